"""Fits of every scene find the truth, and are as uncertain as they say."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.fitting.cases import CASES

REPEATS = 200
# Of 200 repeats 95 % lie inside a 95 % interval, give or take 4 (2.6 standard deviations).
INSIDE = (0.91, 0.99)


def inside(values, sd, truth):
    """The share of estimates within 1.96 standard deviations of the truth, by parameter."""
    return np.mean(np.abs(values - truth) < 1.96 * sd, axis=0)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_recovers_the_truth_and_its_uncertainty(name):
    """Without errors the truth to 1e-8; with errors the truth within the 95 % interval in 95 % of 200 repeats."""
    case = CASES[name]
    measured = case.measured(case.truth())
    names = sorted(case.free)
    truth = np.array([case.params[n] for n in names])
    exact = case.fit(measured)
    assert bool(exact.converged)
    assert exact.names == tuple(names)
    np.testing.assert_allclose(exact.values, truth, rtol=1e-8)

    def repeat(point):
        found = case.fit(case.noisy(measured, jax.random.key(point["seed"])))
        return found.values, found.sd, found.converged

    values, sd, converged = lj.sweep(repeat, {"seed": np.arange(REPEATS)}, progress=False).values
    assert converged.all()
    share = inside(values, sd, truth)
    assert np.all((share >= INSIDE[0]) & (share <= INSIDE[1])), share
    # Twins: uncertainties that are half or twice as large are found out.
    assert np.all(inside(values, 0.5 * sd, truth) < INSIDE[0])
    assert np.all(inside(values, 2 * sd, truth) > INSIDE[1])
