"""A motion in legs: one solve after another, each in one mode, from one change of the mode to the next.

What moves in legs is an *automaton*: a mode, guards that end a leg, times at which one ends in any case, and what
happens at an end. Phases of a hybrid, modes of elements (`segments.py`) and outcomes of comparisons (`over_jumps.py`)
are the three that there are; each is a `Location`, or several, and this is the loop that they share. Which leg comes
next is known at run time, so that all locations are in one loop; in a batch each location is solved for all lanes that
are in it, while the others stand still. The legs are what is differentiated: the time and the state at a crossing carry
their derivatives (`event_times.py`) into the start of the next leg, which is the saltation matrix.

Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204 (trajectory sensitivities through switches).
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.events.brackets import uneven
from lagjax.integrate.events.event import Crossings, Guards
from lagjax.integrate.parts import Snapshot
from lagjax.integrate.results import RESULTS, ended_well
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.one_motion import solved
from lagjax.jaxtools import apart, like, stop_gradient, where
from lagjax.system import System, coordinates

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
