"""Integrate one motion from its start to its end, event or failure: start, diffrax's loop, outputs, result.

No Python code here branches on values: a start that cannot be integrated is refused inside the program, which then
ends within a few rejected steps, and the lane keeps the reason in its result.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.events.event_times import all_known, by_name, end_of
from lagjax.integrate.solve.error_estimate import ROUND_OFFS
from lagjax.integrate.solve.loop import Solution, solution_of
from lagjax.integrate.stepping.step_to_outputs import apart_from_jumps
from lagjax.integrate.stepping.tolerances import Scales, rounding, scales_of, shared, span_of, tolerances_at
from lagjax.integrate.trajectory.results import RESULTS, ended_well
from lagjax.integrate.trajectory.trajectory import Snapshot, worst_drift
from lagjax.jaxtools.trees import like, stop_gradient
from lagjax.mechanics.equations import Equations, all_finite, equations_of
from lagjax.mechanics.projection import returned, within, worst_residual
from lagjax.mechanics.structure import conserves_jacobi_integral
from lagjax.numerics.methods.nystrom import Nystrom
from lagjax.numerics.methods.runge_kutta import ExplicitRungeKutta
from lagjax.system import coordinates
from lagjax.system.coordinates import State
from lagjax.system.model import model_of

# A start may be off the constraints by this many tolerances; it is then moved onto them.
START_TOLERANCES = 100.0
# A motion of a hundred periods changes the Jacobi integral by ten to a hundred tolerances.
DRIFT_TOLERANCES = 1e3
# That change times the number of steps is about twenty times the phase shift in radians; 0.01 rad is allowed.
PHASE_STEPS = 0.2
# With fixed steps no tolerance says what change to expect.
FIXED_STEPS_ALLOW = 1e-5
# Results that the robust solve would give as well.
UNAFFECTED = RESULTS.max_steps_reached, RESULTS.start_off_constraints, RESULTS.tolerance_too_small, RESULTS.unordered
# diffrax's results and the names of ours that replace them.
TRANSLATED = {
    "nonfinite_input": "not_finite",
    "nonlinear_divergence": "unsolved_step",
    "nonlinear_max_steps_reached": "unsolved_step",
}


def solved(system, q0, v0, params, ts, guards, settings, adjoint, sizes_so_far=None):
    """Return the fields of the trajectory of one system by name, with `settled`: whether the robust solve would agree.

    `sizes_so_far` (2, n): the largest coordinates and velocities of the earlier legs, where this is not the first one.
    """
    ours = isinstance(settings.method, (ExplicitRungeKutta, Nystrom))
    # A condition for diffrax evaluates the vector field at the state that it gets, which is the user's.
    fast = ours and settings.event is None
    equations = equations_of(model_of(system, ts[0], q0, v0, params), fast=fast, fallback=settings.robust)
    if guards is not None and equations.users is not None:
        guards = guards.in_numbers(equations.users.tree)
    q, v = equations.inside(q0), equations.inside(v0)
    start = _start(equations, q, v, ts, settings, sizes_so_far)
    settings = replace(settings, atol=start.atol)
    solution = _stepped(equations, start, ts, guards, settings, adjoint)
    outputs = _outputs(equations, start, solution, ts, settings)
    fields = _result(equations, start, solution, outputs, guards, settings)
    rows = jax.vmap(equations.outside)
    end, events = fields["end"], fields["events"]
    return fields | {
        "record": solution.record,
        "q": rows(fields["q"]),
        "v": rows(fields["v"]),
        "end": end._replace(q=equations.outside(end.q), v=equations.outside(end.v)),
        "events": {name: found.with_states(rows(found.q), rows(found.v)) for name, found in events.items()},
    }


class Start(NamedTuple):
    """The first state, moved onto the constraints; `against`: which reasons to refuse it hold, by names of `RESULTS`.

    `atol`: as given, or by the state's size; `scales`: those of the motion, if tolerances are relative to its size.
    """

    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    against: dict[str, Bool[Array, ""]]
    refused: Bool[Array, ""]
    atol: Float[Array, " 2"]
    scales: Scales | None


class Outputs(NamedTuple):
    """The motion at the outputs and, as the last row, at its end; which outputs were `reached`; which are finite.

    At outputs that were not reached it is the start's state.
    """

    motion: Snapshot
    reached: Bool[Array, " T"]
    sound: Bool[Array, " T"]


def _start(equations: Equations, q, v, ts, settings, sizes_so_far) -> Start:
    """Prepare the start; of the reasons to refuse it, the last one that holds becomes the result."""
    t, given, off_constraints = ts[0], State(ts[0], q, v, equations.model.params), jnp.asarray(False)
    if settings.drift == "project":
        q, v, _ = returned(equations, t, q, v, *tolerances_at(given, ts, settings, sizes_so_far))
    a, _, finite, singular, contradictory, mass = stop_gradient(equations.verdict(t, q, v))
    tolerances = rtol, atol = tolerances_at(given, ts, settings, sizes_so_far, a)
    if equations.model.m:
        off_constraints = ~within(equations, *given[:3], START_TOLERANCES * rtol, START_TOLERANCES * atol)
        if settings.drift == "project" and not equations.are_taken_for_regular:
            off_constraints |= finite & ~singular & ~within(equations, t, q, v, *tolerances)
    scales = scales_of(mass, *stop_gradient((q, v)), a, stop_gradient(span_of(ts))) if settings.by_size else None
    if scales is not None and sizes_so_far is not None:
        scales = scales._replace(first=jnp.maximum(scales.first, sizes_so_far))
    too_small = settings.controller is None and settings.rtol[0] < ROUND_OFFS * jnp.finfo(ts.dtype).eps
    lengths = [settings.max_step, *([] if settings.dt0 is None else [settings.dt0])]
    against = {
        "start_singular": singular,
        "start_not_finite": ~finite,
        "contradictory": contradictory,
        "start_off_constraints": off_constraints,
        "tolerance_too_small": jnp.asarray(too_small),
        "unordered": jnp.any(ts[1:] < ts[:-1]) | ~jnp.all(jnp.asarray([True, *(length > 0 for length in lengths)])),
    }
    return Start(q, v, against, jnp.any(jnp.stack([*against.values()])), atol, scales)


def _stepped(equations, start, ts, guards, settings, adjoint) -> Solution:
    y0 = jax.tree.map(lambda x: jnp.where(start.refused, 0.0, x), (start.q, start.v))
    first = State(ts[0], start.q, start.v, equations.model.params)
    if settings.dt0 is not None:
        # A motion with dt0 <= 0 is refused; diffrax's own check would end the program.
        settings = replace(settings, dt0=jnp.where(settings.dt0 > 0, settings.dt0, 1.0))
    solution = solution_of(equations, first, y0, start.refused, start.scales, ts, guards, settings, adjoint)
    if solution.located is None:
        return solution
    end = end_of(guards, solution.located, *solution.end)
    # The step in which the event ended the motion goes on beyond the event.
    return solution._replace(end=end, reached=jnp.where(ts <= end[0], solution.reached, jnp.inf))


def _outputs(equations, start, solution, ts, settings) -> Outputs:
    # Outputs not reached get the start state and are masked afterwards: NaN times zero would poison gradients.
    reached = jnp.isfinite(solution.reached) & ~start.refused
    states = jax.tree.map(lambda x, x0: jnp.where(like(reached, x), x, x0[None]), solution.outputs, (start.q, start.v))
    if settings.jump_ts is not None:
        states = apart_from_jumps(equations, ts, settings.jump_ts, *states)
    # One compiled evaluation for the outputs and the end together.
    t, (q, v) = jax.tree.map(lambda x, last: jnp.concatenate([x, last]), (ts, states), solution.end)
    sound = jax.vmap(all_finite)((q, v))[:-1]
    return Outputs(Snapshot(t, q, v, jax.vmap(equations.multipliers)(t, q, v)), reached, sound)


def _result(equations, start, solution, outputs, guards, settings):
    """The fields of the trajectory: NaN at outputs that it did not reach, and the reason."""
    (motion, reached, sound), located = outputs, solution.located
    result = RESULTS.promote(solution.result)
    for reported, ours in TRANSLATED.items():
        result = RESULTS.where(result == getattr(RESULTS, reported), getattr(RESULTS, ours), result)
    # An output is a step of its own, and can fail although the steps of the solve did not.
    known = jnp.all(sound)
    regular = equations.are_taken_for_regular
    if regular:
        known = known & jnp.all(jnp.isfinite(coordinates.flatten(motion.multipliers)[0]))
        known = known if located is None else known & all_known(located)
    result = RESULTS.where(ended_well(result) & ~known, RESULTS.unsolved_step, result)
    for name, holds in start.against.items():
        result = RESULTS.where(holds, getattr(RESULTS, name), result)
    stats = {name: jnp.asarray(count) for name, count in solution.stats.items() if name != "max_steps"}
    change = _scaled_error(stop_gradient(equations), *stop_gradient((motion.t, motion.q, motion.v)), stats, settings)
    # Nothing is known from the first failed output on; the motion then ends at the output before it.
    up_to = jnp.cumsum(~sound) == 0
    masked = jax.tree.map(lambda x: jnp.where(like(reached & up_to, x), x[:-1], jnp.nan), motion)
    last = jnp.where(jnp.all(up_to), sound.size, jnp.maximum(jnp.sum(up_to) - 1, 0))
    end = jax.tree.map(lambda x: jnp.where(start.refused, jnp.nan, x[last]), motion)._replace(t=motion.t[last])
    return {
        "q": masked.q,
        "v": masked.v,
        "multipliers": masked.multipliers,
        "end": end,
        "stats": stats,
        "tolerance": (settings.rtol, _absolute(stop_gradient((motion.q, motion.v)), start.scales, settings)),
        "scaled_error": jnp.where(ended_well(result), change, jnp.inf),
        "result": result,
        "settled": ended_well(result) | _among(result, UNAFFECTED) if regular else jnp.asarray(True),
        "events": {} if located is None else by_name(guards, located, end.t[None], ~start.refused),
    }


def _absolute(states, scales, settings):
    """The given `atol`; or, if tolerances follow the motion's own size, what was as good as zero on it, (2, n)."""
    if scales is None:
        return settings.atol
    sizes = [coordinates.flatten(jax.tree.map(lambda x: jnp.max(jnp.abs(x), axis=0), y))[0] for y in states]
    return rounding(shared(scales, jnp.stack(sizes)))


def _scaled_error(equations, t, q, v, stats, settings):
    """The change of quantities that must stay constant, at the outputs, in units of what the tolerance lets expect.

    An error of the Jacobi integral that grows steadily shifts the phase by about its size per radian, so over very
    many steps less of it is allowed. If the tolerance does not choose the steps, only the change itself counts.
    """
    model, drift, residual = equations.model, jnp.zeros_like(t[0]), jnp.zeros_like(t[0])
    if conserves_jacobi_integral(model):
        drift = worst_drift(model, t, q, v)
    if model.m and settings.drift != "project":
        residual = worst_residual(model, t, q, v)
    if settings.controller is not None:
        return jnp.maximum(drift, residual) / FIXED_STEPS_ALLOW
    rtol = jnp.maximum(settings.rtol[0], jnp.finfo(t.dtype).eps)
    phase = drift * stats["num_accepted_steps"] / PHASE_STEPS
    return jnp.maximum(jnp.maximum(drift, residual) / (DRIFT_TOLERANCES * rtol), phase)


def _among(result, others):
    return jnp.any(jnp.stack([result == other for other in others]))
