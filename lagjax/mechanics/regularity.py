"""Judge whether a solution of the equations at one state is valid."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

# A constraint whose derivative is this much smaller than nearby has none: it is written as a square.
VANISHES_BELOW = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-4}


class Verdict(NamedTuple):
    """A solution of the equations at one state, as vectors or by name, and whether it is valid.

    `mass`: the largest entry of each row of M.
    """

    a: PyTree[Array]
    multipliers: Any
    finite: Bool[Array, ""]
    singular: Bool[Array, ""]
    contradictory: Bool[Array, ""]
    mass: Float[Array, " n"]


def slightly_off(y):
    """Shift a position or velocity by a thousandth of its size, differently in each coordinate."""
    size = jnp.max(jnp.abs(y))
    return y + 1e-3 * jnp.cos(jnp.arange(y.size, dtype=y.dtype)) * jnp.where(size > 0, size, 1.0)


def vanishing(size, nearby):
    """Which rows of A are round-off: their `size` is far below that at a nearby state."""
    return size <= VANISHES_BELOW[np.dtype(size.dtype)] * jnp.nan_to_num(nearby, posinf=0.0)


def acceleration_round_off(inertia, forces, x, u):
    """The round-off of an acceleration in equilibrium or uniform motion, where all its terms nearly cancel."""
    by_force = jnp.max(jnp.where(inertia > 0, forces / jnp.where(inertia > 0, inertia, 1.0), 0.0))
    extent = jnp.max(jnp.abs(x))
    by_velocity = jnp.max(jnp.abs(u)) ** 2 / jnp.where(extent > 0, extent, 1.0)
    return 1e4 * jnp.finfo(x.dtype).eps * (by_force + by_velocity)
