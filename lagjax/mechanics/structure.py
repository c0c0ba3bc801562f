"""The structure of a system, read off its jaxpr and never from values, so that it holds at every state.

`structure` says what the mass matrix depends on and which coordinates it couples, which coordinates are cyclic, whether
time is explicit, whether L has terms linear in the velocities, and what is constant in the constraints. It examines
their programs written out number by number (`in_numbers.py`): an entry that is a zero there is zero everywhere, and one
that no chain of operations connects with a coordinate does not depend on it. Of the packages for the sparsity of
jaxprs, asdex finds the patterns, but neither what an entry depends on nor the program without its zeros, which the
solver runs; one pass gives all three.

A coordinate is an *angle* where L, R, Q and the constraints contain it only through sines and cosines of expressions
linear in it. Its size then means nothing: an error counts the same after a thousand turns as in the first.

The jaxpr is walked once for each leaf of q. Every intermediate value is, as a function of that leaf, constant, linear,
periodic (made of sines and cosines), or anything else; the kind of a primitive's result follows from those of its
operands.
"""

from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.jax_internals.names import ADDITIVE, BILINEAR, LINEAR_IN_FIRST, PERIODIC
from lagjax.jax_internals.programs import Literal, depends, interpreted
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.in_numbers import WRITTEN, Numbers, in_numbers
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanics.reactions import force_with_ones
from lagjax.mechanics.system import System
from lagjax.numerics import banded
from lagjax.numerics.scalars import TooLong

# Coordinates and equations together; the programs of larger systems are not written out.
UP_TO = 24


class ConstraintStructure(NamedTuple):
    """Whether a constraint is linear with constant coefficients (in q, or in v), and whether it depends on time."""

    linear: bool
    moving: bool


class Structure(NamedTuple):
    """What holds for a system at every state.

    - `mass_depends_on`: "t", names of coordinates, "velocities"; empty where M is constant.
    - `blocks`: the coordinates that M couples with each other, by name; one each where M is diagonal.
    - `explicit_time`: whether L, R, Q or a constraint depends on t.
    - `cyclic`: the coordinates that L does not contain.
    - `linear_terms`: the coordinates in whose velocities L has linear terms (they give gyroscopic forces, or none where
      they are a total derivative).
    - `constraints`: a `ConstraintStructure` by name.
    """

    mass_depends_on: tuple[str, ...]
    blocks: tuple[tuple[str, ...], ...]
    explicit_time: bool
    cyclic: tuple[str, ...]
    linear_terms: tuple[str, ...]
    constraints: dict[str, ConstraintStructure]


def structure(system, t, q, v, params) -> Structure | None:
    """The structure of a system; only names and shapes of the state count. None if it or its program is large."""
    names = coordinates.names(q)
    if len(names) + constraints.count(system, t, q, v, params) > UP_TO:
        return None
    _, unflatten = coordinates.flatten(q)
    system = in_numbers(system, unflatten)
    try:
        return _structure((system, t, coordinates.numbers(q), coordinates.numbers(v), params), names)
    except TooLong:
        return None


def _structure(args, names):
    system, n = args[0], len(names)
    mass = _numbers(_mass, args)
    nonzero = np.array([not is_zero(x) for x in mass.program.jaxpr.outvars]).reshape(n, n)
    lagrangian = _numbers(lambda system, *state: system.lagrangian(*state), args)
    linear = _numbers(_momentum_at_rest, args)
    programs = [_numbers(lambda _, *state, f=f: f(*state), args) for f in functions_of(system)]
    return Structure(
        mass_depends_on=_depends_on(mass, names),
        blocks=tuple(tuple(names[i] for i in block) for block in banded.blocks(nonzero)),
        explicit_time=any("t" in _depends_on(program, names) for program in programs),
        cyclic=tuple(name for name in names if name not in _depends_on(lagrangian, names)),
        linear_terms=tuple(name for name, x in zip(names, linear.program.jaxpr.outvars) if not is_zero(x)),
        constraints={name: _constraint_structure(c, args, names) for name, c in system.constraints.items()},
    )


def unseen_coordinates(system, t, q, v, params) -> np.ndarray:
    """Which coordinates are known to occur in none of L, R, Q and the constraints: (n,) booleans.

    They may all be shifted, and nothing else of the motion changes.
    """
    x, unflatten = coordinates.flatten(q)
    if x.size + constraints.count(system, t, q, v, params) > UP_TO:
        return _unseen_leaves(system, t, q, v, params)
    written = in_numbers(system, unflatten), t, coordinates.numbers(q), coordinates.numbers(v), params
    occurs = np.zeros(x.size, bool)
    try:
        for f in functions_of(written[0]):
            numbers = _numbers(lambda _, *state, f=f: f(*state), written)
            _, *state = numbers.state_variables
            occurs |= np.array([depends(numbers.program.jaxpr, [y]) for y in state[: x.size]])
    except TooLong:
        return _unseen_leaves(system, t, q, v, params)
    return ~occurs


def _unseen_leaves(system, t, q, v, params):
    """The same, for whole leaves of q."""
    unseen = []
    for i, leaf in enumerate(jtu.tree_leaves(q)):
        at = lambda args, i=i: jtu.tree_leaves(args[1])[i]
        kinds = {_dependence(f, (t, q, v, params), at) for f in functions_of(system)}
        unseen += [kinds == {Depends.NOT}] * int(np.size(leaf))
    return np.array(unseen)


def is_diagonal(system, t, q, v, params) -> bool:
    """Whether the mass matrix is known to be diagonal."""
    x, _ = coordinates.flatten(q)
    if x.size == 1:
        return True
    try:
        mass = _numbers(_mass, (system, t, q, v, params))
    except TooLong:
        return False
    off_diagonal = ~np.eye(x.size, dtype=bool).reshape(-1)
    return all(is_zero(x) for x, off in zip(mass.program.jaxpr.outvars, off_diagonal) if off)


def is_free_of_velocities(system, t, q, v, params) -> bool:
    """Whether accelerations are known not to depend on the velocities."""
    if system.constraints:
        return False
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    equations = lambda t, x, u, params: mass_and_forcing(system, t, x, u, params, unflatten)
    return _dependence(equations, (t, x, u, params), lambda args: args[2]) == Depends.NOT


def is_zero(x) -> bool:
    """Whether a result of a written-out program is a literal zero."""
    return isinstance(x, Literal) and x.val == 0


def _numbers(function, args):
    return Numbers(function, args, most=WRITTEN)


def _mass(system, t, q, v, params):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    mass = mass_and_forcing(system, t, x, u, params, unflatten).mass
    return [mass[i, j] for i in range(x.size) for j in range(x.size)]


def _momentum_at_rest(system, t, q, v, params):
    at_rest = tuple(np.zeros(x.shape, x.dtype) for x in v)
    return jax.grad(system.lagrangian, argnums=2)(t, q, at_rest, params)


def _depends_on(numbers, names):
    """The names on which any result depends: "t", coordinates, "velocities"."""
    jaxpr, n = numbers.program.jaxpr, len(names)
    t, *state = numbers.state_variables
    found = [name for name, x in zip(["t", *names], [t, *state[:n]]) if depends(jaxpr, [x])]
    return tuple([*found, "velocities"] if depends(jaxpr, state[n:]) else found)


def _constraint_structure(constraint, args, names):
    by = 1 if constraint.of_positions else 2
    value = _numbers(lambda _, *state: constraint.residual(*state), args)
    slope = _numbers(lambda _, *state: jax.jacfwd(lambda *s: constraint.residual(*s), argnums=by)(*state), args)
    return ConstraintStructure(linear=not _depends_on(slope, names), moving="t" in _depends_on(value, names))


class Depends(IntEnum):
    """How a value depends on one leaf of q."""

    NOT = 0
    LINEARLY = 1
    PERIODICALLY = 2
    OTHERWISE = 3


def angles(system, t, q, v, params) -> PyTree[bool]:
    """Which leaves of q are angles, in the structure of q."""
    leaves, structure = jtu.tree_flatten(q)
    found = []
    for i in range(len(leaves)):
        kinds = {
            _dependence(f, (t, q, v, params), lambda args, i=i: jtu.tree_leaves(args[1])[i])
            for f in functions_of(system)
        }
        found.append(kinds - {Depends.NOT} == {Depends.PERIODICALLY})
    return jtu.tree_unflatten(structure, found)


def conserved_momenta(system, t, q, v, params) -> list[str]:
    """The coordinates with a momentum known to be conserved: not in L or a constraint, and no force acts."""
    names = coordinates.names(q)
    forced = system.force is not None or system.dissipation is not None
    if forced or not system.is_holonomic or len(names) > UP_TO:
        return []
    _, unflatten = coordinates.flatten(q)
    system = in_numbers(system, unflatten)
    args = (system, t, coordinates.numbers(q), coordinates.numbers(v), params)
    try:
        occurring = [_depends_on(_numbers(lambda _, *state, f=f: f(*state), args), names) for f in functions_of(system)]
    except TooLong:
        return []
    return [name for name in names if not any(name in found for found in occurring)]


def what_changes_momentum(system, name, t, q, v, params) -> Iterator[str]:
    """What may change the momentum of a coordinate, in words."""
    if not _contains(system.lagrangian, name, t, q, v, params, argument=2):
        yield "L does not contain its velocity"
    if system.force is not None and _pushes(system, name, t, q, v, params):
        yield "a force acts on it"
    if system.dissipation is not None and _contains(system.dissipation, name, t, q, v, params, argument=2):
        yield "dissipation acts on it"
    functions = {"L contains it": system.lagrangian}
    for other, c in system.constraints.items():
        if c.of_positions:
            functions[f"constraint '{other}' contains it"] = c.residual
        else:
            yield f"constraint '{other}' restricts velocities"
    for words, function in functions.items():
        if _contains(function, name, t, q, v, params):
            yield words


def forced_by(system, name, t, q, v, params) -> Iterator[str]:
    """Which forces on other coordinates depend on this one, in words."""
    if system.force is not None and _contains(force_with_ones(system), name, t, q, v, params):
        yield "the force contains it"
    if system.dissipation is not None and _contains(system.dissipation, name, t, q, v, params):
        yield "dissipation contains it"


def _pushes(system, name, t, q, v, params) -> bool:
    """Whether the force on a coordinate is not a literal zero; also True if that is not known."""
    _, unflatten = coordinates.flatten(q)
    args = in_numbers(system, unflatten), t, coordinates.numbers(q), coordinates.numbers(v), params
    try:
        force = _numbers(lambda system, *state: force_with_ones(system)(*state), args)
    except TooLong:
        return True
    return not is_zero(force.program.jaxpr.outvars[coordinates.names(q).index(name)])


def _contains(function, name, t, q, v, params, argument=1) -> bool:
    """Whether a function depends on a coordinate, or with `argument` 2 on a velocity; also True if not known."""
    sizes = [np.size(leaf) for leaf in jtu.tree_leaves(q)]
    leaf = int(np.searchsorted(np.cumsum(sizes), coordinates.names(q).index(name), side="right"))
    if sizes[leaf] == 1:
        found = _dependence(function, (t, q, v, params), lambda args: jtu.tree_leaves(args[argument])[leaf])
        return found != Depends.NOT
    _, unflatten = coordinates.flatten(q)
    alone, known = in_numbers(System(function), unflatten), coordinates.names(q)
    args = alone, t, coordinates.numbers(q), coordinates.numbers(v), params
    try:
        # The function may be a force: all its entries count.
        numbers = _numbers(lambda system, *state: coordinates.flatten(system.lagrangian(*state))[0], args)
    except TooLong:
        return True
    place = 1 + (argument - 1) * len(known) + known.index(name)
    return depends(numbers.program.jaxpr, [numbers.state_variables[place]])


def conserves_jacobi_integral(system, t, q, v, params) -> bool:
    """Whether the Jacobi integral is known to be constant: no explicit time, no force, only positions constrained."""
    return next(what_changes_jacobi_integral(system, t, q, v, params), None) is None


def what_changes_jacobi_integral(system, t, q, v, params) -> Iterator[str]:
    """What may change the Jacobi integral, in words."""
    if system.force is not None:
        yield "there is a force"
    if system.dissipation is not None:
        yield "there is dissipation"
    for name, c in system.constraints.items():
        if not c.of_positions:
            yield f"constraint '{name}' restricts velocities"
    if sees_time(system.lagrangian, t, q, v, params):
        yield "L depends on t"
    for name, c in system.constraints.items():
        if c.of_positions and sees_time(c.residual, t, q, v, params):
            yield f"constraint '{name}' depends on t"


def sees_time(function, *state) -> bool:
    """Whether a function of (t, q, v, params) depends on t."""
    return _dependence(function, state, lambda args: args[0]) != Depends.NOT


def is_autonomous(system, t, q, v, params) -> bool:
    """Whether nothing that the motion depends on depends on t."""
    return not any(sees_time(f, t, q, v, params) for f in functions_of(system))


def functions_of(system):
    """All functions that the motion depends on, of (t, q, v, params)."""
    functions = []
    for phase in system.phases:
        functions += [phase.lagrangian, None if phase.force is None else force_with_ones(phase), phase.dissipation]
        functions += [c.residual for c in phase.constraints.values()]
    return [f for f in functions if f is not None]


def _dependence(function, args, leaf_of):
    """How the outputs of a function of (t, q, v, params) depend on one leaf of these."""
    arrays, static = eqx.partition(args, eqx.is_array)

    def of_arrays(arrays):
        return eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array)

    program = jax.make_jaxpr(of_arrays)(arrays)
    count, structure = len(program.jaxpr.invars), jtu.tree_structure(arrays)
    chosen = leaf_of(jtu.tree_unflatten(structure, range(count)))
    kinds = [Depends.LINEARLY if i == chosen else Depends.NOT for i in range(count)]
    return max(interpreted(program, kinds, _apply, lambda *_: Depends.NOT), default=Depends.NOT)


def _apply(equation, kinds):
    """The kind of each result of a primitive, given the kinds of its operands."""
    name, worst, count = equation.primitive.name, max(kinds, default=Depends.NOT), len(equation.outvars)
    if worst in (Depends.NOT, Depends.OTHERWISE):
        return [worst] * count
    linear = Depends.LINEARLY in kinds
    if name in PERIODIC or not linear:
        return [Depends.PERIODICALLY] * count
    # From here on an operand is linear; together with a periodic one the result is neither.
    pure = Depends.PERIODICALLY not in kinds
    if name in ADDITIVE and pure:
        return [Depends.LINEARLY] * count
    if name in LINEAR_IN_FIRST and pure and worst == kinds[0] and max(kinds[1:], default=Depends.NOT) == Depends.NOT:
        return [Depends.LINEARLY] * count
    if name in BILINEAR and pure and kinds.count(Depends.LINEARLY) == 1:
        return [Depends.LINEARLY] * count
    return [Depends.OTHERWISE] * count
