"""Following branches of a `BranchProblem`: steps, the critical points between them, crossing branches, and the ends.

After each step the monitors of the problem are compared. What changed is refined to a critical point, which is put into
the branch. Where branches cross, the others wait to be followed, each once and in both directions.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from lagjax.analysis.arclength import BranchPoint, BranchProblem, CriticalPoint, Monitor

# Step lengths: the first, the longest (relative to the distance from the origin) and the smallest.
FIRST, LONGEST, LEAST = 0.005, 0.03, 1e-7
# The largest turn of the tangent in a step, in radians, and the desired one.
MOST_TURN, TURN = 0.4, 0.12
# The largest and the desired contraction rate of Newton's method, which is large if the prediction was poor.
MOST_CONTRACTION, CONTRACTION = 0.3, 0.1
# Positions larger than this, in their units, count as infinite.
INFINITY = 1e4
CLOSED_WITHIN = 1e-3
# A spurious crossing means that a step jumped to another branch, and it is repeated with a shorter one, unless it is
# shorter than this already.
SHORT = 1e-6
# Changes of the parameter below this fraction of its range count as none.
CONSTANT = 1e-9
# Critical points closer than this are the same; directions with a larger cosine are.
SAME, SAME_DIRECTION = 1e-5, 0.95
MOST_BRANCHES = 24
# A function whose middle value at three points is below this fraction of the outer ones may be zero twice in between.
DIPS, VERTICES = 0.3, 8
AT_EDGE = "the end of the range"


@dataclass
class BranchPath:
    """The points of a branch in order, why it ends, and the numbers of the critical points through which it goes."""

    points: list[BranchPoint] = field(default_factory=list)
    status: str = ""
    through: set[int] = field(default_factory=set)


class _Launch(NamedTuple):
    """A branch still to be traced, from a critical point in a direction."""

    critical: int
    direction: np.ndarray


class BranchFollower:
    """The branches of a problem and their critical points found so far, and the branches still to be followed.

    `most`: the largest number of points of a branch. `crossings`: whether branches that cross are followed.
    """

    def __init__(self, problem: BranchProblem, most: int, crossings: bool = False):
        self.problem, self.most, self.crossings = problem, most, crossings
        self.paths: list[BranchPath] = []
        self.found: list[CriticalPoint] = []
        self.waiting: list[_Launch] = []

    def follow(self, begin: BranchPoint):
        """Follow the branch from a point, and all that cross."""
        self.paths.append(self._traced(begin))
        while self.waiting and len(self.paths) < MOST_BRANCHES:
            launch = self.waiting.pop(0)
            whole = _joined(*(self._half(launch, sign) for sign in (1.0, -1.0)))
            if whole.points[1:]:
                self.paths.append(whole)

    def _half(self, launch: _Launch, sign: float) -> BranchPath:
        """One half of a branch that crosses another."""
        direction = sign * launch.direction
        point = self.problem.point(self.found[launch.critical].z, direction)
        if isinstance(point, str):
            return BranchPath([], point)
        return self._traced(replace(point, tangent=direction, sign=0.0, growing=None, critical=launch.critical))

    def _traced(self, begin: BranchPoint) -> BranchPath:
        """Follow a branch until it leaves the range of the parameter, ends or closes."""
        problem, path, step = self.problem, BranchPath([begin]), FIRST
        origin = None
        if begin.critical is not None:
            origin = self.found[begin.critical]
            path.through.add(begin.critical)
        problem.moved_to(begin)
        while not path.status and len(path.points) < self.most:
            before, tried = path.points[-1], step
            after, step, why = self._next(before, tried)
            if after is None:
                path.status = why
                break
            outside = not problem.low <= after.z[-1] <= problem.high
            if outside:
                after = problem.at_edge(before, after) or after
            if why := problem.ends(path.points, after, origin):
                path.status = why
                break
            critical = self._between(path.points, after)
            if critical is None:
                step = min(tried, problem.length(after.z - before.z)) / 4
                if step > SHORT * problem.size(before.z):
                    continue
            path.status = self._passed(path, critical or [], after)
            if not path.status:
                path.points.append(after)
                path.status = AT_EDGE if outside else self._end(path, step)
            if not path.status:
                problem.moved_to(after)
        path.status = path.status or f"the limit of {self.most} points"
        return path

    def _next(self, point: BranchPoint, step: float):
        """The next point, the step to try after it, and, if there is no point, the reason."""
        problem = self.problem
        longest = LONGEST * max(1.0, float(np.max(np.abs(point.z[: problem.positions]))))
        why = "Newton's method does not converge, however short the step"
        while step > LEAST * problem.size(point.z):
            step = min(step, longest)
            z = problem.corrected(point.z + step * point.tangent, problem.weights * point.tangent)
            contraction = problem.contraction
            candidate = problem.point(z, point.tangent) if z is not None else None
            if isinstance(candidate, BranchPoint):
                turn = np.arccos(np.clip((problem.weights * candidate.tangent) @ point.tangent, -1, 1))
                moved = problem.length(candidate.z - point.z)
                if turn < MOST_TURN and moved < 1.2 * step and contraction < MOST_CONTRACTION:
                    grow = min(TURN / max(turn, 1e-3), CONTRACTION / max(contraction, 1e-3))
                    return candidate, step * float(np.clip(grow, 0.5, 2.0)), ""
                why = "the branch turns more sharply than steps can follow: a corner of L, or a cusp"
            elif isinstance(candidate, str):
                why = candidate
            step /= 3
        return None, step, why

    def _between(self, points: list[BranchPoint], after: BranchPoint) -> Sequence[CriticalPoint | BranchPoint] | None:
        """What lies between the last point and the next one; None if the step jumped to another branch."""
        problem, before = self.problem, points[-1]
        found = between(problem, before, after)
        if problem.crossings:
            # A turn that was not located, in a step past a crossing, is that crossing.
            found = [c for c in found if c.located or not self._is_near_critical(before, after)]
            if before.sign * after.sign < 0 and not any(c.directions for c in found):
                return None
        if found or len(points) < 2 or before.critical is not None or points[-2].critical is not None:
            return found
        return dips(problem, points[-2], before, after)

    def _is_near_critical(self, before: BranchPoint, after: BranchPoint) -> bool:
        """Whether a known critical point is as near to a point as another one."""
        length = self.problem.length
        return any(length(found.z - before.z) <= 2 * length(after.z - before.z) for found in self.found)

    def _passed(self, path: BranchPath, inside: Sequence[CriticalPoint | BranchPoint], after: BranchPoint) -> str:
        """Put what lies in front of the next point into the path; return why the branch ends there, or nothing."""
        before, place, status = path.points[-1], len(path.points), ""
        along = self.problem.weights * (after.z - before.z)
        for point in inside:
            if isinstance(point, CriticalPoint):
                number, known = self._numbered(point, after)
                path.through.add(number)
                if self.found[number].directions and self._passes_crossing(number, known, after.z - before.z):
                    status = f"a known crossing, at {self.problem.value_of(self.found[number].z)}"
                point = self._at_critical(number, after)
            # Two steps are searched for what only dips, and some of it lies in front of the last point.
            if along @ (point.z - before.z) < 0 and place > 1:
                path.points.insert(place - 1, point)
                place += 1
            else:
                path.points.append(point)
        return status

    def _numbered(self, critical: CriticalPoint, after: BranchPoint) -> tuple[int, bool]:
        """The number of a critical point among those found, and whether it was known already."""
        problem = self.problem
        for i, other in enumerate(self.found if problem.crossings else []):
            if np.max(np.abs(problem.weights * (other.z - critical.z))) < SAME * problem.size(critical.z):
                return i, True
        if critical.point is None:
            point = problem.point(critical.z, after.tangent)
            critical.point = None if isinstance(point, str) else point
        self.found.append(critical)
        return len(self.found) - 1, False

    def _at_critical(self, number: int, after: BranchPoint) -> BranchPoint:
        """The point of a branch at a critical point."""
        critical = self.found[number]
        # A root or multiplier is neutral there, so the nearest other point decides the stability.
        return replace(critical.point or after, z=critical.z, growing=None, critical=number)

    def _passes_crossing(self, number: int, known: bool, step: np.ndarray) -> bool:
        """Note that a branch passes a crossing, so that each direction is followed once; whether this one has been."""
        problem, critical = self.problem, self.found[number]
        along = problem.weights * step / np.linalg.norm(step)
        followed = known and any(abs(self._cosine(d, step)) > SAME_DIRECTION for d in critical.used)
        own = max(critical.directions, key=lambda d: abs(d @ along))
        critical.used.append(own)
        same = SAME_DIRECTION * np.sqrt(along @ along)
        self.waiting = [w for w in self.waiting if w.critical != number or abs(w.direction @ along) < same]
        if not known and self.crossings:
            others = [d for d in critical.directions if d is not own]
            self.waiting += [_Launch(number, d) for d in others]
            critical.used += others
        return followed

    def _cosine(self, a: np.ndarray, b: np.ndarray) -> float:
        length = self.problem.length
        return float((self.problem.weights * a) @ b) / (length(a) * length(b))

    def _end(self, path: BranchPath, step: float) -> str:
        """Why a branch ends at its last point, if it does: at infinity, or where it began."""
        last = path.points[-1]
        if np.max(np.abs(last.z[: self.problem.positions])) > INFINITY:
            escape = self.problem.escape(last)
            if escape is None:
                return f"infinity, near {self.problem.value_of(last.z)}"
            path.through.add(self._numbered(escape, last)[0])
            return f"infinity, at {self.problem.value_of(escape.z, 10)}"
        return "closed" if closes(self.problem, path, step) else ""


def closes(problem: BranchProblem, path: BranchPath, step: float) -> bool:
    """Whether a path has returned to its start."""
    if len(path.points) < 10:
        return False
    first, last = path.points[0], path.points[-1]
    off = problem.length(last.z - first.z)
    return bool(off < max(step, CLOSED_WITHIN) and (problem.weights * first.tangent) @ last.tangent > 0.9)


def _joined(first: BranchPath, second: BranchPath) -> BranchPath:
    """Join both halves of a branch, from one end through the critical point to the other end."""
    status = first.status if not second.points[1:] else f"{second.status}, and {first.status}"
    if first.status == second.status:
        status = first.status
    return BranchPath([*second.points[:0:-1], *first.points], status, first.through | second.through)


def between(problem: BranchProblem, a: BranchPoint, b: BranchPoint) -> list[CriticalPoint]:
    """All critical points between two neighbouring points of a branch."""
    if max(abs(b.z[-1] - a.z[-1]), abs(a.tangent[-1]), abs(b.tangent[-1])) < CONSTANT:
        # On a line of solutions at one value of the parameter only round-off changes.
        return []
    found: list[CriticalPoint] = []
    for monitor in problem.monitors:
        if monitor.changes(monitor.value(a), monitor.value(b)) and not (monitor.alone and found):
            critical = monitor.refine(problem, a, b)
            found += [] if critical is None else [critical]
    return found


def dips(problem: BranchProblem, a: BranchPoint, b: BranchPoint, c: BranchPoint) -> list[CriticalPoint | BranchPoint]:
    """The two edges of a narrow resonance tongue that lies within two steps, and a point in the tongue."""
    for monitor in problem.monitors:
        lowest = _beyond_zero(problem, a, b, c, monitor) if monitor.smooth else None
        if lowest is not None:
            edges = [monitor.refine(problem, a, lowest), monitor.refine(problem, lowest, c)]
            return [one for one in (edges[0], lowest, edges[1]) if one is not None]
    return []


def _beyond_zero(problem: BranchProblem, a: BranchPoint, b: BranchPoint, c: BranchPoint, monitor: Monitor):
    """A point between a and c where a function changes its sign, by parabolas; None if it only comes near zero."""
    left, middle, right = (monitor.value(p) for p in (a, b, c))
    if not (left * middle > 0 and middle * right > 0 and abs(middle) < DIPS * min(abs(left), abs(right))):
        return None
    whole = problem.length(b.z - a.z) + problem.length(c.z - b.z)
    x, f = [0.0, problem.length(b.z - a.z) / whole, 1.0], [left, middle, right]
    sign, tried = np.sign(left), set(x)
    for _ in range(VERTICES):
        near = np.argsort(np.abs(np.array(x) - x[int(np.argmin(np.abs(f)))]))[:3]
        (x0, x1, x2), (f0, f1, f2) = np.array(x)[near], np.array(f)[near]
        slope, bend = (f1 - f0) / (x1 - x0), ((f2 - f1) / (x2 - x1) - (f1 - f0) / (x1 - x0)) / (x2 - x0)
        if not np.isfinite(bend) or bend * sign <= 0:
            return None
        vertex = 0.5 * (x0 + x1) - slope / (2 * bend)
        point = problem.between(a, c, vertex) if 0 < vertex < 1 and vertex not in tried else None
        if point is None:
            return None
        if monitor.value(point) * sign < 0:
            return point
        tried.add(vertex)
        x.append(vertex)
        f.append(monitor.value(point))
    return None
