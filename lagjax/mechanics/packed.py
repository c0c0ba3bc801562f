"""A pytree as its arrays and a hashable rest, so that JAX can carry a system along with what was computed of it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import PyTree


class Packed(NamedTuple):
    """What of a pytree is not an array: its other leaves, with None in place of arrays, and its structure."""

    leaves: tuple
    structure: Any

    def together(self, arrays: PyTree) -> Any:
        """The pytree again."""
        return eqx.combine(arrays, jtu.tree_unflatten(self.structure, self.leaves))

    def __reduce__(self):
        # Equinox has a marker in the structure of its modules that it knows by identity. A copy of the structure would
        # have a copy of the marker: the tree itself is copied in its place.
        return _rest_of, (jtu.tree_unflatten(self.structure, self.leaves),)


def pack(tree: PyTree) -> tuple[PyTree, Packed]:
    """Split a pytree into arrays and a hashable rest."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return arrays, _rest_of(rest)


def _rest_of(tree):
    leaves, structure = jtu.tree_flatten(tree)
    return Packed(tuple(leaves), structure)
