"""How an engine fills a store: which points are written together, and whether versions give the same results."""

import warnings
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.sweep.axes import Axes, Blocks, divided
from lagjax.sweep.batch_program import GOOD, Status, not_run
from lagjax.sweep.labels import labels_of, named_leaves
from lagjax.sweep.metadata import in_words, versions
from lagjax.sweep.scheduler import Engine
from lagjax.sweep.store import Store
from lagjax.sweep.structure import description_of

# A block of a store is written about this often, and holds no more bytes than this.
BLOCK_SECONDS, BLOCK_BYTES = 2.0, 256e6
# The last call of the program for a group of blocks is padded with unused points: at most one call in this many.
FULL_CHUNKS = 16
# Two versions may differ by this much, relative to the largest value, before a warning is given.
ALIKE_VERSIONS = 1e-6


class NewStore(NamedTuple):
    """What a new store needs: its blocks; by leaf, the times of trajectories that are the same at every point; and the
    description of what `run` returns.
    """

    blocks: Blocks
    times: dict[str, np.ndarray]
    structure: dict[str, Any] | None


def new_store(engine: Any, axes: Axes, shares: int) -> NewStore:
    """What a new store needs, found by computing a first chunk of points."""
    first = np.arange(min(engine.program.chunk, axes.size))
    seconds, values, status = engine.timed(first)
    good = np.flatnonzero(np.isin(status.result, GOOD))
    lane = good[0] if len(good) else 0
    one = jax.tree.map(lambda x: jnp.asarray(x[lane]), values)
    blocks = divided(axes.shape, _block(engine, axes, shares, seconds))
    return NewStore(blocks, _times(engine, axes, one), description_of(engine.program.values, one))


def _block(engine: Engine, axes: Axes, shares: int, seconds: float):
    """Points per block: a few seconds' worth, at least `shares` blocks, and no more bytes than allowed."""
    chunk = engine.program.chunk
    wanted = max(1, round(BLOCK_SECONDS * engine.workers / max(seconds, 1e-6))) * chunk
    fair = max(1, axes.size // (shares * chunk)) * chunk
    fits = max(1, int(BLOCK_BYTES / (engine.program.bytes_of_point * chunk))) * chunk
    return min(wanted, fair, fits)


def _times(engine: Engine, axes: Axes, one: PyTree):
    labels = labels_of(axes, engine.program.values).values
    named = dict(named_leaves(one))
    times = [key for key, label in labels.items() if label.times and np.ndim(named[key]) == 1]
    return {key: np.asarray(named[key]) for key in times if _is_fixed(engine, axes, key)}


def _is_fixed(engine: Engine, axes: Axes, key: str):
    """Whether a leaf of what `run` returns does not depend on the point: `vmap` with `out_axes=None` decides."""

    def leaf(point: dict[str, Any]):
        return dict(named_leaves(engine.run(point)))[key]

    try:
        jax.eval_shape(jax.vmap(leaf, out_axes=None), axes.at(np.zeros(1, int)))
    except ValueError as error:
        if "out_axes" not in str(error):
            raise
        return False
    return True


class Filling:
    """Blocks that are computed together: each is written as soon as all of its points have arrived."""

    def __init__(self, engine: Any, store: Store, numbers: list[int]):
        self.store, self.numbers = store, numbers
        points = [store.blocks.points(number) for number in numbers]
        self.indices = np.concatenate([np.arange(x.start, x.stop) for x in points])
        lengths = np.array([x.stop - x.start for x in points])
        self._ends, self._left = np.cumsum(lengths), lengths
        self._results = not_run(engine.program, len(self.indices))

    def take(self, positions: np.ndarray, values: Any, status: Status):
        """Accept the results at some positions among the indices."""
        for whole, new in zip(jax.tree.leaves(self._results), jax.tree.leaves((values, status))):
            whole[positions] = new
        block_of_point = np.searchsorted(self._ends, positions, side="right")
        self._left = self._left - np.bincount(block_of_point, minlength=len(self._left))
        for i in np.unique(block_of_point)[self._left[np.unique(block_of_point)] == 0].tolist():
            start = 0 if i == 0 else self._ends[i - 1]
            self.store.write(self.numbers[i], *jax.tree.map(lambda x: x[start : self._ends[i]], self._results))


def groups_of_blocks(engine: Any, store: Store, numbers: list[int]) -> Iterator[list[int]]:
    """Groups of blocks to compute together: their points fill the chunks of the program and fit into memory."""
    points = min(FULL_CHUNKS * engine.program.chunk, int(BLOCK_BYTES / engine.program.bytes_of_point))
    group, count = [], 0
    for number in numbers:
        here = store.blocks.points(number)
        if group and count + here.stop - here.start > points:
            yield group
            group, count = [], 0
        group.append(number)
        count += here.stop - here.start
    if group:
        yield group


def compare_versions(engine: Any, store: Store) -> None:
    """If other versions began the store, recompute some of its points and warn if they differ."""
    stored, number = store.about["fingerprint"], store.first()
    if stored["program"] == engine.program.digest or number is None:
        return
    indices = np.r_[store.blocks.points(number)][: engine.program.chunk]
    found, status = engine.first(indices)
    worst, name = 0.0, None
    for (leaf, x), stored_values in zip(named_leaves(found), (x[: len(indices)] for x in store.read(number))):
        good = np.isin(status.result, GOOD)
        x, stored_values = x[good].astype(complex), stored_values[good].astype(complex)
        largest = np.max(np.abs(stored_values), initial=0.0)
        difference = np.max(np.abs(x - stored_values), initial=0.0) / (largest if largest > 0 else 1.0)
        if not difference <= worst:
            worst, name = difference, leaf
    if not worst <= ALIKE_VERSIONS:
        warnings.warn(
            f"{store.path} was begun with {in_words(stored['versions'])} and is continued with {in_words(versions())}: "
            f"of {len(indices):,} points computed again, '{name}' differs by {worst:.1e} of its largest value.\n"
            "Usual cause: run is not the same function as before; or a motion that amplifies round-off.\n"
            "Fix: another path, to compute the whole sweep again.",
            stacklevel=4,
        )
