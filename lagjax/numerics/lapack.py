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
def solve(matrix, rhs):
    """`matrix⁻¹ rhs`."""
    return jnp.linalg.solve(matrix, rhs)


@one_by_one
def decomposed(matrix):
    """U, σ and Vᵀ of any matrix, without what belongs to no singular value."""
    return jnp.linalg.svd(matrix, full_matrices=False)


@one_by_one
def characteristic(matrix):
    """All eigenvalues, complex."""
    return jnp.linalg.eigvals(matrix)
