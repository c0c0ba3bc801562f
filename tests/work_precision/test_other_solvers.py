"""Other tools on the same motion: SciPy's, and diffrax alone, against the closed form of an oscillator."""

import numpy as np
import pytest

from lagjax.work_precision.methods import dop853, usual_others

TS, PARAMS = np.linspace(0.0, 2.0, 5), {"k": 4.0}
START = {"x": 1.0}, {"x": 0.0}


def acceleration(t, q, v, params):
    """x'' = -k x."""
    return {"x": -params["k"] * q["x"]}


@pytest.mark.parametrize("name", ["diffrax, by hand", "DOP853, by hand", "LSODA, by hand"])
def test_each_solves_the_oscillator(name):
    """x = cos 2t in the user's structure; a tighter tolerance gives a smaller error for more evaluations."""
    solve = usual_others(acceleration, *START, PARAMS, TS)[name]
    found = [solve(tolerance) for tolerance in (1e-4, 1e-9)]
    errors = [np.max(np.abs(np.asarray(q["x"]) - np.cos(2 * TS))) for q, _, _ in found]
    rates = [np.max(np.abs(np.asarray(v["x"]) + 2 * np.sin(2 * TS))) for _, v, _ in found]
    assert errors[1] < 1e-7 and rates[1] < 2e-7 and errors[1] < errors[0] and found[1][2] > found[0][2]


def test_what_fails_is_nan():
    """A motion that ends before its time has no states; twin: a shorter one has."""

    def blows_up(t, q, v, params):
        return {"x": 6.0 * q["x"] ** 2}

    # x = 1/(1 - t)².
    start = {"x": 1.0}, {"x": 2.0}
    for end, finite in ((0.5, True), (1.5, False)):
        q, _, _ = dop853(blows_up, *start, PARAMS, np.array([0.0, end]))(1e-8)
        assert np.isfinite(q["x"]).all() == finite
