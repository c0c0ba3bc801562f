"""The record of steps: as large as is asked for, and steps that are run again are the same."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.test_replay import PARAMS, TS, pendulum

pytestmark = pytest.mark.usefixtures("in_reverse")


def long_swing():
    """The derivative of a pendulum's last angle, after a time of 2000, by its thirty parameters."""
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.sum(p) * jnp.cos(q))
    end = lambda p, adjoint: lj.integrate(system, 1.0, 0.0, p, ts=np.array([0.0, 2e3]), adjoint=adjoint).q[-1]
    return lambda adjoint: jax.jit(jax.grad(lambda p: end(p, adjoint)))


@pytest.mark.exhaustive
def test_a_budget_of_memory():
    """A record has the requested size, and pieces that are run again meet whatever the round-off."""
    at, swing = jnp.full(30, 1 / 30), long_swing()
    whole, pieces = (swing(lj.Replay(memory=memory)) for memory in (1e6, 1e5))
    assert 0.8e6 < whole.lower(at).compile().memory_analysis().temp_size_in_bytes < 1.2e6
    assert 0.8e5 < pieces.lower(at).compile().memory_analysis().temp_size_in_bytes < 1.2e5
    np.testing.assert_allclose(pieces(at), whole(at), rtol=1e-6)


def test_a_budget_that_is_none():
    """A budget that is too small, not positive or not usable is refused with a remedy."""
    with pytest.raises(ValueError, match=r"(?s)has no room.*Fix: lj.Replay\(memory=5e3\)"):
        long_swing()(lj.Replay(memory=100.0))(jnp.ones(30))
    with pytest.raises(ValueError, match="positive number of bytes"):
        lj.Replay(memory=-1.0)
    chosen = diffrax.PIDController(rtol=1e-6, atol=1e-9)
    with pytest.raises(ValueError, match="none is kept with a stepsize_controller"):
        lj.integrate(pendulum(), 1.0, 0.0, PARAMS, ts=TS, adjoint=lj.Replay(memory=1e6), stepsize_controller=chosen)
