"""The compiled program behind `integrate`: start, diffrax's loop, outputs.

Nothing here looks at values: a start that cannot be integrated is refused inside the program, which then ends
within a few rejected steps, and the lane keeps the reason in its result.
"""

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
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.jax_internals.compiling import compiler_options
from lagjax.jax_internals.tracing import is_eager, takes_for_regular
from lagjax.mechanics import coordinates
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.equations import Equations, equations_of
from lagjax.mechanics.kept import kept
from lagjax.mechanics.memory import filled_up, parted
from lagjax.mechanics.memory_maps import share_used
from lagjax.mechanics.structure import conserves_jacobi_integral, is_free_of_velocities
from lagjax.motion.arriving import apart_from_jumps
from lagjax.motion.both_modes import solve_in_both_modes
from lagjax.motion.consistency import returned, stopped, within, worst_residual
from lagjax.motion.crossing_times import all_known, by_name, end_of
from lagjax.motion.global_error import ROUND_OFFS, with_errors, with_errors_inside
from lagjax.motion.loop import Solution, solution_of
from lagjax.motion.reported import report_settled
from lagjax.motion.tolerances import Scales, rounding, scales_of, shared, span_of, tolerances_at
from lagjax.motion.trajectory import RESULTS, How, Moment, Trajectory, ended_well, pack, worst_drift
from lagjax.numerics.evaluations import evaluations_a_step
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
    # Infinite where steps are of any length.
    max_step: Float[Array, ""]
    jump_ts: Float[Array, " J"] | None
    # Of the first step, and of the time from one output to the next for all: see `Arriving`.
    shares: Float[Array, " 2"]
    # The most steps of a motion that is integrated again, for its error.
    repeated_up_to: Int[Array, ""]
    # Whether `atol` is one of a motion's own size, and the one above only for want of it.
    by_size: bool = eqx.field(static=True)
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
        # A program of the user's, which is not kept here.
        share_used()
        return _inside(*problem)
    *motion, ts, guards, settings = problem
    # Filled up by its last time.
    many = np.append(ts, np.full(filled_up(len(ts)) - len(ts), ts[-1]))
    of = lambda settings: parted((*motion, many, guards, settings))
    static, arrays = of(settings)
    programs = kept((_Programs, static), lambda: _Programs(static, len(ts)))
    try:
        found = programs.run(arrays, len(ts))
        again = lambda closer: programs.run(of(closer)[1], len(ts), settled=True)
        return with_errors(again, found, settings, ts) if settings.repeated_up_to else found
    except jax.errors.JaxRuntimeError:
        return _trajectory_of(*problem)[0]


def _inside(*problem):
    """The trajectory in a program that is being traced; who takes it for regular there is told whether it is."""
    *motion, settings = problem
    # An adjoint that was asked for is there to be differentiated through.
    regular = takes_for_regular() and settings.adjoint is None
    settings = replace(settings, careful=not regular)
    found, settled = _trajectory_of(*motion, settings)
    if settings.repeated_up_to:
        again = lambda closer: _trajectory_of(*stopped(motion), closer)[0]
        found = with_errors_inside(again, found, settings, motion[4])
    return report_settled(found, settled) if regular else found


class _Programs:
    """The compiled programs of one kind of motion: of equations taken for regular (None where they are not), and with
    the careful way. JAX keeps them as long as this object lives."""

    def __init__(self, static, count):
        jit = partial(jax.jit, compiler_options=compiler_options())
        self.regular: Callable | None = jit(partial(_of_arrays, static, False, count))
        self.careful: Callable = jit(partial(_of_arrays, static, True, count))
        self._count = count

    def run(self, arrays, count, settled=False):
        """The trajectory with so many outputs; where it is not settled, by the careful way, but if `settled`."""
        if self.regular is not None:
            found, rows, well = self.regular(arrays)
            if settled or well:
                return self._first_outputs(found, rows, count)
            self.regular = None
        found, rows, _ = jax.block_until_ready(self.careful(arrays))
        return self._first_outputs(found, rows, count)

    def _first_outputs(self, found, rows, count):
        """The trajectory with so many outputs, of `rows` that were filled up."""
        if count == self._count:
            return found
        # A program for each number of outputs would be compiled.
        return replace(found, **jax.device_put(jtu.tree_map(lambda x: np.asarray(x)[:count], rows)))


def _of_arrays(static, careful, count, arrays):
    """The trajectory with the number of outputs that was asked for first, all outputs, and whether it is settled."""
    *motion, settings = static.together(arrays)
    found, settled = _trajectory(*motion, replace(settings, careful=careful, unroll_up_to=UNROLL_AT_ONCE_UP_TO))
    rows = {"t": found.t, "q": found.q, "v": found.v, "multipliers": found.multipliers}
    return replace(found, **jtu.tree_map(lambda x: x[:count], rows)), rows, settled


@eqx.filter_jit
def _trajectory_of(*problem):
    return _trajectory(*problem)


def _trajectory(system, q0, v0, params, ts, guards, settings):
    """The trajectory, and whether it is settled: what was taken for regular failed for no other reason than that."""
    asked, method = settings.method, method_of(settings, system, ts[0], q0, v0, params)
    how = _how(method, asked, settings)
    settings = eqx.tree_at(lambda s: s.method, settings, method, is_leaf=lambda x: x is None)
    # Derivatives flow to the floating arrays of these; the settings are constants.
    x, rest = eqx.partition((system, q0, v0, params, ts, guards, settings.jump_ts), eqx.is_inexact_array)
    fixed, static = eqx.partition((rest, settings), eqx.is_array)

    def solved(x, fixed, adjoint, differentiated):
        rest, settings = eqx.combine(fixed, static)
        *motion, jump_ts = eqx.combine(x, rest)
        unroll_up_to = 0 if differentiated else settings.unroll_up_to
        careful = settings.careful or differentiated and settings.adjoint is None
        settings = replace(settings, jump_ts=jump_ts, unroll_up_to=unroll_up_to, careful=careful)
        return _solve(*motion, settings, adjoint)

    if settings.adjoint is None:
        fields = solve_in_both_modes(solved, x, fixed)
    else:
        fields = solved(x, fixed, settings.adjoint, True)
    arrays, described = pack(system, params, how)
    settled = fields.pop("settled")
    return Trajectory(t=ts, **fields, arrays=arrays, static=described), settled


def _how(method, asked, settings):
    name = type(method).__name__ + ("" if asked is None or asked is method else " (diffrax's, in lagjax's form)")
    terms = diffrax.ODETerm(lambda t, y, args: y)
    chosen = "fixed" if isinstance(settings.controller, diffrax.ConstantStepSize) else "controller"
    return How(
        name, method.error_order(terms), evaluations_a_step(method), chosen if settings.controller else "tolerance"
    )


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


def _solve(system, q0, v0, params, ts, guards, settings, adjoint):
    ours = isinstance(settings.method, (ExplicitRungeKutta, Nystrom))
    # A condition that asks diffrax evaluates the vector field at the state that it gets, the user's.
    quickly = ours and settings.event is None
    equations = equations_of(system, ts[0], q0, v0, params, quickly=quickly, fallback=settings.careful)
    if guards is not None and equations.unflatten is not None:
        guards = guards.in_numbers(equations.unflatten)
    q, v = equations.inside(q0), equations.inside(v0)
    _, atol = tolerances_at(State(ts[0], q, v, params), ts, settings)
    settings = replace(settings, atol=atol)
    start = _start(equations, q, v, ts, settings)
    solution = _stepped(equations, start, ts, guards, settings, adjoint)
    outputs = _outputs(equations, start, solution, ts, settings)
    fields = _result(equations, start, solution, outputs, guards, settings)
    rows = jax.vmap(equations.outside)
    end, events = fields["end"], fields["events"]
    return fields | {
        "q": rows(fields["q"]),
        "v": rows(fields["v"]),
        "end": end._replace(q=equations.outside(end.q), v=equations.outside(end.v)),
        "events": {name: found.with_states(rows(found.q), rows(found.v)) for name, found in events.items()},
    }


class Start(NamedTuple):
    """The first state, moved onto the constraints, and what speaks against it, by names of `RESULTS`.

    `scales`: of the motion, where tolerances are relative to its size.
    """

    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    against: dict[str, Bool[Array, ""]]
    refused: Bool[Array, ""]
    scales: Scales | None


class Outputs(NamedTuple):
    """The motion at the outputs and, last, at its end, where nothing is NaN; and which outputs were reached."""

    motion: Moment
    reached: Bool[Array, " T"]


def _start(equations: Equations, q, v, ts, settings) -> Start:
    """What speaks against a start comes in rising order: the last of what holds is the result."""
    t, off_constraints, holds = ts[0], jnp.asarray(False), jnp.asarray(True)
    if equations.system.constraints:
        tolerances = START_TOLERANCES * settings.rtol, START_TOLERANCES * settings.atol
        off_constraints = ~within(equations, t, q, v, *tolerances)
    if settings.drift == "project":
        q, v, holds = returned(equations, t, q, v, settings.rtol, settings.atol)
    a, _, finite, singular, contradictory, mass = stopped(equations.verdict(t, q, v))
    scales = scales_of(mass, *stopped((q, v)), a, stopped(span_of(ts))) if settings.by_size else None
    too_small = settings.controller is None and settings.rtol[0] < ROUND_OFFS * jnp.finfo(ts.dtype).eps
    lengths = [settings.max_step, *([] if settings.dt0 is None else [settings.dt0])]
    against = {
        "start_singular": singular,
        "start_not_finite": ~finite,
        "contradictory": contradictory,
        "start_off_constraints": off_constraints | (finite & ~singular & ~holds),
        "tolerance_too_small": jnp.asarray(too_small),
        "unordered": jnp.any(ts[1:] < ts[:-1]) | ~jnp.all(jnp.asarray([True, *(length > 0 for length in lengths)])),
    }
    return Start(q, v, against, jnp.any(jnp.stack([*against.values()])), scales)


def _stepped(equations, start, ts, guards, settings, adjoint) -> Solution:
    y0 = jax.tree.map(lambda x: jnp.where(start.refused, 0.0, x), (start.q, start.v))
    first = State(ts[0], start.q, start.v, equations.params)
    if settings.dt0 is not None:
        # Where it is not positive the motion is refused; diffrax's own check would end the program.
        settings = replace(settings, dt0=jnp.where(settings.dt0 > 0, settings.dt0, 1.0))
    solution = solution_of(equations, first, y0, start.refused, start.scales, ts, guards, settings, adjoint)
    if solution.located is None:
        return solution
    end = end_of(guards, solution.located, *solution.end)
    # The step in which the motion ended went on to its own end.
    return solution._replace(end=end, reached=jnp.where(ts <= end[0], solution.reached, jnp.inf))


def _outputs(equations, start, solution, ts, settings) -> Outputs:
    # What was not reached is evaluated at the start and masked afterwards: NaN times zero would poison gradients.
    reached = jnp.isfinite(solution.reached) & ~start.refused
    states = jax.tree.map(lambda x, x0: jnp.where(_like(reached, x), x, x0[None]), solution.outputs, (start.q, start.v))
    if settings.jump_ts is not None:
        states = apart_from_jumps(equations, ts, settings.jump_ts, *states)
    # One compiled evaluation for the outputs and the end together.
    t, (q, v) = jax.tree.map(lambda x, last: jnp.concatenate([x, last]), (ts, states), solution.end)
    return Outputs(Moment(t, q, v, jax.vmap(equations.multipliers)(t, q, v)), reached)


def _result(equations, start, solution, outputs, guards, settings):
    """The fields of the trajectory: NaN where it did not come, and why."""
    (motion, reached), located = outputs, solution.located
    result = RESULTS.promote(solution.result)
    for reported, ours in TRANSLATED.items():
        result = RESULTS.where(result == getattr(RESULTS, reported), getattr(RESULTS, ours), result)
    # An output is a step of its own, and can fail where the steps of the solve did not.
    known = jnp.all(jnp.isfinite(coordinates.flatten(jax.tree.map(lambda x: x[:-1], (motion.q, motion.v)))[0]))
    regular = equations.are_taken_for_regular
    if regular:
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
        "tolerance": (settings.rtol, _absolute(stopped((motion.q, motion.v)), start.scales, settings)),
        "departure": _departure(stopped(equations), *stopped((motion.t, motion.q, motion.v)), stats, settings),
        "result": result,
        "settled": ended_well(result) | _among(result, THE_SAME) if regular else jnp.asarray(True),
        "events": {} if located is None else by_name(guards, located, motion.t[-1:], ~start.refused),
    }


def _absolute(states, scales, settings):
    """The `atol` that was given; by a motion's own size what was as good as zero on it, (2, n)."""
    if scales is None:
        return settings.atol
    sizes = [coordinates.flatten(jax.tree.map(lambda x: jnp.max(jnp.abs(x), axis=0), y))[0] for y in states]
    return rounding(shared(scales, jnp.stack(sizes)))


def _departure(equations, t, q, v, stats, settings):
    """How far what must stay constant has changed at the outputs, in units of what the tolerance lets expect.

    An error of the Jacobi integral that grows steadily shifts the phase by about its size a radian, so that over very
    many steps less of it is allowed. With steps that the tolerance does not choose it counts for itself.
    """
    system, params, drift, residual = equations.system, equations.params, jnp.zeros_like(t[0]), jnp.zeros_like(t[0])
    if conserves_jacobi_integral(system, t[0], *jax.tree.map(lambda x: x[0], (q, v)), params):
        drift = worst_drift(system, t, q, v, params)
    if system.constraints and settings.drift != "project":
        residual = worst_residual(system, t, q, v, params)
    if settings.controller is not None:
        return jnp.maximum(drift, residual) / FIXED_STEPS_ALLOW
    rtol = jnp.maximum(settings.rtol[0], jnp.finfo(t.dtype).eps)
    phase = drift * stats["num_accepted_steps"] / PHASE_STEPS
    return jnp.maximum(jnp.maximum(drift, residual) / (DRIFT_TOLERANCES * rtol), phase)


def _among(result, others):
    return jnp.any(jnp.stack([result == other for other in others]))


def _like(mask, x):
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))
