"""The surface f = 0 inside a box, as faces: a surface net.

Each cell of a grid in which the sign of f changes has a vertex, the mean of the places on its edges where f, taken as
linear along them, vanishes. Each edge on which the sign changes has a face, with the four cells about it as corners.

Source: Gibson, "Constrained Elastic Surface Nets", *MICCAI* (1998), §2.
"""

from collections.abc import Callable
from itertools import product

import numpy as np

from lagjax.display.in_space.surfaces import Faces

# Cells along the longest side of the box.
CELLS = 20


def level_set(f: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray) -> Faces:
    """Faces of f = 0 between two corners of a box; `f` takes points (n, 3). They are seen from where f > 0.

    >>> flat = level_set(lambda points: points[:, 2] - 0.3, np.zeros(3), np.ones(3))
    >>> print(np.ptp(flat.vertices, axis=0).round(6), flat.vertices[:, 2].max().round(6))
    [0.95 0.95 0.  ] 0.3

    Where f is NaN or infinite there is no surface.
    """
    step = np.max(high - low) / CELLS
    counts = np.maximum(np.ceil((high - low) / step - 1e-9).astype(int), 1)
    points = np.stack(np.meshgrid(*(a + step * np.arange(n + 1) for a, n in zip(low, counts)), indexing="ij"), axis=-1)
    values = np.asarray(f(points.reshape(-1, 3)), float).reshape(points.shape[:3])
    places, crossings = np.zeros((*counts, 3)), np.zeros(counts)
    index, corners = np.arange(np.prod(counts)).reshape(counts), []
    for axis in range(3):
        # The axis first, the two others in cyclic order; x, y and z of points stay where they are.
        order = (axis, (axis + 1) % 3, (axis + 2) % 3)
        value, place = values.transpose(order), points.transpose(*order, 3)
        start, end = value[:-1], value[1:]
        crosses = ((start > 0) != (end > 0)) & np.isfinite(start) & np.isfinite(end)
        share = np.divide(start, start - end, out=np.zeros_like(start), where=crosses)
        place = np.where(crosses[..., None], place[:-1] + share[..., None] * (place[1:] - place[:-1]), 0.0)
        _, n, m = (counts[i] for i in order)
        # Views: what is added to them is added to the cells.
        sums, number, cells = places.transpose(*order, 3), crossings.transpose(order), index.transpose(order)
        for i, j in product((0, 1), repeat=2):
            sums += place[:, i : n + i, j : m + j]
            number += crosses[:, i : n + i, j : m + j]
        around = np.stack([cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]], axis=-1)
        rises = (end > 0)[:, 1:-1, 1:-1]
        faces = np.where(rises[..., None], around, around[..., ::-1])
        corners.append(faces[crosses[:, 1:-1, 1:-1]])
    used = crossings > 0
    renumbered = np.cumsum(used.reshape(-1)) - 1
    faces = renumbered[np.concatenate(corners)]
    return Faces(places[used] / crossings[used][:, None], faces, np.zeros(len(faces)), closed=True)
