"""A fit prints and draws itself, and is a density of its parameters."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import FREE, GUESS, PENDULUM, TS, noisy, pendulum


@pytest.mark.exhaustive
def test_log_likelihood(swinging):
    """The likelihood is largest at the estimates, and falls by a half at one standard deviation."""
    record = lj.Record(TS, q=swinging[0], sigma=0.01, q0=1.0, v0=0.0, hold_q=True, hold_v=True)
    found = lj.fit(pendulum, record, PENDULUM | {"l": 1.3}, free="l")
    density = jax.jit(found.log_likelihood)
    best = float(density(found.sampling))
    assert best == pytest.approx(-0.5 * float(found.chi2), abs=1e-9)
    moved = float(density({"l": found.values[0] + found.sd[0]}))
    assert moved - best == pytest.approx(-0.5, rel=0.01)
    slope = jax.grad(lambda l: found.log_likelihood({"l": l}))(found.values[0] + found.sd[0])
    assert float(slope * found.sd[0]) == pytest.approx(-1.0, rel=0.02)


@pytest.mark.exhaustive
def test_the_fitted_motion(swinging):
    """It is nearer to the measurements than they are to the truth: what is between them are the residuals."""
    data = noisy(swinging[0])
    found = lj.fit(pendulum, lj.Record(TS, q=data), GUESS, free=FREE)
    np.testing.assert_allclose(found.motion().q, data + found.residuals()["q"], atol=1e-8)


@pytest.mark.exhaustive
def test_log_likelihood_of_several_runs(swinging):
    """With two records, the likelihood at the estimates is that of the sum of squares of both."""
    records = [lj.Record(TS, q=noisy(swinging[0], seed=i), q0=1.0, v0=0.0, sigma=0.01) for i in (1, 2)]
    found = lj.fit(pendulum, records, GUESS, free=FREE)
    assert float(found.log_likelihood(found.sampling)) == pytest.approx(-0.5 * float(found.chi2), rel=1e-9)
