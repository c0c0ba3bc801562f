"""Results about an object, remembered for as long as the object lives."""

import math
import weakref
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

T = TypeVar("T")
# The most results of one object. Only a user's loop over new shapes has more, and does not need the first ones again.
AT_MOST = 256
_results: dict[int, tuple[weakref.ref, dict]] = {}


def remembered(thing: Any, key: Hashable, find: Callable[[], T]) -> T:
    """`find()`, or its earlier result for this very object and this key."""
    try:
        hash(key)
    except TypeError:
        return find()
    reference, found = _results.get(id(thing), (None, {}))
    if reference is None or reference() is not thing:
        number, found = id(thing), {}
        _results[number] = weakref.ref(thing, lambda _: _results.pop(number, None)), found
    if key not in found:
        value = find()
        if len(found) >= AT_MOST:
            found.clear()
        found[key] = value
    return found[key]


def kinds(tree: PyTree):
    """Structure, shapes and dtypes of a tree, and its leaves that are not arrays: what a program is compiled for."""
    leaves, structure = jtu.tree_flatten(tree)
    return structure, *((x.shape, x.dtype) if is_array(x) else (type(x), x) for x in leaves)


def same(a: PyTree, b: PyTree) -> bool:
    """Whether two trees are the same: arrays by value, arrays that JAX is tracing by identity."""
    if kinds(a) != kinds(b):
        return False
    pairs = [(x, y) for x, y in zip(jtu.tree_leaves(a), jtu.tree_leaves(b)) if x is not y and is_array(x)]
    if any(isinstance(part, Tracer) for pair in pairs for part in pair):
        return False
    return all(np.array_equal(x, y, equal_nan=np.issubdtype(x.dtype, np.inexact)) for x, y in pairs)


class Parted(NamedTuple):
    """The part of a tree that is not arrays: what a program of its arrays is compiled for."""

    rest: tuple
    structure: Any

    def together(self, arrays):
        """Put the tree together again."""
        arrays = iter(arrays)
        return jtu.tree_unflatten(self.structure, [next(arrays) if x is None else x for x in self.rest])


def parted(tree: PyTree) -> tuple[Parted, list]:
    """Split off a tree's arrays; NumPy numbers are among them, as their values vary between calls."""
    leaves, structure = jtu.tree_flatten(tree)
    varies = [is_array(x) or isinstance(x, np.generic) for x in leaves]
    rest = tuple(None if array else x for x, array in zip(leaves, varies))
    return Parted(rest, structure), [x for x, array in zip(leaves, varies) if array]


def is_array(x) -> bool:
    """Whether something is an array of JAX or of NumPy."""
    return isinstance(x, jax.Array | np.ndarray)


def shape_of(function: Callable, *args):
    """The shapes that a function returns for JAX or NumPy arrays; nothing is computed."""
    shaped = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, np.ndarray) else x
    return eqx.filter_eval_shape(function, *jtu.tree_map(shaped, args))


def filled_up(count: int) -> int:
    """Round `count` up to one of few numbers: a program of that length serves everything filled up to it.

    This adds at most 7, or an eighth of `count`.
    """
    step = 2 ** max(3, count.bit_length() - 4)
    return math.ceil(count / step) * step
