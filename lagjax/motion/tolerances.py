"""What the error of a step may be, number by number.

A tolerance in the user's units is nothing to a motion of nanometres and everything to one of light years. Where `atol`
is left to the library, each coordinate and each velocity is therefore judged by its own size alone:

    rtol max(|y|, a thousandth of the largest |y| so far),        for velocities also of √(|a| |q|)

It is taken at the larger end of the step, so that passing through zero costs nothing; what dies out is followed over
three decades; √(|a| |q|) is the velocity that belongs to an extent and an acceleration, which is what there is at rest
when a force sets in. Below that comes only what rounding makes of the other coordinates: a motion in a plane leaves the
third dimension at round-off, which no step can follow. They are compared by √M_ii q_i and √M_ii v_i, all of one unit
whatever the coordinates are. Where all is zero at the start, nothing tells a size but the user's units.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from lagjax.motion.consistency import stopped

# Of the size of an angle no more counts than this: relative to a thousand turns, a tolerance would mean nothing.
TURN = 2 * np.pi
# This part of the largest that a number has been counts as its size.
DIED_OUT = 1e-3
# What rounding makes of one number in another, in units of the last digit.
ROUNDED = 8.0
# A first step that is too short costs one more, one that is too long several; it may also pass over an event.
FIRST = 0.1
# What is lighter than this, by the root of the mass, is taken for no lighter: rounding also comes by constraints.
LIGHT = 1e-6
# This part of the extent of all others counts for a coordinate at rest at zero where a force sets in.
OF_OTHERS = 1e-6
# Of the coordinates and velocities that the first acceleration makes of a motion from nothing in all its time.
FROM_NOTHING = 1e-6, 1e-3


class Tolerances(NamedTuple):
    """Tolerances of coordinates and of velocities, each (2,)."""

    rtol: Float[Array, " 2"]
    atol: Float[Array, " 2"]


class Scales(NamedTuple):
    """What the start tells of a motion's size; rows are coordinates and velocities.

    - `root_mass`: √M_ii, and about one over it.
    - `reach`: the largest of the numbers by that, never zero.
    - `time`: in which they change. `first`: the sizes of the numbers; where all are zero what is taken for them.
    """

    root_mass: Float[Array, "1 n"]
    over_root_mass: Float[Array, "1 n"]
    reach: Float[Array, "2 1"]
    time: Float[Array, ""]
    first: Float[Array, "2 n"]


def tolerances_at(start, ts, settings, sizes_so_far=None) -> Tolerances:
    """The tolerances of a whole state, for constraints, which see coordinates together: as given, or by the start.

    `seen` (2, n): how large coordinates and velocities have been before it.
    """
    if not settings.by_size:
        return Tolerances(settings.rtol, settings.atol)
    sizes = jnp.abs(_rows(start.q, start.v))
    span, (of_q, of_v) = (
        span_of(ts),
        jnp.max(sizes if sizes_so_far is None else jnp.maximum(sizes, sizes_so_far), axis=1),
    )
    of_q = jnp.where(of_q > 0, of_q, jnp.where(of_v > 0, of_v * span, 1.0))
    return Tolerances(settings.rtol, stopped(settings.rtol * jnp.stack([of_q, jnp.maximum(of_v, of_q / span)])))


def span_of(ts):
    """The time that a motion takes; positive also where it is refused."""
    return jnp.maximum(jnp.abs(ts[-1] - ts[0]), jnp.finfo(ts.dtype).tiny)


def scales_of(mass, q, v, a, span) -> Scales:
    """The scales of a motion, by its first state and the accelerations there, which need not be finite."""
    root_mass, sizes = (
        jnp.sqrt(jnp.nan_to_num(mass[None], posinf=0.0)),
        jnp.abs(jnp.nan_to_num(_rows(q, v, a), posinf=0.0)),
    )
    heaviest = jnp.max(root_mass)
    over_root_mass = 1 / jnp.maximum(root_mass, LIGHT * jnp.where(heaviest > 0, heaviest, 1.0))
    of_q, of_v, of_a = jnp.max(root_mass * sizes, axis=1)
    nothing = (of_q == 0) & (of_v == 0)
    # What is zero is made of the others: a velocity of extent and acceleration, else all of the time that there is.
    of_v = jnp.maximum(of_v, jnp.sqrt(of_a * of_q))
    larger, smaller = jnp.stack([of_q, of_v]), jnp.stack([of_v, of_a])
    known = (larger > 0) & (smaller > 0)
    time = jnp.minimum(span, jnp.min(jnp.where(known, larger / jnp.where(known, smaller, 1.0), span)))
    of_v = jnp.maximum(of_v, jnp.where(of_a > 0, of_a * time, of_q / span))
    of_q = jnp.maximum(of_q, of_v * time)
    reach = jnp.stack([of_q, of_v])[:, None]
    moved = jnp.where(of_a > 0, np.array(FROM_NOTHING, reach.dtype)[:, None] * reach, 1.0)
    least = jnp.minimum(moved * over_root_mass, 1.0) / DIED_OUT
    reach = jnp.where(reach > 0, reach, 1.0)
    return Scales(root_mass, over_root_mass, reach, time, jnp.where(nothing, least, sizes[:2]))


def shared(scales: Scales, sizes) -> Float[Array, "2 n"]:
    """What is as large in each number as the largest of all in its own, of `sizes` (2, n)."""
    return jnp.max(scales.root_mass * sizes, axis=1, keepdims=True) * scales.over_root_mass


def rounding(others: Float[Array, "2 n"]) -> Float[Array, "2 n"]:
    """What rounding makes of numbers that are zero where the others are as large as this."""
    return ROUNDED * jnp.finfo(others.dtype).eps * others


def as_nothing(scales: Scales, rtol) -> Float[Array, " 2n"]:
    """The `atol` of each coordinate and each velocity by the start alone: for iterations inside a step."""
    others = scales.reach * scales.over_root_mass
    own = jnp.where(scales.first > 0, scales.first, others)
    return jnp.ravel(DIED_OUT * rtol[:, None] * own + rounding(others))


class Weighing(diffrax.AbstractAdaptiveStepSizeController):
    """Wrap `controller`, which knows one tolerance: each number's error counts in units of its own.

    With `scales` by its own size; without them by `tolerances`, of coordinates and of velocities. Of the coordinates
    that are `angles`, (n,), at most a turn counts. The state has the largest numbers so far, (2, n).
    """

    controller: diffrax.PIDController
    tolerances: Tolerances
    scales: Scales | None
    angles: tuple[bool, ...] = eqx.field(static=True)

    @property
    def rtol(self):
        return self.controller.rtol

    @property
    def atol(self):
        return self.controller.atol

    @property
    def norm(self):
        return self.controller.norm

    @property
    def dtmin(self):
        return self.controller.dtmin

    def wrap(self, direction):
        """The same for time in this direction, which is always forward."""
        return self

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first step."""
        if self.scales is not None and dt0 is None:
            dt0 = FIRST * stopped(self.scales.time * self.rtol ** (1.0 / float(error_order or 1.0)))
        t1, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return t1, (state, None if self.scales is None else self.scales.first)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Whether to keep a step, and the next one."""
        state, largest = controller_state
        weighed, now = self._weighed(t1 - t0, y0, y1_candidate, y_error, largest)
        keep, *rest, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, weighed, error_order, state
        )
        largest = None if now is None else jnp.where(keep, now, largest)
        return keep, *rest, (state, largest), result

    # Jitted, so that it is traced once: diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def _weighed(self, h, y0, y1, error, largest):
        """The error in the controller's units, and the largest numbers with this step."""
        error, as_it_was = ravel_pytree(error)
        before, after, h = stopped((_rows(*y0), _rows(*y1), h))
        size = jnp.maximum(jnp.abs(before), jnp.abs(after))
        if largest is None:
            own, now = self.tolerances.atol[:, None] + self.tolerances.rtol[:, None] * self._turned(size), None
        else:
            now = jnp.maximum(size, largest)
            own = self._by_size(size, now, jnp.abs(after - before)[1] / h)
        weights = (self.atol + self.rtol * size) / jnp.where(own > 0, own, 1.0)
        return as_it_was(error * weights.ravel()), now

    def _by_size(self, size, largest, rate):
        scales = self.scales
        assert scales is not None
        others = shared(scales, largest)
        q, v = self._turned(jnp.maximum(size, DIED_OUT * largest))
        own = jnp.stack([q, jnp.maximum(v, jnp.sqrt(rate * (q + OF_OTHERS * others[0])))])
        if any(self.angles):
            others = jnp.maximum(others, np.stack([self.angles, np.zeros(len(self.angles))]).astype(others.dtype))
        return self.tolerances.rtol[:, None] * own + rounding(others)

    def _turned(self, sizes):
        if not any(self.angles):
            return sizes
        most = np.stack([np.where(self.angles, TURN, np.inf), np.full(len(self.angles), np.inf)])
        return jnp.minimum(sizes, most.astype(sizes.dtype))


def _rows(*trees):
    """The numbers of trees of the same structure, a row a tree."""
    return ravel_pytree(trees)[0].reshape(len(trees), -1)
