"""Derivatives and lanes that JAX pushes through a program from Python: each of them one program, kept like any other.

Of a compiled function `jax.grad` makes two programs, one of values and one of derivatives, and no other process finds
them again. A function of few numbers has *columns* instead: its derivatives along each of the numbers that move, which
one program gives together with the values. What JAX then does with directions, or backward with cotangents, are
products with this table. By many numbers, or along fewer directions than there are numbers, that would be the longer
way, and JAX takes its own.
"""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import jaxpr_as_fun
from jaxtyping import Array, PyTree

from lagjax.contexts import COLUMNS
from lagjax.jaxtools.cache import FACTS, compiler_options, is_array, program_of
from lagjax.jaxtools.digest import trace_context
from lagjax.jaxtools.kept import KeptProgram, Said, kind, kinds_from
from lagjax.jaxtools.names import Traced, results_of, traced
from lagjax.jaxtools.primitives import ad, filled, front, is_float, jitted, no_tangent, one_by_one, primitive
from lagjax.jaxtools.tracing import HAPPENED, is_differentiated

# By up to so many numbers, pushing along all of them was cheaper to run and to compile than one pull back through
# checkpoints. From where on a replay is cheaper was not measured.
FEW = 24


@dataclass(frozen=True)
class Source:
    """A function of a list of arrays of some kinds, which means what `said` says; `key`: what it is compared by."""

    function: Callable[[list], PyTree] = field(compare=False)
    said: Said = field(compare=False)
    key: Hashable
    kinds: tuple

    def traced(self, forward: bool) -> Traced:
        """Its program, traced once in a process; one that has `forward` derivatives only."""

        def trace() -> Traced:
            with COLUMNS(forward):
                return traced(self.function, self.kinds)

        found = program_of((Source.traced, self, forward), trace)
        # Of which it is now a part.
        HAPPENED.update(found.happened)
        return found


class Lanes(NamedTuple):
    """A function in a batch: which of its operands have a lane axis, the first one."""

    batched: tuple[bool, ...]

    def of(self, function: Callable[[list], list]) -> Callable[[list], list]:
        """The function of batches."""
        axes = [0 if b else None for b in self.batched]
        return lambda arrays: jax.vmap(lambda *one: function(list(one)), axes)(*arrays)


class Columns(NamedTuple):
    """A function with its derivatives along each number in the operands that move.

    After the results comes, for each of them in floating point, an array with an axis of these numbers in front.
    """

    moved: tuple[int, ...]

    def of(self, function: Callable[[list], list]) -> Callable[[list], list]:
        """The function with its columns."""

        def with_columns(arrays: list) -> list:
            moving = [arrays[i] for i in self.moved]

            def of_moving(*chosen):
                return function(filled(arrays, self.moved, chosen))

            def push(*direction):
                values, found = jax.jvp(of_moving, tuple(moving), direction)
                return values, [d for x, d in zip(values, found) if is_float(x)]

            directions = axes_of(moving)
            if len(directions[0]) > 1:
                # The values are the same along all of them.
                values, columns = jax.vmap(push)(*directions)
                values = [x[0] for x in values]
            else:
                values, columns = push(*(x[0] for x in directions))
                columns = [x[None] for x in columns]
            return [*values, *columns]

        return with_columns


@dataclass(frozen=True)
class Outside:
    """A function after what JAX did to it from outside, first things first."""

    source: Source
    steps: tuple[Lanes | Columns, ...] = ()

    def __call__(self, arrays: list) -> list:
        """Its results, in a program that JAX traces."""
        return self._results(arrays, any(isinstance(step, Columns) for step in self.steps))

    def in_both_modes(self, arrays: list) -> list:
        """The same, where JAX may differentiate it in reverse."""
        return self._results(arrays, False)

    def _results(self, arrays: list, forward: bool) -> list:
        traced = self.source.traced(forward)
        function: Callable[[list], list] = lambda arrays: jaxpr_as_fun(traced.program)(*arrays)
        for step in self.steps:
            function = step.of(function)
        return function(arrays)

    def then(self, step: Lanes | Columns) -> "Outside":
        """The same after one more step."""
        return Outside(self.source, (*self.steps, step))

    def compiled(self, count: int) -> KeptProgram:
        """Its program, with so many results."""
        flat = Said(self._meant, lambda results: count, lambda outline, arrays: list(range(outline)))
        return KeptProgram(one_by_one(self), flat, compiler_options())

    def _meant(self) -> list[tuple[Any, bool]]:
        steps = [(type(step).__name__, *step) for step in self.steps]
        return [((compiler_options(), *steps), False), *self.source.said.parts()]


def from_python(function: Callable[[list], PyTree], said: Said, key: Hashable, arrays: list) -> PyTree | None:
    """`function(arrays)`, where JAX pushes derivatives or lanes through arrays whose values are known; else None.

    `function` closes over no traced values; `key`: what it is compared by.
    """
    if not any(isinstance(x, Tracer) for x in arrays) or not all(map(_is_known, arrays)):
        return None
    source = Source(function, said, (key, trace_context and trace_context()), tuple(map(kind, arrays)))
    trace = partial(source.traced, sum(x.size for x in arrays if is_differentiated(x)) in range(1, FEW + 1))
    structure, outputs = FACTS.made((from_python, source), lambda: results_of(trace, said, arrays))
    return jtu.tree_unflatten(structure, _outside_p.bind(*arrays, of=Outside(source), outputs=outputs))


def _is_known(x: Any) -> bool:
    """Whether there are values below all tracers of derivatives and lanes, those of both modes and of batches."""
    while isinstance(x, Tracer):
        within = "primal" if hasattr(x, "tangent") else "val" if hasattr(x, "batch_dim") else ""
        x = getattr(x, within, None)
    return x is not None


def _run(*arrays: Array, of: Outside, outputs: tuple):
    program = program_of(of, lambda: of.compiled(len(outputs)))
    try:
        return program(_as_arrays(arrays))
    except jax.errors.JaxRuntimeError:
        # Equinox's wrapper has a better message for its checks.
        return jitted(of)(_as_arrays(arrays))


def _as_arrays(operands: Sequence) -> list:
    # A constant comes as a Python number that knows its dtype.
    return [x if is_array(x) else jnp.asarray(x) for x in operands]


def _inside(*arrays: Array, of: Outside, outputs: tuple):
    return of(list(arrays))


def _shapes(*arrays, of: Outside, outputs: tuple):
    return kinds_from(outputs)


def _in_lanes(operands: Sequence, axes: Sequence, *, of: Outside, outputs: tuple):
    operands, batched, lanes = front(operands, axes)
    of_lanes = tuple(((lanes, *shape), *rest) for shape, *rest in outputs)
    return _outside_p.bind(*operands, of=of.then(Lanes(batched)), outputs=of_lanes), [0] * len(outputs)


def _pushed(primals: Sequence, tangents: Sequence, *, of: Outside, outputs: tuple):
    primals = _as_arrays(primals)
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero) and primals[i].size)
    if not moved:
        values = _outside_p.bind(*primals, of=of, outputs=outputs)
        return values, list(map(no_tangent, values))
    directions = [tangents[i] for i in moved]
    if not have_columns([primals[i] for i in moved], directions):
        return _by_jax(primals, moved, directions, of)
    numbers = sum(primals[i].size for i in moved)
    kinds = zip(outputs, kinds_from(outputs))
    columns = tuple(((numbers, *shape), *rest) for (shape, *rest), x in kinds if is_float(x))
    try:
        found = _outside_p.bind(*primals, of=of.then(Columns(moved)), outputs=(*outputs, *columns))
    except TypeError:
        # A function of the user's that has derivatives in reverse only; what else is wrong, JAX says.
        return _by_jax(primals, moved, directions, of)
    return changes_from(found, len(outputs), directions)


def have_columns(moved: Sequence, directions: Sequence) -> bool:
    """Whether columns are the way to the derivatives by some arrays along these directions, of which JAX may know none
    yet: by few numbers, and for as many directions at least."""
    return 0 < sum(x.size for x in moved) <= min(FEW, *map(_directions, directions))


def _directions(tangent: Any) -> float:
    """How many directions a tangent stands for: one that is not known yet, for all."""
    if not isinstance(tangent, Tracer):
        return 1
    if hasattr(tangent, "batch_dim"):
        value: Any = tangent.val
        return 1 if tangent.batch_dim is None else value.shape[tangent.batch_dim]
    return 1 if hasattr(tangent, "tangent") else np.inf


def changes_from(found: Sequence, count: int, directions: Sequence) -> tuple[list, list]:
    """The first `count` of what was found, the values, and their changes along directions, from their columns."""
    values, along = list(found[:count]), iter(_products(list(found[count:]), list(directions)))
    return values, [next(along) if is_float(x) else no_tangent(x) for x in values]


@jax.jit
def _products(columns: list, directions: list) -> list:
    """The sums of columns, each times its number of the directions."""
    along = jnp.concatenate([jnp.ravel(d) for d in directions])
    return [jnp.tensordot(along.astype(x.dtype), x, 1) for x in columns]


def _by_jax(primals: Sequence, moved: Sequence[int], directions: Sequence, of: Outside):
    part = program_of((_by_jax, of), lambda: jitted(of.in_both_modes))
    moving = tuple(primals[i] for i in moved)
    values, found = jax.jvp(lambda *chosen: part(filled(primals, moved, chosen)), moving, tuple(directions))
    return values, [d if is_float(x) else no_tangent(x) for x, d in zip(values, found)]


def axes_of(arrays: Sequence) -> list:
    """For each array the directions along all their numbers, with the axis of these in front."""
    ends = np.cumsum([0, *(x.size for x in arrays)])
    axes = [jnp.eye(ends[-1], x.size, -start, dtype=x.dtype) for start, x in zip(ends, arrays)]
    return [rows.reshape(ends[-1], *x.shape) for rows, x in zip(axes, arrays)]


_outside_p = primitive(
    "lagjax_from_python", _run, _shapes, several=True, compiled=_inside, jvp=_pushed, batched=_in_lanes
)
