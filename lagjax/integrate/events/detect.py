"""Crossings inside steps: the sign of each guard is followed along the flow, and each crossing becomes a step's end.

A step of a method of high order is a good part of a period long, and a guard may cross zero within it and come back. So
after each accepted step the guards are followed between its ends, where q, v and a are known, along the quintic through
these, and along the cubics through (q, v) and (v, a): their distance bounds the error (it is the error of the cubic,
120/(ω h)² times that of the quintic). At a few nodes both give the guard g and its rate dg/dt, and each piece between
two nodes is one of three:

    clear      no zero: the four control points of the cubic through (g, dg/dt) at its ends (Bézier's polygon, in whose
               hull it lies) have one sign, by more than the error
    monotone   the rates and the polygon have one direction: the signs at its ends tell whether it crosses
    in doubt   anything else: an extremum near zero, or an interpolant that is too crude

A step without doubts and crossings is taken unchanged. Any other is taken in parts, each a step of the method from the
end of the previous part: if a piece is in doubt, up to the doubtful point (the extremum, or halfway); if a guard
crosses, up to the root, which Newton's formula on the flow finds in two or three steps. So the motion is evaluated in
one way only, by steps of the existing loop: a program has one copy of the equations, and in a batch no lane waits for
one that looks closer. The wrapped controller does not see the parts. It gets the step as a whole, and its answer is
kept until the last part is taken.

Of a crossing the time is kept without derivatives, and the state at that time with them: `event_times.py` gives both
the derivatives that follow from staying on the guard.

Everything is written guard by guard and node by node, on single numbers: on a CPU arrays of four are slower than four
numbers.

Source: Farouki & Rajan, Comput. Aided Geom. Des. 4 (1987) 191 (hulls); Hairer & Wanner, *Solving ODEs I*, §II.6 (dense
output by Hermite's formula); Shampine & Thompson, Appl. Math. Comput. 39 (2000) 43s (crossings inside a step).
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.events.brackets import (
    Followed,
    GuardRoot,
    GuardValue,
    Node,
    Pieces,
    Sight,
    StepPart,
    Watched,
    changes,
    first_root,
    last_known,
    next_node,
)
from lagjax.integrate.events.event import EventKind
from lagjax.jaxtools import apart, like, stop_gradient
from lagjax.mechanics import all_finite

# The most looks inside one step: an extremum takes three, a jump fifty.
LOOKS = 400
# After a part of a step in which guards had to be looked at closely, the next part is at most so many times as long.
GROWS = 4
# The most steps to find a root: Newton's formula takes three, bisection fifty; and what still counts as few.
ROOT_LOOKS, FEW_LOOKS = 100, 5
# An extremum is found if the remaining distance changes its height by less than this part; and the most attempts.
NEAR_EXTREMUM, EXTREMUM_LOOKS = 0.1, 8
# An interval this many resolutions of time long is not divided again.
NARROW = 16
# Roots this close to each other, in resolutions of time, count as simultaneous.
AT_ONCE = 4
# diffrax takes no step that ends within a hundred round-offs of the motion's end, except the one to the end itself.
NEAR_THE_LAST = 32


class Move(NamedTuple):
    """The decision about a step: whether it `takes` the part, where the next part ends (`at`), and what is known then.

    `crossed`: the guards that cross at the end of this part. `turns`: those known to turn there; `turns_left`: those
    found to turn at its start.
    """

    takes: Bool[Array, ""]
    at: Float[Array, ""]
    part: StepPart
    followed: tuple[Followed, ...]
    crossed: tuple[Bool[Array, ""], ...]
    turns: tuple[Bool[Array, ""], ...]
    turns_left: tuple[Bool[Array, ""], ...]


class Segment(NamedTuple):
    """The guards between the last part's end and this one's (see `Pieces`), the signs that are certain, and the first
    wanted root."""

    left: Node
    right: Node
    times: list
    of_guards: list[Pieces]
    in_doubt: list
    signs: list
    root: GuardRoot


class Follower(eqx.Module):
    """Follow the guards from one node of the motion to the next, whatever makes the steps. `last`: the final time."""

    sight: Sight
    last: Float[Array, ""]

    @property
    def kinds(self) -> tuple[EventKind, ...]:
        """The kinds of the guards."""
        return self.sight.guards.kinds

    @property
    def resolution(self) -> Float[Array, ""]:
        """The smallest difference of two times that can be told apart."""
        return self.sight.resolution

    def first(self, t: Array, y: PyTree) -> Watched:
        """What is known at the start: nothing."""
        t, (_, v) = stop_gradient((t, y))
        places, count = self.sight.guards.owners.size, len(self.kinds)
        no, zero, none = jnp.asarray(False), jnp.asarray(0), jnp.asarray(-1)
        part = StepPart(
            parted=no, until=t, following=t, jumps=no, looks=zero, asked=none, curvature=t, tries=zero,
            turns=(no,) * count, turns_at=t, root=GuardRoot(none, t, t, t, t, t), moved=t,
        )  # fmt: skip
        followed = (Followed(jnp.zeros_like(t), zero, no),) * count
        rows = jtu.tree_map(lambda x: jnp.broadcast_to(x, (places, *x.shape)), y)
        a, values = jtu.tree_map(jnp.zeros_like, v), self.sight.unseen(t).values
        return Watched(no, a, values, followed, jnp.full(places, jnp.nan, t.dtype), rows, part)

    # Jitted, so that it is traced once: diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def follow(self, keep, t0: Array, t1, y0: PyTree, y1: PyTree, args: PyTree, watched: Watched, until):
        """Whether a part of a step, from t0 to t1, is taken, where the next one ends, whether the motion ends now, and
        the new `Watched`; nothing changes unless `keep`. `until`: where the whole step ends."""
        fixed, part = stop_gradient(self), watched.part
        known = stop_gradient((t0, t1, y0, y1, args, watched._replace(y=None), until))
        move, a, values = fixed._move(keep, *known)
        takes, ended = keep & move.takes, jnp.asarray(False)
        counts = [f.count for f in watched.followed]
        crossed = [takes & c for c in move.crossed]
        owners, ranks = self.sight.guards.owners, self.sight.guards.ranks
        new = jnp.zeros(owners.size, bool)
        for i, (kind, count, c) in enumerate(zip(self.kinds, counts, crossed)):
            new = new | ((owners == i) & (ranks == count) & c)
            ended = ended | (c & kind.terminal)

        def with_new():
            here = lax.stop_gradient(t1), y1
            return jtu.tree_map(lambda x, all: jnp.where(like(new, all), x[None], all), here, (watched.t, watched.y))

        t, y = lax.cond(eqxi.unvmap_any(jnp.any(new)), with_new, lambda: (watched.t, watched.y))
        followed = tuple(f._replace(count=f.count + c.astype(f.count.dtype)) for f, c in zip(move.followed, crossed))
        begins = keep & ~watched.begun

        def with_turns(values, turns):
            return tuple(v._replace(turns=v.turns | x) for v, x in zip(values, turns))

        here, at_left = with_turns(values, move.turns), with_turns(watched.values, move.turns_left)
        a, values = _where(takes | begins, (a, here), (watched.a, at_left))
        later = Watched(watched.begun | keep, a, values, followed, t, y, move.part)

        def small(w):
            return w._replace(t=None, y=None)

        later = _where(keep, small(later), small(watched._replace(part=part)))._replace(t=t, y=y)
        return takes, move.at, ended, later

    def _at_last(self, t: Array, value: GuardValue, kind: EventKind) -> GuardValue:
        """A guard that comes within round-off of zero at the last time has crossed: a motion that continues from there
        starts on the guard, and does not cross it."""
        crossed = (t >= self.last) & self.sight.is_on(value) & (value.g * value.rate < 0) & (not kind.holds)
        return value._replace(g=jnp.where(crossed, -value.g, value.g))

    def _move(self, keep, t0: Array, t1, y0: PyTree, y1: PyTree, args: PyTree, watched: Watched, until):
        """The decision about a step from t0 to t1; and the acceleration and the guards at its end."""
        part, begins, kinds = watched.part, ~watched.begun, self.kinds
        # The first step is used to evaluate the guards at the start, and then taken again.
        t, y = _where(begins, (t0, y0), (t1, y1))
        a, _ = self.sight.rates(t, y)
        left = Node(t0, y0, watched.a, watched.values)
        right = self.sight.unseen(t)._replace(y=y, a=a)
        turns = [x & (t == part.turns_at) for x in part.turns]
        right = right._replace(values=tuple(v._replace(turns=x) for v, x in zip(right.values, turns)))
        values, times, inner = apart(self.sight.sample, left, right, args)
        values = tuple(self._at_last(t, value, kind) for value, kind in zip(values, kinds))
        right = right._replace(values=values)
        # A guard that holds counts as above zero from the start on: if it leaves zero below, it has crossed.
        touching = [jnp.asarray(kind.holds) & (f.sign == 0) for kind, f in zip(kinds, watched.followed)]
        of_guards = apart(self.sight.judged, left, right, inner, touching)
        doubts = [_any(p.doubt) for p in of_guards]
        # If doubts remain, only the signs at the ends are used.
        signs = [[jnp.where(x, 0.0, sign) for sign in p.sign[:-1]] + p.sign[-1:] for p, x in zip(of_guards, doubts)]
        since = [jnp.where(x, 1.0, f.sign) for x, f in zip(touching, watched.followed)]
        crosses = [changes(before, sign) for before, sign in zip(since, signs)]
        # Nothing to look at more closely, as in most steps of most motions.
        calm = watched.begun & (part.root.guard < 0) & (part.asked < 0) & ~_any(doubts + [_any(c) for c in crosses])
        nothing, at_end = (jnp.asarray(False),) * len(kinds), t1 >= until
        followed = tuple(f._replace(sign=last_known(f.sign, sign)) for f, sign in zip(watched.followed, signs))
        onward = Move(
            jnp.asarray(True), _grown(t0, t1, until), part._replace(looks=jnp.where(at_end, 0, part.looks + 1)),
            followed, nothing, nothing, nothing,
        )  # fmt: skip

        def closer():
            # While a root is sought, only the roots of other guards before it are of interest.
            others = [[c & (part.root.guard != i) for c in mine] for i, mine in enumerate(crosses)]
            root = apart(partial(first_root, kinds), times, of_guards, signs, others)
            segment = Segment(left, right, times, of_guards, doubts, signs, root)
            of_guards_now = zip(watched.followed, values, kinds)
            first = tuple(f._replace(sign=self.sight.first_sign(value, kind)) for f, value, kind in of_guards_now)
            ways = (apart(way, segment, watched, until) for way in (self._toward_root, self._looked))
            move = _where(part.root.guard >= 0, *ways)
            return _where(begins, Move(nothing[0], until, part, first, nothing, nothing, nothing), move)

        return lax.cond(eqxi.unvmap_all(calm | ~keep), lambda: onward, closer), a, values

    def _looked(self, segment: Segment, watched: Watched, until) -> Move:
        """Settle the interval between two nodes, or choose where to look next; if a guard crosses, go to the root."""
        part, left, right, no = watched.part, segment.left, segment.right, (jnp.asarray(False),) * len(self.kinds)
        again, at_extremum, turns, followed = apart(self._at_extremum, right, left, part, watched.followed, until)
        right = right._replace(values=tuple(v._replace(turns=v.turns | x) for v, x in zip(right.values, turns)))
        given_up = part.looks >= LOOKS
        # Bisected down to the resolution of time: a jump, whose time is then known.
        narrow = right.t - left.t <= NARROW * self.resolution
        root, following = segment.root, apart(next_node, left, right, segment.times, segment.of_guards, self.resolution)
        settled, takes, crosses = apart(self._settled, segment.in_doubt, again, narrow | given_up, root)
        looking = ~again & ~settled
        # If the interval starts beyond the guard already, the start is as near as a root can be.
        sign = _chosen(root.guard, [v.g for v in left.values]) * root.after
        begin = jnp.where((sign >= 0) & (root.low <= left.t), left.t + self.resolution, root.guess)
        at = jnp.where(again, at_extremum, jnp.where(following.needed, following.at, right.t))
        onward = jnp.where(narrow, until, _grown(left.t, right.t, until))
        at = jnp.where(takes, onward, jnp.where(crosses, self._inside(root, begin), at))
        none = jnp.asarray(-1)
        later = part._replace(
            looks=jnp.where(takes & (right.t >= until), 0, part.looks + 1),
            asked=jnp.where(again, part.asked, jnp.where(looking & following.needed, following.asked, none)),
            curvature=jnp.where(again, part.curvature, following.curvature),
            tries=jnp.where(again, part.tries + 1, 0),
            turns=tuple(looking & ~following.needed & x for x in following.turns_right),
            turns_at=right.t,
            root=root._replace(guard=jnp.where(crosses, root.guard, none)),
            moved=jnp.where(again, at - right.t, jnp.inf),
        )
        followed = tuple(
            Followed(jnp.where(takes, last_known(f.sign, s), f.sign), f.count, f.uncertain | (settled & x & given_up))
            for f, s, x in zip(followed, segment.signs, segment.in_doubt)
        )
        return Move(takes, at, later, followed, no, turns, tuple(looking & x for x in following.turns_left))

    def _settled(self, in_doubt, again, anyway, root: GuardRoot):
        """Whether no doubt is left; whether, in addition, nothing is crossed; or something is."""
        settled = ~again & (~_any(in_doubt) | anyway)
        return settled, settled & (root.guard < 0), settled & (root.guard >= 0)

    def _toward_root(self, segment: Segment, watched: Watched, until) -> Move:
        """One step of Newton's formula, or of bisection if that makes no progress; the part is taken at the root."""
        part, t, none = watched.part, segment.right.t, jnp.asarray(-1)
        no = (jnp.asarray(False),) * len(self.kinds)
        found, sooner, takes, onward, at = apart(self._nearer, segment, part)
        root, at_one_time, followed, crossing = part.root, AT_ONCE * self.resolution, [], []
        for i, (kind, f, v) in enumerate(zip(self.kinds, watched.followed, segment.right.values)):
            known = jnp.where(jnp.abs(v.g) > v.noise, jnp.sign(v.g), 0.0)
            known = jnp.where(jnp.asarray(kind.holds) & (f.sign == 0), jnp.maximum(known, 0.0), known)
            wanted = (f.sign != 0) & (True if kind.direction == 0 else kind.direction == -f.sign)
            close = jnp.abs(v.g) <= jnp.maximum(v.noise, at_one_time * jnp.abs(v.rate))
            together = wanted & ((close & (v.rate * f.sign < 0)) | (known == -f.sign))
            mine = found & ((root.guard == i) | together)
            sign = jnp.where(mine, -f.sign, jnp.where(found & (known != 0), known, f.sign))
            followed.append(f._replace(sign=jnp.where(found & (root.guard == i), root.after, sign)))
            crossing.append(mine)
        later = part._replace(
            looks=jnp.where(found & (t >= until), 0, part.looks),
            asked=none,
            tries=jnp.where(found | sooner, 0, part.tries + 1),
            turns=no,
            root=onward._replace(guard=jnp.where(found, none, onward.guard)),
            moved=jnp.where(found | sooner, jnp.inf, at - t),
        )
        return Move(takes, jnp.where(found, until, at), later, tuple(followed), tuple(crossing), no, no)

    def _nearer(self, segment: Segment, part: StepPart):
        """Whether the root is found, whether another one is `sooner`, whether the part is taken; the root to seek next,
        and where."""
        root, t = part.root, segment.right.t
        g, rate = (_chosen(root.guard, [getattr(v, name) for v in segment.right.values]) for name in ("g", "rate"))
        crossed = g * root.after >= 0
        low, high = jnp.where(crossed, root.low, jnp.maximum(root.low, t)), jnp.where(crossed, t, root.high)
        step = -g / jnp.where(rate != 0, rate, jnp.nan)
        narrow, size = high - low <= self.resolution, jnp.abs(step)
        # To the last digit, if round-off permits.
        small = size <= jnp.where(part.tries < FEW_LOOKS, 0.25, 1.0) * self.resolution
        found = small | (narrow & crossed) | (part.tries >= ROOT_LOOKS)
        found = found | (crossed & (t >= self.last) & (size <= NEAR_THE_LAST * self.resolution))
        # A guard that jumps is zero nowhere: the first time after the jump counts.
        nearer = (t + step > low) & (t + step < high) & (size <= 0.5 * jnp.abs(part.moved))
        at = jnp.where(narrow, high, jnp.where(nearer, t + step, low + 0.5 * (high - low)))
        # If another guard crosses on the way, the one sought is not the first. If two jump at the same time, neither is
        # sooner, whatever an interpolant says.
        earlier = segment.root
        before, limit = (x - AT_ONCE * self.resolution for x in (t, root.before))
        sooner = found & (earlier.guard >= 0) & (earlier.guess < before) & (t < limit)
        found = found & ~sooner
        # Near the end of the motion diffrax may step only halfway: if there is no root before, go on from there.
        takes = found | (~sooner & ~crossed & (t <= root.low))
        onward = _where(sooner, earlier._replace(before=t), root._replace(low=low, high=high))
        return found, sooner, takes, onward, jnp.where(sooner, self._inside(earlier, earlier.guess), at)

    def _inside(self, root: GuardRoot, at):
        """The time `at`, limited to the bracket of a root."""
        return jnp.clip(at, jnp.minimum(root.low + self.resolution, root.high), root.high)

    def _at_extremum(self, here: Node, left: Node, part: StepPart, followed, until):
        """Whether to look again for an extremum, and where; otherwise which guard turns here, if any."""
        g, rate = (_chosen(part.asked, [getattr(v, name) for v in here.values]) for name in ("g", "rate"))
        asked = part.asked >= 0
        shift = -rate / part.curvature
        there = (0.5 * jnp.abs(rate * shift) <= NEAR_EXTREMUM * jnp.abs(g)) | (jnp.abs(shift) <= self.resolution)
        at = here.t + shift
        # Otherwise the interpolants that led here were too crude, and the part before is examined with better ones.
        nearer = (at > left.t) & (at < until) & (jnp.abs(shift) <= 0.5 * jnp.abs(part.moved))
        again = asked & ~there & nearer & (part.tries < EXTREMUM_LOOKS) & (part.looks < LOOKS)
        mine, doubtful = [asked & there & (part.asked == i) for i in range(len(here.values))], []
        for f, turns, before, value in zip(followed, mine, left.values, here.values):
            # An extremum next to a start on the guard is that start.
            touches = turns & self.sight.touches(value) & ~self.sight.is_on(before)
            doubtful.append(f._replace(uncertain=f.uncertain | touches))
        return again, at, tuple(mine), tuple(doubtful)


class EventController(diffrax.AbstractStepSizeController):
    """Wrap `controller`: follow the guards through each step that it accepts, and end the solve at a terminal one.

    The controller's state is that of the wrapped one and a `Watched`, with the crossings.
    """

    controller: diffrax.AbstractStepSizeController
    follower: Follower

    def wrap(self, direction):
        """The same for time in this direction, which is always forward."""
        return EventController(self.controller.wrap(direction), self.follower)

    def init(self, terms: diffrax.AbstractTerm, t0: Array, t1, y0: PyTree, dt0, args: PyTree, func, error_order):
        """The first step."""
        t1, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        return t1, (inner, self.follower.first(t0, y0))

    def adapt_step_size(
        self, t0: Array, t1, y0: PyTree, y1_candidate: PyTree, args: PyTree, y_error: PyTree, error_order,
        controller_state: PyTree,
    ):  # fmt: skip
        """Whether to keep a step, or a part of one, and the next."""
        inner, watched = controller_state
        parted, resolution = watched.part.parted, self.follower.resolution
        keep, next_t0, next_t1, jumped, asked, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        # A part that fails, though the whole step did not, is halved: the controller has already accepted the step.
        failed = parted & ~all_finite(y_error)
        # With fixed steps `keep` is Python's True.
        keep = jnp.where(parted, ~failed, keep)
        before = watched.part.until, watched.part.following, watched.part.jumps
        until, following, jumps = _where(parted, before, (t1, next_t1, jnp.asarray(jumped)))
        state = t0, t1, y0, y1_candidate, args, watched, until
        unchanged = jnp.asarray(False), t1, jnp.asarray(False), watched
        takes, at, ended, watched = lax.cond(
            eqxi.unvmap_any(keep), lambda: self.follower.follow(keep, *state), lambda: unchanged
        )
        done = takes & (t1 >= until)
        ours = keep | failed
        # `until` replaces an equal `at`: the end of the whole step has derivatives by the output times.
        at = jnp.where(done, following, jnp.where(failed, t0 + 0.5 * (t1 - t0), jnp.where(at >= until, until, at)))
        part = watched.part._replace(parted=ours & ~done, until=until, following=following, jumps=jumps)
        result = diffrax.RESULTS.where(parted, diffrax.RESULTS.successful, result)
        result = diffrax.RESULTS.where(failed & (t1 - t0 <= resolution), diffrax.RESULTS.dt_min_reached, result)
        ended = ended & (result == diffrax.RESULTS.successful)
        return (
            takes,
            jnp.where(ours, jnp.where(takes, t1, t0), next_t0),
            jnp.where(ours, at, next_t1),
            # If False while tracing, diffrax omits what it does after a jump.
            jumped if jumped is False else done & jumps,
            (_where(parted, inner, asked), watched._replace(part=part)),
            diffrax.RESULTS.where(ended, diffrax.RESULTS.event_occurred, result),
        )


def _any(conditions):
    found = jnp.asarray(False)
    for condition in conditions:
        found = found | condition
    return found


def _chosen(i, values):
    found = values[0]
    for k, x in enumerate(values[1:], 1):
        found = jnp.where(i == k, x, found)
    return found


def _grown(t0: Array, t1, until):
    """The end of the part of a step after one from t0 to t1."""
    return jnp.minimum(until, t1 + GROWS * (t1 - t0))


def _where(condition: Callable, a, b):
    return jtu.tree_map(lambda a, b: jnp.where(condition, a, b), a, b)
