"""The steps of a motion, all of one length, or following a pace (`pace.py`); and for which systems they are.

Outputs at equal distances divide the motion: the steps are the longest, up to `dt0`, of which a whole number fits
between two of them. Other outputs leave the steps alone, which then have the length `dt0`: each is the end of one more
step, taken aside from the last state before it. Only outputs are kept. In reverse mode an interval is run again, from
the state at its start, with the states of some of its steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.equal_steps.gauss_step import GaussStep
from lagjax.integrate.equal_steps.pace import Pace, PacedSteps
from lagjax.integrate.equal_steps.rattle_step import RattleStep
from lagjax.integrate.equal_steps.splitting_step import SplittingStep
from lagjax.integrate.equal_steps.watched_step import Between, Due, WatchedSteps
from lagjax.integrate.events.detect import Follower
from lagjax.integrate.events.event_times import locate
from lagjax.integrate.settings import Settings
from lagjax.jaxtools import one_function, where
from lagjax.mechanics import sees_velocities, structure, with_first_order
from lagjax.numerics import EqualSteps, Gauss, Splitting, tableau
from lagjax.system import Model

# Part of a step by which an interval may be longer than so many steps: outputs are rounded.
ROUNDED = 1e-6
# And so many round-offs of the largest time.
ROUND_OFFS_OF_TIMES = 8
# The states kept in reverse mode within an interval.
CHECKPOINTS = 64
# How often a progress meter is moved.
SHOWN = 200


def stepped(
    model: Model, settings: Settings, pace: Pace | None, q: PyTree, v: PyTree, ts: Float[Array, " T"], adjoint: Any,
    meter: diffrax.AbstractProgressMeter, follower: Follower | None = None, wanted: Float[Array, " W"] | None = None,
):  # fmt: skip
    """The states (q, v) at `ts`, which of these were reached, the number of steps, the last time and state (1,), the
    result, and where the guards of a `follower` are zero. `meter` is shown unless the motion is run for reverse mode.

    `wanted`: where states are returned, if not at `ts`, which say how the steps are made: increasing times, all of `ts`
    up to the end of the motion among them, which is the last one.
    """
    method, dt = settings.method, settings.dt0
    assert isinstance(method, EqualSteps) and dt is not None
    forward = isinstance(adjoint, diffrax.ForwardMode)
    shown = forward and not isinstance(meter, diffrax.NoProgressMeter)

    def steps(model: Model, pace: Pace | None, q: PyTree, v: PyTree, ts: Array, dt: Array, follower, wanted):
        x, u = model.vectors(q, v)
        step = _step_of(method, model, ts[0], x, u, settings.differentiated)
        loop = _forward if forward else _checkpointed
        if pace is None:
            steps, rows = EquallyLong(step, loop), spans(ts, dt, settings.max_steps)
            rows = rows if wanted is None else between(rows, ts, wanted)
        else:
            times = ts if wanted is None else wanted
            steps, rows = PacedSteps(step, pace, dt, loop, settings.max_steps), (times[:-1], times[1:])
        if follower is not None:
            steps = WatchedSteps(steps, model, follower, loop)

        def interval(carried: tuple[Any, Any], row: Any):
            state, bar = carried
            watched = Metered(meter, bar, ts, dt)
            state, output = (steps._replace(loop=watched.loop) if shown else steps).interval(state, row)
            return (state, watched.bar), output

        interval = interval if forward else jax.checkpoint(interval, prevent_cse=False)
        first = steps.first(ts[0], x, u), meter.init() if shown else None
        (last_state, bar), (times, xs, us, unsolved, counts, used_up) = lax.scan(interval, first, rows)
        if shown:
            meter.close(bar)
        states = jax.tree.map(
            lambda first, rows: jnp.concatenate([first[None], rows]), (q, v), (model.tree(xs), model.tree(us))
        )
        reached = jnp.concatenate([jnp.ones(1, bool), ~unsolved])
        last = jnp.minimum(jnp.sum(reached), reached.size - 1)[None]
        end = jnp.concatenate([ts[:1], times])[last], jax.tree.map(lambda x: x[last], states)
        found = states, reached, jnp.sum(counts), end, jnp.any(used_up)
        if follower is None:
            return *found, None, None
        watching: Any = last_state[-1]
        return *found, watching.ended, locate(follower, watching.watched)

    arguments = model, pace, q, v, ts, dt, follower, wanted
    found = one_function(steps, *arguments) if forward and not shown else steps(*arguments)
    states, reached, count, end, used_up, ended, located = found
    results = diffrax.RESULTS
    failed = results.where(used_up, results.max_steps_reached, results.nonlinear_divergence)
    result = results.where(jnp.all(reached), results.successful, failed)
    if ended is not None:
        result = results.where(ended, results.event_occurred, result)
    return states, reached, count, end, result, located


def _forward(goes_on: Callable, one: Callable, state: tuple, time: Callable):
    return lax.while_loop(goes_on, one, state)


def _checkpointed(goes_on: Callable, one: Callable, state: tuple, time: Callable):
    return eqxi.while_loop(goes_on, one, state, kind="checkpointed", checkpoints=CHECKPOINTS)


class Metered:
    """A loop whose steps are made by a few hundred machine functions, between which a meter is moved.

    `bar` is the state of the meter, before a loop and after it.
    """

    def __init__(self, meter: diffrax.AbstractProgressMeter, bar: Any, ts: Float[Array, " T"], dt: Float[Array, ""]):
        self.meter, self.bar, self._ts = meter, bar, ts
        self._steps = jnp.ceil((ts[-1] - ts[0]) / dt / SHOWN).astype(int)

    def loop(self, goes_on: Callable, one: Callable, state: tuple, time: Callable):
        """The state after the loop; the first of its parts counts steps."""

        def some(watched: tuple) -> tuple:
            state, bar = watched
            until, (first, last) = state[0] + self._steps, (self._ts[0], self._ts[-1])
            steps = lambda state: lax.while_loop(lambda state: goes_on(state) & (state[0] < until), one, state)
            state = one_function(lambda steps, state: steps(state), eqx.filter_closure_convert(steps, state), state)
            return state, self.meter.step(bar, (time(state) - first) / (last - first))

        state, self.bar = lax.while_loop(lambda watched: goes_on(watched[0]), some, (state, self.bar))
        return state


class Span(NamedTuple):
    """The steps of an interval: `count` of the length `h` from `start` on, and one aside, of the length `left`, to the
    output at `end`, unless that is 0. `still`: whether it has no length, as between outputs that only fill up an array;
    `used_up`: whether there would be too many steps.
    """

    start: Float[Array, ""]
    h: Float[Array, ""]
    count: Int[Array, ""]
    left: Float[Array, ""]
    end: Float[Array, ""]
    still: Bool[Array, ""]
    used_up: Bool[Array, ""]


def spans(ts: Float[Array, " T"], dt: Float[Array, ""], most: int | None) -> Span:
    """The steps of all intervals, in rows of (T - 1,); `most`: how many they may be in all.

    >>> of = jax.jit(lambda *ts: spans(jnp.stack(ts), 0.4, None))
    >>> print(of(0.0, 1.0, 2.0, 3.0).count)  # three of 1/3 in each interval
    [3 3 3]
    >>> found = of(0.0, 0.9, 2.0, 3.0)  # of 0.4 throughout
    >>> print(found.count, found.left.__array__().round(2))
    [2 3 2] [0.1 0.  0.2]
    """
    slack = ROUND_OFFS_OF_TIMES * jnp.finfo(ts.dtype).eps * jnp.max(jnp.abs(ts))
    starts, ends, lengths = ts[:-1], ts[1:], ts[1:] - ts[:-1]
    still = lengths == 0
    alike = jnp.all(still | (jnp.abs(lengths - lengths[0]) <= ROUNDED * dt + slack))
    many = jnp.ceil(lengths / dt - ROUNDED).astype(int)
    many = jnp.where(lengths > 0, jnp.maximum(many, 1), 0)
    # Of steps from the first output on: the number before each output, and what is left there.
    passed = jnp.floor((ts - ts[0] + slack) / dt).astype(int)
    left = (ends - ts[0]) - passed[1:] * dt
    left = jnp.where(alike | still | (jnp.abs(left) <= slack), 0.0, left)
    count = jnp.where(alike, many, jnp.diff(passed))
    start = jnp.where(alike, starts, ts[0] + passed[:-1] * dt)
    h = jnp.where(alike, lengths / jnp.maximum(many, 1), dt)
    if most is None:
        return Span(start, h, count, left, ends, still, jnp.zeros(lengths.shape, bool))
    free = jnp.maximum(most - (jnp.cumsum(count) - count), 0)
    return Span(start, h, jnp.minimum(count, free), left, ends, still, count > free)


def between(spans: Span, ts: Float[Array, " T"], wanted: Float[Array, " W"]) -> Span:
    """The same steps in rows (W - 1,) between other outputs, which are increasing times: each is the end of one more
    step aside, unless it is one of `ts`. The last one may be before the end of the motion.
    """
    slack = ROUND_OFFS_OF_TIMES * jnp.finfo(ts.dtype).eps * jnp.max(jnp.abs(ts))
    starts, ends = wanted[:-1], wanted[1:]
    around = jnp.clip(jnp.searchsorted(ts, starts, side="right") - 1, 0, ts.size - 2)
    whole: Span = jax.tree.map(lambda x: x[around], spans)

    def passed(times: Array) -> Array:
        """The number of steps before these times, of those of the interval around."""
        steps = jnp.floor((times - whole.start + slack) / whole.h).astype(int)
        return jnp.where(
            times <= ts[around], 0, jnp.where(times >= whole.end, whole.count, jnp.minimum(steps, whole.count))
        )

    before, after, still, at_end = passed(starts), passed(ends), ends <= starts, ends >= whole.end
    left = jnp.where(at_end, whole.left, ends - (whole.start + after * whole.h))
    left = jnp.where(still | ~at_end & (jnp.abs(left) <= slack), 0.0, left)
    return Span(
        whole.start + before * whole.h, whole.h, jnp.where(still, 0, after - before), left, ends, still,
        whole.used_up & at_end,
    )  # fmt: skip


class EquallyLong(NamedTuple):
    """Steps by `step` of equal length.

    `loop`: called like JAX's `while_loop`, and with a function of its state that returns the time.
    """

    step: Any
    loop: Callable

    def first(self, t: Array, x: Array, u: Array):
        """The start of the motion: the state to go on from, and the one at the last output."""
        way = self.step.first(t, x, u)
        return way, way

    def interval(self, ways: tuple[Any, Any], span: Span):
        """The same at the end of an interval, and the output there."""
        way, there = ways
        begun = ~way.unsolved
        total = span.count + ((span.left != 0) & ~span.used_up)

        def goes_on(state: tuple) -> Array:
            k, way, _ = state
            return (k < total) & ~way.unsolved

        def one(state: tuple) -> tuple:
            k, way, _ = state
            whole = k < span.count
            new = self.step.advanced(way, span.start + k * span.h, jnp.where(whole, span.h, span.left))
            # A step that was not solved is where the motion ends.
            there = where(new.unsolved, way._replace(unsolved=jnp.asarray(True)), new)
            return jnp.where(new.unsolved, k, k + 1), where(whole | new.unsolved, there, way), there

        # An interval without steps ends where it begins.
        k, way, there = self.loop(
            goes_on, one, (jnp.asarray(0), way, there), lambda state: span.start + state[0] * span.h
        )
        used_up = begun & ~way.unsolved & span.used_up
        way, there = (x._replace(unsolved=x.unsolved | used_up) for x in (way, there))
        t = jnp.where(there.unsolved, jnp.minimum(span.start + k * span.h, span.end), span.end)
        return (way, there), (t, there.x, self.step.velocity(there, t), there.unsolved, k, used_up)

    def place(self, t: Array, x: Array, u: Array) -> Between:
        """The start of a motion that is watched (`watched_step.py`)."""
        return Between(self.step.first(t, x, u))

    def due(self, k: Array, place: Between, span: Span, last: Array) -> Due:
        """Step k of an interval of a motion that ends at `last`."""
        total = span.count + ((span.left != 0) & ~span.used_up)
        whole, arrives, t0 = k < span.count, k + 1 >= total, span.start + k * span.h
        h = jnp.where(whole, span.h, span.left)
        return Due(
            t0, h, jnp.where(arrives, span.end, t0 + h), whole, arrives & ~span.used_up, whole | (span.end >= last),
            span.used_up & ~whole,
        )  # fmt: skip

    def onward(self, place: Between, new: Any, due: Due) -> Between:
        """The place after a step."""
        return Between(new)

    def is_still(self, span: Span) -> Array:
        """Whether nothing is to be done in an interval."""
        return (span.count == 0) & (span.left == 0) & ~span.used_up

    def end(self, span: Span) -> Array:
        """The end of an interval."""
        return span.end


def _step_of(method: EqualSteps, model: Model, t: Array, x: Array, u: Array, differentiated: bool):
    if isinstance(method, Splitting):
        if model.m:
            return RattleStep.of(model, method.order, t, x, u, differentiated)
        return SplittingStep.of(model, method.order, t, x, u)
    assert isinstance(method, Gauss)
    return GaussStep(model, tableau(method.stages), method.newton, differentiated)


def check_can_be_stepped(method: EqualSteps, model: Model):
    """Raise unless the method is made for systems like this one."""
    first = with_first_order(model).form.first_order
    if first is not None and isinstance(method, Splitting):
        names = ", ".join(f"'{name}'" for name, is_first in zip(model.names, first.mask(model.n)) if is_first)
        raise ValueError(
            f"lj.{method.label} steps coordinates with a mass, and {names} have none: they are of first order.\n"
            "Fix: method=lj.Gauss(3)."
        )
    if model.reacts:
        raise ValueError(f"lj.{method.label} does not solve for forces that take multipliers.\nFix: leave method out.")
    if isinstance(method, Splitting):
        _check_can_be_split(model)


def is_suited(method: EqualSteps, model: Model) -> bool:
    """Whether the method is made for systems like this one."""
    try:
        check_can_be_stepped(method, model)
    except ValueError:
        return False
    return True


def _check_can_be_split(model: Model):
    """Raise unless L = T(v) - V(q), forces do not depend on velocities, and constraints restrict positions."""
    found = structure(model)
    depends = "" if found is None else ", ".join(found.mass_depends_on)
    rolling = [f"'{residual.name}'" for residual in model.form.residuals if not residual.of_positions]
    if rolling or depends or sees_velocities(model):
        why = "they do"
        if rolling or depends:
            why = f"{', '.join(rolling)} restricts velocities" if rolling else f"the mass matrix depends on {depends}"
        raise ValueError(
            "lj.Splitting is for L = T(v) - V(q) with a constant mass matrix, forces that do not depend on velocities "
            f"and constraints on positions, and {why}.\n"
            "Usual cause: polar coordinates, joint angles, friction, a magnetic field, a rotating frame, rolling.\n"
            "Fix: method=lj.Gauss(3), which takes any L."
        )
