"""A motion with controls as finitely many numbers: a nonlinear program on elements in time.

The elements are those of `elements.py`, where d'Alembert's principle with p = ∂L/∂v takes the place of accelerations,
and M is never inverted. What remains free are the controls, on each element a polynomial through Gauss's points, or
linear, or constant. The cost is the sum of Gauss's rule; the controls and multipliers of the least one are then of the
same order as the motion.

All unknowns stand in one vector: the end's time, the bounds of elements as parts of the whole time, q at the nodes, v
at both ends, controls, λ, μ. Each element sees a few of them, in a *block*, and blocks of one kind are differentiated
together.

Source: Ober-Blöbaum, Junge & Marsden, *ESAIM: COCV* 17 (2011) 322 (discrete mechanics and optimal control);
Leyendecker, Ober-Blöbaum, Marsden & Ortiz, *Optim. Control Appl. Meth.* 31 (2010) 505 (constraints).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.jaxtools import compiled
from lagjax.system import Form, Model, System, constraints, coordinates, unchecked
from lagjax.two_points.elements import (
    Rule,
    at_points,
    constraint_impulse,
    force_and_momentum,
    lagrange,
    rule_of_degree,
    velocity_constraints,
    virtual_work,
)

INTERPOLATIONS = "smooth", "linear", "constant"


class Plant(eqx.Module):
    """The system with its parameters, what it costs, and the form of states and controls.

    `controls`: a control in the user's structure; `merge(params, u)`: the parameters with it.
    """

    system: System
    params: PyTree
    t_a: Array
    cost: Callable | None
    end_cost: Callable | None
    end: Callable | None
    controls: PyTree
    merge: Callable = eqx.field(static=True)
    form: Form = eqx.field(static=True)
    interpolation: str = eqx.field(static=True)
    degree: int = eqx.field(static=True)
    # Coordinates whose velocities have bounds; the number of conditions that `end` returns.
    bounded: tuple[int, ...] = eqx.field(static=True)
    conditions: int = eqx.field(static=True)

    @property
    def n_controls(self) -> int:
        """How many numbers a control is."""
        return sum(int(np.prod(np.shape(x))) for x in jax.tree.leaves(self.controls))

    @property
    def of_positions(self) -> int:
        """How many holonomic equations there are."""
        return sum(r.size for r in self.form.residuals if r.of_positions)

    @property
    def of_velocities(self) -> int:
        """How many equations restrict velocities alone."""
        return self.form.m - self.of_positions

    @property
    def rule(self) -> Rule:
        """Nodes and points of an element."""
        return rule_of_degree(self.degree)

    @property
    def control_nodes(self) -> np.ndarray:
        """At which parts of an element its rows of controls are."""
        return {"smooth": self.rule.points, "linear": np.array([0.0, 1.0]), "constant": np.array([0.5])}[
            self.interpolation
        ]

    def control(self, u: Array) -> PyTree:
        """A vector of controls in the user's structure."""
        return coordinates.like(self.controls, u)

    def model(self, u: Array) -> Model:
        """The model with these controls."""
        return unchecked(self.system, self.merge(self.params, self.control(u)), self.form)


def through(nodes: np.ndarray, at: np.ndarray) -> np.ndarray:
    """From values at `nodes` (m,) to those of their polynomial at `at` (k,), (k, m)."""
    return lagrange(nodes, at)[0]


class Element(NamedTuple):
    """What one element sees: times, and rows of positions, controls, λ and μ."""

    end: Array
    parts: Array
    q: Array
    controls: Array
    node_multipliers: Array
    point_multipliers: Array


class PlanEnds(NamedTuple):
    """What the conditions at both ends see; the controls are those of the first and of the last element.

    `impulse`: along the velocity constraints, at the end.
    """

    end: Array
    q: Array
    v: Array
    controls: Array
    impulse: Array


def of_element(plant: Plant, z: Element) -> tuple[Array, Array]:
    """The cost of an element, and its part of the equations: virtual work, g, phi, and bounded velocities."""
    rule = plant.rule
    total = z.end[0] - plant.t_a
    t, h = plant.t_a + total * z.parts[0], total * (z.parts[1] - z.parts[0])
    states = at_points(rule, t, h, z.q)
    u = through(plant.control_nodes, rule.points) @ z.controls

    def at_point(t: Array, x: Array, v: Array, u: Array, multipliers: Array):
        model = plant.model(u)
        force, p = force_and_momentum(model, t, x, v, multipliers)
        cost = 0.0
        if plant.cost is not None:
            cost = plant.cost(t, model.tree(x), model.tree(v), plant.control(u), plant.params)
        return force, p, velocity_constraints(model, t, x, v), jnp.asarray(cost, x.dtype)

    force, p, phi, cost = jax.vmap(at_point)(*states, u, z.point_multipliers)
    work, g = virtual_work(rule, h, force, p), jnp.zeros((0,), z.q.dtype)
    if plant.of_positions:
        # Constraints are to hold whatever the controls are: these are taken where the element begins.
        model = plant.model(u[0])
        work = work + constraint_impulse(model, rule, t, h, z.q, z.node_multipliers)
        g = jax.vmap(lambda t, x: constraints.position_residual(model, t, x))(t + h * rule.nodes[1:], z.q[1:])
    rows = work, g, phi, states.u[:, list(plant.bounded)]
    return h * jnp.sum(rule.weights * cost), jnp.concatenate([jnp.ravel(x) for x in rows])


def of_ends(plant: Plant, z: PlanEnds) -> tuple[Array, Array]:
    """The cost of the end, and the equations there: momenta, constraints at the start and at the end, conditions."""
    ts, at = (plant.t_a, z.end[0]), through(plant.control_nodes, np.array([0.0, 1.0]))
    rows, of_constraints = [], []
    for i, sign in ((0, 1.0), (1, -1.0)):
        model = plant.model(at[i] @ z.controls[i])

        def g(t: Array, x: Array, model: Model = model):
            return constraints.position_residual(model, t, x)

        p = jax.grad(model.lagrangian, argnums=2)(ts[i], z.q[i], z.v[i])
        phi, back = jax.vjp(lambda v: velocity_constraints(model, ts[i], z.q[i], v), z.v[i])
        # Velocity constraints hold at points inside, and what the last step misses them by is returned at the end.
        rows.append(sign * p + (back(z.impulse)[0] if i else 0.0))
        value, rate = jax.jvp(g, (ts[i], z.q[i]), (jnp.ones_like(ts[i]), z.v[i]))
        of_constraints += [rate, phi] if i else [value, rate, phi]
    last = ts[1], plant.form.tree(z.q[1]), plant.form.tree(z.v[1]), plant.params
    conditions = [] if plant.end is None else [coordinates.flatten(plant.end(*last))[0]]
    cost = 0.0 if plant.end_cost is None else plant.end_cost(*last)
    return jnp.asarray(cost, z.q.dtype), jnp.concatenate([*rows, *of_constraints, *conditions])


def _split(form: tuple, z: Array):
    kind, shapes = form
    ends = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)])
    return kind(*(z[a:b].reshape(shape) for a, b, shape in zip(ends, ends[1:], shapes)))


def _function(plant: Plant, form: tuple):
    of = of_element if form[0] is Element else of_ends

    def function(z: Array):
        return of(plant, _split(form, z))

    return function


@compiled
def values_and_slopes(plant: Plant, form: tuple, z: Array):
    """The costs (B,) and equations (B, r) of the parts z (B, d), and the derivatives of both."""

    def twice(z: Array):
        found = _function(plant, form)(z)
        return found, found

    slopes, values = jax.vmap(jax.jacfwd(twice, has_aux=True))(z)
    return values, slopes


@compiled
def curvatures(plant: Plant, form: tuple, z: Array, share: Array, multipliers: Array):
    """The second derivatives of `share` times the costs plus the equations times `multipliers` (B, r)."""

    def lagrangian(z: Array, multipliers: Array):
        cost, rows = _function(plant, form)(z)
        return share * cost + jnp.dot(multipliers, rows)

    return jax.vmap(jax.hessian(lagrangian))(z, multipliers)
