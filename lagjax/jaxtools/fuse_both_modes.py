"""A function as one machine function, differentiable in both modes and as often as wanted.

`one_function` is differentiated forward along its operations, and can no longer be transposed. Here the derivative is a
linear map of its own, dx -> dy at x: evaluated forward as one function, and transposed by another one, which computes

    x, dy*  ->  (dy/dx)ᵀ dy*

from the start. So what reverse mode keeps are the arguments, and no more. In a batch both are the usual programs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import equinox as eqx
import jax
import jax.tree_util as jtu
from jax.core import ShapedArray
from jaxtyping import PyTree

from lagjax.jaxtools.fuse_cpu import one_function
from lagjax.jaxtools.plain import is_plain
from lagjax.jaxtools.primitives import (
    ad,
    front,
    is_float,
    jaxpr_as_fun,
    linear_map_primitive,
    no_tangent,
    primitive,
    split,
)


def one_function_in_both_modes(function: Callable, *args) -> PyTree:
    """`function(*args)`, compiled as one machine function where that is possible, and so are its derivatives.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> print(jax.grad(lambda x: one_function_in_both_modes(jnp.sin, x))(jnp.asarray(0.0)))
    1.0

    The arguments are those of `one_function`; the results are arrays.
    """
    if is_plain():
        return function(*args)
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jtu.tree_flatten(arrays)
    structures = []

    def of_leaves(*leaves):
        found, of_results = jtu.tree_flatten(function(*eqx.combine(jtu.tree_unflatten(structure, leaves), static)))
        structures.append(of_results)
        return found

    program = jax.make_jaxpr(of_leaves)(*leaves)
    # Jitted, so that it is traced once.
    call = jax.jit(jaxpr_as_fun(program))
    return jtu.tree_unflatten(structures[0], _function_p.bind(*leaves, of=_Function(call, False)))


@dataclass(frozen=True, eq=False)
class _Function:
    """A function of arrays that returns a list of arrays; `lanes`: whether it is one of a batch."""

    call: Callable
    lanes: bool

    def compiled(self, function: Callable, *args):
        """A function that is made from this one, at some arguments."""
        return function(*args) if self.lanes else one_function(function, *args)

    def in_lanes(self, batched: Sequence[bool], lanes: bool = True) -> "_Function":
        """The same for a batch."""
        return _Function(jax.vmap(self.call, [0 if b else None for b in batched]), lanes)


def _evaluated(*leaves, of: _Function):
    return list(of.compiled(of.call, *leaves))


def _shapes(*leaves, of: _Function):
    found = jax.eval_shape(of.call, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves))
    return [ShapedArray(x.shape, x.dtype) for x in found]


def _jvp(primals: Sequence, tangents: Sequence, *, of: _Function):
    values = _function_p.bind(*primals, of=of)
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero))
    if not moved:
        return values, [no_tangent(y) for y in values]
    dy = iter(_tangent_p.bind(*primals, *(tangents[i] for i in moved), of=of, moved=moved))
    return values, [next(dy) if is_float(y) else no_tangent(y) for y in values]


def _batched(operands: Sequence, axes: Sequence, *, of: _Function):
    operands, batched, _ = front(operands, axes)
    found = _function_p.bind(*operands, of=of.in_lanes(batched))
    return found, [0] * len(found)


# The operands of the derivative are the arguments, and the directions of those with indices `moved`; its results are
# the derivatives of the floating-point results.


def _of_moved(points: Sequence, *chosen, of: _Function, moved: Sequence[int]):
    every = list(points)
    for i, x in zip(moved, chosen):
        every[i] = x
    return [y for y in of.call(*every) if is_float(y)]


def _along(points: Sequence, directions: Sequence, *, of: _Function, moved: Sequence[int]):
    start = tuple(points[i] for i in moved)
    return jax.jvp(partial(_of_moved, points, of=of, moved=moved), start, tuple(directions))[1]


def _pushed(points: Sequence, directions: Sequence, *, of: _Function, moved: Sequence[int]):
    return of.compiled(partial(_along, of=of, moved=moved), points, directions)


def _pushed_shapes(*operands, of: _Function, moved: Sequence[int]):
    return [x for x in _shapes(*split(operands, len(moved))[0], of=of) if is_float(x)]


def _pulled(
    points: Sequence, directions: Sequence, wanted: Sequence[bool], cotangents: Sequence, *, of: _Function,
    moved: Sequence[int],
):  # fmt: skip
    moved = tuple(i for i, w in zip(moved, wanted) if w)
    count = len(points)

    def pull(*operands):
        points, cotangents = operands[:count], operands[count:]
        _, back = jax.vjp(partial(_of_moved, points, of=of, moved=moved), *(points[i] for i in moved))
        return list(back(list(cotangents)))

    # Itself such a function, to be differentiated again.
    return _function_p.bind(*points, *map(ad.instantiate_zeros, cotangents), of=_Function(pull, of.lanes))


def _pushed_as_function(of: _Function, moved: Sequence[int]) -> _Function:
    def push(*operands):
        return _along(*split(operands, len(moved)), of=of, moved=moved)

    return _Function(push, of.lanes)


def _pushed_jvp(primals: Sequence, tangents: Sequence, *, of: _Function, moved: Sequence[int]):
    values = _tangent_p.bind(*primals, of=of, moved=moved)
    return values, _jvp(primals, tangents, of=_pushed_as_function(of, moved))[1]


def _pushed_batched(operands: Sequence, axes: Sequence, *, of: _Function, moved: Sequence[int]):
    operands, batched, _ = front(operands, axes)
    # Many directions at one point still are one function.
    lanes = of.lanes or any(split(batched, len(moved))[0])
    found = _function_p.bind(*operands, of=_pushed_as_function(of, moved).in_lanes(batched, lanes))
    return found, [0] * len(found)


_function_p = primitive("lagjax_function", _evaluated, _shapes, several=True, jvp=_jvp, batched=_batched)
_tangent_p = linear_map_primitive(
    "lagjax_function_tangent", _pushed, _pulled, _pushed_shapes, lambda params: len(params["moved"]),
    jvp=_pushed_jvp, batched=_pushed_batched,
)  # fmt: skip
