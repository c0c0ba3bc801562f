"""Split a pytree into arrays and a hashable rest, so that JAX can carry a system along with what was computed of it."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import PyTree


class Packed(NamedTuple):
    """The part of a pytree that is not arrays: its other leaves, with None in place of arrays, and its structure."""

    leaves: tuple
    structure: Any

    def together(self, arrays: PyTree) -> Any:
        """Put the pytree together again."""
        return eqx.combine(arrays, jtu.tree_unflatten(self.structure, self.leaves))

    def __reduce__(self):
        # Equinox puts a marker into the structure of its modules and recognises it by identity. A copied structure
        # would contain a copy of the marker, so the tree itself is copied instead.
        return _rest_of, (jtu.tree_unflatten(self.structure, self.leaves),)


def pack(tree: PyTree) -> tuple[PyTree, Packed]:
    """Split a pytree into arrays and a hashable rest."""
    arrays, rest = eqx.partition(tree, eqx.is_array)
    return arrays, _rest_of(rest)


def _rest_of(tree):
    leaves, structure = jtu.tree_flatten(tree)
    return Packed(tuple(leaves), structure)
