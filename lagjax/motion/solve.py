"""The compiled program behind `integrate`: which one, with which method, and what is kept of it.

What it does is in `one_solve.py`, and for motions in phases in `legs.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from lagjax.jax_internals.compiling import compiler_options
from lagjax.jax_internals.tracing import is_eager, takes_for_regular
from lagjax.mechanics.hybrid import Hybrid, phases_of
from lagjax.mechanics.kept import kept
from lagjax.mechanics.memory import filled_up, parted
from lagjax.mechanics.memory_maps import share_used
from lagjax.mechanics.structure import is_free_of_velocities
from lagjax.mechanics.written_out import has_networks
from lagjax.meter import waiting
from lagjax.motion.both_modes import solve_in_both_modes
from lagjax.motion.consistency import stopped
from lagjax.motion.global_error import with_errors, with_errors_inside
from lagjax.motion.hybrid_trajectory import HybridTrajectory
from lagjax.motion.legs import solved_in_legs
from lagjax.motion.one_solve import solved
from lagjax.motion.reported import report_settled
from lagjax.motion.trajectory import Asked, How, Trajectory, pack
from lagjax.numerics.evaluations import evaluations_a_step
from lagjax.numerics.nystrom import Nystrom, Nystrom8, Nystrom12
from lagjax.numerics.runge_kutta import Dopri8, in_our_form

# The operations of a right-hand side that is copied to each of a method's stages; a longer one is compiled once, in a
# loop. In lanes of a rod or a double pendulum copies are twice as fast. A step by itself is a fifth slower in a loop,
# but the first answer of a rod comes an eighth sooner, that of eight coupled masses in half the time. Derivatives are
# taken without copies: two thirds of the time to the first of them, a fifth more for each of the next ones.
UNROLL_UP_TO, UNROLL_AT_ONCE_UP_TO = 250, 30
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
    progress: bool | None = eqx.field(static=True)
    # Of the record for reverse mode, in bytes; None for the usual one.
    memory: float | None = eqx.field(static=True, default=None)
    # False where the equations are taken for regular, until that turns out to be wrong.
    robust: bool = eqx.field(static=True, default=True)
    # The operations of a right-hand side that is copied to each of a method's stages.
    unroll_up_to: int = eqx.field(static=True, default=UNROLL_UP_TO)


def trajectory_of(*problem) -> Trajectory:
    """The trajectory of a system, q0, v0, params, ts, guards, and settings; what went wrong is recorded in its result.

    Where nothing is traced, the equations are first taken for regular, which compiles in two thirds of the time and is
    all that most systems need; where that fails, the robust way is compiled too, and kept to. Equinox's wrapper of
    `jit` takes longer than a short motion; it has better words for the checks that it puts into a program.
    """
    if not is_eager():
        # A program of the user's, which is not kept here.
        share_used()
        return _inside(*problem)
    *motion, ts, guards, settings = problem
    # Whether the compiler is told of makes no other program.
    shown, settings = settings.progress, replace(settings, progress=bool(settings.progress))
    # Filled up by its last time.
    many = np.append(ts, np.full(filled_up(len(ts)) - len(ts), ts[-1]))
    of = lambda settings: parted((*motion, many, guards, settings))
    static, arrays = of(settings)
    programs = kept((_Programs, static), lambda: _Programs(static, len(ts)))
    try:
        found = programs.run(arrays, len(ts), shown)
        again = lambda closer: programs.run(of(closer)[1], len(ts), shown, settled=True)
        return with_errors(again, found, settings, ts) if settings.repeated_up_to else found
    except jax.errors.JaxRuntimeError:
        return _trajectory_of(*problem)[0]


def _inside(*problem):
    """The trajectory in a program that is being traced; who takes it for regular there is told whether it is."""
    *motion, settings = problem
    # An adjoint that was asked for is there to be differentiated through.
    regular = takes_for_regular() and settings.adjoint is None
    settings = replace(settings, robust=not regular)
    found, settled = _trajectory_of(*motion, settings)
    if settings.repeated_up_to:
        again = lambda closer: _trajectory_of(*stopped(motion), closer)[0]
        found = with_errors_inside(again, found, settings, motion[4])
    return report_settled(found, settled) if regular else found


class _Programs:
    """The compiled programs of one kind of motion: of equations taken for regular (None where they are not), and with
    the robust way. JAX keeps them as long as this object lives."""

    def __init__(self, static, count):
        jit = partial(jax.jit, compiler_options=compiler_options())
        self.regular: Callable | None = jit(partial(_of_arrays, static, False, count))
        self.robust: Callable = jit(partial(_of_arrays, static, True, count))
        self._count, self._compiled = count, set()

    def run(self, arrays, count, shown, settled=False):
        """The trajectory with so many outputs; where it is not settled, by the robust way, but if `settled`."""
        if self.regular is not None:
            found, rows, well = self._called(self.regular, arrays, shown)
            if settled or well:
                return self._first_outputs(found, rows, count)
            self.regular = None
        found, rows, _ = jax.block_until_ready(self._called(self.robust, arrays, shown))
        return self._first_outputs(found, rows, count)

    def _called(self, program, arrays, shown):
        """What a program returns; the first time somebody is told that it compiles, as `shown` (see `waiting`) says."""
        if program in self._compiled:
            return program(arrays)
        with waiting(shown, "compiling"):
            found = program(arrays)
        self._compiled.add(program)
        return found

    def _first_outputs(self, found, rows, count):
        """The trajectory with so many outputs, of `rows` that were filled up."""
        if count == self._count:
            return found
        # A program for each number of outputs would be compiled.
        return replace(found, **jax.device_put(jtu.tree_map(lambda x: np.asarray(x)[:count], rows)))


def _of_arrays(static, robust, count, arrays):
    """The trajectory with the number of outputs that was asked for first, all outputs, and whether it is settled."""
    *motion, settings = static.together(arrays)
    found, settled = _trajectory(*motion, replace(settings, robust=robust, unroll_up_to=UNROLL_AT_ONCE_UP_TO))
    rows = found.rows()
    return replace(found, **jtu.tree_map(lambda x: x[:count], rows)), rows, settled


@eqx.filter_jit
def _trajectory_of(*problem):
    return _trajectory(*problem)


def _trajectory(system, q0, v0, params, ts, guards, settings):
    """The trajectory, and whether it is settled: what was taken for regular failed for no other reason than that."""
    s, method = settings, method_of(settings, system, ts[0], q0, v0, params)
    asked = Asked(s.method, s.controller, s.dt0, s.max_step, s.jump_ts, s.drift)
    how = _how(method, s.method, settings, isinstance(system, Hybrid))
    settings = eqx.tree_at(lambda s: s.method, settings, method, is_leaf=lambda x: x is None)
    # Derivatives flow to the floating arrays of these; the settings are constants.
    x, rest = eqx.partition((system, q0, v0, params, ts, guards, settings.jump_ts), eqx.is_inexact_array)
    fixed, static = eqx.partition((rest, settings), eqx.is_array)

    solve = solved_in_legs if isinstance(system, Hybrid) else solved

    def of_arrays(x, fixed, adjoint, differentiated):
        rest, settings = eqx.combine(fixed, static)
        *motion, jump_ts = eqx.combine(x, rest)
        unroll_up_to = 0 if differentiated else settings.unroll_up_to
        robust = settings.robust or differentiated and settings.adjoint is None
        settings = replace(settings, jump_ts=jump_ts, unroll_up_to=unroll_up_to, robust=robust)
        fields = solve(*motion, settings, adjoint)
        return fields, fields.pop("record", None)

    if settings.adjoint is None:
        # Each leg of a motion in phases is replayed by itself.
        fields = solve_in_both_modes(of_arrays, x, fixed, recorded=not isinstance(system, Hybrid))
    else:
        fields, _ = of_arrays(x, fixed, settings.adjoint, True)
    arrays, described = pack(system, params, asked, how)
    settled = fields.pop("settled")
    of = HybridTrajectory if isinstance(system, Hybrid) else Trajectory
    return of(t=ts, **fields, arrays=arrays, static=described), settled


def _how(method, asked, settings, in_legs):
    name = type(method).__name__ + ("" if asked is None or asked is method else " (diffrax's, in lagjax's form)")
    terms = diffrax.ODETerm(lambda t, y, args: y)
    chosen = "fixed" if isinstance(settings.controller, diffrax.ConstantStepSize) else "controller"
    # Many short legs: what chose their steps is not seen by how many there are.
    chosen = chosen if settings.controller else "legs" if in_legs else "tolerance"
    return How(name, method.error_order(terms), evaluations_a_step(method), chosen)


def method_of(settings, system, *state):
    """The method asked for, if it can do it; by default the fastest that can."""
    chosen = settings.method
    if chosen is None:
        # BacksolveAdjoint integrates a state that is no pair (q, v).
        pairs = not isinstance(settings.adjoint, diffrax.BacksolveAdjoint)
        if not pairs or not _are_free_of_velocities(system, *state):
            return Dopri8()
        return nystrom_for(system, state[-1])
    if isinstance(chosen, Nystrom) and not _are_free_of_velocities(system, *state):
        cause = "there are constraints" if any(phase.constraints for phase in phases_of(system)) else "these do"
        raise ValueError(
            f"{type(chosen).__name__} is for accelerations that do not depend on velocities, and {cause}.\n"
            "Usual cause: coordinates in which the kinetic energy has q in it (polar, joint angles), friction, or a "
            "rotating frame.\n"
            "Fix: method=lj.Dopri8(), or leave method out: it is then chosen."
        )
    # With other adjoints, and for conditions that ask it, the solver stays the one that was given.
    ours = in_our_form(chosen) if settings.event is None and isinstance(settings.adjoint, FOLLOWED) else None
    return chosen if ours is None else ours


def nystrom_for(system, params) -> Nystrom:
    """The method by default for accelerations that do not depend on velocities."""
    # A network's own motion is less smooth than that of closed forms: at equal error, from 1e-3 to 1e-11, order 8
    # takes two thirds to nine tenths of the evaluations of order 12, with many outputs half.
    return Nystrom8() if has_networks(system, params) else Nystrom12()


def _are_free_of_velocities(system, *state):
    return all(is_free_of_velocities(phase, *state) for phase in phases_of(system))
