"""Critical points between two points of a branch of cycles: a multiplier passes 1 or -1, or a pair leaves."""

from typing import NamedTuple

import numpy as np

from lagjax.analysis.continuation.arclength import BranchPoint
from lagjax.analysis.continuation.orbit_tracer import OrbitTracer

HALVINGS = 40
# A function whose middle value at three points is below this fraction of the outer ones may be zero twice in between.
DIPS, VERTICES = 0.3, 8


class FoundOrbit(NamedTuple):
    """The kind of a critical point, the point, and how far off its parameter may be."""

    kind: str
    point: BranchPoint
    accuracy: float


def between(tracer: OrbitTracer, a: BranchPoint, b: BranchPoint) -> list[FoundOrbit]:
    """All critical points between two neighbouring points."""
    found = []
    crosses, folds = a.sign * b.sign < 0, a.tangent[-1] * b.tangent[-1] < 0
    if folds:
        # At a pitchfork the parameter turns along the side branch, where the multiplier only touches 1.
        kind = "fold" if crosses or not tracer.crosses else "branch point"
        found.append(_zero(tracer, a, b, kind, lambda p: p.tangent[-1]))
    elif crosses:
        found.append(_zero(tracer, a, b, "branch point", lambda p: p.outputs.plus))
    if a.outputs.minus * b.outputs.minus < 0:
        found.append(_zero(tracer, a, b, "period doubling", lambda p: p.outputs.minus))
    if a.growing is not None and b.growing is not None and a.growing != b.growing and not found:
        found.append(_torus(tracer, a, b))
    return [one for one in found if one is not None]


def dips(tracer: OrbitTracer, a: BranchPoint, b: BranchPoint, c: BranchPoint) -> list[FoundOrbit | BranchPoint]:
    """The two edges of a narrow resonance tongue that lies within two steps, and a point in the tongue."""
    for kind, of in (("branch point", lambda p: p.outputs.plus), ("period doubling", lambda p: p.outputs.minus)):
        left, middle, right = of(a), of(b), of(c)
        same = left * middle > 0 and middle * right > 0
        if not (same and abs(middle) < DIPS * min(abs(left), abs(right))):
            continue
        lowest = _beyond_zero(tracer, a, b, c, of)
        if lowest is not None:
            sides = [_zero(tracer, a, lowest, kind, of), _zero(tracer, lowest, c, kind, of)]
            return [one for one in (sides[0], lowest, sides[1]) if one is not None]
    return []


def _beyond_zero(tracer, a, b, c, of):
    """A point between a and c where a function changes its sign, by parabolas; None if it only comes near zero."""
    length = lambda p, q: float(np.sqrt(tracer.weights @ (q.z - p.z) ** 2))
    whole = length(a, b) + length(b, c)
    x, f = [0.0, length(a, b) / whole, 1.0], [of(a), of(b), of(c)]
    sign, tried = np.sign(f[0]), set(x)
    for _ in range(VERTICES):
        near = np.argsort(np.abs(np.array(x) - x[int(np.argmin(np.abs(f)))]))[:3]
        (x0, x1, x2), (f0, f1, f2) = np.array(x)[near], np.array(f)[near]
        slope, bend = (f1 - f0) / (x1 - x0), ((f2 - f1) / (x2 - x1) - (f1 - f0) / (x1 - x0)) / (x2 - x0)
        if not np.isfinite(bend) or bend * sign <= 0:
            return None
        vertex = 0.5 * (x0 + x1) - slope / (2 * bend)
        point = tracer.between(a, c, vertex) if 0 < vertex < 1 and vertex not in tried else None
        if point is None:
            return None
        if of(point) * sign < 0:
            return point
        tried.add(vertex)
        x.append(vertex)
        f.append(of(point))
    return None


def _zero(tracer, a, b, kind, of) -> FoundOrbit | None:
    found = tracer.zero_between(a, b, of)
    if found is None or not np.isfinite(found[1]):
        return None
    point, off = found
    return FoundOrbit(kind, point, off * tracer.unit)


def _torus(tracer, a, b) -> FoundOrbit | None:
    """The point where a pair leaves the unit circle; None if what begins to grow is not a pair."""
    many = a if a.growing > b.growing else b
    outside = [x for x in many.outputs.multipliers if abs(x) > 1]
    slowest = min(outside, key=abs, default=1.0)
    if abs(np.imag(slowest)) < 1e-3 * abs(slowest):
        return None
    found = _zero(tracer, a, b, "torus", lambda p: p.outputs.pairs)
    if found is not None:
        return found
    low, high, point = 0.0, 1.0, None
    for _ in range(HALVINGS):
        share = 0.5 * (low + high)
        middle = tracer.between(a, b, share)
        if middle is None or middle.growing is None or share in (low, high):
            break
        point = middle
        low, high = (share, high) if middle.growing == a.growing else (low, share)
    off = abs(float(b.z[-1] - a.z[-1])) * (high - low) * tracer.unit
    return None if point is None else FoundOrbit("torus", point, off)
