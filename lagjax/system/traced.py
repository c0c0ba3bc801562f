"""What a function of the user's computes: its arguments and its jaxpr, and several functions of one kind in lanes.

At each call from Python, each of the user's functions is traced on shapes, and a compiled program is used again only
for the same jaxprs; arrays that a function reads from outside, however it comes by them, are arguments of the program.
A function that names nothing from outside but library modules, builtins, numbers and functions like itself is traced
once: with another number of that name it is another function. So are joints, energies and loads of bodies that hold
numbers and such functions.

So no value of the user's is ever read but by running his function, and no object stands in for another. Small arrays
that a function reads are part of its jaxpr, as single numbers are. Tracing takes about half a millisecond.

*In lanes* what several functions compute alike is compiled once. A mechanism has many joints of few kinds: their
programs differ in the numbers that they hold (places, axes) and in the entries of the state that they read. `opened`
makes both operands of the program. Functions whose opened programs have the same meaning are of one kind, and `vectors`
computes all of a kind by one program, with an axis for the functions.
"""

import dataclasses
import dis
import inspect
import sys
import types
from collections import defaultdict
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import Tracer, eval_jaxpr
from jaxtyping import Array, Float, PyTree

from lagjax.jaxtools import (
    ARITHMETIC,
    FACTS,
    HAPPENED,
    ClosedJaxpr,
    Itself,
    Jaxpr,
    Literal,
    Meaning,
    bodies,
    callbacks_in_turn,
    content_of,
    equations,
    evaluate,
    full_products,
    is_array,
    is_float,
    length,
    meaning_of,
    needed,
    once,
    once_per_program,
    rules_of,
    with_own_constants,
    without_repeats,
    written,
)

OF_STATE, OF_POSITION = ("t", "q", "v", "params"), ("t", "q", "params")
WITH_MULTIPLIERS = ("t", "q", "v", "multipliers", "params")
WITH_FORCE = ("t", "q", "v", "force", "params")


def takes_of(function: Callable) -> tuple[str, ...]:
    """The names of a function's arguments: the state, and the multipliers if its signature has room for them."""
    declared = getattr(function, "takes", None)
    if declared is not None:
        return declared
    try:
        inspect.signature(function).bind(*WITH_MULTIPLIERS)
        with_multipliers = not _binds(function, OF_STATE)
    except (TypeError, ValueError):
        with_multipliers = False
    return WITH_MULTIPLIERS if with_multipliers else OF_STATE


def _binds(function: Callable, arguments):
    try:
        inspect.signature(function).bind(*arguments)
    except TypeError:
        return False
    return True


# Arrays of up to so many numbers, or of so many whole numbers (indices), that are read from outside are part of the
# jaxpr: the equations can then leave out what is multiplied by their zeros.
SMALL, SMALL_INDICES = 1024, 4096
# What a function may name and still be traced once: these libraries, but nothing in them that reads the outside.
LIBRARIES = {"jax", "numpy", "math", "cmath", "operator", "functools", "itertools", "equinox", "lagjax"}
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
        self.meaning = Meaning((self.signature.kind, takes, self._structure, meaning_of(self.jaxpr), small, rules))

    def __hash__(self):
        return hash(self.meaning)

    def __eq__(self, other):
        return self is other or isinstance(other, TracedProgram) and self.meaning == other.meaning

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
        HAPPENED["a function was called that is not a program"] += 1
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
        HAPPENED["a function was called that is not a program"] += 1
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
    """A function, its code and what both name from outside: libraries, builtins, numbers and functions like itself.

    None where it may read anything else. No value is looked at: a number is known by being the very same object. An
    object of lagjax's that cannot be changed, as a joint or the energy of bodies, is a function with what it holds:
    numbers, text, functions and other such objects.
    """
    found: list = []
    return tuple(found) if _finds_names(function, found) else None


def _finds_held(x: Any, found: list) -> bool:
    """The same for what an object of lagjax's holds."""
    if x is None or type(x) in (bool, int, float, complex, str):
        found.append((type(x), repr(x)))
        return True
    if type(x) is tuple or isinstance(x, tuple) and _is_own(type(x)):
        found.append((type(x), len(x)))
        return all(_finds_held(part, found) for part in x)
    if isinstance(x, types.FunctionType) and _is_own(x) and _is_at_its_place(x):
        found.append(Itself(x))
        return True
    return _finds_names(x, found)


def _is_own(x: Any) -> bool:
    return x.__module__.partition(".")[0] == __name__.partition(".")[0]


def _is_at_its_place(x: Any) -> bool:
    return getattr(sys.modules.get(x.__module__), x.__name__, None) is x


def _finds_names(function: Callable, found) -> bool:
    if isinstance(function, types.MethodType):
        found.append(function.__func__)
        is_method = getattr(type(function.__self__), function.__name__, None) is function.__func__
        return is_method and _finds_held(function.__self__, found)
    if type(function) is not types.FunctionType:
        of = type(function)
        if not (_is_own(of) and getattr(getattr(of, "__dataclass_params__", None), "frozen", False)):
            return False
        found.append(of)
        return all(_finds_held(getattr(function, field.name), found) for field in dataclasses.fields(of))
    if any(x is function for x in found):
        return True
    names, opens_outside = _names_of(function.__code__)
    if function.__defaults__ or function.__kwdefaults__ or function.__dict__ or opens_outside:
        return False
    try:
        enclosed = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError:
        # One that is not filled yet.
        return False
    found += [function, function.__code__]
    for x in (*(function.__globals__.get(name, MISSING) for name in names), *enclosed):
        if x is not MISSING and type(x) not in NUMBERS and not _is_of_library(x) and not _finds_names(x, found):
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
    if type(x) in CONTAINERS or isinstance(x, tuple) and _is_own(type(x)):
        return all(map(_is_plain, x.values() if isinstance(x, dict) else x or ()))
    if is_array(x) or isinstance(x, np.generic) or type(x) in (bool, int, float, complex, str):
        return True
    if isinstance(x, eqx.Module) and _is_library(type(x).__module__):
        return all(_is_plain(getattr(x, field.name, None)) for field in dataclasses.fields(x))
    return _is_of_library(x) or _is_in_library(x)


def _is_in_library(x: Any) -> bool:
    """Whether it is a function without a name in a library, such as the activation of a network's last layer."""
    module = getattr(x, "__module__", None) or ""
    if type(x) is not types.FunctionType or not _is_library(module) or module not in sys.modules:
        return False
    return x.__globals__ is vars(sys.modules[module]) and _finds_names(x, [])


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
        kind = _in_common(function, args)
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


def _in_common(function: Callable, args: tuple):
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
