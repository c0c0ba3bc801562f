"""Gauss-Kronrod quadrature: exact to its degree."""

import numpy as np

from lagjax.numerics import quadrature


def test_quadrature_is_exact_to_its_degree():
    """Exact for polynomials up to degree 22; twin: not for degree 24. The estimate covers the error at a kink."""
    a, b = np.array([-0.5, 1.0]), np.array([1.0, 0.25])
    powers = np.arange(25)
    found = quadrature.integrals(quadrature.nodes(a, b)[:, :, None] ** powers, a, b)
    exact = (b[:, None] ** (powers + 1) - a[:, None] ** (powers + 1)) / (powers + 1)
    error = np.abs(found.values - exact)
    assert error[:, :23].max() < 1e-15 and error[:, 24].max() > 1e-15
    kink = quadrature.integrals(np.abs(quadrature.nodes(a, b))[:, :, None], a, b)
    assert 1.0 > kink.errors[0] > abs(kink.values[0, 0] - 0.625) > 1e-6
