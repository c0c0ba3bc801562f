"""Strict numerics for all tests: float64, no silent rank promotion, warnings are errors.

What is checked where; `.ci/run` does the first three:

    python -m lagjax    the scenes: error against exact motions by method and tolerance, stiff and extreme cases,
                        pictures; the reduced stability report. Judged by the exit status, which `test_main.py` and
                        `test_stability.py` show to be 1 where anything is missed.
    pytest              every module on programs that compile in seconds; messages; examples in docstrings; the house.
    pytest -m "slow and not exhaustive"
                        what compiles for long, or in processes of its own: derivatives in both modes, orders, events,
                        degenerate and large systems, every mechanism to its end, fits and their uncertainties, random
                        systems; the code of README and docs, the notebooks, the types.
    pytest -m exhaustive
                        before a release, by hand, for an hour and more: further sizes, seeds, methods and modes of
                        what a test above shows once.
"""

import gc
import os
from pathlib import Path

# The workers share the cores: threads of OpenBLAS beside them can stall a small factorisation for seconds.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Tracing makes so many objects that Python looks for cycles all the time: 1.3 of 17 s of a test, now 0.3.
gc.set_threshold(50_000, 5, 5)

# Each compiled program takes some fifty maps of memory. Linux gives a process 65,530, and XLA crashes without one.
MAPS, MOST_MAPS = Path("/proc/self/maps"), 30_000
# Two workers share the memory of a small machine.
SIZE, MOST_PAGES = Path("/proc/self/statm"), 4 * 2**30 // os.sysconf("SC_PAGE_SIZE")
# What is forgotten is not always given back.
allowed = [MOST_PAGES]


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """In the first tier XLA optimises little: it compiles in two thirds of the time.

    Order, stability, speed and what is in a compiled program are measured as users get them: in the slow tiers, in all
    processes that tests start, in `python -m lagjax`, and where a test of the first tier is marked `optimised`.
    """
    as_users_get_it = any(item.get_closest_marker(name) for name in ("slow", "exhaustive", "optimised"))
    jax.config.update("jax_disable_most_optimizations", not as_users_get_it)


def pytest_collection_finish():
    """What is imported by now stays: no use to look through it for cycles."""
    gc.freeze()


@pytest.fixture(autouse=True)
def room_for_programs():
    """Forget the programs of the tests before where there are very many."""
    if not MAPS.exists():
        return
    pages = lambda: int(SIZE.read_text().split()[1])
    if MAPS.read_bytes().count(b"\n") > MOST_MAPS or pages() > allowed[0]:
        jax.clear_caches()
        gc.collect()
        allowed[0] = pages() + MOST_PAGES // 2
