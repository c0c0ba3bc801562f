"""What a guess shows of an orbit: its size, its approximate period, and the turns of its angles.

The guess is followed for a period, and for two more if the period is unknown, with low accuracy. If it is not near its
start after the given period, the time at which it comes nearest is taken as the period instead.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.analysis.orbits.flow import Flow, scale_of

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


class OrbitRequest(NamedTuple):
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


def guessed(flow: Flow, t, z, period, asked: OrbitRequest, parts: int, turns) -> Guess:
    """Follow a guess; `turns` (n,): the turns of the angles, or None to count those of the guess."""
    z = flow.onto_constraints(t, z, scale_of(z, period))
    find_period = asked.free and parts == 1
    reach = REACH if find_period else 1
    path = lax.stop_gradient(flow.path(t, z, reach * period, reach * PIECES))
    finite = jnp.all(jnp.isfinite(path))
    path = jnp.where(finite, path, z[None])
    scale = _extent(path, period, scale_of(z, period), np.array(asked.angles) | np.array(asked.relative))
    index, (displacement, _) = PIECES, jnp.split(path - z[None], 2, axis=1)
    around = np.array(asked.angles) & ~np.array(asked.relative)
    path_turns = jnp.where(around[None], jnp.round(displacement / TURN), 0.0)
    if find_period:
        index = _nearest(
            path - z[None],
            TURN * (path_turns if turns is None else jnp.asarray(turns)[None] + 0 * path_turns),
            scale,
            asked,
        )
    # In a driven system an unstable guess may go anywhere, so all parts begin at the given state.
    nodes = path[np.arange(parts) * PIECES // parts] if asked.moves else jnp.broadcast_to(z, (parts, z.size))
    onto = lambda node: flow.onto_constraints(t, node, scale)
    nodes = jnp.stack([z, *(onto(node) for node in nodes[1:])])
    chosen_turns = path_turns[index] if turns is None else jnp.asarray(turns)
    return Guess(z, nodes, period * jnp.asarray(index, z.dtype) / PIECES, scale, chosen_turns)


def _extent(path, period, otherwise, advances):
    """Half the range of each coordinate and velocity; never zero.

    A coordinate that advances steadily, such as a turning angle, counts by its deviation from that advance.
    """
    rate, x = TURN / period, path[:, : len(advances)]
    steady = jnp.linspace(0.0, 1.0, len(path), dtype=x.dtype)[:, None] * (x[-1] - x[0])[None]
    x = jnp.where(advances[None], x - steady, x)
    x, u = (0.5 * jnp.ptp(y, axis=0) for y in (x, path[:, len(advances) :]))
    both = jnp.stack([x, u / rate])
    # Each takes its own size; one that hardly moves, that of its partner, or else of the coordinate that moves most.
    sizes, largest = jnp.max(both, axis=0), jnp.max(both)
    sizes = jnp.where(sizes > STILL * largest, sizes, largest)[None]
    x, u = jnp.where(both > STILL * sizes, both, sizes)
    return lax.stop_gradient(jnp.where(largest > 0, jnp.concatenate([x, u * rate]), otherwise))


def _nearest(difference, turn_shifts, scale, asked):
    """The index of the point nearest to the start, if it is much nearer than that after the given period."""
    mask = 1.0 - np.concatenate([np.array(asked.relative, float), np.zeros(turn_shifts.shape[1])])
    difference = difference - jnp.concatenate([turn_shifts, jnp.zeros_like(turn_shifts)], axis=1)
    apart = jnp.sqrt(jnp.mean((difference / scale[None]) ** 2 * mask[None], axis=1))
    place = np.arange(len(difference))
    off = jnp.pad(apart, 1, constant_values=np.inf)
    lowest = (apart <= off[:-2]) & (apart <= off[2:]) & (place > BEGINNING * PIECES)
    # Of several returns, such as after one and two periods, the one nearest to the given period.
    near = jnp.where(lowest & (apart < NEAR), np.abs(np.log(np.maximum(place, 0.5) / PIECES)), jnp.inf)
    nearest = jnp.where(jnp.any(jnp.isfinite(near)), jnp.argmin(near), jnp.argmin(jnp.where(lowest, apart, jnp.inf)))
    nearest = jnp.where(jnp.any(lowest), nearest, PIECES)
    return jnp.where(apart[nearest] > BETTER * apart[PIECES], PIECES, nearest)
