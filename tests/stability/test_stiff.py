"""Closed forms of stiff motions obey the equations: a mass whirled on a spring, and a brake."""

import numpy as np
import pytest

from lagjax.stability.stiff import _braking, _spring, _whirl, braked, whirled
from tests.stability.closed_forms import defect

TIMES = np.array([0.1, 0.3, 2.0])


@pytest.mark.parametrize("k", [10.0, 1e4])
def test_a_whirled_spring(k):
    """The circle of radius k/(k - 1) at the rate one is a motion; twin: with another stiffness it is none."""
    row = _spring(k, None)
    assert defect(whirled, _whirl, row.q0, row.v0, {"k": k}, TIMES) < 1e-12 * k + 1e-11

    def another(q0, v0, params, t):
        return _whirl(q0, v0, {"k": 1.1 * k}, t)

    assert defect(whirled, another, row.q0, row.v0, {"k": k}, TIMES) > 1e-2
    np.testing.assert_allclose(row.q0, [k / (k - 1.0), 0.0])


def test_a_brake():
    """v decays as e^(-ct); twin: with another friction it does not."""
    assert defect(braked, _braking, 0.5, 2.0, {"c": 3.0}, TIMES) < 1e-9
    assert defect(braked, lambda q, v, p, t: _braking(q, v, {"c": 3.1}, t), 0.5, 2.0, {"c": 3.0}, TIMES) > 1e-2


def test_the_derivative_along_the_circles():
    """The row's direction is that of the start by the rate ω at ω = 1; twin: with a wrong slope it is not."""
    k, h = 10.0, 1e-5
    row = _spring(k, None, derived=True)
    start = lambda w: np.array([k / (k - w**2), w * k / (k - w**2)])
    slope = (start(1 + h) - start(1 - h)) / (2 * h)
    assert row.along is not None
    np.testing.assert_allclose([row.along[0][0], row.along[1][1]], slope, rtol=1e-8)
    assert abs(row.along[1][1] - start(1.0)[1]) > 0.1
