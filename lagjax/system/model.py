"""A system prepared for states of one form: what is known of it before any value is, and its functions of vectors.

A front door makes a `Model` once (`check_functions.prepare`). Everything below takes the model and a state in vector
form, (t, x, u), and does not ask again for the user's structure, the shapes of constraints or their number.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.jaxtools import shape_of, without_init
from lagjax.system import coordinates
from lagjax.system.function_arguments import WITH_MULTIPLIERS, takes_of
from lagjax.system.system import System
from lagjax.system.traced_functions import Traced


class Residual(NamedTuple):
    """The form of a constraint's residual, by its name; `of_positions`: whether it is holonomic."""

    name: str
    shape: tuple[int, ...]
    of_positions: bool

    @property
    def size(self) -> int:
        """How many equations it is."""
        return math.prod(self.shape)


class FirstOrder(NamedTuple):
    """Coordinates whose velocities are determined, by their places: those of each state by name, and those without a
    mass."""

    states: tuple[tuple[str, tuple[int, ...]], ...]
    massless: tuple[int, ...]

    def mask(self, n: int) -> np.ndarray:
        """Which of n coordinates they are, (n,) booleans."""
        places = [*self.massless, *(i for _, places in self.states for i in places)]
        return np.isin(np.arange(n), places)


class Form(NamedTuple):
    """The form of a system's states: structure and shapes of q, the dtype, and the residuals of the constraints.

    `first_order`: the coordinates of first order, once `mechanics.first_order` has looked for them and found some.
    """

    structure: Any
    shapes: tuple[tuple[int, ...], ...]
    dtype: np.dtype
    residuals: tuple[Residual, ...]
    first_order: FirstOrder | None = None

    @property
    def sizes(self) -> np.ndarray:
        """How many coordinates each leaf of q has."""
        return np.array([np.prod(shape) for shape in self.shapes], int)

    @property
    def n(self) -> int:
        """The number of coordinates."""
        return int(self.sizes.sum())

    @property
    def m(self) -> int:
        """The number of constraint equations."""
        return sum(residual.size for residual in self.residuals)

    @property
    def example(self) -> tuple:
        """A state (t, q, v) of this form, to trace with."""
        leaves = [jax.ShapeDtypeStruct(shape, self.dtype) for shape in ((), *self.shapes)]
        q = jtu.tree_unflatten(self.structure, leaves[1:])
        return leaves[0], q, q

    def tree(self, x: Array):
        """A vector (..., n) in the structure of q."""
        if len(self.shapes) == 1:
            return jtu.tree_unflatten(self.structure, [x.reshape(x.shape[:-1] + self.shapes[0])])
        if isinstance(x, np.ndarray):
            parts = np.split(x, np.cumsum(self.sizes)[:-1], -1)
        else:
            # One operation, whose transpose is one: slices become paddings and sums.
            parts = lax.split(x, self.sizes.tolist(), x.ndim - 1)
        leaves = [part.reshape(x.shape[:-1] + shape) for part, shape in zip(parts, self.shapes)]
        return jtu.tree_unflatten(self.structure, leaves)


class InModes(NamedTuple):
    """The parameters of a system some of whose constraints hold only in some of its `modes`.

    - `modes` (k,): of each element's law, as in `integrate/elements/laws.py`.
    - `off` (m,): which of the stacked constraint equations do not hold now; their multipliers are zero.
    - `slack` (k,): how far the guard of each mode may be below zero by round-off, and by its sign more of some modes.
    """

    params: PyTree
    modes: Int[Array, " k"]
    off: Bool[Array, " m"]
    slack: Float[Array, " k"]


class Given(NamedTuple):
    """The parameters, and the outcomes of comparisons, `modes` (n,): what functions that are smooth in each take as
    `params`.

    `slides` (n,): along which of the jumps the motion slides. `free`: whether the comparisons decide themselves, as in
    the user's own functions.
    """

    params: PyTree
    modes: Float[Array, " n"]
    slides: Bool[Array, " n"]
    free: Bool[Array, ""]


def given_in(row: InModes | None, params: PyTree) -> PyTree:
    """What functions take as parameters in the modes of a row, which has None in their place; without modes, these."""
    return params if row is None else row._replace(params=params)


class Model(eqx.Module):
    """A system, or hybrid, with its parameters, for states of one form. n coordinates, m constraint equations."""

    system: Any
    params: PyTree
    form: Form = eqx.field(static=True)
    n: int = eqx.field(static=True)
    m: int = eqx.field(static=True)

    @property
    def names(self) -> list[str]:
        """The name of each coordinate, as the user would write it."""
        return coordinates.names(self.tree(np.zeros(self.n)))

    @property
    def equation_names(self) -> list[str]:
        """The name of each constraint equation, in the order in which they are stacked."""

        def places(residual: Any) -> list[str]:
            return [str(list(i)) if i else "" for i in np.ndindex(residual.shape)]

        return [residual.name + place for residual in self.form.residuals for place in places(residual)]

    @property
    def holonomic(self) -> np.ndarray:
        """Which of the stacked constraint equations restrict positions, (m,) booleans."""
        return np.array([residual.of_positions for residual in self.form.residuals for _ in range(residual.size)], bool)

    @property
    def off(self) -> Bool[Array, " m"] | None:
        """Which of the stacked constraint equations do not hold in the present mode; None where all always hold."""
        params = self.params.params if isinstance(self.params, Given) else self.params
        return params.off if isinstance(params, InModes) else None

    @property
    def phases(self) -> "tuple[Model, ...]":
        """The model of each phase; the model itself where the system is no hybrid."""
        if not self.system.in_phases:
            return (self,)
        return tuple(
            model_of(phase, *self.form.example, self.system.given(self.params, phase=i))
            for i, phase in enumerate(self.system.phases)
        )

    def tree(self, x: Array):
        """A vector (..., n) in the user's structure."""
        return self.form.tree(x)

    def vector(self, tree: PyTree) -> Float[Array, " n"]:
        """A position, velocity or force in the user's structure as a vector."""
        return coordinates.flatten(tree)[0]

    def vectors(self, q: PyTree, v: PyTree) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """A position and a velocity as vectors."""
        return coordinates.flatten(q)[0], coordinates.flatten(v)[0]

    def split(self, stacked: Float[Array, " m"]) -> dict[str, Array]:
        """One array for each constraint, by name, from a vector over all constraint equations."""
        parts, start = {}, 0
        for residual in self.form.residuals:
            parts[residual.name] = stacked[start : start + residual.size].reshape(residual.shape)
            start += residual.size
        return parts

    def stacked(self, multipliers: dict[str, Array]) -> Float[Array, " m"]:
        """A vector over all constraint equations, from one array for each constraint."""
        parts = [jnp.ravel(multipliers[residual.name]) for residual in self.form.residuals]
        return jnp.concatenate([jnp.zeros(0, self.form.dtype), *parts])

    def zero_multipliers(self) -> dict[str, np.ndarray]:
        """Zero multipliers of the right shapes, by name."""
        return {residual.name: np.zeros(residual.shape, self.form.dtype) for residual in self.form.residuals}

    def belongs_to(self, name: str) -> np.ndarray:
        """Which of the stacked constraint equations belong to a constraint, (m,) booleans."""
        return np.array([residual.name == name for residual in self.form.residuals for _ in range(residual.size)], bool)

    def lagrangian(self, t: Array, x: Array, u: Array) -> Float[Array, ""]:
        """L."""
        return self.system.lagrangian(t, self.tree(x), self.tree(u), self.params)

    def dissipation(self, t: Array, x: Array, u: Array) -> Float[Array, ""]:
        """Rayleigh's function R."""
        return self.system.dissipation(t, self.tree(x), self.tree(u), self.params)

    def force(self, t: Array, x: Array, u: Array, multipliers: Float[Array, " m"] | None = None) -> Float[Array, " n"]:
        """The generalized force Q that L does not contain; without `multipliers`, for those of zero."""
        return self.vector(self.force_at(t, self.tree(x), self.tree(u), multipliers)).astype(x.dtype)

    def force_at(self, t: Array, q: PyTree, v: PyTree, multipliers: Float[Array, " m"] | None = None):
        """The same in the user's structure."""
        force = self.system.force
        if takes_of(force) != WITH_MULTIPLIERS:
            return force(t, q, v, self.params)
        stacked = jnp.zeros(self.m, self.form.dtype) if multipliers is None else multipliers
        return force(t, q, v, self.split(stacked), self.params)

    def forward_dynamics(self, t: Array, x: Array, u: Array, force: Float[Array, " n"]) -> Float[Array, " n"]:
        """The accelerations of L under a force, by the function that the user gave for that."""
        a = self.system.forward_dynamics(t, self.tree(x), self.tree(u), self.tree(force), self.params)
        return self.vector(a).astype(x.dtype)

    @property
    def solves_itself(self) -> bool:
        """Whether the user's own forward dynamics solve the equations."""
        return getattr(self.system, "forward_dynamics", None) is not None

    @property
    def is_returned(self) -> bool:
        """Whether a step is followed by a return of the state, to constraints or to velocities that are determined."""
        return bool(self.m) or self.form.first_order is not None

    @property
    def reacts(self) -> bool:
        """Whether the force depends on multipliers."""
        force = self.system.force
        return force is not None and bool(self.m) and takes_of(force) == WITH_MULTIPLIERS

    def of(self, params: PyTree) -> "Model":
        """The same system with other parameters."""
        return unchecked(self.system, params, self.form)

    def alone(self, name: str) -> "Model":
        """The same with a single one of its constraints."""
        residuals = tuple(residual for residual in self.form.residuals if residual.name == name)
        system = replace(self.system, constraints={name: self.system.constraints[name]})
        return unchecked(system, self.params, self.form._replace(residuals=residuals))

    def mapped(self, change: Callable) -> "Model":
        """The same with `change(function, role)` in place of each of the user's functions (`System.map`)."""
        return unchecked(self.system.map(change), self.params, self.form)


def model_of(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> Model:
    """The model of a system for states like this one; nothing is checked, and no value is looked at."""
    leaves, structure = jtu.tree_flatten(q)
    residuals = () if system.in_phases else tuple(
        Residual(name, _shape_of(c, t, q, v, params), c.of_positions) for name, c in system.constraints.items()
    )  # fmt: skip
    form = Form(structure, tuple(np.shape(x) for x in leaves), np.dtype(jnp.result_type(t)), residuals)
    return unchecked(system, params, form)


def _shape_of(constraint, *state):
    # A traced function knows what it returns.
    known = constraint.function
    value = known.program.value if isinstance(known, Traced) else shape_of(constraint.residual, *state)
    return tuple(jnp.shape(value))


def unchecked(system: System, params: PyTree, form) -> Model:
    """A model of these parts: to make a module the usual way takes long."""
    return without_init(Model, {"system": system, "params": params, "form": form, "n": form.n, "m": form.m})
