"""The curves of a trajectory, by the user's names: what is drawn of it."""

import jax
import numpy as np

from lagjax.mechanics import coordinates


def curves(tree):
    """One curve a coordinate, by the user's names."""
    first = jax.tree.map(lambda x: np.asarray(x[0]), tree)
    columns = np.stack([np.ravel(x) for x in _rows(tree)])
    return dict(zip(coordinates.names(first), columns.T))


def finite(*curves):
    """Those places of curves where all of them are."""
    there = np.isfinite(curves).all(axis=0)
    return tuple(x[there] for x in curves)


def _rows(tree):
    leaves = [np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1)


def columns(values):
    """The columns of an array, with what their names end in."""
    values = np.asarray(values)
    if values.ndim == 1:
        return [("", values)]
    return [(f"[{i}]", column) for i, column in enumerate(values.T)]
