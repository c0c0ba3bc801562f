"""The front door of sweeps: compile once, run everywhere, lose nothing."""

import math
import os
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from itertools import islice
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import ArrayLike

from lagjax.jax_internals.one_function import TOGETHER
from lagjax.meter import meter
from lagjax.motion.trajectory import RESULTS
from lagjax.sweeps.axes import axes_of
from lagjax.sweeps.blocks import block_of, compare_versions
from lagjax.sweeps.fingerprint import check_file_names, named_leaves
from lagjax.sweeps.lanes import LAYOUTS, NOT_RUN, STATUS_TYPES, Status
from lagjax.sweeps.memory import check_memory
from lagjax.sweeps.remembered import program_for
from lagjax.sweeps.result import Stored, Sweep
from lagjax.sweeps.store import chunk_of, open_store, tell

# Points for one call of the compiled program. On a CPU a call costs 0.2 ms, and more gains nothing; a GPU is filled.
CHUNK = {"cpu": 1024, "gpu": 65536}
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


def sweep(
    run: Callable[[dict[str, Any]], Any],
    axes: Mapping[str, ArrayLike],
    *,
    paired: bool = False,
    store: str | os.PathLike | None = None,
    accept_versions: bool = False,
    part: tuple[int, int] | None = None,
    chunk: int | None = None,
    layout: str = "vmap",
    devices: list | None = None,
    sort: bool | None = None,
    workers: int | None = None,
    progress: bool | None = None,
) -> Sweep:
    """Call `run` at every point of a grid, in parallel, and label what it returns.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
    >>> def run(point):
    ...     return lj.integrate(swing, point["angle"], 0.0, {"g": point["g"]}, ts=jnp.array([0.0, 1.0])).q[-1]
    >>> swept = sweep(run, {"g": jnp.array([1.0, 4.0]), "angle": jnp.linspace(0.0, 1.0, 3)}, progress=False)
    >>> print(swept.values.round(4), swept.counts())
    [[ 0.      0.2777  0.6001]
     [ 0.     -0.1947 -0.3062]] {'successful': 6}

    **Main arguments:**

    - `run(point)`: any JAX function; `point` is a dictionary with one scalar (or slice) an axis, and what it returns is
      any pytree of numbers and arrays: a final state, a period, a gradient, a whole `Trajectory`. `integrate` needs
      nothing special in it: it does not raise, and how it went is in `status`.
    - `axes`: what varies, arrays (n, ...) by name. A grid of all combinations, the last axis fastest; with `paired` all
      move together.

    **Long sweeps:**

    - `store`: a directory, to which blocks of points are written as they are finished (zarr). Called again with the
      same sweep, only what is missing is computed; a store of another sweep is refused. What is there is read once and
      checked against its checksums; what is not whole is told, and computed again.
    - `accept_versions`: go on with a store that other versions of lagjax, jax or diffrax have begun. Whether `run` is
      still the same function cannot be told then: a few points are computed again, and told if they differ.
    - `part`: (k, n): this process computes every n-th block from the k-th on; by default as `jax.distributed` says.
    - `progress`: show points done, rate and time left (tqdm); by default where somebody may look.

    **How it runs,** which `print(swept)` says:

    - `chunk`: points for one call of the compiled program.
    - `layout`: lanes `"vmap"` (`vmap`; those that take more than 32,768 steps are run again alone), or one after
      the other, `"map"`.
    - `sort`: first run a few points and then all in the order of their steps, so that a few long lanes do not hold the
      rest; by default for lanes together, from 16,000 points on.
    - `devices`: JAX devices to split each chunk between; by default all.
    - `workers`: chunks at a time; by default the cores of the CPU, or two.

    Called again for the same function, or one that is written anew and reads the same from outside, over axes of the
    same names, shapes and dtypes, it compiles nothing, whatever their values and lengths.

    **Returns:** a `Sweep`. Interrupted (Ctrl-C) it has what was done, and `swept.resweep()` does the rest.

    **Raises:** `TypeError`, `ValueError` for axes and settings that make no sense, or another sweep's store;
    `MemoryError` where the values would not fit, before anything runs.
    """
    if not callable(run):
        raise TypeError(
            f"run must be a function of a point, not {type(run).__name__}.\n"
            "Fix: lambda point: lj.integrate(system, q0, v0, params | point, ts=ts).q."
        )
    grid = axes_of(axes, paired)
    devices = jax.local_devices() if devices is None else list(devices)
    part = (jax.process_index(), jax.process_count()) if part is None else part
    _check(layout, part, store)
    platform = devices[0].platform
    cores = usable_cores() if platform == "cpu" else 2
    workers = (cores if len(devices) == 1 else 2) if workers is None else workers
    if chunk is None and store is not None and Path(store).exists():
        # What was begun on other cores goes on as it was begun.
        chunk = chunk_of(store)
    elif chunk is None:
        chunk = _length(grid.size, workers, CHUNK.get(platform, CHUNK["gpu"]))
    engine = _Engine(run, grid, chunk, workers, sort, layout, devices, progress)
    if store is not None:
        check_file_names("axis", list(grid.names))
        check_file_names("value", [name for name, _ in named_leaves(engine.program.values)])
    check_memory(grid, engine.program, workers, store, devices)
    if store is None:
        return _in_memory(engine, np.arange(grid.size), None)
    return _in_store(engine, grid, Path(store), part, accept_versions)


class _Engine:
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
        chunk = _length(count, self.workers, self.chunk)
        return _Engine(run, self.axes, chunk, self.workers, self.sort, self.layout, self.devices, self.progress)

    def _program(self, robust, progress=False):
        chunk, devices, layout = self.chunk, self.devices, self.layout
        return program_for(self.run, self.axes, chunk, devices, layout, self._patience, robust, progress)

    def seconds_of(self, indices):
        """The seconds of computing at no more than `chunk` indices."""
        started, (_, compiling) = time.perf_counter(), self._compiling
        self.first(indices)
        return time.perf_counter() - started - (self._compiling[1] - compiling)

    def first(self, indices):
        """(values, status) at no more than `chunk` indices, as the programs of many lanes have them."""
        if self.program.irregular.is_set():
            return self._carefully(indices)
        values, status, settled = self._called(self.program, indices)
        if settled is None or settled.all():
            return values, status
        if np.mean(~settled) > MOSTLY:
            self.program.irregular.set()
        return _replaced((values, status), ~settled, self._carefully(indices[~settled]))

    def _carefully(self, indices):
        return self._called(self._careful, indices)[:2]

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
    def _careful(self):
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


def _in_memory(engine, indices, before):
    started, axes = time.perf_counter(), engine.axes
    values, status = _not_run(engine.program, axes.size) if before is None else jax.tree.map(np.copy, before)
    done = 0
    with _meter(len(indices), engine.progress) as shown:
        try:
            for places, found, how in engine.over(indices):
                at = indices[places]
                # Neighbours are written as a slice, five times as fast.
                at = slice(at[0], at[0] + len(at)) if np.all(np.diff(at) == 1) else at
                for whole, some in zip(jax.tree.leaves((values, status)), jax.tree.leaves((found, how))):
                    whole[at] = some
                done += len(places)
                shown.update(len(places))
        except KeyboardInterrupt:
            _tell_interrupted(done, len(indices), "swept.resweep() does the rest.")
    compiling, seconds = engine.seconds_since(started)

    def again(swept, other, which):
        if len(which) == 0:
            return swept
        flat = jax.tree.map(lambda x: x.reshape(axes.size, *x.shape[len(axes.shape) :]), (swept.values, swept.status))
        rerun = engine if other is None else engine.with_run(other, len(which))
        if jax.tree.structure(rerun.program.values) != jax.tree.structure(engine.program.values):
            raise ValueError(
                f"this run returns another structure than the sweep has: {jax.tree.structure(rerun.program.values)}, "
                f"not {jax.tree.structure(engine.program.values)}.\nFix: return the same, computed with other settings."
            )
        return _in_memory(rerun, which, flat)

    return Sweep(axes, values, status, engine.words, done, compiling, seconds, again)


def _not_run(program, count):
    """Room for the values and statuses of some points: NaN, or 0 in numbers that have none."""
    nothing = lambda x: np.nan if np.issubdtype(x.dtype, np.inexact) else 0
    values = jax.tree.map(lambda x: np.full((count, *x.shape), nothing(x), x.dtype), program.values)
    fills = (NOT_RUN, 0, np.nan, np.nan)
    return values, Status(*(np.full(count, fill, dtype) for fill, dtype in zip(fills, STATUS_TYPES)))


def _in_store(engine, axes, path, part, accept_versions):
    started = time.perf_counter()
    block = None if path.exists() else block_of(engine, axes, CHUNKS_EACH * part[1])
    store = open_store(path, axes, engine.program, engine.layout, block, part, accept_versions)
    compare_versions(engine, store)
    k, n = part
    missing = [number for number in store.missing().tolist() if number % n == k]
    length = lambda number: store.points(number).stop - store.points(number).start
    done = 0
    with _meter(sum(map(length, missing)), engine.progress) as shown:
        try:
            for number in missing:
                indices = np.r_[store.points(number)]
                values, status = _not_run(engine.program, len(indices))
                for places, found, how in engine.over(indices):
                    for whole, some in zip(jax.tree.leaves((values, status)), jax.tree.leaves((found, how))):
                        whole[places] = some
                    shown.update(len(places))
                store.write(number, values, status)
                done += len(indices)
        except KeyboardInterrupt:
            # A block that was written in this moment is there, too.
            done = sum(map(length, set(missing) - set(store.missing().tolist())))
            _tell_interrupted(done, sum(map(length, missing)), "the same call goes on from there.")

    def again(swept, other, which):
        raise ValueError(
            "what is in a store belongs to the run that it was begun with.\n"
            "Fix: lj.sweep(other, axes of what failed, paired=True), or a sweep without a store."
        )

    here = f"{engine.words}, in {path}"
    status, _, lost = store.status()
    if lost:
        tell(path, lost.values(), "Fix: this call without part, or with the part that they belong to.", stacklevel=3)
    compiling, seconds = engine.seconds_since(started)
    return Sweep(axes, Stored(store, engine.program.values), status, here, done, compiling, seconds, again)


def _check(layout, part, store):
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(map(repr, LAYOUTS))}, not {layout!r}.")
    k, n = part
    if not 0 <= k < n:
        raise ValueError(f"part must be (k, n) with 0 <= k < n, not {part}.\nFix: part=(0, 2) and part=(1, 2).")
    if n > 1 and store is None:
        raise ValueError(
            f"this is process {k} of {n}, and without a store nobody gets its points.\n"
            'Fix: store="a directory that all processes see".'
        )


def _length(count, workers, most):
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


def _tell_interrupted(done, total, then):
    warnings.warn(f"interrupted: {done:,} of {total:,} points are done and kept; {then}", stacklevel=4)


def _meter(total, progress):
    return meter(progress, total=total, unit=" points", unit_scale=True)
