"""Decompositions by LAPACK, of the matrices of a batch one after the other, without derivatives.

XLA on a CPU gives parts of a batch of LAPACK's calls to the threads of its pool, and waits for them in one of these.
Where a program has several such calls, or several programs run beside each other, all threads may wait, for ever (seen
with jaxlib 0.10 for 100,000 solves and singular values in one program). A loop over the batch calls them for one matrix
at a time, in the thread that it runs in, and of small matrices costs no more.
"""

from collections.abc import Callable
from functools import wraps

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap


def one_by_one(function: Callable) -> Callable:
    """A function of arrays that, batched, is called in a loop; its arguments are not differentiated."""
    looped = custom_vmap(function)

    @looped.def_vmap
    def _(size, batched, *args):
        def at(i):
            given = jax.tree.map(lambda x, many: x[i] if many else x, args, tuple(batched))
            return looped(*given)

        found = lax.map(at, jnp.arange(size))
        return found, jax.tree.map(lambda _: True, found)

    @wraps(function)
    def called(*args):
        return looped(*map(lax.stop_gradient, args))

    return called


@one_by_one
def singular_values(matrix):
    """All of them, descending."""
    return jnp.linalg.svd(matrix, compute_uv=False)


@one_by_one
def complement(columns):
    """Orthonormal columns (n, n - r) that are perpendicular to so many independent ones (n, r)."""
    return jnp.linalg.qr(columns, mode="complete")[0][:, columns.shape[1] :]


@one_by_one
def symmetric_definite(stiffness, mass):
    """s and X of `K x = s M x` with `Xᵀ M X` = 1; NaN where M is not positive definite."""
    lower = jnp.linalg.cholesky(mass)
    inner = lax.linalg.triangular_solve(lower, stiffness, left_side=True, lower=True)
    inner = lax.linalg.triangular_solve(lower, inner.T, left_side=True, lower=True)
    values, vectors = jnp.linalg.eigh((inner + inner.T) / 2)
    return values, lax.linalg.triangular_solve(lower, vectors, left_side=True, lower=True, transpose_a=True)


@one_by_one
def eigen(matrix, inertia):
    """λ and X of `A x = λ E x`, and Z with `Z E X` = 1."""
    values, vectors = lax.linalg.eig(jnp.linalg.solve(inertia, matrix), compute_left_eigenvectors=False)
    return values, vectors, jnp.linalg.inv(inertia.astype(vectors.dtype) @ vectors)


@one_by_one
def eigen_without_null_space(matrix, inertia, zero_below):
    """The same, for one that keeps its digits where a small root comes near a zero of A; and which zeros are of A.

    What A takes to zero, N, is projected out: of P S P with S = E⁻¹ A and P = 1 - N Nᵀ the roots are those of A, the
    left vectors too, and the right ones, which are returned after those of it, S x / λ.
    """
    standard = jnp.linalg.solve(inertia, matrix)
    left, sizes, right = jnp.linalg.svd(matrix)
    terms = 1e2 * jnp.sum(jnp.abs(left) * (jnp.abs(matrix) @ jnp.abs(right.T)), axis=0)
    null = sizes <= zero_below * jnp.minimum(1e3 * sizes[0], jnp.maximum(terms, 4 * sizes.size * sizes[0]))
    directions = jnp.where(null[:, None], right, 0.0)
    onto = directions.T @ directions
    beside = jnp.eye(sizes.size, dtype=matrix.dtype) - onto
    # Its zeros are moved beyond all roots, where they mix with none.
    far = 3 * jnp.sqrt(jnp.sum(standard**2))
    values, vectors = lax.linalg.eig(beside @ standard @ beside + far * onto, compute_left_eigenvectors=False)
    rows = jnp.linalg.inv(vectors)
    is_null = jnp.argsort(jnp.argsort(-jnp.abs(values))) < jnp.sum(null)
    # A zero that is left has its shift among N: what of it is no shift is its vector.
    still = is_null | (values == 0)
    whole = jnp.where(still[None, :], vectors, standard @ vectors / jnp.where(still, 1.0, values)[None, :])
    back = jnp.linalg.inv(inertia).astype(vectors.dtype)
    lefts = jnp.where(is_null[:, None], 0.0, rows @ back)
    norm = lambda x, axis: jnp.sqrt(jnp.sum(jnp.abs(x) ** 2, axis=axis))
    return jnp.where(is_null, 0.0, values), vectors, whole, lefts, norm(vectors, 0) * norm(rows @ back, 1), is_null


@one_by_one
def solve(matrix, rhs):
    """`matrix⁻¹ rhs`."""
    return jnp.linalg.solve(matrix, rhs)


@one_by_one
def decomposed(matrix):
    """U, σ and Vᵀ of any matrix, without what belongs to no singular value."""
    return jnp.linalg.svd(matrix, full_matrices=False)
