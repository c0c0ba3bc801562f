"""Programs that Python calls, compiled and kept; facts that are found once; and pytrees in a form to compare.

The programs used last are kept, whatever they compute; one that is called again after it was dropped is compiled again.
(Weak references would not help: a program holds the user's functions that it was compiled for, and with them 1 to 130
MB and up to 500 of the 65,530 memory maps that Linux allows.) Dropping a program frees it, since each has a `jax.jit`
of its own, but for JAX's traces of the functions inside it, 3 MB for each motion; so once in a while JAX's caches are
cleared, and what is used again is compiled again.

A fact follows from hashable arguments, and takes little.

Programs are compiled by a wrapper of our own: equinox's of `jit` takes longer than a short motion or fit. On a CPU the
XLA of jax 0.10 has two ways to write the kernels of fused operations, with its newer emitters and without them. Our
programs are one machine function, or hundreds of small kernels, and run as fast either way; the older way compiles them
in two thirds of the time (processor time of the hoop until it leaves: 6.3 s in place of 9.5; of a first fit: 3.4 s in
place of 5.3). Lanes of a sweep, in arrays, run up to a quarter slower that way, and so are compiled the newer way. The
XLA of jax 0.11 has one way, and no such option. `LAGJAX_PLAIN=1` leaves the option out.
"""

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable
from functools import partial, wraps
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import PyTree

from lagjax.jaxtools.tracing import is_plain

T = TypeVar("T")


class Recent(OrderedDict):
    """Results by key, as many as were used last."""

    def __init__(self, most: int):
        super().__init__()
        self.most, self.dropped, self._one_thread = most, 0, threading.Lock()

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
            # Another thread may have been faster.
            found = self.setdefault(key, found)
            while len(self) > self.most:
                self.popitem(last=False)
                self.dropped += 1
        return found


PROGRAMS, FACTS = Recent(64), Recent(1024)
# So many programs are dropped before JAX's caches are cleared.
CLEAR_AFTER = 256


def program_of(key: Hashable, make: Callable[[], T]) -> T:
    """The program of this key, made if it is not among those used last."""
    found = PROGRAMS.made(key, make)
    if PROGRAMS.dropped >= CLEAR_AFTER:
        PROGRAMS.dropped = 0
        jax.clear_caches()
    return found


def remembered(thing: Any, key: Hashable, find: Callable[[], T]) -> T:
    """`find()`, or its earlier result for this key and anything that means the same as `thing`."""
    return FACTS.made((kinds(thing), key), find)


def once(function: Callable[..., T]) -> Callable[..., T]:
    """The same function, which remembers its results; where its arguments have no hash, it does not.

    >>> print(once(abs)(-2.0))
    2.0
    """

    @wraps(function)
    def found(*args):
        return FACTS.made((function, args), partial(function, *args))

    return found


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


# What stands in place of an array.
ARRAY = ...


class HashablePart(NamedTuple):
    """The part of a tree that is not arrays, which a program of its arrays is compiled for and JAX can carry along."""

    leaves: tuple
    structure: Any

    def combine(self, arrays: Iterable) -> Any:
        """Put the tree together again."""
        arrays = iter(arrays)
        return jtu.tree_unflatten(self.structure, [next(arrays) if x is ARRAY else x for x in self.leaves])

    def in_place(self, arrays: Iterable) -> Any:
        """The tree of the arrays alone, with None in place of the rest."""
        arrays = iter(arrays)
        return jtu.tree_unflatten(self.structure, [next(arrays) if x is ARRAY else None for x in self.leaves])

    def __reduce__(self):
        # Equinox puts a marker into the structure of its modules and recognises it by identity. A copied structure
        # would contain a copy of the marker, so the tree itself is copied instead.
        return _part_of, (jtu.tree_unflatten(self.structure, self.leaves),)


def _part_of(tree: PyTree) -> HashablePart:
    leaves, structure = jtu.tree_flatten(tree)
    return HashablePart(tuple(leaves), structure)


def hashable_partition(tree: PyTree) -> tuple[list, HashablePart]:
    """Split a tree into its arrays and the rest, as `eqx.partition` does, but in a form that can be a key.

    NumPy numbers are among the arrays, as their values vary between calls.
    """
    leaves, structure = jtu.tree_flatten(tree)
    is_part = [is_array(x) or isinstance(x, np.generic) for x in leaves]
    rest = tuple(ARRAY if array else x for x, array in zip(leaves, is_part))
    return [x for x, array in zip(leaves, is_part) if array], HashablePart(rest, structure)


def is_array(x) -> bool:
    """Whether something is an array of JAX or of NumPy."""
    return isinstance(x, jax.Array | np.ndarray)


def varies(x) -> bool:
    """Whether something is an array, or stands for one in a program that is only traced."""
    return is_array(x) or isinstance(x, jax.ShapeDtypeStruct)


def shape_of(function: Callable, *args):
    """The shapes that a function returns for JAX or NumPy arrays; nothing is computed."""
    return eqx.filter_eval_shape(
        function,
        *jtu.tree_map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if isinstance(x, np.ndarray) else x, args),
    )


def filled_up(count: int) -> int:
    """Round `count` up to one of few numbers: a program of that length serves everything filled up to it.

    This adds at most 7, or an eighth of `count`.
    """
    step = 2 ** max(3, count.bit_length() - 4)
    return math.ceil(count / step) * step


WITHOUT_EMITTERS = {"xla_cpu_use_fusion_emitters": False}


@once
def compiler_options() -> dict | None:
    """Options for `jax.jit` of a top-level program; None if XLA does not know them, which a tiny program tests once."""
    if is_plain() or jax.default_backend() != "cpu":
        return None
    return WITHOUT_EMITTERS if are_known(WITHOUT_EMITTERS) else None


def are_known(options: dict) -> bool:
    """Whether this XLA has these options."""
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
