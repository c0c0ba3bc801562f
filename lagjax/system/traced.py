"""What a function of the user's computes: its jaxpr.

At each call from Python, each of the user's functions is traced on shapes, and a compiled program is used again only
for the same jaxprs; arrays that a function reads from outside, however it comes by them, are arguments of the program.
A function that names nothing from outside but library modules, builtins and functions like itself is traced once.

So no value of the user's is ever read but by running his function, and no object stands in for another. Small arrays
that a function reads are part of its jaxpr, as single numbers are. Tracing takes about half a millisecond.
"""

import dataclasses
import dis
import sys
import types
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer, eval_jaxpr
from jaxtyping import Array, PyTree

from lagjax.jaxtools import (
    FACTS,
    Itself,
    Meaning,
    callbacks_in_turn,
    full_products,
    is_array,
    meaning_of,
    needed,
    once,
    rules_of,
    with_own_constants,
    without_repeats,
)

# Arrays of up to so many numbers, or of so many whole numbers (indices), that are read from outside are part of the
# jaxpr: the equations can then leave out what is multiplied by their zeros.
SMALL, SMALL_INDICES = 1024, 4096
# What a function may name and still be traced once: these libraries, but nothing in them that reads the outside.
LIBRARIES = {"jax", "numpy", "math", "cmath", "operator", "functools", "itertools", "equinox"}
CHANGING = {
    "random", "load", "loadtxt", "genfromtxt", "fromfile", "memmap", "open", "input", "eval", "exec", "globals",
    "locals", "vars", "__import__", "modules", "environ", "import_module", "__globals__", "__dict__", "config",
}  # fmt: skip
OPENS_OUTSIDE = {dis.opmap[name] for name in ("IMPORT_NAME", "STORE_GLOBAL", "DELETE_GLOBAL")}
CONTAINERS = (dict, list, tuple, type(None))
NUMBERS = (bool, int, float, complex, np.generic)
LIKE_ARRAYS = (float, np.generic, jax.ShapeDtypeStruct)
MISSING = object()


class TracedProgram:
    """A function traced on arguments of one kind; equal to any with the same jaxpr for arguments of the same kind.

    `function`: the user's. `takes`: the names of its arguments; `like`: these, with shapes for arrays, as also in
    `value`, what it returned.
    """

    def __init__(self, function: Callable, takes: tuple[str, ...], args: tuple):
        function = function.function if isinstance(function, Traced) else function
        self.function, self.takes, self.signature = function, takes, signature_of(args)
        self.like = _shaped(args)
        own, self._rest = eqx.partition(function, is_array)
        returned, structures = [], []

        def of_arrays(own, arrays: Sequence):
            found = eqx.combine(own, self._rest)(*_with_arrays(args, arrays))
            returned.append(_shaped(found))
            structures.append(jtu.tree_structure(found))
            return [x for x in jtu.tree_leaves(found) if is_array(x) or isinstance(x, NUMBERS)]

        arrays = arrays_of(args)
        with full_products():
            closed = with_own_constants(jax.make_jaxpr(of_arrays)(own, arrays))
            closed = callbacks_in_turn(closed)
            # What a function computes and does not use would be traced again with each of its derivatives.
            closed = closed.replace(jaxpr=closed.jaxpr.replace(eqns=needed(closed.jaxpr)))
            rules = rules_of(of_arrays, closed, own, arrays, user=function)
        self.value, self._structure, self.jaxpr = returned[0], structures[0], closed.jaxpr
        # A user may write to a NumPy array afterwards.
        constants = [np.array(x) if isinstance(x, np.ndarray) else x for x in closed.consts]
        self._fixed = [x if _is_small(x) else None for x in constants]
        self.arrays = (*(x for x in constants if not _is_small(x)), *jtu.tree_leaves(own))
        small = tuple((str(x.dtype), x.shape, np.asarray(x).tobytes()) for x in self._fixed if x is not None)
        self._meaning = Meaning((self.signature.kind, takes, self._structure, meaning_of(self.jaxpr), small, rules))

    def __hash__(self):
        return hash(self._meaning)

    def __eq__(self, other):
        return self is other or isinstance(other, TracedProgram) and self._meaning == other._meaning

    def __call__(self, arrays: Sequence, args: tuple):
        """The function's result, given the arrays that it reads."""
        given = iter(arrays)
        constants = [next(given) if x is None else x for x in self._fixed]
        own = list(given)
        if signature_of(args) != self.signature:
            return self.function_with(arrays)(*args)
        results = eval_jaxpr(without_repeats(self.jaxpr), constants, *own, *arrays_of(args))
        return jtu.tree_unflatten(self._structure, results)

    @property
    def constants(self) -> list[np.ndarray]:
        """The arrays in the program; those that it reads from outside are not among them."""
        return [x for x in self._fixed if x is not None]

    def function_with(self, arrays: Sequence) -> Callable:
        """The user's function; if it is a module, with its own ones among these arrays."""
        structure = jtu.tree_structure(eqx.filter(self.function, is_array))
        own = arrays[len(arrays) - structure.num_leaves :]
        return eqx.combine(jtu.tree_unflatten(structure, own), self._rest)


class Traced(eqx.Module):
    """A user's function as the library calls it: its program, and the arrays that it reads from outside."""

    arrays: tuple[Array, ...]
    program: TracedProgram = eqx.field(static=True)

    def __call__(self, *args):
        return self.program(self.arrays, args)

    @property
    def takes(self) -> tuple[str, ...]:
        return self.program.takes

    @property
    def function(self) -> Callable:
        """The user's function."""
        return self.program.function_with(self.arrays) if self.arrays else self.program.function

    @property
    def __name__(self) -> str:
        return getattr(self.program.function, "__name__", type(self.program.function).__name__)

    def __reduce__(self):
        return _traced_again, (self.function, self.takes, self.program.like)


def _traced_again(function: Callable, takes: tuple[str, ...], like):
    return _of_program(TracedProgram(function, takes, like))


def traced(function: Callable, args: tuple, make: Callable[[], TracedProgram]) -> Traced:
    """A function of the user's as its jaxpr for arguments like `args`, with the program that `make` traces.

    What has been traced for such arguments already, as the functions of a trajectory's system, stays as it is.
    """
    signature = signature_of(args)
    if isinstance(function, Traced) and function.program.signature == signature:
        return function
    names = names_outside(function) if signature.is_plain(args) else None

    def new() -> Traced:
        return _of_program(make())

    return new() if names is None else FACTS.made((names, signature), new)


def _of_program(program):
    return Traced(program.arrays, program)


class Signature:
    """The kind of some arguments: their structure, the shapes and dtypes of arrays, and all other leaves."""

    def __init__(self, kind):
        self.kind = kind

    def __hash__(self):
        return hash(self.kind)

    def __eq__(self, other):
        return self.kind == other.kind

    def is_plain(self, args: tuple) -> bool:
        """Whether arguments of this kind bring along no code of the user's."""
        return FACTS.made((_is_plain, self.kind), lambda: all(_is_plain(x) for x in args))


def signature_of(args: tuple) -> Signature:
    """The kind of some arguments; a Python float counts as an array."""
    leaves, structure = jtu.tree_flatten(args)
    return Signature((structure, *((x.shape, x.dtype) if is_array(x) else _kind(x) for x in leaves)))


def _kind(x: Array):
    if isinstance(x, LIKE_ARRAYS):
        return np.shape(x), jax.dtypes.canonicalize_dtype(getattr(x, "dtype", np.float64))
    return type(x), x


def _shaped(tree: PyTree):
    return jtu.tree_map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if is_array(x) else x, tree)


def _varies(x: Array):
    return is_array(x) or isinstance(x, LIKE_ARRAYS)


def arrays_of(args: tuple) -> list:
    """The arrays among some arguments, and their Python floats."""
    return [x for x in jtu.tree_leaves(args) if _varies(x)]


def _with_arrays(args: tuple, arrays):
    leaves, structure = jtu.tree_flatten(args)
    arrays = iter(arrays)
    return jtu.tree_unflatten(structure, [next(arrays) if _varies(x) else x for x in leaves])


def _is_small(x: Array):
    if isinstance(x, Tracer) or jnp.issubdtype(x.dtype, jax.dtypes.extended):
        return False
    return np.size(x) <= (SMALL if jnp.issubdtype(x.dtype, jnp.inexact) else SMALL_INDICES)


def names_outside(function: Callable) -> tuple | None:
    """A function, its code and what both name from outside: library modules, builtins and functions like itself.

    None where it may read anything else. No value is looked at.
    """
    found: list = []
    return tuple(found) if _finds_names(function, found) else None


def _finds_names(function: Callable, found) -> bool:
    if type(function) is not types.FunctionType:
        return False
    if any(x is function for x in found):
        return True
    names, opens_outside = _names_of(function.__code__)
    if function.__closure__ or function.__defaults__ or function.__kwdefaults__ or function.__dict__ or opens_outside:
        return False
    found += [function, function.__code__]
    for name in names:
        x = function.__globals__.get(name, MISSING)
        if x is not MISSING and not _is_of_library(x) and not _finds_names(x, found):
            return False
        found.append(Itself(x))
    return True


@once
def _names_of(code: types.CodeType) -> tuple[tuple[str, ...], bool]:
    """The names in a function's code, those of attributes included, and whether it may reach what has no name there."""
    names, opens = set(code.co_names), bool(OPENS_OUTSIDE.intersection(code.co_code[::2]))
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            inside, opens_inside = _names_of(constant)
            names.update(inside)
            opens |= opens_inside
    return tuple(sorted(names)), opens or not CHANGING.isdisjoint(names)


def _is_of_library(x: Array) -> bool:
    if isinstance(x, types.ModuleType):
        return _is_library(x.__name__) and sys.modules.get(x.__name__) is x
    module = getattr(x, "__module__", None) or ""
    if not callable(x) or not isinstance(module, str) or not _is_library(module):
        return False
    return getattr(sys.modules.get(module), getattr(x, "__name__", ""), None) is x


def _is_library(name: str) -> bool:
    return name.partition(".")[0] in LIBRARIES


def _is_plain(x: Array) -> bool:
    """Whether an argument is numbers and text in dictionaries, lists, tuples and modules of the libraries."""
    if type(x) in CONTAINERS:
        return all(map(_is_plain, x.values() if isinstance(x, dict) else x or ()))
    if is_array(x) or isinstance(x, np.generic) or type(x) in (bool, int, float, complex, str):
        return True
    if isinstance(x, eqx.Module) and _is_library(type(x).__module__):
        return all(_is_plain(getattr(x, field.name, None)) for field in dataclasses.fields(x))
    return _is_of_library(x)
