"""Newton's method in its three ways: roots of SciPy, their derivatives in closed form, and where it gives up.

Least squares window by window, compared with solving the same equations at once.
"""

from functools import partial

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import pytest
import scipy.optimize

from lagjax.numerics.newton import (
    ByWindows,
    Unknowns,
    WindowedEquations,
    covariance,
    differentiable,
    eliminate,
    last_step,
    least_squares_root,
    newton,
    newton_in_python,
    slopes_of,
    solution,
)
from tests.tiers import exhaustive_but


def circle_and_line(a):
    """x² + y² = a and y = 2 x: the roots are ±√(a/5) (1, 2)."""
    return lambda y: jnp.stack([y[0] ** 2 + y[1] ** 2 - a, y[1] - 2.0 * y[0]])


def test_loops():
    """Steps are shortened (arctan from 3; twin: whole steps leave it), and end where the residual falls enough.

    At a double root each step halves y. Of two levels the slowest decides: its second falls by 9/16 in each step, to a
    thousandth in 13; twin: the first alone takes 5.
    """
    atan = partial(newton, jnp.arctan, lambda y, r, i: r * (1 + y**2), jnp.array([3.0]), 12)
    double = partial(newton, lambda y: y**2, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 40)
    slow = np.array([[2.0], [4.0]])
    levels = partial(newton, lambda y: y**2, lambda y, r, i: r / (slow * y), jnp.ones((2, 1)), 40, enough=1e-3)
    found = jax.jit(lambda: [
        atan(fractions=0.5 ** np.arange(6)), atan(), double(), double(falls=0.2), double(enough=1e-3),
        levels(size=lambda r: r[:, 0])[1], levels(size=lambda r: r[:1, 0].repeat(2))[0],
    ])()  # fmt: skip
    shortened, left, *others = (float(x[0]) for x in found)
    assert abs(shortened) < 1e-15 and not abs(left) < 1.0
    np.testing.assert_allclose(others, [0.5**40, 0.5, 0.5**5, 0.75**13, 0.5**5], rtol=1e-12)


def test_one_more_step_has_the_derivatives():
    """d√a/da = 1/(2 √a) in both modes, from a root found without derivatives."""

    def root(a):
        near = jax.lax.stop_gradient(newton(lambda y: y**2 - a, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 8))
        return last_step(near, jnp.array([1.0]), lambda y: (y**2 - a) / jax.lax.stop_gradient(2 * y))[0]

    both = jax.jit(lambda a: (jax.grad(root)(a), jax.jacfwd(root)(a)))
    np.testing.assert_allclose(both(5.0), 0.5 / np.sqrt(5.0), rtol=1e-14)


def test_least_squares_against_scipy():
    """A root from far away, and its derivatives of two orders; twin: without `differentiable` these are zero."""
    start = np.array([4.0, -1.0])

    def x(a, with_derivatives=True):
        found = least_squares_root(circle_and_line(jax.lax.stop_gradient(a)), start)
        return (differentiable(circle_and_line(a), found) if with_derivatives else found.y)[0]

    @jax.jit
    def of_a(a):
        near = least_squares_root(circle_and_line(a), start).y
        slope, bend = jax.jvp(jax.grad(x), (a,), (1.0,))
        return near, slope, bend, jax.jvp(lambda a: x(a, with_derivatives=False), (a,), (1.0,))[1]

    y, slope, bend, without = of_a(5.0)
    exact = scipy.optimize.root(lambda y: [y[0] ** 2 + y[1] ** 2 - 5.0, y[1] - 2.0 * y[0]], start, tol=1e-14).x
    np.testing.assert_allclose(y, exact, rtol=1e-12)
    np.testing.assert_allclose([slope, bend], [0.1, -0.01], rtol=1e-12)
    assert without == 0.0


def test_in_python():
    """√2 to round-off with lengths that fall; None where steps do not shrink, or where there is none to take."""
    found = newton_in_python(lambda y: (y**2 - 2.0) / (2 * y), np.array([1.0]), 20, free=1)
    assert found is not None and found.converged and found.lengths[2] < found.lengths[1] < found.lengths[0]
    np.testing.assert_allclose(found.y, np.sqrt(2.0), rtol=1e-15)
    assert newton_in_python(lambda y: -(2.0**y), np.array([1.0]), 20, free=1, noise=1e-3) is None
    assert newton_in_python(lambda y: None, np.array([1.0]), 20) is None
    unfinished = newton_in_python(lambda y: (y**2 - 2.0) / (2 * y), np.array([1.0]), 2, enough=1e-12)
    assert unfinished is not None and not unfinished.converged


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
