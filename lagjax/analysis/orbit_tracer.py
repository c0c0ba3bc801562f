"""Branches of cycles, in the equations of `orbit_equations.py`: their points, with multipliers and stability.

Of the monodromy matrix N, with the rows Q of what is trivial in it and P = 1 - QᵀQ, two functions are watched,

    χ₊ = det (P (N - 1) P + QᵀQ),      χ₋ = det (P (N + 1) P + QᵀQ)

the products of μ - 1 and μ + 1 over the multipliers that are not trivial: χ₊ is zero at a fold and where other cycles
branch off, χ₋ where those of twice the period do. They are as smooth as N where multipliers meet.

Source: Seydel, *Practical Bifurcation and Stability Analysis*, §7.6; Kuznetsov, *Elements of Applied Bifurcation
Theory*, §10.2.
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax.analysis.orbit_equations import Evaluated, Guide, OrbitFrame, orbit_at, path_at
from lagjax.analysis.tracing import Point, Tracer

# Changes of a driven system from one period to the next that are none, relative to what a period makes.
SAME = 1e-5
# Multipliers so near the unit circle, in roots of the error of M, are on it: a double one is off by that.
ON_CIRCLE = 3.0


class OrbitOutputs(NamedTuple):
    """What a user sees of a point, and what is watched: χ₊ and χ₋, and whether a pair is about to leave the circle.

    - `multipliers` (k,): the trivial ones first.
    - `low`, `high` (n,): the smallest and largest of each coordinate; `moves`: the largest distance between these.
    """

    parameter: float
    period: float
    nodes: np.ndarray
    multipliers: np.ndarray
    low: np.ndarray
    high: np.ndarray
    plus: float
    minus: float
    pairs: float
    moves: float


class OrbitTracer(Tracer):
    """Cycles of an `OrbitFrame`. `guide`: the last point of the branch."""

    def __init__(self, frame: OrbitFrame, low: float, high: float, guide: Guide, crosses: bool):
        super().__init__(low, high)
        self.frame, self.guide, self.crosses = frame, guide, crosses
        nodes = frame.parts * frame.scale.size
        self.positions = nodes
        self.weights = np.append(np.full(nodes, 1 / frame.parts), [1.0, 1.0])
        self.dtype = np.dtype(frame.scale.dtype)
        self.unit = float(frame.unit)
        self.amplified = 1.0
        self.kept: tuple[bytes, Evaluated] | None = None

    @property
    def noise(self) -> float:
        return max(self.eps, float(self.frame.flow.rtol) * max(1.0, self.amplified))

    def evaluated(self, z) -> Evaluated:
        """What the flow says at a point; of the last one it is remembered."""
        z = z.astype(self.dtype)
        key = b"".join(np.asarray(x).tobytes() for x in (z, *self.guide))
        if self.kept is None or self.kept[0] != key:
            self.kept = key, jax.tree.map(np.asarray, orbit_at(self.frame, z, self.guide))
        return self.kept[1]

    def at(self, z):
        found = self.evaluated(z)
        if np.isfinite(found.amplified):
            self.amplified = float(found.amplified)
        return found.value, found.jacobian, float(found.largest)

    def moved_to(self, point):
        self.guide = self.evaluated(point.z).guide

    def described(self, z, jacobian, tangent) -> Point | str:
        found = self.evaluated(z)
        if float(found.apart) > max(SAME, 1e3 * self.eps):
            return "the system is not the same after any period near the last one: its drive has no common period"
        multipliers, left = self._multipliers(found)
        plus, minus = (self._product(found, shift) for shift in (-1.0, 1.0))
        times, states = path_at(self.frame, z.astype(self.dtype))
        low, high = extent(np.asarray(times), np.asarray(states))
        size = np.abs(left)
        within = ON_CIRCLE * np.sqrt(self.noise)
        growing = int(np.sum(size > 1 + within)) if np.all(np.isfinite(size)) else None
        below = int(np.sum((np.imag(left) == 0) & (np.real(left) < -1)))
        period = float(self.frame.period) * np.exp(z[-2])
        nodes = z[:-2].reshape(self.frame.parts, -1) * np.asarray(self.frame.scale)
        outputs = OrbitOutputs(
            z[-1] * self.unit, period, nodes, multipliers, low, high, plus if self.crosses else 1.0, minus,
            self._pairs(left), float(np.max((high - low) / np.asarray(self.frame.scale)[: len(low)])),
        )  # fmt: skip
        return Point(z, jacobian, tangent, float(np.sign(outputs.plus)), outputs, growing, below)

    def _multipliers(self, found: Evaluated) -> tuple[np.ndarray, np.ndarray]:
        """All of them, those that are trivial first as 1; and those that are not, by falling size."""
        count = int(np.sum(found.there))
        reduced = self._without(found, found.whole)
        left = np.linalg.eigvals(reduced)
        left = left[np.argsort(np.abs(left - 1), kind="stable")][count:]
        left = left[
            np.lexsort((-left.imag, -np.round(np.abs(left) / max(np.max(np.abs(left), initial=0.0), 1e-300), 9)))
        ]
        return np.concatenate([np.ones(count, complex), left.astype(complex)]), left.astype(complex)

    def _without(self, found, matrix):
        rest = np.eye(len(matrix)) - found.trivial.T @ found.trivial
        return rest @ matrix @ rest + found.trivial.T @ found.trivial

    def _product(self, found, shift):
        return float(np.linalg.det(self._without(found, found.whole + shift * np.eye(len(found.whole)))))

    def _pairs(self, left):
        """A function that changes its sign where a pair leaves the unit circle.

        Without damping two pairs meet there: with ρ = μ + 1/μ, the product of (ρ_i - ρ_j)². Else the distance of the
        slowest pair from the circle.
        """
        upper = left[left.imag > 0]
        if not self.frame.reasons.momenta:
            slowest = np.abs(upper)[np.argmin(np.abs(np.log(np.abs(upper))))] if upper.size else 0.0
            return float(np.log(slowest)) if slowest else np.nan
        if left.size < 4:
            return np.nan
        rho, rest = [], list(left + 1 / left)
        while len(rest) > 1:
            # Each is there twice.
            rho.append(rest.pop())
            rest.pop(int(np.argmin(np.abs(np.array(rest) - rho[-1]))))
        apart = np.array([(a - b) ** 2 for i, a in enumerate(rho) for b in rho[i + 1 :]])
        return float(np.prod(apart).real)


def extent(times, states):
    """The smallest and largest of each coordinate on a path of positions and velocities, by cubics between points."""
    x, u = np.split(states, 2, axis=1)
    h = np.diff(times)[:, None]
    x0, x1, m0, m1 = x[:-1], x[1:], h * u[:-1], h * u[1:]
    a, b, c = 2 * (x0 - x1) + m0 + m1, 3 * (x1 - x0) - 2 * m0 - m1, m0
    # Where 3 a s² + 2 b s + c = 0.
    root = np.sqrt(np.maximum(b**2 - 3 * a * c, 0.0))
    q = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        places = [q / (3 * a), c / q]
    found = [x0, x1]
    for s in places:
        inside = np.isfinite(s) & (s > 0) & (s < 1)
        s = np.where(inside, s, 0.0)
        found.append(((a * s + b) * s + c) * s + x0)
    return np.min(found, axis=(0, 1)), np.max(found, axis=(0, 1))
