"""Neutral directions: shifts to another equilibrium, and other speeds of a steady motion.

They are the vectors y = (positions, velocities) with A y = 0. LAPACK returns an arbitrary basis of them. Here it is
reduced until each vector has an entry that is zero in all others.
"""

import jax
import numpy as np

from lagjax.numerics.linalg.rank import null_space

ZERO_BELOW = 1e-9
NEWTON_STEPS, STEADY_AFTER = 8, 1e-9


def with_neutral(linearisation, shapes, zero):
    """The shapes (k, N), with those of zero roots replaced by a reduced basis; and a description of each zero root.

    There may be fewer neutral directions than zero roots; the remaining roots are motions along them that grow with
    time.
    """
    words = [""] * len(zero)
    if not np.any(zero):
        return shapes, words
    p, kind = linearisation.parts, linearisation.kind
    drift, transfer, position, velocity = (np.asarray(x) for x in (p.drift, p.transfer, p.position, p.velocity))
    A = np.block([[drift, transfer], [-position, -velocity]])
    # Rows have different units, so each is scaled by its largest entry.
    size = np.max(np.abs(A), axis=1, keepdims=True)
    basis = null_space(A / np.where(size > 0, size, 1.0), ZERO_BELOW).T
    count = drift.shape[0]
    # A direction with a displacement is described by it, one without a displacement by its velocities.
    still = basis[:, :count] @ np.asarray(p.positions).T
    moving = basis[:, count:] @ np.asarray(p.velocities).T + basis[:, :count] @ np.asarray(p.turning).T
    reduced = _reduced(np.concatenate([still, moving], axis=1))
    shapes, n = np.array(shapes), shapes.shape[1]
    for i, row in zip(np.flatnonzero(zero), reduced):
        shifts = np.max(np.abs(row[:n])) > 1e-6
        row = row[:n] if shifts else row[n:]
        shapes[i] = row / row[np.argmax(np.abs(row))]
        moved = _listed(linearisation.names, shapes[i])
        if not shifts:
            words[i] = f"other speeds in {moved}"
        elif all(kind.holonomic):
            words[i] = f"along {moved}"
        else:
            words[i] = f"shift of {moved}, which the velocity constraints leave free"
    for i in np.flatnonzero(zero)[len(reduced) :]:
        words[i] = "a shift or a speed named before, growing with time"
    return shapes, words


def leads_to_others(linearisation, shapes, linearised_at) -> bool:
    """Whether other equilibria lie along each of the zero `shapes` (k, N): a symmetry, not a critical point.

    From points displaced along each shape, Newton's method looks for an equilibrium in the directions across all
    shapes. `linearised_at(x)`: the `Linearisation` at other positions.
    """
    start = np.concatenate([np.ravel(x) for x in jax.tree.leaves(linearisation.state.q)])
    P = np.asarray(linearisation.parts.positions)
    along = np.linalg.qr(np.linalg.pinv(P) @ np.real(shapes).T)[0]
    across = null_space(along.T)
    size = np.max(np.abs(start)) or 1.0
    for shape in np.real(shapes):
        for share in (0.2, -0.2):
            x = start + share * size * shape
            for _ in range(NEWTON_STEPS):
                now = linearised_at(x)
                if not now.sound:
                    return False
                x = x + _step(now, across)
            if not linearised_at(x).residual <= STEADY_AFTER:
                return False
    return True


def _step(now, across):
    """The Newton step to an equilibrium on the constraints, restricted to the directions `across`."""
    p, holonomic = now.parts, np.array(now.kind.holonomic, bool)
    P, V, mass, K = (np.asarray(x) for x in (p.positions, p.velocities, p.mass, p.position))
    force = mass @ np.linalg.pinv(V) @ np.asarray(p.a)
    step = P @ across @ np.linalg.pinv(K @ across) @ force if across.shape[1] else np.zeros(len(P))
    rows, off = np.asarray(p.raw.rows)[holonomic], np.asarray(p.off)[: int(holonomic.sum())]
    return step - np.linalg.pinv(rows) @ off if len(rows) else step


def _listed(names, shape):
    entries = [name for name, x in zip(names, shape) if abs(x) > 1e-6]
    return ", ".join(entries[:4]) + (", ..." if len(entries) > 4 else "")


def _reduced(rows):
    """Gauss-Jordan elimination with full pivoting."""
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
