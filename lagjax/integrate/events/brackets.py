"""What is known of the guards: at one time, between two times at which the motion is known, and since the start.

See `detect.py` for how they are used, and for the source.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.events.event import EventKind, Guards
from lagjax.integrate.stepping import ProjectedSolver

# Where an interval is divided; not in the middle, since half a period after an extremum there is another one.
SHARES = (0.0, 0.45, 1.0)
PIECES, INNER = len(SHARES) - 1, SHARES[1:-1]
# The cubics over the pieces may miss this part of what a cubic over the whole interval misses of a guard.
BENT = 0.5
# A start on a guard is flat if the guard's rate there explains less than this part of its value at the next node.
FLAT = 1e-3
# Polynomials that multiply (x0, h dx0, h dx1, x1) in a cubic; and the one that goes from 0 to 1 with no rate, and no
# curvature, at its ends.
CUBIC = np.array([[1, 0, -3, 2], [0, 1, -2, 1], [0, 0, -1, 1], [0, 0, 3, -2]])
RISE = np.array([0, 0, 0, 10, -15, 6])


class GuardValue(NamedTuple):
    """A guard at a time: its value, its rate, the round-off of its value, and whether it is known to turn there.

    `still`: whether its rate is round-off; known only of guards that hold.
    """

    g: Float[Array, ""]
    rate: Float[Array, ""]
    noise: Float[Array, ""]
    turns: Bool[Array, ""]
    still: Bool[Array, ""]


class Node(NamedTuple):
    """The motion at a time, and each guard."""

    t: Float[Array, ""]
    y: PyTree
    a: PyTree
    values: tuple[GuardValue, ...]


class Followed(NamedTuple):
    """One guard so far: its sign (0 if not known yet), its number of crossings, and whether some may be missing."""

    sign: Float[Array, ""]
    count: Int[Array, ""]
    uncertain: Bool[Array, ""]


class GuardRoot(NamedTuple):
    """A crossing of a `guard` (-1: none) between `low` and `high`, with the sign `after` it and a `guess` of its time.

    `before`: if the root of another guard was found, which is not the first root, the time of that one.
    """

    guard: Int[Array, ""]
    low: Float[Array, ""]
    high: Float[Array, ""]
    after: Float[Array, ""]
    guess: Float[Array, ""]
    before: Float[Array, ""]


class StepPart(NamedTuple):
    """The step under way, which is taken in parts if it is `parted`.

    `until`: its end; `following`: the end of the next step, as the wrapped controller chose it, and `jumps`: whether
    there is a jump between the two. `looks`: how often the step was looked into. `asked`: the guard (-1: none) expected
    to have an extremum where the part ends, with this `curvature`. `tries`: attempts to find that extremum or the
    `root`; `moved`: how far the last one moved. `turns`: the guards that are known to turn at the time `turns_at`.
    """

    parted: Bool[Array, ""]
    until: Float[Array, ""]
    following: Float[Array, ""]
    jumps: Bool[Array, ""]
    looks: Int[Array, ""]
    asked: Int[Array, ""]
    curvature: Float[Array, ""]
    tries: Int[Array, ""]
    turns: tuple[Bool[Array, ""], ...]
    turns_at: Float[Array, ""]
    root: GuardRoot
    moved: Float[Array, ""]


class Watched(NamedTuple):
    """What is known up to the end of the last part of a step; nothing yet unless `begun`.

    `a`, `values`: the acceleration and the guards there; `followed`: each guard so far; `t`, `y`: the times and states
    of the crossings, S in all, NaN for those still to come; `part`: the step under way.
    """

    begun: Bool[Array, ""]
    a: PyTree
    values: tuple[GuardValue, ...]
    followed: tuple[Followed, ...]
    t: Float[Array, " S"]
    y: PyTree[Float[Array, "S ..."]]
    part: StepPart


class Pieces(NamedTuple):
    """One guard between two nodes: values and rates at all nodes, and whether the rates are `known`; the signs at all
    nodes except the first, 0 if not known; which pieces are in `doubt`."""

    g: list
    rate: list
    known: list
    sign: list
    doubt: list


def pieces_of(begin: GuardValue, inner, off, end: GuardValue, h: Array, touches, at_zero, close) -> Pieces:
    """The pieces of an interval of length h between exact ends; `off`: the errors of the inner nodes (value, rate).

    A piece that comes nearer to zero than `touches` is not clear; nor is one longer than `close` to an end whose rate
    is infinite or unknown. A guard that holds, and has not left zero since the start, has no sign up to `at_zero` from
    it, and is clear as long as it does not fall below that (-inf: any other).
    """
    zero, yes, lengths = jnp.zeros_like(h), jnp.asarray(True), [h * float(x) for x in np.diff(SHARES)]
    g = [begin.g, *(x for x, _ in inner), end.g]
    rate = [jnp.where(v.turns, 0.0, v.rate) for v in (begin, end)]
    # At its very end a slope may be infinite, as that of arccos, or not known: close to it, the polygon takes that of
    # the inner node, and is judged by how well it fits.
    unknown_slope = [~jnp.isfinite(x) & (h > close) for x in rate]
    near = inner[0][1], inner[-1][1]
    rate = [jnp.where(jnp.isfinite(x), x, beside) for x, beside in zip(rate, near)]
    rate = [rate[0], *(x for _, x in inner), rate[1]]
    error = [zero, *(x for x, _ in off), zero]
    # The ends are known to all digits: a guard whose rate is zero there turns there.
    known = [yes, *(jnp.abs(dx) > d for (_, dx), (_, d) in zip(inner, off)), yes]
    sign = [jnp.where(jnp.abs(x) > e, jnp.sign(x), 0.0) for x, e in zip(g, error)]
    sign[-1] = jnp.where(jnp.abs(end.g) > end.noise, sign[-1], 0.0)
    sign = [jnp.where(jnp.abs(x) <= at_zero, 0.0, s) for x, s in zip(g, sign)]
    rate_sign = [jnp.sign(x) for x in rate]
    monotone, direction, doubt, stays = [], [], [], []
    bent = BENT * _bend(g, rate, h)
    for i in range(PIECES):
        third = lengths[i] / 3
        one, two, three, four = g[i], g[i] + third * rate[i], g[i + 1] - third * rate[i + 1], g[i + 1]
        largest = jnp.maximum(error[i], error[i + 1]) + touches + bent
        lowest = jnp.minimum(jnp.minimum(one, two), jnp.minimum(three, four))
        highest = jnp.maximum(jnp.maximum(one, two), jnp.maximum(three, four))
        stays.append(lowest >= jnp.maximum(error[i], error[i + 1]) + bent - at_zero)
        clear = (lowest > largest) | (highest < -largest) | stays[i]
        direction.append(jnp.sign(rate_sign[i] + rate_sign[i + 1]))
        same = known[i] & known[i + 1] & (direction[i] != 0) & (rate_sign[i] * rate_sign[i + 1] >= 0)
        rises = (three - two) * direction[i] >= bent
        if i == 0:
            # No polygon rises from a start on the guard at rate zero, as t³ has.
            flat = (jnp.abs(one) <= jnp.maximum(begin.noise, at_zero)) & (
                third * jnp.abs(rate[0]) <= FLAT * jnp.abs(four)
            )
            rises = rises | (flat & (sign[1] == direction[0]))
        monotone.append(same & rises)
        doubt.append(~(clear | monotone[i]))
    doubt[0], doubt[-1] = doubt[0] | unknown_slope[0], doubt[-1] | unknown_slope[1]
    for i in range(1, PIECES):
        # The sign must be known where one monotone run ends and another begins, but not inside a run.
        inside = monotone[i - 1] & monotone[i] & (direction[i - 1] == direction[i])
        unknown = (sign[i] == 0) & ~inside & ~(stays[i - 1] & stays[i])
        doubt[i - 1], doubt[i] = doubt[i - 1] | unknown, doubt[i] | unknown
    return Pieces(g, rate, known, sign[1:], doubt)


def without_rest(pieces: Pieces, begin: GuardValue, end: GuardValue, inner, h: Array) -> Pieces:
    """The same, without doubts where the guard is zero all along, to round-off."""
    noise = jnp.maximum(begin.noise, end.noise)
    rests = jnp.asarray(True)
    for g, rate in [(begin.g, begin.rate), (end.g, end.rate), *inner]:
        rests = rests & (jnp.abs(g) <= noise) & (jnp.abs(h * rate) <= noise)
    return pieces._replace(doubt=[doubt & ~rests for doubt in pieces.doubt])


def _bend(g, rate, h: Array):
    """How far a guard and its rate at the inner nodes are from the cubic through both ends."""
    off = jnp.zeros_like(h)
    ends = g[0], h * rate[0], h * rate[-1], g[-1]
    for x, dx, share in zip(g[1:-1], rate[1:-1], INNER):
        powers = share ** np.arange(4)
        value, slope = CUBIC @ powers, np.polynomial.polynomial.polyder(CUBIC, axis=1) @ powers[:3]

        def by(weights):
            return sum(w * x for w, x in zip(weights.tolist(), ends))

        off = jnp.maximum(off, jnp.maximum(jnp.abs(x - by(value)), jnp.abs(h * dx - by(slope))))
    return off


def between(left: Node, right: Node, h: Array):
    """(state, acceleration) at the inner nodes, by the quintic, and by the cubics through (q, v) and (v, a).

    The quintic is the integral of the cubic through (v, a), and what that misses of the way from q0 to q1. What it
    misses within round-off of q says nothing, and over a short step would make velocities of it.
    """
    inverse = 1 / jnp.where(h > 0, h, 1.0)

    def at(share: float, q0, v0, a0, q1, v1, a1):
        def by(polynomials, derivatives, *ends):
            powers = _derived(polynomials, derivatives)
            weights = powers @ share ** np.arange(powers.shape[-1])
            return sum(w * x for w, x in zip(np.ravel(weights).tolist(), ends) if w)

        of_v = v0, h * a0, h * a1, v1
        missed = q1 - q0 - h * (0.5 * (v0 + v1) + h * (a0 - a1) / 12)
        digit = ROUNDED * jnp.finfo(h.dtype).eps * (jnp.abs(q0) + jnp.abs(q1))
        missed = jnp.where(jnp.abs(missed) > digit, missed, 0.0)
        v, a = by(CUBIC, 0, *of_v), inverse * by(CUBIC, 1, *of_v)
        fine = (
            q0 + h * by(CUBIC, -1, *of_v) + by(RISE, 0, missed),
            v + inverse * by(RISE, 1, missed),
            a + inverse**2 * by(RISE, 2, missed),
        )
        return fine, (by(CUBIC, 0, q0, h * v0, h * v1, q1), v, a)

    fine, coarse = [], []
    (q0, v0), (q1, v1), leaves = left.y, right.y, jtu.tree_leaves
    structure = jtu.tree_structure(q0)
    for share in INNER:
        found = [at(share, *x) for x in zip(*map(leaves, (q0, v0, left.a, q1, v1, right.a)))]
        for one, of_leaves in zip((fine, coarse), zip(*found)):
            q, v, a = (jtu.tree_unflatten(structure, x) for x in zip(*of_leaves))
            one.append(((q, v), a))
    return fine, coarse


def _derived(polynomials: np.ndarray, derivatives: int) -> np.ndarray:
    """Their derivative of this order; -1: the integral from zero."""
    of = np.polynomial.polynomial
    return of.polyint(polynomials, axis=-1) if derivatives < 0 else of.polyder(polynomials, derivatives, axis=-1)


def first_root(kinds, times, of_guards, signs, crosses) -> GuardRoot:
    """The first wanted crossing of all guards; `crosses`: the nodes at which the sign of each guard changes."""
    infinite = jnp.full_like(times[0], jnp.inf)
    start = times[0], of_guards[0].g[0], of_guards[0].rate[0]
    guard, at, begin, end, after = jnp.asarray(-1), infinite, start, start, jnp.zeros_like(infinite)
    for i, (kind, p, sign, crossed) in enumerate(zip(kinds, of_guards, signs, crosses)):
        since = times[0], p.g[0], p.rate[0]
        for node, new, changed in zip(zip(times[1:], p.g[1:], p.rate[1:]), sign, crossed):
            wanted = changed & (True if kind.direction == 0 else kind.direction == new)
            (t0, g0, _), (t1, g1, _) = since, node
            secant = t0 + (t1 - t0) * jnp.clip(g0 / jnp.where(g0 != g1, g0 - g1, 1.0), 0.0, 1.0)
            sooner = wanted & (secant < at)
            found, before = (jnp.asarray(i), secant, since, node, new), (guard, at, begin, end, after)
            guard, at, begin, end, after = jtu.tree_map(lambda x, y: jnp.where(sooner, x, y), found, before)
            # Secants start from the last node whose sign is known.
            since = tuple(jnp.where(new != 0, x, y) for x, y in zip(node, since))
    return GuardRoot(guard, begin[0], end[0], after, root_of_cubic(begin, end), infinite)


def root_of_cubic(begin, end):
    """The time at which the cubic through two (t, g, dg/dt) is zero."""
    (t0, g0, rate0), (t1, g1, rate1) = begin, end
    h = t1 - t0
    c1, c2, c3 = h * rate0, 3 * (g1 - g0) - h * (2 * rate0 + rate1), 2 * (g0 - g1) + h * (rate0 + rate1)
    x = jnp.clip(g0 / jnp.where(g0 != g1, g0 - g1, 1.0), 0.0, 1.0)
    for _ in range(3):
        slope = c1 + x * (2 * c2 + x * 3 * c3)
        x = jnp.clip(x - (g0 + x * (c1 + x * (c2 + x * c3))) / jnp.where(slope != 0, slope, 1.0), 0.0, 1.0)
    # Where a rate is infinite, as that of sqrt(t) at 0, there is no cubic.
    return t0 + jnp.where(jnp.isfinite(x), x, 0.5) * h


def changes(sign, signs):
    """The nodes at which a known sign differs from the last known one, which is `sign` at first."""
    changed = []
    for there in signs:
        changed.append((there != 0) & (sign != 0) & (there != sign))
        sign = jnp.where(there != 0, there, sign)
    return changed


def last_known(sign, signs):
    """The last sign that is known."""
    for there in signs:
        sign = jnp.where(there != 0, there, sign)
    return sign


class Next(NamedTuple):
    """Where to look `at` next, if `needed`, for which guard (`asked`); or which guards turn at an end that is known."""

    needed: Bool[Array, ""]
    at: Float[Array, ""]
    asked: Int[Array, ""]
    curvature: Float[Array, ""]
    turns_left: tuple[Bool[Array, ""], ...]
    turns_right: tuple[Bool[Array, ""], ...]


def next_node(left_end: Node, right_end: Node, times, of_guards, resolution: Array) -> Next:
    """Where to look next for the first guard in doubt, in its first piece in doubt: at the extremum, or halfway."""
    none, halfway = jnp.asarray(False), left_end.t + 0.5 * (right_end.t - left_end.t)
    found = Next(jnp.asarray(True), halfway, jnp.asarray(-1), jnp.ones_like(halfway), (), ())
    turns_left, turns_right = [none] * len(of_guards), [none] * len(of_guards)
    still_open = jnp.asarray(True)
    for i, p in enumerate(of_guards):
        for j, doubt in enumerate(p.doubt):
            mine, still_open = still_open & doubt, still_open & ~doubt
            left, right, length = p.rate[j], p.rate[j + 1], times[j + 1] - times[j]
            turning = mine & p.known[j] & p.known[j + 1] & (left * right < 0)
            at = times[j] + length * left / jnp.where(turning, left - right, 1.0)
            turning = turning & jnp.isfinite(at)
            # An extremum within the resolution of a known end is that end.
            at_left = turning & (at - left_end.t <= resolution)
            at_right = turning & ~at_left & (right_end.t - at <= resolution)
            turns_left[i], turns_right[i] = turns_left[i] | at_left, turns_right[i] | at_right
            inside = turning & ~(at_left | at_right)
            found = found._replace(
                needed=found.needed & ~(at_left | at_right),
                at=jnp.where(inside, at, found.at),
                asked=jnp.where(inside, i, found.asked),
                curvature=jnp.where(inside, (right - left) / length, found.curvature),
            )
    return found._replace(turns_left=tuple(turns_left), turns_right=tuple(turns_right))


# The error is taken to be this many times the distance of the two interpolants.
SAFETY = 2.0
# Round-off of a guard, in units of the change that its arguments' last digit makes; and that of a start on the guard.
ROUNDED, ON_GUARD = 8, 64
# A guard that holds may begin so many times as far below zero as it is on it.
BELOW = 4
# An extremum within this many tolerances of zero may be on either side of it.
TOUCHES = 10.0


class Sight(eqx.Module):
    """The guards along a motion; `resolution`: the smallest difference of two times that can be told apart."""

    guards: Guards
    motion: ProjectedSolver
    resolution: Float[Array, ""]

    def value(self, t: Array, y: PyTree, args: PyTree):
        """The value of each guard at one state."""
        multipliers = self.motion.rates(t, y)[1] if self.guards.take_multipliers else {}
        return self.guards(t, *y, multipliers, args)

    def sample(self, left: Node, right: Node, args: PyTree):
        """The guards at `right`; the ends of the pieces between the two nodes; and each guard at the inner ones, by the
        quintic and by the cubics."""
        h = right.t - left.t
        times = [left.t, *(left.t + share * h for share in INNER), right.t]
        one, (fine, coarse) = jnp.ones_like(h), between(left, right, h)
        states = [(right.t, right.y, right.a), *((t, *state) for t, state in zip(times[1:-1] * 2, fine + coarse))]
        places, along = [(t, y) for t, y, _ in states], [(one, (y[1], a)) for _, y, a in states]
        # Along the state itself, to see how its last digit changes the guards.
        places, along = [*places, places[0]], [*along, (right.t, uneven(right.y))]
        holds = [kind.holds for kind in self.guards.kinds]
        if any(holds):
            # And how the last digits of v and a change the rates.
            places, along = [*places, places[0]], [*along, (jnp.zeros_like(h), uneven((right.y[1], right.a)))]
        (g, rate), *found = self._along(places, along, args)
        _, digits_of_rate = found.pop() if any(holds) else (g, rate)
        _, digits = found.pop()
        eps = ROUNDED * jnp.finfo(h.dtype).eps
        still = [
            jnp.asarray(hold) & (jnp.abs(dx) <= ON_GUARD * eps * jnp.abs(d))
            for hold, dx, d in zip(holds, rate, digits_of_rate)
        ]
        # Where the slope is infinite, half of the digits remain.
        half = jnp.sqrt(eps)
        noise = [
            jnp.where(jnp.isfinite(d), eps * (jnp.abs(d) + jnp.abs(x)), half * jnp.abs(x)) for x, d in zip(g, digits)
        ]
        values = tuple(
            GuardValue(x, dx, off, turning.turns, at_rest)
            for x, dx, off, turning, at_rest in zip(g, rate, noise, right.values, still)
        )
        return values, times, [[(x[i], dx[i]) for x, dx in found] for i in range(len(values))]

    def _along(self, places, directions, args: PyTree):
        """The guards at places (t, y), and their derivatives along one direction for each place: pairs of tuples."""

        def push(place, direction):
            return self._known(*jax.jvp(lambda t, y: self.value(t, y, args), place, direction))

        if not self.guards.long:
            return [push(*x) for x in zip(places, directions)]
        together = jtu.tree_map(lambda *x: jnp.stack(x), *zip(places, directions))
        # One place after the other: in lanes XLA copies what operations share, and takes a quarter longer.
        found = lax.map(lambda along: push(*along), together)
        return [jtu.tree_map(lambda x: x[i], found) for i in range(len(places))]

    def _known(self, g, rate):
        """The guards and their rates, without infinite slopes and NaN where a guard may not stop the motion."""

        def finite(x, other):
            return jnp.where(jnp.isfinite(x), x, other)

        may_rest = [kind.may_rest for kind in self.guards.kinds]
        return (
            tuple(finite(x, 1.0) if rests else x for x, rests in zip(g, may_rest)),
            tuple(finite(x, 0.0) if rests else x for x, rests in zip(rate, may_rest)),
        )

    def unseen(self, t: Array) -> Node:
        """A node at which nothing is known yet."""
        zero, no = jnp.zeros_like(t), jnp.asarray(False)
        return Node(t, None, None, (GuardValue(zero, zero, zero, no, no),) * len(self.guards.kinds))

    def judged(self, left: Node, right: Node, inner, touching) -> list[Pieces]:
        """Each guard between two nodes, from its values at the inner ones by the quintic and by the cubics.

        `touching`: the guards that have not left zero since the start, see `Pieces`.
        """
        found, h, count = [], right.t - left.t, len(INNER)
        close = self.resolution / jnp.sqrt(jnp.finfo(h.dtype).eps)
        for kind, begin, end, by_both, at_zero in zip(self.guards.kinds, left.values, right.values, inner, touching):
            pairs = zip(by_both[:count], by_both[count:])
            off = [tuple(SAFETY * jnp.abs(x - z) for x, z in zip(*pair)) for pair in pairs]
            steepest = jnp.maximum(*(jnp.where(jnp.isfinite(x.rate), jnp.abs(x.rate), 0.0) for x in (begin, end)))
            touches = TOUCHES * self.motion.tolerances.rtol[0] * h * steepest
            # What neither opens nor closes stays where it is; what opens may begin a little below.
            zero = jnp.maximum(jnp.maximum(self.at_zero(begin), self.at_zero(end)), -begin.g)
            zero = jnp.where(begin.still & end.still, jnp.inf, zero)
            zero = jnp.where(at_zero, zero, -jnp.inf)
            pieces = pieces_of(begin, by_both[:count], off, end, h, touches, zero, close)
            found.append(without_rest(pieces, begin, end, by_both, h) if kind.may_rest else pieces)
        return found

    def first_sign(self, value: GuardValue, kind: EventKind):
        """The sign at the start of the motion: 0 if the start is on the guard."""
        on_guard = self.is_on(value)
        if kind.holds:
            # A crossing ends a phase where it leaves round-off: the next one begins a little below.
            return jnp.where(jnp.abs(value.g) <= BELOW * self.at_zero(value), 0.0, 1.0)
        return jnp.where(on_guard | ~jnp.isfinite(value.g), 0.0, jnp.sign(value.g))

    def is_on(self, value: GuardValue):
        """Whether a state is on a guard, within round-off."""
        return jnp.abs(value.g) <= self.at_zero(value)

    def at_zero(self, value: GuardValue):
        """How far from zero a guard may be, by round-off, where a motion starts on it."""
        return ON_GUARD * (value.noise + jnp.abs(value.rate) * self.resolution)

    def touches(self, value: GuardValue):
        """Whether an extremum with this value may be on either side of zero."""
        eps = ROUNDED * jnp.finfo(value.g.dtype).eps
        return jnp.abs(value.g) <= value.noise * jnp.maximum(TOUCHES * self.motion.tolerances.rtol[0] / eps, 1.0)


def uneven(y: PyTree):
    """The state with each number times a different factor near one, so that sums of parts do not cancel."""
    leaves, structure = jtu.tree_flatten(y)
    scaled = []
    for i, x in enumerate(leaves):
        factor = 0.5 + np.mod(0.618 * (np.arange(x.size) + 1) + 0.377 * i, 1.0)
        scaled.append(x * factor.reshape(x.shape).astype(x.dtype))
    return jtu.tree_unflatten(structure, scaled)
