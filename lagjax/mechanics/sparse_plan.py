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

from lagjax.jaxtools.sparsity import pattern
from lagjax.numerics.linalg import banded, dense
from lagjax.system import constraints
from lagjax.system.model import Model

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


def plan(model: Model) -> Plan | None:
    """How to solve a system sparsely; None where the dense solve is as good. Only shapes and dtypes count."""
    if model.reacts or model.n + model.m < UNKNOWNS_AT_LEAST:
        return None
    leaves, structure = jtu.tree_flatten(model)
    leaves = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
    try:
        hash((structure, leaves))
    except TypeError:
        return _plan.__wrapped__(structure, leaves)
    return _plan(structure, leaves)


# The equations are traced at several places of one program.
@lru_cache(maxsize=64)
def _plan(structure, leaves) -> Plan | None:
    model = jtu.tree_unflatten(structure, leaves)
    t, u = (jax.ShapeDtypeStruct(shape, model.form.dtype) for shape in ((), (model.n,)))
    given = [x if isinstance(x, jax.ShapeDtypeStruct) else None for x in leaves], t, u

    def at(given):
        arrays, t, x = given
        filled = [leaf if x is None else x for x, leaf in zip(arrays, leaves)]
        return jtu.tree_unflatten(structure, filled), t, x

    def momentum(u, given):
        model, t, x = at(given)
        return jax.grad(model.lagrangian, argnums=2)(t, x, u)

    def residual(u, given):
        return constraints.velocity_residual(*at(given), u)

    of_mass = pattern(momentum, u, given)
    blocks = banded.blocks(of_mass)
    if max(map(len, blocks)) > BLOCK_AT_MOST:
        return None
    members = np.full((len(blocks), max(map(len, blocks))), u.size)
    coupled = np.zeros((u.size, u.size), np.float32)
    for k, block in enumerate(blocks):
        members[k, : len(block)] = block
        coupled[np.ix_(block, block)] = 1
    of_rows = pattern(residual, u, given)
    m, band = len(of_rows), None
    if m:
        rows = of_rows.astype(np.float32)
        band = banded.band(rows @ coupled @ rows.T > 0)
        if band.order.half_bandwidth > max(1, BAND_AT_MOST * m):
            return None
    where = np.flatnonzero(members.ravel() < u.size)
    place = where[np.argsort(members.ravel()[where])]
    return Plan(members, place, *map(banded.colours, (coupled > 0, of_rows, of_rows.T)), band)
