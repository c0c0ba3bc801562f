"""The structure of a system, read off its jaxpr and never from values, so that it holds at every state.

`structure` says what the mass matrix depends on and which coordinates it couples, which coordinates are cyclic, whether
time is explicit, whether L has terms linear in the velocities, and what is constant in the constraints. It examines
their programs written out number by number: an entry that is a zero there is zero everywhere, and
one that no chain of operations connects with a coordinate does not depend on it. Of the packages for the sparsity of
jaxprs, asdex finds the patterns, but neither what an entry depends on nor the program without its zeros, which the
solver runs; one pass gives all three.

A coordinate is an *angle* where L, R, Q and the constraints contain it only through sines and cosines of expressions
linear in it. Its size then means nothing: an error counts the same after a thousand turns as in the first.

The jaxpr is walked once for each leaf of q. Every intermediate value is, as a function of that leaf, constant, linear,
periodic (made of sines and cosines), or anything else; the kind of a primitive's result follows from those of its
operands.

A system in single numbers has its coordinates one by one, and programs that are operations on single numbers.
`in_numbers` gives the same system with a tuple of numbers in place of the user's q and v. `Numbers` traces a function
of the system and its state, writes it out, and splits it into a part that depends on the parameters alone and the rest.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from functools import partial
from itertools import islice
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.contexts import WATCHED
from lagjax.jaxtools import (
    ADDITIVE,
    BILINEAR,
    LINEAR_IN_FIRST,
    PERIODIC,
    Literal,
    TooLong,
    calls_host,
    depends,
    interpreted,
    length,
    needed,
    one_by_one,
    outputs_of,
    poisoned,
    run,
    staged,
    varies,
    written_out,
)
from lagjax.mechanics.lagrangian import LinearEquation, force_with_ones, mass_and_forcing, with_first_order
from lagjax.numerics import banded
from lagjax.system import Form, Model, System, coordinates, takes_of, unchecked

# The most operations that are written out, before it is known which are needed. Writing a hundred thousand, as for an L
# with tables or a quadrature in it, only to discard them takes 15 s.
WRITTEN = 6000


class InNumbers(eqx.Module):
    """A function of (t, q, v, params) or (t, q, params), taking each state as a tuple of numbers."""

    function: Callable
    form: Form = eqx.field(static=True)
    returns_coordinates: bool = eqx.field(static=True, default=False)

    @property
    def takes(self):
        return takes_of(self.function)

    def __call__(self, t: Array, *states_and_params):
        *states, params = states_and_params
        # Multipliers come by name, and pass unchanged.
        states = [self.form.tree(jnp.stack(state)) if isinstance(state, tuple) else state for state in states]
        result = self.function(t, *states, params)
        return coordinates.numbers(result) if self.returns_coordinates else result


def in_numbers(model: Model) -> Model:
    """The same system, with a tuple of numbers for q and for v."""
    structure = jtu.tree_structure((0,) * model.n)
    form = model.form._replace(structure=structure, shapes=((),) * model.n)

    def change(function: Callable, role: str) -> InNumbers:
        return InNumbers(function, model.form, returns_coordinates=role in ("force", "forward_dynamics"))

    return unchecked(model.system.map(change), model.params, form)


class Numbers:
    """A function of (model, t, q, v), traced once and written out; q and v are tuples of numbers (`in_numbers`).

    What depends on the model alone is computed by `prepare`, once; `at` does the rest. `calls_host` says whether a
    user's function calls Python at run time. Beyond about `most` operations it raises `TooLong`.

    A function that `has_more` returns its result and what else it knows, which only `with_more_at` returns. With
    `force_apart` the force, a tuple of numbers, is an argument like q and v, and that of the model is not called.
    """

    def __init__(
        self, function: Callable, model: Model, most=math.inf, has_more: bool = False, force_apart: bool = False
    ):
        force = model.form.example[1] if force_apart else None
        arrays, static = eqx.partition((model, *model.form.example, force), varies)
        self.shapes = []

        def of_leaves(*leaves):
            model, *state, force = eqx.combine(jtu.tree_unflatten(jtu.tree_structure(arrays), leaves), static)
            found = function(_under(force, model) if force_apart else model, *state)
            self.shapes += map(jtu.tree_structure, found if has_more else (found,))
            return jtu.tree_leaves(found)

        like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in jtu.tree_leaves(arrays)]
        program = jax.make_jaxpr(of_leaves)(*like)
        self.calls_host = calls_host(program.jaxpr)
        if WATCHED.value:
            program = poisoned(program)
        program = _without_unused(program)
        full = jax.make_jaxpr(lambda *leaves: written_out(program, *leaves, most=most))(*like)
        self.program = _without_unused(full)
        of_problem, of_state = _leaves_of(arrays, (0,)), _leaves_of(arrays, (1, 2, 3, 4))
        self.state_variables = [self.program.jaxpr.invars[i] for i in of_state]
        early, late = staged(self.program, of_problem, of_state)
        count = self.shapes[0].num_leaves

        def result_alone(*given):
            return late(*given)[:count]

        self._early, self._late = jax.jit(one_by_one(early)), jax.jit(one_by_one(result_alone))
        self._late_with_more = jax.jit(one_by_one(late))

    @property
    def length(self) -> int:
        """How many operations its result consists of."""
        return length(outputs_of(self.program, range(self.shapes[0].num_leaves)).jaxpr)

    def prepare(self, model: Model) -> tuple | None:
        """What does not depend on the state; None if there is nothing, since equinox mishandles `()`."""
        return tuple(self._early(*jtu.tree_leaves(eqx.filter(model, varies)))) or None

    def at(self, prepared, t: Array, q: PyTree, v: PyTree, force: tuple | None = None):
        """The function's result at a state."""
        return jtu.tree_unflatten(self.shapes[0], self._late(prepared or (), *jtu.tree_leaves((t, q, v, force))))

    def with_more_at(self, prepared, t: Array, q: PyTree, v: PyTree) -> list:
        """The function's result and what else it returns, at a state."""
        found = iter(self._late_with_more(prepared or (), *jtu.tree_leaves((t, q, v))))
        return [jtu.tree_unflatten(shape, islice(found, shape.num_leaves)) for shape in self.shapes]

    def more(self, model: Model, t: Array, q: PyTree, v: PyTree, force: tuple | None = None):
        """What else the function returns."""
        alone = outputs_of(self.program, range(self.shapes[0].num_leaves, len(self.program.out_avals)))
        given = jtu.tree_leaves(eqx.filter((model, t, q, v, force), varies))
        return jtu.tree_unflatten(self.shapes[1], run(alone, given))

    def __call__(self, model: Model, t: Array, q: PyTree, v: PyTree):
        """The function's result."""
        return self.at(self.prepare(model), t, q, v)


def _under(force: tuple, model: Model) -> Model:
    """The model under a given force."""
    return model.mapped(lambda function, role: (lambda *state: force) if role == "force" else function)


def _without_unused(program):
    return program.replace(jaxpr=program.jaxpr.replace(eqns=needed(program.jaxpr)))


def _leaves_of(arguments, places):
    """The places of some arguments' leaves among the leaves of all."""
    sizes = [len(jtu.tree_leaves(x)) for x in arguments]
    starts = np.cumsum([0, *sizes])
    return [i for place in places for i in range(starts[place], starts[place + 1])]


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


def structure(model: Model) -> Structure | None:
    """The structure of a system. None if it or its program is large, or L is not what its motion is computed from."""
    if model.n + model.m > UP_TO or model.solves_itself:
        return None
    try:
        return _structure(in_numbers(model), model.names)
    except TooLong:
        return None


def _structure(model: Model, names: Sequence[str]):
    system, n = model.system, model.n
    mass = _numbers(_mass, model)
    nonzero = np.array([not is_zero(x) for x in mass.program.jaxpr.outvars]).reshape(n, n)
    lagrangian = _numbers(_of(system.lagrangian), model)
    linear = _numbers(_of(partial(_momentum_at_rest, system.lagrangian)), model)
    programs = [_numbers(_of(f), model) for f, _ in functions_of(model)]
    return Structure(
        mass_depends_on=_depends_on(mass, names),
        blocks=tuple(tuple(names[i] for i in block) for block in banded.blocks(nonzero)),
        explicit_time=any("t" in _depends_on(program, names) for program in programs),
        cyclic=tuple(name for name in names if name not in _depends_on(lagrangian, names)),
        linear_terms=tuple(name for name, x in zip(names, linear.program.jaxpr.outvars) if not is_zero(x)),
        constraints={name: _constraint_structure(c, model, names) for name, c in system.constraints.items()},
    )


def _of(function: Callable):
    """One of the user's functions as a function of the model and the state."""
    return lambda model, *state: function(*state, model.params)


class Invariance(NamedTuple):
    """What is known to change nothing.

    - `unseen` (n,): the coordinates that occur in none of L, R, Q and the constraints; they may all be shifted.
    - `timeless`: none of these depends on t. `even`: L has no terms linear in the velocities.
    """

    unseen: tuple[bool, ...]
    timeless: bool
    even: bool


def invariance(model: Model) -> Invariance:
    """What is known to change nothing; of a large system less is known."""

    def values(model: Model, t: Array, q: PyTree, v: PyTree):
        momentum = _momentum_at_rest(model.system.lagrangian, t, q, v, model.params)
        return [f(t, q, v, phase.params) for f, phase in functions_of(model)], momentum

    try:
        if model.n + model.m > UP_TO:
            raise TooLong
        numbers = Numbers(values, in_numbers(model), most=WRITTEN)
    except TooLong:
        # By whole leaves of q.
        unseen = np.repeat([kinds == {Depends.NOT} for kinds in _by_leaf(model)], model.form.sizes)
        return Invariance(tuple(unseen.tolist()), is_autonomous(model), False)
    jaxpr, (t, *state) = numbers.program.jaxpr, numbers.state_variables
    return Invariance(
        tuple(not depends(jaxpr, [y]) for y in state[: model.n]),
        not depends(jaxpr, [t]),
        all(is_zero(x) for x in jaxpr.outvars[-model.n :]),
    )


def is_diagonal(model: Model) -> bool:
    """Whether the mass matrix is known to be diagonal."""
    if model.n == 1:
        return True
    try:
        mass = _numbers(_mass, model)
    except TooLong:
        return False
    off_diagonal = ~np.eye(model.n, dtype=bool).reshape(-1)
    return all(is_zero(x) for x, off in zip(mass.program.jaxpr.outvars, off_diagonal) if off)


def is_free_of_velocities(model: Model) -> bool:
    """Whether accelerations are known not to depend on the velocities."""
    return not any(
        phase.m or with_first_order(phase).form.first_order is not None or sees_velocities(phase)
        for phase in model.phases
    )


def sees_velocities(model: Model) -> bool:
    """Whether M or F is not known to be free of velocities, constraints aside."""

    def equations(t: Array, q: PyTree, v: PyTree, params: PyTree) -> LinearEquation:
        return mass_and_forcing(model.of(params), t, *model.vectors(q, v))

    return _dependence(equations, model, lambda args: jtu.tree_leaves(args[2])) != Depends.NOT


def is_zero(x: Array) -> bool:
    """Whether a result of a written-out program is a literal zero."""
    return isinstance(x, Literal) and x.val == 0


def _numbers(function: Callable, model: Model):
    return Numbers(function, model, most=WRITTEN)


def _mass(model: Model, t: Array, q: PyTree, v: PyTree):
    # Along velocities alone: no chain of operations then leads from q's tangent, zero, through a network to v.
    x, u = model.vectors(q, v)
    _, push = jax.linearize(lambda u: jax.grad(model.lagrangian, argnums=2)(t, x, u), u)
    mass = jax.vmap(push)(np.eye(model.n, dtype=u.dtype))
    return [mass[i, j] for i in range(model.n) for j in range(model.n)]


def _momentum_at_rest(lagrangian: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    at_rest = tuple(np.zeros(x.shape, x.dtype) for x in v)
    return jax.grad(lagrangian, argnums=2)(t, q, at_rest, params)


def _depends_on(numbers, names: Sequence[str]):
    """The names on which any result depends: "t", coordinates, "velocities"."""
    jaxpr, n = numbers.program.jaxpr, len(names)
    t, *state = numbers.state_variables
    found = [name for name, x in zip(["t", *names], [t, *state[:n]]) if depends(jaxpr, [x])]
    return tuple([*found, "velocities"] if depends(jaxpr, state[n:]) else found)


def _constraint_structure(constraint, model: Model, names: Sequence[str]):
    by = 1 if constraint.of_positions else 2
    value = _numbers(_of(constraint.residual), model)
    slope = _numbers(_of(lambda *state: jax.jacfwd(constraint.residual, argnums=by)(*state)), model)
    return ConstraintStructure(linear=not _depends_on(slope, names), moving="t" in _depends_on(value, names))


class Depends(IntEnum):
    """How a value depends on one leaf of q."""

    NOT = 0
    LINEARLY = 1
    PERIODICALLY = 2
    OTHERWISE = 3


def are_angles(model: Model) -> np.ndarray:
    """Which coordinates are angles, (n,) booleans, by whole leaves of q."""
    leaves = [kinds - {Depends.NOT} == {Depends.PERIODICALLY} for kinds in _by_leaf(model)]
    return np.repeat(leaves, model.form.sizes)


def _by_leaf(model: Model) -> list[set[Depends]]:
    """How the functions of the motion depend on each leaf of q."""

    def on_leaf(i: int) -> set[Depends]:
        return {_dependence(*of, lambda args: jtu.tree_leaves(args[1])[i : i + 1]) for of in functions_of(model)}

    return [on_leaf(i) for i in range(len(model.form.shapes))]


def conserved_momenta(model: Model) -> list[str]:
    """The coordinates with a momentum known to be conserved: not in L or a constraint, and no force acts."""
    system, names = model.system, model.names
    if system.is_forced or not system.is_holonomic or len(names) > UP_TO:
        return []
    model = in_numbers(model)
    try:
        occurring = [_depends_on(_numbers(_of(f), model), names) for f, _ in functions_of(model)]
    except TooLong:
        return []
    return [name for name in names if not any(name in found for found in occurring)]


def what_changes_momentum(model: Model, name: str) -> Iterator[str]:
    """What may change the momentum of a coordinate, in words."""
    system = model.system
    if not _contains(system.lagrangian, name, model, argument=2):
        yield "L does not contain its velocity"
    if system.force is not None and _pushes(model, name):
        yield "a force acts on it"
    if system.dissipation is not None and _contains(system.dissipation, name, model, argument=2):
        yield "dissipation acts on it"
    functions = {"L contains it": system.lagrangian}
    for other, c in system.constraints.items():
        if c.of_positions:
            functions[f"constraint '{other}' contains it"] = c.residual
        else:
            yield f"constraint '{other}' restricts velocities"
    for words, function in functions.items():
        if _contains(function, name, model):
            yield words


def forced_by(model: Model, name: str) -> Iterator[str]:
    """Which forces on other coordinates depend on this one, in words."""
    if model.system.force is not None and _contains(force_with_ones(model), name, model):
        yield "the force contains it"
    if model.system.dissipation is not None and _contains(model.system.dissipation, name, model):
        yield "dissipation contains it"


def _pushes(model: Model, name: str) -> bool:
    """Whether the force on a coordinate is not a literal zero; also True if that is not known."""
    try:
        force = _numbers(_of(force_with_ones(in_numbers(model))), in_numbers(model))
    except TooLong:
        return True
    return not is_zero(force.program.jaxpr.outvars[model.names.index(name)])


def _contains(function: Callable, name: str, model: Model, argument=1) -> bool:
    """Whether a function depends on a coordinate, or with `argument` 2 on a velocity; also True if not known."""
    sizes, known = model.form.sizes, model.names
    leaf = int(np.searchsorted(np.cumsum(sizes), known.index(name), side="right"))
    if sizes[leaf] == 1:
        return (
            _dependence(function, model, lambda args: jtu.tree_leaves(args[argument])[leaf : leaf + 1]) != Depends.NOT
        )
    alone = in_numbers(unchecked(System(function), model.params, model.form._replace(residuals=())))
    try:
        # The function may be a force: all its entries count.
        numbers = _numbers(_of(lambda *s: coordinates.flatten(alone.system.lagrangian(*s))[0]), alone)
    except TooLong:
        return True
    place = 1 + (argument - 1) * len(known) + known.index(name)
    return depends(numbers.program.jaxpr, [numbers.state_variables[place]])


def conserves_jacobi_integral(model: Model) -> bool:
    """Whether the Jacobi integral is known to be constant: no explicit time, no force, only positions constrained."""
    return next(what_changes_jacobi_integral(model), None) is None


def what_changes_jacobi_integral(model: Model) -> Iterator[str]:
    """What may change the Jacobi integral, in words."""
    system = model.system
    if system.force is not None:
        yield "there is a force"
    if system.dissipation is not None:
        yield "there is dissipation"
    if system.states:
        yield "L may depend on a state"
    for name, c in system.constraints.items():
        if not c.of_positions:
            yield f"constraint '{name}' restricts velocities"
    if sees_time(system.lagrangian, model):
        yield "L depends on t"
    for name, c in system.constraints.items():
        if c.of_positions and sees_time(c.residual, model):
            yield f"constraint '{name}' depends on t"


def sees_time(function: Callable, model: Model) -> bool:
    """Whether a function of (t, q, v, params) depends on t."""
    return _dependence(function, model, lambda args: args[:1]) != Depends.NOT


def is_autonomous(model: Model) -> bool:
    """Whether nothing that the motion depends on depends on t."""
    return not any(sees_time(*of) for of in functions_of(model))


def functions_of(model: Model) -> list[tuple[Callable, Model]]:
    """All functions that the motion depends on, of (t, q, v, params), each with the model of its phase."""
    functions = []
    for phase in model.phases:
        system = phase.system
        forced = None if system.force is None else force_with_ones(phase)
        of_phase = [system.lagrangian, forced, system.dissipation, *system.states.values()]
        of_phase += [c.residual for c in system.constraints.values()]
        functions += [(f, phase) for f in of_phase if f is not None]
    return functions


def _dependence(function: Callable, model: Model, leaves_of: Callable) -> Depends:
    """How the outputs of a function of (t, q, v, params) depend on any of some leaves of these."""
    arrays, static = eqx.partition((*model.form.example, model.params), varies)

    def of_arrays(arrays: Sequence):
        return eqx.filter(function(*eqx.combine(arrays, static)), eqx.is_array)

    program = jax.make_jaxpr(of_arrays)(arrays)
    count, structure = len(program.jaxpr.invars), jtu.tree_structure(arrays)
    chosen = set(leaves_of(jtu.tree_unflatten(structure, range(count))))
    kinds = [Depends.LINEARLY if i in chosen else Depends.NOT for i in range(count)]
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
