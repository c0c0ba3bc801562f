"""The error of a failed motion: in the user's terms, or from inside a program by the message of its result.

At run time equinox raises the largest code of the lanes that fail. An empty batch has no largest code, so the code
passes through a primitive that gives an empty batch one of success.
"""

from collections.abc import Sequence
from typing import NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import arguments
from lagjax.integrate.diagnose_contacts import of_elements
from lagjax.integrate.diagnose_guard import of_guards
from lagjax.integrate.diagnose_stop import stopped_early
from lagjax.integrate.error_report import columns
from lagjax.integrate.parts import pack
from lagjax.integrate.problem import Problem
from lagjax.integrate.results import RESULTS, ended_well, is_among, message
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.one_motion import START_TOLERANCES
from lagjax.integrate.tolerances import tolerances_at
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import as_usual, compiled, primitive
from lagjax.mechanics import accelerations, describe, explain_failure
from lagjax.system import OF_STATE, Hybrid, State, coordinates, takes_of


@as_usual
def raise_at_run_time(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory; if it failed, the program that computes it ends with the message of its result."""
    code = _code_p.bind(jnp.asarray(trajectory.result._value))
    result = eqx.tree_at(lambda result: result._value, trajectory.result, code)
    return result.error_if(trajectory, ~ended_well(result))


def _batched(operands: Sequence, axes: Sequence):
    (code,), (axis,) = operands, axes
    if code.shape[axis] == 0:
        return jnp.full(code.shape[:axis] + code.shape[axis + 1 :], RESULTS.successful._value), None
    return _code_p.bind(code), axis


def _same(code):
    return code


_code_p = primitive("result_code", _same, _same, batched=_batched)


# Switches at times that differ by less than this part of the last time are simultaneous.
AT_ONE_TIME = 1e-12
# Of so many gaps between switches, the last ones that are not of zero length, most have one ratio.
ENOUGH = 12
# A switch that changes velocities by less than this part of the largest one changes nothing.
STILL = 1e-12


def raise_failure(trajectory: Trajectory, start: State, settings: Settings, guards) -> NoReturn:
    """Raise the error of a failed motion; `start` is its first state, `guards` those of each phase."""
    # The guards of elements take modes, and are said in words of their own.
    elements = trajectory.in_phases and trajectory.system.elements is not None
    about_guards = "" if elements else of_guards(trajectory, guards)
    if trajectory.in_phases:
        _raise_in_phase(trajectory, start, settings, about_guards)
    _raise(trajectory, start, settings, about_guards)


def _raise(trajectory, start: State, settings: Settings, about_guards: str, where="") -> NoReturn:
    result = trajectory.result
    model, start = trajectory.model, coordinates.as_arrays(start, start.t.dtype)
    if is_among(result, [RESULTS.start_off_constraints]):
        found = compiled(tolerances_at)(start._replace(params=None), trajectory.t, settings)
        tolerances = (START_TOLERANCES * np.asarray(tolerance) for tolerance in found)
        raise ValueError(where + arguments.off_constraints(model, start, *tolerances))
    if is_among(result, arguments.REFUSED):
        arguments.check_finite(start)
        raise ValueError(where + (explain_failure(model, start) or message(result)))
    raise RuntimeError(where + stopped_early(trajectory, settings, about_guards))


def _raise_in_phase(trajectory, start: State, settings: Settings, about_guards: str) -> NoReturn:
    hybrid, switches, result = trajectory.system, trajectory.switches, trajectory.result
    if hybrid.elements is not None and _is_of_elements(trajectory, start):
        raise of_elements(trajectory, start)
    if is_among(result, [RESULTS.too_many_switches]):
        raise RuntimeError(_too_many(trajectory))
    if is_among(result, [RESULTS.guard_below_zero]):
        raise ValueError(_below_zero(hybrid, start))
    if is_among(result, [RESULTS.guard_not_seen]):
        raise RuntimeError(
            f"a guard of phase '{hybrid.names[trajectory.last_phase()]}', which began at t = "
            f"{float(trajectory.end.t):.9g}, is below zero at t = {float(trajectory.t[-1]):.9g}, but no crossing of "
            f"zero was found{_not_seen(trajectory, settings)}.\n"
            "Fix: a guard that is continuous and above zero as long as its phase lasts; or max_step=, so that steps "
            "see where it dips below."
        )
    if is_among(result, [RESULTS.reset_not_finite]):
        raise RuntimeError(_no_state_after(trajectory))
    count, phase = len(switches), trajectory.last_phase()
    entered = start
    if count:
        after = switches.t, switches.q_after, switches.v_after
        entered = State(*jax.tree.map(lambda x: np.asarray(x)[count - 1], after), trajectory.params)
    there = f"in phase '{hybrid.names[phase]}', entered at t = {float(entered.t):.9g}: "
    problem, how = (hybrid.systems[phase], trajectory.params, trajectory.asked), trajectory.static.how
    arrays, static = pack(problem, how, trajectory.static.integrate)
    fields = {
        name: getattr(trajectory, name) for name in ("q", "v", "end", "stats", "scaled_error", "result", "tolerance")
    }
    names = hybrid.systems[phase].constraints

    def of_phase(tree: PyTree):
        return {name: tree[name] for name in names}

    fields["end"] = fields["end"]._replace(multipliers=of_phase(fields["end"].multipliers))
    alone = Trajectory(
        t=trajectory.t, multipliers=of_phase(trajectory.multipliers), events={}, arrays=arrays, static=static, **fields
    )
    _raise(alone, entered, settings, about_guards, there)


def _is_of_elements(trajectory, start: State) -> bool:
    """Whether elements ended a motion, and no switch of phases."""
    result, hybrid = trajectory.result, trajectory.system
    if is_among(result, [RESULTS.element_refused]):
        return True
    of_switch = is_among(result, [RESULTS.guard_not_seen, RESULTS.reset_not_finite])
    of_switch = of_switch or is_among(result, [RESULTS.guard_below_zero]) and bool(_switches_below(hybrid, start))
    return hybrid.laws[trajectory.last_phase()] is not None and not of_switch


def _too_many(trajectory):
    switches = trajectory.switches
    t, count = np.asarray(switches.t)[: len(switches)], len(switches)
    gaps, last = np.diff(t), float(t[-1])
    apart = gaps[gaps > AT_ONE_TIME * max(abs(last), 1e-300)]
    said = f"there were {count} switches until t = {last:.9g}, and one more exceeds most_switches = {count}.\n"
    ratios = apart[1:][-ENOUGH:] / apart[:-1][-ENOUGH:]
    ratio = float(np.median(ratios)) if ratios.size > 1 else 1.0
    if ratio < 1 and np.mean(abs(ratios - ratio) < 0.1 * ratio) > 0.5:
        end = last + (gaps[-1] * ratio / (1 - ratio) if gaps[-1] in apart else 0.0)
        return said + (
            f"Usual cause: infinitely many switches in finite time: each takes {ratio:.3g} of the time of the "
            f"one before, so that the motion comes to rest at about t = {end:.6g}.\n"
            'Fix: add a phase of rest, with lj.Switch(..., rest="lying") to go there; or ts that end before.'
        )
    at_once = 1 + int(np.argmax(gaps[::-1] > AT_ONE_TIME * max(abs(last), 1e-300))) if apart.size else count
    if at_once < min(3, count):
        return said + f"Fix: lj.Hybrid(..., most_switches={10 * count}), or ts that end before."
    names = " -> ".join(trajectory.system.names[i] for i in _phases_along(trajectory)[-4:])
    said += f"The last {at_once} of them, {names}, happen at one time"
    before, after = (columns(np, x, rows=len(switches.t))[:count] for x in (switches.v, switches.v_after))
    change, size = np.max(abs(after[-1] - before[-1])), np.max(abs(np.concatenate([before, after])))
    if change > STILL * size:
        return said + (
            f", and still change velocities, the last one by {change:.2g}: impacts that follow each other.\n"
            f"Fix: lj.Hybrid(..., most_switches={10 * count})."
        )
    return said + (
        f", and the last one changes velocities by {change:.1g} only: its guard is at zero, or below, and falls "
        "although nothing moves toward it. No phase lasts.\n"
        "Fix: add a phase for what happens there (a contact that stays, a joint that sticks), with the constraint "
        'that holds it: lj.Switch(..., rest="lying"), or start="lying".'
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
            "Fix: less friction, or a plastic impact onto a phase in which the contact holds: lj.guards.touches(gap)."
        )
    return said + (
        "Usual cause: a reset that divides by something that is zero there, or takes its root; or constraints of the "
        "next phase that cannot be satisfied.\n"
        "Fix: look at reset(t, q, v, params) at that state, in traj.switches with throw=False."
    )


def _not_seen(trajectory, settings: Settings):
    """The guards that are below zero at the end of the last phase, which is integrated without them."""
    hybrid, end, i = trajectory.system, trajectory.end, trajectory.last_phase()
    ts = np.array([end.t, trajectory.t[-1]], np.asarray(trajectory.t).dtype)
    alone = trajectory.static.integrate(Problem(hybrid.systems[i], end.q, end.v, trajectory.params, ts, None, settings))
    values = {}
    for switch in (hybrid.switches[k] for k in hybrid.leaving(i)):

        def of(at, switch=switch):
            return float(switch.value(at.t, at.q, at.v, at.multipliers, trajectory.params))

        values[switch.in_words()] = of(end), of(alone.end)
    below = {name: pair for name, pair in values.items() if not pair[1] >= 0}
    said = "; ".join(f"that of {name} is {g1:.3g}, and {g0:.3g} at the start" for name, (g0, g1) in below.items())
    return f": {said}" if said else ""


def _phases_along(trajectory):
    switches, hybrid = trajectory.switches, trajectory.system
    return [int(hybrid.first), *map(int, np.asarray(switches.to)[: len(switches)])]


def _switches_below(hybrid: Hybrid, start: State) -> list[str]:
    """The guards of switches of the first phase that are below zero at the start, in words."""
    first, found = int(hybrid.first), []
    system = hybrid.systems[first]
    # The multipliers of elements depend on their modes.
    known = hybrid.elements is None and bool(system.constraints)
    multipliers = accelerations(system, *start)[1] if known else {}
    for i in hybrid.leaving(first):
        switch = hybrid.switches[i]
        if not known and takes_of(switch.when) != OF_STATE:
            continue
        value = switch.value(start.t, start.q, start.v, multipliers, start.params)
        if float(value) < 0:
            found.append(f"that of {switch.in_words()} is {float(value):.6g}")
    return found


def _below_zero(hybrid: Hybrid, start: State):
    name, found = hybrid.names[int(hybrid.first)], "; ".join(_switches_below(hybrid, start))
    return (
        f"a guard of phase '{name}' is below zero at the start: {found}.\n"
        "Usual cause: a motion that starts in the wrong phase, or a guard with the wrong sign: it must be above zero "
        "as long as the phase lasts.\n"
        "Fix: lj.integrate(..., start=name), or -guard."
    )
