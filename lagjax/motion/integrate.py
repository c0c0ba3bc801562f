"""The front door: a trajectory from a system and an initial state.

    check the arguments  ->  one compiled solve by diffrax  ->  say what went wrong, if anything did

All looking at values happens outside the compiled program, so that it can be cached, batched and
differentiated; inside it, a start that cannot be integrated becomes NaN at once and the lane keeps the reason.
"""

import importlib.util
from collections.abc import Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Float, PyTree

from lagjax.mechanics import coordinates
from lagjax.mechanics.multipliers import (
    equations_of_motion,
    explain_failure,
    explain_singular,
    linear_system,
    saddle_point_matrix,
)
from lagjax.mechanics.system import System
from lagjax.motion import problem
from lagjax.motion.both_modes import solve_in_both_modes
from lagjax.motion.consistency import level_size, residuals_and_slopes, to_manifold
from lagjax.motion.stepping import OnManifold, forward_differentiable
from lagjax.motion.trajectory import RESULTS, Moment, Static, Trajectory, message, pack

# A start may be off the constraints by this many tolerances; it is then moved onto them.
START_TOLERANCES = 100.0
# Baumgarte's feedback decays a violation this many times over the time span.
BAUMGARTE_DECAYS = 50.0


class Settings(eqx.Module):
    """How to integrate: everything but the system, the state and the times."""

    method: diffrax.AbstractSolver
    controller: diffrax.AbstractStepSizeController | None
    event: diffrax.Event | None
    adjoint: diffrax.AbstractAdjoint | None
    rtol: Float[Array, ""]
    atol: Float[Array, ""]
    dt0: Float[Array, ""] | None
    max_steps: int | None = eqx.field(static=True)
    drift: str = eqx.field(static=True)
    progress: bool = eqx.field(static=True)


def integrate(
    system: System,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    ts: ArrayLike | Sequence[float],
    rtol: ArrayLike | None = None,
    atol: ArrayLike | None = None,
    method: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: ArrayLike | None = None,
    event: diffrax.Event | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = 2**20,
    throw: bool = True,
    progress: bool = False,
    drift: str | None = None,
) -> Trajectory:
    """Integrate Lagrange's equations from (q0, v0) at `ts[0]`, with outputs at `ts`.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> traj = integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=jnp.array([0.0, 0.2, 0.6]))
    >>> print(traj.q.round(9))
    [0.  0.4 0. ]

    **Main arguments:**

    - `system`: the `System`.
    - `q0`, `v0`: initial coordinates and velocities, any pytree of float arrays, alike; `[q]`, `[q]/[t]`. A start
      that is off the constraints by no more than about the tolerance is moved onto them.
    - `params`: what the Lagrangian takes; gradients flow to its floating arrays.
    - `ts` (T,): increasing output times, `[t]`. Outputs are steps of the method, not interpolations.
    - `rtol`, `atol`: tolerances of the local error of q and v. By default 1e-9 in float64, 1e-5 in float32.

    **Other arguments:**

    - `method`: any diffrax solver; `diffrax.Dopri8()` by default, the cheapest of diffrax's explicit methods
      below an error of 1e-6 on the scenes (`python -m lagjax` prints the comparison).
    - `stepsize_controller`: any diffrax controller, in place of `diffrax.PIDController(rtol, atol)`.
    - `dt0`: the first step, `[t]`; needed with `diffrax.ConstantStepSize()`.
    - `event`: a `diffrax.Event` whose condition takes `(t, (q, v), params, **kwargs)`. Without a root finder of
      its own, a real-valued condition is located to round-off.
    - `adjoint`: any diffrax adjoint. Without one, forward and reverse mode both work.
    - `max_steps`: the largest number of steps, accepted and rejected.
    - `throw`: raise where the integration fails. With `throw=False` the trajectory carries the reason in
      `result` and NaN from there on.
    - `progress`: show a progress meter.
    - `drift`: `"project"` (return to the constraints after every step; the default where there are any),
      `"baumgarte"` (feedback at 50 decays a time span), or `"none"`.

    **Returns:** a `Trajectory`.

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind, shape or dtype; `ts` that does not increase; a
      tolerance below the dtype's reach.
    - `ValueError` for a start off the constraints, or one where L or its equations are singular or not finite.
    - `RuntimeError` where the integration stops early: `max_steps` reached, or a step size that collapsed.

    Order and accuracy: those of `method`; `tests/motion/test_integrate.py` measures them.

    Source: Hairer & Wanner, *Solving ODEs II*, §VII.2 (projection); Kidger, arXiv:2202.02435 (diffrax).
    """
    problem.check_system(system)
    method = diffrax.Dopri8() if method is None else method
    problem.check_method(method)
    t0 = ts[0] if len(np.shape(ts)) == 1 and np.shape(ts)[0] else 0.0
    start = coordinates.state(t0, q0, v0, params)
    dtype = start.t.dtype
    problem.check_functions(system, start)
    settings = Settings(
        method=method,
        controller=stepsize_controller,
        event=event,
        adjoint=adjoint,
        rtol=problem.tolerance(rtol, "rtol", dtype),
        atol=problem.tolerance(atol, "atol", dtype),
        dt0=None if dt0 is None else jnp.asarray(dt0, dtype),
        max_steps=max_steps,
        drift=problem.check_drift(drift, system),
        progress=progress,
    )
    ts = problem.times(ts, dtype)
    trajectory, matrix = _integrate(system, start.q, start.v, start.params, ts, settings)
    if throw:
        trajectory = _raise_failure(trajectory, matrix, start._replace(t=ts[0]), settings)
    return trajectory


@eqx.filter_jit
def _integrate(system, q0, v0, params, ts, settings):
    """Split all that is differentiable from the rest, and solve."""
    everything = (system, q0, v0, params, ts)
    x, rest = eqx.partition(everything, eqx.is_inexact_array)
    fixed, static = eqx.partition((rest, settings), eqx.is_array)

    def solved(x, fixed, adjoint):
        rest, settings = eqx.combine(fixed, static)
        return _solve(*eqx.combine(x, rest), settings, adjoint)

    if settings.adjoint is None:
        parts = solve_in_both_modes(solved, x, fixed)
    else:
        parts = solved(x, fixed, settings.adjoint)
    q, v, multipliers, end, stats, result, matrix = parts
    arrays, static_parts, structure = pack(system, params)
    name = type(settings.method).__name__
    trajectory = Trajectory(
        t=ts,
        q=q,
        v=v,
        multipliers=multipliers,
        end=end,
        stats=stats,
        result=result,
        tolerance=(settings.rtol, settings.atol),
        arrays=arrays,
        static=Static(static_parts, structure, name),
    )
    return trajectory, matrix


def _solve(system, q0, v0, params, ts, settings, adjoint):
    """The compiled program: start, diffrax's loop, outputs."""
    project = settings.drift == "project"
    if project:
        trouble = _start_trouble(system, ts[0], q0, v0, params, settings)
        q0, v0 = to_manifold(system, ts[0], q0, v0, params)
    else:
        trouble = jnp.asarray(False)
    matrix, finite = _start_equations(system, ts[0], q0, v0, params)
    # NaN makes diffrax stop within a few rejected steps, and is what a failed lane should hold.
    y0 = jax.tree.map(lambda x: jnp.where(trouble | ~finite, jnp.nan, x), (q0, v0))

    method = settings.method if settings.event is None else forward_differentiable(settings.method)
    terms = diffrax.ODETerm(_vector_field(system, ts, settings.drift))
    solution = diffrax.diffeqsolve(
        terms,
        OnManifold(method, system, terms, params, project),
        t0=ts[0],
        t1=ts[-1],
        dt0=settings.dt0,
        y0=y0,
        args=params,
        saveat=diffrax.SaveAt(subs=(diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True))),
        stepsize_controller=_controller(ts, settings),
        adjoint=adjoint,
        event=_located_event(settings.event, ts),
        max_steps=settings.max_steps,
        throw=False,
        progress_meter=_progress_meter(settings.progress),
    )
    (reached_ts, end_t), ((q, v), (end_q, end_v)) = solution.ts, solution.ys
    # What was not reached is evaluated at the start and masked afterwards: NaN times zero would poison gradients.
    reached = jnp.isfinite(reached_ts)
    q, v = jax.tree.map(lambda x, x0: jnp.where(_like(reached, x), x, x0), (q, v), (q0, v0))
    # One compiled evaluation for the outputs and the end together.
    multipliers = _multipliers(system, *jax.tree.map(_append, (ts, q, v), (end_t, end_q, end_v)), params)
    end = jax.tree.map(lambda x: x[-1], Moment(end_t, end_q, end_v, multipliers))
    q, v, multipliers = jax.tree.map(
        lambda x: jnp.where(_like(reached, x), x, jnp.nan), (q, v, jax.tree.map(lambda x: x[:-1], multipliers))
    )
    result = RESULTS.promote(solution.result)
    result = RESULTS.where(finite, result, RESULTS.start_not_finite)
    result = RESULTS.where(trouble, RESULTS.start_off_constraints, result)
    stats = {k: jnp.asarray(n) for k, n in solution.stats.items() if k != "max_steps"}
    return q, v, multipliers, end, stats, result, matrix


def _vector_field(system, ts, drift):
    """d(q, v)/dt = (v, a), on the user's pytrees."""
    rate = BAUMGARTE_DECAYS / (ts[-1] - ts[0])

    def field(t, y, params):
        q, v = y
        return v, equations_of_motion(system, t, q, v, params, rate if drift == "baumgarte" else None)[0]

    return field


def _multipliers(system, ts, q, v, params):
    at = lambda t, q, v: equations_of_motion(system, t, q, v, params)[1]
    return jax.vmap(at)(ts, q, v) if system.constraints else {}


def _start_trouble(system, t, q, v, params, settings):
    residual, slope, size = residuals_and_slopes(system, t, q, v, params)
    allowed = START_TOLERANCES * (slope @ (settings.atol + settings.rtol * level_size(size)))
    return ~jnp.all(jnp.abs(residual) <= allowed)


def _start_equations(system, t, q, v, params):
    """The matrix of the equations at the start, and whether all of them are finite."""
    linear, rows, lagrangian = linear_system(system, t, q, v, params)
    solution = equations_of_motion(system, t, q, v, params)
    finite = jnp.all(jnp.isfinite(coordinates.flatten((solution, lagrangian))[0]))
    return jax.lax.stop_gradient(saddle_point_matrix(linear.mass, rows.jacobian)), finite


def _controller(ts, settings):
    if settings.controller is not None:
        return settings.controller
    # A step that small no longer moves t: the solution is singular there, or was NaN from the start.
    dtmin = 16 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    return diffrax.PIDController(rtol=settings.rtol, atol=settings.atol, dtmin=dtmin, force_dtmin=False)


def _located_event(event, ts):
    """Locate a real-valued event to round-off in t where the user names no root finder."""
    if event is None or event.root_finder is not None:
        return event
    round_off = 4 * jnp.finfo(ts.dtype).eps

    def small(condition):
        # Bisection also asks |f| < atol, in the unit of t; only the sign of f is of interest here.
        def scaled(t, y, args, **kwargs):
            value = jnp.asarray(condition(t, y, args, **kwargs))
            return value if value.dtype == bool else 1e-20 * value

        return scaled

    finder = optx.Bisection(rtol=round_off, atol=round_off * (ts[-1] - ts[0]))
    return diffrax.Event(jax.tree.map(small, event.cond_fn, is_leaf=callable), finder, event.direction)


def _progress_meter(progress):
    if not progress:
        return diffrax.NoProgressMeter()
    if importlib.util.find_spec("tqdm") is None:
        return diffrax.TextProgressMeter()
    return diffrax.TqdmProgressMeter()


def _append(outputs, last):
    return jnp.concatenate([outputs, last])


def _like(mask, x):
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))


def _raise_failure(trajectory, matrix, start, settings):
    """Raise in the user's words; while tracing, at run time with the result's own message."""
    ended_well = (trajectory.result == RESULTS.successful) | (trajectory.result == RESULTS.event_occurred)
    if coordinates.is_traced(trajectory):
        return trajectory.result.error_if(trajectory, ~ended_well)
    system = trajectory.system
    if not ended_well:
        if bool(trajectory.result == RESULTS.start_off_constraints):
            tolerances = (START_TOLERANCES * float(tol) for tol in trajectory.tolerance)
            raise ValueError(problem.off_constraints(system, start, *tolerances))
        if bool(trajectory.result == RESULTS.start_not_finite):
            problem.check_finite(start)
            raise ValueError(explain_failure(system, start) or message(trajectory.result))
        raise RuntimeError(problem.stopped_early(trajectory, settings.max_steps))
    singular = explain_singular(np.asarray(matrix), system, start)
    if singular:
        raise ValueError(singular)
    return trajectory
