"""Elements: Gauss's collocation in Lagrange's terms, its order with and without constraints."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import lagjax as lj
from lagjax.system import constraints, prepare
from lagjax.two_points import elements
from tests.jaxtools.in_numpy import evaluated

T = 1.0
angle = lj.System(lambda t, q, v, params: 0.5 * v["x"][0] ** 2 + jnp.cos(q["x"][0]))
rod = lj.System(
    lambda t, q, v, params: 0.5 * jnp.sum(v["x"] ** 2) - q["x"][1],
    {"rod": lj.Holonomic(lambda t, q, params: 0.5 * (jnp.sum(q["x"] ** 2) - 1))},
)


def pendulum(t):
    """The angle of a pendulum that starts at rest from 2 asin(sqrt(m)), by Jacobi's functions."""
    sn, _, dn, _ = scipy.special.ellipj(scipy.special.ellipk(0.5) - t, 0.5)
    return 2 * np.arcsin(np.sqrt(0.5) * sn)


def error(s, count, constrained, node_weights=None):
    """The errors at shared nodes of the path between the ends and of its multipliers, by Newton's method."""
    rule = elements.rule_of_degree(s)
    if node_weights is not None:
        rule = rule._replace(node_weights=node_weights)
    h = T / count
    t = np.concatenate([[0.0], *(k * h + h * rule.nodes[1:] for k in range(count))])
    theta = pendulum(t)
    exact = np.stack([np.sin(theta), -np.cos(theta)], axis=1) if constrained else theta[:, None]
    n, m = exact.shape[1], int(constrained)
    q = {"x": exact[0]}
    model, _ = prepare(rod if constrained else angle, 0.0, q, q, None)

    @jax.jit
    def residual(z):
        x, multipliers = z[:, :n], z[:, n:]
        total = jnp.zeros_like(x)
        for k in range(count):
            part = slice(k * s, k * s + s + 1)
            at = jnp.asarray(k * h), jnp.asarray(h), x[part], multipliers[part]
            total = total.at[part].add(elements.residual(model, rule, *at))
        g = jax.vmap(partial(constraints.position_residual, model, jnp.zeros(())))(x)
        return jnp.concatenate([total, g], axis=1)

    def inner(y):
        whole = jnp.concatenate([exact, np.zeros((len(t), m))], axis=1)
        return residual(whole.at[1:-1].set(y.reshape(len(t) - 2, n + m)))[1:-1].ravel()

    y = np.concatenate([exact, np.zeros((len(t), m))], axis=1)[1:-1].ravel()
    matrix = jax.jit(jax.jacfwd(inner))
    for _ in range(5):
        y = y - np.linalg.solve(matrix(y), inner(y))
    assert np.max(np.abs(inner(y))) < 1e-13
    x, multipliers = np.split(np.asarray(y).reshape(len(t) - 2, n + m)[s - 1 :: s], [n], axis=1)
    # By energy, the rod pulls with three times the weight's component along it.
    tension = -3 * np.cos(theta[s:-1:s])[:, None]
    return np.max(np.abs(x - exact[s:-1:s])), np.max(np.abs(multipliers - tension), initial=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("constrained", [False, True])
def test_order(constrained):
    """The error at shared nodes falls with h to the power 2s, constraints or not, and the multipliers are those of the
    motion. Twin: weights of impulses that are not Lobatto's give other multipliers."""
    (coarse, _), (fine, of_multipliers) = error(3, 2, constrained), error(3, 4, constrained)
    assert abs(np.log2(coarse / fine) - 6) < 1.0
    assert of_multipliers < 1e-3
    if constrained:
        assert error(3, 4, True, np.full(4, 0.25))[1] > 0.1


def test_momentum_at_the_ends():
    """R of an element with an exact path is -p at its start and p at its end, and 0 between; its sum is the impulse of
    all forces, velocity constraints included. Twin: without the multiplier."""
    system = lj.System(
        lambda t, q, v, params: 0.5 * jnp.sum(v**2) - 3.0 * q[1],
        {"slope": lj.Nonholonomic(lambda t, q, v, params: v[1] - 2 * v[0])},
    )
    rule, start, rate, a, mu = elements.rule_of_degree(3), np.array([1.0, 2.0]), 0.3, np.array([-1.2, -2.4]), 0.6
    model, _ = prepare(system, 0.0, start, start, None)
    h = np.array(0.7)
    tau = h * rule.nodes[:, None]
    v0 = np.array([rate, 2 * rate])
    nodes = start[None] + v0[None] * tau + 0.5 * a[None] * tau**2
    residual = partial(elements.residual, model, rule, np.zeros(()), h)
    pushed = lambda nodes, mu: residual(nodes, point_multipliers=mu)
    expected = np.array([-v0, 0 * v0, 0 * v0, v0 + a * h])
    assert np.allclose(evaluated(pushed, nodes, np.full((3, 1), mu)), expected, atol=1e-14)
    assert not np.allclose(evaluated(residual, nodes), expected, atol=1e-2)
