"""Decompositions by LAPACK, for the matrices of a batch one after the other, without derivatives.

On a CPU a batch of LAPACK calls can stop a process for good (`jaxtools/without_lapack_batches.py`), and every program
of ours is a loop over the matrices of a batch. Here the loop is around all of a decomposition's steps, on each
platform.
"""

from collections.abc import Callable, Sequence
from functools import wraps

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array


def one_by_one(function: Callable) -> Callable:
    """Make `vmap` of a function of arrays call it in a loop; its arguments are not differentiated."""
    looped = custom_vmap(function)

    @looped.def_vmap
    def _(size: int, batched: Sequence[bool], *args):
        def at(i: Array):
            one_matrix = [jnp.asarray(x)[i] if is_batched else x for x, is_batched in zip(args, batched)]
            return looped(*one_matrix)

        found = lax.map(at, jnp.arange(size))
        return found, jax.tree.map(lambda _: True, found)

    @wraps(function)
    def without_derivatives(*args):
        return looped(*map(lax.stop_gradient, args))

    return without_derivatives


@one_by_one
def singular_values(matrix: Array):
    """All singular values, descending."""
    return jnp.linalg.svd(matrix, compute_uv=False)


@one_by_one
def complement(columns: Array):
    """Orthonormal columns (n, n - r) perpendicular to r independent columns (n, r)."""
    return jnp.linalg.qr(columns, mode="complete")[0][:, columns.shape[1] :]


@one_by_one
def symmetric_definite(stiffness: Array, mass: Array):
    """s and X of `K x = s M x` with `Xᵀ M X` = 1; NaN where M is not positive definite."""
    lower = jnp.linalg.cholesky(mass)
    inner = lax.linalg.triangular_solve(lower, stiffness, left_side=True, lower=True)
    inner = lax.linalg.triangular_solve(lower, inner.T, left_side=True, lower=True)
    values, vectors = jnp.linalg.eigh((inner + inner.T) / 2)
    return values, lax.linalg.triangular_solve(lower, vectors, left_side=True, lower=True, transpose_a=True)


@one_by_one
def eigen(matrix: Array, inertia: Array):
    """λ and X of `A x = λ E x`, and Z with `Z E X` = 1."""
    values, vectors = lax.linalg.eig(jnp.linalg.solve(inertia, matrix), compute_left_eigenvectors=False)
    return values, vectors, jnp.linalg.inv(inertia.astype(vectors.dtype) @ vectors)


@one_by_one
def eigen_without_null_space(matrix: Array, inertia: Array, zero_below: float):
    """Like `eigen`, but small roots near a zero root of A keep their digits; also says which roots are zeros of A.

    The null space N of A is projected out: P S P with S = E⁻¹ A and P = 1 - N Nᵀ has the roots and the left vectors of
    A. Its right vectors x are returned, followed by the right vectors of A, S x / λ.
    """
    standard = jnp.linalg.solve(inertia, matrix)
    left, sizes, right = jnp.linalg.svd(matrix)
    terms = 1e2 * jnp.sum(jnp.abs(left) * (jnp.abs(matrix) @ jnp.abs(right.T)), axis=0)
    null = sizes <= zero_below * jnp.minimum(1e3 * sizes[0], jnp.maximum(terms, 4 * sizes.size * sizes[0]))
    directions = jnp.where(null[:, None], right, 0.0)
    on_null = directions.T @ directions
    outside = jnp.eye(sizes.size, dtype=matrix.dtype) - on_null
    # The zeros of N are moved beyond all other roots, so that they do not mix with them.
    far = 3 * jnp.sqrt(jnp.sum(standard**2))
    values, vectors = lax.linalg.eig(outside @ standard @ outside + far * on_null, compute_left_eigenvectors=False)
    rows = jnp.linalg.inv(vectors)
    is_null = jnp.argsort(jnp.argsort(-jnp.abs(values))) < jnp.sum(null)
    # For a remaining zero root S x lies in N; its vector is x itself, the part outside N.
    zero = is_null | (values == 0)
    right_x = jnp.where(zero[None, :], vectors, standard @ vectors / jnp.where(zero, 1.0, values)[None, :])
    inverse = jnp.linalg.inv(inertia).astype(vectors.dtype)
    lefts = jnp.where(is_null[:, None], 0.0, rows @ inverse)

    def norm(x: Array, axis: int) -> Array:
        return jnp.sqrt(jnp.sum(jnp.abs(x) ** 2, axis=axis))

    return jnp.where(is_null, 0.0, values), vectors, right_x, lefts, norm(vectors, 0) * norm(rows @ inverse, 1), is_null


@one_by_one
def solve(matrix: Array, rhs: Array):
    """`matrix⁻¹ rhs`."""
    return jnp.linalg.solve(matrix, rhs)


@one_by_one
def decomposed(matrix: Array):
    """The reduced singular value decomposition U, σ, Vᵀ of any matrix."""
    return jnp.linalg.svd(matrix, full_matrices=False)
