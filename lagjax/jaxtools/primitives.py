"""Primitives of our own: operations with rules of their own for derivatives, batches and compilation."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from lagjax.jaxtools.tracing import as_usual
from lagjax.jaxtools.without_lapack_batches import one_by_one

__all__ = [
    "Primitive", "ad", "front", "is_float", "jaxpr_as_fun", "linear_map_primitive", "no_tangent", "primitive", "split",
]  # fmt: skip


def primitive(
    name: str,
    evaluate: Callable,
    shapes: Callable,
    *,
    several: bool = False,
    compiled: Callable | None = None,
    jvp: Callable | None = None,
    transpose: Callable | None = None,
    batched: Callable | None = None,
) -> Primitive:
    """Define a primitive that gives one result, or a list of `several`.

    **Arguments:** `evaluate`, the operation on arrays; `compiled`, the operation in compiled programs, if that is
    another function; `shapes`, the abstract values of the results from those of the operands; and the rules, as JAX
    wants them, of derivatives, of transposition and of batches. A transformation without a rule raises.
    """
    new = Primitive(name)
    new.multiple_results = several
    new.def_impl(as_usual(evaluate))
    new.def_abstract_eval(shapes)
    # What such a primitive evaluates in Python becomes part of a program only here.
    lowered = one_by_one(compiled or evaluate)
    mlir.register_lowering(new, mlir.lower_fun(lowered, multiple_results=several))
    for rules, rule in (
        (ad.primitive_jvps, jvp),
        (ad.primitive_transposes, transpose),
        (batching.primitive_batchers, batched),
    ):
        if rule is not None:
            rules[new] = as_usual(rule)
    return new


def linear_map_primitive(
    name: str,
    along: Callable,
    transpose: Callable,
    shapes: Callable,
    count: Callable,
    *,
    jvp: Callable,
    batched: Callable,
) -> Primitive:
    """Define a linear map of directions at some points: a derivative that JAX can transpose.

    **Arguments:** operands are the points, then `count(params)` directions. `along(points, directions, **params)` gives
    the results; `transpose(points, directions, wanted, cotangents, **params)` one cotangent for each wanted direction,
    in order, of which the abstract value stands among `directions`. The other rules are those of `primitive`.
    """

    def evaluate(*operands, **params):
        return list(along(*split(operands, count(params)), **params))

    def transposed(cotangents: Sequence, *operands, **params):
        points, directions = split(operands, count(params))
        # A constant comes as a Python number that knows its dtype.
        points = tuple(jnp.asarray(x) for x in points)
        wanted = tuple(ad.is_undefined_primal(x) for x in directions)
        like = [x.aval if w else x for x, w in zip(directions, wanted)]
        found = iter(transpose(points, like, wanted, cotangents, **params))
        return [None] * len(points) + [next(found) if w else None for w in wanted]

    return primitive(name, evaluate, shapes, several=True, jvp=jvp, transpose=transposed, batched=batched)


def split(operands: Sequence, count: int) -> tuple[tuple, tuple]:
    """The points and the last `count` operands, which are directions at them."""
    return tuple(operands[: len(operands) - count]), tuple(operands[len(operands) - count :])


def front(operands: Sequence, axes: Sequence[int | None]) -> tuple[list, tuple[bool, ...], int]:
    """The operands of a batch with its axis in front, which of them have it, and the number of lanes."""
    lanes = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    moved = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    return moved, tuple(axis is not None for axis in axes), lanes


def is_float(x) -> bool:
    """Whether an array has derivatives."""
    return jnp.issubdtype(x.dtype, jnp.inexact)


def no_tangent(x) -> ad.Zero:
    """The tangent of an array that does not move."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())
