"""Blocks of a grid: boxes whose points are consecutive in the flat order as well, the last axis fastest.

Such a box has one point along the first axes, some along one axis, and all along the rest. So a store keeps arrays in
the shape of its axes, and yet each of its files holds consecutive flat indices.
"""

import math
from typing import NamedTuple

import numpy as np


class Blocks(NamedTuple):
    """How a grid is divided: its shape and the shape of a block; blocks at the end of an axis may be shorter."""

    shape: tuple[int, ...]
    block: tuple[int, ...]

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of blocks along each axis."""
        return tuple(-(-n // k) for n, k in zip(self.shape, self.block))

    def __len__(self):
        return math.prod(self.counts)

    def place(self, number: int) -> tuple[int, ...]:
        """The position of a block along each axis, which names its file in zarr."""
        return tuple(int(i) for i in np.unravel_index(number, self.counts))

    def region(self, number: int) -> tuple[slice, ...]:
        """The part of the grid that belongs to a block, as slices."""
        found = zip(self.place(number), self.shape, self.block)
        return tuple(slice(i * k, min((i + 1) * k, n)) for i, n, k in found)

    def points(self, number: int) -> slice:
        """The flat indices of a block."""
        region = self.region(number)
        first = int(np.ravel_multi_index([x.start for x in region], self.shape))
        return slice(first, first + math.prod(x.stop - x.start for x in region))


def divided(shape: tuple[int, ...], points: int) -> Blocks:
    """Divide a grid into blocks of about `points` points, and no more."""
    inner = 1
    for axis in reversed(range(len(shape))):
        if inner * shape[axis] > points:
            # Blocks of similar size: 100 points in blocks of at most 40 give 34, 34 and 32.
            pieces = math.ceil(shape[axis] / max(1, points // inner))
            length = math.ceil(shape[axis] / pieces)
            return Blocks(shape, (*(1,) * axis, length, *shape[axis + 1 :]))
        inner *= shape[axis]
    return Blocks(shape, shape)
