"""A motion in legs: one solve after another, each in one mode, from one change of the mode to the next.

What moves in legs is an *automaton*: a mode, guards that end a leg, times at which one ends in any case, and what
happens at an end. Phases of a hybrid, modes of elements (`segments.py`) and outcomes of comparisons (`OverJumps`)
are the three that there are; each is a `Location`, or several, and this is the loop that they share. Which leg comes
next is known at run time, so that all locations are in one loop; in a batch each location is solved for all lanes that
are in it, while the others stand still. The legs are what is differentiated: the time and the state at a crossing carry
their derivatives (`event_times.py`) into the start of the next leg, which is the saltation matrix.

Over the jumps and kinks of forces, outcomes of comparisons are the modes. In a mode (`integrate/jumps.py`) the
equations are smooth, and each leg ends where the guard of one of its comparisons is zero. There the mode changes and
the state does not; the time and the state carry their derivatives (`event_times.py`) into the next leg, so that
derivatives of all orders get the jump: with the flows φ₋ and φ₊ of both sides and the time τ at which a neighbouring
motion crosses, the neighbour goes on from φ₊(-τ) φ₋(τ). If both sides push the motion back it goes along the jump
(`Sliding`), until a share of the mixture leaves [0, 1].

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

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.elements import WithElements
from lagjax.integrate.events.brackets import uneven
from lagjax.integrate.events.event import LONG, Crossings, EventKind, Guards
from lagjax.integrate.jumps import Jumps, Mixed, OfParams, Sliding, Smooth, slidable
from lagjax.integrate.results import RESULTS, Snapshot, ended_well
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.one_motion import resolution, solved
from lagjax.integrate.stepping import DIED_OUT
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import IN_TIME, apart, like, stop_gradient, where
from lagjax.system import WITH_MULTIPLIERS, Given, System, coordinates, model_of, warn

# How far below zero a guard may be where a motion starts, in tolerances of its terms.
NOT_BELOW = 1e2
# The fields that a leg gives at its outputs.
ROWS = "q", "v", "multipliers"
# Times within this many resolutions of time are simultaneous.
AT_ONCE = 4


class Way(NamedTuple):
    """How far the legs have come: the state from which the next one starts, and the results of all before.

    `mode`: that of the automaton. `continues`: whether there is a next leg. `count`: of the changes of mode so far,
    with the automaton's own `record` of them. `rows`: the outputs; NaN where there is none yet. `events`: the recorded
    crossings. `sizes_so_far`: the largest coordinates and velocities, (2, n); `least`: the sizes below which numbers
    counted as zero. `begins`: whether the mode that fits the start is still to be found, in a leg of no length.
    """

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    mode: Any
    begins: Bool[Array, ""]
    continues: Bool[Array, ""]
    count: Int[Array, ""]
    record: Any
    rows: dict[str, Any]
    events: dict[str, Crossings]
    end: Snapshot
    stats: dict[str, Array]
    sizes_so_far: Array
    least: Array
    scaled_error: Float[Array, ""]
    settled: Bool[Array, ""]
    result: Any

    def fields(self, settings: Settings) -> dict[str, Any]:
        """The fields of a trajectory."""
        return self.rows | {
            "end": self.end,
            "stats": self.stats,
            "tolerance": (settings.rtol, self.least),
            "scaled_error": self.scaled_error,
            "result": self.result,
            "settled": self.settled,
            "events": self.events,
        }


class Leg(NamedTuple):
    """A leg that has been solved: where it was asked for (`here`), from which `way`, to the times that it was given.

    `given`: what functions took as `params`; `end`, `result`, `events`: those of the solve; `rows`: its outputs.
    """

    here: Bool[Array, ""]
    begins: Bool[Array, ""]
    way: Way
    given: Any
    times: Float[Array, " T"]
    end: Snapshot
    result: Any
    events: dict[str, Crossings]
    rows: dict[str, Any]


class Then(NamedTuple):
    """What follows a leg: whether the motion goes `onward`, by a change that counts and is recorded; whether it `moves`
    on from where the leg ended, by that, a jump or a pause; or whether the leg is done `again`, and does not count.

    `end`: of the leg; `q`, `v`: after it; `mode`: after it, also where it is done again; `record`: with this change;
    `rows`: of the leg, with those of its mode; `before`: which of the outputs up to its start are its own; `begins`:
    whether the mode that fits is still to be found where the next leg starts.
    """

    onward: Bool[Array, ""]
    moves: Bool[Array, ""]
    again: Bool[Array, ""] | bool
    end: Snapshot
    q: PyTree
    v: PyTree
    mode: Any
    record: Any
    result: Any
    events: dict[str, Crossings]
    rows: dict[str, Any]
    before: Bool[Array, ""]
    begins: Bool[Array, ""] | bool = False


class Location:
    """The modes of an automaton in which one `system` moves, with its `guards`."""

    system: System
    guards: Guards | None

    def has(self, mode: Any) -> Bool[Array, ""] | bool:
        """Whether a mode is one of these."""
        return True

    def given(self, params: PyTree, way: Way) -> Any:
        """What functions take as `params` in the leg that begins here."""
        return params

    def until(self, ahead: Float[Array, " T"], way: Way) -> Float[Array, " T"]:
        """The outputs `ahead`, no further than where the next leg ends in any case."""
        return ahead

    def then(self, leg: Leg) -> Then:
        """What follows a leg."""
        raise NotImplementedError


def over_legs(
    locations: Sequence[Location], first: Way, params: PyTree, ts: Float[Array, " T"], settings: Callable, adjoint: Any,
    most: int, turns: int,
) -> Way:  # fmt: skip
    """The way after all legs, of `most` changes of mode: while it continues, or in as many `turns`, for reverse mode.

    `settings(location)`: those of its legs.
    """

    def next_legs(way: Way) -> Way:
        for location in locations:
            here = way.continues & location.has(way.mode)
            leg = partial(_after, location, here, params=params, ts=ts, settings=settings(location), adjoint=adjoint)
            # The loop asks already whether any lane is in the only location.
            way = leg(way) if len(locations) == 1 else lax.cond(eqxi.unvmap_any(here), leg, lambda way: way, way)
        return way

    if isinstance(adjoint, diffrax.ForwardMode):
        # On one number alone XLA would try to count the turns, in a copy of all that is inside, at each of its passes.
        # One question for all lanes: if each had its own, JAX would copy the results of all legs in each turn.
        return lax.while_loop(lambda way: eqxi.unvmap_any(way.continues & (way.count <= most)), next_legs, first)

    def turn(way: Any, _: None):
        return lax.cond(eqxi.unvmap_any(way.continues), next_legs, lambda way: way, way), None

    return lax.scan(turn, first, None, length=turns)[0]


def before_any(
    start: Snapshot, end: Snapshot, mode: Any, sizes: Array, settings: Settings, rows: dict[str, Any],
    events: dict[str, Crossings], record: Any = None, begins: Bool[Array, ""] | bool = False,
) -> Way:  # fmt: skip
    """The way before the first leg; `end`: of the motion, if there is none."""
    zero, yes, dtype = jnp.asarray(0), jnp.asarray(True), start.t.dtype
    return Way(
        t=start.t, q=start.q, v=start.v, mode=mode, begins=jnp.asarray(begins), continues=yes, count=zero,
        record=record, rows=rows, events=events, end=end,
        stats={name: zero for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")}, sizes_so_far=sizes,
        least=jnp.zeros_like(sizes) if settings.by_size else settings.atol, scaled_error=jnp.zeros((), dtype),
        settled=yes, result=RESULTS.successful,
    )  # fmt: skip


def _after(
    location: Location, here: Array, way: Way, params: PyTree, ts: Array, settings: Settings, adjoint: Any
) -> Way:
    """The way after one more leg in a location, for the lanes that are `here`."""
    ahead, at = outputs_ahead(ts, way.t)
    begins, given = here & way.begins, location.given(params, way)
    # Lanes elsewhere stand still.
    times = jnp.where(here & ~begins, location.until(ahead, way), way.t)
    found = apart(
        solved, location.system, way.q, way.v, given, times, location.guards, settings, adjoint, way.sizes_so_far,
    )  # fmt: skip
    rows = {name: found[name] for name in ROWS}
    then = location.then(Leg(here, begins, way, given, times, found["end"], found["result"], found["events"], rows))
    again = jnp.asarray(then.again)
    counts, end, result = here & ~again & ~begins, then.end, then.result
    known = ((ts > way.t) & (ts <= end.t) | then.before & (ts <= way.t)) & counts
    rows = jax.tree.map(lambda x: x[at], then.rows)
    known = known & reached(rows["q"])
    # Nothing is known from a leg of no length, but for the mode and the velocities that fit the start.
    sizes = jnp.maximum(way.sizes_so_far, sizes_of(end.q, end.v))
    sizes = jnp.where(begins & (way.count == 0), sizes_of(then.q, then.v), sizes)
    least = way.least if not settings.by_size else jnp.maximum(way.least, stop_gradient(found["tolerance"][1]))
    error = jnp.where(ended_well(result), jnp.maximum(way.scaled_error, found["scaled_error"]), jnp.inf)
    stats = {name: n + found["stats"][name] for name, n in way.stats.items()}
    least, stats = where(begins, (way.least, way.stats), (least, stats))
    failed, events = begins & ~then.onward, with_those_of(then.events, way.events)
    events = events if then.again is False else where(then.again, way.events, events)
    further = Way(
        t=jnp.where(then.moves, end.t, way.t), q=where(then.moves, then.q, way.q), v=where(then.moves, then.v, way.v),
        mode=then.mode, begins=jnp.asarray(then.begins), continues=again | then.moves & (end.t < ts[-1]),
        count=way.count + (then.onward & ~begins), record=then.record,
        rows=filled(way.rows, known, rows), events=events,
        end=where(then.onward, end._replace(q=then.q, v=then.v), where(counts, end, way.end)), stats=stats,
        sizes_so_far=sizes, least=least,
        scaled_error=jnp.where(failed, jnp.inf, jnp.where(counts, error, way.scaled_error)),
        settled=way.settled & (found["settled"] | begins), result=RESULTS.where(again, RESULTS.successful, result),
    )  # fmt: skip
    # Outputs and the record are those of before in the other lanes.
    return where(here, further, way)._replace(rows=further.rows, record=further.record)


def outputs_ahead(ts: Array, t: Array) -> tuple[Array, Array]:
    """t and the outputs after it, padded with the last: past ones would cost a step each; and where each output is."""
    place, past = jnp.arange(ts.shape[0]), jnp.sum(ts <= t)
    ahead = jnp.where(place == 0, t, ts[jnp.minimum(place + past - 1, ts.shape[0] - 1)])
    return ahead, jnp.maximum(place - past + 1, 0)


def filled(rows: dict[str, Any], known: Array, new: dict[str, Any]) -> dict[str, Any]:
    """The outputs, with those of a leg where they are `known`; what a leg does not have stays."""

    def put(all, new):
        return jax.tree.map(lambda x, y: jnp.where(like(known, x), y.astype(x.dtype), x), all, new)

    multipliers = {name: put(x, new["multipliers"].get(name, x)) for name, x in rows["multipliers"].items()}
    others = {name: put(x, new[name]) for name, x in rows.items() if name != "multipliers"}
    return others | {"multipliers": multipliers}


def times_of(guards: Guards | None, events: dict[str, Crossings], count: int, dtype) -> tuple[list, Array]:
    """When each of the first `count` guards crosses zero first, infinite if it does not; and the first of the events
    that end a motion."""
    never = jnp.asarray(jnp.inf, dtype)
    kinds, terminal = ((), ()) if guards is None else (guards.kinds, guards.terminal)
    when = [jnp.where(jnp.isfinite(events[kind.name].t[0]), events[kind.name].t[0], jnp.inf) for kind in kinds]
    ends = [t for t, ends in zip(when[count:], terminal[count:]) if ends]
    return when[:count], jnp.min(jnp.stack([*ends, never]))


class Ending(NamedTuple):
    """How a leg ends: whether it is `by_guard`, of those that end its mode the `first`, or was `asked` to end; whether
    that is `at_once`, where it began; whether such a guard is `below` zero by more than errors can cause."""

    by_guard: Bool[Array, ""]
    first: Int[Array, ""]
    at_once: Bool[Array, ""]
    below: Bool[Array, ""]
    end: Snapshot


def ending_of(
    guards: Guards | None, count: int, leg: Leg, when: Array, of_events: Array, asked: Bool[Array, ""] | bool,
    resolution: Array, rtol: Array,
) -> Ending:  # fmt: skip
    """How a leg ends. `when`: the times at which its first `count` guards cross, and others at which it was `asked` to
    end; infinite for those that do not. `of_events`: the first of an event that ends the motion."""
    at_one_time, (t, q, v, multipliers), way = AT_ONCE * resolution, leg.end, leg.way
    # An event that ends the motion at the time of a change comes first.
    by_guard = (leg.result == RESULTS.event_occurred) & ~(of_events <= jnp.min(when) + at_one_time) | asked
    at_once = by_guard & (t - way.t <= at_one_time)
    # A change at once happens where the leg begins, so that its time has the derivatives of that.
    end = Snapshot(*where(at_once, (way.t, way.q, way.v), (t, q, v)), multipliers)
    first = jnp.argmax(when <= jnp.min(when) + at_one_time)
    return Ending(by_guard, first, at_once, _is_below(end, leg.given, guards, count, rtol), end)


def _is_below(end: Snapshot, params: PyTree, guards: Guards | None, count: int, rtol: Array):
    if guards is None or not count:
        return jnp.asarray(False)
    state = stop_gradient(tuple(end))
    g, terms = jax.jvp(lambda *state: jnp.stack(guards(*state, stop_gradient(params))[:count]), state, uneven(state))
    return jnp.any(g < -NOT_BELOW * rtol[0] * jnp.abs(terms))


def reached(q: PyTree):
    """The rows of q that are known."""
    return jnp.isfinite(jax.vmap(lambda q: jnp.sum(coordinates.flatten(q)[0]))(q))


def sizes_of(q: PyTree, v: PyTree):
    """The sizes of coordinates and velocities, (2, n)."""
    return jnp.abs(jnp.stack([stop_gradient(coordinates.flatten(y)[0]) for y in (q, v)]))


def nothing(guards: Guards | None, names, q: PyTree, v: PyTree, multipliers: dict[str, Array]) -> dict[str, Crossings]:
    """The events of these names before any crossing; `multipliers`: those of all phases, NaN."""
    room = {kind.name: kind.most for kind in (() if guards is None else guards.kinds)}

    t = jnp.zeros((), jax.tree.leaves(q)[0].dtype)
    rows = {name: unknown((t, q, v, multipliers), room[name]) for name in names}
    return {name: Crossings(*known, jnp.asarray(0), jnp.asarray(False)) for name, known in rows.items()}


def unknown(tree: PyTree, *rows: int) -> PyTree:
    """NaN in place of each number of a tree; with a number of rows, so many of it."""
    return jax.tree.map(lambda x: jnp.full((*rows, *jnp.shape(x)), jnp.nan, jnp.result_type(x)), tree)


def with_those_of(leg: dict[str, Crossings], before: dict[str, Crossings]) -> dict[str, Crossings]:
    """Append the crossings of a leg to the earlier ones."""
    return {name: _joined(found, leg[name]) for name, found in before.items()}


def _joined(before: Crossings, new: Crossings) -> Crossings:
    place = jnp.arange(before.t.shape[0]) - jnp.sum(jnp.isfinite(before.t))
    multipliers = {name: new.multipliers.get(name, jnp.full_like(x, jnp.nan)) for name, x in before.multipliers.items()}

    def join(x, y: PyTree):
        later = (place >= 0).reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(later, y[jnp.maximum(place, 0)].astype(x.dtype), x)

    rows = jax.tree.map(join, (before.t, before.q, before.v, before.multipliers), (new.t, new.q, new.v, multipliers))
    return Crossings(*rows, before.count + new.count, before.uncertain | new.uncertain)


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
