"""Explain errors inside the user's functions in the user's names, with the line where they happened.

An error that is not recognised is raised unchanged. Each explanation is chained to the original error, whose traceback
ends at the user's line.
"""

import difflib
import inspect
import re
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from lagjax.system.known_errors import MISTAKES, Failure

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


def _missing_key_message(call, given, error):
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


def _message(call, given, error):
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


def _indexed_arguments(call, line):
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


def _line(call, error):
    """The line of the user's file where the error happened, or ""."""
    code = getattr(inspect.unwrap(call.function), "__code__", None)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if code and f.filename == code.co_filename]
    return (frames[-1].line or "") if frames else ""


def _quoted(line):
    return f"\n    {line.strip()}" if line else ""
