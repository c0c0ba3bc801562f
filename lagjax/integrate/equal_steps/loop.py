"""The steps of a motion, all of one length between two outputs, or following a pace (`pace.py`); and for which systems.

An interval between two outputs is divided into the fewest equal steps that are no longer than `dt0`. Only outputs are
kept. In reverse mode an interval is run again, from the state at its start, with the states of some of its steps.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.integrate.equal_steps.gauss_step import GaussStep
from lagjax.integrate.equal_steps.pace import Pace, PacedSteps
from lagjax.integrate.equal_steps.rattle_step import RattleStep
from lagjax.integrate.equal_steps.splitting_step import SplittingStep
from lagjax.integrate.settings import Settings
from lagjax.jaxtools import one_function, where
from lagjax.mechanics import sees_velocities, structure, with_first_order
from lagjax.numerics import EqualSteps, Gauss, Splitting, tableau
from lagjax.system import Model

# Part of a step by which an interval may be longer than so many steps: outputs are rounded.
ROUNDED = 1e-6
# The states kept in reverse mode within an interval.
CHECKPOINTS = 64
# How often a progress meter is moved.
SHOWN = 200


def stepped(
    model: Model, settings: Settings, pace: Pace | None, q: PyTree, v: PyTree, ts: Float[Array, " T"], adjoint: Any,
    meter: diffrax.AbstractProgressMeter,
):  # fmt: skip
    """The states (q, v) at `ts`, which of these were reached, the number of steps, the last time and state (1,), and
    the result. `meter` is shown unless the motion is run for reverse mode."""
    method, dt = settings.method, settings.dt0
    assert isinstance(method, EqualSteps) and dt is not None
    forward = isinstance(adjoint, diffrax.ForwardMode)
    shown = forward and not isinstance(meter, diffrax.NoProgressMeter)

    def steps(model: Model, pace: Pace | None, q: PyTree, v: PyTree, ts: Array, dt: Array):
        x, u = model.vectors(q, v)
        step = _step_of(method, model, ts[0], x, u, settings.differentiated)
        loop = _forward if forward else _checkpointed
        steps = EquallyLong(step, dt, loop) if pace is None else PacedSteps(step, pace, dt, loop)

        def interval(carried: tuple[Any, Any], row: tuple[Array, Array]):
            state, bar = carried
            watched = Metered(meter, bar, ts, dt)
            state, output = (steps._replace(loop=watched.loop) if shown else steps).interval(state, row)
            return (state, watched.bar), output

        interval = interval if forward else jax.checkpoint(interval, prevent_cse=False)
        first = steps.first(ts[0], x, u), meter.init() if shown else None
        (_, bar), (times, xs, us, unsolved, counts) = lax.scan(interval, first, (ts[:-1], ts[1:]))
        if shown:
            meter.close(bar)
        states = jax.tree.map(
            lambda first, rows: jnp.concatenate([first[None], rows]), (q, v), (model.tree(xs), model.tree(us))
        )
        reached = jnp.concatenate([jnp.ones(1, bool), ~unsolved])
        last = jnp.minimum(jnp.sum(reached), ts.size - 1)[None]
        end = jnp.concatenate([ts[:1], times])[last], jax.tree.map(lambda x: x[last], states)
        return states, reached, jnp.sum(counts), end

    arguments = model, pace, q, v, ts, dt
    states, reached, count, end = one_function(steps, *arguments) if forward and not shown else steps(*arguments)
    diverged = diffrax.RESULTS.nonlinear_divergence
    result = diffrax.RESULTS.where(jnp.all(reached), diffrax.RESULTS.successful, diverged)
    return states, reached, count, end, result


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


class EquallyLong(NamedTuple):
    """Steps by `step` of equal length between two outputs, at most `dt`.

    `loop`: called like JAX's `while_loop`, and with a function of its state that returns the time.
    """

    step: Any
    dt: Float[Array, ""]
    loop: Callable

    def first(self, t: Array, x: Array, u: Array):
        """The start of the motion."""
        return self.step.first(t, x, u)

    def interval(self, way: Any, row: tuple[Array, Array]):
        """The state at the end of an interval, twice: to go on from, and as an output."""
        t0, t1 = row
        count = jnp.ceil((t1 - t0) / self.dt - ROUNDED).astype(int)
        count = jnp.where(way.unsolved, 0, jnp.where(t1 > t0, jnp.maximum(count, 1), 0))
        h = (t1 - t0) / jnp.maximum(count, 1)

        def goes_on(state: tuple) -> Array:
            k, way = state
            return (k < count) & ~way.unsolved

        def one(state: tuple) -> tuple:
            k, way = state
            new = self.step.advanced(way, t0 + k * h, h)
            # A step that was not solved is where the motion ends.
            before = way._replace(unsolved=jnp.asarray(True))
            return jnp.where(new.unsolved, k, k + 1), where(new.unsolved, before, new)

        k, way = self.loop(goes_on, one, (jnp.asarray(0), way), lambda state: t0 + state[0] * h)
        t = jnp.where(way.unsolved, jnp.minimum(t0 + k * h, t1), t1)
        return way, (t, way.x, self.step.velocity(way, t), way.unsolved, k)


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
