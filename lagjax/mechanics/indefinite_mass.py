"""Whether a motion that stopped met a mass matrix with an eigenvalue below zero.

Where an eigenvalue of M passes zero, `M a = F` has no solution: velocities grow like one over its root, and no motion
reaches the other side. In the coordinates that constraints leave free, Nᵀ M N counts, with A N = 0. How many
eigenvalues are below zero does not depend on units (Sylvester's law of inertia); the numbers themselves do.

The eigenvalues at the start, at the end and just beyond it decide. An r² that only touches zero, as in polar
coordinates, is thus told apart: beyond its zero it is positive again.

Source: Golub & Van Loan, *Matrix Computations*, §8.1.5 (the law of inertia).
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax.mechanics.saddle_point import examined
from lagjax.system import Model, State

# An eigenvalue counts as below zero beyond so many round-offs of the largest.
ROUND_OFFS = 1e3
# How far beyond the end M is looked at, as parts of the way so far.
BEYOND = 4.0 ** np.arange(-24.0, -2.0)


class IndefiniteMass(NamedTuple):
    """The cause in words and the fix, and whether an eigenvalue passes zero from the start to just beyond the end."""

    cause: str
    fix: str
    crossed: bool


def indefinite_mass(model: Model, start: State, end: State) -> IndefiniteMass | None:
    """What M's eigenvalues at the start, the end and beyond it say; None where none is below zero."""
    first, last = _Eigenvalues(model, start), _Eigenvalues(model, end)
    if not (first.known and last.known):
        return None
    found = last if last.differs(first) else _beyond(model, start, end, first)
    if found is not None:
        cause = (
            f"a mass matrix that is not positive definite: its smallest eigenvalue is {first.smallest:.3g} at the "
            f"start, {last.smallest:.2g} at the end and {found.smallest:.2g} at t = {float(found.t):.9g}, most in "
            f"'{found.name}'. Where it passes zero, accelerations have no bound"
        )
    elif first.below:
        cause = (
            f"a mass matrix that is not positive definite: its smallest eigenvalue is {first.smallest:.3g} at the "
            f"start, most in '{first.name}', and {last.smallest:.2g} at the end. A kinetic energy without a lower "
            "bound lets velocities grow without end"
        )
    else:
        return None
    fix = (
        "M = lj.learned.positive_definite(numbers, sizes) for an M that is learned; else the sign of the kinetic "
        "energy in L: np.linalg.eigvalsh(lj.mass_matrix(system, t, q, v, params)) must be above zero"
    )
    return IndefiniteMass(cause, fix, found is not None)


class _Eigenvalues:
    """The eigenvalues of M at a state, in the directions that constraints leave free; not `known` if not finite."""

    def __init__(self, model: Model, s: State):
        found = examined(model, s)
        mass, rows = np.asarray(found.linear.mass, float), np.asarray(found.rows.jacobian, float)
        self.t, self.known, self.below = s.t, bool(np.all(np.isfinite(mass)) and np.all(np.isfinite(rows))), 0
        if not self.known:
            return
        _, sizes, right = np.linalg.svd(rows)
        free = right[int(np.sum(sizes > 1e-9 * np.max(sizes, initial=0.0))) :].T
        values, vectors = np.linalg.eigh(free.T @ mass @ free)
        self.known = values.size > 0
        if self.known:
            round_off = ROUND_OFFS * np.finfo(found.linear.mass.dtype).eps * np.max(np.abs(values))
            self.below, self.above = int(np.sum(values < -round_off)), int(np.sum(values > round_off))
            self.smallest = float(values[0])
            self.name = model.names[int(np.argmax(np.abs(free @ vectors[:, 0])))]

    def differs(self, first: "_Eigenvalues") -> bool:
        """Whether an eigenvalue has another sign than at `first`, beyond round-off."""
        return self.below > first.below or self.above > first.above


def _beyond(model: Model, start: State, end: State, first: _Eigenvalues) -> _Eigenvalues | None:
    """The first state on the straight line beyond the end where an eigenvalue has another sign than at `first`."""
    (x0, _), (x, u) = (model.vectors(s.q, s.v) for s in (start, end))
    way, pace = float(np.max(np.abs(x - x0))), float(np.max(np.abs(u)))
    for part in BEYOND if 0 < way * pace < np.inf else ():
        ahead = np.sign(end.t - start.t) * part * way / pace
        q = jax.tree.map(lambda q, v: np.asarray(q) + ahead * np.asarray(v), end.q, end.v)
        there = _Eigenvalues(model, end._replace(t=end.t + ahead, q=q))
        if not there.known:
            return None
        if there.differs(first):
            return there
    return None
