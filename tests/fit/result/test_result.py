"""A fit is a density of its parameters; what its residuals tell, in words."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import PENDULUM, TS, noisy, pendulum


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
def test_what_the_residuals_tell():
    """As many unknowns as measurements leave no uncertainty; residuals on a curve are not measurement errors."""
    spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["k"] * q**2)
    with pytest.warns(lj.FitWarning, match="as many unknowns as measurements.*\n.*sigma="):
        found = lj.fit(spring, lj.Record([0.0, 0.5, 1.0], q=[1.0, 0.9, 0.6]), {"k": 1.0})
    assert np.isnan(found.sd).all() and np.isnan(found.start_sd[0][0])
    # Twin: the same with the size of the errors given.
    told = lj.fit(spring, lj.Record([0.0, 0.5, 1.0], q=[1.0, 0.9, 0.6], sigma=0.01), {"k": 1.0})
    assert np.isfinite(told.sd).all()
    clean = lj.integrate(spring, 1.0, 0.0, {"k": 4.0}, ts=TS).q
    data = noisy(np.asarray(clean) + 0.3 * np.cos(9 * TS), 0.02)
    with pytest.warns(lj.FitWarning, match="residuals of 'q' are not measurement errors"):
        lj.fit(spring, lj.Record(TS, q=data), {"k": 3.0})
    # Twin: residuals as large, but uncorrelated.
    lj.fit(spring, lj.Record(TS, q=noisy(np.asarray(clean), 0.25)), {"k": 3.0})
