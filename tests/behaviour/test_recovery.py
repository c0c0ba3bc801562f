"""Fits of scenes find the truth, with the correct uncertainties."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import lagjax as lj
from tests.fit.cases import CASES
from tests.tiers import exhaustive_but

REPEATS = 200
# 95 % of 200 repeats lie inside a 95 % interval, give or take 4 % (2.6 standard deviations).
INSIDE = (0.91, 0.99)
# Starts on constraints, one of which depends on a fitted parameter.
STARTS_TOO = ("sphere", "wedge")


def inside(values, sd, truth):
    """The share of estimates within 1.96 standard deviations of the truth, by parameter."""
    return np.mean(np.abs(values - truth) < 1.96 * sd, axis=0)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", exhaustive_but(("pendulum",), CASES))
def test_recovers_the_truth_and_its_uncertainty(name):
    """Without errors the truth to 1e-8; with errors, 95 % of 200 repeats have the truth in their 95 % interval."""
    case = CASES[name]
    measured = case.measured(case.truth())
    truth = np.array([case.params[n] for n in sorted(case.free)])

    def repeat(point):
        noisy = case.noisy(measured, jax.random.key(point["seed"]))
        data = jax.tree.map(lambda x, y: jnp.where(point["seed"] == 0, x, y), measured, noisy)
        found = case.fit(data)
        assert found.names == tuple(sorted(case.free))
        values, sd = found.values, found.sd
        if name in STARTS_TOO:
            values = ravel_pytree((values, found.q0, found.v0))[0]
            sd = ravel_pytree((sd, found.start_sd))[0]
        return values, sd, found.converged

    # One program; the first point has no measurement errors.
    values, sd, converged = lj.sweep(repeat, {"seed": np.arange(REPEATS + 1)}, progress=False).values
    assert converged.all()
    np.testing.assert_allclose(values[0, : len(truth)], truth, rtol=1e-8)
    if name in STARTS_TOO:
        truth = np.asarray(ravel_pytree((truth, case.q0, case.v0))[0])
        np.testing.assert_allclose(values[0], truth, atol=1e-8)
    values, sd = values[1:], sd[1:]
    share = inside(values, sd, truth)
    assert np.all((share >= INSIDE[0]) & (share <= INSIDE[1])), share
    # Twins: uncertainties half or twice as large fail.
    assert np.all(inside(values, 0.5 * sd, truth) < INSIDE[0])
    assert np.all(inside(values, 2 * sd, truth) > INSIDE[1])
