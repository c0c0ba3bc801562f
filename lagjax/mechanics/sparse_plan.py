"""Decide whether a system is large and made of parts that touch few others, and how to solve it then.

The jaxpr shows which velocities M couples, and which velocities each constraint equation restricts. With M in small
blocks, the matrix S = A M⁻¹ Aᵀ of the multipliers couples equations that act on a common block; ordered, it is a band.
Nothing here depends on values, so a plan holds at every state.
"""

from dataclasses import dataclass
from functools import lru_cache

import equinox as eqx
import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Int

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.reactions import reacts
from lagjax.mechanics.sparsity import pattern
from lagjax.numerics import banded, dense

# The banded solve is faster from six unknowns on (a chain of two: 2.4 microseconds against 4.8; of twelve: 4 against
# 24); the dense one exchanges rows, which suits any mass matrix, and is kept where little is to be gained.
UNKNOWNS_AT_LEAST = 24
# Blocks of M are inverted by elimination up to this size.
BLOCK_AT_MOST = dense.ELIMINATE_UP_TO
# A band wider than this share of its rows leaves little out.
BAND_AT_MOST = 0.5


@dataclass(frozen=True, eq=False)
class Plan:
    """What is known of a system independently of values: blocks of M, colours of M and A, the band of S."""

    members: Int[np.ndarray, "blocks size"]
    place: Int[np.ndarray, " n"]
    of_mass: banded.Colours
    of_rows: banded.Colours
    of_columns: banded.Colours
    band: banded.Band | None

    def __str__(self):
        size = self.members.shape[1]
        mass = "mass matrix diagonal" if size == 1 else f"mass matrix in blocks of up to {size}"
        if self.band is None:
            return mass
        rows, half_bandwidth = self.band.order
        return f"banded, half bandwidth {half_bandwidth}, {len(rows)} equations; {mass}"


def plan(system, t, q, v, params) -> Plan | None:
    """How to solve a system sparsely; None where the dense solve is as good. Only shapes and dtypes count."""
    n = sum(np.size(x) for x in jax.tree.leaves(q))
    if reacts(system) or n + constraints.count(system, t, q, v, params) < UNKNOWNS_AT_LEAST:
        return None
    leaves, structure = jtu.tree_flatten((system, t, q, v, params))
    leaves = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
    try:
        hash((structure, leaves))
    except TypeError:
        return _plan.__wrapped__(structure, leaves)
    return _plan(structure, leaves)


# The equations are traced at several places of one program.
@lru_cache(maxsize=64)
def _plan(structure, leaves) -> Plan | None:
    arrays = [x if isinstance(x, jax.ShapeDtypeStruct) else None for x in leaves]

    def at(arrays):
        filled = [x if x is not None else leaf for x, leaf in zip(arrays, leaves)]
        system, t, q, v, params = jtu.tree_unflatten(structure, filled)
        return system, t, coordinates.flatten(q)[0], params, coordinates.flatten(v)[1]

    def momentum(u, arrays):
        system, t, x, params, unflatten = at(arrays)
        return jax.grad(lambda u: system.lagrangian(t, unflatten(x), unflatten(u), params))(u)

    def residual(u, arrays):
        system, t, x, params, unflatten = at(arrays)
        return constraints.velocity_residual(system, t, x, u, params, unflatten)

    _, t, q, _, _ = jtu.tree_unflatten(structure, leaves)
    u = jax.ShapeDtypeStruct((sum(x.size for x in jax.tree.leaves(q)),), t.dtype)
    of_mass = pattern(momentum, u, arrays)
    blocks = banded.blocks(of_mass)
    if max(map(len, blocks)) > BLOCK_AT_MOST:
        return None
    members = np.full((len(blocks), max(map(len, blocks))), u.size)
    coupled = np.zeros((u.size, u.size), np.float32)
    for k, block in enumerate(blocks):
        members[k, : len(block)] = block
        coupled[np.ix_(block, block)] = 1
    of_rows = pattern(residual, u, arrays)
    m, band = len(of_rows), None
    if m:
        rows = of_rows.astype(np.float32)
        band = banded.band(rows @ coupled @ rows.T > 0)
        if band.order.half_bandwidth > max(1, BAND_AT_MOST * m):
            return None
    where = np.flatnonzero(members.ravel() < u.size)
    place = where[np.argsort(members.ravel()[where])]
    return Plan(members, place, *map(banded.colours, (coupled > 0, of_rows, of_rows.T)), band)
