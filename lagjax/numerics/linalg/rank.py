"""Which rows of a matrix are independent, decided by a program that XLA can compile and batch.

`independent_rows` is Gram-Schmidt with row pivoting: each round takes the row that is farthest from the span of those
taken before and removes its direction from the rest. The relative length of the remainder of a row is the sine of its
angle to that span; rows whose sine is at most `DEPENDENT_BELOW` depend on the others. Working on the rows instead of
their Gram matrix distinguishes small sines from round-off.

Source: Golub & Van Loan, *Matrix Computations*, §5.4.2 (pivoting) and §5.2.8 (modified Gram-Schmidt).
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

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
