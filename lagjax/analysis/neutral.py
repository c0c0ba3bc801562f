"""Directions in which nothing changes: shifts to another equilibrium, and other speeds of a steady motion.

They are the vectors y = (positions, velocities) with A y = 0. LAPACK gives any basis of them; here it is reduced until
each has an entry that the others do not have, other speeds first.
"""

import numpy as np

from lagjax.numerics.rank import null_space

ZERO_BELOW = 1e-9


def with_neutral(found, shapes, zero):
    """The shapes (k, N), those of zero roots replaced by a reduced basis."""
    if not np.any(zero):
        return shapes
    p = found.parts
    drift, transfer, position, velocity = (np.asarray(x) for x in (p.drift, p.transfer, p.position, p.velocity))
    A = np.block([[drift, transfer], [-position, -velocity]])
    # Rows of different units.
    size = np.max(np.abs(A), axis=1, keepdims=True)
    basis = null_space(A / np.where(size > 0, size, 1.0), ZERO_BELOW).T
    count = drift.shape[0]
    # Velocities of coordinates, where no position is displaced; positions, where one is.
    still = basis[:, :count] @ np.asarray(p.positions).T
    moving = basis[:, count:] @ np.asarray(p.velocities).T + basis[:, :count] @ np.asarray(p.turning).T
    reduced = _reduced(np.concatenate([still, moving], axis=1))
    shapes, n = np.array(shapes), shapes.shape[1]
    for i, row in zip(np.flatnonzero(zero), reduced):
        row = row[:n] if np.max(np.abs(row[:n])) > 1e-6 else row[n:]
        shapes[i] = row / row[np.argmax(np.abs(row))]
    return shapes


def _reduced(rows):
    """Gauss-Jordan with full pivoting."""
    rows, done = np.array(rows), []
    for i in range(len(rows)):
        left = np.abs(rows)
        left[done] = 0.0
        k, j = np.unravel_index(int(np.argmax(left)), left.shape)
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, j], rows[k])
        done.append(k)
    rows[np.abs(rows) < 1e-12] = 0.0
    return rows
