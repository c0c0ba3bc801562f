"""How an engine fills a store: points to write together, and whether it is as other versions were."""

import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lagjax.sweeps.axes import Axes
from lagjax.sweeps.fingerprint import in_words, named_leaves, versions
from lagjax.sweeps.grids import Blocks, divided
from lagjax.sweeps.labels import labels_of
from lagjax.sweeps.lanes import GOOD, Status, not_run
from lagjax.sweeps.memory import bytes_of
from lagjax.sweeps.store import Store
from lagjax.sweeps.structures import written

# A block of a store is written about so often, and holds no more than this.
BLOCK_SECONDS, BLOCK_BYTES = 2.0, 256e6
# The last call of the program for some blocks is filled up with points of which nobody asks: one of so many.
FULL_CHUNKS = 16
# Two versions may differ by so much, relative to the largest value, before it is told.
ALIKE_VERSIONS = 1e-6


class Begun(NamedTuple):
    """What a new store is made of: its blocks; times of trajectories that do not depend on the point, by leaf; the
    description of what `run` returns.
    """

    blocks: Blocks
    times: dict[str, np.ndarray]
    structure: dict[str, Any] | None


def begun(engine: Any, axes: Axes, shares: int) -> Begun:
    """The beginnings of a store, by some points that are computed for it."""
    first = np.arange(min(engine.program.chunk, axes.size))
    seconds, values, status = engine.timed(first)
    good = np.flatnonzero(np.isin(status.result, GOOD))
    lane = good[0] if len(good) else 0
    one = jax.tree.map(lambda x: jnp.asarray(x[lane]), values)
    blocks = divided(axes.shape, _block(engine, axes, shares, seconds))
    return Begun(blocks, _times(engine, axes, one), written(engine.program.values, one))


def _block(engine, axes, shares, seconds):
    """Points to write together: some seconds' worth, `shares` of them or more, no more than fits."""
    chunk = engine.program.chunk
    wanted = max(1, round(BLOCK_SECONDS * engine.workers / max(seconds, 1e-6))) * chunk
    fair = max(1, axes.size // (shares * chunk)) * chunk
    fits = max(1, int(BLOCK_BYTES / (bytes_of(engine.program) * chunk))) * chunk
    return min(wanted, fair, fits)


def _times(engine, axes, one):
    labels = labels_of(axes, engine.program.values).values
    named = dict(named_leaves(one))
    times = [key for key, label in labels.items() if label.times and np.ndim(named[key]) == 1]
    return {key: np.asarray(named[key]) for key in times if _is_fixed(engine, axes, key)}


def _is_fixed(engine, axes, key):
    """Whether a leaf of what `run` returns is the same at all points, whatever they are: vmap knows."""
    leaf = lambda point: dict(named_leaves(engine.run(point)))[key]
    try:
        jax.eval_shape(jax.vmap(leaf, out_axes=None), axes.at(np.zeros(1, int)))
    except ValueError as error:
        if "out_axes" not in str(error):
            raise
        return False
    return True


class Filling:
    """Blocks that are being computed together: each is written as soon as all of its points are there."""

    def __init__(self, engine: Any, store: Store, numbers: list[int]):
        self.store, self.numbers = store, numbers
        points = [store.blocks.points(number) for number in numbers]
        self.indices = np.concatenate([np.arange(x.start, x.stop) for x in points])
        lengths = np.array([x.stop - x.start for x in points])
        self._ends, self._left = np.cumsum(lengths), lengths
        self._found = not_run(engine.program, len(self.indices))

    def take(self, places: np.ndarray, values: Any, status: Status):
        """What was computed at some places among the indices."""
        for whole, some in zip(jax.tree.leaves(self._found), jax.tree.leaves((values, status))):
            whole[places] = some
        touched = np.searchsorted(self._ends, places, side="right")
        self._left = self._left - np.bincount(touched, minlength=len(self._left))
        for i in np.unique(touched)[self._left[np.unique(touched)] == 0].tolist():
            start = 0 if i == 0 else self._ends[i - 1]
            self.store.write(self.numbers[i], *jax.tree.map(lambda x: x[start : self._ends[i]], self._found))


def together(engine: Any, store: Store, numbers: list[int]) -> Iterator[list[int]]:
    """Blocks to compute together: so that their points fill the chunks of the program, and fit into memory."""
    points = min(FULL_CHUNKS * engine.program.chunk, int(BLOCK_BYTES / bytes_of(engine.program)))
    some, count = [], 0
    for number in numbers:
        here = store.blocks.points(number)
        if some and count + here.stop - here.start > points:
            yield some
            some, count = [], 0
        some.append(number)
        count += here.stop - here.start
    if some:
        yield some


def compare_versions(engine: Any, store: Store) -> None:
    """Where other versions have begun a store, compute some of its points again and tell how they differ."""
    there, number = store.about["fingerprint"], store.first()
    if there["program"] == engine.program.digest or number is None:
        return
    indices = np.r_[store.blocks.points(number)][: engine.program.chunk]
    found, status = engine.first(indices)
    worst, name = 0.0, None
    for (leaf, x), before in zip(named_leaves(found), (x[: len(indices)] for x in store.read(number))):
        good = np.isin(status.result, GOOD)
        x, before = x[good].astype(complex), before[good].astype(complex)
        largest = np.max(np.abs(before), initial=0.0)
        off = np.max(np.abs(x - before), initial=0.0) / (largest if largest > 0 else 1.0)
        if not off <= worst:
            worst, name = off, leaf
    if not worst <= ALIKE_VERSIONS:
        warnings.warn(
            f"{store.path} was begun with {in_words(there['versions'])}, and is continued with {in_words(versions())}: "
            f"computed again, '{name}' of {len(indices):,} of its points differs by {worst:.1e} of its largest value.\n"
            "Usual cause: run is another function than it was; or a motion that amplifies round-off.\n"
            "Fix: another path, to compute all of it anew.",
            stacklevel=4,
        )
