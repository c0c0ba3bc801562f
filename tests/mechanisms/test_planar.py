"""Mechanisms in a plane against the equations, multipliers and closed forms of their sources."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.mechanisms import andrews, car_axis, driven_crank, n_four_bar
from lagjax.mechanisms.planar import ANDREWS_MULTIPLIERS, Angles, AxleEnds, driven_crank_exact
from tests.behaviour.test_end_states import TOLERANCES, WITHIN, relative_errors
from tests.by_numpy import by_numpy
from tests.by_numpy import equations as at_a_state
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_close, assert_reference, equations, residuals, stacked
from tests.tiers import exhaustive_but


def test_andrews_against_the_printed_equations():
    """M, f, g, G and the acceleration level from the Lagrangian are Hairer & Wanner's at a random state."""
    rng = np.random.default_rng(5)
    q, v = rng.uniform(-1, 1, 7), rng.uniform(-100, 100, 7)
    params = dict(andrews.params)
    mass, force, jacobian, gamma = equations(andrews, q=Angles(*q), v=Angles(*v))
    M, f, g, G = published.andrews(q, v, params)
    G_rate = published.andrews(q + 1e-30j * v, v + 0j, params)[3].imag / 1e-30
    assert_close(mass, M)
    assert_close(force, f)
    assert_close(jacobian, G)
    assert_close(gamma, -G_rate @ v)
    assert_close(by_numpy(residuals(andrews))(0.0, Angles(*q)), g)
    # Twin: a motor of twice the torque, a joint half a millimetre away.
    assert not np.allclose(force, published.andrews(q, v, params | {"mom": 0.066})[1], rtol=1e-12)
    assert not np.allclose(jacobian, published.andrews(q, v, params | {"d": 0.0285})[3], rtol=1e-12)


def test_andrews_multipliers_at_the_start():
    """λ(0) is the source's with its sign reversed."""
    start = andrews
    found = at_a_state(start.system, 0.0, start.q0, start.v0, start.params).multipliers["loops"]
    assert np.max(np.abs(found + ANDREWS_MULTIPLIERS[0])) <= 1e-10


def test_driven_crank():
    """The closed form gives the stored start and end, and its velocity is its position's derivative."""
    mechanism = driven_crank
    q, v, _ = driven_crank_exact(mechanism.end, mechanism.params)
    assert_reference(mechanism, stacked(q), stacked(v))
    q, v, _ = driven_crank_exact(0.0, mechanism.params)
    np.testing.assert_allclose(stacked((q, v)), stacked((mechanism.q0, mechanism.v0)), atol=1e-14)
    at = lambda t: stacked(driven_crank_exact(t, mechanism.params)[0])
    step = 2.0**-20
    np.testing.assert_allclose(
        (at(0.03 + step) - at(0.03 - step)) / (2 * step),
        stacked(driven_crank_exact(0.03, mechanism.params)[1]),
        rtol=1e-6,
        atol=1e-6,
    )


def test_torque_of_the_motor():
    """At a state the motor's multiplier is the closed form's torque."""
    params = dict(driven_crank.params) | {"rate": 3.0}
    q, v, torque = driven_crank_exact(0.3, params)
    found = at_a_state(driven_crank.system, 0.3, q, v, params).multipliers["motor"]
    np.testing.assert_allclose(found, torque, rtol=1e-12)


def test_ladder():
    """Jacobi's elliptic functions give the stored end, and solve the pendulum's equation."""
    mechanism = n_four_bar
    assert_reference(mechanism, *published.ladder_end(2, mechanism.end, mechanism.params))
    k = (2 + 1.5) * 9.81 / (2 + 1.0)
    angle = solve_ivp(lambda t, y: [y[1], -k * np.cos(y[0])], (0, 2), [np.pi / 2, -1], "DOP853", rtol=1e-13, atol=1e-13)
    q, _ = published.ladder_end(2, 2.0, mechanism.params)
    np.testing.assert_allclose(q[0], [np.cos(angle.y[0, -1]), np.sin(angle.y[0, -1])], atol=1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize("rtol", exhaustive_but((1e-8,), (*TOLERANCES, 1e-12)))
def test_singular_position_is_passed_or_reported(rtol):
    """After the first singular position the end is right, or the integration reports that it failed."""
    mechanism = n_four_bar
    traj = lj.integrate(
        mechanism.system, mechanism.q0, mechanism.v0, mechanism.params,
        ts=np.array([0.0, 1.0]), rtol=rtol, atol=rtol, throw=False,
    )  # fmt: skip
    right = np.all(relative_errors(traj, published.ladder_end(2, 1.0, mechanism.params)) <= WITHIN * rtol)
    assert right or not bool(traj.result == lj.RESULTS.successful)


def test_car_axis_against_the_printed_equations():
    """Mass, springs, both constraints and the signs of both multipliers are the test set's at a random state."""
    rng = np.random.default_rng(6)
    q, t, params = np.array([0.1, 0.5, 1.1, 0.4]) + rng.uniform(-0.2, 0.2, 4), 1.23, car_axis.params
    v = rng.uniform(-1, 1, 4)
    mass, force, jacobian, gamma = equations(car_axis, t, AxleEnds(*q), AxleEnds(*v))
    k, f, g, G = published.car_axis(t, q, params)
    # The source lists the upright spring first, lagjax the names in order: axle, upright.
    g, G = g[::-1], G[::-1]
    assert_close(mass, k * np.eye(4))
    assert_close(force, f)
    assert_close(jacobian, G)
    assert_close(by_numpy(residuals(car_axis))(t, AxleEnds(*q)), g)
    # gamma = -d²g/dt² at a = 0, by a sixth-order difference along q + v t.
    along = lambda s: published.car_axis(t + s, q + v * s, params)[2][::-1]
    step, weights = 1e-2, (1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90)
    second = sum(w * along(i * step) for i, w in zip(range(-3, 4), weights)) / step**2
    assert_close(gamma, -second, 1e-5)
    # Twin: the wheel half a wave earlier.
    assert not np.allclose(force, published.car_axis(t - np.pi / params["omega"], q, params)[1], rtol=1e-12)
