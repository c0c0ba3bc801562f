"""Elements: Gauss's collocation in Lagrange's terms; whole paths are compared with closed forms in test_connect.py."""

from functools import partial

import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.system import prepare
from lagjax.two_points import elements
from tests.jaxtools.in_numpy import evaluated


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
    pushed = lambda nodes, mu: residual(nodes, point_multipliers=mu).work
    expected = np.array([-v0, 0 * v0, 0 * v0, v0 + a * h])
    assert np.allclose(evaluated(pushed, nodes, np.full((3, 1), mu)), expected, atol=1e-14)
    assert not np.allclose(evaluated(lambda nodes: residual(nodes).work, nodes), expected, atol=1e-2)
