"""The memory that a sweep needs, and a check that it is available."""

import math
from pathlib import Path

import jax

from lagjax.sweeps.lanes import STATUS_TYPES

# The largest part of the free memory that a sweep may use.
FILL_AT_MOST = 0.8


def check_memory(axes, program, workers, store, devices):
    """Raise `MemoryError` if the values would not fit."""
    on_host, free = devices[0].platform == "cpu", _free_memory()
    device_limit = None if on_host else (devices[0].memory_stats() or {}).get("bytes_limit")
    if device_limit is not None and workers * program.working > device_limit:
        raise MemoryError(
            f"a chunk of {program.chunk:,} points needs {program.working / 1e9:.3g} GB on each device, and "
            f"{workers} at a time do not fit into its {device_limit / 1e9:.3g} GB.\nFix: chunk={program.chunk // 4}."
        )
    kept = 0 if store is not None else axes.size * bytes_of(program)
    needed = kept + (workers * program.working if on_host else 0)
    if free is not None and needed > FILL_AT_MOST * free:
        raise MemoryError(
            f"this sweep needs {needed / 1e9:.3g} GB: {axes.size:,} points of {bytes_of(program):,} bytes, and "
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


def bytes_of(program):
    """The bytes of one point's values and status."""
    of_status = sum(dtype.itemsize for dtype in STATUS_TYPES)
    return of_status + sum(math.prod(x.shape) * x.dtype.itemsize for x in jax.tree.leaves(program.values))
