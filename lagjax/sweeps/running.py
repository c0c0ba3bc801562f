"""A sweep's compiled program, and how it is called: in chunks, by several workers, long lanes apart."""

import math
import os
import threading
import time
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from itertools import islice

import jax
import numpy as np

from lagjax.jax_internals.one_function import TOGETHER
from lagjax.motion.results import RESULTS
from lagjax.sweeps.remembered import program_for

# On a CPU each core gets so many chunks or more, so that none waits long for the last.
CHUNKS_EACH = 4
# Points whose steps tell the order of the rest.
PILOTS = 256
# The longest of which takes no more than this times the mean: nothing is gained by sorting.
ALIKE = 1.5
# Lanes together wait for the longest: one that takes more steps than this is run again, alone.
PATIENCE = 2**15
# Where more points of a chunk than this part are not settled, the next ones are not taken for regular.
MOSTLY = 0.25
MAX_STEPS = int(RESULTS.max_steps_reached._value)


class Engine:
    """A compiled program and how it is called.

    It takes motions for regular, which compiles in two thirds of the time: the robust program is compiled when a point
    turns out to need it.
    """

    def __init__(self, run, axes, chunk, workers, sort, layout, devices, progress):
        self.run, self.axes, self.chunk = run, axes, math.ceil(chunk / len(devices)) * len(devices)
        self.workers, self.sort, self.layout, self.devices = workers, sort, layout, devices
        self.progress = progress
        self._patience = PATIENCE if layout == "vmap" else None
        self.program, seconds = self._program(robust=False, progress=progress)
        # Before anything runs, and since then.
        self._compiling = [seconds, 0.0]
        self._lock, self._one, self._slow = threading.Lock(), None, None

    def seconds_since(self, started):
        """The seconds of compiling and of computing since then; what was compiled before it for that, too."""
        spent, (earlier, later) = time.perf_counter() - started, self._compiling
        self._compiling = [0.0, 0.0]
        return earlier + later, spent - later

    @property
    def words(self):
        """How it is called, as a person says it."""
        platform, count = self.devices[0].platform, len(self.devices)
        where = platform if count == 1 else f"{count} {platform}s"
        of_workers = f"{self.workers} worker{'s' * (self.workers > 1)}"
        return f"{where}, {of_workers}, lanes {self.layout}, chunks of {self.chunk}"

    def with_run(self, run, count):
        """The same for another run, over `count` points."""
        chunk = chunk_length(count, self.workers, self.chunk)
        return Engine(run, self.axes, chunk, self.workers, self.sort, self.layout, self.devices, self.progress)

    def _program(self, robust, progress=False):
        chunk, devices, layout = self.chunk, self.devices, self.layout
        return program_for(self.run, self.axes, chunk, devices, layout, self._patience, robust, progress)

    def timed(self, indices):
        """(the seconds of computing at no more than `chunk` indices, values, status)."""
        started, (_, compiling) = time.perf_counter(), self._compiling
        found = self.first(indices)
        return time.perf_counter() - started - (self._compiling[1] - compiling), *found

    def first(self, indices):
        """(values, status) at no more than `chunk` indices, as the programs of many lanes have them."""
        if self.program.irregular.is_set():
            return self._robustly(indices)
        values, status, settled = self._called(self.program, indices)
        if settled is None or settled.all():
            return values, status
        if np.mean(~settled) > MOSTLY:
            self.program.irregular.set()
        return _replaced((values, status), ~settled, self._robustly(indices[~settled]))

    def _robustly(self, indices):
        return self._called(self._robust, indices)[:2]

    def _called(self, program, indices):
        return program.call(self.axes.at(np.resize(indices, self.chunk)), len(indices))

    def at(self, indices):
        """(values, status) at no more than `chunk` indices; lanes that were given up are run alone."""
        values, status = self.first(indices)
        given_up = (status.result == MAX_STEPS) & (status.steps >= PATIENCE) & (self.layout == "vmap")
        if not given_up.any():
            return values, status
        alone = [self._alone.call(self.axes.at(indices[i : i + 1]), 1)[:2] for i in np.flatnonzero(given_up)]
        return _replaced((values, status), given_up, jax.tree.map(lambda *x: np.concatenate(x), *alone))

    @property
    def _alone(self):
        # Compiled only where a lane needs it.
        with self._lock:
            if self._one is None:
                self._one, seconds = program_for(self.run, self.axes, 1, self.devices[:1], "map")
                self._compiling[1] += seconds
        return self._one

    @property
    def _robust(self):
        with self._lock:
            if self._slow is None:
                self._slow, seconds = self._program(robust=True)
                self._compiling[1] += seconds
        return self._slow

    def over(self, indices):
        """(places among some indices, values, status) of chunks of them as they are finished, in any order."""
        chunk, order = self.chunk, self._order(indices)
        waiting = (order[start : start + chunk] for start in range(0, len(indices), chunk))
        task = lambda places: (places, *self.at(indices[places]))
        if self.workers == 1:
            yield from map(task, waiting)
            return
        pool = ThreadPoolExecutor(self.workers)
        try:
            # No more than a few at a time: what is finished and not taken yet would fill the memory.
            running = {pool.submit(task, places) for places in islice(waiting, 2 * self.workers)}
            while running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    running |= {pool.submit(task, places) for places in islice(waiting, 1)}
                    yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _order(self, indices):
        """The places of some indices, sorted by the steps that a few of them took, where lanes wait for each other."""
        places = np.arange(len(indices))
        worth = self.layout == "vmap" and len(indices) >= 64 * PILOTS if self.sort is None else self.sort
        if not worth:
            return places
        few = places[:: max(1, len(indices) // min(self.chunk, PILOTS))][: self.chunk]
        steps = self.first(indices[few])[1].steps
        if self.sort is None and steps.max() <= ALIKE * steps.mean():
            return places
        return np.argsort(np.interp(places, few, steps), kind="stable")


def _replaced(found, places, others):
    """Values and statuses with those of some places from elsewhere."""
    found = jax.tree.map(np.array, found)
    for every, some in zip(*map(jax.tree.leaves, (found, others))):
        every[places] = some
    return found


def chunk_length(count: int, workers: int, most: int) -> int:
    """The points of a chunk: of few lengths, so that a sweep of some points more is served by the same program.

    Large chunks are shortened, which costs more calls; small ones are filled with points of which nobody asks.
    """
    each = max(math.ceil(count / (CHUNKS_EACH * workers)), min(TOGETHER, math.ceil(count / workers)))
    each = min(each, most)
    if each >= TOGETHER:
        return 2 ** (each.bit_length() - 1)
    step = 2 ** max(0, each.bit_length() - 4)
    return min(math.ceil(each / step) * step, most)


def usable_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
