"""A system prepared for states of one form, and how it is told whether two systems are the same.

A front door makes a `Model` once (`check_functions.prepare`). Everything below takes the model and a state in vector
form, (t, x, u), and does not ask again for the user's structure, the shapes of constraints or their number.

Whether a system is the one of a motion is told by what its functions return at one state of the motion. A signature
holds the values and slopes of L, of R and of each constraint, and the force, each in one row. Two systems whose
signatures agree at a state in the middle of a motion count as the same.
"""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.jaxtools import compiled, shape_of, without_init
from lagjax.system import coordinates
from lagjax.system.coordinates import State
from lagjax.system.system import Hybrid, System, rate_of
from lagjax.system.traced import WITH_MULTIPLIERS, Traced, takes_of


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

    - `modes` (k,): of each element's law, as in `integrate/laws.py`.
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


# Values that differ by more than this, relative to the largest of their row, come from another function. Round-off is
# below it also where large terms cancel, in float32 too, unless only the last digits remain.
SAME = {np.dtype("float64"): 1e-7, np.dtype("float32"): 1e-3}

# The attributes that other code reads from a system.
SYSTEM_FIELDS = {field.name for of in (System, Hybrid) for field in fields(of)} - {"first"}


class UnknownSystem(eqx.Module):
    """A placeholder for a system that was not given: what a file knows about it.

    - `words`: its printed form; `angles` (n,): which coordinates are angles.
    - `signature`: what its functions returned at `state`, by role. `starts`: where the motions of a fit start, and
    `phase`: the number of the phase in which they start.
    """

    words: str = eqx.field(static=True)
    angles: tuple[bool, ...] = eqx.field(static=True)
    signature: dict[str, Array]
    state: PyTree
    starts: PyTree = None
    phase: int | None = eqx.field(static=True, default=None)

    def __repr__(self):
        return f"{self.words.splitlines()[0]}, not given"

    def __getattr__(self, name: str):
        if name in SYSTEM_FIELDS:
            _raise_unknown(self)
        raise AttributeError(name)


def signature(system: System | Hybrid, state: State) -> dict[str, np.ndarray]:
    """What each function of a system returns at a state, by role."""
    if isinstance(system, System):
        return _signature(system, state)
    found = {}
    for i, (name, phase) in enumerate(zip(system.names, system.systems)):
        for case, params in system.cases(state.params, i).items():
            of_phase = _signature(phase, state._replace(params=params))
            found |= {f"{role} of phase '{name}'{case}": x for role, x in of_phase.items()}
    names = [f"{i}: {switch.phase} -> {switch.to}, {switch.rest}" for i, switch in enumerate(system.switches)]
    return found | {f"switch {name}": np.zeros(0) for name in names} | system.laws_in_numbers(state)


def differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """The differences between two signatures, in words."""
    found = [f"{role} is missing" for role in there if role not in here]
    found += [f"{role} is there, but was not before" for role in here if role not in there]
    for role in there:
        if role not in here:
            continue
        a, b = (np.asarray(x[role]) for x in (there, here))
        size = np.max(
            np.abs(np.nan_to_num(np.concatenate([a.ravel(), b.ravel()]), posinf=0.0, neginf=0.0)), initial=0.0
        )
        tolerance = SAME.get(a.dtype, 1e-2) * size
        if a.shape != b.shape:
            found.append(f"{role} has {len(b)} values and slopes, but had {len(a)}")
        elif not np.allclose(a, b, rtol=0.0, atol=tolerance, equal_nan=True):
            what = (
                "value" if a.size and not np.isclose(a[0], b[0], rtol=0.0, atol=tolerance, equal_nan=True) else "slope"
            )
            i = 0 if what == "value" else int(np.argmax(np.nan_to_num(np.abs(a - b), nan=np.inf)))
            found.append(f"{role}: its {what} was {a[i]:.9g}, and is {b[i]:.9g}")
    return found


@partial(compiled, in_numpy=True)
def _signature(system: System, s: State):
    found = {}

    def flat(*trees) -> Array:
        return jnp.concatenate([jnp.ravel(jnp.asarray(x, s.t.dtype)) for x in jax.tree.leaves(trees)])

    def values_and_slopes(function: Callable, *args, slopes):
        return flat(function(*args), jax.jacfwd(function, argnums=slopes)(*args))

    found["the Lagrangian"] = values_and_slopes(system.lagrangian, *s, slopes=(1, 2))
    if system.dissipation is not None:
        found["the dissipation"] = values_and_slopes(system.dissipation, *s, slopes=(2,))
    for name, c in system.constraints.items():
        words, slopes = ("", (1,)) if c.of_positions else (", of velocities,", (1, 2))
        found[f"the constraint '{name}'{words}"] = values_and_slopes(c.residual, *s, slopes=slopes)
    for name, f in system.states.items():
        found[f"the {rate_of(name)}"] = values_and_slopes(f, *s, slopes=(1, 2))
    if system.force is not None:
        ones = jax.tree.map(np.ones_like, model_of(system, *s).zero_multipliers())
        given = s._asdict() | {"multipliers": ones}
        found["the force"] = flat(system.force(*(given[name] for name in takes_of(system.force))))
    return found


def middle_state(t: Array, q: PyTree, v: PyTree, params: PyTree) -> State:
    """A state in the middle of a motion, among the finite ones; for a batch, of the first lane."""
    first = (0,) * (np.ndim(t) - 1)

    def one(x: Any) -> np.ndarray:
        return np.asarray(x)[first]

    t, q, v = jax.tree.map(one, (t, q, v))
    params = jax.tree.map(lambda x: one(x) if first and isinstance(x, (jax.Array, np.ndarray)) else x, params)
    known = np.all([np.isfinite(x.reshape(len(t), -1)).all(axis=1) for x in jax.tree.leaves((q, v))], axis=0)
    i = int(known.sum()) // 2
    return State(*jax.tree.map(lambda x: x[i], (t, q, v)), params)


def known_system(system: Any) -> Any:
    """Return the system, or raise if it is not known."""
    if isinstance(system, UnknownSystem):
        _raise_unknown(system)
    return system


def _raise_unknown(system) -> NoReturn:
    raise ValueError(
        f"this needs the functions of the system ({system.words.splitlines()[0]}), which a file does not contain.\n"
        "Fix: lj.load_trajectory(path, system=system), or load_fit or open_sweep, with the system that was integrated."
    )
