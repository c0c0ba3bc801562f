"""The compiled program of a sweep, and how it is called: in chunks, by several workers, long lanes separately.

Lanes run together under `vmap`, each with its own steps; on a CPU `integrate` takes 256 of them at a time. `"map"` runs
one after the other, which is slower in nearly all measurements (`benchmarks/speed/sweep.py`) and needs less memory.

A later sweep that computes the same over axes of the same kinds uses the program of an earlier one. What a sweep
computes is the jaxpr of its function, which is traced for each sweep, so that no stale program is ever used.
"""

import hashlib
import math
import os
import re
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding
from jaxtyping import Array, PyTree

from lagjax.contexts import NAMING, PATIENCE, REGULAR_FIRST
from lagjax.display import waiting
from lagjax.integrate import ENDED_WELL, RESULTS, Trajectory, reporting, watched
from lagjax.jaxtools import (
    TOGETHER,
    ClosedJaxpr,
    Jaxpr,
    KeptProgram,
    Meaning,
    NotKept,
    Said,
    Unusable,
    as_usual,
    bodies,
    content_of,
    is_traced,
    meaning_of,
    one_by_one,
    outlined,
    program_of,
    rebuilt,
    surroundings_for_names,
)
from lagjax.sweep.axes import POINT, Axes
from lagjax.system import Call, check_arguments, in_words

NOT_RUN, LOST = -1, -2
LAYOUTS = ("vmap", "map")


def nothing(dtype: np.dtype) -> float:
    """The fill value of a dtype."""
    return np.nan if np.issubdtype(dtype, np.inexact) else 0


class Status(NamedTuple):
    """How each point ended, as arrays in the shape of the sweep.

    `result` is the code of a `RESULTS` item, -1 if the point was not run, -2 if it is lost from its store; `steps`
    counts the steps of all its integrations; `scaled_error` and `residual` are the worst values of its integrations
    at their outputs (`Trajectory`), 0 if nothing was integrated.
    """

    result: Any
    steps: Any
    scaled_error: Any
    residual: Any


STATUS_TYPES = Status(np.dtype(np.int8), np.dtype(np.int32), np.dtype(np.float32), np.dtype(np.float32))
# Result codes whose values can be trusted, and result codes that have a value at all.
TRUSTED = tuple(int(item._value) for item in ENDED_WELL)
GOOD = (*TRUSTED, *(int(item._value) for item in (RESULTS.drifted, RESULTS.not_converged, RESULTS.misfit)))


class Program(NamedTuple):
    """A compiled program for `chunk` points: shapes of one point's `values`, `working` memory in bytes, a digest.

    `call(point, count)`: (values, status, settled) of the first `count` points, as NumPy arrays; `point` has the values
    of `chunk` points by axis. Points that are not settled need the robust program; settled is None for the robust
    program itself (`settles` is then false). `irregular` is set when many points turn out to need the robust program.
    """

    call: Callable
    chunk: int
    values: PyTree
    working: int
    digest: str
    irregular: threading.Event
    settles: bool

    @property
    def bytes_of_point(self) -> int:
        """The bytes of one point's values and status."""
        of_status = sum(dtype.itemsize for dtype in STATUS_TYPES)
        return of_status + sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(self.values))


def is_motion(x: Any) -> bool:
    """Whether it is a trajectory, which is not taken apart."""
    return isinstance(x, Trajectory)


def point_of(run: Callable) -> Callable:
    """A function of one point that returns (values, `Status`, settled); `reporting` explains `settled`.

    The values of a point that failed are NaN.
    """
    reporting_run = reporting(run)

    def point(at: dict[str, Array]):
        values, report, settled = reporting_run(at)
        if report is None:
            floats = [x for x in jax.tree.leaves(values) if jnp.issubdtype(x.dtype, jnp.inexact)]
            finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in floats])) if floats else jnp.asarray(True)
            result = jnp.where(finite, RESULTS.successful._value, RESULTS.not_finite._value)
            report = (result, 0, 0.0, 0.0)
        status = Status(*(jnp.asarray(x, dtype) for x, dtype in zip(report, STATUS_TYPES)))
        well = jnp.any(jnp.stack([status.result == code for code in GOOD]))

        def masked(x: Any):
            # A trajectory records itself how far it got, and is NaN from there on.
            if is_motion(x) or not jnp.issubdtype(x.dtype, jnp.inexact):
                return x
            return jnp.where(well, x, jnp.nan)

        return jax.tree.map(masked, values, is_leaf=is_motion), status, settled

    return point


@contextmanager
def _explained(run: Callable, axes: Axes, patience: int | None, robust: bool):
    of_user = Call("run", run, (POINT,))
    check_arguments(of_user, "the axes taken one by one; a point is one dictionary")
    with PATIENCE(patience), REGULAR_FIRST(not robust), in_words(of_user, {POINT: axes.values}):
        yield


@as_usual
def traced_point(run: Callable, axes: Axes, patience: int | None, robust: bool) -> tuple[ClosedJaxpr, PyTree]:
    """What the user's function computes at one point, with its motions by their names, and the structure in which it
    does."""
    shaped = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in axes.arrays]
    here = surroundings_for_names()
    with NAMING(here), _explained(run, axes, patience, robust):
        return watched(run, dict(zip(axes.names, shaped)))


@as_usual
def compiled(
    run: Callable,
    axes: Axes,
    chunk: int,
    devices: Sequence,
    layout: str,
    patience: int | None,
    robust: bool,
    point: tuple[Meaning, PyTree],
    compiles: bool = True,
) -> Program:
    """Compile a sweep's program for chunks of some length, split between the devices; or find one that is kept.

    Only the names, shapes and dtypes of the axes matter, and the meaning and the structure of one `point`. Motions are
    given up after `patience` steps, if given. Unless `robust`, motions are assumed to be regular. Without `compiles` it
    says what it gives, and cannot be called.
    """
    meaning, structure = point
    at_point = point_of(run)
    given = {"values": jtu.tree_unflatten(structure, range(structure.num_leaves))}

    def lanes(values: tuple):
        def at(values: tuple):
            return at_point(dict(zip(axes.names, values)))

        return jax.lax.map(at, values) if layout == "map" else jax.vmap(at)(values)

    function, sharding = lanes, SingleDeviceSharding(devices[0])
    if len(devices) > 1:
        mesh, split = Mesh(np.asarray(devices), ("lanes",)), PartitionSpec("lanes")
        function = jax.shard_map(lanes, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
        sharding = NamedSharding(mesh, split)
    shaped = [jax.ShapeDtypeStruct((chunk, *x.shape[1:]), x.dtype, sharding=sharding) for x in axes.arrays]

    def of_arrays(arrays: list):
        with _explained(run, axes, patience, robust):
            return one_by_one(function)(tuple(arrays))

    def meant():
        if len(devices) > 1 or devices[0] != jax.devices()[0]:
            raise NotKept("it runs on another device than the first, or on several")
        return [(meaning, True), ((__name__, axes.names, layout, patience, robust), False)]

    program = KeptProgram(
        of_arrays,
        Said(
            meant,
            lambda results: outlined(results, given),
            lambda outline, arrays: rebuilt(outline, given),
            lambda jaxpr: {"digest": digest(_text(jaxpr).encode())},
        ),
        None,
    )
    ready = program.ready_for(shaped) if compiles else program.traced_for(shaped)
    memory = ready.compiled.memory_analysis() if compiles else None
    working = 0 if memory is None else memory.temp_size_in_bytes + memory.output_size_in_bytes

    @as_usual
    def call(point: dict[str, np.ndarray], count: int):
        nonlocal ready
        arrays = list(point.values())
        try:
            found = ready.call(arrays)
        except Unusable:
            ready = program.made_for(shaped)
            found = ready.call(arrays)
        return jtu.tree_unflatten(ready.structure, [np.asarray(x)[:count] for x in found])

    outputs = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in ready.outputs]
    values, _, settled = jtu.tree_unflatten(ready.structure, outputs)
    return Program(call, chunk, values, working, ready.facts["digest"], threading.Event(), settled is not None)


def program_for(
    run: Callable,
    axes: Axes,
    chunk: int,
    devices: Sequence,
    layout: str,
    patience: int | None = None,
    robust: bool = True,
    progress: bool | None = False,
    compiles: bool = True,
) -> tuple[Program, float]:
    """The program, and the seconds it took to compile; 0 if it was in the cache."""
    seconds = 0.0

    def make():
        nonlocal seconds
        started = time.perf_counter()
        with waiting(progress, "compiling"):
            program = compiled(run, axes, chunk, devices, layout, patience, robust, (meaning, structure), compiles)
        seconds = time.perf_counter() - started
        return program

    program, structure = traced_point(run, axes, patience, robust)
    if is_traced(program.consts):
        raise TypeError(
            "run uses a value from outside that is being traced: a sweep compiles and runs on its own, outside of jit, "
            "grad and vmap, and has no derivative by such a value.\n"
            "Fix: inside a program use jax.vmap in place of lj.sweep; or a derivative for each point of the sweep, "
            "lj.sweep(jax.grad(...), axes)."
        )
    meaning = Meaning((meaning_of(program.jaxpr), structure, tuple(map(content_of, program.consts))))
    settings = (tuple(jax.config.values.items()), jax.sharding.get_abstract_mesh())
    key = meaning, axes.names, chunk, tuple(devices), layout, patience, robust, compiles, settings
    return program_of(key, make), seconds


def raised(program: Program) -> tuple[PyTree, Status]:
    """The values and the status of one point at which a callback of the user's raised."""
    values, status = not_run(program, 1)
    code = RESULTS.raised._value

    def with_result(x: Any):
        if not is_motion(x):
            return x
        return eqx.tree_at(lambda traj: traj.result._value, x, np.full_like(x.result._value, code))

    values = jax.tree.map(with_result, values, is_leaf=is_motion)
    return values, status._replace(result=np.full(1, code, STATUS_TYPES.result))


def not_run(program: Program, count: int) -> tuple[PyTree, Status]:
    """Arrays for the values and statuses of some points, filled with NaN, or 0 for dtypes without NaN."""
    values = jax.tree.map(lambda x: np.full((count, *x.shape), nothing(x.dtype), x.dtype), program.values)
    fills = (NOT_RUN, 0, np.nan, np.nan)
    return values, Status(*(np.full(count, fill, dtype) for fill, dtype in zip(fills, STATUS_TYPES)))


def digest(data: bytes) -> str:
    """The first 64 bits of a SHA-256 hash, as text."""
    return hashlib.sha256(data).hexdigest()[:16]


def _text(closed: ClosedJaxpr):
    # Memory addresses are removed; the constants of nested programs are added.
    constants = "".join(digest(_data(x)) for x in closed.consts if not isinstance(x, Tracer))
    return re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr)) + constants + "".join(_constants(closed.jaxpr))


def _constants(jaxpr: Jaxpr):
    for equation in jaxpr.eqns:
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                if isinstance(part, ClosedJaxpr):
                    yield from (digest(_data(x)) for x in part.consts)
        for body in bodies(equation):
            yield from _constants(body)


def _data(x: Any):
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x).tobytes()


# Each worker gets at least this many chunks, so that none waits long for the last one.
CHUNKS_EACH = 4
# The number of pilot points; their steps determine the order of the rest.
PILOTS = 256
# Sorting gains nothing if the longest pilot point takes at most this many times the mean number of steps.
SIMILAR_STEPS = 1.5
# Lanes that run together wait for the longest: a lane that takes more steps than this is run again alone.
STEPS_TOGETHER = 2**15
# If more than this part of a chunk is not settled, the next chunks use the robust program from the start.
MOSTLY_UNSETTLED = 0.25
MAX_STEPS = int(RESULTS.max_steps_reached._value)


class Engine:
    """A compiled program and how it is called.

    The first program assumes regular motions, which compiles in two thirds of the time; the robust program is compiled
    only when a point turns out to need it.
    """

    # Blocks of a new store: at least so many for each process.
    shares = CHUNKS_EACH

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
        self._patience = STEPS_TOGETHER if layout == "vmap" else None
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
        given_up = (status.result == MAX_STEPS) & (status.steps >= STEPS_TOGETHER) & (self.layout == "vmap")
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
