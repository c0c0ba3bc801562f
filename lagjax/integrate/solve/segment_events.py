"""The crossings recorded over all legs of a motion in phases."""

import jax
import jax.numpy as jnp

from lagjax.integrate.events.event import Crossings, Guards


def nothing(guards: Guards | None, names, q, v, multipliers) -> dict[str, Crossings]:
    """The events of these names before any crossing; `multipliers`: those of all phases, NaN."""
    room = {kind.name: kind.most for kind in (() if guards is None else guards.kinds)}

    def none(most):
        rows = lambda tree: jax.tree.map(lambda x: jnp.full((most, *x.shape), jnp.nan, x.dtype), tree)
        t = jnp.full(most, jnp.nan, jax.tree.leaves(q)[0].dtype)
        return Crossings(t, rows(q), rows(v), rows(multipliers), jnp.asarray(0), jnp.asarray(False))

    return {name: none(room[name]) for name in names}


def with_those_of(leg: dict[str, Crossings], before: dict[str, Crossings]) -> dict[str, Crossings]:
    """Append the crossings of a leg to the earlier ones."""
    return {name: _joined(found, leg[name]) for name, found in before.items()}


def _joined(before: Crossings, new: Crossings) -> Crossings:
    place = jnp.arange(before.t.shape[0]) - jnp.sum(jnp.isfinite(before.t))
    multipliers = {name: new.multipliers.get(name, jnp.full_like(x, jnp.nan)) for name, x in before.multipliers.items()}

    def join(x, y):
        later = (place >= 0).reshape(-1, *[1] * (x.ndim - 1))
        return jnp.where(later, y[jnp.maximum(place, 0)].astype(x.dtype), x)

    rows = jax.tree.map(join, (before.t, before.q, before.v, before.multipliers), (new.t, new.q, new.v, multipliers))
    return Crossings(*rows, before.count + new.count, before.uncertain | new.uncertain)
