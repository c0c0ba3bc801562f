"""Whole turns of a pendulum: after each it is where it began, with the rate of its start."""

import numpy as np
from scipy import integrate

from lagjax.scenes import bead_on_hoop
from lagjax.stability.long import UNIT, _whole_turns
from tests.by_numpy import by_numpy

RATE = 3.0
period_of = by_numpy(lambda rate: bead_on_hoop.rotation_period(UNIT, rate**2 - 2.0))


def test_the_period_of_a_turn():
    """The time of a turn is ∮ dq / √(v² - 2 (1 - cos q)); twin: for another rate it is another one."""
    time = integrate.quad(lambda q: (RATE**2 - 2 * (1 - np.cos(q))) ** -0.5, 0.0, 2 * np.pi, epsabs=1e-12)[0]
    np.testing.assert_allclose(period_of(RATE), time, rtol=1e-12)
    assert abs(period_of(3.1) / time - 1) > 1e-2


def test_after_whole_turns():
    """Direction and rate at and near whole turns, where the angle changes at the rate of the start."""
    period = float(period_of(RATE))
    direction, rate = by_numpy(_whole_turns)(0.0, RATE, {}, np.array([0.0, 5 * period, 5 * period + 1e-5]))
    np.testing.assert_allclose(direction[:, :2], [[1.0, 1.0], [0.0, 0.0]], atol=1e-13)
    np.testing.assert_allclose(direction[1, 2], RATE * 1e-5, rtol=1e-8)
    np.testing.assert_array_equal(rate, RATE)
