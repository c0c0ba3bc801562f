"""The compiled program of a sweep: maps the axis values at some points to values and statuses.

Lanes run together under `vmap`, each with its own steps; on a CPU `integrate` takes 256 of them at a time. `"map"` runs
one after the other, which is slower in nearly all measurements (`benchmarks/speed/sweep.py`) and needs less memory.

A later sweep that computes the same over axes of the same kinds uses the program of an earlier one. What a sweep
computes is the jaxpr of its function, which is traced for each sweep, so that no stale program is ever used.
"""

import hashlib
import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding
from jaxtyping import Array, PyTree

from lagjax.display import waiting
from lagjax.integrate import ENDED_WELL, PATIENCE, RESULTS, Trajectory, reporting, watched
from lagjax.jaxtools import (
    REGULAR_FIRST,
    ClosedJaxpr,
    Jaxpr,
    Meaning,
    as_usual,
    bodies,
    content_of,
    is_traced,
    meaning_of,
    one_by_one,
    program_of,
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
    """What the user's function computes at one point, and the structure in which it does."""
    shaped = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in axes.arrays]
    with _explained(run, axes, patience, robust):
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
) -> Program:
    """Compile a sweep's program for chunks of some length, split between the devices.

    Only the names, shapes and dtypes of the axes matter. Motions are given up after `patience` steps, if given. Unless
    `robust`, motions are assumed to be regular.
    """
    point = point_of(run)

    def lanes(values: tuple):
        def at(values: tuple):
            return point(dict(zip(axes.names, values)))

        return jax.lax.map(at, values) if layout == "map" else jax.vmap(at)(values)

    function, sharding = lanes, SingleDeviceSharding(devices[0])
    if len(devices) > 1:
        mesh, split = Mesh(np.asarray(devices), ("lanes",)), PartitionSpec("lanes")
        function = jax.shard_map(lanes, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
        sharding = NamedSharding(mesh, split)
    shaped = tuple(jax.ShapeDtypeStruct((chunk, *x.shape[1:]), x.dtype, sharding=sharding) for x in axes.arrays)
    with _explained(run, axes, patience, robust):
        traced = jax.jit(one_by_one(function)).trace(shaped)
    shapes, _, settled = traced.out_info
    program = traced.lower().compile()
    memory = program.memory_analysis()
    working = 0 if memory is None else memory.temp_size_in_bytes + memory.output_size_in_bytes

    @as_usual
    def call(point: dict[str, np.ndarray], count: int):
        return jax.tree.map(lambda x: np.asarray(x)[:count], program(tuple(point.values())))

    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), shapes)
    identity = digest(_text(traced.jaxpr).encode())
    return Program(call, chunk, one, working, identity, threading.Event(), settled is not None)


def program_for(
    run: Callable,
    axes: Axes,
    chunk: int,
    devices: Sequence,
    layout: str,
    patience: int | None = None,
    robust: bool = True,
    progress: bool | None = False,
) -> tuple[Program, float]:
    """The program, and the seconds it took to compile; 0 if it was in the cache."""
    seconds = 0.0

    def make():
        nonlocal seconds
        started = time.perf_counter()
        with waiting(progress, "compiling"):
            program = compiled(run, axes, chunk, devices, layout, patience, robust)
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
    key = meaning, axes.names, chunk, tuple(devices), layout, patience, robust, settings
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
