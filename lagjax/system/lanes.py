"""The user's functions of one kind in lanes: what several of them compute alike is compiled once.

A mechanism has many joints of few kinds: their programs differ in the numbers that they hold (places, axes) and in the
entries of the state that they read. `opened` makes both operands of the program. Functions whose opened programs have
the same meaning are of one kind, and `vectors` computes all of a kind by one program, with an axis for the functions.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import eval_jaxpr
from jaxtyping import Array, Float

from lagjax.jaxtools import (
    ARITHMETIC,
    ClosedJaxpr,
    Jaxpr,
    Literal,
    Meaning,
    bodies,
    content_of,
    equations,
    evaluate,
    is_float,
    length,
    meaning_of,
    once_per_program,
    written,
)
from lagjax.system.traced_functions import Traced, arrays_of, signature_of

# Functions stay as they are where lanes would save fewer operations: to bring operands together takes as many.
SAVED = 20


class Opened(NamedTuple):
    """A program that takes the numbers written in it, its constants, and what it reads of its arguments.

    `numbers`: those written in it; `reads`: which of the arguments' arrays it reads.
    """

    program: ClosedJaxpr
    meaning: Meaning
    numbers: tuple[np.ndarray, ...]
    reads: tuple[int, ...]


@once_per_program
def opened(jaxpr: Jaxpr) -> Opened | None:
    """The program in this form; None for one that is more than arithmetic, as a loop."""
    if any(e.primitive.name not in ARITHMETIC or e.effects for e in equations(jaxpr)):
        return None
    variables = [x for e in jaxpr.eqns for x in e.invars] + list(jaxpr.outvars)
    read = list(dict.fromkeys(x for x in variables if not isinstance(x, Literal) and x in jaxpr.invars))
    numbers = tuple(written(x) for e in jaxpr.eqns for x in e.invars if _is_operand(x, e))

    def run(*operands: Array) -> list:
        given = iter(operands)
        of_literals = [next(given) for _ in numbers]
        values = dict(zip((*jaxpr.constvars, *read), given))
        left = iter(of_literals)
        for e in jaxpr.eqns:
            if any(_is_operand(x, e) for x in e.invars):
                at = [next(left) if _is_operand(x, e) else written(x) if isinstance(x, Literal) else values[x]
                      for x in e.invars]  # fmt: skip
                results = e.primitive.bind(*at, **e.params)
                results = results if e.primitive.multiple_results else [results]
            else:
                results = evaluate(jaxpr, e, values)
            values.update(zip(e.outvars, results))
        return [jnp.asarray(written(x)) if isinstance(x, Literal) else values[x] for x in jaxpr.outvars]

    avals: list[Any] = [*numbers, *(x.aval for x in (*jaxpr.constvars, *read))]
    program = jax.make_jaxpr(run)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in avals))
    return Opened(program, Meaning(meaning_of(program.jaxpr)), numbers, tuple(map(jaxpr.invars.index, read)))


def _is_operand(x, equation) -> bool:
    """Whether an operand is a number that may be another one in another lane; whole numbers may be places."""
    return isinstance(x, Literal) and is_float(x.aval) and not bodies(equation)


def vectors(functions: Sequence[Callable], args: tuple) -> list[Float[Array, " m"]]:
    """The results of functions that return a number or a vector, as vectors; functions of one kind in lanes."""
    results: list = [None] * len(functions)
    kinds: defaultdict = defaultdict(list)
    for i, function in enumerate(functions):
        kind = _kind(function, args)
        kinds[i if kind is None else kind].append(i)
    for places in kinds.values():
        alike = [functions[i] for i in places]
        if len(alike) > 1 and (len(alike) - 1) * length(alike[0].program.jaxpr) >= SAVED:
            found = _in_lanes([function.program for function in alike], arrays_of(args))
        else:
            found = [jnp.ravel(function(*args)) for function in alike]
        for i, value in zip(places, found):
            results[i] = value
    return results


def _kind(function: Callable, args: tuple):
    """What functions of one kind have in common; None where the function is the only one of its kind."""
    if not isinstance(function, Traced) or function.arrays or signature_of(args) != function.program.signature:
        return None
    program = function.program
    found = opened(program.jaxpr)
    fixed = tuple(content_of(x) for x in program.constants if not is_float(x))
    return None if found is None else (found.meaning, fixed)


def _in_lanes(programs: Sequence, arrays: Sequence[Array]) -> list[Float[Array, " m"]]:
    """The results of programs of one kind, given the arguments' arrays."""
    lanes = [found for found in (opened(program.jaxpr) for program in programs) if found is not None]
    kind = lanes[0].program
    held = [[*lane.numbers, *program.constants] for lane, program in zip(lanes, programs)]
    operands = [_together(x) for x in zip(*held)] + [
        (arrays[i[0]], None) if len(set(i)) == 1 else (_stacked([arrays[k] for k in i]), 0)
        for i in zip(*(lane.reads for lane in lanes))
    ]

    def of_lane(*operands: Array) -> Array:
        (value,) = eval_jaxpr(kind.jaxpr, kind.consts, *operands)
        return jnp.ravel(value)

    values, axes = zip(*operands)
    found = jax.vmap(of_lane, axes, axis_size=len(programs))(*values)
    size = found.shape[1]
    return list(lax.split(found.reshape(-1), [size] * len(programs)))


def _together(values: Sequence[np.ndarray]) -> tuple[np.ndarray, int | None]:
    """Constants of all lanes along a new axis; without one where all are the same."""
    stacked = np.stack(values)
    return (values[0], None) if (stacked == values[0]).all() else (stacked, 0)


def _stacked(values: Sequence[Array]) -> Array:
    """The same as `jnp.stack`, in two operations."""
    return jnp.concatenate([jnp.ravel(x) for x in values]).reshape(len(values), *jnp.shape(values[0]))
