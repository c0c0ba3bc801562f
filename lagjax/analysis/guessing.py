"""What a guess shows of an orbit: its size, its approximate period, and the turns of its angles.

The guess is followed for a period, and for two more if the period is unknown, with low accuracy. If it is not near its
start after the given period, the time at which it comes nearest is taken as the period instead.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.analysis.flow import Flow, scale_of

TURN = 2 * np.pi
# Points of the path in a given period, and the number of given periods searched for a better one.
PIECES, REACH = 48, 3
# A guess comes back where its distance is below this fraction of its size; a return replaces the given period only if
# it is nearer by the second factor.
NEAR, BETTER = 0.2, 0.5
# A coordinate that moves less than this fraction of the others hardly moves.
STILL = 1e-6
# Returns in this first fraction of a period are ignored: the motion has hardly left its start.
BEGINNING = 0.4


class Asked(NamedTuple):
    """The kind of orbit that is searched; all fields are static.

    - `free`: whether the period is unknown; `moves`: whether the start may move along the orbit (no dependence on t).
    - `energy`: whether the Jacobi integral is held; `held`: the indices of the held entries of (q, v).
    - `relative` (n,): coordinates that need not come back; `angles` (n,): those that come back up to whole turns.
    """

    free: bool
    moves: bool
    energy: bool
    held: tuple[int, ...]
    relative: tuple[bool, ...]
    angles: tuple[bool, ...]


class Guess(NamedTuple):
    """The start on the constraints, states at equal parts of a period, the period, and the sizes and turns."""

    z: Float[Array, " 2n"]
    nodes: Float[Array, "K 2n"]
    period: Float[Array, ""]
    scale: Float[Array, " 2n"]
    turns: Float[Array, " n"]


def guessed(flow: Flow, t, z, period, asked: Asked, parts: int, turns) -> Guess:
    """Follow a guess; `turns` (n,): the turns of the angles, or None to count those of the guess."""
    z = flow.onto_constraints(t, z, scale_of(z, period))
    searched = asked.free and parts == 1
    reach = REACH if searched else 1
    path = lax.stop_gradient(flow.path(t, z, reach * period, reach * PIECES))
    known = jnp.all(jnp.isfinite(path))
    path = jnp.where(known, path, z[None])
    scale = _extent(path, period, scale_of(z, period), np.array(asked.angles) | np.array(asked.relative))
    at, (gone, _) = PIECES, jnp.split(path - z[None], 2, axis=1)
    around = np.array(asked.angles) & ~np.array(asked.relative)
    own = jnp.where(around[None], jnp.round(gone / TURN), 0.0)
    if searched:
        at = _nearest(
            path - z[None], TURN * (own if turns is None else jnp.asarray(turns)[None] + 0 * own), scale, asked
        )
    # In a driven system an unstable guess may go anywhere, so all parts begin at the given state.
    nodes = path[np.arange(parts) * PIECES // parts] if asked.moves else jnp.broadcast_to(z, (parts, z.size))
    onto = lambda node: flow.onto_constraints(t, node, scale)
    nodes = jnp.stack([z, *(onto(node) for node in nodes[1:])])
    given = own[at] if turns is None else jnp.asarray(turns)
    return Guess(z, nodes, period * jnp.asarray(at, z.dtype) / PIECES, scale, given)


def _extent(path, period, otherwise, goes_on):
    """Half the range of each coordinate and velocity; never zero.

    A coordinate that advances steadily, such as a turning angle, counts by its deviation from that advance.
    """
    rate, x = TURN / period, path[:, : len(goes_on)]
    steady = jnp.linspace(0.0, 1.0, len(path), dtype=x.dtype)[:, None] * (x[-1] - x[0])[None]
    x = jnp.where(goes_on[None], x - steady, x)
    x, u = (0.5 * jnp.ptp(y, axis=0) for y in (x, path[:, len(goes_on) :]))
    both = jnp.stack([x, u / rate])
    # Each takes its own size; one that hardly moves, that of its partner, or else of the coordinate that moves most.
    of_both, largest = jnp.max(both, axis=0), jnp.max(both)
    of_both = jnp.where(of_both > STILL * largest, of_both, largest)[None]
    x, u = jnp.where(both > STILL * of_both, both, of_both)
    return lax.stop_gradient(jnp.where(largest > 0, jnp.concatenate([x, u * rate]), otherwise))


def _nearest(difference, turned, scale, asked):
    """The index of the point nearest to the start, if it is much nearer than that after the given period."""
    mask = 1.0 - np.concatenate([np.array(asked.relative, float), np.zeros(turned.shape[1])])
    difference = difference - jnp.concatenate([turned, jnp.zeros_like(turned)], axis=1)
    apart = jnp.sqrt(jnp.mean((difference / scale[None]) ** 2 * mask[None], axis=1))
    place = np.arange(len(difference))
    off = jnp.pad(apart, 1, constant_values=np.inf)
    lowest = (apart <= off[:-2]) & (apart <= off[2:]) & (place > BEGINNING * PIECES)
    # Of several returns, such as after one and two periods, the one nearest to the given period.
    near = jnp.where(lowest & (apart < NEAR), np.abs(np.log(np.maximum(place, 0.5) / PIECES)), jnp.inf)
    nearest = jnp.where(jnp.any(jnp.isfinite(near)), jnp.argmin(near), jnp.argmin(jnp.where(lowest, apart, jnp.inf)))
    nearest = jnp.where(jnp.any(lowest), nearest, PIECES)
    return jnp.where(apart[nearest] > BETTER * apart[PIECES], PIECES, nearest)
