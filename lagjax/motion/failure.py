"""The error message of a failed motion, in the user's terms."""

from typing import NoReturn

import jax
import numpy as np

from lagjax.mechanics import coordinates
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.diagnosis import describe, explain_failure
from lagjax.mechanics.multipliers import accelerations
from lagjax.motion import problem
from lagjax.motion.hybrid_trajectory import HybridTrajectory
from lagjax.motion.one_solve import START_TOLERANCES
from lagjax.motion.results import RESULTS, is_among, message
from lagjax.motion.solve import Settings
from lagjax.motion.stopped_early import stopped_early
from lagjax.motion.tolerances import tolerances_at
from lagjax.motion.trajectory import Trajectory, pack

# Switches at times that differ by less than this part of the last time are simultaneous.
AT_ONE_TIME = 1e-12


def raise_failure(trajectory: Trajectory, start: State, settings: Settings) -> NoReturn:
    """Raise the error of a failed motion; `start` is its first state."""
    if isinstance(trajectory, HybridTrajectory):
        _raise_in_phase(trajectory, start, settings)
    _raise(trajectory, start, settings)


def _raise(trajectory, start, settings, where="") -> NoReturn:
    result = trajectory.result
    system, start = trajectory.system, coordinates.as_arrays(start, start.t.dtype)
    if is_among(result, [RESULTS.start_off_constraints]):
        tolerances = (START_TOLERANCES * np.asarray(tol) for tol in tolerances_at(start, trajectory.t, settings))
        raise ValueError(where + problem.off_constraints(system, start, *tolerances))
    if is_among(result, problem.REFUSED):
        problem.check_finite(start)
        raise ValueError(where + (explain_failure(system, start) or message(result)))
    raise RuntimeError(where + stopped_early(trajectory, settings))


def _raise_in_phase(trajectory, start, settings) -> NoReturn:
    hybrid, switches, result = trajectory.system, trajectory.switches, trajectory.result
    if is_among(result, [RESULTS.too_many_switches]):
        raise RuntimeError(_too_many(trajectory))
    if is_among(result, [RESULTS.guard_below_zero]):
        raise ValueError(_below_zero(hybrid, start))
    if is_among(result, [RESULTS.guard_not_seen]):
        raise RuntimeError(
            f"a guard of phase '{hybrid.names[trajectory.last_phase()]}' is below zero at t = "
            f"{float(trajectory.end.t):.9g}, but no crossing of zero was found.\n"
            "Usual cause: its phase began with the guard at zero, and with a rate that is only round-off: a body that "
            "rests on what its phase lets it fly above.\n"
            "Fix: add a phase for that, with the constraint that holds it: lj.Switch(..., rest=name), or start=name."
        )
    if is_among(result, [RESULTS.reset_not_finite]):
        raise RuntimeError(_no_state_after(trajectory))
    count, phase = len(switches), trajectory.last_phase()
    entered = start
    if count:
        at = lambda tree: jax.tree.map(lambda x: np.asarray(x)[count - 1], tree)
        entered = State(*at((switches.t, switches.q_after, switches.v_after)), trajectory.params)
    there = f"in phase '{hybrid.names[phase]}', entered at t = {float(entered.t):.9g}: "
    arrays, static = pack(hybrid.systems[phase], trajectory.params, trajectory.asked, trajectory.static.how)
    fields = {
        name: getattr(trajectory, name) for name in ("q", "v", "end", "stats", "scaled_error", "result", "tolerance")
    }
    names = hybrid.systems[phase].constraints
    of_phase = lambda tree: {name: tree[name] for name in names}
    fields["end"] = fields["end"]._replace(multipliers=of_phase(fields["end"].multipliers))
    alone = Trajectory(
        t=trajectory.t, multipliers=of_phase(trajectory.multipliers), events={}, arrays=arrays, static=static, **fields
    )
    _raise(alone, entered, settings, there)


def _too_many(trajectory):
    switches = trajectory.switches
    t, count = np.asarray(switches.t)[: len(switches)], len(switches)
    gaps, last = np.diff(t[-4:]), float(t[-1])
    names = " -> ".join(trajectory.system.names[i] for i in _phases_along(trajectory)[-4:])
    said = f"there were {count} switches until t = {last:.9g}, and one more exceeds most_switches = {count}.\n"
    if gaps.size and np.all(gaps <= AT_ONE_TIME * max(abs(last), 1e-300)):
        return said + (
            f"Usual cause: no phase lasts: the last switches, {names}, happen at one time, as each guard is below zero "
            "in the phase that the other leads to.\n"
            "Fix: add a phase for what happens there (a contact that stays, a joint that sticks); look at the guards "
            "at the last state, in traj.switches with throw=False."
        )
    ratio = gaps[-1] / gaps[-2] if gaps.size > 1 and gaps[-2] > 0 else 1.0
    if 0 < ratio < 1 and gaps.size > 2 and abs(gaps[-2] / gaps[-3] - ratio) < 0.1 * ratio:
        return said + (
            f"Usual cause: infinitely many switches in finite time: each takes {ratio:.3g} of the time of the "
            f"one before, so that the motion comes to rest at about t = {last + gaps[-1] * ratio / (1 - ratio):.6g}.\n"
            'Fix: add a phase of rest, with lj.Switch(..., rest="lying") to go there; or ts that end before.'
        )
    return said + (
        f"Usual cause: a long motion.\nFix: lj.Hybrid(..., most_switches={10 * count}), or ts that end before."
    )


def _no_state_after(trajectory):
    hybrid, switches = trajectory.system, trajectory.switches
    last = len(switches) - 1
    switch = hybrid.switches[int(switches.way[last])]
    before = f"q = {describe(jax.tree.map(lambda x: x[last], switches.q))}"
    said = (
        f"the switch {switch.in_words()} at t = {float(switches.t[last]):.9g} gives a state that is not finite, from "
        f"{before}.\n"
    )
    if getattr(switch.reset, "friction", None) is not None:
        return said + (
            "Usual cause: a contact that jams. The gap and the constraints fix how it slides, whatever friction does, "
            "and friction exceeds the force that pushes the contact together: no impulse satisfies both.\n"
            "Fix: less friction, or a plastic impact onto a phase in which the contact holds: lj.touches(gap)."
        )
    return said + (
        "Usual cause: a reset that divides by something that is zero there, or takes its root; or constraints of the "
        "next phase that cannot be satisfied.\n"
        "Fix: look at reset(t, q, v, params) at that state, in traj.switches with throw=False."
    )


def _phases_along(trajectory):
    switches, hybrid = trajectory.switches, trajectory.system
    return [int(hybrid.first), *map(int, np.asarray(switches.to)[: len(switches)])]


def _below_zero(hybrid, start):
    first, found = int(hybrid.first), []
    system = hybrid.systems[first]
    multipliers = accelerations(system, *start)[1] if system.constraints else {}
    for i in hybrid.leaving(first):
        switch = hybrid.switches[i]
        value = switch.value(start.t, start.q, start.v, multipliers, start.params)
        if float(value) < 0:
            found.append(f"that of {switch.in_words()} is {float(value):.6g}")
    return (
        f"a guard of phase '{hybrid.names[first]}' is below zero at the start: {'; '.join(found)}.\n"
        "Usual cause: a motion that starts in the wrong phase, or a guard with the wrong sign: it must be above zero "
        "as long as the phase lasts.\n"
        "Fix: lj.integrate(..., start=name), or -guard."
    )
