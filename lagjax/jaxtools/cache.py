"""Facts about systems, remembered; and pytrees in a form to compare."""

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

T = TypeVar("T")


class Recent(OrderedDict):
    """Results by key, as many as were used last."""

    def __init__(self, most: int):
        super().__init__()
        self.most, self._one_thread = most, threading.Lock()

    def made(self, key: Hashable, make: Callable[[], T]) -> T:
        """The result of this key, made if there is none yet; made each time if the key cannot be compared."""
        try:
            with self._one_thread:
                if key in self:
                    self.move_to_end(key)
                    return self[key]
        except TypeError:
            return make()
        found = make()
        with self._one_thread:
            self[key] = found
            while len(self) > self.most:
                self.popitem(last=False)
        return found


_facts = Recent(1024)


def remembered(thing: Any, key: Hashable, find: Callable[[], T]) -> T:
    """`find()`, or its earlier result for this key and anything that means the same as `thing`."""
    return _facts.made((kinds(thing), key), find)


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


def varies(x) -> bool:
    """Whether something is an array, or stands for one in a program that is only traced."""
    return is_array(x) or isinstance(x, jax.ShapeDtypeStruct)


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
