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
from lagjax.integrate.jumps import Jumps
from lagjax.integrate.results import NO_PHASE, RESULTS, Snapshot
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
    over_jumps,
    sizes_of,
    times_of,
    unknown,
)
from lagjax.integrate.solve.one_motion import resolution
from lagjax.integrate.trajectory import OF_PHASES, SWITCHES, Switches
from lagjax.jaxtools import apart, like, where
from lagjax.mechanics import all_finite
from lagjax.system import Hybrid, System, model_of


class Phase(NamedTuple):
    """What ends one phase: its guards, in the order of the switches, and what each of them does to the state.

    `switches` (k,): their numbers in the hybrid; `targets` (k, 2): the next phase, and that of rest; `resets`:
    `reset(t, q, v, multipliers, params)` -> (q, v), and whether the motion comes to rest there; `events`: the names of
    the recorded events, whose guards come last. `meeting`: of the elements of the phase, which changes their modes
    (`meeting.py`); these have their `places` among the modes of all phases, and one guard, after those of
    switches.
    """

    guards: Guards | None
    switches: tuple[int, ...]
    targets: np.ndarray
    resets: tuple
    events: tuple[str, ...]
    meeting: Any = None
    places: tuple[int, int] = (0, 0)

    @property
    def ends(self) -> int:
        """How many guards end a leg of the phase."""
        return len(self.switches) + (self.meeting is not None and self.meeting.laws.guarded > 0)

    @property
    def has_instants(self) -> bool:
        """Whether legs end at instants of sampled controls, too."""
        return self.meeting is not None and bool(self.meeting.laws.sampled)

    def in_motion(self, *motion: Any) -> "Phase":
        """The same in a motion of this tolerance, over these times from this start (`Meeting.in_motion`)."""
        return self if self.meeting is None else self._replace(meeting=self.meeting.in_motion(*motion))

    def given(self, params: PyTree, modes: "Modes | None") -> PyTree:
        """What the functions of the phase take as `params`."""
        return params if modes is None or self.meeting is None else self.meeting.laws.given(params, *modes.at(self))


class PhaseMode(NamedTuple):
    """The phase, and the modes of elements, if there are any."""

    phase: Int[Array, ""]
    of_elements: "Modes | None"


class Modes(NamedTuple):
    """The modes of the elements of all phases, `NO_PHASE` in those of others than the present one, and how far below
    zero round-off may take their guards."""

    modes: Int[Array, " k"]
    slack: Float[Array, " k"]

    def at(self, phase: Phase) -> "Modes":
        """Those of a phase."""
        return Modes(*(x[slice(*phase.places)] for x in self))

    def put(self, phase: Phase, here: Any) -> "Modes":
        """These in a phase, `here`, and none elsewhere."""
        if phase.places == (0, self.modes.size):
            return Modes(here.modes, here.slack)
        of_phase = slice(*phase.places)
        modes, slack = jnp.full_like(self.modes, NO_PHASE), jnp.zeros_like(self.slack)
        return Modes(modes.at[of_phase].set(here.modes), slack.at[of_phase].set(here.slack))


class InPhase(Location):
    """Phase number `i` of all `phases`, with what ends it, in a motion over `ts`; `ways`: how many switches there are.

    `in_step`: whether all lanes of a batch that go on have the same number of switches.
    """

    def __init__(
        self, hybrid: Hybrid, i: int, phases: Sequence[Phase], params: PyTree, ts: Array, settings: Settings,
        in_step: bool,
    ):  # fmt: skip
        self.i, self.phase, self.phases, self.ways = i, phases[i], tuple(phases), len(hybrid.switches)
        self.params, self.ts, self.settings, self.in_step = params, ts, settings, in_step
        self.system, self.guards = hybrid.systems[i], self.phase.guards

    def has(self, mode: PhaseMode) -> Bool[Array, ""]:
        return mode.phase == self.i

    def given(self, params: PyTree, way: Way) -> PyTree:
        return self.phase.given(params, way.mode.of_elements)

    def next_instant(self, mode: PhaseMode) -> Float[Array, ""]:
        """That of sampled controls; infinite without."""
        if self.phase.meeting is None or mode.of_elements is None:
            return jnp.asarray(jnp.inf, self.ts.dtype)
        return self.phase.meeting.laws.next_instant(mode.of_elements.at(self.phase).modes, self.ts, self.params)

    def until(self, ahead: Float[Array, " T"], way: Way) -> Float[Array, " T"]:
        return jnp.minimum(ahead, self.next_instant(way.mode))

    def then(self, leg: Leg) -> Then:
        """What follows a leg: a switch, of phases or of the modes of elements; or the motion's end."""
        phase, way, here, ts, mode = self.phase, leg.way, leg.here, self.ts, leg.way.mode
        leg = self._with_forces(leg)
        end, rows, until = leg.end, leg.rows, self.next_instant(mode)
        result, events = RESULTS.where(leg.begins, RESULTS.successful, leg.result), leg.events
        instant = here & ~leg.begins & (leg.times[-1] == until) & (result == RESULTS.successful)
        no, record = jnp.asarray(False), way.record
        onward, after = no, After(way.q, way.v, mode.phase, jnp.asarray(NO_PHASE, jnp.int32), no, mode.of_elements)
        if phase.ends or phase.meeting is not None:
            when, of_events = times_of(phase.guards, events, phase.ends, ts.dtype)
            when = jnp.stack([*when, jnp.where(instant, until, jnp.inf)])
            kinds = () if phase.guards is None else phase.guards.kinds[: phase.ends]
            uncertain = here & reduce(jnp.logical_or, (events[x.name].uncertain for x in kinds), jnp.asarray(False))
            ending = apart(
                ending_of, phase.guards, phase.ends, leg._replace(result=result), when, of_events,
                instant | leg.begins, resolution(ts), self.settings.rtol,
            )  # fmt: skip
            switched, end, below = here & ending.by_guard, ending.end, ending.below & ~leg.begins
            refused, full = ending.at_once & (way.count == 0) & below, way.count >= way.record.t.shape[0]
            missed = (result == RESULTS.successful) & below
            onward = leg.begins | switched & ~refused & ~full & ~missed
            failed = RESULTS.where(refused, RESULTS.guard_below_zero, RESULTS.too_many_switches)
            result = RESULTS.where(missed, RESULTS.guard_not_seen, RESULTS.where(switched, failed, result))
            result = RESULTS.where(onward, RESULTS.successful, result)
            after, impulse = apart(
                _after_end, self.system, ending, leg.given, self.phases, self.i, self.ways, mode.of_elements,
                way.sizes_so_far, instant, leg.begins,
            )  # fmt: skip
            record = _recorded(way, onward, leg.begins, end, after, impulse, self.in_step)
            record = eqx.tree_at(lambda s: s.uncertain, record, record.uncertain | uncertain)
            # A motion in the wrong phase is wrong from that phase's start on, its first output included.
            invalid = here & ((result == RESULTS.guard_not_seen) | (result == RESULTS.guard_below_zero))
            end = where(invalid, Snapshot(way.t, way.q, way.v, unknown(end.multipliers)), end)
            events = {name: x.none_where(invalid) for name, x in events.items()}
            rows = rows | {"q": where(invalid, unknown(rows["q"]), rows["q"])}
            if phase.meeting is not None:
                result = RESULTS.where(onward, _obeyed(after, result), result)
                onward = onward & after.found & after.presses & after.allowed
            broken = (onward | leg.begins) & ~all_finite((after.q, after.v))
            why = RESULTS.where(leg.begins, RESULTS.start_not_finite, RESULTS.reset_not_finite)
            result, onward = RESULTS.where(broken, why, result), onward & ~broken
        rows = rows | {"phase": jnp.full(ts.shape, self.i, jnp.int32), "modes": None}
        if mode.of_elements is not None:
            assert after.modes is not None
            modes = jnp.broadcast_to(mode.of_elements.modes[None], (ts.size, mode.of_elements.modes.size))
            if phase.meeting is not None and phase.has_instants:
                # Outputs at instants have the new values.
                new, sampled = instant & onward & (leg.times == until), np.zeros(modes.shape[1], bool)
                sampled[slice(*phase.places)] = phase.meeting.laws.is_sampled
                modes = jnp.where(sampled[None] & new[:, None], after.modes.modes[None], modes)
                rows["q"] = jax.tree.map(lambda x, y: jnp.where(like(new, x), y[None], x), rows["q"], after.q)
            rows["modes"] = modes
        mode = where(onward, PhaseMode(after.to, after.modes), mode)
        end = end._replace(multipliers=unknown(way.end.multipliers) | end.multipliers)
        at_first, begins = way.count == 0, onward & after.begins
        return Then(
            onward, onward, False, end, after.q, after.v, mode, record, result, events, rows, at_first, begins
        )  # fmt: skip

    def _with_forces(self, leg: Leg) -> Leg:
        """The leg with the forces of elements among its multipliers."""
        if self.phase.meeting is None:
            return leg
        laws, of_rows = self.phase.meeting.laws, leg.rows["multipliers"]
        every = jax.tree.map(
            lambda x, last: jnp.concatenate([x, last[None]]), (leg.times, *leg.rows.values()), tuple(leg.end)
        )
        acting = jax.vmap(partial(laws.acting, given=leg.given))(*every)
        rows = leg.rows | {"multipliers": of_rows | {name: x[:-1] for name, x in acting.items()}}
        of_end = leg.end.multipliers | {name: x[-1] for name, x in acting.items()}
        return leg._replace(rows=rows, end=leg.end._replace(multipliers=of_end))


def solved_in_phases(
    jumps: Sequence[Jumps | None], hybrid: Hybrid, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, phases,
    settings: Settings, adjoint: Any,
):  # fmt: skip
    """Return the fields of the trajectory, like `one_motion.solved`, with the phase of each output and the switches.

    `jumps`: those of each phase's forces.
    """
    phases = [phase.in_motion(settings.rtol[0], ts, q0, v0, params) for phase in phases]
    first = _first(hybrid, q0, v0, params, ts, phases, settings)
    # A lane may have a jump while another has a switch.
    in_step = len(phases) == 1 and not any(jumps)
    locations = [InPhase(hybrid, i, phases, params, ts, settings, in_step) for i in range(len(phases))]

    def of_location(location: Any) -> Settings:
        drift = settings.drift if location.system.constraints else "none"
        meeting = location.phase.meeting
        return replace(settings, drift=drift, forced=None if meeting is None else meeting.forced)

    # Each turn takes every lane at least one leg further; where elements are entered, one of no length comes first.
    most = hybrid.most_switches
    turns = most + 1 + any(phase.meeting is not None for phase in phases) * (1 if len(phases) == 1 else most + 1)
    way, stats = over_jumps(jumps, locations, first, params, ts, of_location, settings, adjoint, most, turns)
    found, switches = way.fields(settings), way.record
    events = found["events"] | ({SWITCHES: switches.as_crossings()} if switches.ways else {})
    return found | {"events": events, "switches": switches, "stats": stats}


def _first(
    hybrid: Hybrid, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, phases: Sequence[Phase], settings: Settings
) -> Way:
    """The way before the first leg; with elements all gaps are open, until a leg of no length has found their modes."""
    multipliers = reduce(
        lambda all, of: all | of, (x.zero_multipliers() for x in model_of(hybrid, ts[0], q0, v0, params).phases)
    )
    many, modes, exists, begins = ts.shape[0], None, jnp.asarray(True), jnp.asarray(False)
    # A motion in no phase would never end.
    first, refused = jnp.asarray(hybrid.first, jnp.int32), RESULTS.no_such_phase
    exists, phase = (first >= 0) & (first < len(phases)), jnp.clip(first, 0, len(phases) - 1)
    for of in phases:
        if of.meeting is None:
            continue
        laws, given = of.meeting.laws, of.meeting.laws.at_first(ts[0], params)
        acting = jax.eval_shape(laws.acting, ts[0], q0, v0, multipliers, given)
        multipliers = multipliers | jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), acting)
        allowed = laws.allow(ts[0], params)
        exists, refused = exists & allowed, RESULTS.where(allowed, refused, RESULTS.element_refused)
    if any(of.meeting is not None for of in phases):
        size = max(of.places[1] for of in phases)
        none = Modes(jnp.zeros(size, jnp.asarray(0).dtype), jnp.zeros(size, ts.dtype))
        begins, modes = _entered(phases, phase, none, ts[0], params)
        known = all_finite((q0, v0))
        exists, refused = exists & known, RESULTS.where(known, refused, RESULTS.start_not_finite)
    rows = dict(zip(("q", "v", "multipliers"), unknown((q0, v0, multipliers), many)))
    rows["phase"] = jnp.full(many, NO_PHASE, jnp.int32)
    rows["modes"] = None if modes is None else jnp.zeros((many, modes.modes.size), jnp.int32)
    known = jax.tree.map(lambda x: jnp.where(exists & ~begins, x, jnp.nan), (q0, v0))
    start, end = (Snapshot(ts[0], *y, unknown(multipliers)) for y in ((q0, v0), known))
    events = nothing(phases[0].guards, phases[0].events, q0, v0, start.multipliers)
    switches = switches_before_any(hybrid, q0, v0)
    mode = PhaseMode(phase, modes)
    way = before_any(start, end, mode, sizes_of(q0, v0), settings, rows, events, switches, begins)
    error = jnp.where(exists, way.scaled_error, jnp.inf)
    return way._replace(continues=exists, scaled_error=error, result=RESULTS.where(exists, RESULTS.successful, refused))


def switches_before_any(hybrid: Hybrid, q: PyTree, v: PyTree) -> Switches:
    """The switches of a motion before the first one."""
    room, modes = hybrid.most_switches, hybrid.modes
    none, (of_q, of_v) = jnp.full(room, NO_PHASE, jnp.int32), unknown((q, v), room)
    ways = [(switch.phase, OF_PHASES) for switch in hybrid.switches] + modes
    return Switches(
        t=jnp.full(room, jnp.nan, jnp.result_type(jax.tree.leaves(of_q)[0])), way=none, to=none, q=of_q, v=of_v,
        q_after=of_q, v_after=of_v, impulse=of_v, count=jnp.asarray(0), uncertain=jnp.asarray(False),
        names=hybrid.names, ways=tuple(name for name, _ in ways),
        modes=jnp.zeros((room, len(modes)), jnp.int32) if modes else None,
        kinds=tuple(kind for _, kind in ways) if modes else (),
    )  # fmt: skip


def _obeyed(met: "After", otherwise: Any):
    """The result of a meeting in which a law is broken; `otherwise` if none is."""
    result = RESULTS.where(met.found, otherwise, RESULTS.no_contact_forces)
    result = RESULTS.where(met.presses, result, RESULTS.normal_below_zero)
    return RESULTS.where(met.allowed, result, RESULTS.element_refused)


class After(NamedTuple):
    """The state after the end of a leg; the phase `to` which it leads, and whether the modes of the elements there are
    still to be found; which of all `ways` out of phases and modes it was; with elements their modes, and whether there
    are any that obey the laws."""

    q: PyTree
    v: PyTree
    to: Int[Array, ""]
    way: Int[Array, ""]
    begins: Bool[Array, ""]
    modes: Modes | None
    found: Bool[Array, ""] | bool = True
    presses: Bool[Array, ""] | bool = True
    allowed: Bool[Array, ""] | bool = True


def _after_end(
    system: System, ending: Ending, given: PyTree, phases: Sequence[Phase], i: int, ways: int, modes: Modes | None,
    sizes_so_far: Array, instant: Array, begins: Array,
) -> tuple[After, PyTree]:  # fmt: skip
    """What follows the end of a leg in phase `i`, and the impulse: by its first switch, or a meeting of elements."""
    phase, first, end, found = phases[i], ending.first, ending.end, []
    if phase.switches:
        params = given if phase.meeting is None else given.params
        states = [reset(end.t, end.q, end.v, end.multipliers, params) for reset in phase.resets]
        q, v, rests = jax.tree.map(lambda *x: _one_of(first, x), *states)
        to = jnp.asarray(phase.targets)[first, rests.astype(int)]
        entered = _entered(phases, to, modes, end.t, params)
        found.append(After(q, v, to, jnp.asarray(phase.switches, jnp.int32)[first], *entered))
    if phase.meeting is not None:
        assert modes is not None
        sizes = jnp.maximum(sizes_so_far, sizes_of(end.q, end.v))
        q, met, number = phase.meeting(end, given, sizes, instant, begins)
        way, here = ways + phase.places[0] + number, jnp.asarray(i, jnp.int32)
        laws = met.found, met.presses, met.allowed
        found.append(After(q, met.v, here, way, jnp.asarray(False), modes.put(phase, met), *laws))
    by_switch = (first < len(phase.switches)) & ~begins
    after = found[0] if len(found) == 1 else where(by_switch, *jax.tree.map(jnp.asarray, found))
    momentum = partial(jax.grad(system.lagrangian, argnums=2), end.t)
    return after, jax.tree.map(jnp.subtract, momentum(after.q, after.v, given), momentum(end.q, end.v, given))


def _entered(phases: Sequence[Phase], to: Array, modes: Modes | None, t: Array, params: PyTree):
    """Whether modes that fit the state are to be found where a phase is entered; those before that, with open gaps."""
    if modes is None:
        return jnp.asarray(False), None
    found = Modes(jnp.full_like(modes.modes, NO_PHASE), jnp.zeros_like(modes.slack))
    for i, phase in enumerate(phases):
        if phase.meeting is not None:
            found = where(to == i, modes.put(phase, phase.meeting.laws.at_first(t, params)), found)
    return jnp.asarray([phase.meeting is not None for phase in phases])[to], found


def _recorded(
    way: Way, onward: Array, begins: Array, end: Snapshot, after: After, impulse: PyTree, in_step: bool
) -> Switches:
    """The record with a switch more, where the motion goes `onward`; or, where a phase `begins`, with the modes that
    fit, and the velocities on these, after the last switch.

    Where all lanes of a batch that go on are `in_step`, with the same number of switches, one row is written.
    """
    switches, place = way.record, jnp.arange(way.record.t.shape[0])
    new, of_last = onward & ~begins, onward & begins & (way.count > 0)
    last = eqxi.unvmap_max(jnp.where(new, way.count, 0))
    here = new & (place == way.count)
    corrected = here | of_last & (place == way.count - 1)

    def put(all: Array, x: Array, at: Array = here) -> Array:
        x = x.astype(all.dtype)
        if in_step:
            return all.at[last].set(jnp.where(new, x, all[last]))
        return jnp.where(like(at, all), x[None], all)

    def put_after(all: Array, x: Array) -> Array:
        return put(all, x, corrected)

    if not in_step:
        before = jax.tree.map(lambda all: jnp.where(of_last, all[way.count - 1], 0.0), switches.impulse)
        impulse = jax.tree.map(jnp.add, impulse, before)
    fields = {
        name: jax.tree.map(put, getattr(switches, name), x)
        for name, x in {"t": end.t, "way": after.way, "to": after.to, "q": end.q, "v": end.v}.items()
    }
    modes = None if after.modes is None else after.modes.modes
    of_after = {"q_after": after.q, "v_after": after.v, "impulse": impulse, "modes": modes}
    fields |= {name: jax.tree.map(put_after, getattr(switches, name), x) for name, x in of_after.items()}
    return replace(switches, count=way.count + new, **fields)


def _one_of(first: Array, values):
    found = values[0]
    for i, x in enumerate(values[1:], 1):
        found = jnp.where(first == i, x, found)
    return found
