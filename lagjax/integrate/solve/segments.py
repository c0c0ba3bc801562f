"""A motion in phases: one solve after another, each from a switch to the next.

A leg is a motion of its phase's system that ends where one of the phase's guards crosses zero from above, with the
outputs that lie in it. Which leg comes next is known at run time, so that all phases are in one loop; in a batch each
phase is solved for all lanes that are in it, while the others stand still. The legs are what is differentiated: the
time and the state at a crossing carry their derivatives (`event_times.py`) into the start of the next leg, which is
the saltation matrix.

A guard is assumed to be above zero where its phase begins. If it is zero there and falls, however slowly, or is below
zero, it is crossed at once, in a leg of no length: this handles two guards at one time, and friction that cannot hold a
contact that has stopped sliding.

Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204 (trajectory sensitivities through switches).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.events.brackets import uneven
from lagjax.integrate.events.event import Crossings, Guards
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.one_motion import resolution, solved
from lagjax.integrate.trajectory.hybrid_trajectory import SWITCHES, Switches
from lagjax.integrate.trajectory.parts import NO_PHASE, Snapshot
from lagjax.integrate.trajectory.results import RESULTS, ended_well
from lagjax.jaxtools import apart, like, stop_gradient, where
from lagjax.mechanics import all_finite
from lagjax.system import Hybrid, System, coordinates, model_of


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


# How far below zero a guard may be where a motion starts, in tolerances of its terms.
NOT_BELOW = 1e2
# The fields that a leg gives at its outputs.
ROWS = "q", "v", "multipliers"
# Times within this many resolutions of time are simultaneous.
AT_ONCE = 4


class Phase(NamedTuple):
    """What ends one phase: its guards, in the order of the switches, and what each of them does to the state.

    `switches` (k,): their numbers in the hybrid; `targets` (k, 2): the next phase, and that of rest; `resets`:
    `reset(t, q, v, multipliers, params)` -> (q, v), and whether the motion comes to rest there; `events`: the names of
    the recorded events, whose guards come after those of switches. `meeting`: in place of resets, where a switch
    changes the modes of elements (`elements/meeting.py`).
    """

    guards: Guards | None
    switches: tuple[int, ...]
    targets: np.ndarray
    resets: tuple
    events: tuple[str, ...]
    meeting: Any = None

    @property
    def has_instants(self) -> bool:
        """Whether legs end at instants of sampled controls, too."""
        return self.meeting is not None and bool(self.meeting.laws.sampled)

    def in_motion(self, *motion: Any) -> "Phase":
        """The same in a motion of this tolerance, over these times from this start (`Meeting.in_motion`)."""
        return self if self.meeting is None else self._replace(meeting=self.meeting.in_motion(*motion))

    def until(self, modes: "Modes | None", ts: Array, params: PyTree) -> Float[Array, ""]:
        """The next instant."""
        if modes is None:
            return jnp.asarray(jnp.inf, ts.dtype)
        return self.meeting.laws.next_instant(modes.modes, ts, params)

    def given(self, params: PyTree, modes: "Modes | None") -> PyTree:
        """What the functions of the phase take as `params`."""
        return params if modes is None else self.meeting.laws.given(params, *modes)


class Modes(NamedTuple):
    """The modes of elements, and how far below zero round-off may take their guards."""

    modes: Int[Array, " k"]
    slack: Float[Array, " k"]


class OutputRows(NamedTuple):
    """The outputs of all legs so far; NaN, and no phase, where there is none yet."""

    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    phase: Int[Array, " T"]
    modes: Int[Array, "T k"] | None


class PhaseWay(NamedTuple):
    """How far the legs have come: the state from which the next one starts, and the results of all before.

    `continues`: whether there is a next one. `events`: the recorded crossings. `sizes_so_far`: the largest coordinates
    and velocities, (2, n); `least`: the sizes below which numbers counted as zero. `modes`: None without elements;
    `begins`: whether the modes that fit the start are still to be found, in a leg of no length.
    """

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    phase: Int[Array, ""]
    continues: Bool[Array, ""]
    rows: OutputRows
    switches: Switches
    events: dict[str, Crossings]
    end: Snapshot
    stats: dict[str, Array]
    sizes_so_far: Array
    least: Array
    scaled_error: Float[Array, ""]
    settled: Bool[Array, ""]
    result: Any
    modes: Modes | None
    begins: Bool[Array, ""]


def solved_in_legs(
    hybrid: Hybrid, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, phases, settings: Settings, adjoint: Any
):
    """Return the fields of the trajectory, like `one_motion.solved`, with the phase of each output and the switches."""
    phases = [phase.in_motion(settings.rtol[0], ts, q0, v0, params) for phase in phases]
    first = _first_leg(hybrid, q0, v0, params, ts, phases[0], settings)

    def next_legs(way: PhaseWay) -> PhaseWay:
        for i in range(len(hybrid.systems)):
            here = way.continues & (way.phase == i)
            leg = partial(
                _leg, hybrid, i, here, params=params, ts=ts, phase=phases[i], settings=settings, adjoint=adjoint
            )
            # The loop asks already whether any lane is in the only phase.
            way = leg(way) if len(hybrid.systems) == 1 else lax.cond(eqxi.unvmap_any(here), leg, lambda way: way, way)
        return way

    # Each turn takes every lane at least one leg further.
    most = hybrid.most_switches
    turns = most + 1 + any(phase.meeting is not None for phase in phases)
    way = over_legs(next_legs, lambda way: way.switches.count <= most, first, turns, adjoint)
    rows = way.rows
    return {
        "q": rows.q,
        "v": rows.v,
        "multipliers": rows.multipliers,
        "end": way.end,
        "stats": way.stats,
        "tolerance": (settings.rtol, way.least),
        "scaled_error": way.scaled_error,
        "result": way.result,
        "settled": way.settled,
        "events": way.events | ({SWITCHES: way.switches.as_crossings()} if way.switches.ways else {}),
        "phase": rows.phase,
        "modes": rows.modes,
        "switches": way.switches,
    }


def over_legs(next_leg: Callable, has_room: Callable, first: Any, turns: int, adjoint: Any) -> Any:
    """The way after all legs: while it continues and has room, or in as many turns, for reverse mode."""
    if isinstance(adjoint, diffrax.ForwardMode):
        # On one number alone XLA would try to count the turns, in a copy of all that is inside, at each of its passes.
        # One question for all lanes: if each had its own, JAX would copy the results of all legs in each turn.
        return lax.while_loop(lambda way: eqxi.unvmap_any(way.continues & has_room(way)), next_leg, first)

    def turn(way: Any, _: None):
        return lax.cond(eqxi.unvmap_any(way.continues), next_leg, lambda way: way, way), None

    return lax.scan(turn, first, None, length=turns)[0]


def outputs_ahead(ts: Array, t: Array) -> tuple[Array, Array]:
    """t and the outputs after it, padded with the last: past ones would cost a step each; and where each output is."""
    place, past = jnp.arange(ts.shape[0]), jnp.sum(ts <= t)
    ahead = jnp.where(place == 0, t, ts[jnp.minimum(place + past - 1, ts.shape[0] - 1)])
    return ahead, jnp.maximum(place - past + 1, 0)


def _first_leg(hybrid: Hybrid, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, phase, settings: Settings):
    dtype, many = ts.dtype, ts.shape[0]
    model = model_of(hybrid, ts[0], q0, v0, params)
    multipliers = reduce(lambda all, of: all | of, (phase.zero_multipliers() for phase in model.phases))
    modes = None
    if phase.meeting is not None:
        # With all gaps open, until the first leg, of no length, has found what fits the start.
        given = phase.meeting.laws.at_first(ts[0], params)
        modes = Modes(given.modes, given.slack)
        acting = jax.eval_shape(phase.meeting.laws.acting, ts[0], q0, v0, multipliers, given)
        multipliers = multipliers | jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), acting)
    of_modes = None if modes is None else jnp.zeros((many, modes.modes.size), jnp.int32)
    rows = OutputRows(*unknown((q0, v0, multipliers), many), jnp.full(many, NO_PHASE, jnp.int32), of_modes)
    switches = switches_before_any(hybrid, q0, v0, None if phase.meeting is None else phase.meeting.laws)
    # A motion in no phase would never end.
    first, phases = jnp.asarray(hybrid.first, jnp.int32), len(hybrid.systems)
    exists, refused = (first >= 0) & (first < phases), RESULTS.no_such_phase
    if phase.meeting is not None:
        known, allowed = all_finite((q0, v0)), phase.meeting.laws.allow(ts[0], params)
        exists, refused = known & allowed, RESULTS.where(known, RESULTS.element_refused, RESULTS.start_not_finite)
    begins = jnp.asarray(phase.meeting is not None)
    known = jax.tree.map(lambda x: jnp.where(exists & ~begins, x, jnp.nan), (q0, v0))
    start = Snapshot(ts[0], *known, unknown(multipliers))
    zero, least = jnp.asarray(0), jnp.zeros((2, model.n), dtype) if settings.by_size else settings.atol
    stats = {name: zero for name in ("num_steps", "num_accepted_steps", "num_rejected_steps")}
    return PhaseWay(
        t=ts[0], q=q0, v=v0, phase=jnp.clip(first, 0, phases - 1), continues=exists, rows=rows,
        switches=switches, events=nothing(phase.guards, phase.events, q0, v0, start.multipliers), end=start,
        stats=stats, sizes_so_far=sizes_of(q0, v0), least=least,
        scaled_error=jnp.where(exists, jnp.zeros((), dtype), jnp.inf), settled=jnp.asarray(True),
        result=RESULTS.where(exists, RESULTS.successful, refused), modes=modes, begins=begins,
    )  # fmt: skip


def switches_before_any(hybrid: Hybrid, q: PyTree, v: PyTree, laws: Any) -> Switches:
    """The switches of a motion before the first one; `laws`: those of elements, if there are any."""
    room = hybrid.most_switches
    none, (of_q, of_v) = jnp.full(room, NO_PHASE, jnp.int32), unknown((q, v), room)
    return Switches(
        t=jnp.full(room, jnp.nan, jnp.result_type(jax.tree.leaves(of_q)[0])), way=none, to=none, q=of_q, v=of_v,
        q_after=of_q, v_after=of_v, impulse=of_v, count=jnp.asarray(0), uncertain=jnp.asarray(False),
        names=hybrid.names, ways=tuple(s.phase for s in hybrid.switches) if laws is None else laws.names,
        modes=None if laws is None else jnp.zeros((room, laws.size), jnp.int32),
        kinds=() if laws is None else laws.kinds,
    )  # fmt: skip


def _leg(
    hybrid: Hybrid, i: int, in_phase: Array, way: PhaseWay, params: PyTree, ts: Array, phase: Phase, settings: Settings,
    adjoint: Any,
) -> PhaseWay:  # fmt: skip
    """Return the way after one more leg in phase i, for the lanes in `in_phase`."""
    until = phase.until(way.modes, ts, params)
    system, params = hybrid.systems[i], phase.given(params, way.modes)
    ahead, place = outputs_ahead(ts, way.t)
    begins = in_phase & way.begins
    # Lanes in other phases stand still.
    times = jnp.where(in_phase & ~begins, jnp.minimum(ahead, until), way.t)
    settings = settings if system.constraints else replace(settings, drift="none")
    forced = None if phase.meeting is None else phase.meeting.forced
    found = apart(
        solved, system, way.q, way.v, params, times, phase.guards, settings, adjoint, way.sizes_so_far, forced
    )
    result, end, onward, events = found["result"], found["end"], jnp.asarray(False), found["events"]
    result = RESULTS.where(begins, RESULTS.successful, result)
    after, target, switches = After(way.q, way.v, jnp.asarray(False), way.modes), way.phase, way.switches
    rows, known = {name: found[name] for name in ROWS}, (ts > way.t) & (ts <= end.t)
    if phase.meeting is not None:
        laws = phase.meeting.laws
        every = jax.tree.map(lambda x, last: jnp.concatenate([x, last[None]]), (times, *rows.values()), tuple(end))
        acting = jax.vmap(partial(laws.acting, given=params))(*every)
        rows["multipliers"] = rows["multipliers"] | {name: x[:-1] for name, x in acting.items()}
        end = end._replace(multipliers=end.multipliers | {name: x[-1] for name, x in acting.items()})
    instant = in_phase & ~begins & jnp.isfinite(until) & (result == RESULTS.successful)
    if phase.guards is not None and phase.switches or phase.meeting is not None:
        count, terminal = len(phase.switches), () if phase.guards is None else phase.guards.terminal
        crossings = [] if phase.guards is None else [events[kind.name] for kind in phase.guards.kinds]
        when = [jnp.where(jnp.isfinite(x.t[0]), x.t[0], jnp.inf) for x in crossings]
        of_events = [t for t, ends in zip(when[count:], terminal[count:]) if ends]
        when = [*when[:count], *[jnp.where(instant, until, jnp.inf)] * phase.has_instants]
        uncertain = in_phase & reduce(jnp.logical_or, (x.uncertain for x in crossings[:count]), jnp.asarray(False))
        never = jnp.asarray(jnp.inf, ts.dtype)
        times_of = jnp.stack(when or [never]), jnp.stack([*of_events, never])
        ending = apart(
            _ending, phase, result, end, times_of, in_phase, instant, way, params, resolution(ts), settings.rtol
        )  # fmt: skip
        result, end, onward = ending.result, ending.end, ending.onward
        after, target, new = apart(_switched, system, ending, params, phase, way.sizes_so_far, instant, begins)
        switches = _recorded(way.switches, onward & ~begins, new, together=len(hybrid.systems) == 1)
        switches = eqx.tree_at(lambda s: s.uncertain, switches, switches.uncertain | uncertain)
        # A motion in the wrong phase is wrong from that phase's start on, its first output included.
        invalid = in_phase & ((result == RESULTS.guard_not_seen) | (result == RESULTS.guard_below_zero))
        end = where(invalid, Snapshot(way.t, way.q, way.v, unknown(end.multipliers)), end)
        events = {name: x.none_where(invalid) for name, x in events.items()}
        if after.found is not None:
            result = RESULTS.where(onward, _obeyed(after, result), result)
            onward = onward & after.found & after.presses & after.allowed
        broken = (onward | begins) & ~all_finite((after.q, after.v))
        why = RESULTS.where(begins, RESULTS.start_not_finite, RESULTS.reset_not_finite)
        result, onward = RESULTS.where(broken, why, result), onward & ~broken
    rows = jax.tree.map(lambda x: x[place], rows)
    known = (known | (way.switches.count == 0) & (ts <= way.t)) & ~begins
    of_modes = None if way.modes is None else way.modes.modes[None]
    if phase.has_instants:
        assert phase.meeting is not None and after.modes is not None
        # Outputs at instants have the new values.
        new = instant & onward & (ts == until)
        of_modes = jnp.where(phase.meeting.laws.is_sampled[None] & new[:, None], after.modes.modes[None], of_modes)
        rows["q"] = jax.tree.map(lambda x, y: jnp.where(like(new, x), y[None], x), rows["q"], after.q)
    known = known & (result != RESULTS.guard_below_zero) & reached(rows["q"])
    end = end._replace(multipliers=unknown(way.end.multipliers) | end.multipliers)
    # Nothing is known from a leg of no length, but for the modes and velocities that fit the start.
    sizes = jnp.where(begins, sizes_of(after.q, after.v), jnp.maximum(way.sizes_so_far, sizes_of(end.q, end.v)))
    end = where(onward, end._replace(q=after.q, v=after.v), where(begins, way.end, end))
    least = way.least if not settings.by_size else jnp.maximum(way.least, stop_gradient(found["tolerance"][1]))
    error = jnp.maximum(way.scaled_error, found["scaled_error"])
    stats = {name: n + found["stats"][name] for name, n in way.stats.items()}
    least, error, stats = where(begins, (way.least, way.scaled_error, way.stats), (least, error, stats))
    further = PhaseWay(
        t=jnp.where(onward, end.t, way.t), q=where(onward, after.q, way.q), v=where(onward, after.v, way.v),
        phase=jnp.where(onward, target, way.phase), continues=onward & (end.t < ts[-1]),
        rows=_filled(way.rows, in_phase & known, rows, i, of_modes), switches=switches,
        events=with_those_of(events, way.events), end=end, stats=stats, sizes_so_far=sizes, least=least,
        scaled_error=jnp.where(ended_well(result), error, jnp.inf),
        settled=way.settled & (found["settled"] | begins), result=result,
        modes=where(onward, after.modes, way.modes), begins=way.begins & ~begins,
    )  # fmt: skip
    # Outputs and switches are those of before in the other lanes.
    return where(in_phase, further, way)._replace(rows=further.rows, switches=further.switches)


def _obeyed(met: Any, otherwise: Any):
    """The result of a meeting, of `Met` or `After`, in which a law is broken; `otherwise` if none is."""
    result = RESULTS.where(met.found, otherwise, RESULTS.no_contact_forces)
    result = RESULTS.where(met.presses, result, RESULTS.normal_below_zero)
    return RESULTS.where(met.allowed, result, RESULTS.element_refused)


class PhaseEnding(NamedTuple):
    """How a leg ends: `onward`: whether another one follows; `first`: by which of the phase's switches; the result."""

    onward: Bool[Array, ""]
    first: Int[Array, ""]
    end: Snapshot
    result: Any


def _ending(
    phase: Phase, result, end: Snapshot, times: tuple[Array, Array], in_phase: Array, instant: Array, way: PhaseWay,
    params: PyTree, resolution: Array, rtol: Array,
) -> PhaseEnding:  # fmt: skip
    """Find out what ends a leg; `times`: those at which its guards, and events that end the motion, cross, infinite for
    those that do not; `instant`: whether it ends at one of a sampled control."""
    at_one_time, at_start = AT_ONCE * resolution, way.switches.count == 0
    # An event that ends the motion at the time of a switch comes first.
    when, of_events = times
    by_event = jnp.any(of_events <= jnp.min(when) + at_one_time)
    begins = in_phase & way.begins
    switched = in_phase & ((result == RESULTS.event_occurred) & ~by_event | instant | begins)
    at_once = switched & (end.t - way.t <= at_one_time)
    # A switch at once happens where the leg begins, so that its time has the derivatives of that.
    t, q, v = where(at_once, (way.t, way.q, way.v), (end.t, end.q, end.v))
    end = Snapshot(t, q, v, end.multipliers)
    below = is_below(end, params, phase.guards, len(phase.switches), rtol)
    refused, full = at_once & at_start & below, way.switches.count >= way.switches.t.shape[0]
    missed = (result == RESULTS.successful) & below & ~begins
    onward = begins | switched & ~refused & ~full & ~missed
    failed = RESULTS.where(refused, RESULTS.guard_below_zero, RESULTS.too_many_switches)
    result = RESULTS.where(missed, RESULTS.guard_not_seen, RESULTS.where(switched, failed, result))
    result = RESULTS.where(onward, RESULTS.successful, result)
    first = jnp.argmax(when <= jnp.min(when) + at_one_time)
    return PhaseEnding(onward, first, end, result)


def is_below(end: Snapshot, params: PyTree, guards: Guards | None, count: int, rtol: Array):
    """Whether one of the first `count` guards is below zero by more than errors can cause."""
    if guards is None or not count:
        return jnp.asarray(False)
    state = stop_gradient(tuple(end))
    g, terms = jax.jvp(lambda *state: jnp.stack(guards(*state, stop_gradient(params))[:count]), state, uneven(state))
    return jnp.any(g < -NOT_BELOW * rtol[0] * jnp.abs(terms))


def reached(q: PyTree):
    """The rows of q that are known."""
    return jnp.isfinite(jax.vmap(lambda q: jnp.sum(coordinates.flatten(q)[0]))(q))


def _filled(rows: OutputRows, known: Array, found, i: int, modes: Array | None) -> OutputRows:
    """Return the outputs, with those of a leg in phase i where they are `known`."""

    def put(all, new):
        return jax.tree.map(lambda x, y: jnp.where(like(known, x), y.astype(x.dtype), x), all, new)

    multipliers = {name: put(x, found["multipliers"].get(name, x)) for name, x in rows.multipliers.items()}
    of_modes = None if modes is None else put(rows.modes, modes)
    phase = jnp.where(known, i, rows.phase)
    return OutputRows(put(rows.q, found["q"]), put(rows.v, found["v"]), multipliers, phase, of_modes)


class After(NamedTuple):
    """The state after a switch; with elements, their modes, and whether there are any."""

    q: PyTree
    v: PyTree
    rests: Bool[Array, ""]
    modes: Modes | None = None
    found: Bool[Array, ""] | None = None
    presses: Bool[Array, ""] | None = None
    allowed: Bool[Array, ""] | None = None


def _switched(
    system: System, ending: PhaseEnding, params: PyTree, phase: Phase, sizes_so_far: Array, instant: Array,
    begins: Array,
):  # fmt: skip
    """Return the state after the phase's first switch, the next phase, and the fields of that switch."""
    _, first, end, _ = ending
    if phase.meeting is None:
        number = jnp.asarray(phase.switches, jnp.int32)[first]
        states = [After(*reset(end.t, end.q, end.v, end.multipliers, params)) for reset in phase.resets]
        after = jax.tree.map(lambda *x: _one_of(first, x), *states)
    else:
        sizes = jnp.maximum(sizes_so_far, sizes_of(end.q, end.v))
        q, met, number = phase.meeting(end, params, sizes, instant, begins)
        first = jnp.zeros_like(first)
        after = After(q, met.v, jnp.asarray(False), Modes(met.modes, met.slack), met.found, met.presses, met.allowed)
    momentum = partial(jax.grad(system.lagrangian, argnums=2), end.t)
    impulse = jax.tree.map(jnp.subtract, momentum(after.q, after.v, params), momentum(end.q, end.v, params))
    to = jnp.asarray(phase.targets)[first, after.rests.astype(int)]
    new = {"t": end.t, "way": number, "to": to, "q": end.q, "v": end.v, "q_after": after.q, "v_after": after.v}
    new |= {"impulse": impulse, "modes": None if after.modes is None else after.modes.modes}
    return after, to, new


def _recorded(switches: Switches, onward: Array, new: dict[str, Any], together: bool) -> Switches:
    """The record with a switch more, where the motion goes `onward`.

    In a batch lanes that go on have the same number of switches, if they are `together`: then one row is written.
    """
    room = switches.t.shape[0]
    last = eqxi.unvmap_max(jnp.where(onward, switches.count, 0))
    place = onward & (jnp.arange(room) == switches.count)

    def put(all, new):
        new = new.astype(all.dtype)
        if together:
            return all.at[last].set(jnp.where(onward, new, all[last]))
        return jnp.where(like(place, all), new[None], all)

    fields = {name: jax.tree.map(put, getattr(switches, name), x) for name, x in new.items()}
    return replace(switches, count=switches.count + onward, **fields)


def sizes_of(q: PyTree, v: PyTree):
    """The sizes of coordinates and velocities, (2, n)."""
    return jnp.abs(jnp.stack([stop_gradient(coordinates.flatten(y)[0]) for y in (q, v)]))


def _one_of(first: Array, values):
    found = values[0]
    for i, x in enumerate(values[1:], 1):
        found = jnp.where(first == i, x, found)
    return found
