"""Constraints at acceleration level: forces, signs, singular and indefinite mass matrices."""

import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax import Holonomic, Nonholonomic, System, constraint_force, constraint_residual
from tests.jaxtools.in_numpy import accelerations


def plane_particle(t, q, v, params):
    """A particle in a uniform field."""
    return 0.5 * params["m"] * jnp.dot(v, v) - params["m"] * params["g"] * q[1]


def circle(t, q, params):
    """|q|² = l²."""
    return jnp.dot(q, q) - params["l"] ** 2


def test_pendulum_tension():
    """The rod's multiplier gives the tension m (v²/l + g cos); λ > 0 pushes along +∂g/∂q."""
    params = {"m": 1.5, "g": 9.8125, "l": 2.0}
    angle, rate = 0.75, 1.25
    q = 2.0 * np.array([np.sin(angle), -np.cos(angle)])
    v = 2.0 * rate * np.array([np.cos(angle), np.sin(angle)])
    system = System(plane_particle, {"rod": Holonomic(circle)})
    a, multipliers = lj.accelerations(system, 0.0, q, v, params)
    tension = params["m"] * (2.0 * rate**2 + params["g"] * np.cos(angle))
    np.testing.assert_allclose(multipliers["rod"], -tension / (2 * 2.0), rtol=1e-13)
    np.testing.assert_allclose(constraint_force(system, 0.0, q, v, params)["rod"], -tension * q / 2.0, rtol=1e-13)
    tangential = np.asarray(a) @ np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(tangential, -params["g"] * np.sin(angle), rtol=1e-13)


def test_moving_constraint():
    """A support in motion (explicit time in g) enters gamma: ∂²g/∂t² and 2 ∂²g/∂t∂q v both count."""
    lift = lambda t: jnp.sin(2 * t)
    tilt = lambda t: 0.5 * t
    floor = Holonomic(lambda t, q, params: q[1] - lift(t) - tilt(t) * q[0])
    t, params = 0.375, {"m": 1.5, "g": 9.8125}
    q = np.array([0.25, float(lift(t) + tilt(t) * 0.25)])
    v = np.array([0.75, float(2 * np.cos(2 * t) + 0.5 * 0.25 + tilt(t) * 0.75)])
    a, multipliers = accelerations(System(plane_particle, {"floor": floor}), t, q, v, params)
    slope = float(tilt(t))
    demanded = -4 * np.sin(2 * t) + 2 * 0.5 * 0.75  # of a_y - slope a_x
    force = (demanded + params["g"]) * params["m"] / (1 + slope**2)
    np.testing.assert_allclose(multipliers["floor"], force, rtol=1e-13)
    np.testing.assert_allclose(a, [-slope * force / 1.5, force / 1.5 - 9.8125], rtol=1e-13)


def test_nonlinear_velocity_constraint():
    """|v|² kept constant: Chetaev's rule gives a = F/m - v (v·F)/(m v²)."""
    cruise = Nonholonomic(lambda t, q, v, params: jnp.dot(v, v) - 4.0)
    v = 2.0 * np.array([0.6, 0.8])
    a, multipliers = accelerations(
        System(plane_particle, {"cruise": cruise}), 0.0, np.zeros(2), v, {"m": 1.5, "g": 9.8125}
    )
    gravity = np.array([0.0, -9.8125])
    np.testing.assert_allclose(a, gravity - v * (v @ gravity) / 4.0, rtol=1e-13)
    np.testing.assert_allclose(multipliers["cruise"], -1.5 * (v @ gravity) / (2 * 4.0), rtol=1e-13)


def test_velocity_constraint_with_time_and_position():
    """∂phi/∂t and (∂phi/∂q) v of a velocity constraint count: v_y = x t."""
    driven = Nonholonomic(lambda t, q, v, params: v[1] - q[0] * t)
    a, _ = accelerations(
        System(plane_particle, {"driven": driven}),
        2.0,
        np.array([0.5, 0.0]),
        np.array([3.0, 1.0]),
        {"m": 1.0, "g": 1.0},
    )
    np.testing.assert_allclose(a, [0.0, 0.5 + 3.0 * 2.0], rtol=1e-13)


def test_indefinite_mass_matrix():
    """L = ½ (v_x² - v_y²) with x = y + z tied: definite on what is free, so it is solved."""
    system = System(
        lambda t, q, v, params: 0.5 * (v[0] ** 2 - v[1] ** 2) + q[0],
        {"tie": Holonomic(lambda t, q, params: q[0] - 2 * q[1])},
    )
    a, multipliers = lj.accelerations(system, 0.0, np.zeros(2), np.zeros(2), None)
    # x = 2 y: L = ½ (4 - 1) v_y² + 2 y.
    np.testing.assert_allclose(a, [4 / 3, 2 / 3], rtol=1e-14)
    np.testing.assert_allclose(multipliers["tie"], 1 / 3, rtol=1e-14)


def test_residuals_by_level():
    """`level` chooses g or dg/dt."""
    system = System(plane_particle, {"rod": Holonomic(circle)})
    state = (0.0, np.array([3.0, 4.0]), np.array([1.0, 2.0]), {"m": 1.0, "g": 1.0, "l": 4.0})
    assert float(constraint_residual(system, *state)["rod"]) == 9.0
    assert float(constraint_residual(system, *state, level="velocity")["rod"]) == 22.0
