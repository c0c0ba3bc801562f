"""The values of guards at one time, and between two times at which the motion is known.

See `detect.py` for how they are used, and `brackets.py` for how they are judged.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from lagjax.integrate.events.brackets import INNER, GuardValue, Node, Pieces, between, pieces_of, without_rest
from lagjax.integrate.events.event import EventKind, Guards
from lagjax.integrate.stepping.projected_solver import ProjectedSolver

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

    def value(self, t, y, args):
        """The value of each guard at one state."""
        multipliers = self.motion.rates(t, y)[1] if self.guards.take_multipliers else {}
        return self.guards(t, *y, multipliers, args)

    def sample(self, left: Node, right: Node, args):
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
        noise = lambda x, d: jnp.where(jnp.isfinite(d), eps * (jnp.abs(d) + jnp.abs(x)), half * jnp.abs(x))
        values = tuple(
            GuardValue(x, dx, noise(x, d), turning.turns, at_rest)
            for x, dx, d, turning, at_rest in zip(g, rate, digits, right.values, still)
        )
        return values, times, [[(x[i], dx[i]) for x, dx in found] for i in range(len(values))]

    def _along(self, places, directions, args):
        """The guards at places (t, y), and their derivatives along one direction for each place: pairs of tuples."""
        value = lambda t, y: self.value(t, y, args)
        push = lambda place, direction: self._known(*jax.jvp(value, place, direction))
        if not self.guards.long:
            return [push(*x) for x in zip(places, directions)]
        together = jtu.tree_map(lambda *x: jnp.stack(x), *zip(places, directions))
        found = jax.vmap(push)(*together)
        return [jtu.tree_map(lambda x: x[i], found) for i in range(len(places))]

    def _known(self, g, rate):
        """The guards and their rates, without infinite slopes and NaN where a guard may not stop the motion."""
        finite = lambda x, other: jnp.where(jnp.isfinite(x), x, other)
        may_rest = [kind.may_rest for kind in self.guards.kinds]
        return (
            tuple(finite(x, 1.0) if rests else x for x, rests in zip(g, may_rest)),
            tuple(finite(x, 0.0) if rests else x for x, rests in zip(rate, may_rest)),
        )

    def unseen(self, t) -> Node:
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


def uneven(y):
    """The state with each number times a different factor near one, so that sums of parts do not cancel."""
    leaves, structure = jtu.tree_flatten(y)
    scaled = []
    for i, x in enumerate(leaves):
        factor = 0.5 + np.mod(0.618 * (np.arange(x.size) + 1) + 0.377 * i, 1.0)
        scaled.append(x * factor.reshape(x.shape).astype(x.dtype))
    return jtu.tree_unflatten(structure, scaled)
