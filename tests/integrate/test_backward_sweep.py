"""The loop back over the steps: no cotangent is dropped, lanes that failed add nothing, networks as matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.test_replay import end, modes_agree

pytestmark = pytest.mark.usefixtures("in_reverse")


@pytest.mark.exhaustive
def test_lanes_that_fail_have_no_part():
    """A lane without mass does not start: it adds nothing to derivatives by shared parameters, and its own are zero."""
    heavy = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v**2 - 0.5 * p["k"] * q**2)
    one = lambda k, m: end(heavy, 0.5, 0.0, {"k": k, "m": m})
    derivatives = jax.jit(jax.grad(lambda k, m, w: jnp.sum(w * jax.vmap(one, (None, 0))(k, m)), (0, 1)))
    by_k, by_m = derivatives(2.0, jnp.array([1.0, 0.0, 2.0]), jnp.ones(3))
    k, m = derivatives(2.0, jnp.array([1.0, 1.5, 2.0]), jnp.array([1.0, 0.0, 1.0]))
    np.testing.assert_allclose(by_k, k, rtol=1e-12)
    np.testing.assert_allclose(by_m, m, rtol=1e-12)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", ((8, 3), (72, 1), (72, 3), (8, 1)))
def test_networks_as_matrices(kind):
    """Stages in a loop and as copies; two coordinates of different masses; by the weights, the masses and the start."""
    hidden, lanes = kind
    random = np.random.default_rng(0)
    w = [random.normal(size=(2, hidden)), random.normal(size=(hidden, hidden)) / hidden, random.normal(size=hidden)]

    def lagrangian(t, q, v, p):
        w, m = p
        return 0.5 * jnp.sum(m * v**2) - 0.5 * jnp.sum(q**2) - jnp.tanh(jnp.tanh(q @ w[0]) @ w[1]) @ w[2]

    system, q0 = lj.System(lagrangian), random.normal(size=(3, 2))

    def total(x):
        *p, q = x
        of = lambda q: end(system, q, jnp.zeros(2), p)
        return jnp.sum(jax.vmap(of)(q)) if lanes == 3 else of(q[0])

    modes_agree(total, (w, np.array([1.0, 3.0]), q0), rtol=1e-10)
