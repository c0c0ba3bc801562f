"""Error against run time, and what happens in the extremes: the tables that `python -m lagjax` prints.

A scene offers `Run`s (motions with a known answer) and `Case`s (stiff and extreme inputs, tried once). Times are
medians of whole calls of `integrate` after the first, of which a few tenths of a millisecond are the call's own; one
compilation serves a method at all its tolerances. What a person waits for the first answer is a run time too, and
stands apart: from the call to the result, tracing and compiling included.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import diffrax
import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanics import coordinates
from lagjax.mechanics.structure import is_free_of_velocities
from lagjax.mechanics.system import System
from lagjax.motion.crossings import Crossing
from lagjax.motion.integrate import integrate
from lagjax.motion.trajectory import Trajectory, ended_well, message
from lagjax.numerics.nystrom import Nystrom12
from lagjax.numerics.runge_kutta import Dopri8, Tsit5

# The tolerance at which a run must reach its `required` error, for the method named with it.
JUDGED_AT = 1e-10
JUDGED_METHOD = "Dopri8"


@dataclass(frozen=True)
class Run:
    """A motion with a known answer.

    - `error`: the relative error of a trajectory, as one number; `measured` says in words what it compares.
    - `required`: the largest error allowed at rtol = atol = 1e-10 with Dopri8.
    - `invariant`: a quantity that must not change, (T,) from a trajectory; the Jacobi integral if None.
    - `events`: by name, `Crossing`s that end the motion.
    """

    name: str
    system: System
    params: PyTree
    q0: PyTree
    v0: PyTree
    ts: np.ndarray
    error: Callable[[Trajectory], float]
    measured: str
    required: float = 1e-9
    invariant: Callable[[Trajectory], np.ndarray] | None = None
    events: Mapping[str, Crossing] | None = None


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input: what was tried, what happened, and whether that is right.

    `error` is relative, against the exact answer; a case passes if it is at most `allowed`. Where the right
    outcome is a refusal, `happened` quotes it and `error` is 0 (refused, as it should be) or infinite.
    """

    name: str
    happened: str
    error: float
    allowed: float

    @property
    def passed(self) -> bool:
        return bool(self.error <= self.allowed)


@dataclass(frozen=True)
class Scene:
    """A worked system: where it comes from, what the source gets wrong, and how it is checked.

    `runs`, `cases` and `picture` are functions, so that importing a scene computes nothing.
    """

    name: str
    title: str
    source: str
    misprints: tuple[str, ...]
    runs: Callable[[], Sequence[Run]]
    cases: Callable[[], Sequence[Case]]
    picture: Callable[[], Any]


@dataclass(frozen=True)
class Row:
    """One line of a work-precision table; `compile_seconds` is from the call to the first answer of that method."""

    run: str
    measured: str
    method: str
    tolerance: float
    error: float
    residual: float | None
    drift: float
    steps: int
    seconds: float
    compile_seconds: float
    result: str
    required: float | None = field(default=None)

    @property
    def passed(self) -> bool:
        return self.required is None or bool(self.error <= self.required)


def work_precision(
    run: Run,
    methods: dict[str, diffrax.AbstractSolver] | None = None,
    tolerances: Sequence[float] = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
    repeats: int = 5,
) -> list[Row]:
    """Integrate one run by several methods at several tolerances, timed and checked.

    **Arguments:** `methods` by name (by default Tsit5, Dopri8 and, where it can be used, Nystrom12); `tolerances`, each
    used as rtol and atol; `repeats`, of which the median time is kept.

    **Returns:** one `Row` a method and tolerance, `seconds` for a call with results ready.
    """
    methods = _methods_for(run) if methods is None else methods
    rows = []
    for name, method in methods.items():
        solve = _solver_of(run, method)
        compile_seconds = None
        for tolerance in tolerances:
            started = time.perf_counter()
            trajectory = jax.block_until_ready(solve(tolerance))
            if compile_seconds is None:
                compile_seconds = time.perf_counter() - started
            seconds = np.median([_seconds(solve, tolerance) for _ in range(repeats)])
            judged = name == JUDGED_METHOD and tolerance == JUDGED_AT
            rows.append(_row(run, name, tolerance, trajectory, seconds, compile_seconds, judged))
    return rows


def relative_error(got: PyTree, exact: PyTree) -> float:
    """The largest error over all leaves and outputs, each leaf relative to its largest exact value."""
    errors = []
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(exact), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        scale = np.max(np.abs(b))
        errors.append(np.max(np.abs(a - b)) / (scale if scale > 0 else 1.0))
    return float(np.max(errors))


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A plain-text table: first column to the left, the others to the right."""
    lines = [header, *rows]
    widths = [max(len(line[i]) for line in lines) for i in range(len(header))]
    shown = [
        "  ".join(cell.ljust(w) if i == 0 else cell.rjust(w) for i, (cell, w) in enumerate(zip(line, widths)))
        for line in lines
    ]
    return "\n".join([shown[0], "-" * len(shown[0]), *shown[1:]])


def work_precision_table(rows: Sequence[Row]) -> str:
    """The first table of a scene."""
    header = ("run", "method", "tol", "error", "residual", "drift", "steps", "time/ms", "first/s", "")
    cells = [
        (
            row.run,
            row.method,
            f"{row.tolerance:.0e}",
            f"{row.error:.1e}",
            "-" if row.residual is None else f"{row.residual:.0e}",
            f"{row.drift:.0e}",
            f"{row.steps}",
            f"{1e3 * row.seconds:.2f}",
            f"{row.compile_seconds:.1f}",
            _verdict(row),
        )
        for row in rows
    ]
    return table(header, cells)


def first_answer(rows: Sequence[Row]) -> str:
    """How long the scene's first answer took in this process, and its next: a line below the first table."""
    row = rows[0]
    return (
        f"first answer: {row.compile_seconds:.1f} s from the call to the result of '{row.run}' by {row.method}, "
        f"tracing and compiling included; the same again: {1e3 * row.seconds:.2f} ms"
    )


def case_table(cases: Sequence[Case]) -> str:
    """The second table of a scene."""
    cells = [
        (case.name, f"{case.error:.1e}", f"{case.allowed:.0e}", "ok" if case.passed else "MISSED", case.happened)
        for case in cases
    ]
    header = ("stiff and extreme cases", "error", "allowed", "", "what happened")
    # The last column is prose: keep it to the left.
    width = max(len(row[-1]) for row in [header, *cells])
    return table(header[:-1] + (header[-1].ljust(width),), [row[:-1] + (row[-1].ljust(width),) for row in cells])


def _methods_for(run) -> dict[str, diffrax.AbstractSolver]:
    by_runge_kutta: dict[str, diffrax.AbstractSolver] = {"Tsit5": Tsit5(), "Dopri8": Dopri8()}
    state = coordinates.state(run.ts[0], run.q0, run.v0, run.params)
    return by_runge_kutta | ({"Nystrom12": Nystrom12()} if is_free_of_velocities(run.system, *state) else {})


def _solver_of(run, method):
    def solve(tolerance):
        return integrate(
            run.system,
            run.q0,
            run.v0,
            run.params,
            ts=run.ts,
            rtol=tolerance,
            atol=tolerance,
            method=method,
            events=run.events,
            throw=False,
        )

    return solve


def _seconds(solve, tolerance):
    started = time.perf_counter()
    jax.block_until_ready(solve(tolerance))
    return time.perf_counter() - started


def _row(run, name, tolerance, trajectory, seconds, compile_seconds, judged):
    return Row(
        run=run.name,
        measured=run.measured,
        method=name,
        tolerance=tolerance,
        error=run.error(trajectory) if bool(ended_well(trajectory.result)) else float("inf"),
        residual=float(trajectory.residual()) if run.system.constraints else None,
        drift=_drift(run, trajectory),
        steps=int(trajectory.stats["num_steps"]),
        seconds=float(seconds),
        compile_seconds=compile_seconds,
        result=message(trajectory.result),
        required=run.required if judged else None,
    )


def _drift(run, trajectory):
    if run.invariant is None:
        return float(trajectory.drift())
    values = np.asarray(run.invariant(trajectory))
    scale = np.nanmax(np.abs(values))
    return float(np.nanmax(np.abs(values - values[0])) / (scale if scale > 0 else 1.0))


def _verdict(row):
    if row.required is None:
        return ""
    return f"ok (<= {row.required:.0e})" if row.passed else f"MISSED (> {row.required:.0e})"
