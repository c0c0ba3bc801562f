"""The compiled program behind `integrate`: the choice of the program and of the method, and the cache of programs.

The program itself is in `one_motion.py`, and the loop of motions in modes in `legs.py`.

Of a kind of motion there are two programs, of which the second is compiled only if the first is not enough. One program
with the robust way as a branch (`lax.cond`) gives the first answer of a pendulum on a rod after 3.0 times that of bare
diffrax, two programs after 2.3 times (processor time, two cores).
"""

from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from lagjax.display import waiting
from lagjax.integrate.both_modes import solve_in_both_modes
from lagjax.integrate.elements import InElements
from lagjax.integrate.equal_steps.loop import check_can_be_stepped
from lagjax.integrate.jumps import Jumps, slidable, with_jumps_in_time
from lagjax.integrate.jumps import found as jumps_found
from lagjax.integrate.problem import Problem
from lagjax.integrate.results import SolveInfo, SolveOptions, pack
from lagjax.integrate.settings import UNROLL_AT_ONCE_UP_TO, Settings
from lagjax.integrate.solve.legs import solved_over_jumps, warn_of_missed, with_lost, without_elements
from lagjax.integrate.solve.one_motion import solved
from lagjax.integrate.solve.reports import report_settled, with_errors, with_errors_inside
from lagjax.integrate.solve.segments import solved_in_phases
from lagjax.integrate.trajectory import HybridTrajectory, Trajectory
from lagjax.jaxtools import (
    HashablePart,
    KeptProgram,
    Said,
    as_usual,
    compiler_options,
    filled_up,
    from_python,
    hashable_partition,
    is_eager,
    jitted,
    named,
    one_by_one,
    outlined,
    program_of,
    rebuilt,
    stop_gradient,
    takes_for_regular,
)
from lagjax.mechanics import has_networks, indefinite_in_words, is_free_of_velocities
from lagjax.numerics import Dopri8, EqualSteps, Nystrom, Nystrom8, Nystrom12, Tsit5, evaluations_a_step, in_our_form
from lagjax.system import Model, State, model_of, replace_fields, warn

# The adjoints that can differentiate our methods as they do diffrax's own.
FOLLOWED = type(None), diffrax.ForwardMode, diffrax.RecursiveCheckpointAdjoint, diffrax.DirectAdjoint


def trajectory_of(problem: Problem) -> Trajectory:
    """Return the trajectory of a motion forward in time; a failure is recorded in its result.

    If nothing is traced, the equations are first assumed regular, which compiles in two thirds of the time and is
    enough for most systems; if that fails, the robust solve is compiled too and used from then on. Where contacts may
    hold more than there are coordinates it is the only one: numbers decide whether they do. Equinox's wrapper of `jit`
    takes longer than a short motion, so it runs only if a check in the program fails: its message is better.
    """
    if not is_eager():
        return _inside(problem)
    ts, shown = problem.ts, problem.settings.progress
    # Whether compiling is announced does not change the program.
    settings = replace(problem.settings, progress=bool(shown))
    # Padded with the last time.
    padded = problem._replace(ts=np.append(ts, np.full(filled_up(len(ts)) - len(ts), ts[-1])))

    def of(settings: Settings):
        return hashable_partition(padded._replace(settings=settings))

    arrays, static = of(settings)
    programs = program_of((_Programs, static), lambda: _Programs(static, len(ts), not _may_hold_too_much(problem)))
    try:
        found, whole = programs.run(arrays, len(ts), shown)
        if whole is not None and not programs.has_warned:
            programs.has_warned = _warned_of_mass(whole, problem, programs.has_looked)
            programs.has_looked = True
        if not settings.repeated_up_to:
            return found
        return with_errors(lambda s: programs.run(of(s)[0], len(ts), shown, settled=True)[0], found, settings, ts)
    except jax.errors.JaxRuntimeError:
        return _trajectory_of(problem)[0]


def _inside(problem: Problem) -> Trajectory:
    """The trajectory in a program that is being traced, which reports `settled` if it assumes the equations regular."""
    # If the user gave an adjoint, the motion will be differentiated, which needs the robust solve.
    regular = takes_for_regular() and problem.settings.adjoint is None and not _may_hold_too_much(problem)
    repeats = bool(problem.settings.repeated_up_to)
    arrays, static = hashable_partition(problem)

    def of_arrays(arrays: list):
        return (_traced(Problem(*static.combine(arrays)), regular, repeats),)

    def meant():
        return [((regular, repeats), False), *_meant(static, not regular)]

    said = Said(meant, _outline, partial(_said_tree, static))
    found = named(of_arrays, said, arrays)
    if found is None and problem.settings.adjoint is None:
        found = from_python(one_by_one(of_arrays), said, (static, regular, repeats), arrays)
    return _traced(problem, regular, repeats) if found is None else found[0]


def _traced(problem: Problem, regular: bool, repeats: bool) -> Trajectory:
    settings = replace(problem.settings, robust=not regular)
    problem = problem._replace(settings=settings)
    found, settled, _ = _trajectory_of(problem)
    if repeats:
        still = stop_gradient(problem[:-1])
        found = with_errors_inside(lambda s: _trajectory_of(Problem(*still, s))[0], found, settings, problem.ts)
    return report_settled(found, settled) if regular else found


def _warned_of_mass(whole: tuple, problem: Problem, again: bool) -> bool:
    """Whether the mass matrix at the start is not positive definite; and say so."""
    if words := indefinite_in_words(*whole, lambda: model_of(problem.system, *problem.start).names, again):
        warn(words, UserWarning)
    return bool(words)


def _may_hold_too_much(problem: Problem) -> bool:
    """Whether contacts and constraints may be more than coordinates, and so depend on each other."""
    laws = problem.system.laws if isinstance(problem.system, InElements) else ()
    most = sum(map(np.size, jtu.tree_leaves(problem.q)))
    return any(of_phase is not None and of_phase.equations > most for of_phase in laws)


class _Programs:
    """The programs of one kind of motion: with the equations assumed regular (None once they turned out not to be), and
    with the robust solve. `has_looked`, `has_warned`: at, and of, a mass matrix that is not definite."""

    def __init__(self, static: HashablePart, count: int, regular: bool):
        def of(robust: bool) -> KeptProgram:
            said = Said(partial(_meant, static, robust), _outline, partial(_said_tree, static))
            return KeptProgram(partial(_of_arrays, static, robust, count), said, compiler_options())

        self.regular: KeptProgram | None = of(False) if regular else None
        self.robust = of(True)
        self.has_looked = self.has_warned = False

    @as_usual
    def run(self, arrays: list, count: int, shown: bool | None, settled: bool = False) -> tuple[Trajectory, Any]:
        """The trajectory with `count` outputs, by the robust solve if it is not settled; unless `settled` is given.
        And M and A at its start, where they are formed.

        A program announces that it compiles, as `shown` says (see `waiting`).
        """
        while True:
            program = self.regular or self.robust
            with nullcontext() if program.is_ready else waiting(shown, "compiling"):
                found, rows, well, whole = program(arrays)
            if program is self.robust:
                jax.block_until_ready((found, rows))
            if program is self.robust or settled or well:
                break
            self.regular = None
        if len(found.t) == count:
            return found, whole
        # In NumPy: JAX would compile a program for each number of outputs.
        return replace(found, **jax.device_put(jtu.tree_map(lambda x: np.asarray(x)[:count], rows))), whole


def _of_arrays(static: HashablePart, robust: bool, count: int, arrays: list):
    """The trajectory with the first `count` outputs, all padded outputs, whether it is settled, and M and A."""
    problem = Problem(*static.combine(arrays))
    # With guards to be watched a program is long anyway, and compiles a third faster without copies.
    unroll_up_to = 0 if problem.system.in_phases else UNROLL_AT_ONCE_UP_TO
    settings = replace(problem.settings, robust=robust, unroll_up_to=unroll_up_to)
    found, settled, whole = one_by_one(_trajectory)(problem._replace(settings=settings))
    rows = found.rows()
    return replace(found, **jtu.tree_map(lambda x: x[:count], rows)), rows, settled, whole


# The classes of what a motion gives, besides those of the user's states.
def _meant(static: HashablePart, robust: bool) -> list[tuple[Any, bool]]:
    """What a program computes, for its digest; with whether states and parameters may be in the user's classes.

    The number of outputs is not in it: `run` cuts what is too long. Nor are the functions of a system with elements as
    the user wrote them, which nothing calls: beside them are their programs, in modes.
    """
    leaves = iter(static.leaves)
    found: list[tuple[Any, bool]] = [((__name__, robust, compiler_options()), False)]
    for name, structure in zip(Problem._fields, static.structure.children()):
        part = HashablePart(tuple(islice(leaves, structure.num_leaves)), structure)
        if name == "system":
            system = jtu.tree_unflatten(part.structure, part.leaves)
            if isinstance(system, InElements):
                user = jtu.tree_map(lambda x: "a function" if callable(x) else x, system.user)
                leaves_of_system, structure = jtu.tree_flatten(replace_fields(system, user=user))
                part = HashablePart(tuple(leaves_of_system), structure)
        found.append((part, name in ("q", "v", "params")))
    return found


def _outline(results: tuple) -> dict[str, Any]:
    """The structure of what `_of_arrays` returns, as data."""
    found, *_ = results
    given = {"q": found.end.q, "arrays": found.arrays, "static": found.static}
    return {"how": list(found.static.how), "results": outlined(results, given)}


def _said_tree(static: HashablePart, outline: dict[str, Any], arrays: list):
    """Results of this structure; what they say of themselves is that of this problem."""
    problem = Problem(*static.combine(arrays))
    of_problem, described = _described(problem, SolveInfo(*outline["how"]))
    given = {"q": problem.q, "arrays": of_problem, "static": described}
    return rebuilt(outline["results"], given)


def _described(problem: Problem, how: SolveInfo):
    """What a trajectory says of its problem: arrays, and the rest."""
    s = problem.settings
    # What the tolerance chose is no longer known where the motion is continued.
    chosen = Tsit5() if s.method is None and how.method == Tsit5.__name__ else s.method
    asked = SolveOptions(chosen, s.controller, s.dt0, s.max_step, s.jump_ts, s.drift, s.jumps)
    return pack((problem.system, problem.params, asked), how, trajectory_of)


@jitted
def _trajectory_of(problem: Problem):
    return _trajectory(problem)


def _trajectory(problem: Problem):
    """The trajectory; whether it is settled, as the robust solve would give the same; and M and A where it starts."""
    system, *motion, settings = problem
    start, model = problem.start, model_of(system, *problem.start)
    s, method = settings, method_of(settings, model)
    by_tolerance = s.method is None and isinstance(method, Tsit5)
    if settings.outputs is None:
        settings = replace(settings, outputs="interpolated" if by_tolerance else "exact")
    how = _how(method, s.method, settings, system.in_phases)
    settings = eqx.tree_at(lambda s: s.method, settings, method, is_leaf=lambda x: x is None)
    # Derivatives flow to the floating-point arrays of these; the settings are constants.
    x, rest = eqx.partition((system, *motion, settings.jump_ts), eqx.is_inexact_array)
    fixed, static = eqx.partition((rest, settings), eqx.is_array)

    jumps = [None for _ in model.phases] if settings.jumps == "ignored" else followed(settings, model, start)
    in_time = [x if x is not None and x.in_time else None for x in jumps]
    jumps = [x if x is not None and x.count else None for x in jumps]
    solve = partial(solved_in_phases, jumps) if system.in_phases else solved
    if any(jumps) and not system.in_phases:
        solve = partial(solved_over_jumps, jumps)

    def solve_arrays(x, fixed, adjoint: Any, differentiated):
        rest, settings = eqx.combine(fixed, static)
        *motion, jump_ts = eqx.combine(x, rest)
        too_many = jnp.asarray(False)
        for mine, phase in zip(in_time, model_of(motion[0], motion[4][0], *motion[1:4]).phases if any(in_time) else ()):
            if mine is not None:
                bare, _ = without_elements(phase.system)
                jump_ts, many = with_jumps_in_time(mine, jump_ts, bare, *motion[1:3], phase.params, motion[4])
                too_many = too_many | many
        unroll_up_to = 0 if differentiated or any(jumps) else settings.unroll_up_to
        robust = settings.robust or differentiated and settings.adjoint is None
        settings = replace(
            settings, jump_ts=jump_ts, unroll_up_to=unroll_up_to, robust=robust, differentiated=differentiated
        )
        fields = solve(*motion, settings, adjoint)
        if any(in_time):
            fields["stats"] = with_lost(fields["stats"], too_many)
        return fields, fields.pop("record", None)

    if settings.adjoint is None:
        # Each leg of a motion in phases is replayed separately.
        fields = solve_in_both_modes(
            solve_arrays, x, fixed, recorded=solve is solved and not isinstance(method, EqualSteps)
        )
    else:
        fields, _ = solve_arrays(x, fixed, settings.adjoint, True)
    arrays, described = _described(problem, how)
    settled, whole = fields.pop("settled"), fields.pop("whole", None)
    of = HybridTrajectory if system.in_phases else Trajectory
    return of(t=problem.ts, **fields, arrays=arrays, static=described), settled, whole


def followed(settings: Settings, model: Model, start: State) -> list[Jumps | None]:
    """The jumps of each phase that a motion follows; None if there are none. Says which are not followed."""
    found, missed = [], []
    if isinstance(settings.method, EqualSteps):
        why = "in steps of equal length, which are less accurate where one goes across"
    elif settings.controller is not None or settings.event is not None:
        why = "with a stepsize_controller, or a condition for diffrax, of your own"
    elif isinstance(settings.adjoint, diffrax.BacksolveAdjoint):
        why = "with diffrax.BacksolveAdjoint"
    else:
        why = ""
    for phase in model.phases:
        bare, beside = without_elements(phase.system)
        state = start._replace(params=phase.params)
        jumps = jumps_found(model_of(bare, *state), state)
        found.append(jumps)
        if jumps is None:
            continue
        not_here, missed = why, [*missed, *jumps.missed]
        if not why and beside is not None and slidable(jumps, bare):
            not_here = "along which the motion could slide, beside friction or springs among the elements"
        if not_here:
            missed += [f"{words}, {not_here}" for words in jumps.in_words()]
            found[-1] = None
    if missed:
        warn_of_missed(missed)
    return found


def _how(method: diffrax.AbstractSolver, asked, settings: Settings, in_legs):
    own = method.label if isinstance(method, EqualSteps) else type(method).__name__
    name = own + ("" if asked is None or asked is method else " (diffrax's, in lagjax's form)")
    terms = diffrax.ODETerm(lambda t, y, args: y)
    chosen = "fixed" if isinstance(settings.controller, diffrax.ConstantStepSize) else "controller"
    # With many short legs the number of steps does not tell what chose them.
    chosen = chosen if settings.controller else "legs" if in_legs else "tolerance"
    interpolated = settings.outputs == "interpolated"
    return SolveInfo(name, method.error_order(terms), evaluations_a_step(method), chosen, interpolated=interpolated)


def method_of(settings: Settings, model: Model):
    """Return the method asked for, raising if it cannot do it; by default the fastest that can."""
    chosen = settings.method
    if settings.outputs == "interpolated":
        chosen = Tsit5() if chosen is None else chosen
        if not isinstance(chosen, Tsit5 | diffrax.Tsit5):
            raise ValueError(
                'outputs="interpolated" takes outputs from polynomials of order 5, which '
                f"{type(chosen).__name__} does not go with: its steps are too long, or it has no acceleration at their "
                "ends.\n"
                "Fix: method=lj.Tsit5(), or leave method out: it is then chosen."
            )
    if chosen is None and settings.loose and has_networks(model):
        return Tsit5()
    if chosen is None:
        # BacksolveAdjoint integrates a state that is not a pair (q, v).
        pairs = not isinstance(settings.adjoint, diffrax.BacksolveAdjoint)
        if not pairs or not is_free_of_velocities(model):
            return Dopri8()
        return nystrom_for(model)
    if isinstance(chosen, EqualSteps):
        check_can_be_stepped(chosen, model)
        return chosen
    if isinstance(chosen, Nystrom) and not is_free_of_velocities(model):
        cause = "there are constraints" if any(phase.m for phase in model.phases) else "these do"
        raise ValueError(
            f"{type(chosen).__name__} is for accelerations that do not depend on velocities, and {cause}.\n"
            "Usual cause: a kinetic energy that depends on q (polar coordinates, joint angles), friction, or a "
            "rotating frame.\n"
            "Fix: method=lj.Dopri8(), or leave method out: it is then chosen."
        )
    # With other adjoints, and for conditions that evaluate it, the given solver is kept.
    ours = in_our_form(chosen) if settings.event is None and isinstance(settings.adjoint, FOLLOWED) else None
    return chosen if ours is None else ours


def nystrom_for(model: Model) -> Nystrom:
    """The default method for accelerations that do not depend on velocities."""
    # The motion of a network is less smooth than that of closed forms: at equal error, from 1e-3 to 1e-11, order 8
    # takes two thirds to nine tenths of the evaluations of order 12, and half with many outputs.
    return Nystrom8() if has_networks(model) else Nystrom12()
