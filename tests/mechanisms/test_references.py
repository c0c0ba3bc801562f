"""The stored end states agree with independent integrations to the digits that they claim."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from lagjax.mechanisms import (
    andrews,
    bricard,
    double_pendulum,
    driven_crank,
    fekete,
    governor,
    n_four_bar,
    slider_crank,
)
from lagjax.system.constraints import Holonomic
from tests.mechanisms import published
from tests.mechanisms.test_equations import stacked


def assert_reference(mechanism, q, v):
    """Stored and recomputed ends agree to the stored number of digits, separately for positions and velocities."""
    for stored, computed in zip(mechanism.reference, (q, v)):
        stored = stacked(stored)
        assert np.max(np.abs(stored - np.ravel(computed))) <= 10.0**-mechanism.digits * np.max(np.abs(stored))


def test_andrews():
    """DOP853 on the printed equations ends where the test set's reference does, to nine digits (not to ten)."""
    mechanism = andrews.MECHANISM
    q, v = published.andrews_end(stacked(mechanism.q0), stacked(mechanism.v0), mechanism.end, mechanism.params)
    assert_reference(mechanism, q, v)
    assert np.max(np.abs(v - stacked(mechanism.reference[1]))) > 1e-10 * np.max(np.abs(v))


def test_slider_crank():
    """DOP853 on the equation of the crank's angle gives the stored end; without gravity it does not."""
    mechanism = slider_crank.MECHANISM
    assert_reference(mechanism, *published.slider_crank_end(mechanism.end, mechanism.params))
    with pytest.raises(AssertionError):
        assert_reference(mechanism, *published.slider_crank_end(mechanism.end, {**mechanism.params, "g": 0.0}))


def test_ladder():
    """Jacobi's elliptic functions give the stored end, and solve the pendulum's equation."""
    mechanism = n_four_bar.MECHANISM
    assert_reference(mechanism, *published.ladder_end(2, mechanism.end, mechanism.params))
    k = (2 + 1.5) * 9.81 / (2 + 1.0)
    angle = solve_ivp(lambda t, y: [y[1], -k * np.cos(y[0])], (0, 2), [np.pi / 2, -1], "DOP853", rtol=1e-13, atol=1e-13)
    q, _ = published.ladder_end(2, 2.0, mechanism.params)
    np.testing.assert_allclose(q[0], [np.cos(angle.y[0, -1]), np.sin(angle.y[0, -1])], atol=1e-11)


def test_double_pendulum():
    """DOP853 on the equations of the angles gives the stored end; with other masses it does not."""
    mechanism = double_pendulum.MECHANISM
    assert_reference(mechanism, *published.double_pendulum_end(mechanism.end, mechanism.params))
    with pytest.raises(AssertionError):
        assert_reference(mechanism, *published.double_pendulum_end(mechanism.end, {**mechanism.params, "m2": 1.1}))


def test_driven_crank():
    """The closed form gives the stored start and end, and its velocity is its position's derivative."""
    mechanism = driven_crank.MECHANISM
    q, v, _ = driven_crank.exact(mechanism.end, mechanism.params)
    assert_reference(mechanism, stacked(q), stacked(v))
    q, v, _ = driven_crank.exact(0.0, mechanism.params)
    np.testing.assert_allclose(stacked((q, v)), stacked((mechanism.q0, mechanism.v0)), atol=1e-14)
    at = lambda t: stacked(driven_crank.exact(t, mechanism.params)[0])
    step = 2.0**-20
    np.testing.assert_allclose(
        (at(0.03 + step) - at(0.03 - step)) / (2 * step),
        stacked(driven_crank.exact(0.03, mechanism.params)[1]),
        rtol=1e-6,
        atol=1e-6,
    )


def test_fekete():
    """The published rest state is one: no tangential force on any particle, and λ = -19/4; the start is not."""
    mechanism = fekete.MECHANISM

    def forces(points):
        apart = points[:, None] - points[None]
        squares = np.sum(apart**2, axis=2) + np.eye(20)
        return np.sum(apart / squares[..., None], axis=1)

    assert np.max(np.abs(forces(fekete.REST) - 2 * 19 / 4 * fekete.REST)) < 1e-10
    assert np.max(np.abs(forces(mechanism.q0) - 2 * 19 / 4 * mechanism.q0)) > 0.1


@pytest.mark.slow
def test_governor():
    """Radau on the two equations of α and z gives the stored end."""
    mechanism = governor.MECHANISM
    assert_reference(mechanism, *published.governor_end(mechanism.end, mechanism.params))


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
    for theta in np.linspace(-2.0, 2.0, 9):
        phi = -np.arccos(-np.cos(theta) / (1 + np.cos(theta)))
        found, end, axis = bricard.chain(theta, phi, bricard.PARAMS)
        np.testing.assert_allclose(end, [0.0, 0.0, 1.0], atol=1e-14)
        np.testing.assert_allclose(axis, [1.0, 0.0, 0.0], atol=1e-14)
        for constraint in bricard.system.constraints.values():
            assert isinstance(constraint, Holonomic)
            np.testing.assert_allclose(constraint.g(0.0, found, bricard.PARAMS), 0.0, atol=1e-14)
    np.testing.assert_allclose(
        stacked(bricard.chain(-np.pi / 2, -np.pi / 2, bricard.PARAMS)[0]), stacked(bricard.MECHANISM.q0), atol=1e-15
    )
    # Twin: an angle off the curve does not close.
    assert np.linalg.norm(bricard.chain(-1.0, -1.0, bricard.PARAMS)[1] - np.array([0.0, 0.0, 1.0])) > 0.1
