"""Branches of steady motions, from the equations of `equilibrium_equations.py`.

Monitored from point to point are the sign of `det (J; τ)`, which changes where another branch crosses (also where this
one only touches the critical parameter, as the side branch of a pitchfork does); the sign of τ_μ, which changes at a
fold; the number of growing roots; and the number of negative eigenvalues of E_y, which changes by two where two vanish
together.

Source: Allgower & Georg, *Introduction to Numerical Continuation Methods*, §8.1 (the determinant).
"""

import jax
import numpy as np

from lagjax.analysis.continuation.arclength import BranchPoint, Tracer
from lagjax.analysis.continuation.equilibrium_equations import Frame, evaluated, outputs_at
from lagjax.analysis.equilibria.equilibria import GROWS_ABOVE


class SteadyTracer(Tracer):
    """Steady motions of a `Frame`. `fastest`: the size of the fastest root so far, the unit of the roots' round-off."""

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

    def described(self, z, jacobian, tangent) -> BranchPoint:
        outputs = jax.tree.map(np.asarray, outputs_at(self.frame, z.astype(self.dtype)))
        sign = np.linalg.slogdet(np.concatenate([jacobian, (self.weights * tangent)[None]]))[0]
        negative = int(np.sum(np.linalg.eigvals(jacobian[:, :-1]).real < 0))
        return BranchPoint(z, jacobian, tangent, float(sign), outputs, self._growing(outputs[-1]), negative)

    def _growing(self, roots) -> int | None:
        """The number of growing roots; None if the roots are not known."""
        known = roots[np.isfinite(roots)]
        if not known.size:
            return None
        self.fastest = max(self.fastest, float(np.max(np.abs(known))))
        return int(np.sum(known.real > GROWS_ABOVE[self.dtype] * self.fastest))
