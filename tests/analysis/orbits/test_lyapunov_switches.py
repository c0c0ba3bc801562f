"""Lyapunov exponents through switches: a ball against NumPy with saltation matrices, and a block that sticks."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import lagjax as lj
from tests.analysis.orbits.test_switching_flow import BELT, FLIPS, PERIOD, E, G, block, bounce, bouncing, stick_slip

BALL = {"A": 1.8 * FLIPS, "omega": 8.0, "e": E}


def gaps(t, q, v, later):
    """The height over the table after these times, without an impact."""
    return q + v * later - G * later**2 / 2 - BALL["A"] * np.sin(BALL["omega"] * (t + later))


def next_impact(t, q, v, end):
    """The time until the table is met, or None: the first change of sign on a grid."""
    grid = np.append(np.arange(0.01, end - t, 0.01), end - t)
    below = np.flatnonzero(gaps(t, q, v, grid) < 0)
    if not below.size:
        return None
    before = grid[below[0] - 1] if below[0] else 1e-9
    root = optimize.brentq(lambda later: float(gaps(t, q, v, later)), before, grid[below[0]], xtol=1e-15, rtol=1e-15)
    return float(np.asarray(root))


def struck(t, v):
    """The velocity after an impact, and the saltation matrix, R + (f⁺ - R f⁻ - ∂R/∂t) ∇g / g'."""
    A, omega, e = BALL.values()
    table, turns = A * omega * np.cos(omega * t), -A * omega**2 * np.sin(omega * t)
    after, reset = -e * v + (1 + e) * table, np.diag([1.0, -e])
    jump = np.array([after, -G]) - reset @ [v, -G] - [0.0, (1 + e) * turns]
    return after, reset + np.outer(jump, [1.0, 0.0]) / (v - table)


def by_numpy(q, v, ts):
    """The logarithms of the growth of two tangents from time to time, and the number of impacts after each."""
    t, frame, grown, impacts, counts = ts[0], np.eye(2), [], 0, []
    for end in ts[1:]:
        while (later := next_impact(t, q, v, end)) is not None:
            q, v, t = q + v * later - G * later**2 / 2, v - G * later, t + later
            v, saltation = struck(t, v)
            frame, impacts = saltation @ np.array([[1.0, later], [0.0, 1.0]]) @ frame, impacts + 1
        q, v, flight, t = q + v * (end - t) - G * (end - t) ** 2 / 2, v - G * (end - t), end - t, end
        frame, r = np.linalg.qr(np.array([[1.0, flight], [0.0, 1.0]]) @ frame)
        grown.append(np.log(np.abs(np.diag(r))))
        counts.append(impacts)
    return np.array(grown), np.array(counts)


@pytest.mark.exhaustive
def test_chaotic_ball():
    """The exponents agree with NumPy's, and areas shrink by e² at each impact, until the motions part.

    Twin: below the flip the orbit is regular, with log|μ|/T of its multipliers, of which trace and product are known.
    """
    ts, start = np.arange(301) * PERIOD, (2 * BALL["A"] + 0.5, 0.3)
    found = lj.lyapunov_exponents(bouncing, *start, BALL, ts=ts, count=2)
    grown, counts = by_numpy(*start, ts)
    volume = np.cumsum(np.sum(np.asarray(found.growth), axis=1))[:10]
    assert counts[9] >= 5
    np.testing.assert_allclose(volume, 2 * np.log(E) * counts[:10], atol=1e-6)
    np.testing.assert_allclose(volume, np.cumsum(grown.sum(axis=1))[:10], atol=1e-6)
    settled = np.sum(grown[75:], axis=0) / (ts[-1] - ts[75])
    np.testing.assert_array_less(np.abs(found.exponents - settled), 2 * np.asarray(found.uncertainty))
    assert bool(found.sensitive) and np.isnan(found.liouville) and "Liouville" not in repr(found)
    t, q, v, trace = bounce(0.07)
    regular = lj.lyapunov_exponents(bouncing, q, v, BALL | {"A": 0.07}, ts=t + ts, count=2)
    exact = np.log(np.abs(np.roots([1.0, -trace, E**2]))) / PERIOD
    np.testing.assert_array_less(np.abs(regular.exponents - np.sort(exact)[::-1]), regular.uncertainty)
    np.testing.assert_allclose(jnp.sum(regular.exponents), np.sum(exact), atol=1e-9)
    assert not bool(regular.sensitive)


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
