"""A motion over the jumps and kinks of its forces: outcomes of comparisons as modes of an automaton (`legs.py`).

In a mode (`jumps/find.py`) the equations are smooth, and each leg ends where the guard of one of its comparisons is
zero. There the mode changes and the state does not; the time and the state carry their derivatives (`event_times.py`)
into the next leg, so that derivatives of all orders get the jump: with the flows φ₋ and φ₊ of both sides and the time τ
at which a neighbouring motion crosses, the neighbour goes on from φ₊(-τ) φ₋(τ). If both sides push the motion back it
goes along the jump (`integrate/sliding.py`), until a share of the mixture leaves [0, 1].

After very many jumps, and where a mode turns out to be wrong, the rest of the motion is integrated with the comparisons
as they are, which is right too, with more steps and without the jumps' part of the derivatives; `stats["lost_jumps"]`
says so.

Jumps that depend on t alone are ends of steps inside a leg, like `jump_ts` (`integrate/jumps.py`).

Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204 (trajectory sensitivities through switches).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.elements import WithElements
from lagjax.integrate.events.event import LONG, EventKind, Guards
from lagjax.integrate.jumps import Jumps, OfParams, Smooth
from lagjax.integrate.parts import Snapshot
from lagjax.integrate.results import RESULTS, ended_well
from lagjax.integrate.settings import Settings
from lagjax.integrate.sliding import Mixed, Sliding, slidable
from lagjax.integrate.solve.legs import (
    AT_ONCE,
    Leg,
    Location,
    Then,
    Way,
    before_any,
    ending_of,
    nothing,
    over_legs,
    sizes_of,
    times_of,
    unknown,
)
from lagjax.integrate.solve.one_motion import resolution
from lagjax.integrate.tolerances import DIED_OUT
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import IN_TIME, apart, stop_gradient, where
from lagjax.system import WITH_MULTIPLIERS, Given, System, model_of, warn

# The most jumps that are followed in a motion.
MOST_JUMPS = 1000


class JumpWarning(UserWarning):
    """A force jumps or has a kink where the motion is not followed across it: derivatives may lack a part."""


def warn_of_missed(missed: Sequence[str]):
    """Say which jumps are not followed."""
    warn(
        f"not followed across its jumps or kinks: {'; '.join(dict.fromkeys(missed))}.\n"
        "The motion is right to its tolerance, but takes more steps, and where such a number changes its branch, "
        "derivatives lack the part that is due to the change.\n"
        "Usual cause: a network with relu, a comparison inside lax.scan, a force with a comparison in a phase.\n"
        "Fix: a smooth function in its place (jax.nn.softplus, jnp.tanh), the comparison outside of the loop, or "
        'jumps="ignored" if it does not matter.',
        JumpWarning,
    )


def with_lost(stats, too_many: Array):
    """The statistics of a motion, with jumps in time that were too many to be followed."""
    known = {"num_jumps": jnp.asarray(0), "lost_jumps": jnp.asarray(False)} | stats
    return known | {"lost_jumps": known["lost_jumps"] | too_many}


def warn_of_lost(trajectory: Trajectory):
    """Say that a motion could not be followed across all its jumps."""
    if "lost_jumps" in trajectory.stats and bool(trajectory.stats["lost_jumps"]):
        count = int(trajectory.stats["num_jumps"])
        why = f"after {count} jumps" if count else "at all, or not across those in time, more than 256"
        warn(
            f"the motion was not followed across the jumps of its forces {why}; there forces were taken as they come: "
            "the motion is right to its tolerance, and derivatives lack the part that is due to those jumps.\n"
            "Usual cause: a comparison at the end of a function's domain (arccos, sqrt), a control that chatters, a "
            "long table of times.\n"
            'Fix: jumps="ignored" if the comparison only guards against NaN; a shorter time span.',
            JumpWarning,
        )


class ModeGuard(eqx.Module):
    """The guard of one mode, (t, q, v, given) -> a number above zero as long as the mode lasts.

    A motion that slides along jump `number` has α (1 - α) in its place.
    """

    guard: Smooth
    sliding: Sliding | None
    number: int = eqx.field(static=True)

    def __call__(self, t: Array, q: PyTree, v: PyTree, given: Given):
        value = self.guard(t, q, v, given)
        if self.sliding is not None:
            share = self.sliding.mixture(t, q, v, given).shares[self.sliding.which.index(self.number)]
            value = jnp.where(given.slides[self.number], share * (1 - share), value)
        return jnp.where(given.free, 1.0, value)


class Piecewise(eqx.Module):
    """A system in a mode: its `smooth` equations, the mixtures, and for each mode its guard and the mode beyond.

    `pauses`: whether guards may jump with time, so that legs end where forces do.
    """

    smooth: System
    sliding: Sliding | None
    guards: tuple[ModeGuard, ...]
    beyond: tuple[Smooth, ...]
    pauses: bool = eqx.field(static=True)


def piecewise_of(jumps: Jumps, system: System, small: bool) -> Piecewise:
    """The smooth system with its guards; motions slide in `small` systems. Forces of elements stay as they are."""
    bare, beside = without_elements(system)
    smooth, guards, sliding = jumps.smooth(bare), jumps.numbers(bare, 0), None
    if beside is not None:
        smooth = replace(smooth, force=Beside(smooth.force, beside))
    which = slidable(jumps, smooth) if small else ()
    if which:
        differences = jumps.numbers(bare, 2)
        sliding = Sliding(smooth, tuple(differences[i] for i in which), which)
        smooth = replace(smooth, force=Mixed(smooth.force, sliding))
    guards = tuple(ModeGuard(guard, sliding if i in which else None, i) for i, guard in enumerate(guards))
    pauses = sliding is not None or any(IN_TIME in slot.depends for slot in jumps.slots)
    return Piecewise(smooth, sliding, guards, tuple(jumps.numbers(bare, 1)), pauses)


class Beside(eqx.Module):
    """The forces of elements beside a smooth one."""

    force: Callable | None
    elements: WithElements
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: Given):
        own = self.elements(t, q, v, multipliers, given.params)
        return own if self.force is None else jax.tree.map(jnp.add, self.force(t, q, v, given), own)


def without_elements(system: System) -> tuple[System, WithElements | None]:
    """A system of `InModes` without the forces of elements, and these; any other system as it is."""
    if not isinstance(system.force, WithElements):
        return system, None
    force = system.force.force
    bare = replace(system, force=None if force is None else OfParams(force))
    return bare, replace(system.force, force=None)


class Outcomes(NamedTuple):
    """The outcomes of one system's comparisons, and along which the motion slides: as in `Given`."""

    modes: Float[Array, " n"]
    slides: Bool[Array, " n"]


class Jumping(NamedTuple):
    """The mode of a motion over jumps: that of its location, and the outcomes in each location.

    `fresh`: whether outcomes are still to be found, as the comparisons say. `free`: as in `Given`. `count`: of the
    jumps so far.
    """

    inner: Any
    outcomes: tuple[Outcomes | None, ...]
    fresh: Bool[Array, ""]
    free: Bool[Array, ""]
    count: Int[Array, ""]


class Alone(Location):
    """A motion of one system, with the guards of the user's events."""

    def __init__(self, system: System, guards: Guards | None):
        self.system, self.guards = system, guards

    def then(self, leg: Leg) -> Then:
        no, end, yes = jnp.asarray(False), leg.end, jnp.asarray(True)
        return Then(no, no, False, end, end.q, end.v, None, None, leg.result, leg.events, leg.rows, yes)


class OverJumps(Location):
    """Location `i` of a motion over `ts`, in which jumps are followed, if there are any: their guards come first."""

    def __init__(self, inner: Location, i: int, jumps: Jumps | None, small: bool, ts: Array, settings: Settings):
        self.inner, self.i, self.ts, self.settings, self.jumps = inner, i, ts, settings, jumps
        self.piecewise = None if jumps is None else piecewise_of(jumps, inner.system, small)
        self.system = inner.system if self.piecewise is None else self.piecewise.smooth
        self.guards = inner.guards if self.piecewise is None else _together(self.piecewise, inner.guards)

    def has(self, mode: Jumping) -> Bool[Array, ""] | bool:
        return self.inner.has(mode.inner)

    def given(self, params: PyTree, way: Way) -> Any:
        given, mode = self.inner.given(params, _inside(way)), way.mode
        before = mode.outcomes[self.i]
        if self.jumps is None or before is None:
            return given
        found = self.jumps.modes(without_elements(self.inner.system)[0], way.t, way.q, way.v, given)
        modes = jnp.where(mode.fresh, stop_gradient(found), before.modes)
        return Given(given, modes, before.slides & ~mode.fresh, mode.free)

    def until(self, ahead: Float[Array, " T"], way: Way) -> Float[Array, " T"]:
        ahead = self.inner.until(ahead, _inside(way))
        if self.piecewise is None or not self.piecewise.pauses or self.settings.jump_ts is None:
            return ahead
        # A guard that jumps in time may have no zero: the next leg begins there, and ends at once. Not `minimum`, whose
        # derivative is one half for an output at that time.
        pause = _next(self.settings.jump_ts, way.t, resolution(self.ts))
        return jnp.where(ahead > pause, pause, ahead)

    def then(self, leg: Leg) -> Then:
        """The mode beyond a comparison; the same, after a pause; the same leg without modes; or what follows in the
        location alone."""
        mode, last, here = leg.way.mode, self.ts[-1], leg.here & ~leg.begins
        given = leg.given if self.piecewise is None else leg.given.params
        then = self.inner.then(leg._replace(way=_inside(leg.way), given=given))
        by_jump, again, end, outcomes = jnp.asarray(False), jnp.asarray(False), leg.end, mode.outcomes
        if self.piecewise is not None:
            guards, given = self.piecewise.guards, leg.given
            when, of_events = times_of(self.guards, leg.events, len(guards), last.dtype)
            found = apart(
                ending_of, self.guards, len(guards), leg, jnp.stack(when), of_events, False, resolution(self.ts),
                self.settings.rtol,
            )  # fmt: skip
            end, ends_well = found.end, ended_well(leg.result)
            gives_up = (leg.result == RESULTS.max_steps_reached) | (leg.result == RESULTS.no_progress)
            # Where a force jumps in time, the side of which a guard is belongs to the next leg.
            wrong = ends_well & ~found.by_guard & (end.t >= last) & found.below | ~ends_well & ~gives_up
            by_jump, again = here & found.by_guard, here & ~mode.free & wrong
            # Not where a leg began, if it ended at once: what jumps with time has jumped only after that.
            beyond = Outcomes(*apart(_beyond, self.piecewise, found.first, leg.end, given))
            new = where(by_jump, beyond, Outcomes(given.modes, given.slides))
            outcomes = tuple(new if i == self.i else x for i, x in enumerate(outcomes))
        mine = by_jump | again
        onward, count = then.onward & ~mine, mode.count + by_jump
        paused = here & ~mine & (then.result == RESULTS.successful) & ~then.moves & (then.end.t < last)
        free = mode.free | again | (by_jump & (count >= MOST_JUMPS))
        result = RESULTS.where(by_jump, RESULTS.successful, RESULTS.where(again, leg.result, then.result))
        end = end._replace(multipliers=unknown(then.end.multipliers) | end.multipliers)
        inner, record, events, end, q, v, rows_q = where(
            mine,
            (mode.inner, leg.way.record, {x: leg.events[x] for x in then.events}, end, end.q, end.v, leg.rows["q"]),
            (then.mode, then.record, then.events, then.end, then.q, then.v, then.rows["q"]),
        )
        mode = Jumping(inner, outcomes, onward, free, count)
        moves, before = jnp.where(mine, by_jump, then.moves | paused), then.before & (leg.way.t <= self.ts[0])
        rows, begins = then.rows | {"q": rows_q}, then.begins if then.begins is False else then.begins & ~mine
        return Then(onward, moves, again, end, q, v, mode, record, result, events, rows, before, begins)


def _inside(way: Way) -> Way:
    return way._replace(mode=way.mode.inner)


def over_jumps(
    jumps: Sequence[Jumps | None], locations: Sequence[Location], first: Way, params: PyTree, ts: Array,
    of_location: Callable, settings: Settings, adjoint: Any, most: int, turns: int,
) -> tuple[Way, dict[str, Array]]:  # fmt: skip
    """The way after all legs (`over_legs`), with the `jumps` of each location followed; and its statistics."""
    if not any(jumps):
        way = over_legs(locations, first, params, ts, of_location, adjoint, most, turns)
        return way, way.stats
    over, outcomes = [], []
    for i, (location, mine) in enumerate(zip(locations, jumps)):
        model = model_of(location.system, ts[0], first.q, first.v, location.given(params, first))
        over.append(OverJumps(location, i, mine, model.n + model.m <= 24, ts, settings))
        none = None if mine is None else Outcomes(jnp.zeros(mine.count, ts.dtype), jnp.zeros(mine.count, bool))
        outcomes.append(none)
    no, more = jnp.asarray(False), MOST_JUMPS + 2 + (0 if settings.jump_ts is None else settings.jump_ts.size)
    first = first._replace(mode=Jumping(first.mode, tuple(outcomes), ~no, no, jnp.asarray(0)))
    way = over_legs(over, first, params, ts, lambda location: of_location(location.inner), adjoint, most, turns + more)
    return way, way.stats | {"num_jumps": way.mode.count, "lost_jumps": way.mode.free}


def solved_over_jumps(
    jumps: Sequence[Jumps | None], system: System, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, guards,
    settings: Settings, adjoint: Any,
):  # fmt: skip
    """Return the fields of the trajectory, like `one_motion.solved`."""
    model = model_of(system, ts[0], q0, v0, params)
    multipliers, sizes = unknown(model.zero_multipliers()), sizes_of(q0, v0)
    # A motion that rests at zero, held by friction, has round-off alone to tell its size.
    sizes = jnp.where(jnp.any(sizes > 0), sizes, 1 / DIED_OUT)
    start, names = Snapshot(ts[0], q0, v0, multipliers), () if guards is None else [kind.name for kind in guards.kinds]
    rows = unknown({"q": q0, "v": v0, "multipliers": multipliers}, ts.shape[0])
    events = nothing(guards, names, q0, v0, multipliers)
    first, locations = before_any(start, start, None, sizes, settings, rows, events), [Alone(system, guards)]
    way, stats = over_jumps(jumps, locations, first, params, ts, lambda location: settings, settings, adjoint, 0, 0)
    return way.fields(settings) | {"stats": stats}


def _together(piecewise: Piecewise, guards: Guards | None) -> Guards:
    """The guards of the modes, and then those of the user's events."""
    long = any(len(f.guard.program.jaxpr.eqns) > LONG for f in piecewise.guards) or piecewise.sliding is not None
    of_mode = partial(
        EventKind, direction=-1, terminal=True, most=1, takes_multipliers=False, holds=True, may_rest=True
    )
    kinds = tuple(of_mode(f"mode {i}", long=long) for i in range(len(piecewise.guards)))
    if guards is None:
        return Guards(piecewise.guards, kinds)
    return Guards((*piecewise.guards, *map(OfParams, guards.functions)), (*kinds, *guards.kinds))


def _next(jump_ts, t: Array, resolution: Array):
    """The next of the times of jumps."""
    return jnp.min(jnp.where(jump_ts > t + AT_ONCE * resolution, jump_ts, jnp.inf))


def _beyond(piecewise: Piecewise, first: Array, end: Snapshot, given: Given):
    """The modes after the guard `first` has crossed zero, and along which jumps the motion then slides."""
    state, given = stop_gradient((end.t, end.q, end.v)), stop_gradient(given)
    n = len(piecewise.guards)
    mine, slid = jnp.arange(n) == first, given.slides
    beyond = jnp.stack([f(*state, given) for f in piecewise.beyond]).astype(given.modes.dtype)
    modes = jnp.where(mine, beyond, given.modes)
    if piecewise.sliding is None:
        return modes, slid
    which = piecewise.sliding.which
    shares = piecewise.sliding.mixture(*state, given).shares
    # A motion that slides leaves to the side of the share that it has.
    stays = jnp.zeros(n, bool).at[jnp.asarray(which)].set(jnp.stack(shares) < 0.5) & slid
    modes = jnp.where(mine & stays, given.modes, modes)
    after = given._replace(modes=modes, slides=slid & ~mine)
    rates = (
        jnp.zeros(n, modes.dtype).at[jnp.asarray(which)].set(jnp.stack(piecewise.sliding.mixture(*state, after).rates))
    )
    back = mine & ~slid & (rates * (2 * modes - 1) < 0)
    return modes, (slid & ~mine) | back
