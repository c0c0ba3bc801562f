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

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanics.coordinates import flatten
from lagjax.motion.consistency import stopped

# Of the size of an angle no more counts than this: relative to a thousand turns, a tolerance would mean nothing.
TURN = 2 * np.pi
# This part of the largest that a number has been counts as its size.
DIED_OUT = 1e-3
# What rounding makes of one number in another, in units of the last digit.
ROUNDED = 8.0
# This part of the extent of all others counts for a coordinate at rest at zero where a force sets in.
OF_OTHERS = 1e-6
# Of what a constant acceleration makes of a motion from nothing; the user's unit at most.
FROM_NOTHING = 1e-6


class Tolerances(NamedTuple):
    """Tolerances of coordinates and of velocities, each (2,)."""

    rtol: Float[Array, " 2"]
    atol: Float[Array, " 2"]


class Scales(NamedTuple):
    """How large a motion is as its start tells it, nowhere zero; and √M_ii, like q.

    `least`: the least of coordinates and of velocities, where the start tells nothing; else zero.
    """

    q: PyTree[Array]
    v: PyTree[Array]
    root_mass: PyTree[Array]
    least: tuple[PyTree[Array], PyTree[Array]]


class Seen(NamedTuple):
    """The largest coordinates and velocities so far, and the longest step."""

    q: PyTree[Array]
    v: PyTree[Array]
    longest: Float[Array, ""]


def tolerances_at(start, ts, settings) -> Tolerances:
    """The tolerances of a whole state, for the constraints, which see coordinates together: as given, or by the start's
    size."""
    if not settings.by_size:
        return Tolerances(settings.rtol, settings.atol)
    span, of_q, of_v = span_of(ts), _largest(start.q), _largest(start.v)
    of_q = _first_positive(of_q, of_v * span, 1.0)
    return Tolerances(settings.rtol, stopped(settings.rtol * jnp.stack([of_q, jnp.maximum(of_v, of_q / span)])))


def span_of(ts):
    """The time that a motion takes; positive also where it is refused."""
    return jnp.maximum(jnp.abs(ts[-1] - ts[0]), jnp.finfo(ts.dtype).tiny)


def scales_of(root_mass, q, v, a, span) -> Scales:
    """The scales of a motion by its first state and the accelerations there; what is zero is as the others are."""
    of_q, of_v, of_a = (_reach(root_mass, y) for y in (q, v, a))
    nothing = (of_q == 0) & (of_v == 0)
    # From rest by what the acceleration makes of the extent, from the origin by what it makes of the velocity.
    from_origin = of_v**2 / jnp.where(of_a > 0, of_a, jnp.inf)
    of_v = _first_positive(jnp.maximum(of_v, jnp.sqrt(of_a * of_q)), of_a * span, of_q / span)
    of_q = _first_positive(of_q, from_origin, of_v * span)
    own = lambda y, size: jtu.tree_map(lambda y, s: _first_positive(jnp.abs(y), _over(size, s), 1.0), y, root_mass)
    of_unit = jnp.where(of_a > 0, FROM_NOTHING, 1.0)
    least = lambda y: jtu.tree_map(lambda y: jnp.where(nothing, jnp.minimum(of_unit * y, 1.0), 0.0), y)
    q, v = own(q, of_q), own(v, of_v)
    return Scales(q, v, root_mass, (least(q), least(v)))


def rounding(root_mass, q, v, time) -> tuple[PyTree[Array], PyTree[Array]]:
    """What rounding makes of coordinates and velocities that are zero where the others are as large as these."""
    of_q = _reach(root_mass, q)
    of_v = jnp.maximum(_reach(root_mass, v), of_q / time)
    part = ROUNDED * jnp.finfo(of_q.dtype).eps
    of_q, of_v = (jtu.tree_map(lambda s, size=size: part * _over(size, s), root_mass) for size in (of_q, of_v))
    return of_q, of_v


def as_nothing(scales: Scales, rtol) -> Float[Array, " 2n"]:
    """The `atol` of each coordinate and each velocity by the start alone: for iterations inside a step."""
    of = _largest(scales.q) / jnp.maximum(_largest(scales.v), jnp.finfo(rtol.dtype).tiny)
    others = rounding(scales.root_mass, scales.q, scales.v, of)
    least = lambda rtol, own, other: jtu.tree_map(lambda y, least: DIED_OUT * rtol * y + least, own, other)
    return flatten(tuple(map(least, rtol, scales[:2], others)))[0]


class Weighing(diffrax.AbstractAdaptiveStepSizeController):
    """Wrap `controller`, which knows one tolerance: each number's error counts in units of its own.

    With `scales` by its own size; without them by `tolerances`, of coordinates and of velocities, the `angles` among
    the leaves of q by at most a turn.
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
        if self.scales is None:
            t1, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
            return t1, (state, None)
        # In units of the scales, in which atol is rtol.
        units = self.scales.q, self.scales.v
        of_units = lambda terms, t, y, args: _divided(func(terms, t, jtu.tree_map(jnp.multiply, y, units), args), units)
        controller = eqx.tree_at(lambda c: c.atol, self.controller, self.controller.rtol)
        t1, state = controller.init(terms, t0, t1, _divided(y0, units), dt0, args, of_units, error_order)
        size = stopped(jtu.tree_map(jnp.abs, y0))
        first = jtu.tree_map(lambda y, least: jnp.maximum(y, least / DIED_OUT), size, self.scales.least)
        return t1, (state, Seen(*first, jnp.zeros_like(t0)))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Whether to keep a step, and the next one."""
        state, seen = controller_state
        before, after, h = stopped((y0, y1_candidate, t1 - t0))
        size = jtu.tree_map(lambda a, b: jnp.maximum(jnp.abs(a), jnp.abs(b)), before, after)
        rate = jtu.tree_map(lambda a, b: jnp.abs(b - a) / h, before[1], after[1])
        own = self._given(size) if seen is None else self._by_size(size, rate, seen, h)
        rtol, atol = self.controller.rtol, self.controller.atol
        weighed = jtu.tree_map(
            lambda e, size, own: e * (atol + rtol * size) / jnp.where(own > 0, own, 1.0), y_error, size, own
        )
        keep, *rest, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, weighed, error_order, state
        )
        if seen is not None:
            now = Seen(*jtu.tree_map(jnp.maximum, (seen.q, seen.v), size), jnp.maximum(seen.longest, h))
            seen = jtu.tree_map(lambda new, old: jnp.where(keep, new, old), now, seen)
        return keep, *rest, (state, seen), result

    def _given(self, size):
        (rtol_q, rtol_v), (atol_q, atol_v) = self.tolerances
        of_q, of_v = size
        own_q = jtu.tree_map(lambda size: atol_q + rtol_q * size, self._turned(of_q))
        return own_q, jtu.tree_map(lambda size: atol_v + rtol_v * size, of_v)

    def _by_size(self, size, rate, seen, h):
        scales, (rtol_q, rtol_v) = self.scales, self.tolerances.rtol
        assert scales is not None
        largest_q, largest_v = jtu.tree_map(jnp.maximum, size, (seen.q, seen.v))
        largest_q, longest = self._turned(largest_q), jnp.maximum(h, seen.longest)
        of_q = jtu.tree_map(lambda y, most: jnp.maximum(y, DIED_OUT * most), self._turned(size[0]), largest_q)
        extent = _reach(scales.root_mass, largest_q)
        set_in = lambda a, q, s: jnp.sqrt(a * (q + OF_OTHERS * _over(extent, s)))
        of_v = jtu.tree_map(lambda y, most: jnp.maximum(y, DIED_OUT * most), size[1], largest_v)
        of_v = jtu.tree_map(jnp.maximum, of_v, jtu.tree_map(set_in, rate, of_q, scales.root_mass))
        others = rounding(scales.root_mass, largest_q, largest_v, longest)
        own_q = jtu.tree_map(lambda size, least: rtol_q * size + least, of_q, others[0])
        return own_q, jtu.tree_map(lambda size, least: rtol_v * size + least, of_v, others[1])

    def _turned(self, q):
        leaves, structure = jtu.tree_flatten(q)
        return structure.unflatten([jnp.minimum(x, TURN) if angle else x for x, angle in zip(leaves, self.angles)])


def _largest(tree):
    leaves = jtu.tree_leaves(tree)
    largest = jnp.max(jnp.abs(leaves[0]))
    for x in leaves[1:]:
        largest = jnp.maximum(largest, jnp.max(jnp.abs(x)))
    return largest


def _reach(root_mass, y):
    """The largest of numbers that the masses make comparable."""
    return _largest(jtu.tree_map(jnp.multiply, root_mass, y))


def _over(size, root_mass):
    """What is as large as `size` in a number; nothing where it has no mass."""
    return jnp.where(root_mass > 0, size / jnp.where(root_mass > 0, root_mass, 1.0), 0.0)


def _divided(y, units):
    return jtu.tree_map(jnp.divide, y, units)


def _first_positive(*sizes) -> Any:
    found = sizes[-1]
    for size in reversed(sizes[:-1]):
        found = jnp.where(size > 0, size, found)
    return found
