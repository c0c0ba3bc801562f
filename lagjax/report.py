"""Error against run time, and results of extreme cases: the tables that `python -m lagjax` prints.

A scene has `Run`s (motions with a known answer) and `Case`s (stiff and extreme inputs, tried once). Runs are compared
by `lj.work_precision`: times are medians of compiled solves without the overhead of a call. The time until the first
answer, which includes tracing and compiling, is reported separately.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.display import table
from lagjax.integrate import Crossing, Trajectory
from lagjax.system import System, coordinates
from lagjax.work_precision import WorkPrecision, in_ms, usual_methods, usual_others
from lagjax.work_precision import work_precision as compared

# The tolerance at which a run must reach its `required` error, for the method named with it.
JUDGED_AT = 1e-10
JUDGED_METHOD = "Dopri8"
# If a solve by another tool takes longer than this, in seconds, its tighter tolerances are not tried.
PATIENCE = 0.4
# How much the job runs: `--quick`, by default, `--full`; each includes the ones before it.
QUICK, MAIN, FULL = 0, 1, 2


@dataclass(frozen=True)
class Run:
    """A motion with a known answer.

    - `error`: the relative error of a trajectory, as one number; `measured` says what it compares.
    - `required`: the largest error allowed at rtol = atol = 1e-10 with Dopri8.
    - `invariant`: a quantity that must not change, (T,) from a trajectory; the Jacobi integral if None.
    - `events`: `Crossing`s by name that end the motion.
    - `by_hand`: accelerations and multipliers derived by hand, as a function of `(t, q, v, params)`, for other tools.
    - `drawn`: whether the run is long enough for meaningful run times.
    - `tier`: `FULL` for a variation of another run, which only `--full` makes; `--quick` makes a scene's first.
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
    by_hand: Callable | None = None
    drawn: bool = True
    tier: int = MAIN


@dataclass(frozen=True)
class Case:
    """One stiff or extreme input: what was tried, what happened, and whether that is correct.

    `error` is relative to the exact answer; a case passes if it is at most `allowed`. If the correct outcome is an
    error message, `happened` quotes it and `error` is 0 (refused, as expected) or infinite.
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

    `runs`, `cases` and `picture` are functions, so that importing a scene computes nothing; the last two take a tier.
    """

    name: str
    title: str
    source: str
    misprints: tuple[str, ...]
    runs: Callable[[], Sequence[Run]]
    cases: Callable[..., Sequence[Case]]
    picture: Callable[..., Any]


@dataclass(frozen=True)
class Row:
    """One line of a work-precision table; None for values that are unknown for another tool."""

    run: str
    measured: str
    method: str
    tolerance: float
    error: float
    residual: float | None
    drift: float | None
    steps: int | None
    evaluations: int | None
    seconds: float
    compile_seconds: float | None
    result: str
    required: float | None = field(default=None)

    @property
    def passed(self) -> bool:
        return self.required is None or bool(self.error <= self.required)


def work_precision(run: Run, tier: int = FULL, **settings: Any) -> WorkPrecision:
    """Compare methods on a run, and with other tools where accelerations by hand are there.

    `MAIN` compares the default method, another, and diffrax; `FULL` all methods, and SciPy, slower by a hundred.
    `settings` are those of `lj.work_precision`.
    """
    instead, by_hand = None, run.by_hand
    if tier == MAIN:
        start = coordinates.state(run.ts[0], run.q0, run.v0, run.params)
        settings |= {"methods": dict([*usual_methods(run.system, start).items()][:2])}
    if tier > QUICK and by_hand is not None:
        instead = usual_others(lambda *state: by_hand(*state)[0], run.q0, run.v0, run.params, run.ts)
        instead = instead if tier == FULL else dict([*instead.items()][:1])
    return compared(
        run.system, run.q0, run.v0, run.params,
        ts=run.ts, events=run.events, error=run.error, others=instead, patience_with_others=PATIENCE, **settings,
    )  # fmt: skip


def rows_of(run: Run, found: WorkPrecision) -> list[Row]:
    """The lines of the first table of a scene."""
    return [_row(run, curve, point) for curve in found.curves.values() for point in curve.points]


def relative_error(got: PyTree, exact: PyTree) -> float:
    """The largest error over all leaves and outputs, each leaf relative to its largest exact value."""
    errors = []
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(exact), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        scale = np.max(np.abs(b))
        errors.append(np.max(np.abs(a - b)) / (scale if scale > 0 else 1.0))
    return float(np.max(errors))


def work_precision_table(rows: Sequence[Row]) -> str:
    """The first table of a scene."""
    header = ("run", "method", "tol", "error", "residual", "drift", "steps", "evaluations", "time/ms", "compile/s", "")
    cells = [
        (
            row.run,
            row.method,
            f"{row.tolerance:.0e}",
            f"{row.error:.1e}",
            "-" if row.residual is None else f"{row.residual:.0e}",
            "-" if row.drift is None else f"{row.drift:.0e}",
            "-" if row.steps is None else f"{row.steps}",
            "-" if row.evaluations is None else f"{row.evaluations}",
            in_ms(row.seconds),
            "-" if row.compile_seconds is None else f"{row.compile_seconds:.1f}",
            _verdict(row),
        )
        for row in rows
    ]
    return table(header, cells)


def first_answer(rows: Sequence[Row]) -> str:
    """The time of the scene's first answer in this process, and of the next: a line below the first table."""
    row = rows[0]
    return (
        f"first answer: {row.compile_seconds or 0.0:.1f} s of tracing and compiling for '{row.run}' by {row.method}; "
        f"then {in_ms(row.seconds)} ms per solve"
    )


def judged(rows: Sequence[Row]) -> tuple[str, str, str]:
    """Of the run that came nearest to missing its error: that error and what is allowed, its ms, its first answer."""
    shares = {np.nan_to_num(row.error / row.required, nan=np.inf): row for row in rows if row.required is not None}
    if not shares:
        return "-", "-", "-"
    row = shares[max(shares)]
    return f"{row.error:.0e} (<= {row.required:.0e})", in_ms(row.seconds), f"{row.compile_seconds or 0.0:.1f}"


def case_table(cases: Sequence[Case]) -> str:
    """The second table of a scene."""
    cells = [
        (case.name, f"{case.error:.1e}", f"{case.allowed:.0e}", "ok" if case.passed else "MISSED", case.happened)
        for case in cases
    ]
    header = ("stiff and extreme cases", "error", "allowed", "", "what happened")
    return table(header, cells, prose=True)


def _row(run, curve, point):
    trajectory, compiled = point.trajectory, np.isfinite(curve.compile_seconds)
    judged = curve.method == JUDGED_METHOD and point.tolerance == JUDGED_AT
    return Row(
        run=run.name,
        measured=run.measured,
        method=curve.method,
        tolerance=point.tolerance,
        error=point.error,
        residual=float(trajectory.residual()) if trajectory is not None and run.system.constraints else None,
        drift=None if trajectory is None else _drift(run, trajectory),
        steps=point.steps,
        evaluations=point.evaluations,
        seconds=point.seconds,
        compile_seconds=curve.compile_seconds if compiled else None,
        result=point.result,
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
        return "" if np.isfinite(row.error) else row.result
    return f"ok (<= {row.required:.0e})" if row.passed else f"MISSED (> {row.required:.0e})"
