"""Many steps with derivatives from their states, by one way or by another where that fails."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools import steps_in_both_modes

HEIGHTS = np.array([0.5, 0.25, 1.0, 0.5])


def grown(y, h, rate):
    """Linear growth, of two numbers."""
    return {"a": y["a"] * (1 + rate * h), "b": y["b"] + y["a"] * h}


def failing(limit):
    """The same with another rate, NaN beyond a limit."""
    return lambda y, h, rate: jax.tree.map(lambda x: jnp.where(x > limit, jnp.nan, x), grown(y, h, 2 * rate))


def last(ways, start, rate):
    """The last states."""
    states = steps_in_both_modes(ways, {"a": start, "b": 0.0 * start}, HEIGHTS, rate)
    return states["a"][-1] + 3 * states["b"][-1]


def by_hand(start, rate):
    """The same in a loop."""
    y = {"a": start, "b": 0.0 * start}
    for h in HEIGHTS:
        y = grown(y, h, rate)
    return y["a"] + 3 * y["b"]


def all_of(function):
    """A value, its slopes in both modes, its curvature, and values and slopes of lanes with one rate."""

    def of_lanes(rate):
        return jnp.sum(jax.vmap(function, (0, None))(jnp.array([0.1, 0.2]), rate) ** 2)

    def found(start, rate):
        both = jax.value_and_grad(function, (0, 1))(start, rate), jax.jacfwd(function, (0, 1))(start, rate)
        return both, jax.grad(jax.grad(function, 1), 1)(start, rate), jax.value_and_grad(of_lanes)(rate)

    return jax.tree.leaves(jax.jit(found)(0.5, 0.3))


@pytest.mark.slow
def test_derivatives_of_many_steps():
    """Those of a loop by hand, by the second way where the first fails; twin: where it does not fail."""
    right = all_of(by_hand)
    np.testing.assert_allclose(all_of(lambda *given: last([failing(-1.0), grown], *given)), right, rtol=1e-13)
    first = all_of(lambda *given: last([failing(1e9), grown], *given))
    np.testing.assert_allclose(first[0], by_hand(0.5, 0.6), rtol=1e-13)
    assert np.min(np.abs(np.array(first) / np.array(right) - 1)) > 1e-3
