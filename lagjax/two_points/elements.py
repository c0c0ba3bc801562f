"""The stationary action on elements of a path: polynomials of degree s through Lobatto's nodes, L at Gauss's points.

On an element of length h the path is the polynomial through its s + 1 nodes x_j, ends included, and the integral of L
is Gauss's rule with s points, x(c_i) = Σ_j P_ij x_j and u(c_i) = Σ_j D_ij x_j / h. Virtual displacements of the nodes
give Lagrange's equations in integrated form,

    R_j = Σ_i w_i (h P_ij f_i + D_ij p_i) + h b_j Gᵀ λ_j,    f = ∂L/∂q + Q - ∂R/∂v + Aᵀ μ,    p = ∂L/∂v

with holonomic constraints g = 0 and their multipliers λ at the nodes (b: Lobatto's weights, G = ∂g/∂q), and velocity
constraints with μ at Gauss's points (A = ∂phi/∂v). At a node that two elements share both parts add up to zero; at the
ends of the path R is the momentum, -p at the first and p at the last. Without Q, R and μ it is the derivative of a
discrete action, and its derivative the second variation. It is Gauss's collocation, of order 2s at shared nodes. The
mass matrix is never inverted, and nothing is evaluated at an element's end but g.

Source: Marsden & West, *Acta Numerica* 10 (2001) 357, §2.2.6; Jay, *SIAM J. Numer. Anal.* 45 (2007) 1814 (constraints);
Ober-Blöbaum & Saake, *Adv. Comput. Math.* 41 (2015) 955 (order).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import legendre

from lagjax.jaxtools import once
from lagjax.mechanics import applied_force
from lagjax.system import Model, constraints


class Rule(NamedTuple):
    """An element of degree s on [0, 1], in NumPy: nodes (s + 1,), Gauss's points (s,), and what leads from one to the
    other.

    - `node_weights`: Lobatto's; `weights`: Gauss's.
    - `interpolation`, `derivative` (s, s + 1): from values at the nodes to values and derivatives at the points.
    - `node_derivative` (s + 1, s + 1): from values at the nodes to derivatives there.
    """

    nodes: np.ndarray
    node_weights: np.ndarray
    points: np.ndarray
    weights: np.ndarray
    interpolation: np.ndarray
    derivative: np.ndarray
    node_derivative: np.ndarray

    @property
    def degree(self) -> int:
        return len(self.points)


@once
def rule_of_degree(s: int) -> Rule:
    """Nodes, points, weights and matrices of an element of degree s.

    >>> rule = rule_of_degree(2)
    >>> print(rule.nodes, rule.node_weights.round(6), (rule.derivative @ rule.nodes**2 - 2 * rule.points).round(12))
    [0.  0.5 1. ] [0.166667 0.666667 0.166667] [0. 0.]
    """
    last = np.zeros(s + 1)
    last[s] = 1.0
    # NumPy from 2.5 on returns complex numbers.
    inner = np.sort(np.real(legendre.legroots(legendre.legder(last))))
    x = np.array([-1.0, *inner, 1.0])
    points, weights = legendre.leggauss(s)
    node_weights = 2 / (s * (s + 1) * legendre.legval(x, last) ** 2)
    nodes, points = (x + 1) / 2, (points + 1) / 2
    at_points = lagrange(nodes, points)
    return Rule(nodes, node_weights / 2, points, weights / 2, *at_points, lagrange(nodes, nodes)[1])


def lagrange(nodes: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Matrices (k, m) from values at `nodes` (m,) to values and derivatives of their polynomial at `at` (k,)."""
    values, slopes = np.empty((len(at), len(nodes))), np.zeros((len(at), len(nodes)))
    for j, node in enumerate(nodes):
        others = np.delete(nodes, j)
        factors = (at[:, None] - others[None]) / (node - others)[None]
        values[:, j] = factors.prod(axis=1)
        for k, other in enumerate(others):
            slopes[:, j] += np.delete(factors, k, axis=1).prod(axis=1) / (node - other)
    return values, slopes


def integrals(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Matrix (k, m) from values at `points` (k = m) to the integrals of their polynomial from `start` to each of them.

    >>> print(integrals(np.array([0.0, 1.0]), np.zeros(2)))
    [[0.  0. ]
     [0.5 0.5]]
    """
    x, weights = legendre.leggauss(len(points))
    lengths = points - start
    at = start[:, None] + lengths[:, None] * (x + 1) / 2
    values = lagrange(points, at.ravel())[0].reshape(len(points), len(points), -1)
    return np.einsum("i,k,ikj->ij", lengths, weights / 2, values)


class PointStates(NamedTuple):
    """Times, positions and velocities at the points of an element."""

    t: Float[Array, " s"]
    x: Float[Array, "s n"]
    u: Float[Array, "s n"]


def at_points(rule: Rule, t: Array, h: Array, nodes: Float[Array, "s+1 n"]) -> PointStates:
    """The states at the points of the element that starts at t and is h long."""
    dtype = nodes.dtype
    x, u = rule.interpolation.astype(dtype) @ nodes, rule.derivative.astype(dtype) @ nodes / h
    return PointStates(t + h * rule.points.astype(dtype), x, u)


def force_and_momentum(
    model: Model, t: Array, x: Array, u: Array, multipliers: Float[Array, " mv"] | None = None
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """f = ∂L/∂q + Q - ∂R/∂v + Aᵀ μ and p = ∂L/∂v at one state; μ of the velocity constraints alone, stacked."""
    gradient, p = jax.grad(model.lagrangian, argnums=(1, 2))(t, x, u)
    f = gradient + applied_force(model, t, x, u)
    if multipliers is not None and multipliers.size:
        f = f + jax.vjp(lambda u: velocity_constraints(model, t, x, u), u)[1](multipliers)[0]
    return f, p


def virtual_work(rule: Rule, h: Array, force: Float[Array, "s n"], momentum: Float[Array, "s n"]):
    """R (s + 1, n) of an element, from f and p at its points."""
    dtype = force.dtype
    w = rule.weights.astype(dtype)[:, None]
    return h * (rule.interpolation.T.astype(dtype) @ (w * force)) + rule.derivative.T.astype(dtype) @ (w * momentum)


def constraint_impulse(
    model: Model, rule: Rule, t: Array, h: Array, nodes: Float[Array, "s+1 n"], multipliers: Float[Array, "s+1 mh"]
) -> Float[Array, "s+1 n"]:
    """h b_j Gᵀ λ_j at the nodes of an element."""

    def at(t: Array, x: Array, multipliers: Array) -> Array:
        return jax.vjp(lambda x: constraints.position_residual(model, t, x), x)[1](multipliers)[0]

    dtype = nodes.dtype
    times = t + h * rule.nodes.astype(dtype)
    return h * rule.node_weights.astype(dtype)[:, None] * jax.vmap(at)(times, nodes, multipliers)


def residual(
    model: Model,
    rule: Rule,
    t: Array,
    h: Array,
    nodes: Float[Array, "s+1 n"],
    node_multipliers: Float[Array, "s+1 mh"] | None = None,
    point_multipliers: Float[Array, "s mv"] | None = None,
) -> Float[Array, "s+1 n"]:
    """R of an element."""
    states = at_points(rule, t, h, nodes)
    if point_multipliers is None:
        f, p = jax.vmap(lambda t, x, u: force_and_momentum(model, t, x, u))(*states)
    else:
        f, p = jax.vmap(lambda *state: force_and_momentum(model, *state))(*states, point_multipliers)
    work = virtual_work(rule, h, f, p)
    if node_multipliers is None or node_multipliers.shape[1] == 0:
        return work
    return work + constraint_impulse(model, rule, t, h, nodes, node_multipliers)


def discrete_action(model: Model, rule: Rule, t: Array, h: Array, nodes: Float[Array, "s+1 n"]) -> Float[Array, ""]:
    """The integral of L over an element by Gauss's rule."""
    return h * rule.weights.astype(nodes.dtype) @ jax.vmap(model.lagrangian)(*at_points(rule, t, h, nodes))


def velocity_constraints(model: Model, t: Array, x: Array, u: Array) -> Float[Array, " mv"]:
    """phi of the velocity constraints, stacked."""
    q, v = model.tree(x), model.tree(u)
    found = [c.phi(t, q, v, model.params) for c in model.system.constraints.values() if not c.of_positions]
    return jnp.concatenate([jnp.zeros(0, x.dtype), *(jnp.atleast_1d(phi).astype(x.dtype) for phi in found)])
