"""Linear combinations of columns that vanish: a sparse basis of the null space of a matrix with round-off.

Singular values below a tolerance count as zero, and the gap to the next one shows how reliable that is. A null space
has no preferred basis; the one with the most zeros is the most readable, and elimination finds it: each vector gets an
entry that is zero in all others, starting with the first entries. Small entries are not used as pivots, so that
round-off is not magnified. Each vector is then computed again from the columns of its nonzero entries alone.

Source: Golub & Van Loan, *Matrix Computations*, §5.5.8 (numerical rank), §3.4 (elimination).
"""

from typing import NamedTuple

import numpy as np

from lagjax.analysis.precision import Precision

PIVOT_ABOVE = 1e-2


class NullSpace(NamedTuple):
    """Reduced vectors (d, K); all singular values (K,), falling; the smallest nonzero one over the largest zero one."""

    vectors: np.ndarray
    singular_values: np.ndarray
    gap: float


def null_space(columns: np.ndarray, precision: Precision) -> NullSpace:
    """The combinations of columns (N, K) that vanish; singular values are relative to the square root of N."""
    count, columns = columns.shape[1], np.asarray(columns, float)
    if count == 0:
        return NullSpace(np.zeros((0, 0)), np.zeros(0), np.inf)
    if len(columns) > count:
        columns = np.asarray(np.linalg.qr(columns, mode="r"))
    _, nonzero, directions = np.linalg.svd(columns)
    sizes = np.zeros(count)
    sizes[: len(nonzero)] = nonzero
    rank = int(np.sum(sizes > precision.null))
    least = max(float(sizes[rank]) if rank < count else 0.0, precision.exact / 1e3)
    gap = float(sizes[rank - 1]) / least if rank else np.inf
    vectors = reduced(directions[rank:], precision)
    return NullSpace(
        np.stack([_from_support(columns, v, precision.null) for v in vectors]) if len(vectors) else vectors, sizes, gap
    )


def reduced(vectors: np.ndarray, precision: Precision) -> np.ndarray:
    """A basis of the same space with as many zeros as elimination finds, with pivots from the first entries on."""
    rows, free = vectors.copy(), list(range(len(vectors)))
    pivots = []
    for least in (PIVOT_ABOVE, precision.zero):
        for k in range(rows.shape[1]):
            if not free or k in pivots:
                continue
            chosen = max(free, key=lambda i: abs(rows[i, k]))
            if abs(rows[chosen, k]) <= least:
                continue
            rows[chosen] /= rows[chosen, k]
            others = np.arange(len(rows)) != chosen
            rows[others] -= np.outer(rows[others, k], rows[chosen])
            pivots.append(k)
            free.remove(chosen)
            # Rescaled so that entries are compared with one.
            for i in free:
                rows[i] /= max(np.max(np.abs(rows[i])), np.finfo(rows.dtype).tiny)
    rows = np.stack([_cleaned(row, precision.zero) for row in rows]) if len(rows) else rows
    order = sorted(range(len(rows)), key=lambda i: tuple(np.flatnonzero(rows[i])[:1]))
    return rows[order]


def beyond(vectors: np.ndarray, known: np.ndarray, precision: Precision) -> np.ndarray:
    """A reduced basis of the part of a space (d, K) that is not in another one (k, K)."""
    if len(known) == 0 or len(vectors) == 0:
        return reduced(vectors, precision)
    first = np.linalg.qr(known.T)[0]
    rest = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    rest = rest - (rest @ first) @ first.T
    _, sizes, directions = np.linalg.svd(rest)
    directions = directions[: int(np.sum(sizes > 100 * precision.zero))]
    # Elimination removes the pivot entries of the known vectors.
    together = reduced(np.concatenate([known, directions]), precision)
    leading = {int(np.flatnonzero(v)[0]) for v in reduced(known, precision)}
    return np.stack([v for v in together if int(np.flatnonzero(v)[0]) not in leading]) if len(directions) else rest[:0]


def independent(columns: np.ndarray, precision: Precision) -> np.ndarray:
    """Which columns (N, K) are linearly independent of those before them, (K,) booleans."""
    kept, basis = np.zeros(columns.shape[1], bool), np.zeros((len(columns), 0))
    for k, column in enumerate(columns.T):
        size = np.linalg.norm(column)
        rest = column / size if size > 0 else column
        for _ in range(2):
            rest = rest - basis @ (basis.T @ rest)
        length = np.linalg.norm(rest)
        if length > precision.zero:
            kept[k] = True
            basis = np.concatenate([basis, (rest / length)[:, None]], axis=1)
    return kept


def _from_support(columns, vector, tolerance):
    """The vector computed again from the columns of its nonzero entries, if their null space has one dimension."""
    support = np.flatnonzero(vector)
    if len(support) == 1:
        return vector
    _, sizes, directions = np.linalg.svd(columns[:, support])
    if len(sizes) < len(support) or (len(sizes) > 1 and sizes[-2] <= tolerance):
        return vector
    result = np.zeros_like(vector)
    result[support] = directions[-1] / directions[-1][0] * vector[support[0]]
    return result


def _cleaned(row, zero_below):
    return np.where(np.abs(row) > zero_below * np.max(np.abs(row)), row, 0.0)
