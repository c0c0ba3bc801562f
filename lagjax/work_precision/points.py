"""The parts of a comparison: points, the curve of each method, and its measured order."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagjax.integrate.trajectory.trajectory import Trajectory

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
