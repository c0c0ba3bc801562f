"""One-parameter groups of motions of a system, their generators, and what each of them conserves.

A generator moves the coordinates by ε ξ(t, q) and the time by ε τ(t, q). It is a symmetry of L where the action changes
only by terms at its ends: by ε times the total derivative of a function F(t, q), the gauge term,

    τ ∂L/∂t + ξ·∂L/∂q + (dξ/dt - v dτ/dt)·p + L dτ/dt - dF/dt = 0,        p = ∂L/∂v

with d/dt = ∂/∂t + v·∂/∂q. Call the left side ρ. With all forces f = Q - ∂R/∂v + Aᵀ λ that L does not contain, the
equations of motion `dp/dt = ∂L/∂q + f` give

    C = p·ξ - τ (v·p - L) - F,        dC/dt = ρ + f·(ξ - τ v)

at every state, symmetry or not. So C is constant where ρ = 0 and no force acts along ξ - τ v; a constraint's own force
λ·A (ξ - τ v) vanishes for all λ where the displacement is one that the constraint allows.

Source: Noether, Nachr. Ges. Wiss. Göttingen (1918) 235, §2; Goldstein, *Classical Mechanics*, §13.7;
Neĭmark & Fufaev, *Dynamics of Nonholonomic Systems*, §III.6 (velocity constraints).

Translations, rotations and boosts move all points among the coordinates: those that are Cartesian coordinates of points
by their names and shapes.

A point is a group of scalars whose names differ only by x, y, z (`x, y`; `x1, z1`; `bead_x, bead_y, bead_z`), or an
array of shape (2,) or (3,), or one row of an array (n, 2) or (n, 3). The guess only decides which motions of space are
tried: coordinates that are not positions simply have no such symmetry.
"""

import numbers
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.jaxtools import compiled, is_traced, shape_of
from lagjax.mechanics.constrained_state import accelerations_at
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.lagrangian import applied_force
from lagjax.refusals import must, must_be_function, must_name, must_return
from lagjax.system import (
    OF_POSITION,
    Call,
    Model,
    State,
    System,
    check_arguments,
    check_system,
    constraints,
    coordinates,
    in_words,
    model_of,
    traced_system,
)

AXES = "xyz"
NAMES = re.compile(r"(?P<before>(?:.*\.)?(?:\w+_)?)(?P<axis>[xyzXYZ])(?P<after>\d*|_\w+)")


class CartesianPoint(NamedTuple):
    """A point: its label ("" for the only one), and the places of its coordinates along x, y, z (None: it has none)."""

    label: str
    places: tuple[int | None, int | None, int | None]


def points(q: PyTree) -> list[CartesianPoint]:
    """The points among the coordinates.

    >>> points({"x": 0.0, "y": 0.0, "angle": 0.0})
    [CartesianPoint(label='', places=(1, 2, None))]
    >>> [point.label for point in points({"r": np.zeros((2, 3))})]
    ['r[0]', 'r[1]']
    """
    found, axes_by_point, start = [], {}, 0
    for (path, leaf), name in zip(jtu.tree_flatten_with_path(q)[0], leaf_names(q)):
        shape = np.shape(leaf)
        size = int(np.prod(shape))
        last = shape[len(shape) - 1] if shape else 0
        if last in (2, 3) and len(shape) <= 2:
            for i in range(size // last):
                label = name if len(shape) == 1 else f"{name}[{i}]"
                where = [start + i * last + k for k in range(last)]
                found.append(CartesianPoint(label, (where[0], where[1], where[2] if len(where) > 2 else None)))
        elif path and not shape and (match := NAMES.fullmatch(name)):
            key = match["before"], match["after"], match["axis"].isupper()
            axes_by_point.setdefault(key, {})[match["axis"].lower()] = start, name
        start += size
    for axes in axes_by_point.values():
        if len(axes) > 1:
            where = tuple(axes[axis][0] if axis in axes else None for axis in AXES)
            found.append(CartesianPoint(", ".join(name for _, name in axes.values()), where))
    return [found[0]._replace(label="")] if len(found) == 1 else found


def leaf_names(q: PyTree) -> list[str]:
    """The name of each leaf of q, as the user would write it."""
    paths = [path for path, _ in jtu.tree_flatten_with_path(q)[0]]
    # A scalar in place of each leaf: the names of the coordinates then have no indices.
    return coordinates.names(jtu.tree_unflatten(jtu.tree_structure(q), [0.0] * len(paths)))


def turned(point: CartesianPoint, axis: str) -> tuple[int, int] | None:
    """The two places that a rotation about an axis mixes, the first turning to the second; None if one is missing."""
    k = AXES.index(axis)
    first, second = point.places[(k + 1) % 3], point.places[(k + 2) % 3]
    return None if first is None or second is None else (first, second)


class Generator(eqx.Module):
    """Generate a one-parameter group: the coordinates move by ε ξ, the time by ε τ, and L changes by ε dF/dt.

    >>> import lagjax as lj
    >>> turn = lj.Generator(lambda t, q, params: {"x": -q["y"], "y": q["x"]}, name="L_z")
    >>> lj.Generator.rotation("z") + 0.5 * lj.Generator.translation("z")
    Generator(L_z + 0.5 p_z)

    **Arguments:**

    - `delta`: `ξ(t, q, params)` -> like q, `[q]/[ε]`. None if the coordinates do not move.
    - `time`: `τ(t, q, params)` -> scalar, or a number, `[t]/[ε]`.
    - `gauge`: `F(t, q, params)` -> scalar, `[L] [t]/[ε]`; L changes by dF/dt, as under a boost.
    - `name`: the name of its charge.

    Ready-made ones are `Generator.shift`, `translation`, `rotation`, `screw`, `boost` and `time_translation`; they can
    be added, and multiplied by numbers.

    **Raises:** `TypeError` for an argument that is not a function.

    Source: Goldstein, *Classical Mechanics*, §13.7.
    """

    delta: Callable | None
    time: Callable | None
    gauge: Callable | None
    name: str = eqx.field(static=True)

    def __init__(self, delta=None, time=None, gauge=None, name: str | None = None):
        for role, function in (("delta", delta), ("time", time), ("gauge", gauge)):
            if role == "time" and isinstance(function, numbers.Real):
                continue
            fix = f"{role}=lambda t, q, params: {'q' if role == 'delta' else 't'}"
            must_be_function(function, f"{role} of a generator", "(t, q, params)", fix, optional=True)
        if delta is None and time is None and gauge is None:
            raise TypeError(
                "a generator must move something.\n"
                'Fix: lj.Generator(lambda t, q, params: {"x": 1.0, "y": 0.0}), or lj.Generator(time=1.0).'
            )
        self.delta = delta
        self.time = _Constant(np.asarray(float(time))) if isinstance(time, numbers.Real) else time
        self.gauge = gauge
        self.name = name or getattr(delta, "__name__", None) or "charge"

    def at(self, t: Array, q: PyTree, params: PyTree):
        """ξ (like q), τ and F at one time and position, in the dtype of the coordinates."""

        def like(x: Array, y: Any) -> Array:
            return jnp.broadcast_to(jnp.asarray(y, x.dtype), x.shape)

        xi = jtu.tree_map(jnp.zeros_like, q) if self.delta is None else jtu.tree_map(like, q, self.delta(t, q, params))

        def number(f: Callable | None) -> Array:
            return jnp.zeros_like(t) if f is None else like(t, f(t, q, params))

        return xi, number(self.time), number(self.gauge)

    def check(self, s: coordinates.State):
        """Raise if this generator does not fit such coordinates."""
        given = {"t": s.t, "q": s.q, "params": s.params}
        for role, function in (("delta", self.delta), ("time", self.time), ("gauge", self.gauge)):
            if function is None:
                continue
            call = Call(role, function, OF_POSITION, f" of the generator '{self.name}'")
            check_arguments(call, "a function that takes the velocities too; a generator moves positions")
            with in_words(call, given):
                value = shape_of(function, s.t, s.q, s.params)
            if role == "delta":
                _check_displacement(call, value, s.q)
            else:
                cause = "a missing sum over coordinates"
                must_return(np.shape(value) == (), call, "one number", value, "jnp.sum(...)", cause)

    @staticmethod
    def shift(by) -> "Generator":
        """Shift coordinates by name, `"x"` or `{"x": 1.0, "X": 1.0}`: the charge is their momentum."""
        by = {by: 1.0} if isinstance(by, str) else dict(by)
        return Generator(_Shift(tuple(by), _array(by.values())), name=added((c, f"p_{n}") for n, c in by.items()))

    @staticmethod
    def translation(axis) -> "Generator":
        """Move all points along an axis, `"x"`, `"y"`, `"z"` or a vector: the charge is a momentum."""
        return Generator(_Translation(_vector(axis)), name=_charge_name("p", axis))

    @staticmethod
    def rotation(axis, about=(0.0, 0.0, 0.0)) -> "Generator":
        """Turn all points about an axis through a point, counterclockwise: the charge is an angular momentum."""
        return Generator(_Rotation(_vector(axis), _array((*about, 0.0, 0.0)[:3])), name=_charge_name("L", axis))

    @staticmethod
    def screw(axis, pitch: float) -> "Generator":
        """Move all points along a right-handed screw, by `pitch` per turn: the charge is pitch p + 2π L."""
        moved = pitch * Generator.translation(axis) + 2 * np.pi * Generator.rotation(axis)
        name = added([(pitch, _charge_name("p", axis))]) + f" + 2π {_charge_name('L', axis)}"
        return Generator(moved.delta, name=name)

    @staticmethod
    def boost(axis, gauge: Callable) -> "Generator":
        """Let all points drift along an axis, by ε t; `gauge(t, q, params)` is Σ m x. The charge is t p - Σ m x."""
        name = f"t {_charge_name('p', axis)} - m {axis}"
        return Generator(_Boost(_Translation(_vector(axis))), gauge=gauge, name=name)

    @staticmethod
    def time_translation() -> "Generator":
        """Set the clock back, τ = -1: the charge is the Jacobi integral v·p - L."""
        return Generator(time=-1.0, name="Jacobi integral")

    def __add__(self, other):
        other = as_generator(other)
        return _combined((1.0, self), (1.0, other), f"{self.name} + {other.name}")

    def __sub__(self, other):
        other = as_generator(other)
        return _combined((1.0, self), (-1.0, other), f"{self.name} - {other.name}")

    def __mul__(self, factor):
        return _combined((factor, self), None, added([(factor, self.name)]) if np.ndim(factor) == 0 else self.name)

    __rmul__ = __mul__

    def __neg__(self):
        return -1.0 * self

    def __repr__(self):
        return f"Generator({self.name})"


def as_generator(given) -> Generator:
    """Return a generator as it is, and make one of a function that moves the coordinates."""
    if isinstance(given, Generator):
        return given
    fix = 'lambda t, q, params: {"x": 1.0, "y": 0.0}, or lj.Generator.shift("x")'
    must_be_function(given, "a generator", "(t, q, params), or a lj.Generator", fix)
    return Generator(given)


def added(terms: Sequence, digits: str = ".6g") -> str:
    """Write a sum of (coefficient, name) terms as text."""
    words = ""
    for coefficient, name in terms:
        if not is_traced(coefficient) and np.ndim(coefficient) == 0:
            size = f"{abs(float(coefficient)):{digits}}"
            sign = "-" if coefficient < 0 else "+"
        else:
            size, sign = "c", "+"
        words += (f" {sign} " if words else "-" * (sign == "-")) + ("" if size == "1" else f"{size} ") + name
    return words


class _Constant(eqx.Module):
    value: np.ndarray

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        return self.value


class _Shift(eqx.Module):
    names: tuple[str, ...] = eqx.field(static=True)
    amounts: np.ndarray

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        x, unflatten = coordinates.flatten(q)
        moved = jnp.zeros_like(x)
        for name, amount in zip(self.names, self.amounts):
            moved = moved.at[np.asarray(places_of(name, q))].add(amount)
        return unflatten(moved)


class _Translation(eqx.Module):
    direction: np.ndarray

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        x, unflatten = coordinates.flatten(q)
        moved = jnp.zeros_like(x)
        for point in _points(q):
            for place, amount in zip(point.places, self.direction):
                moved = moved if place is None else moved.at[place].add(amount)
        return unflatten(moved)


class _Rotation(eqx.Module):
    axis: np.ndarray
    about: np.ndarray

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        x, unflatten = coordinates.flatten(q)
        moved = jnp.zeros_like(x)
        for point in _points(q):
            at = jnp.stack([jnp.zeros_like(x[0]) if place is None else x[place] for place in point.places])
            turned = jnp.cross(jnp.asarray(self.axis, x.dtype), at - jnp.asarray(self.about, x.dtype))
            for place, amount in zip(point.places, turned):
                moved = moved if place is None else moved.at[place].add(amount)
        return unflatten(moved)


class _Boost(eqx.Module):
    translation: Callable

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        return jtu.tree_map(lambda x: t * x, self.translation(t, q, params))


class _Sum(eqx.Module):
    """A linear combination of functions of (t, q, params); `place` selects ξ, τ or F of each generator."""

    generators: tuple[Generator, ...]
    weights: tuple
    place: int = eqx.field(static=True)

    def __call__(self, t: Array, q: PyTree, params: PyTree):
        found = [generator.at(t, q, params)[self.place] for generator in self.generators]
        return jtu.tree_map(lambda *x: sum(w * y for w, y in zip(self.weights, x)), *found)


def _combined(first, second, name: str):
    weights, generators = zip(*(pair for pair in (first, second) if pair is not None))
    weights = tuple(float(w) if isinstance(w, numbers.Real) else w for w in weights)
    moved = []
    for place, role in enumerate(("delta", "time", "gauge")):
        occurs = any(getattr(generator, role) is not None for generator in generators)
        moved.append(_Sum(generators, weights, place) if occurs else None)
    return Generator(*moved, name=name)


def places_of(name: str, q: PyTree) -> list[int]:
    """The places of the named coordinate in the vector of all; a leaf's name stands for all its entries."""
    known = coordinates.names(q)
    found = [i for i, other in enumerate(known) if other == name]
    if not found and name in leaf_names(q):
        found = [i for i, other in enumerate(known) if other.startswith(f"{name}[")]
    if not found:
        must_name([name], known, "a generator names", "coordinate")
    return found


def _points(q: PyTree):
    found = points(q)
    if not found:
        raise ValueError(
            f"there are no points to move in space among the coordinates {listed(coordinates.names(q))}.\n"
            "Usual cause: angles or lengths, whose symmetries are shifts.\n"
            f'Fix: lj.Generator.shift("{coordinates.names(q)[0]}"), or a function delta(t, q, params) of your own.'
        )
    return found


def _vector(axis) -> np.ndarray:
    if isinstance(axis, str):
        must(axis in AXES, "an axis must be 'x', 'y', 'z' or a vector", axis, '"z", or (0.0, 0.0, 1.0)')
        return np.eye(3)[AXES.index(axis)]
    must(np.shape(axis) in ((2,), (3,)), "an axis must be 'x', 'y', 'z' or a vector", axis, '"z", or (0.0, 0.0, 1.0)')
    return _array((*axis, 0.0)[:3])


def _charge_name(letter: str, axis):
    return f"{letter}_{axis}" if isinstance(axis, str) else f"{letter}·({', '.join(f'{x:g}' for x in axis)})"


def _array(values: Sequence | Mapping):
    return np.asarray([float(x) for x in values])


def _check_displacement(call: Call, value, q: PyTree):
    names = leaf_names(q)
    structure, expected = jtu.tree_structure(value), jtu.tree_structure(q)
    if structure != expected:
        returned = _names_in(value)
        missing = [name for name in names if name not in returned] if returned is not None else []
        unknown = [name for name in returned if name not in names] if returned is not None else []
        difference = "; ".join(
            f"{word} {listed(some)}" for word, some in (("it lacks", missing), ("q has no", unknown)) if some
        )
        difference = difference or f"it is {_kind(value)} where q has {listed(names)}"
        raise ValueError(
            f"{call} must return one velocity per coordinate, like q: {difference}.\n"
            "Usual cause: a coordinate left out because it does not move.\n"
            f"Fix: return the structure of q, with 0.0 for {missing[0] if missing else 'what does not move'}."
        )
    for name, x, y in zip(names, jtu.tree_leaves(q), jtu.tree_leaves(value)):
        if np.shape(y) not in ((), np.shape(x)):
            raise ValueError(
                f"{call} moves '{name}', of shape {np.shape(x)}, by something of shape {np.shape(y)}.\n"
                "Usual cause: a coordinate moved by all of q.\nFix: give each coordinate a velocity of its own shape."
            )


def _names_in(value):
    return leaf_names(value) if isinstance(value, Mapping) or hasattr(value, "_fields") else None


def _kind(value):
    shape = getattr(value, "shape", None)
    return f"an array of shape {shape}" if shape is not None else f"a {type(value).__name__}"


class NoetherCharge(eqx.Module):
    """The charge of a generator: a function of (t, q, v, params), `[L] [t]`; `noether_charge` makes it.

    `rate(t, q, v, params)`: its rate of change along a motion, zero where it is conserved and correct where it is not.
    """

    system: System
    generator: Generator

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        """The charge at one state."""
        return _charge(*self._checked(t, q, v, params))

    def rate(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        """How fast the charge changes at one state, `[L]`: ρ + f·(ξ - τ v)."""
        generator, model, s = self._checked(t, q, v, params)
        return _rate(generator, model, s, accelerations_at(model, s)[1] if model.m else {})

    def size(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        """The size of the terms that the charge is a sum of, to compare a change of it with."""
        return _size(*self._checked(t, q, v, params))

    def _checked(self, *state):
        s = coordinates.state(*state)
        self.generator.check(s)
        return self.generator, model_of(traced_system(self.system, s), *s), s

    def __repr__(self):
        return f"NoetherCharge({self.generator.name} of {self.system})"


def noether_charge(system: System, generator) -> NoetherCharge:
    """Return the charge `C = p·ξ - τ (v·p - L) - F` that a one-parameter group conserves where it is a symmetry.

    >>> import lagjax as lj
    >>> def kepler(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) + params["k"] / (q["x"] ** 2 + q["y"] ** 2) ** 0.5
    >>> turn = lambda t, q, params: {"x": -q["y"], "y": q["x"]}
    >>> L_z = noether_charge(lj.System(kepler), turn)
    >>> print(L_z(0.0, {"x": 3.0, "y": 0.0}, {"x": 1.0, "y": 2.0}, {"k": 1.0}))
    6.0

    A translation gives the momentum p, a rotation the angular momentum; `lj.Generator.time_translation()`, which sets
    the clock back (τ = -1), the Jacobi integral v·p - L, and a `time` of +1 minus that.

    **Arguments:**

    - `system`: as for `integrate`.
    - `generator`: a `lj.Generator`, or the function `delta(t, q, params)` -> like q, the velocity ξ with which the
      group moves the coordinates, `[q]/[ε]`.

    **Returns:** a function of (t, q, v, params) -> scalar, `[L] [t]/[ε]`, for `jit`, `vmap` and derivatives; its
    `rate` of the same arguments is dC/dt along a motion, also where that is not zero.

    **Raises:** `TypeError` for a generator that is not a function; `ValueError`, when it is called, for one whose
    displacement does not have the structure of q, with the coordinate by name.

    Source: Goldstein, §13.7; the gauge term as in Derivation 8 of its chapter 1.
    """
    check_system(system, generator, states=False)
    return NoetherCharge(system, as_generator(generator))


class GeneratorFlow(NamedTuple):
    """A generator at one state: ξ, τ and F, and their total derivatives along the motion; ξ in vector form."""

    xi: Float[Array, " n"]
    tau: Float[Array, ""]
    gauge: Float[Array, ""]
    xi_rate: Float[Array, " n"]
    tau_rate: Float[Array, ""]
    gauge_rate: Float[Array, ""]


def flow(generator: Generator, t: Array, q: PyTree, v: PyTree, params: PyTree) -> GeneratorFlow:
    """A generator and its total derivatives at one state."""
    (xi, tau, gauge), (xi_rate, tau_rate, gauge_rate) = jax.jvp(
        lambda t, q: generator.at(t, q, params), (t, q), (jnp.ones_like(t), v)
    )

    def vector(y: PyTree) -> Array:
        return coordinates.flatten(y)[0]

    return GeneratorFlow(vector(xi), tau, gauge, vector(xi_rate), tau_rate, gauge_rate)


def _terms(generator, model: Model, s: State):
    x, u = model.vectors(s.q, s.v)
    value, p = jax.value_and_grad(model.lagrangian, argnums=2)(s.t, x, u)
    xi, tau, gauge = generator.at(s.t, s.q, s.params)
    return p * model.vector(xi), tau * p * u, tau * value, gauge


@compiled
def _charge(generator, model: Model, s: State):
    moved, power, value, gauge = _terms(generator, model, s)
    return jnp.sum(moved - power) + value - gauge


@compiled
def _size(generator, model: Model, s: State):
    return sum(jnp.sum(jnp.abs(term)) for term in _terms(generator, model, s))


@compiled
def _rate(generator, model: Model, s: State, multipliers: Array):
    x, u = model.vectors(s.q, s.v)
    moved = flow(generator, *s)
    change = (moved.tau, moved.xi, moved.xi_rate - u * moved.tau_rate)
    value, rate = jax.jvp(model.lagrangian, (s.t, x, u), change)
    rate = rate + value * moved.tau_rate - moved.gauge_rate
    stacked = model.stacked(multipliers)
    force = applied_force(model, s.t, x, u, stacked)
    if model.m:
        force = force + stacked @ constraints.jacobian(model, s.t, x, u)
    return rate + force @ (moved.xi - moved.tau * u)
