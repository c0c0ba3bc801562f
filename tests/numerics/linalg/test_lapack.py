"""Decompositions in lanes: those of SciPy, matrix by matrix, without derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

from lagjax.numerics import lapack

RNG = np.random.default_rng(3)
MATRICES = RNG.normal(size=(3, 4, 4))
MASSES = MATRICES @ MATRICES.transpose(0, 2, 1) + np.eye(4)
STIFFNESSES = MATRICES + MATRICES.transpose(0, 2, 1)


def test_generalised_eigenvalues_of_symmetric_matrices():
    """K x = s M x with Xᵀ M X = 1 in lanes; NaN where M is not definite."""
    values, vectors = jax.jit(jax.vmap(lapack.symmetric_definite))(STIFFNESSES, MASSES)
    for s, x, k, m in zip(*map(np.asarray, (values, vectors)), STIFFNESSES, MASSES):
        np.testing.assert_allclose(s, scipy.linalg.eigh(k, m, eigvals_only=True), atol=1e-12)
        np.testing.assert_allclose(k @ x, m @ x * s, atol=1e-12)
        np.testing.assert_allclose(x.T @ m @ x, np.eye(4), atol=1e-12)
    assert np.isnan(jax.jit(lapack.symmetric_definite)(STIFFNESSES[0], -MASSES[0])[0]).all()


def test_generalised_eigenvalues():
    """A x = λ E x with left vectors Z E X = 1; and with a zero root projected out, whose other roots are the same."""
    a, e = MATRICES[0], MASSES[0]
    values, x, z = map(np.asarray, jax.jit(lapack.eigen)(a, e))
    expected = scipy.linalg.eigvals(a, e)
    np.testing.assert_allclose(np.sort_complex(values), np.sort_complex(expected), atol=1e-12)
    np.testing.assert_allclose(a @ x, e @ x * values, atol=1e-12)
    np.testing.assert_allclose(z @ e @ x, np.eye(4), atol=1e-12)
    without_null_space = jax.jit(lapack.eigen_without_null_space)
    singular = a - np.outer(a[:, 0], [1.0, 0.0, 0.0, 0.0])
    values, *_, is_null = map(np.asarray, without_null_space(singular, e, 1e-12))
    assert is_null.sum() == 1 and values[is_null] == 0
    expected = np.sort_complex(scipy.linalg.eigvals(singular, e))
    np.testing.assert_allclose(np.sort_complex(values), expected, atol=1e-12)
    # Twin: a regular matrix has no zero root.
    assert not np.asarray(without_null_space(a, e, 1e-12)[-1]).any()


def test_singular_values_and_complements():
    """σ of SciPy; the complement is perpendicular to the columns and orthonormal."""
    np.testing.assert_allclose(
        jax.jit(jax.vmap(lapack.singular_values))(MATRICES), [scipy.linalg.svdvals(x) for x in MATRICES], rtol=1e-12
    )
    u, s, vt = map(np.asarray, jax.jit(lapack.decomposed)(MATRICES[0, :, :2]))
    np.testing.assert_allclose(u * s @ vt, MATRICES[0, :, :2], atol=1e-14)
    rest = jax.jit(jax.vmap(lapack.complement))(MATRICES[:, :, :3])
    assert rest.shape == (3, 4, 1)
    np.testing.assert_allclose(rest.transpose(0, 2, 1) @ MATRICES[:, :, :3], 0.0, atol=1e-14)


def test_no_derivatives():
    """What is decomposed is held; twin: NumPy's function in JAX has the derivative."""
    slope = lambda svd: jax.grad(lambda x: jnp.sum(svd(x)))(MATRICES[0])
    held, other = jax.jit(lambda: [slope(lapack.singular_values), slope(jnp.linalg.svdvals)])()
    assert not np.asarray(held).any() and np.asarray(other).any()


def test_outside_of_jit():
    """Arrays of NumPy in lanes, outside of jit."""
    found = jax.vmap(lapack.singular_values)(MATRICES)
    np.testing.assert_allclose(found, np.linalg.svd(MATRICES, compute_uv=False), atol=1e-12)
