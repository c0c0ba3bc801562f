"""Crossings inside steps: the sign of each guard is followed along the flow.

A step of a method of high order is a good part of a period long, and a guard may cross zero in it and come back. So
after each accepted step the guards are followed between its ends, where q, v and a are known, along the quintic that
fits them, with the cubics through (q, v) and (v, a) beside it: their distance bounds the error (it is the error of the
cubic, 120/(ω h)² times that of the quintic). At a few nodes both give the guard g and its rate dg/dt, and each piece
between two nodes is one of three:

    clear      no zero: the four control points of the cubic through (g, dg/dt) at its ends (Bézier's polygon, in whose
               hull it lies) have one sign, by more than the error
    monotone   the rates and the polygon have one direction: the signs at its ends tell whether it crosses
    in doubt   anything else: an extremum near zero, or an interpolant that is too crude

Where a piece is in doubt the motion itself is asked, by a step of the method from the step's start to a time in there:
at the extremum, or halfway. The interval up to that time is looked at first, and then the rest. So a step without
doubts costs one acceleration and a few guards; an extremum near zero costs two or three steps, however near it is; what
jumps is narrowed down by halves.

Nothing here is differentiated. Of a crossing the step's start and two times that enclose it are kept, and
`crossing_times.py` finds it on the flow once the loop is over.

All is written guard by guard and node by node, on single numbers: on a CPU arrays of four are slower than four numbers.

Source: Farouki & Rajan, Comput. Aided Geom. Des. 4 (1987) 191 (hulls); Hairer & Wanner, *Solving ODEs I*, §II.6 (dense
output by Hermite's formula); Shampine & Thompson, Appl. Math. Comput. 39 (2000) 43s (crossings inside a step).
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.jax_internals.one_function import called
from lagjax.motion.consistency import stopped
from lagjax.motion.crossings import Guards, Kind
from lagjax.motion.pieces import (
    INNER,
    Enclosed,
    Followed,
    Kept,
    Node,
    Pieces,
    Value,
    Watched,
    between,
    changes,
    last_known,
    next_look,
    pieces_of,
    root_of_cubic,
)
from lagjax.motion.stepping import OnManifold

# The distance of the two interpolants, times this, is taken for the error.
SAFETY = 2.0
# How often to look inside one step: an extremum takes three, a jump fifty.
LOOKS = 200
# An extremum is where it is believed to be if what is left changes its height by less than this part.
NEAR_EXTREMUM, EXTREMUM_LOOKS = 0.1, 8
# What rounding leaves of a guard, in units of the change that its arguments' last digit makes; and of a start on it.
ROUNDED, ON_GUARD = 8, 64
# An extremum within so many tolerances of zero may be on either side of it.
TOUCHES = 10.0
# An interval of so many resolutions of time is not parted again.
NARROW = 16
# Where to look: at the step's start, at its end, or inside by a step of the method.
AT_START, AT_END, INSIDE = 0, 1, 2


class Search(NamedTuple):
    """The search in one step: all before `left` is settled, and the interval up to `right` is looked at.

    The next look is `at` a time, of the kind `where`, if `look`. There the guard `asked` (-1: none) is believed to have
    an extremum, with this `curvature`, for the `tries`th time.
    """

    left: Node
    right: Node
    end: Node
    look: Bool[Array, ""]
    where: Int[Array, ""]
    at: Float[Array, ""]
    asked: Int[Array, ""]
    curvature: Float[Array, ""]
    tries: Int[Array, ""]
    looks: Int[Array, ""]
    done: Bool[Array, ""]
    followed: tuple[Followed, ...]
    enclosed: Enclosed


class Watching(diffrax.AbstractStepSizeController):
    """Wrap `controller`: follow the guards through each step that it accepts, and end the solve at a terminal one.

    What was found is the controller's state, a pair of the wrapped one's and a `Watched`. `resolution`: how near two
    times can be told apart.
    """

    controller: diffrax.AbstractStepSizeController
    guards: Guards
    motion: OnManifold
    resolution: Float[Array, ""]

    def wrap(self, direction):
        """The same for time in this direction, which is always forward."""
        return Watching(self.controller.wrap(direction), self.guards, self.motion, self.resolution)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first step."""
        t1, inner = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        (t, (q, v)), places = stopped((t0, y0)), self.guards.owners.size
        zero, no, nothing = jnp.zeros_like(t), jnp.asarray(False), jnp.full(places, jnp.nan, t.dtype)
        node = self._unseen(t, (q, v), jtu.tree_map(jnp.zeros_like, v))
        rows = jtu.tree_map(lambda x: jnp.broadcast_to(x, (places, *x.shape)), y0)
        kept = Kept(nothing, rows, Enclosed(*[nothing] * len(Enclosed._fields)))
        followed = (Followed(zero, jnp.asarray(0), no),) * len(self.guards.kinds)
        return t1, (inner, Watched(no, node, followed, kept))

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Whether to keep a step, and the next one."""
        inner, watched = controller_state
        keep, next_t0, next_t1, jumped, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        # With fixed steps it is Python's True.
        keep = jnp.asarray(keep)
        follow = lambda: self._follow(keep, t0, t1, y0, y1_candidate, args, watched)
        watched = lax.cond(eqxi.unvmap_any(keep), follow, lambda: watched)
        counts = [f.count for f, kind in zip(watched.followed, self.guards.kinds) if kind.terminal]
        ended = keep & (sum(counts) > 0) & (result == diffrax.RESULTS.successful)
        result = diffrax.RESULTS.where(ended, diffrax.RESULTS.event_occurred, result)
        return keep, next_t0, next_t1, jumped, (inner, watched), result

    # Jitted, so that it is traced once: diffrax traces the body of its loop three times.
    @eqx.filter_jit
    def _follow(self, keep, t0, t1, y0, y1, args, watched: Watched) -> Watched:
        fixed, step = stopped(self), stopped((keep, t0, t1, y0, y1, args, watched))
        if self.guards.long:
            return self._with_starts(fixed._search(*step), keep, t0, y0, watched)
        quiet, end, followed = fixed._at_a_glance(*step)
        after = watched._replace(end=end, followed=followed)
        search = lambda: self._with_starts(fixed._search(*step), keep, t0, y0, watched)
        return lax.cond(eqxi.unvmap_all(quiet | ~keep), lambda: after, search)

    def _at_a_glance(self, keep, t0, t1, y0, y1, args, watched: Watched):
        """Whether a step is seen at once to have no crossing; and then its end, and what is known of the guards."""
        # What is not finite is in doubt.
        a, _ = self.motion.rates(t1, y1, believe=True)
        values, _, inner = self._seen(watched.end, self._unseen(t1, y1, a), args)
        of_guards = _apart(self._judged, watched.end, Node(t1, y1, a, values), inner)
        signs = [(f.sign, p.sign) for f, p in zip(watched.followed, of_guards)]
        noticed = _any([_any(p.doubt + changes(*x)) for p, x in zip(of_guards, signs)])
        followed = tuple(f._replace(sign=last_known(*x)) for f, x in zip(watched.followed, signs))
        now = _where(keep, (Node(t1, y1, a, values), followed), (watched.end, watched.followed))
        return watched.begun & ~noticed, *now

    def _with_starts(self, found: Search, keep, t0, y0, watched: Watched) -> Watched:
        """What a search found, with the start of the step that it was in."""
        new = self._places([f.count for f in watched.followed], [f.count for f in found.followed])

        def with_start():
            at_start = lambda x, all: jnp.where(new.reshape(-1, *[1] * x.ndim), x[None], all)
            return jtu.tree_map(at_start, (t0, y0), (watched.kept.t0, watched.kept.y0))

        fresh = eqxi.unvmap_any(jnp.any(new))
        starts = lax.cond(fresh, with_start, lambda: (watched.kept.t0, watched.kept.y0))
        return Watched(watched.begun | keep, found.end, found.followed, Kept(*starts, found.enclosed))

    def _places(self, counts, later):
        """Which of all places are those of crossings from `counts` to `later`, by guard."""
        of_guards = zip(self.guards.kinds, counts, later)
        ranks = ((np.arange(kind.most), a, b) for kind, a, b in of_guards)
        return jnp.concatenate([(rank >= a) & (rank < b) for rank, a, b in ranks])

    def _search(self, keep, t0, t1, y0, y1, args, watched) -> Search:
        start = watched.end
        search = Search(
            left=start, right=start, end=start, look=keep, where=jnp.where(watched.begun, AT_END, AT_START),
            at=jnp.where(watched.begun, t1, t0), asked=jnp.asarray(-1), curvature=jnp.ones_like(t1),
            tries=jnp.asarray(0), looks=jnp.asarray(0), done=~keep, followed=watched.followed,
            enclosed=watched.kept.enclosed,
        )  # fmt: skip

        def look(s: Search) -> Search:
            looks = s.look & ~s.done
            begins, ends, inside = (looks & (s.where == kind) for kind in (AT_START, AT_END, INSIDE))
            flow = lambda: self.motion.flow(t0, y0, s.at)
            y = lax.cond(eqxi.unvmap_any(inside), flow, lambda: y1)
            y = _where(begins, y0, _where(ends, y1, y))
            a = lax.cond(eqxi.unvmap_any(looks), lambda: self.motion.rates(s.at, y)[0], lambda: s.right.a)
            right = _where(looks, self._unseen(s.at, y, a), s.right)
            values, times, inner = _apart(self._seen, s.left, right, args, with_noise=True)
            right = right._replace(values=_where(looks, values, right.values))
            begun = zip(s.followed, right.values, self.guards.kinds)
            signs = (jnp.where(begins, self._first_sign(x, k), f.sign) for f, x, k in begun)
            s = s._replace(
                left=_where(begins, right, s.left), right=right, end=_where(ends, right, s.end), looks=s.looks + 1,
                followed=tuple(f._replace(sign=sign) for f, sign in zip(s.followed, signs)),
            )  # fmt: skip
            again, s = _apart(self._at_extremum, s, looks)
            of_guards = _apart(self._judged, s.left, s.right, inner)
            judged = self._judge(s, ~(again | begins | s.done), times, of_guards)
            onward = s._replace(
                look=jnp.asarray(True),
                where=jnp.where(begins, AT_END, INSIDE),
                at=jnp.where(begins, t1, s.at),
                enclosed=judged.enclosed,
            )
            # What is enclosed has been chosen already, and is long.
            few = lambda s: s._replace(enclosed=None)
            return _where(again | begins, few(onward), few(judged))._replace(enclosed=judged.enclosed)

        return lax.while_loop(lambda s: ~s.done, look, search)

    def value(self, t, y, args):
        """Each guard at one state."""
        multipliers = self.motion.rates(t, y)[1] if self.guards.take_multipliers else {}
        return self.guards(t, *y, multipliers, args)

    def _seen(self, left: Node, right: Node, args, with_noise=False):
        """The guards at `right`; the ends of the pieces between the two nodes; and each guard at the inner ones, by the
        quintic and by the cubics."""
        h = right.t - left.t
        times = [left.t, *(left.t + share * h for share in INNER), right.t]
        one, (fine, coarse) = jnp.ones_like(h), between(left, right, h)
        states = [(right.t, right.y, right.a), *((t, *state) for t, state in zip(times[1:-1] * 2, fine + coarse))]
        places, along = [(t, y) for t, y, _ in states], [(one, (y[1], a)) for _, y, a in states]
        if with_noise:
            # Along the state itself, to see what its last digit makes of the guards.
            places, along = [*places, places[0]], [*along, (right.t, uneven(right.y))]
        (g, rate), *found = self._along(places, along, args)
        digits = found.pop()[1] if with_noise else [jnp.zeros_like(h)] * len(g)
        eps = ROUNDED * jnp.finfo(h.dtype).eps
        values = tuple(
            Value(x, dx, eps * (jnp.abs(d) + jnp.abs(x)), turning.turns)
            for x, dx, d, turning in zip(g, rate, digits, right.values)
        )
        return values, times, [[(x[i], dx[i]) for x, dx in found] for i in range(len(values))]

    def _along(self, places, directions, args):
        """The guards at places (t, y), and their derivatives along a direction each: pairs of tuples."""
        push = lambda place, direction: jax.jvp(lambda t, y: self.value(t, y, args), place, direction)
        if not self.guards.long:
            return [push(*x) for x in zip(places, directions)]
        together = jtu.tree_map(lambda *x: jnp.stack(x), *zip(places, directions))
        found = jax.vmap(push)(*together)
        return [jtu.tree_map(lambda x: x[i], found) for i in range(len(places))]

    def _unseen(self, t, y, a) -> Node:
        """A node whose guards are not known yet."""
        zero = jnp.zeros_like(t)
        return Node(t, y, a, (Value(zero, zero, zero, jnp.asarray(False)),) * len(self.guards.kinds))

    def _judged(self, left: Node, right: Node, inner) -> list[Pieces]:
        """Each guard between two nodes, from what it is at the inner ones by the quintic and by the cubics."""
        found, h, count = [], right.t - left.t, len(INNER)
        for begin, end, by_both in zip(left.values, right.values, inner):
            pairs = zip(by_both[:count], by_both[count:])
            off = [tuple(SAFETY * jnp.abs(x - z) for x, z in zip(*pair)) for pair in pairs]
            touches = TOUCHES * self.motion.tolerances.rtol[0] * h * jnp.maximum(jnp.abs(begin.rate), jnp.abs(end.rate))
            found.append(pieces_of(begin, by_both[:count], off, end, h, touches))
        return found

    def _first_sign(self, value: Value, kind: Kind):
        """The sign at the start of the motion: none where that is on the guard."""
        on_guard = jnp.abs(value.g) <= ON_GUARD * (value.noise + jnp.abs(value.rate) * self.resolution)
        if kind.holds:
            return jnp.where(on_guard & (value.rate > 0), 0.0, 1.0)
        return jnp.where(on_guard | ~jnp.isfinite(value.g), 0.0, jnp.sign(value.g))

    def _at_extremum(self, s: Search, looks):
        """Whether an extremum is to be looked for again, nearer; else, if it was, that it is known."""
        here = s.right
        g, rate, noise = (_chosen(s.asked, [getattr(v, name) for v in here.values]) for name in ("g", "rate", "noise"))
        asked = looks & (s.asked >= 0)
        shift = -rate / s.curvature
        there = (0.5 * jnp.abs(rate * shift) <= NEAR_EXTREMUM * jnp.abs(g)) | (jnp.abs(shift) <= self.resolution)
        again = asked & ~there & (s.tries < EXTREMUM_LOOKS) & (s.looks < LOOKS)
        mine = [asked & there & (s.asked == i) for i in range(len(here.values))]
        eps = ROUNDED * jnp.finfo(g.dtype).eps
        touches = jnp.abs(g) <= noise * jnp.maximum(TOUCHES * self.motion.tolerances.rtol[0] / eps, 1.0)
        return again, s._replace(
            at=jnp.where(again, jnp.clip(here.t + shift, s.left.t, s.end.t), s.at),
            tries=jnp.where(again, s.tries + 1, 0),
            asked=jnp.where(again, s.asked, -1),
            right=here._replace(values=tuple(v._replace(turns=v.turns | m) for v, m in zip(here.values, mine))),
            followed=tuple(f._replace(uncertain=f.uncertain | (m & touches)) for f, m in zip(s.followed, mine)),
        )

    def _judge(self, s: Search, here, times, of_guards) -> Search:
        """Settle what is between `left` and `right`, or say where to look next; where `here`."""
        in_doubt = [_any(p.doubt) for p in of_guards]
        given_up = s.looks >= LOOKS
        # By halves down to the resolution of time: a jump, whose place is then known.
        settled = here & (~_any(in_doubt) | (s.right.t - s.left.t <= NARROW * self.resolution) | given_up)
        # Where doubts remain, only the signs at the ends are believed.
        signs = [
            [jnp.where(doubt, 0.0, sign) for sign in p.sign[:-1]] + p.sign[-1:] for p, doubt in zip(of_guards, in_doubt)
        ]
        crosses = [changes(f.sign, sign) for f, sign in zip(s.followed, signs)]
        any_crosses = settled & _any([_any(x) for x in crosses])
        keep = lambda: self._keep(s, times, of_guards, signs, crosses, any_crosses)
        nothing = lambda: ([f.count for f in s.followed], s.enclosed)
        counts, enclosed = lax.cond(eqxi.unvmap_any(any_crosses), keep, nothing)
        ended = _any([n > f.count for n, f, kind in zip(counts, s.followed, self.guards.kinds) if kind.terminal])
        at_end = ended | (s.right.t >= s.end.t)
        onward = settled & ~at_end
        following = next_look(s.left, s.right, times, of_guards, self.resolution)
        flat = lambda node, turns: node._replace(
            values=tuple(v._replace(turns=v.turns | (~settled & x)) for v, x in zip(node.values, turns))
        )
        return s._replace(
            left=_where(onward, s.right, flat(s.left, following.turns_left)),
            right=_where(onward, s.end, flat(s.right, following.turns_right)),
            look=~settled & following.look,
            where=jnp.asarray(INSIDE),
            at=following.at,
            asked=jnp.where(settled, -1, following.asked),
            curvature=following.curvature,
            tries=jnp.asarray(0),
            done=s.done | (settled & at_end),
            followed=tuple(
                Followed(_where(settled, last_known(f.sign, sign), f.sign), n, f.uncertain | (here & doubt & given_up))
                for f, sign, n, doubt in zip(s.followed, signs, counts, in_doubt)
            ),
            enclosed=enclosed,
        )

    def _keep(self, s: Search, times, of_guards, signs, crosses, settled):
        """Keep the crossings between the nodes, of each guard as many as there is room for."""
        counts, enclosed, first, found = [], s.enclosed, 0, []
        for kind, p, sign, crossed in zip(self.guards.kinds, of_guards, signs, crosses):
            since, mine = (times[0], p.g[0], p.rate[0]), []
            for t, g, rate, after, changed in zip(times[1:], p.g[1:], p.rate[1:], sign, crossed):
                wanted = settled & changed & (True if kind.direction == 0 else kind.direction == after)
                mine.append((wanted, Enclosed(since[0], t, after, *root_of_cubic(since, (t, g, rate)))))
                since = _where(after != 0, (t, g, rate), since)
            found.append(mine)
        # Those for which there is no room are counted up to the end of the motion. The others are known better later.
        end = jnp.asarray(jnp.inf, times[0].dtype)
        for kind, mine in zip(self.guards.kinds, found):
            for wanted, new in mine if kind.terminal else ():
                end = jnp.where(wanted, jnp.minimum(end, new.guess), end)
        for f, kind, mine in zip(s.followed, self.guards.kinds, found):
            count, place = f.count, first + np.arange(kind.most)
            first += kind.most
            there = np.zeros(self.guards.owners.size, bool)
            there[place] = True
            for wanted, new in mine:
                here = there & (self.guards.ranks == count) & wanted
                enclosed = jtu.tree_map(lambda all, x: jnp.where(here, x, all), enclosed, new)
                count = count + (wanted & ((count < kind.most) | (new.guess <= end)))
            counts.append(count)
        return counts, enclosed


def _apart(function, *args, **options):
    """`function(*args)` as a call: what its results share XLA would compute anew for each of those who need them."""
    return called(_jitted(function, args, options))


@eqx.filter_jit
def _jitted(function, args, options):
    return function(*args, **options)


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


def uneven(y):
    """The state, each number times another factor near one: sums of their parts should not cancel."""
    leaves, structure = jtu.tree_flatten(y)
    scaled = []
    for i, x in enumerate(leaves):
        factor = 0.5 + np.mod(0.618 * (np.arange(x.size) + 1) + 0.377 * i, 1.0)
        scaled.append(x * factor.reshape(x.shape).astype(x.dtype))
    return jtu.tree_unflatten(structure, scaled)


def _where(condition, a, b):
    return jtu.tree_map(lambda a, b: jnp.where(condition, a, b), a, b)
