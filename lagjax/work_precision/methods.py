"""Choose the compared methods and tolerances, and check them before anything is compiled."""

from collections.abc import Iterable, Mapping
from typing import Any

import diffrax
import numpy as np

from lagjax.integrate import ROUND_OFFS, arguments, nystrom_for
from lagjax.mechanics import is_free_of_velocities
from lagjax.numerics import Dopri8, EqualSteps, Nystrom, Tsit5
from lagjax.system import State, System, model_of

# From too loose for high orders to show, to where round-off dominates.
LADDERS = {
    np.dtype("float64"): tuple(10.0**-k for k in range(3, 13)),
    np.dtype("float32"): (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5),
}
# The tolerance of a computed reference.
TIGHTEST = {np.dtype("float64"): 1e-13, np.dtype("float32"): 2e-6}
FIX = 'methods={"Dopri8": lj.Dopri8(), "Tsit5": lj.Tsit5()}, or leave it out'


def usual_methods(system: System, start: State) -> dict[str, diffrax.AbstractSolver]:
    """The explicit methods that suit a system, starting with the default of `integrate`."""
    by_stages: dict[str, diffrax.AbstractSolver] = {"Dopri8": Dopri8(), "Tsit5": Tsit5()}
    model = model_of(system, *start)
    if not is_free_of_velocities(model):
        return by_stages
    default = nystrom_for(model)
    return {type(default).__name__: default} | by_stages


def chosen(methods: Any, system: System, start: State) -> dict[str, diffrax.AbstractSolver]:
    """The methods by name; raise if one is not an adaptive solver for this system."""
    if methods is None:
        return usual_methods(system, start)
    if isinstance(methods, (str, diffrax.AbstractSolver, type)) or not isinstance(methods, Iterable):
        fix = f"methods=[{as_code(methods)}]" if isinstance(methods, diffrax.AbstractSolver) else FIX
        raise TypeError(
            f"methods must be a sequence of solvers, or a dict of them by name, not {_in_words(methods)}.\nFix: {fix}."
        )
    named = dict(methods) if isinstance(methods, Mapping) else _named(methods)
    if not named:
        raise ValueError("methods is empty: there is nothing to compare.\nFix: leave it out.")
    for name, method in named.items():
        _check(name, method, system, start)
    return named


def _named(methods: Any):
    named = {}
    for method in methods:
        name = type(method).__name__
        again = sum(key.split(" ")[0] == name for key in named)
        named[f"{name} ({again + 1})" if again else name] = method
    return named


def _check(name: str, method: Any, system: System, start: State):
    if method is None:
        raise TypeError(f"method {name!r} is None.\nFix: leave methods out; the comparison then includes the default.")
    if isinstance(method, EqualSteps):
        raise TypeError(
            f"method {name!r} makes steps of equal length, which no tolerance sets.\n"
            "Fix: lj.horizons(system, q0, v0, params, period=period), which compares it over many periods."
        )
    if isinstance(method, diffrax.AbstractSolver) and not isinstance(method, diffrax.AbstractAdaptiveSolver):
        kind = type(method).__name__
        by_halves = method.term_structure is diffrax.AbstractTerm
        raise TypeError(
            f"method {name!r} is diffrax's {kind}, which does not estimate its error, so no tolerance sets its steps.\n"
            "Usual cause: a method for fixed steps in a comparison at tolerances.\n"
            + (f"Fix: leave it out, or diffrax.HalfSolver(diffrax.{kind}())." if by_halves else "Fix: leave it out.")
        )
    try:
        arguments.check_method(method)
    except TypeError as error:
        raise TypeError(f"method {name!r}: {error}") from None
    if isinstance(method, Nystrom) and not is_free_of_velocities(model_of(system, *start)):
        cause = "there are constraints" if system.constraints else "these do depend on them"
        raise ValueError(
            f"method {name!r} is for accelerations that do not depend on velocities, but {cause}.\n"
            "Usual cause: a list of methods written for another system.\n"
            "Fix: leave it out; methods=None takes those that suit the system."
        )


def ladder(tolerances: Any, dtype: Any) -> tuple[float, ...]:
    """The tolerances from loose to tight; raise if one is below round-off."""
    if tolerances is None:
        return LADDERS.get(np.dtype(dtype), (1e-1, 1e-2))
    try:
        found = np.atleast_1d(np.asarray(tolerances, float))
    except (TypeError, ValueError):
        found = np.zeros(())
    if found.ndim != 1 or not found.size:
        raise ValueError(
            f"tolerances must be a sequence of positive numbers, not {tolerances!r}.\n"
            "Fix: tolerances=(1e-4, 1e-6, 1e-8)."
        )
    floor = ROUND_OFFS * float(np.finfo(dtype).eps)
    for value in found:
        if not np.isfinite(value) or value <= 0:
            raise ValueError(
                f"tolerances must be positive numbers, but one is {value:g}.\n"
                "Usual cause: exponents instead of powers of ten.\nFix: tolerances=(1e-4, 1e-6, 1e-8)."
            )
        if value < floor:
            cause = "JAX works in float32 by default" if np.dtype(dtype) == np.float32 else "a wrong exponent"
            raise ValueError(
                f"a tolerance of {value:.3g} is below what {np.dtype(dtype)} can reach ({floor:.1g}).\n"
                f"Usual cause: {cause}.\nFix: tolerances down to {10 * floor:.0e}"
                + (
                    ', or jax.config.update("jax_enable_x64", True) before the first array.'
                    if np.dtype(dtype) == np.float32
                    else "."
                )
            )
    return tuple(float(value) for value in sorted(set(found), reverse=True))


def as_code(method: Any) -> str:
    """A method as it is written in code."""
    package = arguments.PACKAGES.get(type(method).__module__.split(".")[0], "")
    return f"{package}{method!r}"


def _in_words(x: float):
    if isinstance(x, type):
        return f"the class {x.__name__}"
    return f"{x!r}" if isinstance(x, str) else f"one {type(x).__name__}"
