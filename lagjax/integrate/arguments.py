"""The checks that `integrate` makes of its arguments before it starts, with messages in the user's terms.

Input that can be integrated but is hardly ever meant gets a warning, where values are not traced. A force given in
place of Rayleigh's function R is odd in the velocities, R(-v) = -R(v), as -c v is. The power that it takes, v·∂R/∂v,
then changes its sign with v, so that it gives to one motion what it takes from the reversed one, which no dissipation
does. An R that is merely not even may be right: in a medium that moves with w it is ½ c (v - w)², which has an even and
an odd part.
"""

import weakref
from collections.abc import Callable
from types import FunctionType
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.integrate.replay import Replay
from lagjax.integrate.results import RESULTS, account_of, warning_of
from lagjax.integrate.solve.reports import ROUND_OFFS
from lagjax.integrate.trajectory import AccuracyWarning, Trajectory
from lagjax.jaxtools import at_once, compiled, is_traced, numpy_of, once
from lagjax.mechanics import departures
from lagjax.numerics import EqualSteps
from lagjax.refusals import must, must_be, must_be_among, must_be_finite, must_be_whole, must_not_meet
from lagjax.system import Hybrid, Model, State, System, coordinates, warn

# From here on, with a network in L, Tsit5 is the default, with outputs inside its steps. Evaluations at rtol 1e-5 with
# 21 outputs, by Tsit5, by it with outputs at ends of steps, and by Dopri8: 54, 132 and 286 (a slow motion), 324, 276
# and 1131 (a double pendulum's). With two outputs it takes 162 and Dopri8 130; at 1e-4 102 and 104, at 1e-3 66 and 117.
LOOSE = 1e-6
# Tolerances that each dtype reaches with a margin.
DEFAULT_TOLERANCE = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-5}

# Steps are counted in 32 bits where x64 is off.
MOST_STEPS = 2**31 - 1
# The least span of a motion in round-offs of its times: a step ends at some of the times that can be told apart.
RESOLVED = 1024
# Results of starts that cannot be integrated for a reason in the equations.
REFUSED = (RESULTS.start_not_finite, RESULTS.start_singular, RESULTS.contradictory)


def check_method(method: Any):
    """Raise unless `method` is None or an instance of a diffrax solver for a whole state."""
    if method is None or isinstance(method, EqualSteps):
        return
    must_be(
        diffrax.AbstractSolver | EqualSteps,
        method,
        "method must be a diffrax solver",
        "method=lj.Dopri8(), any of diffrax's, or leave it out",
        "a method given by its name, as in SciPy",
    )
    if method.term_structure is not diffrax.AbstractTerm:
        raise TypeError(
            f"{type(method).__name__} needs a vector field of a special form, and the accelerations of a general "
            "Lagrangian depend on q and v together.\nFix: method=diffrax.Dopri8(), or any method for one ODETerm."
        )


def check_equal_steps(method: EqualSteps, dt0: Any, system: System | Hybrid, **others: Any):
    """Raise unless steps of equal length are possible: their length is known, and nothing has to change it.

    `others`: arguments that have no meaning for them, by name.
    """
    if dt0 is None:
        raise ValueError(
            f"lj.{method.label} makes steps of equal length, which is not given.\n"
            "Fix: dt0=0.01, about a fiftieth of the shortest period."
        )
    if system.in_phases or getattr(system, "elements", None) is not None:
        raise ValueError(
            f"lj.{method.label} makes steps of equal length, and a motion in phases has steps that end at switches.\n"
            "Fix: leave method out; or events=, which are found inside the steps, and may end the motion."
        )
    for name, given in others.items():
        why = "its steps have equal length throughout, and end at outputs alone"
        must_not_meet({name: given, f"lj.{method.label}": method}, why, f"leave {name} out; or method=lj.Dopri8()")


def check_jumps(jumps: Any) -> str:
    """Return `jumps`; raise unless it is one of its two values."""
    fix = 'leave jumps out (they are found), or jumps="ignored"'
    return must_be_among(("found", "ignored"), jumps, "jumps", fix, "times of jumps, which are jump_ts=")


def check_outputs(outputs: Any) -> str | None:
    """Return `outputs`; raise unless it is None or one of two words."""
    fix = 'outputs="exact" (they are ends of steps), outputs="interpolated", or leave it out'
    words = ("exact", "interpolated", None)
    return must_be_among(words, outputs, "outputs", fix, "the times of outputs, which are ts=")


def check_adjoint(adjoint: Any, drift: str, jump_ts: Any, recorded: bool):
    """Raise if an adjoint cannot differentiate the motion; `recorded`: whether lagjax can record its steps."""
    fix = "leave adjoint out (both modes then work), or adjoint=diffrax.RecursiveCheckpointAdjoint()"
    kinds = diffrax.AbstractAdjoint | Replay | None
    must_be(kinds, adjoint, "adjoint must be lj.Replay() or an adjoint of diffrax", fix, "an adjoint given by its name")
    if isinstance(adjoint, Replay) and adjoint.memory is not None and not recorded:
        raise ValueError(
            "lj.Replay(memory=...) limits a record of steps, and none is kept with a stepsize_controller (except "
            "ConstantStepSize), a condition for diffrax in event, or progress: reverse mode then uses diffrax's own "
            "checkpoints.\n"
            "Fix: leave these out; or adjoint=diffrax.RecursiveCheckpointAdjoint(checkpoints=100)."
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and jump_ts is not None:
        raise ValueError(
            "BacksolveAdjoint integrates backwards with steps of its own, which do not end at jump_ts.\n"
            "Fix: leave adjoint out (both modes then work)."
        )
    if isinstance(adjoint, diffrax.BacksolveAdjoint) and drift == "project":
        raise ValueError(
            "BacksolveAdjoint integrates backwards without returning to the constraints, so its gradients would "
            'be wrong.\nFix: leave adjoint out (both modes then work), or drift="none".'
        )


def check_max_steps(max_steps: Any):
    """Raise unless max_steps is None or a positive whole number."""
    if max_steps is not None:
        must_be_whole(max_steps, "max_steps", most=MOST_STEPS, fix="max_steps=10**6, or None for no limit")


def check_drift(drift: Any, constrained: bool) -> str:
    """Return the drift control to use; raise if it is unknown. `constrained`: whether there are constraints."""
    if drift is None:
        return "project" if constrained else "none"
    must_be_among(("project", "baumgarte", "none"), drift, "drift", 'leave it out, or drift="project"')
    return drift if constrained else "none"


def check_controller(controller: Any, max_step: Any, jump_ts: Any):
    """Raise if the user's stepsize_controller is no controller, or max_step or jump_ts are given beside it."""
    if controller is None:
        return
    fix = "leave it out, or stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9)"
    claim = "stepsize_controller must be a controller of diffrax"
    must_be(diffrax.AbstractStepSizeController, controller, claim, fix, "a controller given by its name")
    for name, given, fix in (
        ("max_step", max_step, "stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9, dtmax=0.1)"),
        ("jump_ts", jump_ts, "stepsize_controller=diffrax.ClipStepSizeController(controller, jump_ts=jump_ts)"),
    ):
        why = "the one limits the steps that lagjax chooses, and the other replaces that choice"
        must_not_meet({name: given, "stepsize_controller": controller}, why, f"leave stepsize_controller out, or {fix}")


def vector_of_times(ts: Any):
    """Return `ts` as an array of two or more numbers, or raise."""
    given, ts = ts, numpy_of(ts).asarray(ts)
    real = jnp.issubdtype(ts.dtype, jnp.floating) or jnp.issubdtype(ts.dtype, jnp.integer)
    if real and ts.ndim == 1 and not isinstance(ts.shape[0], int):
        raise ValueError(
            f"the number of output times must be known when a motion is exported, and is {ts.shape[0]}.\n"
            "Fix: as many times as are ever needed, jax.ShapeDtypeStruct((1000,), float)."
        )
    if not real or ts.ndim != 1 or len(ts) < 2:
        actual = f"has shape {ts.shape}" if real else f"is {given!r:.60}"
        raise ValueError(
            f"ts must be a vector of at least two times, and {actual}.\n"
            "Usual cause: only the last time was given; the motion starts at ts[0] with (q0, v0).\n"
            "Fix: ts=jnp.linspace(0.0, 10.0, 101)."
        )
    return ts


def times(ts: Any, dtype: np.dtype):
    """Return a vector of times in `dtype`; raise unless it increases or decreases throughout."""
    ts = ts.astype(dtype)
    if not is_traced(ts):
        must_be_finite(ts, "ts", "give finite times")
        backward = bool(ts[-1] < ts[0])
        wrong = ts[1:] >= ts[:-1] if backward else ts[1:] <= ts[:-1]
        if wrong.any():
            i = int(np.argmax(wrong))
            raise ValueError(
                f"ts must {'decrease' if backward else 'increase'} throughout, as from its first time to its last, but "
                f"ts[{i + 1}] = {float(ts[i + 1]):.9g} follows ts[{i}] = {float(ts[i]):.9g}.\n"
                "Usual cause: times out of order, a repeated time, or times closer than "
                f"{dtype} can tell apart.\n"
                "Fix: ts=jnp.unique(ts), and ts=jnp.unique(ts)[::-1] to run backward in time."
            )
        resolved = RESOLVED * np.finfo(dtype).eps * float(np.max(np.abs(ts)))
        if abs(float(ts[-1]) - float(ts[0])) <= resolved:
            raise ValueError(
                f"ts go from {float(ts[0]):.17g} to {float(ts[-1]):.17g}, and {dtype} tells apart only "
                f"{max(1, round(abs(float(ts[-1]) - float(ts[0])) / float(np.spacing(np.max(np.abs(ts))))))} times "
                "on the way: there is no room for steps.\n"
                "Fix: count time from the start, ts - ts[0], with the start's time in params."
            )
    return ts


def step_length(value: Any, name: str, dtype: np.dtype):
    """Return `dt0` or `max_step` as a number of `dtype`, or None if not given; raise unless it is positive."""
    if value is None:
        return None
    fixed = ", or with fixed steps dt0=1e-3 for example" if name == "dt0" else ", or max_step=0.1 for example"
    cause = "a negative step where ts decreases; it is a length in both directions"
    well = is_traced(value) or _is_number(value) and float(value) > 0
    must(well, f"{name} must be one positive number", value, f"leave {name} out{fixed}", cause)
    return numpy_of(value).asarray(value, dtype)


def jumps(jump_ts: Any, dtype: np.dtype):
    """Return the times at which a force jumps, (J,) of `dtype`, or None without any; raise unless they are a vector."""
    if jump_ts is None:
        return None
    jump_ts = jnp.stack([*jump_ts]) if isinstance(jump_ts, (list, tuple)) and is_traced(jump_ts) else jump_ts
    kind, shape = (jump_ts if hasattr(jump_ts, "dtype") else np.asarray(jump_ts)).dtype, np.shape(jump_ts)
    well = len(shape) < 2 and np.issubdtype(kind, np.number) and not np.issubdtype(kind, np.complexfloating)
    fix = "jump_ts=jnp.array([50.25, 50.35]), the times at which the force jumps or has a kink"
    must(well, "jump_ts must be a vector of times", jump_ts, fix)
    must_be_finite(jump_ts, "jump_ts", "give finite times")
    return jnp.atleast_1d(jnp.asarray(jump_ts, dtype)) if np.prod(shape) else None


def _is_number(value: Any):
    return isinstance(value, int | float | np.ndarray | np.generic | jax.Array) and np.ndim(value) == 0


def tolerance(value: Any, name: str, dtype: np.dtype):
    """Return the tolerances of coordinates and of velocities, (2,) of `dtype`; raise if `dtype` cannot reach them."""
    dtype = np.dtype(dtype)
    value = DEFAULT_TOLERANCE.get(dtype, 1e-2) if value is None else value
    if isinstance(value, (tuple, list)) and is_traced(value):
        value = jnp.stack([jnp.asarray(x, dtype) for x in value])
    is_text = isinstance(value, str) or not isinstance(value, jax.Array) and np.asarray(value).dtype.kind not in "fiu"
    well, claim = not is_text and np.shape(value) in ((), (2,)), "must be one number, or two, one for velocities"
    must(well, f"{name} {claim}", value, f"{name}=1e-9, or {name}=(1e-9, 1e-6)")
    if is_traced(value):
        return jnp.broadcast_to(jnp.asarray(value, dtype), 2)
    return _tolerance(value if isinstance(value, float) else tuple(np.asarray(value, float).flat), name, dtype)


def is_loose(rtol: Any, dtype: np.dtype) -> bool:
    """Whether tolerances, as `tolerance` returns them, suit a method of low order; traced ones count as the default."""
    if is_traced(rtol):
        return DEFAULT_TOLERANCE.get(np.dtype(dtype), 1e-2) >= LOOSE
    return bool(np.min(rtol) >= (1 - 1e-6) * LOOSE)


@once
def _tolerance(value: Any, name: str, dtype: np.dtype):
    _check_tolerance(np.min(value), name, dtype)
    _check_tolerance(np.max(value), name, dtype)
    return np.full(2, value, dtype)


def _check_tolerance(value: Any, name: str, dtype: np.dtype):
    if value == np.inf:
        raise ValueError(
            f"{name} is infinite, which allows any error in a step: nothing would choose the steps.\n"
            "Fix: a finite tolerance; or, for steps of a fixed length, "
            "stepsize_controller=diffrax.ConstantStepSize(), dt0=0.01."
        )
    must(value >= 0, f"{name} must be a number >= 0", value, f"{name}=1e-9, or leave it out")
    if name == "rtol":
        check_reach(value, name, dtype)


def check_reach(value: float, name: str, dtype: np.dtype):
    """Raise for a relative tolerance that a dtype cannot reach."""
    floor, single = ROUND_OFFS * float(jnp.finfo(dtype).eps), dtype == np.dtype("float32")
    if value < floor:
        cause = "JAX works in float32 unless told otherwise" if single else "a wrong exponent"
        remedy = 'jax.config.update("jax_enable_x64", True) before the first array, or ' if single else ""
        raise ValueError(
            f"{name} = {value:.3g} is below what {dtype} can reach ({floor:.1g}).\n"
            f"Usual cause: {cause}.\nFix: {remedy}{name}={10 * floor:.0e} or more."
        )


def check_finite(s: State):
    """Raise if a coordinate or velocity of the initial state is not finite."""
    for which, tree in (("q0", s.q), ("v0", s.v)):
        values = np.asarray(coordinates.flatten(tree)[0])
        for name, value in zip(coordinates.names(tree), values):
            if not np.isfinite(value):
                raise ValueError(
                    f"coordinate '{name}' of {which} is {value}.\n"
                    "Usual cause: a division by zero, or a missing measurement.\n"
                    "Fix: start from finite numbers."
                )


def off_constraints(model: Model, s: State, rtol, atol) -> str:
    """Say which constraints the initial state violates."""
    check_finite(s)
    violated = departures(model, s, rtol, atol) or departures(model, s, 0.0, 0.0)
    if any(f"= {word}" in violated for word in ("nan", "inf", "-inf")):
        return (
            f"constraints are not finite at the initial state: {violated}.\n"
            "Usual cause: NaN or infinity in params, or a constraint evaluated outside its domain.\n"
            "Fix: look at lj.constraint_residual(system, ts[0], q0, v0, params), and at params."
        )
    return (
        f"the initial state is off the constraints: {violated}, which must be 0.\n"
        "Usual cause: a coordinate or velocity computed for other parameters, or rounded.\n"
        "Fix: q0, v0 = lj.consistent_state(system, ts[0], q0, v0, params) for a consistent state near it."
    )


def warn_of_inaccuracy(trajectory: Trajectory):
    """Warn if the error, or the change of a constant of the motion, exceeds what the tolerance lets expect."""
    if float(trajectory.scaled_error) <= 1:
        return
    estimated = trajectory.error is not None and account_of(trajectory) is not None
    words = warning_of(trajectory) if estimated else _of_drift(trajectory)
    warn(words, AccuracyWarning)


def _of_drift(trajectory: Trajectory):
    drift, rtol = float(trajectory.drift()), float(trajectory.tolerance[0][0])
    span, steps = abs(float(trajectory.end.t - trajectory.t[0])), int(trajectory.stats["num_accepted_steps"])
    dtype, how = np.asarray(trajectory.t).dtype, trajectory.static.how.steps
    fix = f"rtol={max(rtol / 1e3, 1e2 * float(np.finfo(dtype).eps)):.0e}"
    if how in ("fixed", "controller"):
        fix = "shorter steps" if how == "fixed" else "tighter tolerances of the stepsize_controller"
    elif rtol < 1e3 * np.finfo(dtype).eps:
        fix = "a shorter span" + (", or float64" if dtype == np.dtype("float32") else "")
    off = f", and a constraint is off by {float(trajectory.residual()):.1g}" if trajectory.system.constraints else ""
    return (
        f"over a time of {span:.6g} ({steps} steps) the Jacobi integral, which should stay constant, changed by "
        f"{drift:.1g} of its size{off}, at the outputs, at rtol = {rtol:.1g}.\n"
        f"Fix: {fix}. What caused it, estimate_error=True says."
    )


# Round-off of an R with several terms, in units of the last place.
ROUND_OFFS_OF_R = 100
# Functions already checked and found correct: this saves 1 ms a call.
_in_order = weakref.WeakSet()


def warn_of_odd_dissipation(dissipation: Callable | None, state: State) -> None:
    """Warn if R changes its sign with the velocities. Nothing is checked if the values are traced."""
    known = isinstance(dissipation, FunctionType) and dissipation in _in_order
    if dissipation is None or known or is_traced(state):
        return
    t, q, v, params = coordinates.as_arrays(state, state.t.dtype)
    # While JAX traces something else, values that it does not trace can still be checked.
    with at_once():
        both = _both_ways(dissipation, t, q, _without_zeros(v), params)
    if is_traced(both):
        return
    plus, minus = map(float, both)
    if plus != 0 and abs(plus + minus) <= ROUND_OFFS_OF_R * float(jnp.finfo(t.dtype).eps) * abs(plus):
        name = getattr(dissipation, "__name__", "f")
        name = "f" if name == "<lambda>" else name
        warn(
            "dissipation R(t, q, v, params) changes its sign with v, R(-v) = -R(v): it gives as much energy to one "
            "motion as it takes from the reversed one.\n"
            "Usual cause: a force given in place of Rayleigh's function R, whose force is -∂R/∂v.\n"
            f"Fix: force={name}, if -c v is meant as a force; or R = 0.5 c v², whose force is -c v. Friction of "
            "constant size has R = c |v|.",
            UserWarning,
        )
    elif isinstance(dissipation, FunctionType):
        _in_order.add(dissipation)


@compiled
def _both_ways(dissipation: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    return [dissipation(t, q, jax.tree.map(lambda x: sign * x, v), params) for sign in (1, -1)]


def _without_zeros(v: PyTree):
    """The velocities, each zero replaced by an irregular number."""
    flat = coordinates.vector(v)
    usual = np.max(np.abs(flat)) or 1.0
    irregular = usual * (0.5 + np.modf(0.6180339887 * np.arange(1, len(flat) + 1))[0])
    return coordinates.like(v, np.where(flat == 0, irregular, flat).astype(flat.dtype))
