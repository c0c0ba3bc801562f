"""Errors inside of a function of the user's that are known: of each what happened, its usual cause and its fix.

Each of `MISTAKES` looks at one kind, and returns None where it is another. What happened completes a sentence whose
subject is the function, `L(t, q, v, params) ...`.
"""

import re
import traceback
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

Words = tuple[str, str, str]


class Failure(NamedTuple):
    """An error, its text, the user's line, the arguments by name, of which ones the line takes which entry, and what
    the user calls them."""

    error: Exception
    said: str
    line: str
    given: Mapping[str, Any]
    taken: Mapping[str, list[str]]
    names: list[str]


def what_is(x: Any) -> str:
    """What an argument is, to who reads a message."""
    if isinstance(x, Mapping):
        return "a dict"
    if isinstance(x, list | tuple):
        return f"a {type(x).__name__}"
    if x is None:
        return "None"
    return "a number" if jnp.ndim(x) == 0 else f"an array of shape {jnp.shape(x)}"


def _foreign_library(f: Failure) -> Words | None:
    """NumPy, SciPy or SymPy on what JAX traces."""
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


def _decides(f: Failure) -> Words | None:
    """Python's `if` on what JAX traces, or an array of those that fulfil a condition."""
    if isinstance(f.error, jax.errors.NonConcreteBooleanIndexError):
        return (
            "picks entries by a condition, and how many there are is not known while JAX traces",
            "x[x > 0]",
            "jnp.where(x > 0, x, 0.0)",
        )
    if not isinstance(f.error, jax.errors.TracerBoolConversionError):
        return None
    return (
        "decides by the value of a coordinate, velocity or parameter, and has none while JAX traces",
        "if, and, or, not, min or max",
        "jnp.where(condition, a, b), jnp.minimum(a, b), or jnp.maximum(a, b)",
    )


def _counts(f: Failure) -> Words | None:
    """A count or an index that is no Python integer."""
    as_float = re.search("be converted to a scalar index|be interpreted as an integer|Shapes must be 1D", f.said)
    if not as_float and not isinstance(f.error, jax.errors.TracerIntegerConversionError):
        return None
    return (
        "uses a number as a count or an index that is "
        + ("no whole number" if as_float else "not known while JAX traces"),
        "range(params[...]), or a list indexed, with " + ("a float" if as_float else "an array of whole numbers"),
        'a whole number of Python, params = {..., "n": 3}; or x[i] of an array x in place of a list',
    )


def _python_number(f: Failure) -> Words | None:
    """A Python number made of what JAX traces."""
    if not isinstance(f.error, jax.errors.ConcretizationTypeError):
        return None
    used = re.search(r"\bmath\.(\w+)", f.line)
    return (
        "makes a Python number of a coordinate, velocity or parameter, and such a number cannot be differentiated",
        "a function of the module math, float(...), int(...), or range(...)",
        f"jnp.{used[1]} in place of math.{used[1]}" if used else "leave out float(...) and int(...)",
    )


def _no_params(f: Failure) -> Words | None:
    """Parameters that were not given, or are no dict."""
    if "params" not in f.given or not ("NoneType" in f.said and f.given["params"] is None):
        return None
    return (
        "uses params, and none were given",
        "params left out of the call, where they follow q and v",
        'lj.integrate(system, q0, v0, {"m": 1.0, "g": 9.81}, ts=ts)',
    )


def _power(f: Failure) -> Words | None:
    """`v^2`."""
    if not ("^" in f.line and re.search(r"\bxor\b|operand type\(s\) for \^", f.said)):
        return None
    return "uses ^, which is no power in Python", "v^2 as it is written in formulas", "v**2"


def _attribute(f: Failure) -> Words | None:
    """A name asked for with a dot."""
    missing = re.search(r"'?(dict|list|tuple|\w*Tracer|ArrayImpl)'?(?: object)? has no attribute '?(\w+)", f.said)
    if missing is None:
        return None
    of, name = missing.groups()
    used = re.search(rf"(\w+)\.{name}\b", f.line)
    asked = used[1] if used else "q"
    if of == "dict":
        return (
            f"asks for .{name} of a dict",
            "names are looked up in brackets",
            f'{asked}["{name}"] in place of {asked}.{name}',
        )
    if of in ("list", "tuple"):
        return (
            f"asks for .{name} of a {of}",
            f"a start that is a {of} of numbers",
            "make it an array, q0 = jnp.array([0.1, 0.2])",
        )
    return (
        f"asks for .{name} of an array, which has none",
        "a function that is written for names, or a method that arrays do not have",
        f'q0 = {{"{name}": 0.1}} and {asked}["{name}"]',
    )


def _whole_dict(f: Failure) -> Words | None:
    """Arithmetic with a dict, or with the names in it."""
    dicts = [name for name, x in f.given.items() if isinstance(x, Mapping) and x]
    if not dicts or not re.search(r"operand type|requires ndarray|not a valid JAX type|must be real number", f.said):
        return None
    if re.search(r"['.]dict'", f.said):
        first = next(iter(f.given[dicts[-1]]))
        return (
            "calculates with a dict",
            "all of what has names taken for one of them",
            f"look a name up in it, as in {dicts[-1]}[{first!r}]",
        )
    of_state = [name for name in dicts if name in ("q", "v")]
    if "'str'" in f.said and of_state and not list(_no_numbers(f.given.get("params"))):
        keys = list(f.given[of_state[0]])
        return (
            "calculates with text",
            f"{of_state[0]} taken apart, as in a, b = {of_state[0]}, which gives the names in a dict",
            ", ".join(f"{of_state[0]}[{key!r}]" for key in keys),
        )
    return None


def _no_number(f: Failure) -> Words | None:
    """A parameter that is text, or None."""
    odd = [name for name, kind in _no_numbers(f.given.get("params")) if re.search(kind, f.said)]
    if not odd:
        return None
    return (
        f"calculates with '{odd[0]}' of params, which is no number",
        "a number read as text, or left to be filled in",
        f'params = {{..., "{odd[0]}": 1.0}}',
    )


def _no_numbers(tree) -> Iterator[tuple[str, str]]:
    """The leaves that are None or text, by name, with what is said of such a one in a calculation."""
    for path, x in jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: x is None):
        if path and (x is None or isinstance(x, str)):
            said = "NoneType" if x is None else "str|sequence|scalar index"
            yield jax.tree_util.keystr(path, simple=True, separator="."), said


def _no_names(f: Failure) -> Words | None:
    """A name looked up where there are none."""
    asked = re.search(r"string indexing; got idx='(.*)'", f.said)
    of_a_list = re.match(r"(?:list|tuple) indices must be integers or slices, not str", f.said)
    if not asked and not of_a_list:
        return None
    taken = {key: [x for x in names if not isinstance(f.given[x], Mapping)] for key, names in f.taken.items()}
    key = asked[1] if asked else next((key for key, names in taken.items() if names), "")
    name = next(iter(taken.get(key, ())), None)
    of = (
        "an array"
        if name in (None, "q", "v") and asked
        else f"{name}, which is {what_is(f.given[name])}"
        if name
        else "a list"
    )
    what = f"asks for '{key}' of {of}" + (", which has no names" if of == "an array" else "")
    if name == "params":
        return what, "parameters without names, or arguments in another order", f'params = {{"{key}": 1.0, ...}}'
    if name == "t":
        order = ", ".join(f.given)
        return what, "the arguments of the function in another order", f"def f({order})"
    return (
        what,
        "a start that is a number or an array, and a function that is written for a dict",
        f'q0 = {{"{key}": 0.1}} and v0 = {{"{key}": 0.0}}',
    )


def _taken_apart(f: Failure) -> Words | None:
    """More, or fewer, entries than there are."""
    if re.search(r"iteration over a 0-d|Too many indices: .*0-dimensional|cannot unpack non-iterable", f.said):
        return (
            "takes entries of a single number",
            "a start that is a number, and a function that is written for an array",
            "q0 = jnp.array([0.1, 0.2]); or q in place of q[0]",
        )
    mentioned = any(re.search(rf"\b{name}\b", f.line) for name in f.names)
    if mentioned and re.search(r"values to unpack|(?:list|tuple) index out of range", f.said):
        size = "; ".join(f"{name} is {_length(f.given[name])}" for name in ("q", "v") if name in f.given)
        return (
            f"takes another number of entries than there are{': ' + size if size else ''}",
            "a start with another number of coordinates than the function is written for",
            "one entry in q0 and in v0 for each that is taken",
        )
    return None


def _length(x):
    return what_is(x) if not isinstance(x, list | tuple) else f"{what_is(x)} of {len(x)}"


def _list(f: Failure) -> Words | None:
    """Arithmetic with a list."""
    kind = re.search(r"'(list|tuple)'", f.said)
    of = kind[1] if kind else "list" if "can't multiply sequence" in f.said else None
    if of is None:
        return None
    return (
        f"calculates with a {of}",
        f"a start or a parameter that is a {of} of numbers, as q0 = [0.1, 0.2]",
        "make it an array, q0 = jnp.array([0.1, 0.2])",
    )


def _assigns(f: Failure) -> Words | None:
    """`x[i] = y`."""
    if "arrays are immutable" not in f.said:
        return None
    return "changes an entry of an array, and JAX's arrays stay as they are", "x[i] = y", "x = x.at[i].set(y)"


def _shapes(f: Failure) -> Words | None:
    """Arrays of shapes that do not go together."""
    if not re.search("incompatible shapes|contracting dimensions|rank_promotion|could not be broadcast", f.said):
        return None
    found = re.findall(r"\(\d*(?:, ?\d*)*\)", f.said)
    of = " and ".join(found[:2])
    size = "; ".join(f"{name} is {what_is(f.given[name])}" for name in ("q", "v") if name in f.given)
    return (
        f"combines arrays of the shapes {of}" + (f", where {size}" if size else ""),
        "a parameter or a matrix for another number of coordinates",
        "shapes that go together, as (n, n) @ (n,)",
    )


# In this order: the first that knows it speaks.
MISTAKES: tuple[Callable[[Failure], Words | None], ...] = (
    _foreign_library, _decides, _python_number, _no_params, _no_number, _counts, _power, _attribute, _whole_dict,
    _no_names, _taken_apart, _list, _assigns, _shapes,
)  # fmt: skip
