"""Errors inside the user's functions in the user's names and lines, and warnings that show the user's line.

An error that is not recognised is raised unchanged. Each explanation is chained to the original error, whose traceback
ends at the user's line.

Known errors inside the user's functions: what happened, the usual cause and the fix of each.

Each of `MISTAKES` recognises one kind of error, and returns None for any other. What happened completes a sentence
whose subject is the function, `L(t, q, v, params) ...`.
"""

import difflib
import inspect
import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from lagjax.jaxtools import HAPPENED

# The code between the user's line and here: warnings skip it.
PACKAGES = tuple(str(Path(str(module.__file__)).parent) + os.sep for module in (jax, eqx, diffrax))
BETWEEN = (*PACKAGES, __file__.rsplit("system", 1)[0])


def warn(words: str, category: type[Warning]) -> None:
    """Warn at the innermost line outside this library and the libraries that it calls."""
    HAPPENED["a warning was given"] += 1
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(BETWEEN):
        frame = frame.f_back
    module, registry = frame.f_globals.get("__name__", "?"), frame.f_globals.setdefault("__warningregistry__", {})
    warnings.warn_explicit(words, category, frame.f_code.co_filename, frame.f_lineno, module, registry)


Words = tuple[str, str, str]


class Failure(NamedTuple):
    """An error, its message, the user's line, the arguments by name, those that the line indexes by key, and the
    user's names for the arguments."""

    error: Exception
    message: str
    line: str
    given: Mapping[str, Any]
    indexed: Mapping[str, list[str]]
    names: list[str]


def what_is(x: Any) -> str:
    """What an argument is, for a message."""
    if isinstance(x, Mapping):
        return "a dict"
    if isinstance(x, list | tuple):
        return f"a {type(x).__name__}"
    if x is None:
        return "None"
    return "a number" if jnp.ndim(x) == 0 else f"an array of shape {jnp.shape(x)}"


def _foreign_library(f: Failure) -> Words | None:
    """NumPy, SciPy or SymPy applied to a value that JAX traces."""
    if any("/sympy/" in frame.filename.replace("\\", "/") for frame in traceback.extract_tb(f.error.__traceback__)):
        return (
            "hands a coordinate, velocity or parameter to SymPy, whose functions are for symbols",
            "a function of SymPy in place of JAX's",
            "import jax.numpy as jnp, and jnp.cos in place of sympy.cos",
        )
    if not isinstance(f.error, jax.errors.TracerArrayConversionError):
        return None
    what = "hands a coordinate, velocity or parameter to NumPy, and NumPy cannot be differentiated"
    if used := re.search(r"\b(?:scipy|special|sp)\.([\w.]+)", f.line):
        name = used[1].removeprefix("special.")
        return what, "SciPy, which computes with NumPy", f"jax.scipy.special.{name}, where it exists"
    used = re.search(r"\b(?:np|numpy)\.([\w.]+)", f.line)
    name = used[1] if used else "cos"
    return what, "np in place of jnp", f"import jax.numpy as jnp, and jnp.{name} in place of np.{name}"


def _branches_on_value(f: Failure) -> Words | None:
    """Python's `if` on a value that JAX traces, or entries picked by a condition on it."""
    if isinstance(f.error, jax.errors.NonConcreteBooleanIndexError):
        return (
            "picks entries by a condition, and how many there are is not known while JAX traces",
            "x[x > 0]",
            "jnp.where(x > 0, x, 0.0)",
        )
    if not isinstance(f.error, jax.errors.TracerBoolConversionError):
        return None
    return (
        "branches on the value of a coordinate, velocity or parameter, which is not known while JAX traces",
        "if, and, or, not, min or max",
        "jnp.where(condition, a, b), jnp.minimum(a, b), or jnp.maximum(a, b)",
    )


def _count_or_index(f: Failure) -> Words | None:
    """A count or an index that is not a Python integer."""
    as_float = re.search("be converted to a scalar index|be interpreted as an integer|Shapes must be 1D", f.message)
    if not as_float and not isinstance(f.error, jax.errors.TracerIntegerConversionError):
        return None
    return (
        "uses a number as a count or an index that is "
        + ("not a whole number" if as_float else "not known while JAX traces"),
        "range(params[...]), or a list indexed, with " + ("a float" if as_float else "an array of whole numbers"),
        'a Python integer, params = {..., "n": 3}; or x[i] of an array x in place of a list',
    )


def _python_number(f: Failure) -> Words | None:
    """A Python number made from a value that JAX traces."""
    if not isinstance(f.error, jax.errors.ConcretizationTypeError):
        return None
    used = re.search(r"\bmath\.(\w+)", f.line)
    return (
        "makes a Python number from a coordinate, velocity or parameter, and such a number cannot be differentiated",
        "a function of the module math, float(...), int(...), or range(...)",
        f"jnp.{used[1]} in place of math.{used[1]}" if used else "leave out float(...) and int(...)",
    )


def _no_params(f: Failure) -> Words | None:
    """Parameters that were not given."""
    if "params" not in f.given or not ("NoneType" in f.message and f.given["params"] is None):
        return None
    return (
        "uses params, and none were given",
        "params left out of the call, where they follow q and v",
        'lj.integrate(system, q0, v0, {"m": 1.0, "g": 9.81}, ts=ts)',
    )


def _power(f: Failure) -> Words | None:
    """`v^2`."""
    if not ("^" in f.line and re.search(r"\bxor\b|operand type\(s\) for \^", f.message)):
        return None
    return "uses ^, which is not a power in Python", "v^2 as in a formula on paper", "v**2"


def _attribute(f: Failure) -> Words | None:
    """A name looked up with a dot."""
    missing = re.search(r"'?(dict|list|tuple|\w*Tracer|ArrayImpl)'?(?: object)? has no attribute '?(\w+)", f.message)
    if missing is None:
        return None
    owner, name = missing.groups()
    used = re.search(rf"(\w+)\.{name}\b", f.line)
    variable = used[1] if used else "q"
    if owner == "dict":
        return (
            f"asks for .{name} of a dict",
            "names are looked up in brackets",
            f'{variable}["{name}"] in place of {variable}.{name}',
        )
    if owner in ("list", "tuple"):
        return (
            f"asks for .{name} of a {owner}",
            f"an initial state that is a {owner} of numbers",
            "make it an array, q0 = jnp.array([0.1, 0.2])",
        )
    return (
        f"asks for .{name} of an array, which does not have it",
        "a function written for a dict, or a method that arrays do not have",
        f'q0 = {{"{name}": 0.1}} and {variable}["{name}"]',
    )


def _whole_dict(f: Failure) -> Words | None:
    """Arithmetic with a dict, or with the names in it."""
    dicts = [name for name, x in f.given.items() if isinstance(x, Mapping) and x]
    if not dicts or not re.search(r"operand type|requires ndarray|not a valid JAX type|must be real number", f.message):
        return None
    if re.search(r"['.]dict'", f.message):
        first = next(iter(f.given[dicts[-1]]))
        return (
            "calculates with a dict",
            "a whole dict in place of one of its entries",
            f"look a name up in it, as in {dicts[-1]}[{first!r}]",
        )
    of_state = [name for name in dicts if name in ("q", "v")]
    if "'str'" in f.message and of_state and not list(_leaves_not_numbers(f.given.get("params"))):
        keys = list(f.given[of_state[0]])
        return (
            "calculates with text",
            f"{of_state[0]} unpacked, as in a, b = {of_state[0]}, which gives the names in a dict",
            ", ".join(f"{of_state[0]}[{key!r}]" for key in keys),
        )
    return None


def _no_number(f: Failure) -> Words | None:
    """A parameter that is text, or None."""
    wrong = [name for name, kind in _leaves_not_numbers(f.given.get("params")) if re.search(kind, f.message)]
    if not wrong:
        return None
    return (
        f"calculates with '{wrong[0]}' of params, which is not a number",
        "a number read as text, or not filled in yet",
        f'params = {{..., "{wrong[0]}": 1.0}}',
    )


def _leaves_not_numbers(tree: PyTree) -> Iterator[tuple[str, str]]:
    """The leaves that are None or text, by name, with a pattern for what an error says of such a leaf."""
    for path, x in jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: x is None):
        if path and (x is None or isinstance(x, str)):
            pattern = "NoneType" if x is None else "str|sequence|scalar index"
            yield jax.tree_util.keystr(path, simple=True, separator="."), pattern


def _no_names(f: Failure) -> Words | None:
    """A name looked up where there are none."""
    asked = re.search(r"string indexing; got idx='(.*)'", f.message)
    of_a_list = re.match(r"(?:list|tuple) indices must be integers or slices, not str", f.message)
    if not asked and not of_a_list:
        return None
    without_names = {key: [x for x in names if not isinstance(f.given[x], Mapping)] for key, names in f.indexed.items()}
    key = asked[1] if asked else next((key for key, names in without_names.items() if names), "")
    name = next(iter(without_names.get(key, ())), None)
    owner = (
        "an array"
        if name in (None, "q", "v") and asked
        else f"{name}, which is {what_is(f.given[name])}"
        if name
        else "a list"
    )
    what = f"asks for '{key}' of {owner}" + (", which has no names" if owner == "an array" else "")
    if name == "params":
        return what, "parameters without names, or arguments in another order", f'params = {{"{key}": 1.0, ...}}'
    if name == "t":
        order = ", ".join(f.given)
        return what, "the arguments of the function in another order", f"def f({order})"
    return (
        what,
        "an initial state that is a number or an array, with a function written for a dict",
        f'q0 = {{"{key}": 0.1}} and v0 = {{"{key}": 0.0}}',
    )


def _unpacked(f: Failure) -> Words | None:
    """More or fewer entries taken than there are."""
    if re.search(r"iteration over a 0-d|Too many indices: .*0-dimensional|cannot unpack non-iterable", f.message):
        return (
            "takes entries of a single number",
            "an initial state that is a number, with a function written for an array",
            "q0 = jnp.array([0.1, 0.2]); or q in place of q[0]",
        )
    mentioned = any(re.search(rf"\b{name}\b", f.line) for name in f.names)
    if mentioned and re.search(r"values to unpack|(?:list|tuple) index out of range", f.message):
        size = "; ".join(f"{name} is {_length(f.given[name])}" for name in ("q", "v") if name in f.given)
        return (
            f"takes more or fewer entries than there are{': ' + size if size else ''}",
            "an initial state with more or fewer coordinates than the function is written for",
            "one entry in q0 and in v0 for each that is taken",
        )
    return None


def _length(x: Array):
    return what_is(x) if not isinstance(x, list | tuple) else f"{what_is(x)} of {len(x)}"


def _list(f: Failure) -> Words | None:
    """Arithmetic with a list."""
    kind = re.search(r"'(list|tuple)'", f.message)
    owner = kind[1] if kind else "list" if "can't multiply sequence" in f.message else None
    if owner is None:
        return None
    return (
        f"calculates with a {owner}",
        f"an initial state or a parameter that is a {owner} of numbers, as q0 = [0.1, 0.2]",
        "make it an array, q0 = jnp.array([0.1, 0.2])",
    )


def _assigns(f: Failure) -> Words | None:
    """`x[i] = y`."""
    if "arrays are immutable" not in f.message:
        return None
    return "changes an entry of an array, and JAX arrays cannot be changed", "x[i] = y", "x = x.at[i].set(y)"


def _shapes(f: Failure) -> Words | None:
    """Arrays whose shapes do not match."""
    if not re.search("incompatible shapes|contracting dimensions|rank_promotion|could not be broadcast", f.message):
        return None
    found = re.findall(r"\(\d*(?:, ?\d*)*\)", f.message)
    combined = " and ".join(found[:2])
    size = "; ".join(f"{name} is {what_is(f.given[name])}" for name in ("q", "v") if name in f.given)
    return (
        f"combines arrays of the shapes {combined}" + (f", where {size}" if size else ""),
        "a parameter or a matrix for another number of coordinates",
        "matching shapes, as (n, n) @ (n,)",
    )


# In this order: the first one that recognises an error explains it.
MISTAKES: tuple[Callable[[Failure], Words | None], ...] = (
    _foreign_library, _branches_on_value, _python_number, _no_params, _no_number, _count_or_index, _power, _attribute,
    _whole_dict, _no_names, _unpacked, _list, _assigns, _shapes,
)  # fmt: skip


# The usual names of arguments: where two of them are swapped, the user means another order, not other names.
NAMES = {"t", "q", "v", "params", "multipliers"}


class Call(NamedTuple):
    """A user's function with its role, the arguments that it gets, and what it belongs to."""

    role: str
    function: Callable
    takes: tuple[str, ...]
    owner: str = ""

    def __str__(self):
        return f"{self.role}({', '.join(self.takes)}){self.owner}"


def check_arguments(call: Call, usual_cause: str):
    """Raise if the function cannot take so many arguments, or takes them in another order."""
    try:
        signature = inspect.signature(call.function)
    except ValueError:
        return  # A built-in without a signature.
    name = getattr(call.function, "__name__", "f")
    name = "f" if name == "<lambda>" else name
    try:
        signature.bind(*call.takes)
    except TypeError as error:
        count = f"{len(call.takes)} argument{'s' * (len(call.takes) > 1)}"
        raise TypeError(
            f"{call} is called with {count}, but the function is {name}{signature}.\n"
            f"Usual cause: {usual_cause}.\n"
            f"Fix: def {name}({', '.join(call.takes)})."
        ) from error
    places = list(zip(signature.parameters, call.takes))
    if len([mine for mine, ours in places if mine != ours and mine in call.takes and mine in NAMES]) > 1:
        raise TypeError(
            f"{call} gets its arguments in this order, but the function is {name}{signature}.\n"
            "Usual cause: the order of another library.\n"
            f"Fix: def {name}({', '.join(call.takes)})."
        )


@contextmanager
def in_words(call: Call, given: Mapping[str, Any]) -> Iterator[None]:
    """Explain an error raised inside, while the function is called with the `given` arguments."""
    try:
        yield
    except KeyError as error:
        raise ValueError(_missing_key_message(call, given, error)) from error
    except (TypeError, AttributeError, IndexError, ValueError, NotImplementedError) as error:
        message = _message(call, given, error)
        if message is None:
            raise
        raise TypeError(message) from error


def _missing_key_message(call, given, error: BaseException):
    """The message for a missing key: where it was looked up, which keys exist, and which one may have been meant."""
    key, line = error.args[0], _line(call, error)
    existing = {name: list(x) for name, x in given.items() if isinstance(x, Mapping) and name in call.takes}
    lookup = re.search(rf"(\w+)\[[\"']?{re.escape(str(key))}[\"']?\]", line)
    parameters = _parameters(call)
    if lookup and lookup[1] in parameters[: len(call.takes)]:
        source = call.takes[parameters.index(lookup[1])]
        existing = {source: existing[source]} if source in existing else existing
    listing = "; ".join(f"{name} has {', '.join(map(repr, keys))}" for name, keys in existing.items())
    meant = difflib.get_close_matches(str(key), [str(k) for keys in existing.values() for k in keys], 1)
    cause = "a name written in two ways, or left out"
    if "point" in existing:
        fix = f'axes = {{..., "{key}": jnp.linspace(0.0, 1.0, 11)}}'
    elif not isinstance(key, str) and any(existing.values()):
        source, keys = next((name, keys) for name, keys in existing.items() if keys)
        cause, fix = "a function that is written for an array", f"look a name up, as in {source}[{keys[0]!r}]"
    elif set(existing) & {"q", "v"} and "params" not in existing:
        fix = f'q0 = {{"{key}": 0.1}} and v0 = {{"{key}": 0.0}}'
    else:
        fix = f'params = {{..., "{key}": 1.0}}'
    return (
        f"{call} asks for {key!r}, and there is none{': ' + listing if listing else ''}.{_quoted(line)}\n"
        f"Usual cause: {cause}.\n"
        f"Fix: {fix}" + (f", or write '{meant[0]}'." if meant else ".")
    )


def _message(call, given, error: BaseException):
    """The explanation of an error; None if it is not recognised."""
    if "\nFix: " in str(error):
        return None  # It is explained already.
    line = _line(call, error)
    known = {name: x for name, x in given.items() if name in call.takes}
    failure = Failure(error, str(error), line, known, _indexed_arguments(call, line), _parameters(call))
    for explain in MISTAKES:
        if (found := explain(failure)) is not None:
            what, cause, fix = found
            return f"{call} {what}.{_quoted(line)}\nUsual cause: {cause}.\nFix: {fix}."
    return None


def _indexed_arguments(call, line: str):
    """The arguments that the line indexes in brackets, by key: {"theta": ["q", "v"]}."""
    ours = dict(zip(_parameters(call), call.takes))
    found = {}
    for name, key in re.findall(r"\b(\w+)\[\s*[\"']?([\w ]+)[\"']?\s*\]", line):
        if name in ours:
            found.setdefault(key, []).append(ours[name])
    return found


def _parameters(call):
    """The user's names of the arguments; none for a built-in without a signature."""
    try:
        return list(inspect.signature(call.function).parameters)
    except ValueError:
        return []


def _line(call, error: BaseException):
    """The line of the user's file where the error happened, or ""."""
    code = getattr(inspect.unwrap(call.function), "__code__", None)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if code and f.filename == code.co_filename]
    return (frames[-1].line or "") if frames else ""


def _quoted(line: str):
    return f"\n    {line.strip()}" if line else ""
