"""Small dense linear solves that XLA can fuse, larger ones by LAPACK; and which rows of a matrix are independent.

`solve(matrix, rhs)` inverts by Gauss-Jordan elimination with scaled partial pivoting, or takes LAPACK's factors of a
larger matrix, and follows with one step of iterative refinement in the same precision. Refinement is what makes the
answer accurate *component by component*: after it the computed x solves `(K + dK) x = b + db` with `|dK| <= c eps |K|`
and `|db| <= c eps |b|` entrywise (Skeel, Math. Comp. 35 (1980) 817), so an acceleration of 1e-17 next to one of 10
keeps its digits if the entries of K and b carry them.

The elimination acts on whole rows, one column at a time, in a loop. Unrolled it ran a fifth faster, but made up half of
the code to compile in a constrained system, where it is only the fallback of the fast solve (`Saddle`). It is faster
than LAPACK, whose call costs 1-1.6 microseconds, up to n = 6.

Differentiation never passes through the pivoting: `dx = K^-1 (db - dK x)`, transposed by JAX.

`independent_rows` is Gram-Schmidt with row pivoting: each round takes the row that is farthest from the span of those
taken before and removes its direction from the rest. The relative length of the remainder of a row is the sine of its
angle to that span; rows whose sine is at most `DEPENDENT_BELOW` depend on the others. Working on the rows instead of
their Gram matrix distinguishes small sines from round-off.

Source: Golub & Van Loan, *Matrix Computations*, §5.4.2 (pivoting) and §5.2.8 (modified Gram-Schmidt).
"""

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.jaxtools import one_by_one, primitive

ELIMINATE_UP_TO = 6
# The largest matrix inverted inside a program without LAPACK; larger ones are better off with it.
ELIMINATE_INSIDE_UP_TO = 16
# Rows count as independent if the squared sine of their angle to the span of those before exceeds this.
INDEPENDENT_ABOVE = 1e-10
# Below this reciprocal condition, after scaling, a matrix counts as singular.
SINGULAR_BELOW = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}


def solve(matrix: Float[Array, "n n"], rhs: Float[Array, " n"]) -> Float[Array, " n"]:
    """Solve `matrix @ x = rhs`; a singular matrix gives NaN or infinity, never a plausible number.

    >>> import jax.numpy as jnp
    >>> print(solve(jnp.array([[2.0, 1.0], [1.0, 3.0]]), jnp.array([3.0, 4.0])))
    [1. 1.]

    **Arguments:** `matrix` (n, n) and `rhs` (n,), of the same floating dtype.

    **Returns:** x, shape (n,), `[rhs]/[matrix]`.
    """
    if rhs.shape[0] <= ELIMINATE_INSIDE_UP_TO:
        return _by_inverse(matrix, rhs)
    # Of 60 equations the inverse, by as many right-hand sides, takes ten times as long. XLA factors the matrix once.
    x = jnp.linalg.solve(matrix, rhs)
    return x + jnp.linalg.solve(matrix, rhs - matrix @ x)


@jax.custom_jvp
def _by_inverse(matrix: Array, rhs: Array):
    return _solution(matrix, rhs)[0]


def _solution(matrix: Array, rhs: Array):
    """x, and the map from a right-hand side to its solution without refinement."""
    if rhs.shape[0] == 1:
        return rhs / matrix[0], lambda b: b / matrix[0]
    inverted = inverse(matrix)
    return refined(inverted, matrix, rhs), lambda b: inverted @ b


# x comes from the same code with and without a derivative: JAX's batching of custom rules under `jit` requires that
# both have their batch axis in the same position.
@_by_inverse.defjvp
def _by_inverse_jvp(primals: Sequence, tangents: Sequence):
    (matrix, rhs), (d_matrix, d_rhs) = primals, tangents
    x, solve_for = _solution(matrix, rhs)
    return x, solve_for(d_rhs - d_matrix @ x)


def refined(inverted: Array, matrix: Array, rhs: Array):
    """`matrix^-1 @ rhs` by an approximate inverse and one step of iterative refinement."""
    x = inverted @ rhs
    return x + inverted @ (rhs - matrix @ x)


def solved(matrix: Float[Array, "n n"], rhs: Array) -> Array:
    """`matrix^-1 @ rhs` for one or several right-hand sides, by the inverse, refined once; derivatives of any order.

    With many lanes, XLA's own batches of LAPACK's solve can deadlock.
    """
    return refined(inverse(matrix), matrix, rhs)


def inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Invert a matrix: small ones by elimination that XLA fuses, larger ones by LAPACK."""
    n = matrix.shape[0]
    if n < 2:
        return 1 / matrix
    if n > ELIMINATE_INSIDE_UP_TO:
        return jnp.linalg.inv(matrix)
    return _inverse_p.bind(matrix, eliminate=n <= ELIMINATE_UP_TO)


def _eliminated(matrix: Array):
    n = matrix.shape[0]
    scale = (1 / jnp.max(jnp.abs(matrix), axis=1)).astype(matrix.dtype)
    work = jnp.concatenate([matrix * scale[:, None], jnp.diag(scale)], axis=1)
    row = np.arange(n)

    def eliminate(k: Array, work: Array):
        candidates = jnp.where(row >= k, jnp.abs(work[:, k]), -1.0)
        pivot = jnp.argmax(candidates)
        top, best = work[k], work[pivot]
        best = (best / best[k])[None]
        work = jnp.where((row == pivot)[:, None], top[None], work)
        factor = jnp.where(row == k, 0.0, work[:, k])
        return jnp.where((row == k)[:, None], best, work - factor[:, None] * best)

    return lax.fori_loop(0, n, eliminate, work)[:, n:]


def _inverse(matrix: Array, eliminate: bool):
    return _eliminated(matrix) if eliminate else jnp.linalg.inv(matrix)


def _inverse_jvp(primals: Sequence, tangents: Sequence, **params):
    inverted = _inverse_p.bind(*primals, **params)
    return inverted, -inverted @ tangents[0] @ inverted


def _inverse_batched(operands: Sequence, axes: Sequence, **params):
    return one_by_one(jax.vmap(partial(_inverse, **params)))(jnp.moveaxis(operands[0], axes[0], 0)), 0


# A primitive, so that a program compiled as one function can use it without calling LAPACK.
_inverse_p = primitive(
    "inverse",
    lambda matrix, eliminate: jax.jit(_inverse, static_argnums=1)(matrix, eliminate),
    lambda matrix, eliminate: matrix,
    compiled=_inverse,
    jvp=_inverse_jvp,
    batched=_inverse_batched,
)


def reciprocal_condition(matrix: Float[Array, "n n"]) -> Float[Array, ""]:
    """`1/(|K| |K^-1|)` in the maximum norm, of a symmetric matrix after symmetric scaling; 0 if singular.

    The scaling brings every row's largest entry near one (Ruiz), so that units do not count as ill-conditioning.
    """

    if matrix.shape[0] == 1:
        return jnp.where(jnp.isfinite(matrix[0, 0]) & (matrix[0, 0] != 0), 1.0, 0.0)

    def rescaled(_, matrix: Array):
        largest = jnp.max(jnp.abs(matrix), axis=1)
        scale = 1 / jnp.sqrt(jnp.where(largest > 0, largest, 1.0))
        return scale[:, None] * matrix * scale[None, :]

    scaled = lax.fori_loop(0, 20, rescaled, matrix)
    product = jnp.max(jnp.abs(scaled)) * jnp.max(jnp.abs(inverse(scaled)))
    return jnp.where(jnp.isfinite(product), 1 / product, 0.0)


def solve_without_exchanges(rows: list[list[Array]], known: list[Array]) -> tuple[list[Array], list[Array]]:
    """Solve a small linear system of single numbers, without exchanging rows; and its pivots.

    >>> x, pivots = solve_without_exchanges([[2.0, 1.0], [1.0, 3.0]], [3.0, 4.0])
    >>> print(*(float(y) for y in x), *(float(y) for y in pivots))
    1.0 1.0 2.0 2.5

    A pivot of zero counts as one: the caller judges the pivots.
    """
    rows, known, count = [list(row) for row in rows], list(known), len(known)
    for k in range(count):
        pivot = jnp.where(rows[k][k] != 0, rows[k][k], 1.0)
        for i in range(k + 1, count):
            factor = rows[i][k] / pivot
            known[i] = known[i] - factor * known[k]
            rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k])]
    pivots = [jnp.asarray(rows[k][k]) for k in range(count)]
    for k in reversed(range(count)):
        rest = sum(rows[k][j] * known[j] for j in range(k + 1, count))
        known[k] = (known[k] - rest) / jnp.where(pivots[k] != 0, pivots[k], 1.0)
    return known, pivots


class Saddle:
    """`[[M, Aᵀ], [A, 0]]` eliminated without pivoting, one number at a time.

    For programs of single numbers (`scalarize.py`), in which the zeros of M and A cost nothing. `valid` says whether
    the solution is as accurate as with pivoting: M is definite (or every pivot the largest of its column), and no row
    of A depends on those before it. For a `diagonal` M without A the pivots are divided by unchecked: a singular one
    gives NaN or infinity. Equations that are `off`, whose rows of A are zero, have the multiplier zero.

    Source: Golub & Van Loan, *Matrix Computations*, §4.1.2.
    """

    def __init__(
        self,
        mass: Float[Array, "n n"],
        jacobian: Float[Array, "m n"],
        diagonal: bool = False,
        off: Bool[Array, " m"] | None = None,
    ):
        self.n, self.m = n, m = mass.shape[0], jacobian.shape[0]
        zero = jnp.zeros_like(mass[0, 0])

        def entry(i: int, j: int) -> Array:
            if i < n or j < n:
                return mass[i, j] if i < n else jacobian[i - n, j]
            return zero if off is None or i != j else jnp.where(off[i - n], -1.0, zero)

        self.matrix = matrix = [[entry(max(i, j), min(i, j)) for j in range(n + m)] for i in range(n + m)]
        work = [row[: i + 1] for i, row in enumerate(matrix)]
        self.lower, self.pivots = [[] for _ in work], []
        schur = []
        positive = negative = largest = independent = nonzero = True
        for k in range(n + m):
            if k == n:
                schur = [work[i][i] for i in range(n, n + m)]
            pivot = work[k][k]
            # Invalid results are computed too, and must not put NaN into the derivatives of the results used instead.
            nonzero = nonzero & (pivot != 0)
            pivot = pivot if diagonal else jnp.where(pivot != 0, pivot, 1.0)
            self.pivots.append(pivot)
            column = [work[i][k] for i in range(k + 1, n + m)]
            if k < n:
                positive, negative = positive & (pivot > 0), negative & (pivot < 0)
                for x in column[: n - k - 1]:
                    largest = largest & (jnp.abs(pivot) >= jnp.abs(x))
            else:
                positive, negative = positive & (pivot < 0), negative & (pivot > 0)
                independent = independent & (jnp.abs(pivot) > INDEPENDENT_ABOVE * jnp.abs(schur[k - n]))
            for i in range(k + 1, n + m):
                factor = column[i - k - 1] / pivot
                self.lower[i].append(factor)
                for j in range(k + 1, i + 1):
                    work[i][j] = work[i][j] - factor * column[j - k - 1]
        definite = positive | negative
        self.valid = diagonal or nonzero & ((definite & independent) if m else (definite | largest))

    def solve(self, forcing: Float[Array, " n"], gamma: Float[Array, " m"], refine: bool = True):
        """Solve `M a - Aᵀ λ = F`, `A a = gamma` for a and λ; with constraints, refined once."""
        known = [forcing[i] for i in range(self.n)] + [gamma[i] for i in range(self.m)]
        x = self._substituted(known)
        if self.m and refine:
            residual = [b - sum(k * y for k, y in zip(row, x)) for b, row in zip(known, self.matrix)]
            x = [a + b for a, b in zip(x, self._substituted(residual))]

        def stack(entries: list) -> Array:
            return jnp.stack(entries) if entries else jnp.zeros(0, forcing.dtype)

        return stack(x[: self.n]), stack([-y for y in x[self.n :]])

    def _substituted(self, known: list[Array]):
        y = list(known)
        for i, row in enumerate(self.lower):
            for j, factor in enumerate(row):
                y[i] = y[i] - factor * y[j]
        x = [b / pivot for b, pivot in zip(y, self.pivots)]
        for i in reversed(range(len(x))):
            for j in range(i):
                x[j] = x[j] - self.lower[i][j] * x[i]
        return x


# In a state that satisfies its constraints to round-off, dependent rows agree to round-off times the condition of the
# mechanism; in a state typed with seven digits they differ by 1e-7.
DEPENDENT_BELOW = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-3}
# In a loop a round is as fast: six rounds compile in 0.2 s of processor time, and written out in 0.6.
UNROLL_UP_TO = 2


def independent_rows(rows: Float[Array, "m n"], dependent_below: float | None = None) -> Bool[Array, " m"]:
    """Choose a largest set of independent rows, as well conditioned as pivoting finds.

    >>> import jax
    >>> import numpy as np
    >>> print(jax.jit(independent_rows)(np.array([[1.0, 0.0], [2.0, 0.0], [1.0, 1.0]])))
    [ True False  True]

    Rows that are zero or not finite are kept: solving with them is then singular or not finite, which is detected.

    **Arguments:** `rows` (m, n), a floating dtype; `dependent_below`, the largest sine of a dependent row, by default
    `DEPENDENT_BELOW` of the dtype. Scaling rows does not change the answer; columns are not scaled, since scaling up a
    column of pure round-off would make any rows independent.

    **Returns:** (m,) booleans. Not differentiable.
    """
    count, dtype = rows.shape[0], np.dtype(rows.dtype)
    if count < 2:
        return jnp.ones(count, bool)
    rest, size = unit_rows(lax.stop_gradient(rows))
    usable = jnp.isfinite(size) & (size > 0)
    rest = jnp.where(usable[:, None], rest, 0.0)
    least = (DEPENDENT_BELOW[dtype] if dependent_below is None else dependent_below) ** 2

    def take_farthest(_, state):
        rest, chosen = state
        distance = jnp.where(chosen, -1.0, jnp.sum(rest**2, axis=1))
        farthest = jnp.argmax(distance)
        found = distance[farthest] > least
        direction = rest[farthest] * jnp.where(found, 1 / jnp.sqrt(distance[farthest]), 0.0)
        rest = rest - (rest @ direction)[:, None] * direction[None, :]
        return rest, chosen | (found & (np.arange(count) == farthest))

    rounds, state = min(rows.shape), (rest, jnp.zeros(count, bool))
    if rounds <= UNROLL_UP_TO:
        for i in range(rounds):
            state = take_farthest(i, state)
    else:
        state = lax.fori_loop(0, rounds, take_farthest, state)
    return state[1] | ~usable


def unit_rows(rows: Float[Array, "m n"]) -> tuple[Float[Array, "m n"], Float[Array, " m"]]:
    """Rows scaled to length one (zero rows are unchanged), and their lengths."""
    # Scaled by the largest entry first, so that squares neither overflow nor underflow.
    largest = jnp.max(jnp.abs(rows), axis=1)
    shape = rows / jnp.where(largest > 0, largest, 1.0)[:, None]
    # The derivative of the root of zero, as of a row that does not hold now, would be NaN.
    square = jnp.sum(shape**2, axis=1)
    length = largest * jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return rows / jnp.where(length > 0, length, 1.0)[:, None], length


def null_space(rows: np.ndarray, smallest: float | None = None) -> np.ndarray:
    """An orthonormal basis (n, k) of the null space of the rows (m, n), outside of compiled programs.

    >>> print(abs(null_space(np.array([[1.0, 1.0, 0.0]]))).round(3).sum(axis=1))
    [0.707 0.707 1.   ]

    Singular values up to `smallest` times the largest count as zero, by default those of round-off size. (SciPy's
    function of the same name takes longer to import than all of lagjax.)
    """
    _, sizes, directions = np.linalg.svd(rows)
    least = max(rows.shape) * np.finfo(sizes.dtype).eps if smallest is None else smallest
    return directions[np.sum(sizes > least * np.max(sizes, initial=0.0)) :].T
