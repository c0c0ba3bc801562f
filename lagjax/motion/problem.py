"""The questions that `integrate` asks of its arguments before it starts, in the user's words."""

import warnings
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from lagjax.mechanics import coordinates
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.diagnosis import describe, explain_failure
from lagjax.mechanics.saddle_point import equations_of_motion
from lagjax.mechanics.system import System
from lagjax.motion.consistency import departures
from lagjax.motion.consistent_state import consistent_state
from lagjax.motion.solve import ROUND_OFFS
from lagjax.motion.trajectory import RESULTS, AccuracyWarning

# Tolerances that each dtype reaches with room to spare.
DEFAULT_TOLERANCE = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-5}
# How methods are called by where they come from.
PACKAGES = {"diffrax": "diffrax.", "lagjax": "lj."}
# Starts that cannot be integrated, whose reason is in the equations.
REFUSED = (RESULTS.start_not_finite, RESULTS.start_singular, RESULTS.contradictory)


def check_system(system: Any):
    """Raise where `system` is not a `System`."""
    if not isinstance(system, System):
        raise TypeError(
            f"the first argument must be a lj.System, not {type(system).__name__}.\n"
            "Fix: system = lj.System(lagrangian)."
        )


def check_method(method: Any):
    """Raise where `method` is neither None nor an instance of a diffrax solver for a whole state."""
    if method is None:
        return
    if isinstance(method, type) and issubclass(method, diffrax.AbstractSolver):
        raise TypeError(
            f"method must be a solver instance, and {method.__name__} is the class.\n"
            "Usual cause: the brackets left out.\n"
            f"Fix: method={PACKAGES.get(method.__module__.split('.')[0], '')}{method.__name__}()."
        )
    if not isinstance(method, diffrax.AbstractSolver):
        raise TypeError(
            f"method must be a diffrax solver, not {type(method).__name__}.\n"
            "Usual cause: a method by its name, as in SciPy.\n"
            "Fix: method=lj.Dopri8(), any of diffrax's, or leave it out."
        )
    if method.term_structure is not diffrax.AbstractTerm:
        raise TypeError(
            f"{type(method).__name__} needs a vector field of a special form, and the accelerations of a general "
            "Lagrangian depend on q and v together.\nFix: method=diffrax.Dopri8(), or any method for one ODETerm."
        )


def check_adjoint(adjoint: Any, drift: str):
    """Raise where an adjoint cannot follow the motion."""
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and drift == "project":
        raise ValueError(
            "BacksolveAdjoint integrates backwards without returning to the constraints, so its gradients would "
            'be wrong.\nFix: leave adjoint out (both modes then work), or drift="none".'
        )


def check_drift(drift: Any, system: System) -> str:
    """The drift control to use; raise where it is unknown."""
    if drift is None:
        return "project" if system.constraints else "none"
    if drift not in ("project", "baumgarte", "none"):
        raise ValueError(f'drift must be "project", "baumgarte" or "none", not {drift!r}.')
    return drift if system.constraints else "none"


def times(ts: Any, dtype):
    """`ts` as an increasing vector of `dtype`, or an error."""
    ts = jnp.asarray(ts)
    if ts.ndim != 1 or ts.shape[0] < 2:
        raise ValueError(
            f"ts must be a vector of at least two times, and has shape {ts.shape}.\n"
            "Usual cause: the last time alone; the motion starts at ts[0] with (q0, v0).\n"
            "Fix: ts=jnp.linspace(0.0, 10.0, 101)."
        )
    ts = ts.astype(dtype)
    if not coordinates.is_traced(ts):
        if not np.all(np.isfinite(ts)):
            raise ValueError("ts contains NaN or infinity.\nFix: give finite times.")
        late = np.flatnonzero(np.diff(np.asarray(ts, float)) <= 0)
        if late.size:
            i = int(late[0])
            raise ValueError(
                f"ts must increase, and ts[{i + 1}] = {float(ts[i + 1]):.9g} follows ts[{i}] = {float(ts[i]):.9g}.\n"
                "Usual cause: times in descending order, a repeated time, or times closer than "
                f"{dtype} can tell apart.\n"
                "Fix: ts=jnp.sort(ts). To run backwards, integrate L(-t, q, -v, params) forwards."
            )
    return ts


def first_step(dt0: Any, dtype):
    """`dt0` as a number of `dtype`, or an error where it is not positive; None where it is to be chosen."""
    if dt0 is None:
        return None
    if not coordinates.is_traced(dt0) and not (np.ndim(dt0) == 0 and float(dt0) > 0):
        raise ValueError(
            f"dt0 must be one positive number, not {dt0}.\n"
            "Fix: leave dt0 out, or with fixed steps dt0=1e-3 for example. To run backwards, integrate "
            "L(-t, q, -v, params) forwards."
        )
    return jnp.asarray(dt0, dtype)


def tolerance(value: Any, name: str, dtype):
    """A tolerance for coordinates and one for velocities, (2,) of `dtype`, or an error where it cannot be reached."""
    dtype = np.dtype(dtype)
    value = DEFAULT_TOLERANCE.get(dtype, 1e-2) if value is None else value
    value = jnp.stack([jnp.asarray(x, dtype) for x in value]) if isinstance(value, (tuple, list)) else value
    if jnp.ndim(value) and jnp.shape(value) != (2,):
        raise ValueError(
            f"{name} must be one number, or two: for coordinates and for velocities. Its shape is {jnp.shape(value)}.\n"
            f"Fix: {name}=1e-9, or {name}=(1e-9, 1e-6)."
        )
    if not coordinates.is_traced(value):
        _check_tolerance(np.min(np.asarray(value, float)), name, dtype)
    return jnp.broadcast_to(jnp.asarray(value, dtype), 2)


def _check_tolerance(value, name, dtype):
    if not value >= 0:
        raise ValueError(f"{name} must be a number >= 0, not {value}.")
    floor = ROUND_OFFS * float(jnp.finfo(dtype).eps)
    if name == "rtol" and value < floor:
        single = dtype == np.dtype("float32")
        cause = "Usual cause: JAX works in float32 unless told otherwise.\n" if single else ""
        remedy = 'jax.config.update("jax_enable_x64", True) before the first array, or ' if single else ""
        raise ValueError(
            f"{name} = {value:.3g} is below what {dtype} can reach ({floor:.1g}).\n"
            f"{cause}Fix: {remedy}{name}={10 * floor:.0e} or more."
        )


def check_finite(s: State):
    """Raise where a coordinate or velocity of the initial state is not finite."""
    for which, tree in (("q0", s.q), ("v0", s.v)):
        values = np.asarray(coordinates.flatten(tree)[0])
        for name, value in zip(coordinates.names(tree), values):
            if not np.isfinite(value):
                raise ValueError(f"coordinate '{name}' of {which} is {value}.\nFix: start from finite numbers.")


def off_constraints(system: System, s: State, rtol, atol) -> str:
    """Say which constraints the initial state violates."""
    check_finite(s)
    violated = departures(system, s, rtol, atol)
    if any(f"= {word}" in violated for word in ("nan", "inf", "-inf")):
        return (
            f"constraints are not finite at the initial state: {violated}.\n"
            "Usual cause: NaN or infinity in params, or a constraint evaluated outside its domain.\n"
            "Fix: look at lj.constraint_residual(system, ts[0], q0, v0, params), and at params."
        )
    return (
        f"the initial state is off the constraints: {violated}, where 0 is asked.\n"
        "Usual cause: a coordinate or velocity computed for other parameters, or rounded.\n"
        "Fix: q0, v0 = lj.consistent_state(system, ts[0], q0, v0, params) for a consistent state near it."
    )


def warn_of_drift(trajectory):
    """Warn where something that must stay constant has changed by more than the tolerance lets expect."""
    if float(trajectory.departure) <= 1:
        return
    drift, rtol = float(trajectory.drift()), float(trajectory.tolerance[0][0])
    span, steps = float(trajectory.end.t - trajectory.t[0]), int(trajectory.stats["num_accepted_steps"])
    off = f", and a constraint is off by {float(trajectory.residual()):.1g}" if trajectory.system.constraints else ""
    warnings.warn(
        f"over a time of {span:.6g} ({steps} steps) the Jacobi integral, which should stay, changed by {drift:.1g} of "
        f"its size{off}, at rtol = {rtol:.1g}.\n"
        "Usual cause: a span of very many periods, over which small errors add up, an unstable motion, steps that are "
        "too long, or round-off (float32, or a tolerance near its limit).\n"
        "Fix: a tighter rtol and atol (in float64), a method of higher order, or a shorter span.",
        AccuracyWarning,
        stacklevel=4,
    )


def stopped_early(trajectory, settings) -> str:
    """Say where and why an integration stopped before its last output."""
    end, t0, t1 = trajectory.end, float(trajectory.t[0]), float(trajectory.t[-1])
    share = 100 * (float(end.t) - t0) / (t1 - t0)
    accepted, rejected = (int(trajectory.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
    what = (
        f"the integration stopped at t = {float(end.t):.9g}, {share:.3g} % of the way to {t1:.6g}, after "
        f"{accepted} accepted and {rejected} rejected steps"
    )
    reason = explain_failure(trajectory.system, State(end.t, end.q, end.v, trajectory.params)) or _beyond(trajectory)
    if reason:
        return f"{what}: {reason}"
    if bool(trajectory.result == RESULTS.max_steps_reached) and rejected <= 10 * accepted:
        return (
            f"{what}: max_steps = {settings.max_steps} is used up. The last state is {describe(end.q)}.\n"
            "Usual cause: a stiff system under an explicit method, or a span of very many periods.\n"
            f"Fix: max_steps={4 * settings.max_steps}, a looser rtol, or method=lj.Radau5() where it is stiff."
        )
    if bool(trajectory.result == RESULTS.unsolved_step) and settings.controller is not None:
        return (
            f"{what}: {RESULTS[trajectory.result]} The last state is {describe(end.q)}.\n"
            "Usual cause: a fixed step that is too long: for the method's stability, an implicit one's root finder, or "
            "for the return to the constraints.\n"
            "Fix: a smaller dt0, or leave stepsize_controller out: steps that fail are then taken again, shorter."
        )
    return (
        f"{what}: {RESULTS[trajectory.result]} The last state is {describe(end.q)}{_fastest(trajectory)}.\n"
        "Usual cause: a singularity of the motion (a collision, a singular configuration), a jump in a force, "
        "or NaN from L beyond that state.\n"
        "Fix: stop before it with event=diffrax.Event(...), or look at lj.accelerations at trajectory.end "
        "with throw=False."
    )


def _beyond(trajectory):
    """Whether the constraints can be met a little after the end; in words where they cannot."""
    system, end = trajectory.system, trajectory.end
    if not system.constraints:
        return None
    ahead = 1e-3 * (trajectory.t[-1] - trajectory.t[0])
    q = jax.tree.map(lambda q, v: q + ahead * v, end.q, end.v)
    try:
        consistent_state(system, end.t + ahead, q, end.v, trajectory.params)
    except ValueError as error:
        return (
            f"the constraints cannot be met a little later. {error}\n"
            "(There: a loop that closes only so far, or one motion prescribed twice.)"
        )
    return None


def _fastest(trajectory):
    """The coordinate whose acceleration is largest at the end: that of a collision or a coordinate singularity."""
    end = trajectory.end
    values = np.abs(coordinates.flatten(equations_of_motion(trajectory.system, *end[:3], trajectory.params)[0])[0])
    names = coordinates.names(end.q)
    if len(names) == 0 or not np.all(np.isfinite(values)):
        return ""
    i = int(np.argmax(values))
    return f", and the largest acceleration that of '{names[i]}', {values[i]:.2g}"
