"""A fit prints and draws itself, and is a density of its parameters."""

import jax
import pytest

import lagjax as lj
from tests.fit.cases import PENDULUM, TS, pendulum


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
