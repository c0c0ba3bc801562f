"""What is critical between two points of a branch of cycles: where a multiplier passes 1 or -1, or a pair leaves."""

from typing import NamedTuple

import numpy as np

from lagjax.analysis.orbit_tracer import OrbitTracer
from lagjax.analysis.tracing import Point

HALVINGS = 40


class FoundOrbit(NamedTuple):
    """The kind of a critical point, the point, and how far off its parameter may be."""

    kind: str
    point: Point
    accuracy: float


def between(tracer: OrbitTracer, a: Point, b: Point) -> list[FoundOrbit]:
    """All that is critical between two neighbouring points."""
    found = []
    crosses, folds = a.sign * b.sign < 0, a.tangent[-1] * b.tangent[-1] < 0
    if folds:
        # Along the side branch of a pitchfork the parameter turns, and the multiplier only touches 1.
        kind = "fold" if crosses or not tracer.crosses else "branch point"
        found.append(_zero(tracer, a, b, kind, lambda p: p.tangent[-1]))
    elif crosses:
        found.append(_zero(tracer, a, b, "branch point", lambda p: p.seen.plus))
    if a.seen.minus * b.seen.minus < 0:
        found.append(_zero(tracer, a, b, "period doubling", lambda p: p.seen.minus))
    if a.growing is not None and b.growing is not None and a.growing != b.growing and not found:
        found.append(_torus(tracer, a, b))
    return [one for one in found if one is not None]


def _zero(tracer, a, b, kind, of) -> FoundOrbit | None:
    found = tracer.zero_between(a, b, of)
    if found is None or not np.isfinite(found[1]):
        return None
    point, off = found
    return FoundOrbit(kind, point, off * tracer.unit)


def _torus(tracer, a, b) -> FoundOrbit | None:
    """Where a pair leaves the unit circle; None where what begins to grow is no pair."""
    many = a if a.growing > b.growing else b
    outside = [x for x in many.seen.multipliers if abs(x) > 1]
    slowest = min(outside, key=abs, default=1.0)
    if abs(np.imag(slowest)) < 1e-3 * abs(slowest):
        return None
    found = _zero(tracer, a, b, "torus", lambda p: p.seen.pairs)
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
