"""A motion with controls as finitely many numbers: a nonlinear program on elements in time, and these elements.

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
from functools import cached_property, partial
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
    basis,
    defects,
    force_and_momentum,
    rule_of_degree,
    velocity_constraints,
)
from lagjax.two_points.mesh import Mesh, between, in_groups, places, rows_of

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


class Element(NamedTuple):
    """What one element sees: times, and rows of positions, controls, λ and μ."""

    end: Array
    parts: Array
    q: Array
    controls: Array
    node_multipliers: Array
    point_multipliers: Array

    def equations(self, plant: Plant) -> tuple[Array, Array]:
        """The cost of an element, and its part of the equations: virtual work, g, phi, and bounded velocities."""
        rule = plant.rule
        total = self.end[0] - plant.t_a
        t, h = plant.t_a + total * self.parts[0], total * (self.parts[1] - self.parts[0])
        states = at_points(rule, t, h, self.q)
        u = basis(plant.control_nodes, rule.points) @ self.controls

        def at_point(t: Array, x: Array, v: Array, u: Array, multipliers: Array):
            model = plant.model(u)
            force, p = force_and_momentum(model, t, x, v, multipliers)
            cost = 0.0
            if plant.cost is not None:
                cost = plant.cost(t, model.tree(x), model.tree(v), plant.control(u), plant.params)
            return force, p, velocity_constraints(model, t, x, v), jnp.asarray(cost, x.dtype)

        force, p, phi, cost = jax.vmap(at_point)(*states, u, self.point_multipliers)
        # Constraints are to hold whatever the controls are: these are taken where the element begins.
        nodes = jnp.concatenate([self.q, self.node_multipliers], axis=1)
        missed = defects(plant.model(u[0]), rule, t, h, nodes, force, p)
        rows = missed.work, missed.g[1:], phi, states.u[:, list(plant.bounded)]
        return h * jnp.sum(rule.weights * cost), jnp.concatenate([jnp.ravel(x) for x in rows])


class PlanEnds(NamedTuple):
    """What the conditions at both ends see; the controls are those of the first and of the last element.

    `impulse`: along the velocity constraints, at the end.
    """

    end: Array
    q: Array
    v: Array
    controls: Array
    impulse: Array

    def equations(self, plant: Plant) -> tuple[Array, Array]:
        """The cost of the end, and the equations there: momenta, constraints at both ends, conditions."""
        ts, at = (plant.t_a, self.end[0]), basis(plant.control_nodes, np.array([0.0, 1.0]))
        rows, of_constraints = [], []
        for i, sign in ((0, 1.0), (1, -1.0)):
            model = plant.model(at[i] @ self.controls[i])

            def g(t: Array, x: Array, model: Model = model):
                return constraints.position_residual(model, t, x)

            p = jax.grad(model.lagrangian, argnums=2)(ts[i], self.q[i], self.v[i])
            phi, back = jax.vjp(lambda v: velocity_constraints(model, ts[i], self.q[i], v), self.v[i])
            # Velocity constraints hold at points inside, and what the last step misses them by is returned at the end.
            rows.append(sign * p + (back(self.impulse)[0] if i else 0.0))
            value, rate = jax.jvp(g, (ts[i], self.q[i]), (jnp.ones_like(ts[i]), self.v[i]))
            of_constraints += [rate, phi] if i else [value, rate, phi]
        last = ts[1], plant.form.tree(self.q[1]), plant.form.tree(self.v[1]), plant.params
        conditions = [] if plant.end is None else [coordinates.flatten(plant.end(*last))[0]]
        cost = 0.0 if plant.end_cost is None else plant.end_cost(*last)
        return jnp.asarray(cost, self.q.dtype), jnp.concatenate([*rows, *of_constraints, *conditions])


def _split(form: tuple, z: Array):
    kind, shapes = form
    ends = np.cumsum([0, *(int(np.prod(shape)) for shape in shapes)])
    return kind(*(z[a:b].reshape(shape) for a, b, shape in zip(ends, ends[1:], shapes)))


@compiled
def values_and_slopes(plant: Plant, form: tuple, z: Array):
    """The costs (B,) and equations (B, r) of the parts z (B, d), and the derivatives of both."""

    def twice(z: Array):
        found = _split(form, z).equations(plant)
        return found, found

    slopes, values = jax.vmap(jax.jacfwd(twice, has_aux=True))(z)
    return values, slopes


@compiled
def curvatures(plant: Plant, form: tuple, share: Array, z: Array, multipliers: Array):
    """The second derivatives of `share` times the costs plus the equations times `multipliers` (B, r)."""

    def lagrangian(z: Array, multipliers: Array):
        cost, rows = _split(form, z).equations(plant)
        return share * cost + jnp.dot(multipliers, rows)

    return jax.vmap(jax.hessian(lagrangian))(z, multipliers)


# Elements that are differentiated together: a program serves any number of elements.
TOGETHER = 16


class Block(NamedTuple):
    """Parts of one kind: which unknowns (B, d) each sees, and to which equations (B, r) it adds."""

    plant: Plant
    form: tuple
    columns: np.ndarray
    rows: np.ndarray

    def values_and_slopes(self, x: np.ndarray):
        """Costs (B,) and rows (B, r), and their derivatives by what each part sees, (B, d) and (B, r, d)."""
        return self._found(partial(values_and_slopes, self.plant, self.form), x[self.columns])

    def curvatures(self, x: np.ndarray, share: float, multipliers: np.ndarray):
        """The second derivatives (B, d, d) of `share` times the cost plus the rows times `multipliers`."""
        function = partial(curvatures, self.plant, self.form, np.asarray(share))
        return self._found(function, x[self.columns], multipliers[self.rows])

    def _found(self, function: Callable, *arguments):
        return in_groups(function, TOGETHER if len(self.columns) > 1 else 1, *arguments)


class Layout:
    """The unknowns and equations of a plant on K elements.

    `places`: by kind, where unknowns stand in the vector of all, in the shapes of these; `rows`: the same of equations.
    """

    def __init__(self, plant: Plant, count: int):
        self.plant, self.count = plant, count
        n, s, k = plant.form.n, plant.degree, count
        controls = self.of_controls[-1, -1] + 1
        self.size, self.places = _numbered({
            "end": (1,), "parts": (k + 1,), "q": (s * k + 1, n), "v": (2, n), "controls": (controls, plant.n_controls),
            "node_multipliers": (s * k + 1, plant.of_positions), "point_multipliers": (s * k, plant.of_velocities),
            "impulse": (plant.of_velocities,),
        })  # fmt: skip
        g, phi = plant.of_positions, plant.of_velocities
        self.row_count, self.rows = _numbered({
            "motion": (s * k + 1, n), "positions": (k, s, g), "velocities": (k, s, phi),
            "bounded": (k, s, len(plant.bounded)), "start": (2 * g + phi,), "stop": (g + phi,),
            "end": (plant.conditions,),
        })  # fmt: skip

    @cached_property
    def of_nodes(self) -> np.ndarray:
        """Which nodes each element has, (K, s + 1)."""
        return rows_of(self.count, self.plant.rule.nodes)

    @cached_property
    def of_points(self) -> np.ndarray:
        """Which points each element has, (K, s)."""
        return rows_of(self.count, self.plant.rule.points)

    @cached_property
    def of_controls(self) -> np.ndarray:
        """Which rows of controls each element has, (K, r)."""
        return rows_of(self.count, self.plant.control_nodes)

    def blocks(self) -> tuple[Block, Block]:
        """The elements and the ends."""
        at, rows, k = self.places, self.rows, self.count
        elements = Element(
            np.repeat(at["end"][None], k, axis=0),
            np.stack([at["parts"][:-1], at["parts"][1:]], axis=1),
            at["q"][self.of_nodes],
            at["controls"][self.of_controls],
            at["node_multipliers"][self.of_nodes],
            at["point_multipliers"][self.of_points],
        )
        ends = PlanEnds(at["end"], at["q"][[0, -1]], at["v"], at["controls"][self.of_controls[[0, -1]]], at["impulse"])
        ends = PlanEnds(*(x[None] for x in ends))
        of_elements = rows["motion"][self.of_nodes], rows["positions"], rows["velocities"], rows["bounded"]
        of_ends = rows["motion"][[0, -1]], rows["start"], rows["stop"], rows["end"]
        return (
            Block(self.plant, _form(elements), _flat(elements, k), _flat(of_elements, k)),
            Block(self.plant, _form(ends), _flat(ends, 1), _flat(of_ends, 1)),
        )


def _numbered(shapes: dict[str, tuple[int, ...]]):
    found, start = {}, 0
    for name, shape in shapes.items():
        size = int(np.prod(shape))
        found[name] = np.arange(start, start + size).reshape(shape)
        start += size
    return start, found


def _form(seen: Element | PlanEnds):
    return type(seen), tuple(x.shape[1:] for x in seen)


def _flat(parts: tuple, count: int):
    return np.concatenate([x.reshape(count, -1) for x in parts], axis=1)


def moved(layout: Layout, x: np.ndarray, mesh: Mesh) -> tuple[Layout, np.ndarray]:
    """The same motion on other elements: the new layout and its unknowns."""
    plant, old, parts = layout.plant, layout.places, x[layout.places["parts"]]
    new = Layout(plant, mesh.count)
    at, y, rule = new.places, np.zeros(new.size), plant.rule
    y[at["parts"]] = mesh.parts
    for name in ("end", "v", "impulse"):
        y[at[name]] = x[old[name]]
    for name, nodes in (
        ("q", rule.nodes), ("node_multipliers", rule.nodes), ("point_multipliers", rule.points),
        ("controls", plant.control_nodes),
    ):  # fmt: skip
        rows = x[old[name]][rows_of(layout.count, nodes)]
        y[at[name]] = between(parts, nodes, rows, places(mesh.parts, nodes))
    return new, y
