"""Phases of a hybrid, and the modes of elements, as locations of an automaton (`legs.py`).

A guard is assumed to be above zero where its phase begins. If it is zero there and falls, however slowly, or is below
zero, it is crossed at once, in a leg of no length: this handles two guards at one time, and friction that cannot hold a
contact that has stopped sliding.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial, reduce
from typing import Any, NamedTuple

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.events.event import Guards
from lagjax.integrate.jumps.find import Jumps
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.legs import (
    Ending,
    Leg,
    Location,
    Then,
    Way,
    before_any,
    ending_of,
    nothing,
    sizes_of,
    times_of,
    unknown,
)
from lagjax.integrate.solve.one_motion import resolution
from lagjax.integrate.solve.over_jumps import over_jumps
from lagjax.integrate.trajectory.hybrid_trajectory import SWITCHES, Switches
from lagjax.integrate.trajectory.parts import NO_PHASE, Snapshot
from lagjax.integrate.trajectory.results import RESULTS
from lagjax.jaxtools import apart, like, where
from lagjax.mechanics import all_finite
from lagjax.system import Hybrid, System, model_of


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

    def given(self, params: PyTree, modes: "Modes | None") -> PyTree:
        """What the functions of the phase take as `params`."""
        return params if modes is None else self.meeting.laws.given(params, *modes)


class PhaseMode(NamedTuple):
    """The phase, and the modes of elements, if there are any."""

    phase: Int[Array, ""]
    of_elements: "Modes | None"


class Modes(NamedTuple):
    """The modes of elements, and how far below zero round-off may take their guards."""

    modes: Int[Array, " k"]
    slack: Float[Array, " k"]


class InPhase(Location):
    """Phase number `i` of a hybrid, with what ends it, in a motion over `ts`.

    `in_step`: whether all lanes of a batch that go on have the same number of switches.
    """

    def __init__(
        self, hybrid: Hybrid, i: int, phase: Phase, params: PyTree, ts: Array, settings: Settings, in_step: bool
    ):
        self.i, self.phase, self.params, self.ts, self.settings, self.in_step = i, phase, params, ts, settings, in_step
        self.system, self.guards = hybrid.systems[i], phase.guards
        self.forced = None if phase.meeting is None else phase.meeting.forced

    def has(self, mode: PhaseMode) -> Bool[Array, ""]:
        return mode.phase == self.i

    def given(self, params: PyTree, way: Way) -> PyTree:
        return self.phase.given(params, way.mode.of_elements)

    def next_instant(self, mode: PhaseMode) -> Float[Array, ""]:
        """That of sampled controls; infinite without."""
        if mode.of_elements is None:
            return jnp.asarray(jnp.inf, self.ts.dtype)
        return self.phase.meeting.laws.next_instant(mode.of_elements.modes, self.ts, self.params)

    def until(self, ahead: Float[Array, " T"], way: Way) -> Float[Array, " T"]:
        return jnp.minimum(ahead, self.next_instant(way.mode))

    def then(self, leg: Leg) -> Then:
        """What follows a leg: a switch, of phases or of the modes of elements; or the motion's end."""
        phase, way, here, given, ts = self.phase, leg.way, leg.here, leg.given, self.ts
        end, rows, until = leg.end, leg.rows, self.next_instant(way.mode)
        result, events = RESULTS.where(leg.begins, RESULTS.successful, leg.result), leg.events
        no, target, record = jnp.asarray(False), way.mode.phase, way.record
        onward, after = no, After(way.q, way.v, no, way.mode.of_elements)
        if phase.meeting is not None:
            every = jax.tree.map(
                lambda x, last: jnp.concatenate([x, last[None]]), (leg.times, *rows.values()), tuple(end)
            )
            acting = jax.vmap(partial(phase.meeting.laws.acting, given=given))(*every)
            rows = rows | {"multipliers": rows["multipliers"] | {name: x[:-1] for name, x in acting.items()}}
            end = end._replace(multipliers=end.multipliers | {name: x[-1] for name, x in acting.items()})
        instant = here & ~leg.begins & (leg.times[-1] == until) & (result == RESULTS.successful)
        if phase.guards is not None and phase.switches or phase.meeting is not None:
            count = len(phase.switches)
            when, of_events = times_of(phase.guards, events, count, ts.dtype)
            when = jnp.stack([*when, jnp.where(instant, until, jnp.inf)])
            kinds = () if phase.guards is None else phase.guards.kinds[:count]
            uncertain = here & reduce(jnp.logical_or, (events[x.name].uncertain for x in kinds), jnp.asarray(False))
            leg = leg._replace(result=result, end=end)
            ending = apart(
                ending_of, phase.guards, count, leg, when, of_events, instant | leg.begins, resolution(ts),
                self.settings.rtol,
            )  # fmt: skip
            switched, end, below = here & ending.by_guard, ending.end, ending.below & ~leg.begins
            refused, full = ending.at_once & (way.count == 0) & below, way.count >= way.record.t.shape[0]
            missed = (result == RESULTS.successful) & below
            onward = leg.begins | switched & ~refused & ~full & ~missed
            failed = RESULTS.where(refused, RESULTS.guard_below_zero, RESULTS.too_many_switches)
            result = RESULTS.where(missed, RESULTS.guard_not_seen, RESULTS.where(switched, failed, result))
            result = RESULTS.where(onward, RESULTS.successful, result)
            after, target, new = apart(
                _switched, self.system, ending, given, phase, way.sizes_so_far, instant, leg.begins
            )
            record = _recorded(way.record, way.count, onward & ~leg.begins, new, self.in_step)
            record = eqx.tree_at(lambda s: s.uncertain, record, record.uncertain | uncertain)
            # A motion in the wrong phase is wrong from that phase's start on, its first output included.
            invalid = here & ((result == RESULTS.guard_not_seen) | (result == RESULTS.guard_below_zero))
            end = where(invalid, Snapshot(way.t, way.q, way.v, unknown(end.multipliers)), end)
            events = {name: x.none_where(invalid) for name, x in events.items()}
            rows = rows | {"q": where(invalid, unknown(rows["q"]), rows["q"])}
            if after.found is not None:
                result = RESULTS.where(onward, _obeyed(after, result), result)
                onward = onward & after.found & after.presses & after.allowed
            broken = (onward | leg.begins) & ~all_finite((after.q, after.v))
            why = RESULTS.where(leg.begins, RESULTS.start_not_finite, RESULTS.reset_not_finite)
            result, onward = RESULTS.where(broken, why, result), onward & ~broken
        rows = rows | {"phase": jnp.full(ts.shape, self.i, jnp.int32), "modes": None}
        if way.mode.of_elements is not None:
            assert phase.meeting is not None and after.modes is not None
            modes = jnp.broadcast_to(way.mode.of_elements.modes[None], (ts.size, phase.meeting.laws.size))
            if phase.has_instants:
                # Outputs at instants have the new values.
                new = instant & onward & (leg.times == until)
                modes = jnp.where(phase.meeting.laws.is_sampled[None] & new[:, None], after.modes.modes[None], modes)
                rows["q"] = jax.tree.map(lambda x, y: jnp.where(like(new, x), y[None], x), rows["q"], after.q)
            rows["modes"] = modes
        mode = where(onward, PhaseMode(target, after.modes), way.mode)
        end = end._replace(multipliers=unknown(way.end.multipliers) | end.multipliers)
        at_first = way.count == 0
        return Then(onward, onward, False, end, after.q, after.v, mode, record, result, events, rows, at_first)


def solved_in_phases(
    jumps: Sequence[Jumps | None], hybrid: Hybrid, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, phases,
    settings: Settings, adjoint: Any,
):  # fmt: skip
    """Return the fields of the trajectory, like `one_motion.solved`, with the phase of each output and the switches.

    `jumps`: those of each phase's forces.
    """
    phases = [phase.in_motion(settings.rtol[0], ts, q0, v0, params) for phase in phases]
    first = _first(hybrid, q0, v0, params, ts, phases[0], settings)
    # A lane may have a jump while another has a switch.
    in_step = len(phases) == 1 and not any(jumps)
    locations = [InPhase(hybrid, i, phase, params, ts, settings, in_step) for i, phase in enumerate(phases)]

    def of_location(location: Location) -> Settings:
        return settings if location.system.constraints else replace(settings, drift="none")

    # Each turn takes every lane at least one leg further.
    most = hybrid.most_switches
    turns = most + 1 + any(phase.meeting is not None for phase in phases)
    way, stats = over_jumps(jumps, locations, first, params, ts, of_location, settings, adjoint, most, turns)
    found, switches = way.fields(settings), way.record
    events = found["events"] | ({SWITCHES: switches.as_crossings()} if switches.ways else {})
    return found | {"events": events, "switches": switches, "stats": stats}


def _first(hybrid: Hybrid, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, phase: Phase, settings: Settings) -> Way:
    """The way before the first leg; with elements all gaps are open, until a leg of no length has found their modes."""
    multipliers = reduce(
        lambda all, of: all | of, (x.zero_multipliers() for x in model_of(hybrid, ts[0], q0, v0, params).phases)
    )
    modes, meeting, many = None, phase.meeting, ts.shape[0]
    if meeting is not None:
        given = meeting.laws.at_first(ts[0], params)
        modes = Modes(given.modes, given.slack)
        acting = jax.eval_shape(meeting.laws.acting, ts[0], q0, v0, multipliers, given)
        multipliers = multipliers | jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), acting)
    rows = dict(zip(("q", "v", "multipliers"), unknown((q0, v0, multipliers), many)))
    rows["phase"] = jnp.full(many, NO_PHASE, jnp.int32)
    rows["modes"] = None if modes is None else jnp.zeros((many, modes.modes.size), jnp.int32)
    # A motion in no phase would never end.
    first, phases = jnp.asarray(hybrid.first, jnp.int32), len(hybrid.systems)
    exists, refused = (first >= 0) & (first < phases), RESULTS.no_such_phase
    if meeting is not None:
        known, allowed = all_finite((q0, v0)), meeting.laws.allow(ts[0], params)
        exists, refused = known & allowed, RESULTS.where(known, RESULTS.element_refused, RESULTS.start_not_finite)
    known = jax.tree.map(lambda x: jnp.where(exists & (meeting is None), x, jnp.nan), (q0, v0))
    start, end = (Snapshot(ts[0], *y, unknown(multipliers)) for y in ((q0, v0), known))
    events = nothing(phase.guards, phase.events, q0, v0, start.multipliers)
    switches = switches_before_any(hybrid, q0, v0, None if meeting is None else meeting.laws)
    mode = PhaseMode(jnp.clip(first, 0, phases - 1), modes)
    way = before_any(start, end, mode, sizes_of(q0, v0), settings, rows, events, switches, begins=meeting is not None)
    error = jnp.where(exists, way.scaled_error, jnp.inf)
    return way._replace(continues=exists, scaled_error=error, result=RESULTS.where(exists, RESULTS.successful, refused))


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


def _obeyed(met: Any, otherwise: Any):
    """The result of a meeting, of `Met` or `After`, in which a law is broken; `otherwise` if none is."""
    result = RESULTS.where(met.found, otherwise, RESULTS.no_contact_forces)
    result = RESULTS.where(met.presses, result, RESULTS.normal_below_zero)
    return RESULTS.where(met.allowed, result, RESULTS.element_refused)


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
    system: System, ending: Ending, params: PyTree, phase: Phase, sizes_so_far: Array, instant: Array,
    begins: Array,
):  # fmt: skip
    """Return the state after the phase's first switch, the next phase, and the fields of that switch."""
    first, end = ending.first, ending.end
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


def _recorded(switches: Switches, count: Array, onward: Array, new: dict[str, Any], in_step: bool) -> Switches:
    """The record with a switch more, where the motion goes `onward`.

    Where all lanes of a batch that go on are `in_step`, with the same number of switches, one row is written.
    """
    room = switches.t.shape[0]
    last = eqxi.unvmap_max(jnp.where(onward, count, 0))
    place = onward & (jnp.arange(room) == count)

    def put(all, new):
        new = new.astype(all.dtype)
        if in_step:
            return all.at[last].set(jnp.where(onward, new, all[last]))
        return jnp.where(like(place, all), new[None], all)

    fields = {name: jax.tree.map(put, getattr(switches, name), x) for name, x in new.items()}
    return replace(switches, count=count + onward, **fields)


def _one_of(first: Array, values):
    found = values[0]
    for i, x in enumerate(values[1:], 1):
        found = jnp.where(first == i, x, found)
    return found
