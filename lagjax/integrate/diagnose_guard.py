"""Why a guard could not be followed: what it gives along the motion, in words and with the number that shows it."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np

from lagjax.integrate.events.event import EventWarning, Guards
from lagjax.integrate.hybrid_trajectory import SWITCHES, HybridTrajectory
from lagjax.integrate.results import RESULTS, is_among
from lagjax.mechanics import describe, listed
from lagjax.system import State, warn

# Outputs at which guards are evaluated; a change by the last digit that is no round-off, as a share of the guard, and
# by how much more a linear one would change where all digits from the middle on change; round-offs that are zero.
OUTPUTS, SHARE, MORE, ZERO = 16, 0.1, 100.0, 64
# What is said where no number shows more.
UNKNOWN = "touches zero within round-off, or changes too fast between steps to be followed"
# Guards are why steps are rejected if so many are, and less than this share of these without guards.
MANY_REJECTED, FEWER = 0.5, 0.5
# A guard is too fast if it changes by so many times its size in a step.
FAST = 10.0


class Instant(NamedTuple):
    """A state of the motion, its multipliers, and its phase."""

    state: State
    multipliers: Mapping
    phase: int


def warn_of_events(trajectory, guards) -> None:
    """Warn if crossings may be missing, and if there were more than are kept; `guards`: those of each phase."""
    for name, found in trajectory.events.items():
        if bool(found.uncertain):
            which, cause, fix = _in_doubt(trajectory, guards, name)
            warn(f"crossings of {which} may be missing: its guard {cause or UNKNOWN}.\nFix: {fix}.", EventWarning)
        elif int(found.count) > found.t.shape[-1] > 1:
            warn(
                f"event '{name}' happened {int(found.count)} times, but only the first {found.t.shape[-1]} are kept.\n"
                f"Fix: lj.Crossing(..., most={int(found.count)}), or terminal=True to end at the first.",
                EventWarning,
            )


def warn_of_missed_end(trajectory, guards) -> bool:
    """Whether the second, more precise motion ended at an event that this one did not see: then warn of that."""
    error = trajectory.error
    if error is None or not is_among(error.result, [RESULTS.event_occurred]):
        return False
    if is_among(trajectory.result, [RESULTS.event_occurred]):
        return False
    of_phases = [guards] if isinstance(guards, Guards) else [phase.guards for phase in guards or () if phase.guards]
    names = dict.fromkeys(f"'{kind.name}'" for of in of_phases for kind in of.kinds if kind.terminal)
    warn(
        f"a second motion with other steps ended at an event that this one did not see ({', '.join(names)}): its guard "
        "crosses zero and comes back within a step.\nFix: max_step=, shorter than the guard takes for that.",
        EventWarning,
    )
    return True


def of_guards(trajectory, guards) -> str:
    """The guards of a motion whose steps they may have shortened, in words, with what is wrong with them; "" if none.

    Those with something wrong are named alone.
    """
    found = [_in_doubt(trajectory, guards, name) for name in (trajectory.events if guards is not None else ())]
    known = [f"The guard of {which} {cause}.\nFix: {fix}." for which, cause, fix in found if cause]
    names = " and ".join(which for which, *_ in found)
    return "\n".join(known) or (names and f"The guards looked at are those of {names}.")


def rejected_by_guards(guards: str, stats: Mapping, without: float) -> str:
    """Why all steps were used up, if by guards, of which `guards` tells; `without`: the share rejected without them."""
    taken = int(stats["num_steps"])
    share = int(stats["num_rejected_steps"]) / taken
    if not guards or share <= MANY_REJECTED or without >= FEWER * share:
        return ""
    said = f"{100 * share:.3g} % of the steps were rejected; without its guards the motion goes on with "
    return f"{said}{100 * without:.3g} %. {guards}" + ("" if "Fix:" in guards else f"\nFix: max_steps={10 * taken}.")


def _in_doubt(trajectory, guards, name: str) -> tuple[str, str, str]:
    """The guard of an event, or that of a switch, that cannot be followed; why, with a number, or ""; and the fix."""
    shifted = "shift the level of the guard a little; or make the motion take shorter steps, max_step="
    if trajectory.system.elements is not None:
        switches = trajectory.switches
        modes = ("a switch of phases, or " if switches.of_phases else "") + "the modes "
        modes += listed([mode for mode, _ in switches.of_modes])
        return (modes if name == SWITCHES else f"event '{name}'"), "", shifted
    instants, step = _instants(trajectory), _step(trajectory)
    candidates = [
        (i, kind.name.partition(", number ")[0] if name == SWITCHES else name, guard, kind.takes_multipliers)
        for i in sorted({x.phase for x in instants})
        for kind, guard in zip(_of_phase(guards, i).kinds, _of_phase(guards, i).functions)
        if kind.name == name or name == SWITCHES and kind.holds
    ]
    for i, of, guard, takes in candidates:
        # The modes that its guard depends on are not known at outputs.
        if not isinstance(guards, Guards) and guards[i].meeting is not None and name == SWITCHES:
            continue
        found = _cause(guard, takes, [x for x in instants if x.phase == i], step)
        if found:
            return _called(of, name), *found
    names = " or ".join(dict.fromkeys(_called(of, name) for _, of, _, _ in candidates))
    return names, "", shifted


def _called(of, name: str):
    return f"the switch {of}" if name == SWITCHES else f"event '{of}'"


def _of_phase(guards, phase) -> Guards:
    return guards if isinstance(guards, Guards) else guards[phase].guards


def _instants(trajectory) -> list[Instant]:
    """Some outputs that were reached, and the end."""
    t, q = np.asarray(trajectory.t), jax.tree.leaves(trajectory.q)[0]
    reached = np.flatnonzero(np.isfinite(np.asarray(q).reshape(t.size, -1)).all(axis=1))
    hybrid = isinstance(trajectory, HybridTrajectory)
    rows = []
    for i in reached[np.unique(np.linspace(0, reached.size - 1, OUTPUTS).astype(int))] if reached.size else ():
        motion = trajectory.q, trajectory.v, trajectory.multipliers
        q, v, multipliers = jax.tree.map(lambda x: np.asarray(x)[i], motion)
        state = State(t[i], q, v, trajectory.params)
        rows.append(Instant(state, multipliers, int(trajectory.phase[i]) if hybrid else 0))
    end = trajectory.end
    last = trajectory.last_phase() if hybrid else 0
    return [*rows, Instant(State(end.t, end.q, end.v, trajectory.params), end.multipliers, last)]


def _step(trajectory):
    """The mean length of the steps of the motion."""
    taken = max(1, int(trajectory.stats["num_accepted_steps"]))
    return abs(float(trajectory.end.t) - float(trajectory.t[0])) / taken


def _cause(guard: Callable, takes_multipliers: bool, instants, step) -> tuple[str, str] | None:
    """What is wrong with a guard at some instants, with the fix; None if nothing is."""

    def value(instant, change=0.0):
        t, q, v = jax.tree.map(lambda x: np.asarray(x) * (1 + change), instant.state[:3])
        of = (t, q, v, instant.multipliers) if takes_multipliers else (t, q, v)
        return float(guard(*of, instant.state.params))

    values = np.array([value(x) for x in instants])
    for x, g in zip(instants, values):
        if not np.isfinite(g):
            return (
                f"is {g} at t = {float(x.state.t):.9g}, where q = {describe(x.state.q)}",
                "a guard that is finite along the whole motion: jnp.sqrt(jnp.maximum(x, 0)) for a root, or a guard "
                "without the root, the logarithm or the quotient, which is zero at the same place",
            )
    eps, size = np.finfo(np.asarray(instants[0].state.t).dtype).eps, np.max(abs(values))
    last, half = (np.array([value(x, change) for x in instants]) - values for change in (4 * eps, np.sqrt(eps)))
    worst = int(np.argmax(abs(last)))
    if abs(last[worst]) > SHARE * size and abs(half[worst]) < MORE * abs(last[worst]):
        return (
            f"changes from {values[worst]:.3g} to {values[worst] + last[worst]:.3g} at "
            f"t = {float(instants[worst].state.t):.9g} where t, q and v change in their last digit",
            "a guard that changes by no more than its size when the state does so by its own",
        )
    if np.all(abs(values) <= ZERO * abs(last)):
        return (
            f"is zero within round-off all along, at most {size:.2g}",
            "another level of the guard, if it is a quantity that is conserved",
        )
    rates = [_rate(value, x, step) for x in instants]
    fastest = int(np.argmax(rates))
    if step * rates[fastest] > FAST * size:
        t = float(instants[fastest].state.t)
        return (
            f"changes at a rate of {rates[fastest]:.2g} at t = {t:.9g}, by its size within "
            f"{size / rates[fastest]:.2g}, where a step of the motion is {step:.2g}",
            f"max_step={size / rates[fastest]:.1g}; or a guard that changes as slowly as the motion",
        )
    return None


def _rate(value, instant, step):
    """The size of dg/dt along (q, v), by a difference over a millionth of a step."""
    t, q, v, params = instant.state
    h = 1e-6 * step
    on = State(np.asarray(t) + h, jax.tree.map(lambda x, dx: np.asarray(x) + h * np.asarray(dx), q, v), v, params)
    return abs(value(instant._replace(state=on)) - value(instant)) / h if h > 0 else 0.0
