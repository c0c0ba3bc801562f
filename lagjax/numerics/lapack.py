"""Decompositions by LAPACK, and the roots of `A x = λ E x` with vectors, error bounds and derivatives.

On a CPU a batch of LAPACK calls can stop a process for good (`jaxtools/primitives.py`), and every program
of ours is a loop over the matrices of a batch. Here the loop is around all of a decomposition's steps, on each
platform.

The roots of `A x = λ E x` with vectors, error bounds and derivatives; double, defective and zero roots are told.

They are those of `K x = s M x`, K and M symmetric, or of `A x = λ E x`. LAPACK's roots and vectors of A have errors of
the round-off of the largest root. With left vectors z and right vectors x the error of the quotient

    λ = z A x / z E x

is the product of the errors of z and x, which makes small roots accurate. The same quotient gives the derivatives: with
`c_ij = z_i (A - λ_j E) x_j / (λ_j - λ_i)` the vectors X + X c and (1 - c) Z follow a change of the matrices to first
order, and hence the quotient to third.

For double roots c is undefined and left out; each of them then gets the derivative of their mean. A root with too few
vectors (a defective root) gets no derivative. `Roots` reports both cases.

Source: Golub & Van Loan, *Matrix Computations*, §7.2.2 (condition of a root), §8.7 (symmetric-definite problems);
Magnus, Econometric Theory 1 (1985) 179 (derivatives).
"""

from collections.abc import Callable, Sequence
from functools import wraps
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Inexact


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


# Two roots are one double root if they differ by less than this fraction of the largest root.
DOUBLE_BELOW = {np.dtype("float64"): 1e-8, np.dtype("float32"): 1e-4}
# A root with a condition above this is defective: it has too few vectors.
DEFECTIVE_ABOVE = {np.dtype("float64"): 1e6, np.dtype("float32"): 1e3}

# A double root of zero is computed only to the square root of round-off.
NEARLY_ZERO = 1e-3


class Roots(NamedTuple):
    """Roots (k,) with right vectors as columns (n, k).

    - `round_off`: the error bound of each. `double`: another root is the same, or the root is `defective`: it also
      shares its vector.
    """

    values: Inexact[Array, " k"]
    vectors: Inexact[Array, "n k"]
    round_off: Float[Array, " k"]
    double: Bool[Array, " k"]
    defective: Bool[Array, " k"]


def symmetric_roots(stiffness, mass) -> Roots:
    """All s of `K x = s M x`, ascending, of symmetric K and positive definite M; NaN where M is not."""
    values, vectors = symmetric_definite(stiffness, mass)
    largest = jnp.max(jnp.abs(values), initial=0.0)
    return _followed(values, vectors, vectors.T, stiffness, mass, largest, jnp.ones_like(values))


def general_roots(matrix, inertia) -> Roots:
    """All λ of `A x = λ E x`, of a regular E."""
    values, vectors, left = eigen(matrix, inertia)

    def norm(x: Array, axis: int):
        return jnp.sqrt(jnp.sum(jnp.abs(x) ** 2, axis=axis))

    condition = norm(vectors, 0) * norm(left, 1)
    return _followed(values, vectors, left, matrix, inertia, jnp.max(jnp.abs(values), initial=0.0), condition)


def roots_beside_zeros(matrix, inertia, derivatives=True) -> tuple[Roots, Bool[Array, " k"]]:
    """All λ of `A x = λ E x` for an A with a null space; and which roots are zero."""
    eps = jnp.finfo(matrix.dtype).eps
    values, beside, vectors, left, condition, null = eigen_without_null_space(matrix, inertia, eps)
    largest = jnp.max(jnp.abs(values), initial=0.0)
    roots = _followed(values, vectors, left, matrix, inertia, largest, condition, beside, null, derivatives)
    return roots, null | (jnp.abs(roots.values) <= roots.round_off)


def _followed(
    values, vectors, left, matrix, inertia, largest, condition, beside=None, null=None, derivatives=True
) -> Roots:
    """The roots as quotients, differentiable by the matrices; `left` (k, n) with `left @ inertia @ vectors` = 1."""
    real = jnp.zeros(0, values.dtype).real.dtype
    condition = jnp.where(jnp.isfinite(condition), condition, jnp.inf)
    vectors, left = (jnp.where(jnp.isfinite(x), x, 0.0) for x in (vectors, left))
    apart = jnp.abs(values[:, None] - values[None, :])
    alike = apart <= DOUBLE_BELOW[np.dtype(real)] * largest
    if null is not None:
        alike = alike & (null[:, None] == null[None, :])
    defective = condition > DEFECTIVE_ABOVE[np.dtype(real)]
    double = (jnp.sum(alike, axis=1) > 1) | defective
    follows = ~alike & ~defective[None, :] & ~defective[:, None]
    if null is not None:
        # The shift along the null space that a mode contains grows like 1/λ, so null vectors take no part in c.
        follows = follows & ~null[:, None] & ~null[None, :]
    start, new_vectors = values, vectors
    # Two passes: the first makes small roots accurate, the second adds only the derivatives. With an exact left vector
    # any right vector gives the root, so the first pass uses one without shifts, which grow like 1/λ.
    for live in (False, True) if derivatives else (False,):
        A, E = (matrix, inertia) if live else lax.stop_gradient((matrix, inertia))
        left_of = left @ (A @ vectors - (E @ vectors) * start[None, :])
        change = jnp.where(follows, left_of / jnp.where(follows, start[None, :] - start[:, None], 1.0), 0.0)
        if live:
            new_vectors, new_left = vectors + vectors @ change, left - change @ left
        else:
            new_vectors, new_left = vectors if beside is None else beside, left
        over = new_left.T * (A @ new_vectors - (E @ new_vectors) * start[None, :])
        under = jnp.sum(new_left.T * (E @ new_vectors), axis=0)
        correction = jnp.sum(over, axis=0) / jnp.where(under != 0, under, 1.0)
        correction = jnp.where(defective if null is None else defective | null, 0.0, correction)
        if jnp.iscomplexobj(values):
            # A real root stays real, because complex ones come in pairs.
            correction = jnp.where(values.imag == 0, correction.real, correction)
        shared = jnp.where(alike & double[:, None], 1.0, jnp.eye(values.size, dtype=real))
        shared = jnp.where(defective[None, :] & ~jnp.eye(values.size, dtype=bool), 0.0, shared)
        correction = (shared / jnp.sum(shared, axis=1, keepdims=True)) @ correction
        still = lax.stop_gradient(correction)
        start = start + correction - still if live else start + still
    round_off = 1e2 * jnp.finfo(real).eps * largest * jnp.where(defective, jnp.minimum(condition, 1e9), condition)
    return Roots(start, new_vectors, round_off, double, defective)


def zero_count(matrix, inertia, values):
    """The multiplicity of the root zero of `A x = λ E x`: null vectors n of A, and solutions of A x = E n."""
    least = jnp.min(jnp.abs(values)) if values.size else jnp.ones(())
    return _zero_count(matrix, inertia, least <= NEARLY_ZERO * jnp.max(jnp.abs(values), initial=0.0))


@one_by_one
def _zero_count(A, E, possible):
    def counted():
        left, sizes, right = jnp.linalg.svd(A)
        # The bound is the round-off of the largest singular value, or of the terms that cancel.
        eps = jnp.finfo(A.dtype).eps
        terms = 1e2 * jnp.sum(jnp.abs(left) * (jnp.abs(A) @ jnp.abs(right.T)), axis=0)
        null = sizes <= eps * jnp.minimum(1e3 * sizes[0], jnp.maximum(terms, 4 * A.shape[0] * sizes[0]))
        # A x = E n has a solution if E n lies in the range of A.
        between = jnp.where(null[:, None] & null[None, :], left.T @ E @ right.T, 0.0)
        reached = jnp.linalg.svd(between, compute_uv=False)
        return (2 * jnp.sum(null) - jnp.sum(reached > 1e-9 * jnp.max(jnp.abs(E)))).astype(jnp.int32)

    return lax.cond(possible, counted, lambda: jnp.zeros((), jnp.int32))
