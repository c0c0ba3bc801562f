"""How a sweep's compiled program is called: in chunks, by several workers, with long lanes run separately."""

import math
import os
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from itertools import islice

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import RESULTS
from lagjax.jaxtools import TOGETHER
from lagjax.sweep.axes import Axes
from lagjax.sweep.batch_program import Program, program_for, raised

# Each worker gets at least this many chunks, so that none waits long for the last one.
CHUNKS_EACH = 4
# The number of pilot points; their steps determine the order of the rest.
PILOTS = 256
# Sorting gains nothing if the longest pilot point takes at most this many times the mean number of steps.
SIMILAR_STEPS = 1.5
# Lanes that run together wait for the longest: a lane that takes more steps than this is run again alone.
PATIENCE = 2**15
# If more than this part of a chunk is not settled, the next chunks use the robust program from the start.
MOSTLY_UNSETTLED = 0.25
MAX_STEPS = int(RESULTS.max_steps_reached._value)


class Engine:
    """A compiled program and how it is called.

    The first program assumes regular motions, which compiles in two thirds of the time; the robust program is compiled
    only when a point turns out to need it.
    """

    def __init__(
        self,
        run: Callable,
        axes: Axes,
        chunk: int,
        workers: int,
        sort: bool | None,
        layout: str,
        devices: list,
        progress: bool | None,
    ):
        self.run, self.axes, self.chunk = run, axes, math.ceil(chunk / len(devices)) * len(devices)
        self.workers, self.sort, self.layout, self.devices = workers, sort, layout, devices
        self.progress = progress
        self._patience = PATIENCE if layout == "vmap" else None
        self.program, seconds = self._program(robust=False, progress=progress)
        # Seconds of compiling before anything ran, and since then.
        self._compiling = [seconds, 0.0]
        self._lock, self._single_lane_program, self._robust_program = threading.Lock(), None, None
        # Whether a point at which a callback raised was already told of.
        self._told = False

    def seconds_since(self, started: float):
        """The seconds of compiling (including those before `started`) and of computing since `started`."""
        spent, (earlier, later) = time.perf_counter() - started, self._compiling
        self._compiling = [0.0, 0.0]
        return earlier + later, spent - later

    @property
    def words(self):
        """A description of how the program is called."""
        platform, count = self.devices[0].platform, len(self.devices)
        where = platform if count == 1 else f"{count} {platform}s"
        of_workers = f"{self.workers} worker{'s' * (self.workers > 1)}"
        return f"{where}, {of_workers}, lanes {self.layout}, chunks of {self.chunk}"

    def _program(self, robust: bool, progress: bool | None = False):
        chunk, devices, layout = self.chunk, self.devices, self.layout
        return program_for(self.run, self.axes, chunk, devices, layout, self._patience, robust, progress)

    def timed(self, indices: np.ndarray):
        """(seconds of computing, values, status) at no more than `chunk` indices."""
        started, (_, compiling) = time.perf_counter(), self._compiling
        results = self.first(indices)
        return time.perf_counter() - started - (self._compiling[1] - compiling), *results

    def first(self, indices: np.ndarray):
        """(values, status) at no more than `chunk` indices, before lanes that were given up are run alone."""
        if self.program.irregular.is_set():
            return self._robustly(indices)
        values, status, settled = self._call(self.program, indices)
        if settled is None or settled.all():
            return values, status
        if np.mean(~settled) > MOSTLY_UNSETTLED:
            self.program.irregular.set()
        return _replaced((values, status), ~settled, self._robustly(indices[~settled]))

    def _robustly(self, indices: np.ndarray):
        return self._call(self._robust_lanes, indices)[:2]

    def _call(self, program: Program, indices: np.ndarray):
        """(values, status, settled) at no more than `chunk` indices; NaN at points where a callback raises.

        JAX drops a whole call if a function in it raises in one lane: the call is halved until those lanes are found.
        """
        chunk = program.chunk
        try:
            return program.call(self.axes.at(np.resize(indices, chunk)), len(indices))
        except jax.errors.JaxRuntimeError as error:
            if "callback" not in str(error).lower():
                raise
            if len(indices) == 1:
                return self._raised(program, indices, str(error))
        halves = [self._call(program, part) for part in np.array_split(indices, 2)]
        return jax.tree.map(lambda *x: np.concatenate(x), *halves)

    def _raised(self, program: Program, indices: np.ndarray, message: str):
        with self._lock:
            told, self._told = self._told, True
        if not told:
            point = {name: np.asarray(x)[0] for name, x in self.axes.at(indices).items()}
            lines = [line.strip() for line in message.splitlines() if line.strip()]
            warnings.warn(
                f"at {', '.join(f'{name} = {x}' for name, x in point.items())} a function that is called in Python "
                f"raised: {lines[-1]:.200}. The point is NaN, as others like it; swept.counts() counts them.",
                stacklevel=2,
            )
        return *raised(program), np.ones(1, bool) if program.settles else None

    def at(self, indices: np.ndarray):
        """(values, status) at no more than `chunk` indices; lanes that were given up are run again alone."""
        values, status = self.first(indices)
        given_up = (status.result == MAX_STEPS) & (status.steps >= PATIENCE) & (self.layout == "vmap")
        if not given_up.any():
            return values, status
        alone = [self._call(self._single_lane, indices[i : i + 1])[:2] for i in np.flatnonzero(given_up)]
        return _replaced((values, status), given_up, jax.tree.map(lambda *x: np.concatenate(x), *alone))

    @property
    def _single_lane(self):
        # Compiled only if a lane needs it.
        with self._lock:
            if self._single_lane_program is None:
                self._single_lane_program, seconds = program_for(self.run, self.axes, 1, self.devices[:1], "map")
                self._compiling[1] += seconds
        return self._single_lane_program

    @property
    def _robust_lanes(self):
        with self._lock:
            if self._robust_program is None:
                self._robust_program, seconds = self._program(robust=True)
                self._compiling[1] += seconds
        return self._robust_program

    def over(self, indices: np.ndarray):
        """Yield (positions among the indices, values, status) of chunks as they are finished, in any order."""
        chunk, order = self.chunk, self._order(indices)
        chunks = (order[start : start + chunk] for start in range(0, len(indices), chunk))

        def task(positions: np.ndarray):
            return positions, *self.at(indices[positions])

        if self.workers == 1:
            yield from map(task, chunks)
            return
        pool = ThreadPoolExecutor(self.workers)
        try:
            # Only a few are submitted at a time: finished chunks that are not yet taken would fill the memory.
            running = {pool.submit(task, positions) for positions in islice(chunks, 2 * self.workers)}
            while running:
                done, running = wait(running, return_when=FIRST_COMPLETED)
                for future in done:
                    running |= {pool.submit(task, positions) for positions in islice(chunks, 1)}
                    yield future.result()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _order(self, indices: np.ndarray):
        """The positions of the indices; sorted by steps, estimated from pilot points, if lanes wait for each other."""
        positions = np.arange(len(indices))
        sorting = self.layout == "vmap" and len(indices) >= 64 * PILOTS if self.sort is None else self.sort
        if not sorting:
            return positions
        pilots = positions[:: max(1, len(indices) // min(self.chunk, PILOTS))][: self.chunk]
        steps = self.first(indices[pilots])[1].steps
        if self.sort is None and steps.max() <= SIMILAR_STEPS * steps.mean():
            return positions
        return np.argsort(np.interp(positions, pilots, steps), kind="stable")


def _replaced(results: PyTree, positions: np.ndarray, others: PyTree):
    """Values and statuses in which some positions are replaced by `others`."""
    results = jax.tree.map(np.array, results)
    for whole, new in zip(*map(jax.tree.leaves, (results, others))):
        whole[positions] = new
    return results


def chunk_length(count: int, workers: int, most: int) -> int:
    """The points per chunk, rounded to few lengths, so that a sweep with a few more points uses the same program.

    Large chunks are rounded down, which costs more calls; small chunks are rounded up and padded with unused points.
    """
    length = max(math.ceil(count / (CHUNKS_EACH * workers)), min(TOGETHER, math.ceil(count / workers)))
    length = min(length, most)
    if length >= TOGETHER:
        return 2 ** (length.bit_length() - 1)
    step = 2 ** max(0, length.bit_length() - 4)
    return min(math.ceil(length / step) * step, most)


def usable_cores() -> int:
    """The cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
