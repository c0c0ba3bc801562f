"""What a comparison consists of: points, the curve of each method, and its measured order."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lagjax.motion.trajectory import Trajectory

# Tighter tolerances that gain less than this, over the best before, are where round-off rules.
STALLED = 1.5
# Above this relative error steps are too long for an order to show.
TOO_LARGE = 0.05


@dataclass(frozen=True)
class Point:
    """One method at one tolerance.

    - `error`: relative, infinite where the motion was not computed to its end; `trusted`: whether it is twice what the
      reference may itself be off by, or more.
    - `seconds`: median of compiled solves, without the call's own; NaN where none was measured. `least`: the fastest.
    - `steps`, accepted and rejected; `evaluations` of the accelerations; None where they are not known.
    - `result`: how it ended, in words. `trajectory`: the motion; None of another tool's.
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
    """One method: its points, from loose to tight, the solver (None of another tool's), and seconds of compiling."""

    method: str
    solver: Any
    compile_seconds: float
    points: tuple[Point, ...]

    @property
    def order(self) -> float:
        """The measured order: minus the slope of error over evaluations (of error over time where these are not known).

        NaN where fewer than three points show it: between errors of 5 % and round-off, and above the reference's own.
        """
        work, errors = _falling(self.points)
        if len(work) < 3:
            return float("nan")
        return float(-np.polyfit(np.log(work), np.log(errors), 1)[0])

    def within(self, error: float) -> Point | None:
        """The fastest point whose error, and that of all tighter ones that were computed, is within `error`."""
        good = []
        for point in reversed(self.points):
            if not np.isfinite(point.seconds) or not point.ended_well:
                continue
            if point.error > error:
                break
            good.append(point)
        return min(good, key=lambda point: point.seconds, default=None)


def _falling(points: Sequence[Point]):
    """Work and errors of the points that an order shows in, as arrays."""
    shown = [p for p in points if p.ended_well and p.trusted and 0 < p.error <= TOO_LARGE and np.isfinite(p.seconds)]
    by_evaluations = all(p.evaluations for p in shown)
    work = np.array([p.evaluations if by_evaluations else p.seconds for p in shown], float)
    errors = np.array([p.error for p in shown])
    last = 0
    for i in range(1, len(shown)):
        if errors[i] * STALLED < np.min(errors[:i]) and work[i] > work[last]:
            last = i
    return work[: last + 1], errors[: last + 1]
