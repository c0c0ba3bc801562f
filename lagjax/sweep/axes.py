"""The parameters that vary in a sweep: named axes, as a grid or paired; the point at each flat index; blocks of points.

A block is a box of the grid whose points are consecutive in the flat order as well, the last axis fastest: it has one
point along the first axes, some along one axis, and all along the rest. So a store keeps arrays in the shape of its
axes, and yet each of its files holds consecutive flat indices.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import ArrayLike

# The single dimension of paired axes.
POINT = "point"


class Axes(eqx.Module):
    """Named axes: values (n, ...) by name; each point gets one slice of each.

    The last axis varies fastest in the flat index; `paired` axes all move together.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    arrays: tuple[Any, ...]
    paired: bool = eqx.field(static=True)

    @property
    def values(self) -> dict[str, Any]:
        """The values by name. Not a field: JAX would sort the names, but their order must match the indices."""
        return dict(zip(self.names, self.arrays))

    @property
    def dims(self) -> dict[str, int]:
        """The dimensions of the sweep and their lengths."""
        lengths = {name: len(x) for name, x in self.values.items()}
        return {POINT: next(iter(lengths.values()))} if self.paired else lengths

    @property
    def shape(self) -> tuple[int, ...]:
        """The lengths of the dimensions."""
        return tuple(self.dims.values())

    @property
    def size(self) -> int:
        """The number of points."""
        return math.prod(self.shape)

    def at(self, index: ArrayLike) -> dict[str, Any]:
        """The point at a flat index as a dictionary; for indices (n,) the values are (n, ...)."""
        positions = [index] * len(self.names) if self.paired else np.unravel_index(index, self.shape)
        return {name: x[i] for name, x, i in zip(self.names, self.arrays, positions)}

    def words(self, index: int) -> str:
        """The point at a flat index as text."""
        point = {name: np.asarray(x) for name, x in self.at(int(index)).items()}
        return ", ".join(
            f"{name} = {x:.6g}" if x.ndim == 0 else f"{name} of shape {x.shape}" for name, x in point.items()
        )


def axes_of(axes: Any, paired: bool) -> Axes:
    """The axes that a user passed, validated."""
    example = 'Fix: axes={"omega": jnp.linspace(0.0, 3.0, 100)}.'
    if not isinstance(axes, Mapping) or not axes:
        raise TypeError(f"axes must be a dictionary of arrays by name, not {axes!r:.60}.\n{example}")
    values = {}
    for name, given in axes.items():
        if any(isinstance(x, Tracer) for x in jax.tree.leaves(given)):
            raise TypeError(
                f"axis '{name}' is being traced: a sweep compiles and runs on its own, outside of jit, grad and vmap.\n"
                "Fix: call lj.sweep with concrete arrays; inside a program use jax.vmap."
            )
        x = np.asarray(given)
        if not np.issubdtype(x.dtype, np.number) and x.dtype != bool or x.ndim == 0 or len(x) == 0:
            raise ValueError(
                f"axis '{name}' must be an array of at least one number, and is {given!r:.60}.\n{example} "
                "Quantities that do not vary belong in run."
            )
        if str(name) in values:
            raise ValueError(
                f"two axes are named '{name}': one name is a string, the other a number.\nFix: rename one of them."
            )
        # In the dtype that JAX would give it: float64 only if x64 is enabled.
        values[str(name)] = x.astype(jax.dtypes.canonicalize_dtype(x.dtype))
    lengths = {name: len(x) for name, x in values.items()}
    if paired and len(set(lengths.values())) > 1:
        lengths_in_words = ", ".join(f"'{name}' has {n}" for name, n in lengths.items())
        raise ValueError(
            f"paired axes must all have the same length: {lengths_in_words}.\n"
            "Usual cause: a grid was intended.\nFix: leave paired=True out, or cut the axes to the same length."
        )
    return Axes(tuple(values), tuple(values.values()), paired)


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

    def size(self, numbers: Iterable[int]) -> int:
        """The number of points of some blocks."""
        return sum(here.stop - here.start for here in map(self.points, numbers))


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
