"""Tables of runs and cases: relative errors, and what is missed is said."""

from dataclasses import replace

import numpy as np
import pytest

from lagjax.report import Case, Row, case_table, first_answer, relative_error, work_precision_table

ROW = Row("swing", "an angle", "Dopri8", 1e-10, 2e-12, None, 3e-11, 120, None, 0.0025, 1.25, "successful", 1e-9)


def test_relative_errors():
    """Each leaf is measured by its largest exact value, zeros by one; NaN stays, and another structure is no error."""
    exact = {"a": np.array([0.0, -4.0]), "b": np.zeros(2)}
    assert relative_error({"a": np.array([1.0, -4.0]), "b": np.array([0.0, 0.125])}, exact) == 0.25
    assert relative_error(exact, exact) == 0.0 and np.isnan(
        relative_error(exact | {"b": np.array([np.nan, 0.0])}, exact)
    )
    with pytest.raises(ValueError):
        relative_error({"a": exact["a"]}, exact)


def test_a_row_passes_or_not():
    """A required error is met or missed, which the table says; without one nothing is judged. NaN is a miss."""
    assert ROW.passed and "ok (<= 1e-09)" in work_precision_table([ROW])
    for error in (2e-9, float("nan")):
        missed = replace(ROW, error=error)
        assert not missed.passed and "MISSED (> 1e-09)" in work_precision_table([missed])
    assert replace(ROW, error=1.0, required=None).passed
    table = work_precision_table([ROW])
    assert "120" in table and "2.5" in table and "-" in table.splitlines()[-1].split()


def test_lines_below():
    """The first answer's seconds, and cases that went well or did not."""
    assert first_answer([ROW]).startswith("first answer: 1.2 s of tracing and compiling for 'swing' by Dopri8")
    assert "then 2.5 ms per solve" in first_answer([ROW])
    good, bad = Case("easy", "went well", 0.0, 0.1), Case("hard", "went wrong", 1.0, 0.1)
    assert good.passed and not bad.passed
    lines = case_table([good, bad]).splitlines()
    assert "ok" in lines[-2] and "MISSED" in lines[-1] and "went wrong" in lines[-1]
