"""Steps whose length follows the motion, without losing what steps of equal length keep.

A pace σ(t, q) > 0 says how long a step should be: dt0 σ. With h = dt0 σ(q_n) a step backward would have another length
than the same step forward, and energy would drift. So the steps have a pace of their own, ρ, whose logarithm follows
that of σ along the motion, from the middle of one step to the middle of the next:

    log ρ_{n+1/2} = log ρ_{n-1/2} + dt0 dσ/dt (t_n, q_n, v_n)          h_{n+1/2} = dt0 ρ_{n+1/2}

It starts with log σ and half of that. Read backward this is the same rule, so that states and steps together return on
their way, and energy stays where it was over any number of encounters. In s, where dt = σ ds, the steps have the length
dt0, and dσ/dt = d(log σ)/ds. The logarithm keeps ρ positive, and its error is in proportion to ρ.

Outputs do not change the steps: each is the end of one more step, from the last state before it.

Source: Hairer & Söderlind, SIAM J. Sci. Comput. 26 (2005) 1838 (with 1/ρ in place of log ρ).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PyTree

from lagjax.integrate.equal_steps.gauss_step import added
from lagjax.integrate.equal_steps.watched_step import Due
from lagjax.jaxtools import where
from lagjax.numerics import EqualSteps
from lagjax.refusals import must_return
from lagjax.system import OF_POSITION, OF_STATE, Call, Form, State, traced_call


def with_traced_pace(method: EqualSteps, start: State) -> EqualSteps:
    """The method with its pace checked and traced; raises, in the user's words, if it cannot be called."""
    if method.pace is None:
        return method
    call = Call("pace", method.pace, OF_POSITION, f" of lj.{type(method).__name__}")
    return replace(method, pace=traced_call(call, dict(zip(OF_STATE, start)), _check))


def _check(call: Call, value: Any):
    shape, dtype = jnp.shape(value), jnp.result_type(value)
    real = jnp.issubdtype(dtype, jnp.floating) or jnp.issubdtype(dtype, jnp.integer)
    fix = "jnp.sum(q**2) ** 0.75, for the distance to the power 3/2"
    must_return(shape == () and real, call, "one positive number", value, fix, "distances that are left as a vector")


class Pace(NamedTuple):
    """A pace for the states of a model; `form`: in which the user writes them."""

    function: Callable
    form: Form
    params: PyTree

    def at(self, t: Array, x: Array) -> Float[Array, ""]:
        """σ."""
        return jnp.asarray(self.function(t, self.form.tree(x), self.params), x.dtype)

    def rate(self, t: Array, x: Array, u: Array) -> Float[Array, ""]:
        """dσ/dt along the motion."""
        return jax.jvp(self.at, (t, x), (jnp.ones_like(t), u))[1]


class Line(NamedTuple):
    """The steps so far, `count` of them: the state `way` at t, what is to be added to t, and log ρ of the next step."""

    way: Any
    t: Float[Array, ""]
    t_rest: Float[Array, ""]
    log_pace: Float[Array, ""]
    count: Int[Array, ""]


class PacedSteps(NamedTuple):
    """Steps by `step` of the length `dt` times the pace, at most `most`; `loop`: as in `loop.py`."""

    step: Any
    pace: Pace
    dt: Float[Array, ""]
    loop: Callable
    most: int | None

    def first(self, t: Array, x: Array, u: Array) -> Line:
        """The start of the motion."""
        log_pace = jnp.log(self.pace.at(t, x)) + self.dt / 2 * self.pace.rate(t, x, u)
        way = self.step.first(t, x, u)
        return Line(way._replace(unsolved=~jnp.isfinite(log_pace)), t, jnp.zeros_like(t), log_pace, jnp.asarray(0))

    def interval(self, line: Line, row: tuple[Array, Array]):
        """The last state before the end of an interval, and the output there."""
        _, t1 = row

        before = line.count

        def goes_on(state: tuple) -> Array:
            k, line = state
            ahead = (self._left(line, t1) > self._length(line)) & ~line.way.unsolved
            return ahead if self.most is None else ahead & (k < self.most)

        k, line = self.loop(goes_on, self._one, (before, line), lambda state: state[1].t)
        used_up = ~line.way.unsolved & (self._left(line, t1) > self._length(line))
        # Never of the length zero: a step that would end at an output is this one.
        there = self.step.advanced(line.way, line.t, self._left(line, t1))
        unsolved = line.way.unsolved | there.unsolved | used_up
        way, t = where(unsolved, line.way, there), jnp.where(unsolved, line.t, t1)
        line = line._replace(way=line.way._replace(unsolved=unsolved), count=k)
        k = jnp.where(unsolved, k, k + 1) - before
        return line, (t, way.x, self.step.velocity(way, t), unsolved, k, used_up)

    def _one(self, state: tuple) -> tuple:
        k, line = state
        h = self._length(line)
        way = self.step.advanced(line.way, line.t, h)
        new, unsolved = self._after(line, way, h, k)
        before = line._replace(way=line.way._replace(unsolved=jnp.asarray(True)))
        return jnp.where(unsolved, k, k + 1), where(unsolved, before, new)

    def _after(self, line: Line, way: Any, h: Array, k: Array) -> tuple[Line, Array]:
        """The line after step k of the length h, and whether it ends there."""
        t, t_rest = added(line.t, line.t_rest + h)
        log_pace = line.log_pace + self.dt * self.pace.rate(t, way.x, self.step.velocity(way, t))
        new = Line(way, t, t_rest, log_pace, k + 1)
        # A step that was not solved, or does not move t, is where the motion ends.
        return new, way.unsolved | ~jnp.isfinite(log_pace) | (t <= line.t)

    def place(self, t: Array, x: Array, u: Array) -> Line:
        """The start of a motion that is watched (`watched_step.py`)."""
        return self.first(t, x, u)

    def due(self, k: Array, line: Line, row: tuple[Array, Array], last: Array) -> Due:
        """The next step of a motion that ends at `last`."""
        h, left = self._length(line), self._left(line, row[1])
        ahead = left > h
        spent = jnp.asarray(False) if self.most is None else ahead & (line.count >= self.most)
        h, until = jnp.where(ahead, h, left), jnp.where(ahead, line.t + h, row[1])
        return Due(line.t, h, until, ahead, ~ahead, ahead | (row[1] >= last), spent)

    def onward(self, line: Line, way: Any, due: Due) -> Line:
        """The line after a step."""
        new, unsolved = self._after(line, way, due.h, line.count)
        return new._replace(way=way._replace(unsolved=unsolved))

    def is_still(self, row: tuple[Array, Array]) -> Array:
        """Whether nothing is to be done in an interval."""
        return row[1] <= row[0]

    def end(self, row: tuple[Array, Array]) -> Array:
        """The end of an interval."""
        return row[1]

    def _length(self, line: Line) -> Array:
        return self.dt * jnp.exp(line.log_pace)

    @staticmethod
    def _left(line: Line, t1: Array) -> Array:
        return (t1 - line.t) - line.t_rest
