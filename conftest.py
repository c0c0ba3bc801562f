"""Strict numerics for all tests: float64, no silent rank promotion, warnings are errors.

At its end pytest prints what was compiled and how much memory a worker had; the fast tier has a budget of both
(`tests/counting.py`). Two tiers of tests, and an option; `.ci/run` runs the scenes and both tiers:

    python -m lagjax    the scenes: error against exact motions by method and tolerance, stiff and extreme cases,
                        pictures; a part of the stability report; `--full`, before a release, all. The exit status is 1
                        if anything is missed, which `test_job.py` and `test_stability.py` check.
    pytest              every module on programs that compile in seconds; messages; docstring examples; architecture.
    pytest -m slow
                        tests that compile for 3 to 20 s, or have processes of their own: derivatives in both modes,
                        orders, events, degenerate and large systems, mechanisms to their end, fits and their
                        uncertainties, random systems; code of README and docs, short notebooks, the package's types.
    pytest -m slow --all-sizes
                        also the tests marked `exhaustive`, before a release and after a change of what they test
                        (`.ci/release`), for two hours: those that compile or train for longer; further sizes, seeds,
                        methods and modes of those above.
"""

import gc
import inspect
import itertools
import os
import time
from pathlib import Path
from typing import Any

# The workers share the cores: additional threads of OpenBLAS can stall a small factorisation for seconds.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# What a test computes is compiled from the source that is tested: `jaxtools/test_kept.py` turns the folder on.
os.environ["LAGJAX_CACHE"] = "off"

import jax  # noqa: E402
import pytest  # noqa: E402
from jax._src import compiler  # noqa: E402

from lagjax.jaxtools.cache import PROGRAMS  # noqa: E402
from tests import counting  # noqa: E402
from tests.tiers import SLOW_EXAMPLES  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Tracing creates so many objects that garbage collection runs constantly: 1.3 of 17 s of a test, now 0.3.
gc.set_threshold(50_000, 5, 5)

# Tests of many files share programs, more than a user needs at a time; `room_for_programs` sets the bound here.
PROGRAMS.most = 1_000

# Each compiled program takes some fifty memory maps. Linux gives a process 65,530, and XLA crashes without one.
MAPS, MOST_MAPS = Path("/proc/self/maps"), 30_000
# Of a worker; above `MOST_PAGES` it lets go of its programs.
GIGABYTES = 2.5
SIZE, MOST_PAGES = Path("/proc/self/statm"), 2 * 2**30 // os.sysconf("SC_PAGE_SIZE")
# Freed memory is not always returned to the system.
allowed = [MOST_PAGES]
# The maps are counted once in ten tests: the list of 30,000 takes the kernel 10 ms.
tests = itertools.count()
backend_compile: Any = getattr(compiler, "backend_compile_and_load", None)


def compile_faster(backend, module, devices, options, callbacks):
    """Compile with `counting.COMPILED_FASTER` where few optimisations are asked for, and count."""
    counting.about_to_compile(module)
    if jax.config.read("jax_disable_most_optimizations"):
        # By JAX's own function: `XLA_FLAGS` would change the optimised tests too, which run in the same process.
        options.env_option_overrides = [*options.env_option_overrides, *counting.COMPILED_FASTER]
    return backend_compile(backend, module, devices, options, callbacks)


# Private to JAX: where it is another function, or LAGJAX_TESTS_PLAIN=1, tests compile as they did before.
takes_options = callable(backend_compile) and list(inspect.signature(backend_compile).parameters)[3:4] == ["options"]
if takes_options and "LAGJAX_TESTS_PLAIN" not in os.environ:
    compiler.backend_compile_and_load = compile_faster


def as_users_get_it(item):
    """Whether a test's programs are optimised."""
    return any(item.get_closest_marker(name) for name in ("exhaustive", "optimised"))


def pytest_addoption(parser):
    """The option for all sizes."""
    parser.addoption("--all-sizes", action="store_true", help="also the slow tests that are marked `exhaustive`")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Exhaustive tests are slow ones, run on request; the types, which take longest, come first: none waits for them.

    The optimised tests come last: few programs compile twice.
    """
    for item in items:
        if item.name in SLOW_EXAMPLES:
            item.add_marker("slow")
    exhaustive = [item for item in items if item.get_closest_marker("exhaustive")]
    for item in exhaustive:
        item.add_marker("slow")
    if not config.getoption("--all-sizes"):
        config.hook.pytest_deselected(items=exhaustive)
        items[:] = [item for item in items if not item.get_closest_marker("exhaustive")]
    items.sort(key=lambda item: (item.path.name != "test_types.py", as_users_get_it(item)))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """XLA optimises little in most tests, which compiles in two thirds of the time.

    Order, stability, speed and compiled programs are measured as users get them: in tests marked `optimised` or
    `exhaustive`, in all processes that tests start, and in `python -m lagjax`.
    """
    optimised = as_users_get_it(item)
    if optimised and jax.config.read("jax_disable_most_optimizations"):
        # JAX would use the programs that earlier tests compiled for the same functions.
        jax.clear_caches()
        PROGRAMS.clear()
    jax.config.update("jax_disable_most_optimizations", not optimised)


# The processor seconds of this process until its tests were collected.
collected: list[float] = []


def pytest_collection_finish():
    """Objects imported by now stay, so garbage collection need not scan them."""
    gc.freeze()
    collected.append(time.process_time())


@pytest.fixture(autouse=True)
def room_for_programs():
    """Clear the compiled programs of earlier tests if there are very many."""
    if next(tests) % 10 or not MAPS.exists():
        return
    pages = lambda: int(SIZE.read_text().split()[1])
    if MAPS.read_bytes().count(b"\n") > MOST_MAPS or pages() > allowed[0]:
        PROGRAMS.clear()
        jax.clear_caches()
        gc.collect()
        allowed[0] = pages() + MOST_PAGES // 2


# What the tests cost, by test, and of each process the seconds until all were collected and the most memory, in GB.
COSTS: dict[str, counting.Cost] = {}
METER = pytest.StashKey[counting.Meter]()
PROCESSES: list[tuple[float, float]] = []


def pytest_xdist_auto_num_workers(config):
    """As many workers as cores, if there is memory for them."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, int(counting.free_memory() / GIGABYTES)))


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Begin to meter a test."""
    item.stash[METER] = counting.Meter()
    yield


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    """The last report of a test says what it cost."""
    if call.when == "teardown":
        item.user_properties.append(("cost", list(item.stash[METER].read())))
    yield


def pytest_runtest_logreport(report):
    """Collect what the tests cost, in the process that all report to."""
    if report.when == "teardown":
        COSTS[report.nodeid] = counting.Cost(*dict(report.user_properties)["cost"])


def pytest_testnodedown(node, error):
    """Collect what a worker says of itself."""
    PROCESSES.extend([tuple(node.workeroutput["process"])] if "process" in getattr(node, "workeroutput", {}) else [])


def pytest_sessionfinish(session):
    """A worker says what it took; where all reports are, the budget of the fast tier is a test."""
    process = collected[0] if collected else 0.0, counting.peak_memory()
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["process"] = process
        return
    if not session.config.getoption("numprocesses", None):
        PROCESSES.append(process)
    if excess(session.config):
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED


def excess(config) -> str:
    """What the fast tier, run as a whole, has too much of; empty if nothing, or if these are other tests."""
    whole = config.args_source.name == "TESTPATHS" and not config.getoption("keyword")
    fast = config.getoption("markexpr") == "not slow"
    return counting.over_budget(COSTS, PROCESSES) if whole and fast else ""


def pytest_terminal_summary(terminalreporter, config):
    """What the tests cost; of a fast tier over its budget, the dearest."""
    if COSTS:
        terminalreporter.write_line(counting.told(COSTS, PROCESSES))
    if too_much := excess(config):
        terminalreporter.write_line(f"FAILED: {too_much}\n{counting.dearest(COSTS)}", red=True)
