"""The structure of what `run` returned, for the values of a store: from its description, or from `run` itself."""

import pickle
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
from jaxtyping import PyTree

from lagjax.sweeps.axes import Axes
from lagjax.sweeps.store import Store
from lagjax.sweeps.travelling import pickled, shapes_of


def as_run_returns(run: Callable, axes: Axes, store: Store) -> PyTree:
    """One point's values, as shapes: what `run` would return.

    **Raises:** `ValueError` where the store has others.
    """
    one = {name: jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for name, x in axes.values.items()}
    like = jax.eval_shape(run, one)
    there, here = shapes_of(store.one(), 0), shapes_of(like, 0)
    if there != here:
        raise ValueError(
            f"run returns {here}, and {store.path} has {there}.\nFix: the function that was swept; or leave run out."
        )
    return like


def as_stored(store: Store, system: Any) -> PyTree | None:
    """The same, from what the store says about itself; None where it does not."""
    return None


class Travelling(NamedTuple):
    """Values in a pickle: their leaves, and their structure as bytes, which are not looked at before it is needed."""

    leaves: list
    structure: bytes | None
    described: Any

    @classmethod
    def of(cls, values: PyTree) -> "Travelling":
        """Values, to be pickled."""
        leaves, structure = jax.tree.flatten(values)
        numbers = jax.tree.unflatten(structure, range(len(leaves)))
        return cls(leaves, pickled(numbers), None)

    def unpacked(self) -> PyTree:
        """The values again."""
        numbers = pickle.loads(self.structure)
        return jax.tree.unflatten(jax.tree.structure(numbers), self.leaves)
