"""Bricard's chain: its curve of closed positions, its redundant equation, and its stored end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lagjax.mechanisms import MECHANISMS, bricard
from tests.by_numpy import by_numpy
from tests.mechanisms.test_mechanism import assert_reference, equations, residuals, stacked


def bricard_end(end, params, rtol=3e-14):
    """(q, v) at `end` from a single equation of motion on the curve of closed chains, by arc length in (θ, φ)."""
    shape = lambda y: bricard.chain(y[0], y[1], params)[0]
    squares = lambda x, y: jnp.sum(x * y)

    def tangent(y):
        slope = jax.grad(lambda y: bricard.closure(y[0], y[1]))(y)
        return jnp.stack([-slope[1], slope[0]]) / jnp.sqrt(slope @ slope)

    def inertia(y):
        """Twice the kinetic energy at unit speed: centres of mass, rotation of slender rods, and their section."""
        rate = jax.jvp(shape, (y,), (tangent(y),))[1]
        points = jnp.concatenate([jnp.zeros((1, 3)), rate.points, jnp.zeros((1, 3))])
        centres, turns = 0.5 * (points[1:] + points[:-1]), points[1:] - points[:-1]
        return params["m"] * (
            squares(centres, centres)
            + squares(turns, turns) / 12
            + params["a"] ** 2 / 6 * squares(rate.axes, rate.axes)
        )

    potential = lambda y: params["m"] * params["g"] * jnp.sum(shape(y).points[:, 1])

    @jax.jit
    def field(y):
        along = tangent(y[:2])
        J, dJ = jax.jvp(inertia, (y[:2],), (along,))
        _, dV = jax.jvp(potential, (y[:2],), (along,))
        return jnp.concatenate([along * y[2], -(0.5 * dJ * y[2] ** 2 + dV)[None] / J])

    start = [-np.pi / 2, -np.pi / 2, 0.0]
    y = solve_ivp(lambda t, y: np.asarray(field(y)), (0, end), start, "DOP853", rtol=rtol, atol=rtol).y[:, -1]
    q, v = jax.jvp(shape, (jnp.asarray(y[:2]),), (tangent(jnp.asarray(y[:2])) * y[2],))
    return stacked(q), stacked(v)


@pytest.mark.slow
def test_bricard():
    """The equation on the curve of closed chains gives the stored end, on the way back in the second swing."""
    mechanism = bricard.MECHANISM
    assert_reference(mechanism, *bricard_end(mechanism.end, mechanism.params))


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
