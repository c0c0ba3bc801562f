"""The compiled program of a sweep: the values that its axes have at some points, to values and statuses.

Lanes run together, under `vmap`, each with its own steps; on a CPU `integrate` takes 256 of them at a time. `"map"`
takes one after the other, which measures slower nearly everywhere (`benchmarks/sweep.py`), and needs the least memory.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec, SingleDeviceSharding
from jaxtyping import PyTree

from lagjax.jax_internals.tracing import REGULAR_FIRST
from lagjax.mechanics.in_words import Call, check_arguments, in_words
from lagjax.motion.reported import PATIENCE, reporting
from lagjax.motion.results import ENDED_WELL, RESULTS
from lagjax.motion.trajectory import Trajectory
from lagjax.sweeps.axes import POINT, Axes
from lagjax.sweeps.digests import program_digest

NOT_RUN, LOST = -1, -2
LAYOUTS = ("vmap", "map")


class Status(NamedTuple):
    """How each point went, arrays in the shape of the sweep.

    `result` is the code of a `RESULTS` item, -1 where the point was not run, -2 where it is lost from its store;
    `steps` those of all its integrations; `scaled_error` and `residual` the worst (`Trajectory`), 0 where nothing was
    integrated.
    """

    result: Any
    steps: Any
    scaled_error: Any
    residual: Any


STATUS_TYPES = Status(np.dtype(np.int8), np.dtype(np.int32), np.dtype(np.float32), np.dtype(np.float32))
# What is to be trusted, and what there is a value of.
TRUSTED = tuple(int(item._value) for item in ENDED_WELL)
GOOD = (*TRUSTED, *(int(item._value) for item in (RESULTS.drifted, RESULTS.not_converged, RESULTS.misfit)))


class Program(NamedTuple):
    """A compiled program for `chunk` points: one point's shapes, the bytes that it works with, a digest of its text.

    `call(point, count)`: (values, status, settled) of no more than `chunk` points, as NumPy arrays; `point` has the
    values of so many by axis. Points that are not settled belong to the robust program; None where this one is that.
    `irregular` is set when most points turn out to belong there.
    """

    call: Callable
    chunk: int
    values: PyTree
    working: int
    digest: str
    irregular: threading.Event


def point_of(run: Callable) -> Callable:
    """A function of one point that returns (values, `Status`, whether these are settled: `reporting`).

    The numbers of a point that failed are NaN.
    """
    told = reporting(run)

    def point(at):
        values, report, settled = told(at)
        if report is None:
            floats = [x for x in jax.tree.leaves(values) if jnp.issubdtype(x.dtype, jnp.inexact)]
            finite = jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in floats])) if floats else jnp.asarray(True)
            result = jnp.where(finite, RESULTS.successful._value, RESULTS.not_finite._value)
            report = (result, 0, 0.0, 0.0)
        status = Status(*(jnp.asarray(x, dtype) for x, dtype in zip(report, STATUS_TYPES)))
        well = jnp.any(jnp.stack([status.result == code for code in GOOD]))

        def masked(x):
            # A trajectory says itself how far it got, and is NaN from there on.
            if isinstance(x, Trajectory) or not jnp.issubdtype(x.dtype, jnp.inexact):
                return x
            return jnp.where(well, x, jnp.nan)

        return jax.tree.map(masked, values, is_leaf=lambda x: isinstance(x, Trajectory)), status, settled

    return point


def compiled(
    run: Callable, axes: Axes, chunk: int, devices: Sequence, layout: str, patience=None, robust=True
) -> Program:
    """Compile a sweep's program for chunks of some length, split between the devices.

    Of the axes only names, shapes and dtypes matter. With `patience`, motions in it are given up after so many steps.
    Where not `robust`, they are taken for regular.
    """
    point = point_of(run)

    def lanes(values):
        at = lambda values: point(dict(zip(axes.names, values)))
        return jax.lax.map(at, values) if layout == "map" else jax.vmap(at)(values)

    function, placed = lanes, SingleDeviceSharding(devices[0])
    if len(devices) > 1:
        mesh, split = Mesh(np.asarray(devices), ("lanes",)), PartitionSpec("lanes")
        function = jax.shard_map(lanes, mesh=mesh, in_specs=split, out_specs=split, check_vma=False)
        placed = NamedSharding(mesh, split)
    shaped = tuple(jax.ShapeDtypeStruct((chunk, *x.shape[1:]), x.dtype, sharding=placed) for x in axes.arrays)
    of_user = Call("run", run, (POINT,))
    check_arguments(of_user, "the axes taken one by one; a point is one dictionary")
    with PATIENCE(patience), REGULAR_FIRST(not robust), in_words(of_user, {POINT: axes.values}):
        traced = jax.jit(function).trace(shaped)
    shapes, *_ = traced.out_info
    program = traced.lower().compile()
    memory = program.memory_analysis()
    working = 0 if memory is None else memory.temp_size_in_bytes + memory.output_size_in_bytes

    def call(point, count):
        return jax.tree.map(lambda x: np.asarray(x)[:count], program(tuple(point.values())))

    one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), shapes)
    return Program(call, chunk, one, working, program_digest(traced.jaxpr), threading.Event())


def not_run(program: Program, count: int) -> tuple[PyTree, Status]:
    """Room for the values and statuses of some points: NaN, or 0 in numbers that have none."""
    nothing = lambda x: np.nan if np.issubdtype(x.dtype, np.inexact) else 0
    values = jax.tree.map(lambda x: np.full((count, *x.shape), nothing(x), x.dtype), program.values)
    fills = (NOT_RUN, 0, np.nan, np.nan)
    return values, Status(*(np.full(count, fill, dtype) for fill, dtype in zip(fills, STATUS_TYPES)))
