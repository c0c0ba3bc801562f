"""Least squares window by window, compared with solving the same equations at once."""

from functools import partial

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest

from lagjax.numerics.windowed_least_squares import (
    ByWindows,
    Unknowns,
    WindowedEquations,
    covariance,
    eliminate,
    slopes_of,
    solution,
)
from tests.tiers import exhaustive_but

M, J, K, P, H = 7, 3, 2, 4, 2


def chain(windows, seed):
    """Random equations of a chain, as a function of the unknowns, their right-hand side, and one matrix for both."""
    rng = np.random.default_rng(seed)
    rows, own, prior = (rng.normal(size=shape) for shape in ((windows, M, P), (windows, M, K), (H, P)))
    seams, begin, end = (rng.normal(size=(windows, J, n)) for n in (P, K, K))
    rhs = WindowedEquations(*(rng.normal(size=shape) for shape in ((windows, M), (windows, J), H)))
    for of_seams in (seams, begin, end, rhs.seams):
        # The last window has none.
        of_seams[-1] = 0.0

    def product(d):
        following = jnp.concatenate([d.local[1:], jnp.zeros_like(d.local[:1])])
        return WindowedEquations(
            rows @ d.shared + jnp.einsum("wij,wj->wi", own, d.local),
            seams @ d.shared + jnp.einsum("wij,wj->wi", begin, d.local) + jnp.einsum("wij,wj->wi", end, following),
            prior @ d.shared,
        )

    matrix = np.zeros((windows * (M + J) + H, P + windows * K))
    for w in range(windows):
        of_rows, of_seams = slice(w * M, (w + 1) * M), slice(windows * M + w * J, windows * M + (w + 1) * J)
        local = P + w * K
        matrix[of_rows, :P], matrix[of_rows, local : local + K] = rows[w], own[w]
        matrix[of_seams, :P], matrix[of_seams, local : local + K] = seams[w], begin[w]
        if w + 1 < windows:
            matrix[of_seams, local + K : local + 2 * K] = end[w]
    matrix[-H:, :P] = prior
    return product, rhs, Unknowns(np.zeros(P), np.zeros((windows, K))), matrix


def by_lapack(matrix, rhs):
    """The least-squares solution of all equations at once, as unknowns."""
    b = np.concatenate([np.ravel(x) for x in rhs])
    x = np.linalg.lstsq(matrix, np.append(b, np.zeros(len(matrix) - len(b))))[0]
    return Unknowns(x[:P], x[P:].reshape(-1, K))


@pytest.mark.parametrize("windows", exhaustive_but((2,), (1, 2, 5)))
def test_solutions_and_covariance(windows):
    """The chain's solution and covariance are those of the whole matrix; lineax's damps unknowns by their slopes."""
    product, rhs, u, matrix = chain(windows, seed=0)
    none, factor = jax.tree.map(np.zeros_like, u), 0.7
    damped = lambda d: (product(d), jax.tree.map(lambda x: factor * x, d))

    @jax.jit
    def found():
        slopes = slopes_of(product, u)
        factors, loose = (
            eliminate(x, rhs, none) for x in (slopes, slopes._replace(seams_by_next=jnp.zeros((windows, J, K))))
        )
        by_lineax = lx.linear_solve(
            lx.FunctionLinearOperator(damped, jax.eval_shape(lambda: u)), (rhs, none), ByWindows(tau=0.01)
        )
        both = [solution(factors), solution(loose), by_lineax.value]
        return both, covariance(factors, jnp.linalg.inv(factors.shared))

    (once, loose, by_lineax), of = found()
    expected = by_lapack(matrix, rhs)
    sizes = np.linalg.norm(matrix, axis=0)
    for x, exact in ((once, expected), (by_lineax, by_lapack(np.vstack([matrix, 0.1 * factor * np.diag(sizes)]), rhs))):
        jax.tree.map(partial(np.testing.assert_allclose, atol=1e-12), tuple(x), tuple(exact))
    whole = np.linalg.inv(matrix.T @ matrix)
    np.testing.assert_allclose(of.shared, whole[:P, :P], rtol=1e-9)
    for w in range(windows):
        part = slice(P + w * K, P + (w + 1) * K)
        np.testing.assert_allclose(of.local[w], whole[part, part], rtol=1e-9)
        np.testing.assert_allclose(of.local_shared[w], whole[part, :P], rtol=1e-8)
    # Twin: without seams the solution differs.
    assert windows == 1 or np.max(np.abs(loose.shared - expected.shared)) > 1e-3
