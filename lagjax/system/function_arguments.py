"""The arguments of a user's function: the state, or the state and the multipliers."""

import inspect
from collections.abc import Callable

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
