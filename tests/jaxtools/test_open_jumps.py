"""A program with the modes of its jumps given is the program itself, with its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.integrate.jumps.find import Given
from tests.integrate.jumps.test_find import JUMPING, jumps_of


def given_at(system, jumps, *state):
    """The parameters with the modes at a state."""
    modes = jumps.modes(system, *state)
    return Given(state[-1], modes, jnp.zeros(jumps.count, bool), jnp.asarray(False))


@pytest.mark.parametrize("name", JUMPING)
def test_in_its_mode_a_force_is_itself(name):
    """At random states: value and derivatives in the state's own mode; guards above zero; a crossed one below.

    Twin: with another mode the value is another one.
    """
    force, rng, differs = JUMPING[name], np.random.default_rng(1), 0
    system, jumps = jumps_of(force)
    smooth, guards = jumps.smooth(system), jumps.numbers(system, 0)
    smooth_force = smooth.force
    assert smooth_force is not None
    beyond = jumps.numbers(system, 1)
    slope = jax.jit(jax.grad(lambda q, v, t, p: smooth_force(t, q, v, p), argnums=(0, 1)))
    right = jax.jit(jax.grad(lambda q, v, t, p: force(t, q, v, p), argnums=(0, 1)))
    for t, q, v in rng.uniform(-1.5, 1.5, (12, 3)):
        state = jnp.asarray(t), jnp.asarray(q), jnp.asarray(v), jnp.asarray(0.3)
        given = given_at(system, jumps, *state)
        np.testing.assert_allclose(smooth_force(*state[:3], given), force(*state), rtol=1e-14, atol=1e-14)
        np.testing.assert_allclose(slope(q, v, t, given), right(q, v, t, state[-1]), rtol=1e-14, atol=1e-14)
        assert all(guard(*state[:3], given) >= 0 for guard in guards)
        for i, (guard, other) in enumerate(zip(guards, beyond)):
            crossed = given._replace(modes=given.modes.at[i].set(other(*state[:3], given)))
            assert guard(*state[:3], crossed) <= 0
            differs += not np.isclose(smooth_force(*state[:3], crossed), force(*state))
    assert differs > 0
