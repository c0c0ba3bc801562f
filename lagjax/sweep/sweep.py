"""The entry point of sweeps: compile once, run on all devices or workers, keep what was done; how a store is filled."""

import os
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import meter
from lagjax.sweep.axes import Axes, Blocks, axes_of, divided
from lagjax.sweep.engine import CHUNKS_EACH, GOOD, LAYOUTS, Engine, Program, Status, chunk_length, not_run, usable_cores
from lagjax.sweep.executor import FEWEST_TASKS, Remote, Stopped
from lagjax.sweep.labels import labels_of, named_leaves, shapes_of
from lagjax.sweep.metadata import check_file_names, in_words, versions
from lagjax.sweep.objects import Files
from lagjax.sweep.result import Stored, Sweep, of_store
from lagjax.sweep.store import Store, chunk_of, description_of, open_store, warn_of_damage

# A block of a store is written about this often, and holds no more bytes than this. Long sweeps have longer blocks, so
# that there are no more of them than this.
BLOCK_SECONDS, BLOCK_BYTES, MOST_BLOCKS = 2.0, 256e6, 10_000
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


def _block(engine: Any, axes: Axes, shares: int, seconds: float):
    """Points per block: a few seconds' worth, at least `shares` blocks, and no more bytes than allowed."""
    chunk = engine.program.chunk
    wanted = max(1, round(BLOCK_SECONDS * engine.workers / max(seconds, 1e-6))) * chunk
    wanted = max(wanted, -(-axes.size // (MOST_BLOCKS * chunk)) * chunk)
    fair = max(1, axes.size // (shares * chunk)) * chunk
    fits = max(1, int(BLOCK_BYTES / (engine.program.bytes_of_point * chunk))) * chunk
    return min(wanted, fair, fits)


def _times(engine: Any, axes: Axes, one: PyTree):
    labels = labels_of(axes, engine.program.values).values
    named = dict(named_leaves(one))
    times = [key for key, label in labels.items() if label.times and np.ndim(named[key]) == 1]
    return {key: np.asarray(named[key]) for key in times if _is_fixed(engine, axes, key)}


def _is_fixed(engine: Any, axes: Axes, key: str):
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
    """Groups of blocks to compute together: their points fill the program's chunks, or a task, and fit into memory."""
    full = FULL_CHUNKS * engine.program.chunk
    if isinstance(engine, Remote):
        full = engine.points_of_task(store.blocks.size(numbers))
    points = min(full, int(BLOCK_BYTES / engine.program.bytes_of_point))
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
    stored = store.about["fingerprint"]
    number = None if stored["program"] == engine.program.digest else store.first()
    if number is None:
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
            f"{store.place} was begun with {in_words(stored['versions'])}, continued with {in_words(versions())}: "
            f"of {len(indices):,} points computed again, '{name}' differs by {worst:.1e} of its largest value.\n"
            "Usual cause: run is not the same function as before; or a motion that amplifies round-off.\n"
            "Fix: another path, to compute the whole sweep again.",
            stacklevel=4,
        )


# Points per call of the compiled program. On a CPU a call costs 0.2 ms, and larger chunks gain nothing; a GPU needs
# more to be fully used.
CHUNK = {"cpu": 1024, "gpu": 65536}
# The largest part of the free memory that a sweep may use.
FILL_AT_MOST = 0.8


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
    on: Any = None,
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

    - `run(point)`: any JAX function; `point` is a dictionary with one scalar (or slice) per axis. It may return any
      pytree of numbers and arrays: a final state, a period, a gradient, a whole `Trajectory`. `integrate` needs no
      special options in it: it does not raise, and `status` records how it ended.
    - `axes`: the parameters that vary, arrays (n, ...) by name. They form a grid of all combinations, the last axis
      fastest; with `paired` they all move together.

    **Long sweeps:**

    - `store`: a directory, or any URL that fsspec opens (`"s3://bucket/name"`), to which blocks of points are written
      as they are finished (zarr). When the same sweep is called again, only missing points are computed; a store of
      another sweep is refused. Stored files are read once and checked against their checksums; damaged blocks cause a
      warning and are computed again.
    - `accept_versions`: continue a store that other versions of lagjax, jax or diffrax began. Whether `run` is still
      the same function is then unknown: a few points are computed again, with a warning if they differ.
    - `on`: the workers that compute the points, by their executor: a `distributed.Client` of Dask, a pool of processes
      or of MPI, anything with `submit` and futures. They write to the store themselves. Workers that have other
      versions are refused. Needs `pip install "lagjax[cluster]"`.
    - `part`: (k, n): this process computes every n-th block from the k-th on; by default taken from `jax.distributed`.
    - `progress`: show points done, rate and time left (tqdm); by default in a terminal or a notebook.

    **How it runs** (`print(swept)` shows it):

    - `chunk`: points per call of the compiled program.
    - `layout`: `"vmap"` runs lanes together (those that take more than 32,768 steps are run again alone); `"map"` runs
      them one after the other.
    - `sort`: first run a few points, then all points in the order of the steps they are expected to take, so that a few
      long lanes do not hold up the rest; by default with `"vmap"`, from 16,000 points on.
    - `devices`: JAX devices between which each chunk is split; by default all.
    - `workers`: chunks computed at the same time; by default one per CPU core, or two; with `on`, by each of its tasks,
      one.

    A second call compiles nothing if the axes have the same names, shapes and dtypes, whatever their values and
    lengths, and `run` is the same function, or one with the same code that reads the same values from outside.

    **Returns:** a `Sweep`. After an interruption (Ctrl-C) it has the finished points; `swept.resweep()` runs the rest.

    **Raises:** `TypeError`, `ValueError` for invalid axes and settings, or another sweep's store; `MemoryError`
    if the values would not fit, before anything runs.
    """
    if not callable(run):
        raise TypeError(
            f"run must be a function of a point, not {type(run).__name__}.\n"
            "Fix: lambda point: lj.integrate(system, q0, v0, params | point, ts=ts).q."
        )
    grid = axes_of(axes, paired)
    if on is not None and devices is not None:
        raise ValueError("with on= the devices are those of each worker.\nFix: leave devices out.")
    devices = jax.local_devices() if devices is None else list(devices)
    here = (jax.process_index(), jax.process_count()) if on is None else (0, 1)
    part = here if part is None else part
    _check(layout, part, store)
    platform = devices[0].platform
    cores = usable_cores() if platform == "cpu" else 2
    if workers is None:
        workers = 1 if on is not None else cores if len(devices) == 1 else 2
    files = None if store is None else Files(store)
    if chunk is None and files is not None:
        # A store keeps its chunk length, even when it is continued on another number of cores.
        chunk = chunk_of(files)
    if chunk is None:
        tasks = workers if on is None else FEWEST_TASKS // CHUNKS_EACH
        chunk = chunk_length(grid.size, tasks, CHUNK.get(platform, CHUNK["gpu"]))
    if on is None:
        engine = Engine(run, grid, chunk, workers, sort, layout, devices, progress)
    else:
        engine = Remote(on, run, grid, chunk, workers, sort, layout, progress)
    if files is not None:
        labels = labels_of(grid, engine.program.values)
        check_file_names("axis", labels.axes)
        check_file_names("value", [label.name for label in labels.values.values()])
    _check_memory(grid, engine.program, workers, store, devices)
    if files is None:
        return _in_memory(engine, np.arange(grid.size), None)
    return _in_store(engine, grid, files, part, accept_versions)


def _in_memory(engine: Any, indices: np.ndarray, before: PyTree):
    started, axes = time.perf_counter(), engine.axes
    values, status = not_run(engine.program, axes.size) if before is None else jax.tree.map(np.copy, before)
    done = 0
    with _meter(len(indices), engine.progress) as shown:
        try:
            for positions, found, how in engine.over(indices):
                at = indices[positions]
                # Consecutive points are written as a slice, which is five times as fast.
                at = slice(at[0], at[0] + len(at)) if np.all(np.diff(at) == 1) else at
                for whole, new in zip(jax.tree.leaves((values, status)), jax.tree.leaves((found, how))):
                    whole[at] = new
                done += len(positions)
                shown.update(len(positions))
        except (KeyboardInterrupt, Stopped) as why:
            _tell_interrupted(why, done, len(indices), "swept.resweep() runs the rest.")
    compiling, seconds = engine.seconds_since(started)
    again = _Again((engine.chunk, engine.workers, engine.sort, engine.layout), engine)
    return Sweep(axes, values, status, engine.words, done, compiling, seconds, again)


class _Again:
    """Runs points of a sweep in memory again; a pickle has neither the engine that ran it nor `run`."""

    def __init__(self, settings: tuple[int, int, bool | None, str], engine: Any = None):
        self._settings, self._engine = settings, engine

    def __deepcopy__(self, memo: dict):
        return self

    def __reduce__(self):
        return _Again, (self._settings,)

    def __call__(self, swept: Sweep, run: Callable | None, which: np.ndarray) -> Sweep:
        engine = self._engine
        if run is not None:
            chunk, *settings = self._settings
            chunk = chunk_length(len(which), settings[0], chunk)
            devices, progress = (jax.local_devices(), None) if engine is None else (engine.devices, engine.progress)
            engine = Engine(run, swept.axes, chunk, *settings, devices, progress)
        if engine is None:
            raise ValueError(
                "a sweep that was unpickled does not know the function that ran it.\nFix: swept.resweep(run)."
            )
        return _again(swept, engine, which)


def _again(swept: Sweep, engine: Any, which: np.ndarray):
    lead = len(swept.axes.shape)
    flat = jax.tree.map(lambda x: x.reshape(swept.axes.size, *x.shape[lead:]), (swept.values, swept.status))
    there, here = shapes_of(swept.values, lead), shapes_of(engine.program.values, 0)
    if there != here:
        raise ValueError(
            f"this run returns another structure than the sweep: {here}, not {there}.\n"
            "Fix: return the same structure, computed with other settings."
        )
    return _in_memory(engine, which, flat)


def _in_store(engine: Any, axes: Axes, files: Files, part: tuple[int, int], accept_versions: bool):
    started = time.perf_counter()
    new = partial(new_store, engine, axes, engine.shares * part[1])
    store = open_store(files, axes, engine.program, engine.layout, part, accept_versions, new)
    compare_versions(engine, store)
    k, n = part
    missing = [number for number in store.missing().tolist() if number % n == k]
    done = 0
    groups = groups_of_blocks(engine, store, missing)
    with _meter(store.blocks.size(missing), engine.progress) as shown:
        try:
            for count in engine.fill(store, groups) if isinstance(engine, Remote) else _filled(engine, store, groups):
                shown.update(count)
                done += count
        except (KeyboardInterrupt, Stopped) as why:
            # A block that was written just before the interruption counts as well.
            done = store.blocks.size(set(missing) - set(store.missing().tolist()))
            _tell_interrupted(why, done, store.blocks.size(missing), "the same call continues from there.")

    here = f"{engine.words}, in {files.place}"
    files.sizes(again=True)
    status, _, lost = store.status()
    if lost:
        fix = "Fix: this call without part, or with the part to which these blocks belong."
        warn_of_damage(files.place, lost.values(), fix, stacklevel=3)
    compiling, seconds = engine.seconds_since(started)
    return Sweep(axes, Stored(store, engine.program.values), status, here, done, compiling, seconds, of_store)


def _filled(engine: Engine, store: Store, groups: Iterable[list[int]]) -> Iterator[int]:
    """Compute groups of blocks, and write each block as soon as it is complete; yield the points that are done."""
    for numbers in groups:
        filling = Filling(engine, store, numbers)
        for positions, values, status in engine.over(filling.indices):
            filling.take(positions, values, status)
            yield len(positions)


def _check(layout: str, part: tuple[int, int], store: Any):
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(map(repr, LAYOUTS))}, not {layout!r}.")
    k, n = part
    if not 0 <= k < n:
        raise ValueError(f"part must be (k, n) with 0 <= k < n, not {part}.\nFix: part=(0, 2) and part=(1, 2).")
    if n > 1 and store is None:
        raise ValueError(
            f"this is process {k} of {n}, and without a store its points would be lost.\n"
            'Fix: store="a directory that all processes can reach".'
        )


def _check_memory(axes: Axes, program: Program, workers: int, store: Any, devices: list):
    """Raise `MemoryError` if the values would not fit."""
    on_host, free = devices[0].platform == "cpu", _free_memory()
    device_limit = None if on_host else (devices[0].memory_stats() or {}).get("bytes_limit")
    if device_limit is not None and workers * program.working > device_limit:
        raise MemoryError(
            f"a chunk of {program.chunk:,} points needs {program.working / 1e9:.3g} GB on each device, and "
            f"{workers} at a time do not fit into its {device_limit / 1e9:.3g} GB.\nFix: chunk={program.chunk // 4}."
        )
    kept = 0 if store is not None else axes.size * program.bytes_of_point
    needed = kept + (workers * program.working if on_host else 0)
    if free is not None and needed > FILL_AT_MOST * free:
        raise MemoryError(
            f"this sweep needs {needed / 1e9:.3g} GB: {axes.size:,} points of {program.bytes_of_point:,} bytes, and "
            f"{workers} x {program.working / 1e9:.2g} GB of working memory. {free / 1e9:.3g} GB are free.\n"
            "Usual cause: run returns whole trajectories, or a grid with one axis too many.\n"
            'Fix: return less per point (a final state, a period), or store="directory"; or a smaller chunk=.'
        )


def _free_memory():
    """The bytes available without swapping; None if the system does not report them."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    fields = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in lines}
    return fields.get("MemAvailable")


def _tell_interrupted(why: BaseException, done: int, total: int, then: str):
    words = f"stopped: {why}:" if isinstance(why, Stopped) else "interrupted:"
    warnings.warn(f"{words} {done:,} of {total:,} points are done and kept; {then}", stacklevel=4)


def _meter(total: int, progress: bool | None):
    return meter(progress, total=total, unit=" points", unit_scale=True)
