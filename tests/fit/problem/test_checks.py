"""Measurements that the motion does not have, and a guess that cannot move, are refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lagjax.fit.problem import checks
from lagjax.fit.problem.checks import check_predicted
from lagjax.numerics import Unknowns
from tests.fit.cases import pendulum
from tests.fit.problem.test_initial_states import on_a_rod


@pytest.mark.parametrize(
    ("measured", "words"),
    [
        ({"q": {"z": np.zeros((1, 60))}}, "'z' was measured as q, but the motion has no such name: 'x' and 'y'"),
        ({"multipliers": {"rope": np.zeros((1, 60))}}, "'rope' was measured as multipliers(.|\n)*'rod'"),
        ({"q": np.zeros((1, 60))}, "but the motion has(.|\n)*in that structure"),
        ({"q": {"x": np.zeros((1, 60, 1))}}, r"'x' was measured with the shape \(1,\) at each time, but"),
    ],
)
def test_what_the_motion_does_not_have(measured, words):
    """Names, structures and shapes that the motion does not have are refused; twin: those that it has."""
    check_predicted(on_a_rod())
    with pytest.raises(ValueError, match=words):
        check_predicted(replace(on_a_rod(), measured=measured))


def test_a_motion_that_fails(monkeypatch):
    """The record whose motion fails is named, with the message of `integrate`; twin: if all end well nothing is."""

    def integrate(system, q, v, params, *, ts, throw, **options):
        raise ValueError(f"{q} after {v} with {params} at {ts}, {throw}, {options}")

    monkeypatch.setattr(checks, "integrate", integrate)
    setting = lambda x, s, w, stage: ("ts", x, (s, w), {"throw": False, "rtol": 1e-3})
    problem = SimpleNamespace(system=pendulum, setting=setting, windows=SimpleNamespace(record=np.array([0, 7])))
    checks.check_motion(problem, np.array([True, True]), Unknowns("x", "ab"))
    words = "the motion of record 7 fails: b after 1 with x at ts, True, {'rtol': 0.001}"
    with pytest.raises(ValueError, match=f"from the guess {words}"):
        checks.check_motion(problem, np.array([True, False]), Unknowns("x", "ab"))
