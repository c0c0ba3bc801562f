"""The reduced force along the zero modes of an equilibrium, and the multiple roots that it has.

Let J be the Jacobian of the balance r(y) = 0 at y₀, with almost null right vectors φ and left ones ψ. The bordered
equations

    r(y) + β ψ = 0,    φ·(y - y₀) = s

are regular; they eliminate everything but the amplitudes s, and leave the reduced force b(s) = -β(s) with which the
equilibrium resists (Lyapunov-Schmidt). Near a root it is c₊ s^k on one side and c₋ |s|^k on the other. The exponent k
is read off b at amplitudes that shrink by a constant factor, where |b| shrinks by a constant factor too: so round-off,
which does not, is not taken for a force. A k-fold root is found by Newton's method only to ε^(1/k); between its
neighbours it is the simple root of the derivative b^(k-1).

Source: Govaerts, *Numerical Methods for Bifurcations of Dynamical Equilibria* (2000), ch. 3 (bordered systems).
"""

from typing import NamedTuple

import jax
import numpy as np

from lagjax.analysis.equilibria import balance as equations
from lagjax.analysis.equilibria.balance import Steady
from lagjax.jaxtools import compiled
from lagjax.numerics import newton_in_python, null_space, with_value

# Amplitudes that are evaluated together, half of them on each side.
SAMPLES = 64
NEWTON_STEPS = 10
# Stiffness, relative to the typical one, along a valley in which a search has stopped short of a multiple root.
CREEPS_BELOW = 1e-2
# Exponents of neighbouring amplitudes agree to this; round-off has no exponent.
SAME_EXPONENT, WINDOW = 0.15, 4


class Side(NamedTuple):
    """The first term on one side: its sign, its exponent, and the smallest amplitude at which it shows."""

    sign: float
    exponent: float
    amplitude: float


class Bordered(NamedTuple):
    """The equations about an equilibrium y₀ (N,): units of rows and columns, and the null vectors in these units."""

    steady: Steady
    y: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    right: np.ndarray
    left: np.ndarray


def soft_below(dtype) -> float:
    """Stiffness below this part of the typical one may be that of a multiple root, which is off by ε^(1/k)."""
    return 1e2 * float(np.sqrt(np.finfo(dtype).eps))


@compiled
def values_at(steady: Steady, points):
    """The imbalance and its Jacobian at many points."""
    return jax.vmap(lambda y: with_value(lambda y: equations.balance(steady, y), y))(points)


def padded(points, dtype):
    """Points (B, N), repeated to the number for which the program is compiled."""
    return np.resize(points, (SAMPLES, points.shape[1])).astype(dtype)


def bordered_at(steady, y, size, unseen, soft=None) -> Bordered:
    """The null vectors of the balance at y: of positions, except the symmetries and the `unseen` coordinates."""
    soft = soft_below(steady.t.dtype) if soft is None else soft
    dtype, n = np.dtype(steady.t.dtype), steady.n
    y = np.asarray(y, float)
    unit = size if size > 0 else 1.0
    # The row of a single number has no scale of its own, so it is taken at displaced points too.
    shifts = np.random.default_rng(0).uniform(-0.5, 0.5, (SAMPLES, y.size)) * unit
    shifts[0], shifts[:, n:] = 0.0, 0.0
    _, jacobians = (np.asarray(x, float) for x in values_at(steady, (y + shifts).astype(dtype)))
    jacobian = jacobians[0]

    def positive(x: np.ndarray):
        return np.where(x > 0, x, 1.0)

    usable = np.where(np.isfinite(jacobians), np.abs(jacobians), 0.0)
    rows = positive(np.max(np.median(usable, axis=0)[:, :n], axis=1) * unit)
    of_columns = np.max(np.abs(jacobian) / rows[:, None], axis=0)
    columns = np.concatenate([np.full(n, unit), 1 / positive(of_columns[n:])])
    matrix = jacobian / rows[:, None] * columns[None, :]
    along = np.asarray(fields_at(steady, y[:n].astype(dtype)), float)
    extra = np.zeros((len(along) + len(unseen), y.size))
    extra[: len(along), :n] = along / positive(np.max(np.abs(along), axis=1, initial=0.0))[:, None]
    extra[np.arange(len(unseen)) + len(along), unseen] = 1.0
    # Multipliers of dependent constraints are no motion, and combinations of constraints are no force.
    right = _with_part(_almost_null(np.concatenate([matrix, extra]), soft), n)
    left = _with_part(_almost_null(matrix.T, soft), n)
    if left.shape[1] > right.shape[1]:
        # Unseen coordinates and symmetries have no reduced force.
        of_extra = extra[:, :n] / rows[:n] if len(extra) else extra[:, :n]
        kept = left.copy()
        for row in np.linalg.qr(of_extra.T)[0].T if len(extra) else ():
            weights = row @ kept[:n]
            if np.linalg.norm(weights) > 1e-8:
                kept = kept @ null_space(weights[None, :])
        left = kept
    return Bordered(steady, y, rows, columns, right, left)


def _almost_null(matrix, below):
    """The right singular vectors (N, r) of the singular values up to `below`."""
    _, sizes, right = np.linalg.svd(matrix)
    return right[np.sum(sizes > below) :].T


def _with_part(vectors, n):
    """Combinations of null vectors (N, r) that have a part among the first n unknowns."""
    if not vectors.shape[1]:
        return vectors
    _, sizes, combine = np.linalg.svd(vectors[:n], full_matrices=False)
    return vectors @ combine[sizes > 1e-8].T


@compiled
def fields_at(steady, x):
    """The velocity along each symmetry at unit rate."""
    return steady.fields(x)


def reduced(bordered: Bordered, amplitudes: np.ndarray):
    """The reduced force b (B, z) at amplitudes s (B, z), and the unknowns there; NaN where there is no solution."""
    steady, y0, rows, columns, right, left = bordered
    dtype, z, count = np.dtype(steady.t.dtype), right.shape[1], len(amplitudes)
    y = y0 + columns * (amplitudes @ right.T)
    units = np.append(columns, np.ones(z))

    def step(both):
        y, beta = both[:, : y0.size], both[:, y0.size :]
        r, jacobian = (np.asarray(x, float)[:count] for x in values_at(steady, padded(y, dtype)))
        matrix = np.zeros((count, len(rows) + z, y0.size + z))
        matrix[:, : len(rows), : y0.size] = jacobian / rows[:, None] * columns
        matrix[:, : len(rows), y0.size :] = left
        matrix[:, len(rows) :, : y0.size] = right.T
        off = np.concatenate([r / rows + beta @ left.T, ((y - y0) / columns) @ right - amplitudes], axis=1)
        usable = np.all(np.isfinite(matrix), axis=(1, 2)) & np.all(np.isfinite(off), axis=1)
        inverse = np.linalg.pinv(np.where(usable[:, None, None], matrix, 0.0), rcond=1e-11)
        return units * np.einsum("bij,bj->bi", inverse, np.where(usable[:, None], off, np.nan))

    with np.errstate(all="ignore"):
        found = newton_in_python(step, np.concatenate([y, np.zeros((count, z))], axis=1), NEWTON_STEPS)
    assert found is not None
    last = np.max(np.abs(found.step[:, : y0.size] / columns), axis=1)
    reached = (last <= 1e-6 * np.max(np.abs(amplitudes), axis=1))[:, None]
    return np.where(reached, -found.y[:, y0.size :], np.nan), np.where(reached, found.y[:, : y0.size], np.nan)


def reduced_force(bordered, size):
    """Amplitudes (A,), ascending, and b at -A ... -a, a ... A."""
    # Where nothing says how large the positions are, a wider range.
    steps = np.arange(2, 2 + SAMPLES // 2)[::-1] * (1.0 if size > 0 else 2.0)
    amplitudes = 2.0**-steps
    return amplitudes, reduced(bordered, np.concatenate([-amplitudes[::-1], amplitudes])[:, None])[0][:, 0]


def first_term(amplitudes, b) -> Side | None:
    """The first term of b on one side: from the smallest amplitude on at which |b| has an exponent."""
    order = np.argsort(amplitudes)
    s, b = np.asarray(amplitudes)[order], np.asarray(b)[order]
    with np.errstate(all="ignore"):
        exponents = np.diff(np.log2(np.abs(b))) / np.diff(np.log2(s))
    for i in range(len(exponents) - WINDOW + 1):
        some = exponents[i : i + WINDOW]
        same_sign = np.all(np.sign(b[i : i + WINDOW + 1]) == np.sign(b[i]))
        if same_sign and np.all(np.isfinite(some)) and np.ptp(some) <= SAME_EXPONENT and np.median(some) > 0.5:
            return Side(float(np.sign(b[i])), float(np.median(some)), float(s[i]))
    return None


def between(bordered, side: Side) -> np.ndarray:
    """The k-fold root to full accuracy: the simple root of the (k-1)-th derivative of b between its neighbours."""
    k = round(side.exponent)
    if abs(k - side.exponent) > SAME_EXPONENT or k < 2 or k > 9:
        return bordered.y
    reach = min(0.2, max(64 * side.amplitude, 0.05))
    s = reach * _nodes()
    b, _ = reduced(bordered, s[:, None])
    if not np.all(np.isfinite(b)):
        return bordered.y
    derivative = np.polynomial.Chebyshev.fit(s, b[:, 0], min(k + 10, 24), domain=(-reach, reach)).deriv(k - 1)
    roots = derivative.roots()
    roots = roots[(np.abs(roots.imag) <= 1e-9 * reach) & (np.abs(roots.real) <= 4 * side.amplitude)].real
    if not roots.size:
        return bordered.y
    _, y = reduced(bordered, np.full((1, 1), roots[np.argmin(np.abs(roots))]))
    y, n = y[0], bordered.steady.n
    # A root at zero has no size that could say what is round-off there; the search has one.
    if np.max(np.abs(y / bordered.columns)[:n]) < np.sqrt(np.finfo(bordered.steady.t.dtype).eps):
        y = np.where(np.arange(y.size) < n, 0.0, y)
    return y if np.all(np.isfinite(y)) else bordered.y


def _nodes():
    """Chebyshev's nodes between -1 and 1."""
    return np.cos(np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES)


def nearest(steady: Steady, x, size: float, unseen: np.ndarray) -> np.ndarray | None:
    """The multiple root of a system at rest to which a search at `x` (n,) creeps along a curved valley, or None."""
    dtype = np.dtype(steady.t.dtype)
    y = np.concatenate([x, np.zeros(steady.m)])
    r, jacobian = (np.asarray(z)[0] for z in values_at(steady, padded(y[None], dtype)))
    if not (np.all(np.isfinite(r)) and np.all(np.isfinite(jacobian))):
        return None
    # Multipliers enter linearly.
    y[steady.n :] = -np.linalg.lstsq(jacobian[:, steady.n :], r, rcond=None)[0]
    bordered = bordered_at(steady, y, size, np.flatnonzero(unseen), CREEPS_BELOW)
    if bordered.right.shape[1] != 1 or bordered.left.shape[1] != 1:
        return None
    y = _multiple_root(bordered)
    if y is None:
        return None
    bordered = bordered_at(steady, y, size, np.flatnonzero(unseen))
    if bordered.right.shape[1] != 1 or bordered.left.shape[1] != 1:
        return None
    amplitudes, b = reduced_force(bordered, size)
    term = first_term(amplitudes, b[SAMPLES // 2 :])
    return None if term is None else between(bordered, term)[: steady.n]


def _multiple_root(bordered: Bordered) -> np.ndarray | None:
    """The unknowns at the root of the reduced force nearest to amplitude zero; None beyond a tenth of the size.

    At a k-fold root, b/b' = (s - s₀)/k + ... has a simple one, which is read off where b is larger than round-off.
    """
    s = 0.1 * _nodes()
    b = reduced(bordered, s[:, None])[0][:, 0]
    if not np.all(np.isfinite(b)):
        return None
    slope = np.polynomial.Chebyshev.fit(s, b, 16, domain=(-0.1, 0.1)).deriv()(s)
    seen = (np.abs(b) > 1e-8 * np.max(np.abs(b))) & (slope != 0)
    if np.sum(seen) < SAMPLES // 4:
        return None
    roots = np.polynomial.Chebyshev.fit(s[seen], b[seen] / slope[seen], 7, domain=(-0.1, 0.1)).roots()
    roots = roots[(np.abs(roots.imag) <= 1e-3) & (np.abs(roots.real) <= 0.1)].real
    if not roots.size:
        return None
    _, near = reduced(bordered, np.full((1, 1), roots[np.argmin(np.abs(roots))]))
    return near[0] if np.all(np.isfinite(near)) else None
