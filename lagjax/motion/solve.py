"""The compiled program behind `integrate`: start, diffrax's loop, outputs.

Nothing here looks at values: a start that cannot be integrated is refused inside the program, which then ends
within a few rejected steps, and the lane keeps the reason in its result.
"""

import threading
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jax_internals.compiling import compiler_options
from lagjax.jax_internals.one_function import called
from lagjax.jax_internals.tracing import is_eager
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.in_numbers import in_numbers
from lagjax.mechanics.memory import Parted, filled_up, parted
from lagjax.mechanics.saddle_point import equations_of_motion, is_regular, verdict
from lagjax.mechanics.structure import conserves_jacobi_integral, is_free_of_velocities
from lagjax.mechanics.written_out import is_small, write_out
from lagjax.motion.arriving import apart_from_jumps
from lagjax.motion.both_modes import solve_in_both_modes
from lagjax.motion.consistency import stopped, to_manifold, within, worst_residual
from lagjax.motion.crossing_times import all_known, by_name, end_of
from lagjax.motion.loop import Solution, solution_of
from lagjax.motion.memory_maps import maps_used, warn_of_memory_maps
from lagjax.motion.trajectory import RESULTS, Moment, Trajectory, ended_well, pack, worst_drift
from lagjax.numerics.nystrom import Nystrom, Nystrom12
from lagjax.numerics.runge_kutta import Dopri8, ExplicitRungeKutta, in_our_form

# A start may be off the constraints by this many tolerances; it is then moved onto them.
START_TOLERANCES = 100.0
# A motion of a hundred periods changes the Jacobi integral by ten to a hundred tolerances.
DRIFT_TOLERANCES = 1e3
# The same change times the number of steps is about twenty times the phase that it shifts, in radians: a hundredth.
PHASE_STEPS = 0.2
# With fixed steps no tolerance says how much is expected.
FIXED_STEPS_ALLOW = 1e-5
# The tightest tolerance that is not below round-off.
ROUND_OFFS = 8
# Motions whose programs are kept, of 10 to 130 MB each; fewer, where these use so much of the memory maps there are.
KEPT, KEPT_AT_LEAST, MAPS_SHARE = 100, 8, 0.4
# The operations of a right-hand side that is copied to each of a method's stages; a longer one is compiled once, in a
# loop. In lanes of a rod or a double pendulum copies are twice as fast. A step by itself is a fifth slower in a loop,
# but the first answer of a rod comes an eighth sooner, that of eight coupled masses in half the time. Derivatives are
# taken without copies: two thirds of the time to the first of them, a fifth more for each of the next ones.
UNROLL_UP_TO, UNROLL_AT_ONCE_UP_TO = 250, 30
# What the careful way would say, too.
THE_SAME = RESULTS.max_steps_reached, RESULTS.start_off_constraints, RESULTS.tolerance_too_small, RESULTS.unordered
# What diffrax reports, in the words of a motion.
TRANSLATED = {
    "nonfinite_input": "not_finite",
    "nonlinear_divergence": "unsolved_step",
    "nonlinear_max_steps_reached": "unsolved_step",
}


# What our methods can be differentiated by as diffrax's own can.
FOLLOWED = type(None), diffrax.ForwardMode, diffrax.RecursiveCheckpointAdjoint, diffrax.DirectAdjoint


# A module of equinox takes longer to make than a short motion to compute.
@jtu.register_dataclass
@dataclass(frozen=True)
class Settings:
    """How to integrate: everything but the system, the state and the times."""

    method: diffrax.AbstractSolver | None
    controller: diffrax.AbstractStepSizeController | None
    event: diffrax.Event | None
    adjoint: diffrax.AbstractAdjoint | None
    rtol: Float[Array, " 2"]
    atol: Float[Array, " 2"]
    dt0: Float[Array, ""] | None
    max_step: Float[Array, ""] | None
    jump_ts: Float[Array, " J"] | None
    apart: bool = eqx.field(static=True)
    max_steps: int | None = eqx.field(static=True)
    drift: str = eqx.field(static=True)
    progress: bool = eqx.field(static=True)
    # False where the equations are taken for regular, until that turns out to be wrong.
    careful: bool = eqx.field(static=True, default=True)
    # The operations of a right-hand side that is copied to each of a method's stages.
    unroll_up_to: int = eqx.field(static=True, default=UNROLL_UP_TO)


def trajectory_of(*problem) -> Trajectory:
    """The trajectory of a system, q0, v0, params, ts, guards, and settings; what went wrong is recorded in its result.

    Where nothing is traced, the equations are first taken for regular, which compiles in two thirds of the time and is
    all that most systems need; where that fails, the careful way is compiled too, and kept to. Equinox's wrapper of
    `jit` takes longer than a short motion; it has better words for the checks that it puts into a program.
    """
    if not is_eager():
        return _trajectory_of(*problem)
    system, q0, v0, params, ts, guards, settings = problem
    # Filled up by its last time.
    many = np.append(ts, np.full(filled_up(len(ts)) - len(ts), ts[-1]))
    static, arrays = parted((system, q0, v0, params, many, guards, settings))
    programs = _kept(static, len(ts))
    try:
        if programs.regular is not None:
            found, settled = programs.regular(arrays)
            if settled:
                return programs.first_outputs(found, len(ts))
            programs.regular = None
        return programs.first_outputs(jax.block_until_ready(programs.careful(arrays))[0], len(ts))
    except jax.errors.JaxRuntimeError:
        return _trajectory_of(*problem)


class _Programs:
    """The compiled programs of one kind of motion: of equations taken for regular (None where they are not), and with
    the careful way. JAX keeps them as long as this object lives."""

    def __init__(self, static, count):
        jit = partial(jax.jit, compiler_options=compiler_options())
        self.regular: Callable | None = jit(partial(_of_arrays, static, False))
        self.careful: Callable = jit(partial(_of_arrays, static, True))
        self._count = count
        self._cut = jax.jit(lambda rows: [x[:count] for x in rows])

    def first_outputs(self, found, count):
        """The trajectory without the outputs that it was filled up by."""
        if found.t.size == count:
            return found
        leaves, structure = jtu.tree_flatten(found)
        size = len(jtu.tree_leaves((found.t, found.q, found.v, found.multipliers)))
        rows = leaves[:size]
        # A program for each number of outputs would be compiled; for the first one it is.
        cut = self._cut(rows) if count == self._count else jax.device_put([np.asarray(x)[:count] for x in rows])
        return jtu.tree_unflatten(structure, cut + leaves[size:])


# What was integrated here, that used last at the end.
_programs: OrderedDict[Parted, _Programs] = OrderedDict()
_one_thread = threading.Lock()


def _kept(static, count):
    with _one_thread:
        found = _programs.get(static)
        if found is None:
            found = _programs[static] = _Programs(static, count)
            while len(_programs) > KEPT or len(_programs) > KEPT_AT_LEAST and maps_used() > MAPS_SHARE:
                _programs.popitem(last=False)
        _programs.move_to_end(static)
        return found


def _of_arrays(static, careful, arrays):
    *motion, settings = static.together(arrays)
    return _trajectory(*motion, replace(settings, careful=careful, unroll_up_to=UNROLL_AT_ONCE_UP_TO))


@eqx.filter_jit
def _trajectory_of(*problem):
    return _trajectory(*problem)[0]


def _trajectory(system, q0, v0, params, ts, guards, settings):
    """The trajectory, and whether it is settled: what was taken for regular failed for no other reason than that."""
    # Here while it is traced, which is when something new is compiled.
    warn_of_memory_maps()
    asked, method = settings.method, method_of(settings, system, ts[0], q0, v0, params)
    name = type(method).__name__ + ("" if asked is None or asked is method else " (diffrax's, in lagjax's form)")
    settings = eqx.tree_at(lambda s: s.method, settings, method, is_leaf=lambda x: x is None)
    # Derivatives flow to the floating arrays of these; the settings are constants.
    x, rest = eqx.partition((system, q0, v0, params, ts, guards, settings.jump_ts), eqx.is_inexact_array)
    fixed, static = eqx.partition((rest, settings), eqx.is_array)

    def solved(x, fixed, adjoint, differentiated):
        rest, settings = eqx.combine(fixed, static)
        *motion, jump_ts = eqx.combine(x, rest)
        unroll_up_to = 0 if differentiated else settings.unroll_up_to
        settings = replace(settings, jump_ts=jump_ts, unroll_up_to=unroll_up_to)
        return _solve_in_numbers(*motion, settings, adjoint)

    if settings.adjoint is None:
        fields = solve_in_both_modes(solved, x, fixed)
    else:
        fields = solved(x, fixed, settings.adjoint, True)
    arrays, described = pack(system, params, name)
    tolerance, settled = (settings.rtol, settings.atol), fields.pop("settled")
    return Trajectory(t=ts, **fields, tolerance=tolerance, arrays=arrays, static=described), settled


def method_of(settings, system, *state):
    """The method asked for, if it can do it; by default the fastest that can."""
    chosen = settings.method
    if chosen is None:
        # BacksolveAdjoint integrates a state that is no pair (q, v).
        pairs = not isinstance(settings.adjoint, diffrax.BacksolveAdjoint)
        return Nystrom12() if pairs and is_free_of_velocities(system, *state) else Dopri8()
    if isinstance(chosen, Nystrom) and not is_free_of_velocities(system, *state):
        cause = "there are constraints" if system.constraints else "these do"
        raise ValueError(
            f"{type(chosen).__name__} is for accelerations that do not depend on velocities, and {cause}.\n"
            "Usual cause: coordinates in which the kinetic energy has q in it (polar, joint angles), friction, or a "
            "rotating frame.\n"
            "Fix: method=lj.Dopri8(), or leave method out: it is then chosen."
        )
    # With other adjoints, and for conditions that ask it, the solver stays the one that was given.
    ours = in_our_form(chosen) if settings.event is None and isinstance(settings.adjoint, FOLLOWED) else None
    return chosen if ours is None else ours


def _solve_in_numbers(system, q0, v0, params, ts, guards, settings, adjoint):
    """The solve, of a small system with the coordinates one by one."""
    written = unflatten = None
    ours = isinstance(settings.method, (ExplicitRungeKutta, Nystrom))
    # A condition that asks diffrax evaluates the vector field at the state that it gets, the user's.
    if ours and settings.event is None and is_small(system, ts[0], q0, v0, params):
        _, unflatten = coordinates.flatten(q0)
        system, q0, v0 = in_numbers(system, unflatten), coordinates.numbers(q0), coordinates.numbers(v0)
        guards = None if guards is None else guards.in_numbers(unflatten)
        written = write_out(system, ts[0], q0, v0, params)
    if written is None or not written.careful:
        settings = replace(settings, careful=True)
    fields = _solve(system, q0, v0, params, ts, guards, settings, adjoint, written)
    if unflatten is None:
        return fields
    together = lambda numbers: unflatten(jnp.stack(numbers))
    rows = jax.vmap(together)
    end, events = fields["end"], fields["events"]
    return fields | {
        "q": rows(fields["q"]),
        "v": rows(fields["v"]),
        "end": end._replace(q=together(end.q), v=together(end.v)),
        "events": {name: found.with_states(rows(found.q), rows(found.v)) for name, found in events.items()},
    }


class Start(NamedTuple):
    """The first state, moved onto the constraints, and what speaks against it, by names of `RESULTS`."""

    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    against: dict[str, Bool[Array, ""]]
    refused: Bool[Array, ""]


class Outputs(NamedTuple):
    """The motion at the outputs and, last, at its end, where nothing is NaN; and which outputs were reached."""

    motion: Moment
    reached: Bool[Array, " T"]


def _solve(system, q0, v0, params, ts, guards, settings, adjoint, written):
    regular = None if settings.careful else written
    start = _start(system, q0, v0, params, ts, settings, regular)
    solution = _stepped(system, start, params, ts, guards, settings, adjoint, written)
    outputs = _outputs(system, start, solution, params, ts, guards, settings, regular)
    return _result(system, start, solution, outputs, params, guards, settings)


def _start(system, q, v, params, ts, settings, regular) -> Start:
    """What speaks against a start comes in rising order: the last of what holds is the result."""
    t, off_constraints = ts[0], jnp.asarray(False)
    if system.constraints:
        tolerances = START_TOLERANCES * settings.rtol, START_TOLERANCES * settings.atol
        off_constraints = ~within(system, t, q, v, params, *tolerances)
    holds, projects = True, settings.drift == "project"
    if regular is not None:
        # What speaks against one that is not regular is not told apart.
        q, v = called(regular.project(system, t, q, v, params)) if projects else (q, v)
        solution = (*called(regular.equations(system, t, q, v, params)), system.lagrangian(t, q, v, params))
        finite, contradictory = jnp.all(jnp.isfinite(coordinates.flatten(solution)[0])), jnp.asarray(False)
        singular = ~is_regular(system, t, q, v, params)
    else:
        if projects:
            projected = to_manifold(system, t, q, v, params, settings.rtol, settings.atol)
            q, v, holds = projected.q, projected.v, projected.holds
        _, _, finite, singular, contradictory = stopped(verdict(system, t, q, v, params))
    too_small = settings.controller is None and settings.rtol[0] < ROUND_OFFS * jnp.finfo(ts.dtype).eps
    lengths = [length for length in (settings.dt0, settings.max_step) if length is not None]
    against = {
        "start_singular": singular,
        "start_not_finite": ~finite,
        "contradictory": contradictory,
        "start_off_constraints": off_constraints | (finite & ~singular & ~jnp.asarray(holds)),
        "tolerance_too_small": jnp.asarray(too_small),
        "unordered": jnp.any(ts[1:] < ts[:-1]) | ~jnp.all(jnp.asarray([True, *(length > 0 for length in lengths)])),
    }
    return Start(q, v, against, jnp.any(jnp.stack([*against.values()])))


def _stepped(system, start, params, ts, guards, settings, adjoint, written) -> Solution:
    y0 = jax.tree.map(lambda x: jnp.where(start.refused, 0.0, x), (start.q, start.v))
    first = State(ts[0], start.q, start.v, params)
    if settings.dt0 is not None:
        # Where it is not positive the motion is refused; diffrax's own check would end the program.
        settings = replace(settings, dt0=jnp.where(settings.dt0 > 0, settings.dt0, 1.0))
    solution = solution_of(system, written, first, y0, start.refused, ts, guards, settings, adjoint)
    if solution.located is None:
        return solution
    end = end_of(guards, solution.located, *solution.end)
    # The step in which the motion ended went on to its own end.
    return solution._replace(end=end, reached=jnp.where(ts <= end[0], solution.reached, jnp.inf))


def _outputs(system, start, solution, params, ts, guards, settings, regular) -> Outputs:
    # What was not reached is evaluated at the start and masked afterwards: NaN times zero would poison gradients.
    reached = jnp.isfinite(solution.reached) & ~start.refused
    states = jax.tree.map(lambda x, x0: jnp.where(_like(reached, x), x, x0[None]), solution.outputs, (start.q, start.v))
    if settings.jump_ts is not None:
        states = apart_from_jumps(system, ts, settings.jump_ts, *states, params)
    # One compiled evaluation for the outputs and the end together.
    t, (q, v) = jax.tree.map(lambda x, last: jnp.concatenate([x, last]), (ts, states), solution.end)
    multipliers = _multipliers(system, regular, t, q, v, params)
    return Outputs(Moment(t, q, v, multipliers), reached)


def _result(system, start, solution, outputs, params, guards, settings):
    """The fields of the trajectory: NaN where it did not come, and why."""
    (motion, reached), located = outputs, solution.located
    result = RESULTS.promote(solution.result)
    for reported, ours in TRANSLATED.items():
        result = RESULTS.where(result == getattr(RESULTS, reported), getattr(RESULTS, ours), result)
    # An output is a step of its own, and can fail where the steps of the solve did not.
    known = jnp.all(jnp.isfinite(coordinates.flatten(jax.tree.map(lambda x: x[:-1], (motion.q, motion.v)))[0]))
    if not settings.careful:
        known = known & jnp.all(jnp.isfinite(coordinates.flatten(motion.multipliers)[0]))
        known = known if located is None else known & all_known(located)
    result = RESULTS.where(ended_well(result) & ~known, RESULTS.unsolved_step, result)
    for name, holds in start.against.items():
        result = RESULTS.where(holds, getattr(RESULTS, name), result)
    stats = {name: jnp.asarray(count) for name, count in solution.stats.items() if name != "max_steps"}
    masked = jax.tree.map(lambda x: jnp.where(_like(reached, x), x[:-1], jnp.nan), motion)
    end = jax.tree.map(lambda x: jnp.where(start.refused, jnp.nan, x[-1]), motion)._replace(t=motion.t[-1])
    return {
        "q": masked.q,
        "v": masked.v,
        "multipliers": masked.multipliers,
        "end": end,
        "stats": stats,
        "departure": _departure(system, stopped((motion.t, motion.q, motion.v, params)), stats, settings),
        "result": result,
        "settled": settings.careful | ended_well(result) | _among(result, THE_SAME),
        "events": {} if located is None else by_name(guards, located, motion.t[-1:], ~start.refused),
    }


def _departure(system, motion, stats, settings):
    """How far what must stay constant has changed at the outputs, in units of what the tolerance lets expect.

    An error of the Jacobi integral that grows steadily shifts the phase by about its size a radian, so that over very
    many steps less of it is allowed. With steps that the tolerance does not choose it counts for itself.
    """
    t, q, v, params = motion
    drift = residual = jnp.zeros_like(t[0])
    if conserves_jacobi_integral(system, t[0], *jax.tree.map(lambda x: x[0], (q, v)), params):
        drift = worst_drift(system, t, q, v, params)
    if system.constraints and settings.drift != "project":
        residual = worst_residual(system, t, q, v, params)
    if settings.controller is not None:
        return jnp.maximum(drift, residual) / FIXED_STEPS_ALLOW
    rtol = jnp.maximum(settings.rtol[0], jnp.finfo(t.dtype).eps)
    phase = drift * stats["num_accepted_steps"] / PHASE_STEPS
    return jnp.maximum(jnp.maximum(drift, residual) / (DRIFT_TOLERANCES * rtol), phase)


def _multipliers(system, regular, t, q, v, params):
    def at(t, q, v):
        if regular is None:
            return equations_of_motion(system, t, q, v, params)[1]
        return constraints.split(system, called(regular.equations(system, t, q, v, params))[1], t, q, v, params)

    return jax.vmap(at)(t, q, v) if system.constraints else {}


def _among(result, others):
    return jnp.any(jnp.stack([result == other for other in others]))


def _like(mask, x):
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))
