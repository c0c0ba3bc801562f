"""Forces that are linear in the multipliers, however they are written; and those that are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools.dependence import is_linear
from tests.jaxtools.in_numpy import evaluated

E, UP = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


@jax.custom_jvp
def unchanged(x):
    """The same number, with a derivative of its own."""
    return 1.0 * x


unchanged.defjvp(lambda at, along: (unchanged(at[0]), along[0]))
to_velocity = lambda v: jnp.cross(UP, v)[:2]
halves = lambda n, state: (state[0] + 1, state[1] - 0.15 * n * E)

# Each is -0.3 n along x, for v[0] > 0.
LINEAR = {
    "a product": lambda n, v: -0.3 * n * E,
    "a jitted helper": lambda n, v: jax.jit(lambda n: -0.3 * n * E)(n),
    "cross": lambda n, v: jnp.cross(UP, jnp.array([0.0, 0.3, 0.0]) * n),
    "where between two": lambda n, v: jnp.where(v[0] > 0, -0.3 * n, 0.3 * n) * E,
    "vjp": lambda n, v: jax.vjp(to_velocity, v)[1](jnp.array([0.0, -0.3]) * n)[0],
    "grad": lambda n, v: jax.grad(lambda v: -0.3 * v[0] * n)(v),
    "cond": lambda n, v: jax.lax.cond(v[0] > 0, lambda n: -0.3 * n * E, lambda n: 0.3 * n * E, n),
    "fori_loop": lambda n, v: jax.lax.fori_loop(0, 3, lambda i, x: x - 0.1 * n * E, jnp.zeros(3)),
    "while_loop": lambda n, v: jax.lax.while_loop(lambda s: s[0] < 2, lambda s: halves(n, s), (0, jnp.zeros(3)))[1],
    "solve": lambda n, v: jnp.linalg.solve(2 * jnp.eye(3), -0.6 * n * E),
    "at": lambda n, v: jnp.zeros(3).at[0].add(-0.3 * n),
    "custom_jvp": lambda n, v: -0.3 * unchanged(n) * E,
    "with a force beside it": lambda n, v: -0.3 * n * E + 0.0 * jnp.sin(v),
}
NOT_LINEAR = {
    "abs": lambda n, v: -0.3 * jnp.abs(n) * E,
    "a jitted abs": lambda n, v: -0.3 * jax.jit(jnp.abs)(n) * E,
    "maximum": lambda n, v: -0.3 * jnp.maximum(n, 0) * E,
    "a square": lambda n, v: -0.3 * n**2 * E,
    "where on n": lambda n, v: jnp.where(n > 0, -0.3 * n, 0.0) * E,
    "a jump": lambda n, v: jnp.where(n > 0, 5.0, 3.0) * E,
    "sign": lambda n, v: -0.3 * jnp.sign(n) * E,
    "stop_gradient": lambda n, v: -0.3 * jax.lax.stop_gradient(n) * E,
    "almost abs": lambda n, v: -0.3 * jnp.sqrt(n**2 + 1e-6) * E,
    "tanh": lambda n, v: -0.3 * jnp.tanh(n) * E,
    "a quotient": lambda n, v: -0.3 * n / (1.0 + n**2) * E,
    "clip far out": lambda n, v: -0.3 * jnp.clip(n, -100.0, 100.0) * E,
}


def decided(force):
    """What is decided about a force of one multiplier."""
    return is_linear(lambda n, v: force(n[0], v), 1, np.float64, np.ones(3))


@pytest.mark.parametrize("name", LINEAR)
def test_linear_forces(name):
    """They are linear, and equal to the plain product."""
    assert decided(LINEAR[name])
    (found,) = evaluated(LINEAR[name], 10.0, np.array([2.0, 0.0, 0.0]))
    np.testing.assert_allclose(found, [-3.0, 0.0, 0.0], atol=1e-14)


@pytest.mark.parametrize("name", NOT_LINEAR)
def test_forces_that_are_not_linear(name):
    """They bend or jump with the multiplier: the twins of the linear ones."""
    assert not decided(NOT_LINEAR[name])


def test_what_jax_traces():
    """With traced parameters the same is decided."""

    def both(mu):
        force = lambda n, mu: jnp.where(mu > 0, jnp.linalg.solve(jnp.eye(3), -mu * n * E), mu * n * E)
        assert is_linear(lambda n, mu: force(n[0], mu), 1, np.float64, mu)
        assert not is_linear(lambda n, mu: force(jnp.abs(n[0]), mu), 1, np.float64, mu)
        return mu

    jax.eval_shape(both, 0.3)
