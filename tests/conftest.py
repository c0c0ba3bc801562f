"""Strict numerics for all tests: float64, no silent rank promotion, warnings are errors."""

import os
from pathlib import Path

# The workers share the cores: threads of OpenBLAS beside them can stall a small factorisation for seconds.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")

# Each compiled program takes some fifty maps of memory. Linux gives a process 65,530, and XLA crashes without one.
MAPS, MOST_MAPS = Path("/proc/self/maps"), 30_000


@pytest.fixture(autouse=True)
def room_for_programs():
    """Forget the programs of the tests before where there are very many."""
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MOST_MAPS:
        jax.clear_caches()
