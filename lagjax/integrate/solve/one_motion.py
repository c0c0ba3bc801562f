"""Integrate one motion from its start to its end, event or failure: start, diffrax's loop, outputs, result.

`solved` is the recipe, and the functions that it calls follow in their order; after them what `_loop` gives to diffrax.
No Python code here branches on values: a start that cannot be integrated is refused inside the program, which then
ends within a few rejected steps, and the lane keeps the reason in its result.
"""

import importlib.util
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple, cast

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.equal_steps.loop import stepped
from lagjax.integrate.equal_steps.pace import Pace
from lagjax.integrate.events.brackets import Sight
from lagjax.integrate.events.detect import EventController, Follower
from lagjax.integrate.events.event import Guards
from lagjax.integrate.events.event_times import Located, all_known, at_known_times, by_name, end_of, first_end, locate
from lagjax.integrate.replay import Replay, replayed
from lagjax.integrate.results import RESULTS, Snapshot, ended_well
from lagjax.integrate.settings import Settings, is_recorded
from lagjax.integrate.solve.reports import ROUND_OFFS
from lagjax.integrate.step_record import Recorded, StepProblem, with_room
from lagjax.integrate.stepping import (
    AsNothing,
    FastField,
    Field,
    PerCoordinateTolerance,
    ProjectedSolver,
    Scales,
    StepToOutputs,
    Tolerances,
    apart_from_jumps,
    forward_differentiable,
    rounding,
    scales_of,
    shared,
    span_of,
    together,
    tolerances_at,
)
from lagjax.integrate.trajectory import worst_drift
from lagjax.jaxtools import calls_host, like, one_function, stop_gradient
from lagjax.mechanics import (
    Equations,
    all_finite,
    are_angles,
    conserves_jacobi_integral,
    equations_of,
    returned,
    within,
    worst_residual,
)
from lagjax.numerics import EqualSteps, ExplicitRungeKutta, Nystrom, Radau5, SimplifiedNewton, with_tolerances
from lagjax.system import State, System, coordinates, model_of

# Packages whose checks at run time are known to pass, since `solve` examines their subjects itself.
CHECKED_PACKAGES = {"lagjax", "diffrax", "optimistix"}
# Baumgarte's feedback decays a violation by e this many times over the time span.
BAUMGARTE_DECAYS = 50.0
# A start may be off the constraints by this many tolerances; it is then moved onto them.
START_TOLERANCES = 100.0
# A motion of a hundred periods changes the Jacobi integral by ten to a hundred tolerances.
DRIFT_TOLERANCES = 1e3
# That change times the number of steps is about twenty times the phase shift in radians; 0.01 rad is allowed.
PHASE_STEPS = 0.2
# With fixed steps no tolerance says what change to expect.
FIXED_STEPS_ALLOW = 1e-5
# A loop over steps whose accelerations, in arrays, have more operations than this is compiled in parts: LLVM's time for
# one function grows faster than its length. With 360 operations the parts compile in 7.3 s of processor time in place
# of 8.3, and a call takes 17 ms in place of 13; a vehicle, of 4,600, had its first answer after 57 s in place of 79.
IN_PARTS_FROM = 1000
# Results that the robust solve would give as well.
UNAFFECTED = (
    RESULTS.max_steps_reached, RESULTS.no_progress, RESULTS.start_off_constraints, RESULTS.tolerance_too_small,
    RESULTS.unordered,
)  # fmt: skip
# diffrax's results and the names of ours that replace them.
TRANSLATED = {
    "nonfinite_input": "not_finite",
    "nonlinear_divergence": "unsolved_step",
    "nonlinear_max_steps_reached": "unsolved_step",
    # Controllers end a motion by one of diffrax's own results; none of diffrax's gives this one.
    "max_steps_rejected": "no_progress",
}


def solved(
    system: System, q0: PyTree, v0: PyTree, params: PyTree, ts: Float[Array, " T"], guards: Guards | None,
    settings: Settings, adjoint: diffrax.AbstractAdjoint, sizes_so_far: Float[Array, "2 n"] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Return the fields of the trajectory of one system by name; with `settled`, whether the robust solve would agree,
    and `whole`, M and A at the start.

    `sizes_so_far` (2, n): the largest coordinates and velocities of the earlier legs, where this is not the first one.
    """
    ours = isinstance(settings.method, (ExplicitRungeKutta, Nystrom, EqualSteps))
    # A condition for diffrax evaluates the vector field at the state that it gets, which is the user's.
    fast = ours and settings.event is None
    model = model_of(system, ts[0], q0, v0, params)
    equations = equations_of(model, fast=fast, fallback=settings.robust, differentiated=settings.differentiated)
    first_order = equations.model.form.first_order
    if first_order is not None and settings.drift == "none":
        # Velocities that are determined are returned to their values whatever becomes of constraints.
        settings = replace(settings, drift="project")
    if guards is not None and equations.users is not None:
        guards = guards.in_numbers(equations.users.tree)
    start = _start(equations, equations.inside(q0), equations.inside(v0), ts, settings, sizes_so_far)
    settings = replace(settings, atol=start.atol)
    if settings.dt0 is not None:
        # A motion with dt0 <= 0 is refused; diffrax's own check would end the program.
        settings = replace(settings, dt0=jnp.where(settings.dt0 > 0, settings.dt0, 1.0))
    if guards is None or isinstance(adjoint, diffrax.ForwardMode):
        loop = _in_equal_steps if isinstance(settings.method, EqualSteps) else _loop
        solution = loop(equations, start, ts, guards, settings, adjoint)
    else:
        solution = _loop_twice(equations, start, ts, guards, settings, adjoint)
    if guards is not None and solution.located is not None:
        end = end_of(guards, solution.located, *solution.end)
        # The step in which the event ended the motion goes on beyond the event.
        solution = solution._replace(end=end, reached=jnp.where(ts <= end[0], solution.reached, jnp.inf))
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

    `atol`: as given, or by the state's size; `scales`: those of the motion, if tolerances are relative to its size;
    `whole`: M and A, where they are formed.
    """

    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    against: dict[str, Bool[Array, ""]]
    refused: Bool[Array, ""]
    atol: Float[Array, " 2"]
    scales: Scales | None
    whole: tuple[Float[Array, "n n"], Float[Array, "m n"]] | None


def _start(equations: Equations, q: PyTree, v: PyTree, ts: Array, settings: Settings, sizes_so_far) -> Start:
    """Prepare the start; of the reasons to refuse it, the last one that holds becomes the result."""
    t, given, off_constraints = ts[0], State(ts[0], q, v, equations.model.params), jnp.asarray(False)
    project = settings.drift == "project"
    if equations.are_taken_for_regular:
        (q, v), verdict = equations.begin(t, q, v, project)
    else:
        if project:
            q, v, _ = returned(equations, t, q, v, *tolerances_at(given, ts, settings, sizes_so_far))
        # Nothing of it is differentiated, and it is half of the program of a tree.
        fixed, at = stop_gradient((equations, (t, q, v)))
        verdict = fixed.verdict(*at)
    a, _, finite, singular, contradictory, mass, known, whole = stop_gradient(verdict)
    tolerances = rtol, atol = tolerances_at(given, ts, settings, sizes_so_far, a)
    if equations.model.m:
        off_constraints = ~within(equations, *given[:3], START_TOLERANCES * rtol, START_TOLERANCES * atol, known)
        if project and not equations.are_taken_for_regular:
            off_constraints |= finite & ~singular & ~within(equations, t, q, v, *tolerances)
    first_order = equations.model.form.first_order
    without_mass = np.zeros(equations.model.n, bool) if first_order is None else first_order.mask(equations.model.n)
    at_start = mass, *stop_gradient((q, v)), a, stop_gradient(span_of(ts))
    scales = None
    if settings.by_size:
        scales = scales_of(*at_start, without_mass & ~without_mass.all(), settings.forced)
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
    return Start(q, v, against, jnp.any(jnp.stack([*against.values()])), atol, scales, whole)


class Solution(NamedTuple):
    """The result of the loop: times that it reached (infinite elsewhere), states there, its last time and state, (1,).

    `located`: where guards are zero; None without guards. `record`: that of the steps, if they can be replayed.
    """

    reached: Float[Array, " T"]
    outputs: PyTree[Float[Array, "T ..."]]
    end: tuple[Float[Array, " 1"], PyTree[Float[Array, "1 ..."]]]
    stats: dict[str, Array]
    result: diffrax.RESULTS
    located: Located | None
    record: Recorded | None = None


def _loop(
    equations: Equations, start: Start, ts: Float[Array, " T"], guards: Guards | None, settings: Settings,
    adjoint: diffrax.AbstractAdjoint, repeated: bool = False,
) -> Solution:  # fmt: skip
    """Step through a motion by diffrax; if refused, end within a few steps. Without `scales` by `atol` alone.

    `repeated`: the times of crossings are known, and are among `ts`.
    """
    first = State(ts[0], start.q, start.v, equations.model.params)
    y0 = jax.tree.map(lambda x: jnp.where(start.refused, 0.0, x), (start.q, start.v))
    if isinstance(adjoint, Replay) and not is_recorded(settings.controller, settings.event, settings.progress):
        adjoint = diffrax.RecursiveCheckpointAdjoint()
    feedback = BAUMGARTE_DECAYS / (ts[-1] - ts[0]) if settings.drift == "baumgarte" else None
    fast, written = None, equations.written
    if written is not None and feedback is None:
        unrolled = written.equations.length <= settings.unroll_up_to
        fast = settings.method if unrolled else _in_a_loop(settings.method, adjoint)
    # BacksolveAdjoint integrates a larger state backwards: it takes the bare method, and outputs but no separate end.
    bare = isinstance(adjoint, diffrax.BacksolveAdjoint)
    settings = eqx.tree_at(lambda s: s.method, settings, _with_root_finder(settings, start.scales))
    controller = _controller(equations, ts, settings, start.scales, bare, repeated)
    terms = diffrax.ODETerm(Field(equations, feedback) if fast is None else FastField(equations))
    if bare:
        solver, saveat = settings.method, diffrax.SaveAt(ts=ts)
    else:
        solver = _solver(equations, fast, feedback, start.refused, settings, adjoint)
        subs = diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)
        saveat = diffrax.SaveAt(subs=subs, controller_state=guards is not None)
    if guards is not None:
        controller = EventController(controller, _follower(equations, guards, feedback, ts, settings))
    silent = not _user_calls_python(equations, terms, first, guards, settings, controller)
    if isinstance(adjoint, Replay):
        assert isinstance(controller, StepToOutputs | diffrax.ConstantStepSize)
        before, after = (jnp.searchsorted(ts, ts, side=side) for side in ("left", "right"))
        problem = StepProblem(
            terms, solver, controller, ts, before, after, ts[0], ts[-1], settings.dt0, y0, first.params
        )  # fmt: skip
        found = replayed(with_room(problem, settings.memory), settings.max_steps, silent, adjoint)
        end = found.t[None], jax.tree.map(lambda x: x[None], found.y)
        reached = jnp.where(found.reached, ts, jnp.inf)
        return Solution(reached, found.outputs, end, found.stats, found.result, None, found)

    def solve(
        terms: diffrax.AbstractTerm, solver, t0: Array, t1: Array, dt0, y0: PyTree, args: PyTree, saveat,
        controller: Any, event: Any,
    ):  # fmt: skip
        solution = diffrax.diffeqsolve(
            terms, solver, t0, t1, dt0, y0, args, saveat=saveat, stepsize_controller=controller, adjoint=adjoint,
            event=event, max_steps=settings.max_steps, throw=False, progress_meter=_progress_meter(settings.progress),
        )  # fmt: skip
        watching = isinstance(controller, EventController)
        located = locate(controller.follower, cast(tuple, solution.controller_state)[1]) if watching else None
        return solution.ts, solution.ys, solution.stats, solution.result, located

    arguments = (
        terms, solver, ts[0], ts[-1], settings.dt0, y0, first.params, saveat, controller, _by_position(settings.event),
    )  # fmt: skip
    # Reverse mode needs the operations inside, so the solve is then not wrapped.
    if isinstance(adjoint, diffrax.ForwardMode):
        in_parts = getattr(solver, "in_parts", False)
        reached, outputs, *rest = one_function(solve, *arguments, checked=silent, in_blocks=True, in_parts=in_parts)
    else:
        reached, outputs, *rest = solve(*arguments)
    assert reached is not None and outputs is not None
    if bare:
        end = jax.tree.map(lambda x: x[-1:], (reached, outputs))
    else:
        (reached, end_t), (outputs, end_y) = reached, outputs
        end = end_t, end_y
    return Solution(reached, outputs, end, *rest)


def _in_equal_steps(
    equations: Equations, start: Start, ts: Array, guards: Guards | None, settings: Settings, adjoint: Any,
    wanted: Float[Array, " W"] | None = None,
) -> Solution:  # fmt: skip
    """The same in steps of equal length. `wanted`: the times of the outputs, if not `ts`, which lay out the steps."""
    assert isinstance(settings.method, EqualSteps) and settings.dt0 is not None
    state = jax.tree.map(lambda x: jnp.where(start.refused, 0.0, x), (start.q, start.v))
    at = jnp.where(start.refused, ts[0], ts)
    form, model = equations.users or equations.model.form, equations.model
    pace = None if settings.method.pace is None else Pace(settings.method.pace, form, model.params)
    meter = _progress_meter(settings.progress, often=1)
    follower = None if guards is None else _follower(equations, guards, None, at, settings)
    found = stepped(model, settings, pace, *state, at, adjoint, meter, follower, wanted)
    states, reached, count, end, result, located = found
    stats = {"num_steps": count, "num_accepted_steps": count, "num_rejected_steps": jnp.zeros_like(count)}
    times = ts if wanted is None else wanted
    return Solution(jnp.where(reached, times, jnp.inf), states, end, stats, result, located)


def _loop_twice(
    equations: Equations, start: Start, ts: Float[Array, " T"], guards: Guards, settings: Settings,
    adjoint: diffrax.AbstractAdjoint,
) -> Solution:  # fmt: skip
    """The same in reverse mode, where diffrax differentiates only outputs: crossings, once their times are known,
    become outputs."""
    equal = isinstance(settings.method, EqualSteps)
    loop = _in_equal_steps if equal else _loop
    first = loop(*stop_gradient((equations, start, ts, guards, settings)), diffrax.ForwardMode())
    # Crossings must be ends of steps, and so are then the outputs among them.
    settings = replace(settings, outputs="exact")
    end = jnp.minimum(first.end[0][0], first_end(guards, first.located.t))
    times = jnp.concatenate([ts, first.located.t])
    times = jnp.minimum(jnp.where(jnp.isfinite(times), times, end), end)
    order = jnp.argsort(times)
    without = eqx.tree_at(lambda s: s.event, settings, None, is_leaf=lambda x: x is None)
    if equal:
        second = _in_equal_steps(equations, start, ts, None, without, adjoint, times[order])
    else:
        second = _loop(equations, start, times[order], None, without, adjoint, repeated=True)
    place, bent = jnp.argsort(order), not isinstance(adjoint, Replay) or adjoint.bent
    of_outputs, of_crossings = (
        jax.tree.map(lambda x: x[place[part]], second.outputs) for part in (slice(ts.size), slice(ts.size, None))
    )
    return first._replace(
        reached=jnp.where(jnp.isfinite(second.reached[place[: ts.size]]), first.reached, jnp.inf),
        outputs=of_outputs,
        end=second.end,
        located=at_known_times(guards, equations, resolution(ts), first.located, times[ts.size :], of_crossings, bent),
    )


class Outputs(NamedTuple):
    """The motion at the outputs and, as the last row, at its end; which outputs were `reached`; which are finite.

    At outputs that were not reached it is the start's state.
    """

    motion: Snapshot
    reached: Bool[Array, " T"]
    sound: Bool[Array, " T"]


def _outputs(equations: Equations, start: Start, solution: Solution, ts: Array, settings: Settings) -> Outputs:
    # Outputs not reached get the start state and are masked afterwards: NaN times zero would poison gradients.
    reached = jnp.isfinite(solution.reached) & ~start.refused
    states = jax.tree.map(lambda x, x0: jnp.where(like(reached, x), x, x0[None]), solution.outputs, (start.q, start.v))
    if settings.outputs == "interpolated" and settings.drift == "project":
        # Between states that satisfy the constraints a polynomial is off them by about its error.
        tolerances = settings.rtol, settings.atol
        states = jax.vmap(lambda t, q, v: returned(equations, t, q, v, *tolerances)[:2])(ts, *states)
    if settings.jump_ts is not None:
        states = apart_from_jumps(equations, ts, settings.jump_ts, *states)
    # One compiled evaluation for the outputs and the end together.
    t, (q, v) = jax.tree.map(lambda x, last: jnp.concatenate([x, last]), (ts, states), solution.end)
    sound = jax.vmap(all_finite)((q, v))[:-1]
    return Outputs(Snapshot(t, q, v, equations.multipliers_along(t, q, v)), reached, sound)


def _result(equations: Equations, start: Start, solution: Solution, outputs, guards, settings: Settings):
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
        "whole": start.whole,
        "settled": ended_well(result) | _among(result, UNAFFECTED) if regular else jnp.asarray(True),
        "events": {} if located is None else by_name(guards, located, end.t[None], ~start.refused),
    }


def _absolute(states, scales, settings: Settings):
    """The given `atol`; or, if tolerances follow the motion's own size, what was as good as zero on it, (2, n)."""
    if scales is None:
        return settings.atol
    sizes = [coordinates.flatten(jax.tree.map(lambda x: jnp.max(jnp.abs(x), axis=0), y))[0] for y in states]
    found = rounding(shared(scales, jnp.stack(sizes)))
    if (forced := scales.forced) is None:
        return found
    # A motion that is continued from an output knows of its forces by this.
    return found + forced.left_over(jnp.max(forced.a, axis=0), forced.t[-1] - forced.t[0])


def _scaled_error(equations: Equations, t: Array, q: PyTree, v: PyTree, stats: dict[str, Array], settings: Settings):
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


def _user_calls_python(
    equations: Equations, terms: diffrax.AbstractTerm, first: State, guards, settings: Settings, controller: Any
):
    """Whether the user's functions, method or controller may call Python at run time, if only to check something.

    If not, only diffrax's checks are left. They concern the times and the first step, which `solve` examines itself.
    """
    parts = (settings.method, settings.controller)
    if any(part is not None and type(part).__module__.split(".")[0] not in CHECKED_PACKAGES for part in parts):
        return True
    (t, q, v, params), written = first, equations.written
    if written is None:
        traced = [jax.make_jaxpr(lambda t, y: terms.vf(t, y, params))(t, (q, v))]
    else:
        traced = []
        if any(numbers.calls_host for numbers in (written.equations, written.project) if numbers is not None):
            return True
    if guards is not None:
        multipliers = equations.model.zero_multipliers()
        traced.append(jax.make_jaxpr(lambda t, q, v: guards(t, q, v, multipliers, params))(t, q, v))
    conditions = jax.tree.leaves(settings.event.cond_fn, is_leaf=callable) if settings.event is not None else ()
    given = dict(terms=terms, solver=settings.method, t0=t, t1=t, dt0=None, max_steps=settings.max_steps)
    given |= dict(saveat=None, stepsize_controller=controller)
    for condition in conditions:
        traced.append(jax.make_jaxpr(lambda t, y, condition=condition: condition(t, y, params, **given))(t, (q, v)))
    return any(calls_host(program.jaxpr) for program in traced)


def method_alone(settings: Settings, method):
    """Return a method as it steps a motion on equations that are not written out."""
    return _in_a_loop(_with_root_finder(replace(settings, method=method), None), diffrax.ForwardMode())


def _with_root_finder(settings: Settings, scales):
    """An implicit method with diffrax's default root finder gets ours; all get the solve's tolerances."""
    method, tolerances = settings.method, (settings.rtol[0], settings.atol[0])
    if scales is not None and isinstance(method, Radau5):
        as_nothing = AsNothing(scales, settings.rtol)
        ours = isinstance(method.root_finder, SimplifiedNewton)
        tolerances = settings.rtol[0], as_nothing if ours else as_nothing(jnp.zeros_like(scales.first))
    if isinstance(getattr(method, "root_finder", None), diffrax.VeryChord):
        return eqx.tree_at(lambda method: method.root_finder, method, SimplifiedNewton(*tolerances))
    return with_tolerances(method, *tolerances)


def _solver(equations: Equations, fast, feedback, refused, settings: Settings, adjoint: Any):
    return ProjectedSolver(
        solver=_in_a_loop(settings.method, adjoint),
        equations=equations,
        fast=fast,
        feedback=feedback,
        refused=refused,
        tolerances=Tolerances(settings.rtol, settings.atol),
        controlled=settings.controller is None,
        project=settings.drift == "project",
        arriving=_arriving(settings),
        between=settings.outputs == "interpolated",
        jump_ts=settings.jump_ts,
        in_parts=isinstance(adjoint, diffrax.ForwardMode) and _is_long(equations),
    )


def _is_long(equations: Equations) -> bool:
    return equations.written is None and equations.operations(*equations.model.form.example) > IN_PARTS_FROM


def _in_a_loop(method, adjoint: Any):
    """Return the method with a loop over its stages, of the kind that the derivative needs."""
    if isinstance(method, Nystrom) or isinstance(method, ExplicitRungeKutta) and isinstance(adjoint, Replay):
        return replace(method, in_a_loop=True)
    # A subclass may have a tableau of its own, which diffrax's implementation does not know.
    ours = isinstance(method, ExplicitRungeKutta) and method.tableau is method.shipped.tableau
    method = method.shipped if ours else method
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint | diffrax.DirectAdjoint | Replay):
        return forward_differentiable(method)
    return eqx.tree_at(lambda s: s.scan_kind, method, "lax", is_leaf=lambda x: x is None) if ours else method


def _arriving(settings: Settings):
    # A user's controller chooses its steps itself; a condition for diffrax may read the controller's tolerances.
    return settings.controller is None and settings.event is None


def _controller(equations: Equations, ts: Array, settings: Settings, scales, bare: bool, repeated: bool):
    if settings.controller is not None:
        return settings.controller
    # A step that small no longer moves t: the solution is singular there, or was NaN from the start.
    dtmin = 16 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    # The largest error counts, not the mean: more coordinates should not loosen the tolerance of each.
    controller = diffrax.PIDController(
        rtol=settings.rtol[0], atol=settings.atol[0], norm=optx.max_norm, dtmin=dtmin, dtmax=settings.max_step,
        force_dtmin=False,
    )  # fmt: skip
    angle = tuple(are_angles(equations.model).tolist())
    if not bare and (scales is not None or settings.apart or any(angle)):
        controller = PerCoordinateTolerance(controller, Tolerances(settings.rtol, settings.atol), scales, angle)
    arriving = _arriving(settings) and not bare
    # Where no output is the end of a step.
    ends = ts if arriving and settings.outputs == "exact" else ts[np.array([0, -1])]
    if settings.jump_ts is None and not repeated:
        return StepToOutputs(controller, ends, settings.shares, settings.max_steps) if arriving else controller
    jumps = ts[-1:] if settings.jump_ts is None else settings.jump_ts
    return StepToOutputs(controller, together(ends, jumps), settings.shares, settings.max_steps)


def _follower(equations: Equations, guards: Guards, feedback: Array | None, ts: Array, settings: Settings) -> Follower:
    return Follower(Sight(guards, equations, feedback, settings.rtol[0], resolution(ts)), ts[-1])


def resolution(ts: Array):
    """Return the smallest difference of two times that can be told apart."""
    return 4 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))


def _by_position(event: Any):
    """Return the user's event with `args` by position: diffrax passes it by name, but a user may call it `params`."""
    if event is None:
        return None

    def by_position(condition: Callable):
        return lambda t, y, args, **kwargs: condition(t, y, args, **kwargs)

    return diffrax.Event(jax.tree.map(by_position, event.cond_fn, is_leaf=callable))


def _progress_meter(progress: bool | None, often: int = 20):
    """A meter that is moved at every so many calls."""
    if not progress:
        return diffrax.NoProgressMeter()
    if importlib.util.find_spec("tqdm") is None:
        return diffrax.TextProgressMeter()
    return diffrax.TqdmProgressMeter(often)
