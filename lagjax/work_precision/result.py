"""The result of a comparison: points, the curve of each method with its measured order, tables, and a diagram."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from lagjax.display import DrawnAxes, labelled, table
from lagjax.display import plots as plot
from lagjax.integrate import Trajectory
from lagjax.refusals import installed
from lagjax.work_precision.methods import as_code
from lagjax.work_precision.references import Reference

# The numbers of a point; unknown ones are NaN.
NUMBERS = ("error", "seconds", "least", "steps", "evaluations")


# Round-off dominates where a tighter tolerance improves on the best error so far by less than this factor.
STALLED = 1.5
# Above this relative error steps are too long to show an order.
TOO_LARGE = 0.05


@dataclass(frozen=True)
class Point:
    """One method at one tolerance.

    - `error`: relative; infinite if the motion was not computed to its end. `trusted`: whether it is more than twice
      the possible error of the reference.
    - `seconds`: the median of compiled solves, without the overhead of a call; NaN if none was measured. `least`: the
      fastest.
    - `steps`, accepted and rejected; `evaluations` of the accelerations; None if unknown.
    - `result`: how it ended, in words. `trajectory`: the motion; None for another tool.
    """

    method: str
    tolerance: float
    error: float
    trusted: bool
    seconds: float
    least: float
    steps: int | None
    evaluations: int | None
    result: str
    trajectory: Trajectory | None = field(default=None, repr=False, compare=False)

    @property
    def ended_well(self) -> bool:
        return bool(np.isfinite(self.error))


@dataclass(frozen=True)
class Curve:
    """One method: its points, from loose to tight, the solver (None for another tool), and seconds of compiling."""

    method: str
    solver: Any
    compile_seconds: float
    points: tuple[Point, ...]

    @property
    def order(self) -> float:
        """The measured order: minus the slope of log error over log evaluations (over log time if these are unknown).

        NaN if fewer than three points count: errors below 5 %, above round-off, and above the error of the reference.
        """
        work, errors = _points_for_order(self.points)
        if len(work) < 3:
            return float("nan")
        return float(-np.polyfit(np.log(work), np.log(errors), 1)[0])

    def within(self, error: float) -> Point | None:
        """The fastest point whose error, like that of all tighter computed ones, is within `error`."""
        good = []
        for point in reversed(self.points):
            if not np.isfinite(point.seconds) or not point.ended_well:
                continue
            if point.error > error:
                break
            good.append(point)
        return min(good, key=lambda point: point.seconds, default=None)


def _points_for_order(points: Sequence[Point]):
    """Work and errors of the points that count for the order, as arrays."""
    counted = [p for p in points if p.ended_well and p.trusted and 0 < p.error <= TOO_LARGE and np.isfinite(p.seconds)]
    by_evaluations = all(p.evaluations for p in counted)
    work = np.array([p.evaluations if by_evaluations else p.seconds for p in counted], float)
    errors = np.array([p.error for p in counted])
    last = 0
    for i in range(1, len(counted)):
        if errors[i] * STALLED < np.min(errors[:i]) and work[i] > work[last]:
            last = i
    return work[: last + 1], errors[: last + 1]


class Choice(NamedTuple):
    """A method and the tolerance at which it comes within an error; `seconds` per solve, without compiling."""

    name: str
    method: Any
    tolerance: float
    error: float
    seconds: float
    compile_seconds: float


class DiagramChoices(tuple):
    """Choices, the fastest first; prints itself as a table and the call to make."""

    def __repr__(self):
        cells = [
            (c.name, f"{c.tolerance:.0e}", f"{c.error:.1e}", in_ms(c.seconds), _in_seconds(c.compile_seconds))
            for c in self
        ]
        lines = table(("fastest first", "tolerance", "error", "ms", "compile/s"), cells)
        ours = next((c for c in self if c.method is not None), None)
        if ours is None:
            return lines
        at = f"rtol={ours.tolerance:.0e}"
        return f"{lines}\nlj.integrate(system, q0, v0, params, ts=ts, method={as_code(ours.method)}, {at})"


@dataclass(frozen=True, repr=False)
class WorkPrecision:
    """Methods compared on one motion. It prints itself as a table, and plots itself.

    - `curves`: by name, the `Curve` of each method: its `points`, its measured `order`, seconds of compiling;
      `found["Dopri8"]` is one.
    - `reference`: what errors are measured against, and its own possible error; None if a function `error` was given.
      Points with an error below twice that are marked as not to be trusted.
    - `measured`: the definition of an error, in words, with the number of times at which states are compared: between
      these, errors are not seen. `call_seconds`: the overhead of a call, which is subtracted.
    """

    curves: dict[str, Curve]
    reference: Reference | None
    measured: str
    call_seconds: float

    def __getitem__(self, name: str) -> Curve:
        return self.curves[name]

    @property
    def points(self) -> Iterator[Point]:
        """All points, method by method."""
        return (point for curve in self.curves.values() for point in curve.points)

    def best(self, error: float) -> DiagramChoices:
        """The best choices for a relative error: the fastest tolerance of each method within it, the fastest first.

        A tolerance counts only if all tighter ones are within the error, too, which excludes lucky ones.

        **Raises:** `ValueError` if no method reaches this error, or it is below the error of the reference.
        """
        if self.reference is not None and error < self.reference.error:
            raise ValueError(
                f"an error of {error:.0e} is below the possible error of the reference, {self.reference.error:.0e}.\n"
                "Usual cause: a long or unstable motion, which amplifies round-off.\n"
                "Fix: allow a larger error, shorten ts, or give an exact reference=."
            )
        choices = []
        for curve in self.curves.values():
            point = curve.within(error)
            if point is not None:
                choices.append(
                    Choice(
                        curve.method, curve.solver, point.tolerance, point.error, point.seconds, curve.compile_seconds
                    )
                )
        if not choices:
            nearest = min(self.points, key=lambda point: point.error)
            raise ValueError(
                f"no method stays within {error:.0e}: the nearest is {nearest.method} at {nearest.tolerance:.0e}, with "
                f"{nearest.error:.1e}.\nFix: allow a larger error, or give tighter tolerances=."
            )
        return DiagramChoices(sorted(choices, key=lambda choice: choice.seconds))

    def to_pandas(self):
        """A `pandas.DataFrame`, one row per point: method, tolerance, error, seconds, steps, evaluations, how it ended.

        `order` and `compile_seconds` are those of the method. Unknown steps and evaluations are `<NA>`.

        **Raises:** `ImportError` without pandas.
        """
        pandas = installed("pandas", "this", "data")
        points = list(self.points)
        names = ("method", "tolerance", "error", "trusted", "seconds", "least", "steps", "evaluations")
        columns = {name: [getattr(point, name) for point in points] for name in names}
        for name in ("steps", "evaluations"):  # Whole numbers, some of which may be unknown.
            columns[name] = pandas.array(columns[name], "Int64")
        columns["order"] = [self[point.method].order for point in points]
        columns["compile_seconds"] = [self[point.method].compile_seconds for point in points]
        for name in ("method", "result"):
            words = [getattr(point, name) for point in points]
            columns[name] = pandas.Categorical(words, list(dict.fromkeys(words)))
        return pandas.DataFrame(columns)

    def to_xarray(self):
        """An `xarray.Dataset` over `solver` (the methods by name) and `tolerance`, loose to tight; NaN where not tried.

        **Raises:** `ImportError` without xarray.
        """
        xarray = installed("xarray", "this", "data")
        methods, points = list(self.curves), list(self.points)
        tolerances = sorted({point.tolerance for point in points}, reverse=True)
        # Not called `method`, which is an argument of xarray's `sel`.
        shape, dims = (len(methods), len(tolerances)), ("solver", "tolerance")
        numbers = {name: np.full(shape, np.nan) for name in NUMBERS}
        trusted, results = np.zeros(shape, bool), np.full(shape, "not tried", object)
        for point in points:
            at = methods.index(point.method), tolerances.index(point.tolerance)
            for name, x in numbers.items():
                known = getattr(point, name)
                x[at] = np.nan if known is None else known
            trusted[at], results[at] = point.trusted, point.result
        variables: dict[str, Any] = {name: (dims, x) for name, x in numbers.items()}
        variables |= {"trusted": (dims, trusted), "result": (dims, results.astype(str))}
        coords: dict[str, Any] = {"solver": methods, "tolerance": tolerances}
        for name in ("order", "compile_seconds"):
            coords[name] = "solver", [getattr(curve, name) for curve in self.curves.values()]
        attributes = {"measured": self.measured, "call_seconds": self.call_seconds}
        if self.reference is not None:
            attributes["reference_error"] = self.reference.error
        return xarray.Dataset(variables, coords, attributes)

    def plot(self, title: str = ""):
        """Draw error against run time, and against evaluations of the accelerations; returns a matplotlib `Figure`.

        The number next to a curve is its measured order; hollow points are not to be trusted.

        **Raises:** `ImportError` without matplotlib.
        """
        return plot.work_precision([self.against_time(title), self.against_evaluations(title)])

    def against_time(self, title: str = "") -> DrawnAxes:
        """Error against run time, for `plot.work_precision`."""
        return self._drawn(title, "run time / ms", lambda point: 1e3 * point.seconds)

    def against_evaluations(self, title: str = "") -> DrawnAxes:
        """Error against evaluations, for `plot.work_precision`."""
        return self._drawn(title, "evaluations of the accelerations", lambda point: point.evaluations or np.nan)

    def _drawn(self, title: str, label: str, work: Callable):
        curves = {
            name: (
                np.array([work(p) for p in curve.points], float),
                np.array([p.error for p in curve.points]),
                np.array([p.trusted for p in curve.points]),
                curve.order,
            )
            for name, curve in self.curves.items()
        }
        return DrawnAxes(title, label, curves, 0.0 if self.reference is None else self.reference.error)

    def __repr__(self):
        rows = [("error", self.measured)]
        if self.reference is not None:
            rows.append(("reference", self.reference.in_words()))
            if not self.reference.agrees:
                rows.append(("WARNING", _reference_warning(self.reference)))
        rows.append(("time", f"median of a compiled solve, without the {in_ms(self.call_seconds)} ms of a call"))
        head = labelled(f"Work and precision of {len(self.curves)} method{'s' if len(self.curves) > 1 else ''}", rows)
        header = ("method", "tolerance", "error", "steps", "evaluations", "ms", "order", "compile/s", "")
        cells = [
            (*_curve_cells(curve, i)[:1], *_point_cells(point), *_curve_cells(curve, i)[1:], _remark(point))
            for curve in self.curves.values()
            for i, point in enumerate(curve.points)
        ]
        return "\n".join([head, "", table(header, cells, prose=True)])


def in_ms(seconds: float) -> str:
    """Milliseconds with three digits."""
    return "-" if not np.isfinite(seconds) else f"{1e3 * seconds:.3g}"


def _in_seconds(seconds: float):
    return "-" if not np.isfinite(seconds) else f"{seconds:.1f}"


def _curve_cells(curve: Curve, i: int):
    """Name, order and seconds of compiling, only in the first row of a method."""
    if i:
        return "", "", ""
    return curve.method, f"{curve.order:.1f}" if np.isfinite(curve.order) else "-", _in_seconds(curve.compile_seconds)


def _point_cells(point: Point):
    known = lambda count: "-" if count is None else f"{count}"
    error = f"{point.error:.1e}" if point.ended_well else "-"
    return f"{point.tolerance:.0e}", error, known(point.steps), known(point.evaluations), in_ms(point.seconds)


def _remark(point: Point):
    if not point.ended_well:
        return point.result
    return "" if point.trusted else "not to be trusted"


def _reference_warning(reference: Reference):
    return (
        f"errors below {reference.error:.0e} are unknown. Usual cause: amplified errors (chaos, a long span), "
        "a force that jumps or is narrow, a wrong reference. Fix: shorten ts, jump_ts=, max_step=, reference=."
    )
