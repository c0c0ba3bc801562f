"""Lyapunov exponents through switches: a ball that bounces, and a block that sticks."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.orbits.test_switching_flow import BELT, FLIPS, PERIOD, E, block, bounce, bouncing, stick_slip

BALL = {"A": 1.8 * FLIPS, "omega": 8.0, "e": E}


@pytest.mark.exhaustive
def test_ball_on_a_table():
    """Below the flip log|μ|/T of the orbit's multipliers, of which trace and product are known; far above it, chaos.

    At each impact areas shrink by e², which the sum of the exponents shows.
    """
    ts = np.arange(301) * PERIOD
    t, q, v, trace = bounce(0.07)
    regular = lj.lyapunov_exponents(bouncing, q, v, BALL | {"A": 0.07}, ts=t + ts, count=2)
    exact = np.log(np.abs(np.roots([1.0, -trace, E**2]))) / PERIOD
    np.testing.assert_array_less(np.abs(regular.exponents - np.sort(exact)[::-1]), regular.uncertainty)
    np.testing.assert_allclose(jnp.sum(regular.exponents), 2 * np.log(E) / PERIOD, atol=1e-9)
    chaotic = lj.lyapunov_exponents(bouncing, 2 * BALL["A"] + 0.5, 0.3, BALL, ts=ts, count=2)
    assert bool(chaotic.sensitive) and not bool(regular.sensitive)
    assert np.isnan(chaotic.liouville) and "Liouville" not in repr(chaotic)


@pytest.mark.exhaustive
def test_a_block_that_sticks():
    """Along a cycle the exponent is zero; across it neighbours meet, -inf, as the multiplier 0 says."""
    found = lj.lyapunov_exponents(block, 0.1, 0.25, BELT, ts=np.linspace(0.0, 10 * stick_slip(BELT), 101), count=2)
    assert bool(found.ended) and abs(found.exponents[0]) < found.uncertainty[0]
    assert found.exponents[1] == -np.inf and found.uncertainty[1] == 0
    assert "-inf" in repr(found) and "neighbours meet" in repr(found)
    # From the time at which growth is counted to a whole number of periods later, nothing has grown.
    np.testing.assert_allclose(np.sum(found.growth[30:90, 0]), 0.0, atol=1e-7)
    found.plot()
