"""A motion over the jumps and kinks of its forces: outcomes of comparisons as modes of an automaton (`legs.py`).

In a mode (`jumps/find.py`) the equations are smooth, and each leg ends where the guard of one of its comparisons is
zero. There the mode changes and the state does not; the time and the state carry their derivatives (`event_times.py`)
into the next leg, so that derivatives of all orders get the jump: with the flows φ₋ and φ₊ of both sides and the time τ
at which a neighbouring motion crosses, the neighbour goes on from φ₊(-τ) φ₋(τ). If both sides push the motion back it
goes along the jump (`integrate/jumps/sliding.py`), until a share of the mixture leaves [0, 1].

After very many jumps, and where a mode turns out to be wrong, the rest of the motion is integrated with the comparisons
as they are, which is right too, with more steps and without the jumps' part of the derivatives; `stats["lost_jumps"]`
says so.

Jumps that depend on t alone are ends of steps inside a leg, like `jump_ts` (`integrate/jumps/find.py`).

Source: Hiskens & Pai, IEEE Trans. Circuits Syst. I 47 (2000) 204 (trajectory sensitivities through switches).
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.events.event import LONG, EventKind, Guards
from lagjax.integrate.jumps.find import Given, Jumps, OfParams, Smooth
from lagjax.integrate.jumps.sliding import Mixed, Sliding, slidable
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.legs import (
    AT_ONCE,
    Leg,
    Place,
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
from lagjax.integrate.stepping.tolerances import DIED_OUT
from lagjax.integrate.trajectory.parts import Snapshot
from lagjax.integrate.trajectory.results import RESULTS, ended_well
from lagjax.integrate.trajectory.trajectory import Trajectory
from lagjax.jaxtools import IN_TIME, apart, stop_gradient
from lagjax.system import System, model_of, warn

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
    """The smooth system with its guards; motions slide in `small` systems."""
    smooth, guards, sliding = jumps.smooth(system), jumps.numbers(system, 0), None
    which = slidable(jumps, system) if small else ()
    if which:
        differences = jumps.numbers(system, 2)
        sliding = Sliding(smooth, tuple(differences[i] for i in which), which)
        smooth = replace(smooth, force=Mixed(smooth.force, sliding))
    guards = tuple(ModeGuard(guard, sliding if i in which else None, i) for i, guard in enumerate(guards))
    pauses = sliding is not None or any(IN_TIME in slot.depends for slot in jumps.slots)
    return Piecewise(smooth, sliding, guards, tuple(jumps.numbers(system, 1)), pauses)


class Outcomes(NamedTuple):
    """The mode of a motion over jumps: as in `Given`."""

    modes: Float[Array, " n"]
    slides: Bool[Array, " n"]
    free: Bool[Array, ""]


class OverJumps(Place):
    """The modes of a piecewise system, in a motion over `ts`; the first guards are theirs."""

    def __init__(self, piecewise: Piecewise, guards: Guards, ts: Array, settings: Settings):
        self.piecewise, self.guards, self.ts, self.settings = piecewise, guards, ts, settings
        self.system = piecewise.smooth

    def given(self, params: PyTree, mode: Outcomes) -> Given:
        return Given(params, *mode)

    def until(self, ahead: Float[Array, " T"], way: Way) -> Float[Array, " T"]:
        if not self.piecewise.pauses or self.settings.jump_ts is None:
            return ahead
        # A guard that jumps in time may have no zero: the next leg begins there, and ends at once. Not `minimum`, whose
        # derivative is one half for an output at that time.
        pause = _next(self.settings.jump_ts, way.t, resolution(self.ts))
        return jnp.where(ahead > pause, pause, ahead)

    def then(self, leg: Leg) -> Then:
        """What follows a leg: the mode beyond a comparison; the same, after a pause; or the same leg without modes."""
        way, given, (modes, slides, free), guards = leg.way, leg.given, leg.way.mode, self.piecewise.guards
        last, options = self.ts[-1], (resolution(self.ts), self.settings.rtol)
        when, of_events = times_of(self.guards, leg.events, len(guards), last.dtype)
        by_jump, first, _, below, end = apart(
            ending_of, self.guards, len(guards), leg, jnp.stack(when), of_events, False, *options
        )
        ends_well, whole = ended_well(leg.result), end.t >= last
        gives_up = (leg.result == RESULTS.max_steps_reached) | (leg.result == RESULTS.no_progress)
        # Where a force jumps in time, the side of which a guard is belongs to the next leg.
        again = leg.here & ~free & (ends_well & ~by_jump & whole & below | ~ends_well & ~gives_up)
        onward, result = leg.here & by_jump, RESULTS.where(by_jump, RESULTS.successful, leg.result)
        paused = leg.here & (result == RESULTS.successful) & ~onward & ~again & ~whole
        # Not where a leg began, if it ended at once: what jumps with time has jumped only after that.
        beyond, along = apart(_beyond, self.piecewise, first, leg.end, given)
        mode = Outcomes(
            jnp.where(onward, beyond, modes), jnp.where(onward, along, slides),
            free | again | (onward & (way.count + 1 >= MOST_JUMPS)),
        )  # fmt: skip
        moves, at_first = onward | paused, way.t <= self.ts[0]
        return Then(onward, moves, again, end, end.q, end.v, mode, None, result, leg.events, leg.rows, at_first)


def solved_over_jumps(
    jumps: Jumps, system: System, q0: PyTree, v0: PyTree, params: PyTree, ts: Array, guards, settings: Settings,
    adjoint: Any,
):  # fmt: skip
    """Return the fields of the trajectory, like `one_motion.solved`."""
    model = model_of(system, ts[0], q0, v0, params)
    piecewise = piecewise_of(jumps, system, small=model.n + model.m <= 24)
    modes = stop_gradient(jumps.modes(system, ts[0], q0, v0, params))
    mode = Outcomes(modes, jnp.zeros(modes.shape, bool), jnp.asarray(False))
    multipliers, sizes = unknown(model.zero_multipliers()), sizes_of(q0, v0)
    # A motion that rests at zero, held by friction, has round-off alone to tell its size.
    sizes = jnp.where(jnp.any(sizes > 0), sizes, 1 / DIED_OUT)
    start, names = Snapshot(ts[0], q0, v0, multipliers), () if guards is None else [kind.name for kind in guards.kinds]
    rows = unknown({"q": q0, "v": v0, "multipliers": multipliers}, ts.shape[0])
    events = nothing(guards, names, q0, v0, multipliers)
    first = before_any(start, start, mode, sizes, settings, rows, events)
    turns = MOST_JUMPS + 2 + (0 if settings.jump_ts is None else settings.jump_ts.size)
    place = OverJumps(piecewise, _together(piecewise, guards), ts, settings)
    way = over_legs([place], first, params, ts, lambda place: settings, adjoint, MOST_JUMPS, turns)
    stats = way.stats | {"num_jumps": way.count, "lost_jumps": way.mode.free}
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
