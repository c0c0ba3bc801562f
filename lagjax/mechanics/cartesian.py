"""Find which coordinates are Cartesian coordinates of points, by their names and shapes.

A point is a group of scalars whose names differ only by x, y, z (`x, y`; `x1, z1`; `bead_x, bead_y, bead_z`), or an
array of shape (2,) or (3,), or one row of an array (n, 2) or (n, 3). The guess only decides which motions of space are
tried: coordinates that are not positions simply have no such symmetry.
"""

import re
from typing import NamedTuple

import jax.tree_util as jtu
import numpy as np

from lagjax.system import coordinates

AXES = "xyz"
NAMES = re.compile(r"(?P<before>(?:.*\.)?(?:\w+_)?)(?P<axis>[xyzXYZ])(?P<after>\d*|_\w+)")


class CartesianPoint(NamedTuple):
    """A point: its label ("" for the only one), and the places of its coordinates along x, y, z (None: it has none)."""

    label: str
    places: tuple[int | None, int | None, int | None]


def points(q) -> list[CartesianPoint]:
    """The points among the coordinates.

    >>> points({"x": 0.0, "y": 0.0, "angle": 0.0})
    [Point(label='', places=(1, 2, None))]
    >>> [point.label for point in points({"r": np.zeros((2, 3))})]
    ['r[0]', 'r[1]']
    """
    found, axes_by_point, start = [], {}, 0
    for (path, leaf), name in zip(jtu.tree_flatten_with_path(q)[0], leaf_names(q)):
        shape = np.shape(leaf)
        size = int(np.prod(shape))
        last = shape[len(shape) - 1] if shape else 0
        if last in (2, 3) and len(shape) <= 2:
            for i in range(size // last):
                label = name if len(shape) == 1 else f"{name}[{i}]"
                where = [start + i * last + k for k in range(last)]
                found.append(CartesianPoint(label, (where[0], where[1], where[2] if len(where) > 2 else None)))
        elif path and not shape and (match := NAMES.fullmatch(name)):
            key = match["before"], match["after"], match["axis"].isupper()
            axes_by_point.setdefault(key, {})[match["axis"].lower()] = start, name
        start += size
    for axes in axes_by_point.values():
        if len(axes) > 1:
            where = tuple(axes[axis][0] if axis in axes else None for axis in AXES)
            found.append(CartesianPoint(", ".join(name for _, name in axes.values()), where))
    return [found[0]._replace(label="")] if len(found) == 1 else found


def leaf_names(q) -> list[str]:
    """The name of each leaf of q, as the user would write it."""
    paths = [path for path, _ in jtu.tree_flatten_with_path(q)[0]]
    # A scalar in place of each leaf: the names of the coordinates then have no indices.
    return coordinates.names(jtu.tree_unflatten(jtu.tree_structure(q), [0.0] * len(paths)))


def turned(point: CartesianPoint, axis: str) -> tuple[int, int] | None:
    """The two places that a rotation about an axis mixes, the first turning to the second; None if one is missing."""
    k = AXES.index(axis)
    first, second = point.places[(k + 1) % 3], point.places[(k + 2) % 3]
    return None if first is None or second is None else (first, second)
