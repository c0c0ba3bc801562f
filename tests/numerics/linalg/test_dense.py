"""Small linear solves: correct, accurate entry by entry, differentiable, and not finite for singular matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.numerics import dense
from lagjax.numerics.dense import Saddle
from tests.tiers import exhaustive_but

solve = jax.jit(dense.solve)
LARGE = dense.ELIMINATE_UP_TO + 1
SOME = (2, LARGE)


@pytest.mark.parametrize("n", exhaustive_but(SOME, (1, 2, 5, dense.ELIMINATE_UP_TO, LARGE, 20)))
def test_solves_random_systems(n):
    """The backward error of random systems is at round-off, below and above the switch to LAPACK."""
    rng = np.random.default_rng(n)
    for matrix, rhs in ((rng.normal(size=(n, n)), rng.normal(size=n)) for _ in range(5)):
        assert error_of(np.asarray(solve(matrix, rhs)), matrix, rhs) < 1e-14
    # A singular matrix gives NaN or infinity.
    assert not np.all(np.isfinite(solve(np.ones((n, n)) * (n > 1), np.arange(1.0, n + 1))))


def test_pivots_where_the_diagonal_vanishes():
    """A zero on the diagonal (every saddle-point matrix has one) is no obstacle."""
    matrix = np.zeros((4, 4))
    matrix[:3, :3], matrix[3, 3] = [[0.0, 2.0, 1.0], [2.0, 0.0, 0.0], [1.0, 0.0, 3.0]], 1.0
    rhs = np.array([1.0, 2.0, 3.0, 4.0])
    np.testing.assert_allclose(solve(matrix, rhs), np.linalg.solve(matrix, rhs), rtol=1e-14)


def test_refinement_keeps_small_components():
    """An acceleration of 1e-17 next to one of 10 keeps its digits; without refinement it is lost entirely."""
    alpha, m, M, g = 2.0**-30, 1.5, 4.0, 9.8125
    s, c = np.sin(alpha), np.cos(alpha)
    matrix, rhs = whole(np.diag([M, m, m]), np.array([[-s, s, -c]])), np.array([0.0, 0.0, m * g, 0.0])
    exact = (M + m) * g * s**2 / (M + m * s**2)
    assert abs(solve(matrix, rhs)[2] / exact - 1) < 1e-14
    assert abs(np.linalg.solve(matrix, rhs)[2] / exact - 1) > 0.1


def test_derivatives_in_both_modes():
    """dx = K^-1 (db - dK x), forward and reverse, against a central difference."""
    rng = np.random.default_rng(0)
    matrix, rhs, d_matrix, d_rhs = (rng.normal(size=shape) for shape in ((4, 4), (4,), (4, 4), (4,)))
    weights, step = rng.normal(size=4), 1e-6

    @jax.jit
    def both(*at):
        _, forward = jax.jvp(dense.solve, at, (d_matrix, d_rhs))
        return forward, jax.vjp(dense.solve, *at)[1](weights)

    forward, pulled = both(matrix, rhs)
    ahead, behind = (np.linalg.solve(matrix + h * d_matrix, rhs + h * d_rhs) for h in (step, -step))
    np.testing.assert_allclose(forward, (ahead - behind) / (2 * step), rtol=1e-7)
    np.testing.assert_allclose(np.sum(pulled[0] * d_matrix) + pulled[1] @ d_rhs, weights @ forward, rtol=1e-12)


@pytest.mark.parametrize("n", exhaustive_but(SOME, (1, *SOME)))
def test_reverse_mode_of_jitted_lanes(n):
    """Lanes, and reverse mode through vmap through jit: Σ x = s Σ K⁻¹ b of each lane, and its derivative by s."""
    rng = np.random.default_rng(n)
    matrices, rhs = rng.normal(size=(3, n, n)), rng.normal(size=n)
    of_lanes = lambda scales: jnp.sum(jax.vmap(lambda k, s: solve(k, s * rhs))(matrices, scales))
    value, slopes = jax.jit(jax.value_and_grad(of_lanes))(np.arange(1.0, 4.0))
    expected = [np.sum(np.linalg.solve(k, rhs)) for k in matrices]
    np.testing.assert_allclose(slopes, expected, rtol=1e-11)
    np.testing.assert_allclose(value, [1, 2, 3] @ np.array(expected), rtol=1e-11)


@jax.jit
def eliminated(mass, jacobian, forcing, gamma):
    """a, multipliers, and whether they are valid."""
    saddle = Saddle(mass, jacobian)
    return *saddle.solve(forcing, gamma), saddle.valid


def error_of(solution, matrix, known):
    """The backward error entry by entry: |K x - b| / (|K| |x| + |b|)."""
    return np.max(np.abs(matrix @ solution - known) / (np.abs(matrix) @ np.abs(solution) + np.abs(known)))


def whole(mass, jacobian):
    """The matrix of (a, -multipliers)."""
    m = len(jacobian)
    return np.block([[mass, jacobian.T], [jacobian, np.zeros((m, m))]])


RNG = np.random.default_rng(4)
SPREAD = np.diag([1.0, 1e-3, 1e5])
CASES = {
    "plain": (np.diag([1.0, 2.0, 3.0]) + 0.3, RNG.normal(size=(2, 3))),
    "masses from 1e-12 to 1e12": (np.diag([1e-12, 1.0, 1e12]), RNG.normal(size=(1, 3))),
    "units": (SPREAD @ (np.eye(3) + 0.4) @ SPREAD, RNG.normal(size=(2, 3)) @ SPREAD),
    "a light coordinate held": (np.diag([1.0, 1e-9, 1.0]), np.array([[0.0, 1.0, 1e-3]])),
    "negative": (-np.diag([1.0, 2.0, 3.0]) - 0.3, RNG.normal(size=(1, 3))),
    "Hilbert": (1 / (1.0 + np.add.outer(np.arange(3), np.arange(3))), RNG.normal(size=(1, 3))),
}


@pytest.mark.parametrize("name", CASES)
def test_as_accurate_as_lapack(name):
    """Backward error entry by entry: within a few units of round-off, as LAPACK's is, over the extremes."""
    mass, jacobian = CASES[name]
    forcing, gamma = RNG.normal(size=3), RNG.normal(size=len(jacobian))
    a, multipliers, valid = eliminated(mass, jacobian, forcing, gamma)
    matrix, known = whole(mass, jacobian), np.concatenate([forcing, gamma])
    assert valid
    ours = error_of(np.concatenate([a, -multipliers]), matrix, known)
    assert ours < 20 * np.finfo(float).eps + 2 * error_of(np.linalg.solve(matrix, known), matrix, known)


@pytest.mark.parametrize(
    ("mass", "jacobian"),
    [
        (np.diag([0.0, 1.0, 1.0]), np.array([[1.0, 1.0, 0.0]])),
        (np.diag([1.0, -1.0, 1.0]), np.array([[0.0, 1.0, 0.0]])),
        (np.eye(3), np.array([[1.0, 2.0, 0.0], [1.0, 2.0, 1e-6]])),
        (np.eye(3), np.array([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]])),
    ],
    ids=["massless", "indefinite", "dependent", "vanishing"],
)
def test_not_believed(mass, jacobian):
    """If pivoting is needed the result is invalid but never NaN, which would spoil derivatives."""
    a, multipliers, valid = eliminated(mass, jacobian, np.ones(3), np.ones(len(jacobian)))
    assert not valid and np.all(np.isfinite(a)) and np.all(np.isfinite(multipliers))
