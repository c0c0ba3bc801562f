"""The curves that are drawn of a trajectory, by the user's names."""

import jax
import numpy as np

from lagjax.system import coordinates


def curves(tree):
    """Return one curve for each coordinate, by the user's names."""
    first = jax.tree.map(lambda x: np.asarray(x[0]), tree)
    columns = np.stack([np.ravel(x) for x in _rows(tree)])
    return dict(zip(coordinates.names(first), columns.T))


def finite(*curves):
    """Return the curves at the places where all are finite."""
    all_finite = np.isfinite(curves).all(axis=0)
    return tuple(x[all_finite] for x in curves)


def _rows(tree):
    leaves = [np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1)


def columns(values):
    """Return the columns of an array, each with the suffix of its name."""
    values = np.asarray(values)
    if values.ndim == 1:
        return [("", values)]
    return [(f"[{i}]", column) for i, column in enumerate(values.T)]
