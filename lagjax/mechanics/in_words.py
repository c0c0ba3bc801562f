"""What goes wrong inside a function of the user's, in the user's names, with the line where it happened.

What is not recognized is raised as it came: it is then between the user and the function. Each error is chained to the
one that it puts in words, whose traceback ends at the user's line.
"""

import difflib
import inspect
import re
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from lagjax.mechanics.mistakes import MISTAKES, Failure

# Arguments by their usual names: two of them in each other's place are no choice of names.
NAMES = {"t", "q", "v", "params", "multipliers"}


class Call(NamedTuple):
    """A function of the user's, what it is called here, the arguments that it gets, and to what it belongs."""

    role: str
    function: Callable
    takes: tuple[str, ...]
    owner: str = ""

    def __str__(self):
        return f"{self.role}({', '.join(self.takes)}){self.owner}"


def check_arguments(call: Call, usual_cause: str):
    """Raise where the function cannot be called with so many arguments, or takes them in another order."""
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
            f"{call} is called with {count}, and the function is {name}{signature}.\n"
            f"Usual cause: {usual_cause}.\n"
            f"Fix: def {name}({', '.join(call.takes)})."
        ) from error
    places = list(zip(signature.parameters, call.takes))
    if len([mine for mine, ours in places if mine != ours and mine in call.takes and mine in NAMES]) > 1:
        raise TypeError(
            f"{call} gets its arguments in this order, and the function is {name}{signature}.\n"
            "Usual cause: the order of another library.\n"
            f"Fix: def {name}({', '.join(call.takes)})."
        )


@contextmanager
def in_words(call: Call, given: Mapping[str, Any]) -> Iterator[None]:
    """What goes wrong inside, while the function is called with what is `given`, is raised in the user's words."""
    try:
        yield
    except KeyError as error:
        raise ValueError(_missing(call, given, error)) from error
    except (TypeError, AttributeError, IndexError, ValueError, NotImplementedError) as error:
        words = _in_words(call, given, error)
        if words is None:
            raise
        raise TypeError(words) from error


def _missing(call, given, error):
    """A key that is not there: where it was looked for, what is there, and what may have been meant."""
    key, line = error.args[0], _line(call, error)
    there = {name: list(x) for name, x in given.items() if isinstance(x, Mapping) and name in call.takes}
    asked = re.search(rf"(\w+)\[[\"']?{re.escape(str(key))}[\"']?\]", line)
    parameters = _parameters(call)
    if asked and asked[1] in parameters[: len(call.takes)]:
        source = call.takes[parameters.index(asked[1])]
        there = {source: there[source]} if source in there else there
    has = "; ".join(f"{name} has {', '.join(map(repr, keys))}" for name, keys in there.items())
    meant = difflib.get_close_matches(str(key), [str(k) for keys in there.values() for k in keys], 1)
    cause = "a name written in two ways, or left out"
    if "point" in there:
        fix = f'axes = {{..., "{key}": jnp.linspace(0.0, 1.0, 11)}}'
    elif not isinstance(key, str) and any(there.values()):
        source, keys = next((name, keys) for name, keys in there.items() if keys)
        cause, fix = "a function that is written for an array", f"look a name up, as in {source}[{keys[0]!r}]"
    elif set(there) & {"q", "v"} and "params" not in there:
        fix = f'q0 = {{"{key}": 0.1}} and v0 = {{"{key}": 0.0}}'
    else:
        fix = f'params = {{..., "{key}": 1.0}}'
    return (
        f"{call} asks for {key!r}, and there is none{': ' + has if has else ''}.{_quoted(line)}\n"
        f"Usual cause: {cause}.\n"
        f"Fix: {fix}" + (f", or write '{meant[0]}'." if meant else ".")
    )


def _in_words(call, given, error):
    """What an error means; None where that is not known."""
    if "\nFix: " in str(error):
        return None  # It is in words.
    line = _line(call, error)
    known = {name: x for name, x in given.items() if name in call.takes}
    failure = Failure(error, str(error), line, known, _arguments(call, line), _parameters(call))
    for recognized in MISTAKES:
        if (found := recognized(failure)) is not None:
            what, cause, fix = found
            return f"{call} {what}.{_quoted(line)}\nUsual cause: {cause}.\nFix: {fix}."
    return None


def _arguments(call, line):
    """The arguments of which the line takes something in brackets, by what is taken: {"theta": ["q", "v"]}."""
    ours = dict(zip(_parameters(call), call.takes))
    found = {}
    for name, key in re.findall(r"\b(\w+)\[\s*[\"']?([\w ]+)[\"']?\s*\]", line):
        if name in ours:
            found.setdefault(key, []).append(ours[name])
    return found


def _parameters(call):
    """What the user calls the arguments; nothing of a built-in without a signature."""
    try:
        return list(inspect.signature(call.function).parameters)
    except ValueError:
        return []


def _line(call, error):
    """The line of the user's file in which it happened, or ""."""
    code = getattr(inspect.unwrap(call.function), "__code__", None)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if code and f.filename == code.co_filename]
    return (frames[-1].line or "") if frames else ""


def _quoted(line):
    return f"\n    {line.strip()}" if line else ""
