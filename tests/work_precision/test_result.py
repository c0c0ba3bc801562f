"""Comparisons in pandas and xarray: the same numbers, and unknown ones marked as such."""

import numpy as np
import pytest

from lagjax.work_precision import WorkPrecision
from lagjax.work_precision.result import Curve, Point


def point(method, tolerance, error, steps, **others):
    """A point with made-up numbers."""
    known = {"trusted": True, "seconds": 1e-3 * (steps or 1), "least": 9e-4, "evaluations": steps and 6 * steps}
    return Point(method, tolerance, error, steps=steps, **known | {"result": "successful"} | others)


ERRORS = {tolerance: 1.2345678901234567 * tolerance for tolerance in (1e-3, 1e-5, 1e-7)}
ALL = tuple(point("A", tolerance, error, round(tolerance**-0.25)) for tolerance, error in ERRORS.items())
SOME = (point("B", 1e-3, np.inf, None, seconds=np.nan, least=np.nan, trusted=False, result="failed"),)
found = WorkPrecision({"A": Curve("A", None, 2.5, ALL), "B": Curve("B", None, np.nan, SOME)}, None, "as given", 1e-5)


def test_pandas():
    """One row per point, bit for bit; unknown numbers are not zero."""
    import pandas

    table = found.to_pandas()
    assert len(table) == 4 and table["method"].tolist() == ["A", "A", "A", "B"]
    for name in ("tolerance", "error", "seconds", "least", "trusted", "result"):
        np.testing.assert_array_equal(table[name].to_numpy(), [getattr(x, name) for x in found.points])
    assert table["steps"].tolist() == [x.steps for x in ALL] + [pandas.NA]
    np.testing.assert_array_equal(table["order"].to_numpy()[:3], found["A"].order)
    assert isinstance(table["method"].dtype, pandas.CategoricalDtype)
    assert min(table[table["method"] == "A"]["error"].tolist()) == ERRORS[1e-7]
    # Twin: another error is noticed.
    assert not table["error"].equals(found.to_pandas()["error"] * (1 + 1e-15))


def test_xarray():
    """Arrays by method and tolerance; NaN where there is no such point."""
    data = found.to_xarray()
    assert dict(data.sizes) == {"solver": 2, "tolerance": 3} and data["tolerance"].values.tolist() == list(ERRORS)
    np.testing.assert_array_equal(data["error"].sel(solver="A"), list(ERRORS.values()))
    np.testing.assert_array_equal(data["error"].sel(solver="B"), [np.inf, np.nan, np.nan])
    assert data["result"].sel(solver="B").values.tolist() == ["failed", "not tried", "not tried"]
    assert data["order"].sel(solver="A") == found["A"].order and data.attrs["measured"] == "as given"


@pytest.mark.parametrize("name, call", [("pandas", found.to_pandas), ("xarray", found.to_xarray)])
def test_without_the_extra(monkeypatch, name, call):
    """Without the package the message says how to install it."""
    monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(ImportError, match=rf'needs {name}(.|\n)*pip install "lagjax\[data\]"'):
        call()
