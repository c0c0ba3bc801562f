"""Explain wrong calls in the user's words: a first argument that is not a system, arguments to give by name."""

from collections.abc import Callable
from functools import wraps
from inspect import Parameter, signature
from typing import Any, ParamSpec, TypeVar

from lagjax.system.constraints import Holonomic, Nonholonomic
from lagjax.system.hybrid import Hybrid
from lagjax.system.signature import known_system
from lagjax.system.system import System

P = ParamSpec("P")
R = TypeVar("R")
CONSTRAINTS = (Holonomic, Nonholonomic)
SYSTEMS = (System, Hybrid)


def check_system(system: Any, *others: Any, phases: bool = False, states: bool = True, elements: bool = False) -> None:
    """Raise if the first argument of a function is not a `System`, or with `phases` a `Hybrid`.

    `others`: the following arguments, among which the system may be. `states`, `elements`: whether it may have them.
    """
    if not states and isinstance(system, System) and system.states:
        raise ValueError(
            f"this is not done for systems with states, as '{next(iter(system.states))}' here: only coordinates obey "
            "Lagrange's equations.\nFix: lj.integrate for their motions; here the system without them."
        )
    if type(system) is System or isinstance(system, SYSTEMS if phases else System):
        if not elements and getattr(system, "elements", None) is not None:
            raise TypeError(
                f"this takes a system with one form of equations, and the elements of this one "
                f"({', '.join(map(repr, system.elements))}) change them.\n"
                "Fix: lj.System(...) without elements=, with a lj.Holonomic for a contact that is closed; "
                "lj.integrate takes elements."
            )
        return
    known_system(system)
    if isinstance(system, Hybrid):
        raise TypeError(
            "this takes one system, and a lj.Hybrid has one for each of its phases.\n"
            f"Fix: hybrid.systems[{len(system.names) - 1}] for '{system.names[-1]}'; print(hybrid) shows how "
            "the phases follow each other."
        )
    raise TypeError(f"the first argument must be a lj.System, not {_describe(system)}.\n{_remedy(system, others)}")


def _describe(thing):
    if isinstance(thing, type):
        return f"the class {thing.__name__}"
    if callable(thing) and hasattr(thing, "__name__"):
        return "a function" if thing.__name__ == "<lambda>" else f"the function '{thing.__name__}'"
    return "None" if thing is None else f"a {type(thing).__name__}"


def _remedy(system, others):
    places = [i for i, x in enumerate(others, 2) if isinstance(x, SYSTEMS)]
    if places:
        return (
            f"Usual cause: arguments in another order; the system is argument {places[0]} here.\n"
            "Fix: lj.integrate(system, q0, v0, params, ts=ts); and (system, t, q, v, params) at one state."
        )
    if system is System:
        return "Usual cause: the class in place of a system.\nFix: system = lj.System(lagrangian)."
    if isinstance(system, CONSTRAINTS):
        return (
            "Usual cause: a constraint without its system.\n"
            'Fix: system = lj.System(lagrangian, constraints={"rod": constraint}).'
        )
    if isinstance(getattr(system, "system", None), SYSTEMS):
        return "Usual cause: a result of a system in place of the system.\nFix: its .system."
    name = getattr(system, "__name__", "lagrangian") if callable(system) else "lagrangian"
    name = "lagrangian" if name == "<lambda>" else name
    cause = "the Lagrangian in place of its system" if callable(system) else "arguments in another order"
    return f"Usual cause: {cause}.\nFix: system = lj.System({name}), and the system as the first argument."


def by_name(call: str, *required: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a function explain a call without its `required` keyword arguments; `call`: a correct call."""

    def decorate(function: Callable):
        parameters = signature(function).parameters
        most_positional = sum(x.kind is Parameter.POSITIONAL_OR_KEYWORD for x in parameters.values())
        needed = frozenset(required)

        @wraps(function)
        def checked(*args, **kwargs):
            # Unknown keywords are left to Python's own error.
            if (len(args) > most_positional or not kwargs.keys() >= needed) and kwargs.keys() <= parameters.keys():
                missing = [name for name in required if name not in kwargs]
                raise TypeError(_wrong_call(function.__name__, len(args) - most_positional, missing, call))
            return function(*args, **kwargs)

        return checked

    return decorate


def _wrong_call(name: str, excess, missing, call):
    words = [f"without {', '.join(f'{x}=' for x in missing)}"] if missing else []
    words += [f"with {excess} positional argument{'s' * (excess > 1)} too many"] if excess > 0 else []
    which = " and ".join(missing) or "further arguments"
    return (
        f"lj.{name} was called {' and '.join(words)}.\n"
        f"Usual cause: {which} given by position, or left out.\n"
        f"Fix: {call}, by name."
    )
