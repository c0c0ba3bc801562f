"""The numbers in `params` by their names, `"omega"`, `"spring.k"`, `"k[1]"`: along which a branch is followed."""

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanics import coordinates
from lagjax.mechanics.diagnosis import listed


class Number(eqx.Module):
    """An entry of a leaf of `params`."""

    name: str = eqx.field(static=True)
    leaf: int = eqx.field(static=True)
    entry: int = eqx.field(static=True)

    def put(self, params: PyTree, value) -> PyTree:
        """`params` with another value of it."""
        leaves, structure = jtu.tree_flatten(params)
        if coordinates.is_traced((leaves[self.leaf], value)):
            leaf = jnp.asarray(leaves[self.leaf])
            leaf = leaf.reshape(-1).at[self.entry].set(value).reshape(leaf.shape).astype(leaf.dtype)
        else:
            leaf = np.array(leaves[self.leaf])
            leaf.reshape(-1)[self.entry] = value
        leaves[self.leaf] = leaf
        return jtu.tree_unflatten(structure, leaves)

    def get(self, params: PyTree):
        """Its value."""
        leaf = jtu.tree_leaves(params)[self.leaf]
        return coordinates.numpy_of(leaf).ravel(leaf)[self.entry]


def numbers_in(params: PyTree) -> dict[str, Number]:
    """All floating numbers in `params`."""
    found = {}
    for i, (path, leaf) in enumerate(jtu.tree_flatten_with_path(params)[0]):
        name = jtu.keystr(path, simple=True, separator=".") or "params"
        if not eqx.is_array_like(leaf) or not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            continue
        for entry, index in enumerate(np.ndindex(jnp.shape(leaf))):
            suffix = "[" + ", ".join(map(str, index)) + "]" if index else ""
            found[name + suffix] = Number(name + suffix, i, entry)
    return found


def no_such_number(along: str, params: PyTree, more: str) -> ValueError:
    """That there is no number of that name; `more`: what else there would be."""
    known = list(numbers_in(params))
    there = f"there {'are' if len(known) != 1 else 'is'} {listed(known) or 'none'}"
    return ValueError(
        f"along={along!r} is no number in params; {there}.\n"
        f'Fix: one of these; "spring.k" for params["spring"]["k"], {more}.'
    )
