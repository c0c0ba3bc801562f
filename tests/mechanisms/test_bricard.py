"""Bricard's chain: its curve of closed positions, and its redundant equation."""

import numpy as np

from lagjax.mechanisms import MECHANISMS, bricard
from tests.by_numpy import by_numpy
from tests.mechanisms.test_mechanism import equations, residuals, stacked


def test_bricard_chain():
    """The chain closes along the whole curve, and is the cube's edges at θ = φ = -90°."""
    chain = by_numpy(lambda theta, phi: bricard.chain(theta, phi, bricard.PARAMS))
    off = by_numpy(residuals(bricard.MECHANISM))
    for theta in np.linspace(-2.0, 2.0, 9):
        found, end, axis = chain(theta, -np.arccos(-np.cos(theta) / (1 + np.cos(theta))))
        np.testing.assert_allclose(end, [0.0, 0.0, 1.0], atol=1e-14)
        np.testing.assert_allclose(axis, [1.0, 0.0, 0.0], atol=1e-14)
        np.testing.assert_allclose(off(0.0, found), 0.0, atol=1e-14)
    cube = chain(-np.pi / 2, -np.pi / 2)[0]
    np.testing.assert_allclose(stacked(cube), stacked(bricard.MECHANISM.q0), atol=1e-15)
    # Twin: an angle off the curve does not close.
    assert np.linalg.norm(chain(-1.0, -1.0)[1] - np.array([0.0, 0.0, 1.0])) > 0.1


def test_bricard_has_one_constraint_too_many():
    """24 equations, 23 independent; without any one equation of the dependent set still 23."""
    _, _, jacobian, _ = equations(MECHANISMS["bricard"])
    assert jacobian.shape == (24, 24)
    left, values, _ = np.linalg.svd(jacobian)
    assert values[-1] < 1e-15 * values[0] < values[-2]
    dependent = np.flatnonzero(np.abs(left[:, -1]) > 1e-12)
    assert dependent.size > 1
    for i in dependent:
        assert np.linalg.matrix_rank(np.delete(jacobian, i, axis=0)) == 23
    # Twin: an equation outside the dependent set is missed.
    outside = np.setdiff1d(np.arange(24), dependent)
    for i in outside:
        assert np.linalg.matrix_rank(np.delete(jacobian, i, axis=0)) == 22
