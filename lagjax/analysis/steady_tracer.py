"""Branches of steady motions, in the equations of `branch_equations.py`.

What is watched from point to point: the sign of `det (J; τ)`, which changes where another branch crosses (also where
this one only touches the critical parameter, as the side branch of a pitchfork does); that of τ_μ, which changes at a
fold; the number of roots that grow; and that of negative eigenvalues of E_y, which changes by two where two are zero
together.

Source: Allgower & Georg, *Introduction to Numerical Continuation Methods*, §8.1 (the determinant).
"""

import jax
import numpy as np

from lagjax.analysis.branch_equations import Frame, evaluated, outputs_at
from lagjax.analysis.equilibria import GROWS_ABOVE
from lagjax.analysis.tracing import Point, Tracer


class SteadyTracer(Tracer):
    """Steady motions of a `Frame`. `fastest`: the fastest root so far, beside which one is round-off."""

    def __init__(self, frame: Frame, low: float, high: float):
        super().__init__(low, high)
        self.frame, self.fastest = frame, 0.0
        size, self.positions = frame.columns.size, frame.steady.n
        self.weights = np.zeros(size + 1)
        self.weights[: self.positions] = 1.0
        self.weights[-1] = 1.0
        self.dtype = np.dtype(frame.columns.dtype)
        self.unit = float(frame.unit)

    def at(self, z):
        value, jacobian, largest = jax.tree.map(np.asarray, evaluated(self.frame, z.astype(self.dtype)))
        return value, jacobian, float(largest)

    def described(self, z, jacobian, tangent) -> Point:
        outputs = jax.tree.map(np.asarray, outputs_at(self.frame, z.astype(self.dtype)))
        sign = np.linalg.slogdet(np.concatenate([jacobian, (self.weights * tangent)[None]]))[0]
        negative = int(np.sum(np.linalg.eigvals(jacobian[:, :-1]).real < 0))
        return Point(z, jacobian, tangent, float(sign), outputs, self._growing(outputs[-1]), negative)

    def _growing(self, roots) -> int | None:
        """How many roots grow; None where they are not known."""
        known = roots[np.isfinite(roots)]
        if not known.size:
            return None
        self.fastest = max(self.fastest, float(np.max(np.abs(known))))
        return int(np.sum(known.real > GROWS_ABOVE[self.dtype] * self.fastest))
