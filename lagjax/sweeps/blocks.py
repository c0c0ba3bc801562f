"""What a store asks of the engine that fills it: points to write together, and whether it is as other versions were."""

import warnings
from typing import Any

import numpy as np

from lagjax.sweeps.axes import Axes
from lagjax.sweeps.fingerprint import in_words, named_leaves, versions
from lagjax.sweeps.lanes import GOOD
from lagjax.sweeps.memory import bytes_of
from lagjax.sweeps.store import Store

# A block of a store is written about so often, and holds no more than this.
BLOCK_SECONDS, BLOCK_BYTES = 2.0, 256e6
# Two versions may differ by so much, relative to the largest value, before it is told.
ALIKE_VERSIONS = 1e-6


def block_of(engine: Any, axes: Axes, shares: int) -> int:
    """Points to write together: some seconds' worth, `shares` of them or more, no more than fits."""
    chunk = engine.program.chunk
    first = np.arange(min(chunk, axes.size))
    seconds = max(engine.seconds_of(first), 1e-6)
    wanted = max(1, round(BLOCK_SECONDS * engine.workers / seconds)) * chunk
    fair = max(1, axes.size // (shares * chunk)) * chunk
    fits = max(1, int(BLOCK_BYTES / (bytes_of(engine.program) * chunk))) * chunk
    return min(wanted, fair, fits)


def compare_versions(engine: Any, store: Store) -> None:
    """Where other versions have begun a store, compute some of its points again and tell how they differ."""
    there, number = store.about["fingerprint"], store.first()
    if there["program"] == engine.program.digest or number is None:
        return
    indices = np.r_[store.points(number)][: engine.program.chunk]
    found, status = engine.first(indices)
    worst, name = 0.0, None
    for (leaf, x), before in zip(named_leaves(found), store.read(indices)):
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
