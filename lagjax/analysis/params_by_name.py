"""The numbers in `params` by name, `"omega"`, `"spring.k"`, `"k[1]"`: one of them is the parameter of a branch."""

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.jaxtools import is_traced, numpy_of
from lagjax.mechanics import listed


class Number(eqx.Module):
    """One entry of one leaf of `params`."""

    name: str = eqx.field(static=True)
    leaf: int = eqx.field(static=True)
    entry: int = eqx.field(static=True)

    def put(self, params: PyTree, value) -> PyTree:
        """`params` with another value of this number."""
        leaves, structure = jtu.tree_flatten(params)
        if is_traced((leaves[self.leaf], value)):
            leaf = jnp.asarray(leaves[self.leaf])
            leaf = leaf.reshape(-1).at[self.entry].set(value).reshape(leaf.shape).astype(leaf.dtype)
        else:
            leaf = np.array(leaves[self.leaf])
            leaf.reshape(-1)[self.entry] = value
        leaves[self.leaf] = leaf
        return jtu.tree_unflatten(structure, leaves)

    def get(self, params: PyTree):
        """The value of this number."""
        leaf = jtu.tree_leaves(params)[self.leaf]
        return numpy_of(leaf).ravel(leaf)[self.entry]


def numbers_in(params: PyTree) -> dict[str, Number]:
    """All floating-point numbers in `params`, by name."""
    numbers = {}
    for i, (path, leaf) in enumerate(jtu.tree_flatten_with_path(params)[0]):
        name = jtu.keystr(path, simple=True, separator=".") or "params"
        if not eqx.is_array_like(leaf) or not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            continue
        for entry, index in enumerate(np.ndindex(jnp.shape(leaf))):
            suffix = "[" + ", ".join(map(str, index)) + "]" if index else ""
            numbers[name + suffix] = Number(name + suffix, i, entry)
    return numbers


def no_such_number(along: str, params: PyTree, more: str) -> ValueError:
    """The error that no number has this name; `more`: what else `along` may be."""
    known = list(numbers_in(params))
    there = f"there {'are' if len(known) != 1 else 'is'} {listed(known) or 'none'}"
    return ValueError(
        f"along={along!r} is no number in params; {there}.\n"
        f'Fix: one of these; "spring.k" for params["spring"]["k"], {more}.'
    )
