"""Mechanisms in space against the equations and closed forms of their sources."""

import numpy as np

from lagjax.mechanisms import MECHANISMS, bricard, fekete, governor, spatial
from lagjax.mechanisms.spatial import REST, GovernorParts
from tests.by_numpy import by_numpy
from tests.by_numpy import equations as at_a_state
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import equations, residuals, stacked


def test_bricard_chain():
    """The chain closes along the whole curve, and is the cube's edges at θ = φ = -90°."""
    chain = by_numpy(lambda theta, phi: spatial.chain(theta, phi, bricard.params))
    off = by_numpy(residuals(bricard))
    for theta in np.linspace(-2.0, 2.0, 9):
        found, end, axis = chain(theta, -np.arccos(-np.cos(theta) / (1 + np.cos(theta))))
        np.testing.assert_allclose(end, [0.0, 0.0, 1.0], atol=1e-14)
        np.testing.assert_allclose(axis, [1.0, 0.0, 0.0], atol=1e-14)
        np.testing.assert_allclose(off(0.0, found), 0.0, atol=1e-14)
    cube = chain(-np.pi / 2, -np.pi / 2)[0]
    np.testing.assert_allclose(stacked(cube), stacked(bricard.q0), atol=1e-15)
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


def test_its_accelerations():
    """At a state off its start, and in motion, slider and balls accelerate as the two equations have it."""
    p, parts = dict(governor.params) | {"k": 50.0, "c": 3.0}, GovernorParts
    tree = lambda x: parts(x[0], x[1], x[2:5], x[5:])
    field, y = published.governor_field(p), np.array([0.4, 0.7, 0.45, 1.5, -0.8])
    found = at_a_state(governor.system, 0.0, *map(tree, published.governor_state(p, field, y)), p).a
    step = 2.0**-20 * np.array(field(0.0, y))
    (_, more), (_, less) = (published.governor_state(p, field, y + way * step) for way in (1, -1))
    exact = tree((more - less) * 2.0**19)
    for ours, right in zip(found, exact):
        np.testing.assert_allclose(ours, right, rtol=1e-7, atol=1e-7)


def test_fekete():
    """The published rest state is one: no tangential force on any particle, and λ = -19/4; the start is not."""
    mechanism = fekete

    def forces(points):
        apart = points[:, None] - points[None]
        squares = np.sum(apart**2, axis=2) + np.eye(20)
        return np.sum(apart / squares[..., None], axis=1)

    assert np.max(np.abs(forces(REST) - 2 * 19 / 4 * REST)) < 1e-10
    assert np.max(np.abs(forces(mechanism.q0) - 2 * 19 / 4 * mechanism.q0)) > 0.1
