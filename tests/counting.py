"""Count what JAX compiles: the programs and the single operations of each test, and what they cost.

A *program* has hundreds of operations and takes a second or more to trace, lower and compile. A *kernel* is small:
mostly one operation of `jax.numpy` outside of any `jit`, such as `x[0]`, `jnp.stack` or `.round()` on a result, for 30
ms.
"""

import resource
import sys
import time
from collections.abc import Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import jax.monitoring

from lagjax.jaxtools.cache import are_known

# Fewer operations make a kernel; where they cannot be counted, fewer seconds.
OPERATIONS, SECONDS = 250, 0.25
# Of the whole fast tier, a tenth and more above what it has, as that differs from run to run: it falls when that does.
# The aim is 150 programs; of kernels and memory it is reached.
BUDGET = (168, "programs"), (1_500, "kernels"), (2.5, "GB in a worker")
# The older loop emitter takes two thirds of the time of XLA; one module of LLVM's instead of up to 32, which share
# helper functions and a pool of threads, another eighth less of the processors', all of which the workers use anyhow.
COMPILED_FASTER = [("xla_cpu_use_fusion_emitters", False), ("xla_cpu_parallel_codegen_split_count", 1)]
# The XLA of jax 0.11 has no other emitters.
COMPILED_FASTER = [(name, value) for name, value in COMPILED_FASTER if are_known({name: value})]
_COMPILED: list["Compiled"] = []
# The number of operations of what is compiled next, where known.
_NEXT: list[int] = []


class Compiled(NamedTuple):
    """Something that XLA compiled: its name, the seconds of XLA, and whether it is a program."""

    name: str
    seconds: float
    is_program: bool


def operations_of(module: Any) -> int:
    """The number of operations of an MLIR module, counted up to `OPERATIONS`."""
    counted = 0

    def another(operation):
        nonlocal counted
        counted += 1
        return going_on if counted < OPERATIONS else enough

    kinds = sys.modules[type(module).__module__].WalkResult
    going_on, enough = kinds.ADVANCE, kinds.INTERRUPT
    module.operation.walk(another)
    return counted


def about_to_compile(module: Any):
    """Count the operations of what is compiled next."""
    _NEXT[:] = [operations_of(module)]


def _heard(event, seconds, **about):
    if event == "/jax/core/compile/backend_compile_duration":
        is_program = _NEXT.pop() >= OPERATIONS if _NEXT else seconds >= SECONDS
        _COMPILED.append(Compiled(str(about.get("fun_name", "")), seconds, is_program))


# Registered permanently: JAX cannot remove a listener.
jax.monitoring.register_event_duration_secs_listener(_heard)


@contextmanager
def compiles():
    """A list to which the compile seconds of each program compiled in this context are added."""
    before, found = len(_COMPILED), []
    yield found
    found.extend(compiled.seconds for compiled in _COMPILED[before:])


class Cost(NamedTuple):
    """What a test, or several together, took: processor seconds, and of both kinds the number and seconds of XLA."""

    seconds: float = 0.0
    programs: int = 0
    of_programs: float = 0.0
    kernels: int = 0
    of_kernels: float = 0.0

    def __add__(self, other: "Cost") -> "Cost":  # pyright: ignore[reportIncompatibleMethodOverride]
        return Cost(*(a + b for a, b in zip(self, other)))

    def __str__(self) -> str:
        return f"{self.seconds:6.1f} s  {self.programs:4} programs  {self.kernels:5} kernels"


class Meter:
    """Reads off what was spent since it was made."""

    def __init__(self):
        self._from, self._started = len(_COMPILED), time.process_time()

    def read(self) -> Cost:
        """The cost until now, of this process alone."""
        since, spent = _COMPILED[self._from :], time.process_time() - self._started
        programs = [x.seconds for x in since if x.is_program]
        kernels = [x.seconds for x in since if not x.is_program]
        return Cost(spent, len(programs), sum(programs), len(kernels), sum(kernels))


def peak_memory() -> float:
    """The most memory this process has had, in GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e9


def free_memory() -> float:
    """The memory that is free on this machine, or in this container, in GB; infinite where nobody says it."""
    said = [float("inf")]
    if Path("/proc/meminfo").exists():
        lines = dict(line.split(":") for line in Path("/proc/meminfo").read_text().splitlines())
        said.append(int(lines["MemAvailable"].split()[0]) * 1024 / 1e9)
    if (limit := Path("/sys/fs/cgroup/memory.max")).exists() and limit.read_text().strip() != "max":
        said.append((int(limit.read_text()) - int(Path("/sys/fs/cgroup/memory.current").read_text())) / 1e9)
    return min(said)


def told(costs: dict[str, Cost], processes: Sequence[tuple[float, float]]) -> str:
    """What all tests cost together, and the processes in which they ran."""
    total = sum(costs.values(), Cost())
    return (
        f"{total.programs} programs ({total.of_programs:.0f} s of XLA), "
        f"{total.kernels} kernels ({total.of_kernels:.0f} s); "
        f"{total.seconds:.0f} processor s in tests, {max((x[0] for x in processes), default=0.0):.0f} s in each of "
        f"{len(processes)} processes to collect them, at most {max((x[1] for x in processes), default=0.0):.1f} GB"
    )


def over_budget(costs: dict[str, Cost], processes: Sequence[tuple[float, float]]) -> str:
    """What the fast tier has too much of; empty if nothing."""
    total = sum(costs.values(), Cost())
    spent = total.programs, total.kernels, max((memory for _, memory in processes), default=0.0)
    excess = [f"{x:.4g} {what}, at most {most}" for x, (most, what) in zip(spent, BUDGET) if x > most]
    return f"the budget of the fast tier, {'; '.join(excess)}. The dearest:" if excess else ""


def dearest(costs: dict[str, Cost], count: int = 10) -> str:
    """The tests that cost most, one a line."""
    rows = sorted(costs.items(), key=lambda row: -row[1].seconds)[:count]
    return "\n".join(f"{cost}  {test}" for test, cost in rows)
