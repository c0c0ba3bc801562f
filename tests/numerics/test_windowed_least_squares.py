"""Least squares window by window, compared with solving the same equations at once."""

import jax
import jax.flatten_util
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

W, M, J, K, P, H = 5, 7, 3, 2, 4, 2


def chain(seed=0, windows=W):
    """Random equations of a chain, as a function of the unknowns, their right-hand side, and one matrix for both."""
    rng = np.random.default_rng(seed)
    draw = lambda *shape: jnp.asarray(rng.normal(size=shape))
    rows, own, prior = draw(windows, M, P), draw(windows, M, K), draw(H, P)
    # The last window has no seam.
    seams, begin, end = (draw(windows, J, n).at[-1].set(0.0) for n in (P, K, K))

    def product(d):
        following = jnp.concatenate([d.local[1:], jnp.zeros_like(d.local[:1])])
        return WindowedEquations(
            rows @ d.shared + jnp.einsum("wij,wj->wi", own, d.local),
            seams @ d.shared + jnp.einsum("wij,wj->wi", begin, d.local) + jnp.einsum("wij,wj->wi", end, following),
            prior @ d.shared,
        )

    rhs = WindowedEquations(draw(windows, M), draw(windows, J).at[-1].set(0.0), draw(H))
    unknowns = Unknowns(jnp.zeros(P), jnp.zeros((windows, K)))
    flat, back = jax.flatten_util.ravel_pytree(unknowns)
    matrix = jax.jit(jax.jacfwd(lambda x: jax.flatten_util.ravel_pytree(product(back(x)))[0]))(flat)
    return product, rhs, unknowns, np.asarray(matrix), back


@pytest.mark.parametrize("windows", exhaustive_but((2,), (1, 2, 5)))
def test_solution_and_covariance(windows):
    """The chain's solution and covariance are those of the whole matrix."""
    product, rhs, u, matrix, back = chain(windows=windows)
    none = jax.tree.map(jnp.zeros_like, u)
    eliminated = jax.jit(lambda slopes: eliminate(slopes, rhs, none))
    slopes = jax.jit(lambda u: slopes_of(product, u))(u)
    factors = eliminated(slopes)
    b = np.asarray(jax.flatten_util.ravel_pytree(rhs)[0])
    expected = back(jnp.asarray(np.linalg.lstsq(matrix, b)[0]))
    for found, x in zip(solution(factors), expected):
        np.testing.assert_allclose(found, x, atol=1e-12)
    whole = np.linalg.inv(matrix.T @ matrix)
    of = covariance(factors, jnp.linalg.inv(factors.shared))
    np.testing.assert_allclose(of.shared, whole[:P, :P], rtol=1e-9)
    for w in range(windows):
        part = slice(P + w * K, P + (w + 1) * K)
        np.testing.assert_allclose(of.local[w], whole[part, part], rtol=1e-9)
        np.testing.assert_allclose(of.local_shared[w], whole[part, :P], rtol=1e-8)
    if windows > 1:
        # Twin: without seams the solution differs.
        loose = eliminated(slopes._replace(seams_by_next=jnp.zeros((windows, J, K))))
        assert np.max(np.abs(solution(loose).shared - expected.shared)) > 1e-3


def test_damped_step_as_a_linear_solver():
    """The lineax solver damps every unknown relative to its slopes."""
    product, rhs, u, matrix, back = chain(3)
    factor = 0.7

    def damped(d):
        return product(d), jax.tree.map(lambda x: factor * x, d)

    operator = lx.FunctionLinearOperator(damped, jax.eval_shape(lambda: u))
    found = lx.linear_solve(operator, (rhs, jax.tree.map(jnp.zeros_like, u)), ByWindows(tau=0.01)).value
    sizes = np.linalg.norm(matrix, axis=0)
    whole = np.vstack([matrix, 0.1 * factor * np.diag(sizes)])
    b = np.concatenate([np.asarray(jax.flatten_util.ravel_pytree(rhs)[0]), np.zeros(len(sizes))])
    expected = back(jnp.asarray(np.linalg.lstsq(whole, b)[0]))
    for x, y in zip(found, expected):
        np.testing.assert_allclose(x, y, atol=1e-12)
