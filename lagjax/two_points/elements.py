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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import legendre

from lagjax.jaxtools import numpy_of, once
from lagjax.mechanics import applied_force
from lagjax.numerics import dense
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
    to_points, to_nodes = derivatives(nodes, points), derivatives(nodes, nodes)
    return Rule(nodes, node_weights / 2, points, weights / 2, basis(nodes, points), to_points, to_nodes)


def basis(nodes: np.ndarray, at: Float[Array, "..."]) -> Float[Array, "... m"]:
    """The polynomials that are one at one of the nodes (m,) and zero at the others, at any places.

    >>> print(basis(np.array([0.0, 1.0]), np.array(0.25)))
    [0.75 0.25]
    """
    xp: Any = numpy_of(at)
    own = np.eye(len(nodes), dtype=bool)
    factors = (xp.reshape(at, (-1, 1, 1)) - nodes[None, None]) / (nodes[:, None] - nodes + own)[None]
    return xp.prod(xp.where(own[None], 1.0, factors), axis=2).astype(at.dtype).reshape(*at.shape, len(nodes))


def derivatives(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Matrix (k, m) from values at `nodes` (m,) to derivatives of their polynomial at `at` (k,)."""
    found = np.zeros((len(at), len(nodes)))
    for j, node in enumerate(nodes):
        others = np.delete(nodes, j)
        factors = (at[:, None] - others[None]) / (node - others)[None]
        for k, other in enumerate(others):
            found[:, j] += np.delete(factors, k, axis=1).prod(axis=1) / (node - other)
    return found


def integrals(points: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Matrix (k, m) from values at `points` (k = m) to the integrals of their polynomial from `start` to each of them.

    >>> print(integrals(np.array([0.0, 1.0]), np.zeros(2)))
    [[0.  0. ]
     [0.5 0.5]]
    """
    x, weights = legendre.leggauss(len(points))
    lengths = points - start
    at = start[:, None] + lengths[:, None] * (x + 1) / 2
    return np.einsum("i,k,ikj->ij", lengths, weights / 2, basis(points, at))


def linear_motion(
    rule: Rule, h: Array | float, matrices: Float[Array, "s m m"], known: Float[Array, "m c"], backward: bool = False
) -> tuple[Float[Array, "s m c"], Float[Array, "m c"]]:
    """The solutions of ẏ = M y by Gauss's collocation: at the points of an element, and at its end.

    From what is known at the start, with M at the points; `backward` from the end to the start.

    >>> _, end = linear_motion(rule_of_degree(4), 1.0, np.ones((4, 1, 1)), np.ones((1, 1)))
    >>> print(end.round(6))
    [[2.718282]]
    """
    xp: Any = numpy_of((h, matrices, known))
    size = matrices.shape[0] * matrices.shape[1]
    # y_i = y_0 + h Σ_j (∫_0^{c_i} l_j) ẏ_j, and ẏ_j = M_j y_j; from the end on, 1 stands in the place of 0.
    reach = integrals(rule.points, np.full(rule.degree, float(backward))).astype(known.dtype)
    system = np.eye(size, dtype=known.dtype) - h * xp.einsum("ij,jab->iajb", reach, matrices).reshape(size, size)
    inverse: Any = np.linalg.inv if xp is np else dense.inverse
    inside = (inverse(system) @ xp.tile(known, (rule.degree, 1))).reshape(rule.degree, *known.shape)
    change = h * xp.einsum("j,jab,jbc->ac", rule.weights.astype(known.dtype), matrices, inside)
    return inside, known - change if backward else known + change


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
    model: Model, t: Array, x: Array, u: Array, multipliers: Float[Array, " mv"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """f = ∂L/∂q + Q - ∂R/∂v + Aᵀ μ and p = ∂L/∂v at one state; μ of the velocity constraints alone, stacked."""
    gradient, p = jax.grad(model.lagrangian, argnums=(1, 2))(t, x, u)
    f = gradient + applied_force(model, t, x, u)
    if multipliers.size:
        f = f + jax.vjp(lambda u: velocity_constraints(model, t, x, u), u)[1](multipliers)[0]
    return f, p


def virtual_work(rule: Rule, h: Array, force: Float[Array, "s n"], momentum: Float[Array, "s n"]):
    """R (s + 1, n) of an element, from f and p at its points."""
    dtype = force.dtype
    w = rule.weights.astype(dtype)[:, None]
    return h * (rule.interpolation.T.astype(dtype) @ (w * force)) + rule.derivative.T.astype(dtype) @ (w * momentum)


class Defects(NamedTuple):
    """By how much an element misses its equations: R, and the holonomic constraints g, at its nodes."""

    work: Float[Array, "s+1 n"]
    g: Float[Array, "s+1 m"]


def of_constraints(model: Model, t: Array, node: Float[Array, " N"]) -> tuple[Float[Array, " n"], Float[Array, " m"]]:
    """Gᵀ λ and g at a node (x, λ)."""
    g, back = jax.vjp(lambda x: constraints.position_residual(model, t, x), node[: model.n])
    return back(node[model.n :])[0], g


def defects(
    model: Model, rule: Rule, t: Array, h: Array, nodes: Float[Array, "s+1 N"], force: Array, momentum: Array
) -> Defects:
    """R and g of an element with nodes (x, λ), from f and p (s, n) at its points."""
    work, dtype = virtual_work(rule, h, force, momentum), nodes.dtype
    if nodes.shape[1] == model.n:
        return Defects(work, jnp.zeros((len(nodes), 0), dtype))
    impulse, g = jax.vmap(lambda t, node: of_constraints(model, t, node))(t + h * rule.nodes.astype(dtype), nodes)
    return Defects(work + h * rule.node_weights.astype(dtype)[:, None] * impulse, g)


def residual(
    model: Model,
    rule: Rule,
    t: Array,
    h: Array,
    nodes: Float[Array, "s+1 N"],
    point_multipliers: Float[Array, "s mv"] | None = None,
) -> Defects:
    """R and g of an element with nodes (x, λ)."""
    states = at_points(rule, t, h, nodes[:, : model.n])
    multipliers = jnp.zeros((rule.degree, 0), nodes.dtype) if point_multipliers is None else point_multipliers
    f, p = jax.vmap(lambda *state: force_and_momentum(model, *state))(*states, multipliers)
    return defects(model, rule, t, h, nodes, f, p)


def discrete_action(model: Model, rule: Rule, t: Array, h: Array, nodes: Float[Array, "s+1 N"]) -> Float[Array, ""]:
    """The integral of L over an element by Gauss's rule, and h Σ b_j g·λ_j: without Q, R and μ its derivative by (x, λ)
    is R and h b_j g."""
    dtype, (x, multipliers) = nodes.dtype, jnp.split(nodes, [model.n], axis=1)
    action = h * rule.weights.astype(dtype) @ jax.vmap(model.lagrangian)(*at_points(rule, t, h, x))
    if not multipliers.size:
        return action
    g = jax.vmap(lambda t, x: constraints.position_residual(model, t, x))(t + h * rule.nodes.astype(dtype), x)
    return action + h * jnp.sum(rule.node_weights.astype(dtype)[:, None] * g * multipliers)


def velocity_constraints(model: Model, t: Array, x: Array, u: Array) -> Float[Array, " mv"]:
    """phi of the velocity constraints, stacked."""
    q, v = model.tree(x), model.tree(u)
    found = [c.phi(t, q, v, model.params) for c in model.system.constraints.values() if not c.of_positions]
    return jnp.concatenate([jnp.zeros(0, x.dtype), *(jnp.atleast_1d(phi).astype(x.dtype) for phi in found)])
