"""Branches of cycles, from the equations of `orbit_equations.py`: their points, with multipliers and stability.

Two functions of the monodromy matrix N are monitored. With the rows Q of its trivial directions and P = 1 - QᵀQ,

    χ₊ = det (P (N - 1) P + QᵀQ),      χ₋ = det (P (N + 1) P + QᵀQ)

are the products of μ - 1 and μ + 1 over the nontrivial multipliers. χ₊ is zero at a fold and where other cycles branch
off, χ₋ where cycles of twice the period branch off. Where multipliers meet, both remain as smooth as N.

Source: Seydel, *Practical Bifurcation and Stability Analysis*, §7.6; Kuznetsov, *Elements of Applied Bifurcation
Theory*, §10.2.
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax.analysis.continuation.arclength import BranchPoint, Tracer
from lagjax.analysis.continuation.orbit_equations import Evaluated, Guide, OrbitFrame, orbit_at, path_at

# A driven system repeats if it changes by less than this from one period to the next, relative to its change in a
# period.
SAME = 1e-5
# A multiplier within this many square roots of the error of N is on the unit circle: a double one is off by that much.
ON_CIRCLE = 3.0


class OrbitOutputs(NamedTuple):
    """The outputs of a point, and the monitored functions: χ₊, χ₋, and `pairs`, which is zero where a pair leaves.

    - `multipliers` (k,): the trivial ones first.
    - `low`, `high` (n,): the smallest and largest value of each coordinate; `moves`: their largest distance, scaled.
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
        self.cached: tuple[bytes, Evaluated] | None = None

    @property
    def noise(self) -> float:
        return max(self.eps, float(self.frame.flow.rtol) * max(1.0, self.amplified))

    def evaluated(self, z) -> Evaluated:
        """The equations evaluated at a point; the result for the last point is cached."""
        z = z.astype(self.dtype)
        key = b"".join(np.asarray(x).tobytes() for x in (z, *self.guide))
        if self.cached is None or self.cached[0] != key:
            self.cached = key, jax.tree.map(np.asarray, orbit_at(self.frame, z, self.guide))
        return self.cached[1]

    def at(self, z):
        evaluation = self.evaluated(z)
        if np.isfinite(evaluation.amplified):
            self.amplified = float(evaluation.amplified)
        return evaluation.value, evaluation.jacobian, float(evaluation.largest)

    def moved_to(self, point):
        self.guide = self.evaluated(point.z).guide

    def described(self, z, jacobian, tangent) -> BranchPoint | str:
        evaluation = self.evaluated(z)
        if float(evaluation.apart) > max(SAME, 1e3 * self.eps):
            return "the system is not the same after any period near the last one: its drive has no common period"
        multipliers, left = self._multipliers(evaluation)
        plus, minus = (self._product(evaluation, shift) for shift in (-1.0, 1.0))
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
        return BranchPoint(z, jacobian, tangent, float(np.sign(outputs.plus)), outputs, growing, below)

    def _multipliers(self, evaluation: Evaluated) -> tuple[np.ndarray, np.ndarray]:
        """All multipliers, the trivial ones first as exactly 1; and the nontrivial ones alone, by falling size."""
        count = int(np.sum(evaluation.there))
        reduced = self._without(evaluation, evaluation.whole)
        left = np.linalg.eigvals(reduced)
        left = left[np.argsort(np.abs(left - 1), kind="stable")][count:]
        left = left[
            np.lexsort((-left.imag, -np.round(np.abs(left) / max(np.max(np.abs(left), initial=0.0), 1e-300), 9)))
        ]
        return np.concatenate([np.ones(count, complex), left.astype(complex)]), left.astype(complex)

    def _without(self, evaluation, matrix):
        rest = np.eye(len(matrix)) - evaluation.trivial.T @ evaluation.trivial
        return rest @ matrix @ rest + evaluation.trivial.T @ evaluation.trivial

    def _product(self, evaluation, shift):
        return float(np.linalg.det(self._without(evaluation, evaluation.whole + shift * np.eye(len(evaluation.whole)))))

    def _pairs(self, left):
        """A function that changes its sign where a pair leaves the unit circle.

        Without damping two pairs meet there, and the function is the product of (ρ_i - ρ_j)² with ρ = μ + 1/μ.
        Otherwise it is the logarithm of the size of the pair nearest to the circle.
        """
        upper = left[left.imag > 0]
        if not self.frame.reasons.momenta:
            slowest = np.abs(upper)[np.argmin(np.abs(np.log(np.abs(upper))))] if upper.size else 0.0
            return float(np.log(slowest)) if slowest else np.nan
        if left.size < 4:
            return np.nan
        rho, rest = [], list(left + 1 / left)
        while len(rest) > 1:
            # μ and 1/μ have the same ρ, so each value occurs twice.
            rho.append(rest.pop())
            rest.pop(int(np.argmin(np.abs(np.array(rest) - rho[-1]))))
        apart = np.array([(a - b) ** 2 for i, a in enumerate(rho) for b in rho[i + 1 :]])
        return float(np.prod(apart).real)


def extent(times, states):
    """The smallest and largest value of each coordinate on a path, with cubic interpolation between its points."""
    x, u = np.split(states, 2, axis=1)
    h = np.diff(times)[:, None]
    x0, x1, m0, m1 = x[:-1], x[1:], h * u[:-1], h * u[1:]
    a, b, c = 2 * (x0 - x1) + m0 + m1, 3 * (x1 - x0) - 2 * m0 - m1, m0
    # The extrema of a cubic: 3 a s² + 2 b s + c = 0.
    root = np.sqrt(np.maximum(b**2 - 3 * a * c, 0.0))
    q = -(b + np.copysign(root, b))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = [q / (3 * a), c / q]
    candidates = [x0, x1]
    for s in roots:
        inside = np.isfinite(s) & (s > 0) & (s < 1)
        s = np.where(inside, s, 0.0)
        candidates.append(((a * s + b) * s + c) * s + x0)
    return np.min(candidates, axis=(0, 1)), np.max(candidates, axis=(0, 1))
