"""What is refused by rule: input of the kinds that are wrong everywhere in the same way, in the user's words.

Each rule takes what was given, what it is called, and the fix as code, and raises with a message of one pattern: what
happened, with the value as given; the usual cause, where one is known; the fix. Whatever needs an explanation of its
own is raised where it is found.
"""

import difflib
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from typing import Any

import jax
import numpy as np

from lagjax.jaxtools import is_eager, is_traced

# Arrays are shown by their values up to this size.
FEW = 9
# The prefix with which a user writes a class, by the package that defines it.
PACKAGES = {"diffrax": "diffrax.", "lagjax": "lj."}
OUTSIDE = "call it outside of jax.jit, jax.vmap and jax.grad"


def words(what: str, fix: str = "", cause: str = "") -> str:
    """The message of a refusal."""
    return f"{what}." + (f"\nUsual cause: {cause}." if cause else "") + (f"\nFix: {fix}." if fix else "")


def shown(given: Any) -> str:
    """What was given: 'fast', 1000000.0, [0.1, 0.2], shape (3, 4), float64, the class Dopri8, a dict."""
    if isinstance(given, type):
        return f"the class {given.__name__}"
    if isinstance(given, np.ndarray | jax.Array) and not is_traced(given) and given.size <= FEW:
        return f"{np.asarray(given).tolist()!r:.60}"
    if hasattr(given, "shape") and hasattr(given, "dtype") and not isinstance(given, np.generic):
        return f"shape {given.shape}, {given.dtype}"
    if callable(given) and hasattr(given, "__name__"):
        return "a function" if given.__name__ == "<lambda>" else f"the function '{given.__name__}'"
    if isinstance(given, np.generic):
        return f"{given.item()!r:.60}"
    if isinstance(given, str | int | float | complex | None) or type(given) in (tuple, list, dict, set):
        return f"{' '.join(repr(given).split()):.60}"
    name = type(given).__name__
    return f"{'an' if name[0] in 'AEIOaeio' else 'a'} {name}"


def listed(names: Iterable) -> str:
    """Names in quotes, joined by commas and "and"."""
    quoted = [f"'{name}'" for name in names]
    if not quoted:
        return "none"
    return quoted[0] if len(quoted) == 1 else ", ".join(quoted[:-1]) + f" and {quoted[-1]}"


def must(holds: Any, claim: str, given: Any, fix: str = "", cause: str = "", error: type = ValueError) -> None:
    """Raise unless it `holds`; `claim`: "dt must be positive". For numbers out of range, and for wrong shapes."""
    if not holds:
        raise error(words(f"{claim}, not {shown(given)}", fix, cause))


def must_be(kinds: Any, given: Any, claim: str, fix: str = "", cause: str = "") -> None:
    """Raise a `TypeError` unless what was given is an instance of one of these classes; a class itself is none."""
    if isinstance(given, type) and issubclass(given, kinds):
        role, package = claim.split(" must ")[0], PACKAGES.get(given.__module__.split(".")[0], "")
        fix, cause = f"{role + '=' if role.isidentifier() else ''}{package}{given.__name__}()", "missing brackets"
    must(isinstance(given, kinds), claim, given, fix, cause, TypeError)


def must_be_function(given: Any, role: str, takes: str, fix: str = "", cause: str = "", optional: bool = False) -> None:
    """Raise a `TypeError` for what cannot be called, and is not None with `optional`; `takes`: "(t, q, v, params)"."""
    fix = fix or f"{role}=lambda {takes[1:-1]}: ..., the function itself and not its value"
    holds = callable(given) or optional and given is None
    must(holds, f"{role} must be a function of {takes}", given, fix, cause, TypeError)


def must_be_among(options: Iterable, given: Any, role: str, fix: str = "", cause: str = "") -> Any:
    """Return an option; raise unless it is one of a few words, or None where that is among them."""
    options = [*options]
    if not any(given is x or isinstance(given, type(x)) and given == x for x in options):
        *most, last = map(repr, options)
        near = [*difflib.get_close_matches(str(given), [x for x in options if isinstance(x, str)], 1), options[0]][0]
        must(False, f"{role} must be {', '.join(most)} or {last}", given, fix or f"{role}={near!r}", cause)
    return given


def must_be_whole(given: Any, role: str, least: int = 1, most: float = np.inf, fix: str = "") -> None:
    """Raise unless a number is whole and in its range, both ends included; 1e6 is a float."""
    whole = isinstance(given, int | np.integer) and not isinstance(given, bool)
    wanted = f"from {least} to {most:,}" if most < np.inf else "above zero" if least == 1 else f"of at least {least}"
    number = isinstance(given, int) or isinstance(given, float) and np.isfinite(given)
    near = int(min(max(given, least), most)) if number else least
    cause = "1e6, which is a float" if isinstance(given, float) and given == near else ""
    claim, holds = f"{role} must be a whole number {wanted}", whole and least <= given <= most
    must(holds, claim, given, fix or f"{role}={near}", cause)


def must_be_finite(given: Any, role: str, fix: str = "") -> None:
    """Raise if there is a NaN or an infinity among numbers, unless JAX is tracing them."""
    numbers = np.zeros(0) if is_traced(given) else np.asarray(given, float)
    if len(wrong := np.argwhere(~np.isfinite(numbers))):
        place = ", ".join(map(str, wrong[0]))
        what = f"there is NaN or infinity in {role}: {numbers[tuple(wrong[0])]}"
        raise ValueError(words(what + (f" at [{place}]" if place else ""), fix))


def must_be_like(given: Any, like: Any, role: str, of: str, fix: str, cause: str = "") -> None:
    """Raise unless a tree has the structure and the shapes of another; `of`: what that one is called."""
    wanted, found = (jax.tree.map(np.shape, tree) for tree in (like, given))
    if found != wanted:
        what = f"{role} must be like {of}, in structure and shapes: {of} has {wanted}, and it has {found}"
        raise ValueError(words(what, fix, cause))


def must_be_single(batch: Sequence[int], what: str, fix: str) -> None:
    """Raise for a batch, of the shape `batch`, where one is taken; `{name}` in `fix`, "{traj}.draw()", becomes one."""
    if batch:
        one = re.sub(r"{(\w+)}", r"jax.tree.map(lambda x: x[0], \1)", fix)
        raise ValueError(words(f"{what} is a batch of shape {tuple(batch)}: take one lane of it", one))


def must_have_values(given: Any, what: str, fix: str = OUTSIDE, cause: str = "", eager: bool = False) -> None:
    """Raise a `TypeError` where JAX is tracing what was given; with `eager`, where it is tracing anything at all."""
    if is_traced(given) or eager and not is_eager():
        raise TypeError(words(f"{what}, and JAX is tracing", fix, cause))


def must_name(
    given: Any, names: Iterable, what: str, kind: str, fix: str = "'{}'", cause: str = "", error: type = ValueError
) -> None:
    """Raise unless a name, or each of several, is one of those there are; `{}` in `fix` becomes the nearest of them.

    `what`: what names it, `kind`: what it should be; "angles names 'tehta', which is no coordinate; there are ...".
    """
    names = [*names]
    for name in [given] if isinstance(given, str) else given:
        if name not in names:
            near = difflib.get_close_matches(str(name), [str(x) for x in names], 1) or names
            fix = fix.replace("{}", str(near[0])) if names else "leave it out"
            there = f"there {'are' if len(names) != 1 else 'is'} {listed(names)}"
            raise error(words(f"{what} {name!r:.60}, which is no {kind}; {there}", fix, cause))


def must_differ(names: Iterable[str], what: str, fix: str = "a name for each") -> None:
    """Raise if a name occurs twice; `what`: whose they are, "two bodies", "an element and a constraint"."""
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise ValueError(words(f"{what} are called '{twice[0]}'", fix))


def must_return(holds: Any, call: object, wanted: str, value: Any, fix: str, cause: str = "") -> None:
    """Raise unless it `holds` of what a function of the user's returned, in a trace or not."""
    if not holds:
        raise ValueError(words(f"{call} must return {wanted}, and returned {shown(value)}", fix, cause))


def must_not_meet(given: Mapping[str, Any], why: str, fix: str = "leave one of them out", error: type = ValueError):
    """Raise if more than one of some arguments is given, not None: they exclude each other."""
    both = [name for name, x in given.items() if x is not None]
    if len(both) > 1:
        raise error(words(f"{' and '.join(both)} exclude each other: {why}", fix))


def must_go_together(given: Mapping[str, Any], why: str, fix: str) -> None:
    """Raise if some of several arguments that belong together are given, not None, and others are not."""
    missing = [name for name, x in given.items() if x is None]
    if 0 < len(missing) < len(given):
        there = " and ".join(name for name in given if name not in missing)
        raise ValueError(words(f"{there} is given, but {' and '.join(missing)} is not: {why}", fix))


def installed(module: str, user: str, extra: str) -> Any:
    """Import an optional package, or raise an `ImportError` that says how to get it; `user`: what needs it."""
    try:
        return import_module(module)
    except ImportError as error:
        fix = f'pip install "lagjax[{extra}]"'
        raise ImportError(words(f"{user} needs {module}, an optional extra", fix)) from error
