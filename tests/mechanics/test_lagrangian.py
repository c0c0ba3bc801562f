"""Equations of motion against textbook formulas at random states."""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax import System, accelerations, jacobi_integral, mass_matrix, momentum
from lagjax.mechanics.equations import equations_of
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import in_numpy
from tests.systems import double_pendulum_lagrangian

rng = np.random.default_rng(20)
# Of unit length.
OF_ARMS = {"m1": 1.5, "m2": 0.5, "l1": 1.0, "l2": 1.0, "g": 9.8125}


def a_of(system, t, q, v, params):
    """The accelerations of an unconstrained system."""
    solved = lambda *state: equations_of(model_of(system, *state)).accelerations(*state[:3])[0]
    return in_numpy(solved)(t, q, v, params)


def test_double_pendulum_accelerations():
    """The double pendulum at 50 random states, and its twin without the centrifugal term fails."""
    q, v = rng.normal(size=(2, 50, 2))
    m1, m2, g = 1.5, 0.5, 9.8125
    system = System(double_pendulum_lagrangian)
    solved = in_numpy(lambda q, v: equations_of(model_of(system, 0.0, q, v, OF_ARMS)).accelerations(0.0, q, v)[0])
    a = [solved(*state) for state in zip(q, v)]
    s, c = np.sin(q[:, 0] - q[:, 1]), np.cos(q[:, 0] - q[:, 1])

    def formula(centrifugal):
        # Strogatz-form equations solved for the two accelerations by Cramer's rule.
        b1 = -centrifugal * m2 * v[:, 1] ** 2 * s - (m1 + m2) * g * np.sin(q[:, 0])
        b2 = centrifugal * m2 * v[:, 0] ** 2 * s - m2 * g * np.sin(q[:, 1])
        determinant = m2 * (m1 + m2 - m2 * c**2)
        return np.stack([m2 * b1 - m2 * c * b2, (m1 + m2) * b2 - m2 * c * b1], axis=1) / determinant[:, None]

    np.testing.assert_allclose(a, formula(1.0), rtol=1e-11)
    assert np.max(np.abs(a - formula(0.0))) > 0.1


def test_magnetic_force():
    """A vector potential in L gives (e/m) v x B, with the right sign."""

    def charged(t, q, v, params):
        potential = 0.5 * jnp.cross(params["B"], q)
        return 0.5 * params["m"] * jnp.dot(v, v) + params["e"] * jnp.dot(v, potential)

    params = {"m": 2.0, "e": 0.5, "B": np.array([0.25, -1.0, 3.0])}
    q, v = rng.normal(size=(2, 3))
    a = a_of(System(charged), 0.0, q, v, params)
    np.testing.assert_allclose(a, 0.25 * np.cross(v, params["B"]), rtol=1e-13)


def test_relativistic_particle():
    """L = -m c² sqrt(1 - v²/c²) - V has M = m γ³ along the motion and m γ across it."""
    c, m, field = 2.0, 1.25, 0.75

    def lagrangian(t, q, v, params):
        return -m * c**2 * jnp.sqrt(1 - jnp.dot(v, v) / c**2) + field * q[0]

    v = np.array([1.5, 0.0])
    gamma = 1 / np.sqrt(1 - v[0] ** 2 / c**2)
    system = System(lagrangian)
    np.testing.assert_allclose(
        mass_matrix(system, 0.0, np.zeros(2), v, None), m * np.diag([gamma**3, gamma]), rtol=1e-13
    )
    np.testing.assert_allclose(
        a_of(system, 0.0, np.zeros(2), v, None), [field / (m * gamma**3), 0.0], rtol=1e-13, atol=1e-15
    )
    np.testing.assert_allclose(momentum(system, 0.0, np.zeros(2), v, None), m * gamma * v, rtol=1e-13)
    np.testing.assert_allclose(jacobi_integral(system, 0.0, np.zeros(2), v, None), m * gamma * c**2, rtol=1e-13)


def test_mass_matrix_by_name():
    """½ u·S u with u = (angle', r1', r2'), a number and a vector: blocks of S, each of the shape of its coordinates."""
    S = np.array([[2.0, 0.5, 0.25], [0.5, 3.0, -0.75], [0.25, -0.75, 4.0]])

    def kinetic(t, q, v, params):
        u = jnp.concatenate([v["angle"][None], v["r"]])
        return 0.5 * u @ params @ u

    at = {"r": np.zeros(2), "angle": 0.0}
    named = mass_matrix(System(kinetic), 0.0, at, at, S, by_name=True)
    np.testing.assert_allclose(named["r"]["angle"], S[1:, 0], rtol=1e-15)
    np.testing.assert_allclose(named["angle"]["r"], S[0, 1:], rtol=1e-15)
    np.testing.assert_allclose(named["r"]["r"], S[1:, 1:], rtol=1e-15)
    assert named["angle"]["angle"] == 2.0 and list(named) == list(named["r"]) == ["angle", "r"]


def test_a_total_time_derivative_changes_nothing():
    """L + dF(t, q)/dt has the same accelerations; adding F itself does not."""

    def bare(t, q, v, params):
        return 0.5 * jnp.dot(v, v) * (1 + q[0] ** 2) + jnp.sin(q[0] * q[1]) * jnp.cos(t)

    def gauge(t, q):
        return jnp.exp(0.5 * t) * q[0] ** 2 * q[1]

    def with_derivative(t, q, v, params):
        return bare(t, q, v, params) + jax.jvp(gauge, (t, q), (jnp.ones_like(t), v))[1]

    def with_value(t, q, v, params):
        return bare(t, q, v, params) + gauge(t, q)

    t, (q, v) = 0.375, rng.normal(size=(2, 2))
    expected, same, other = (a_of(System(f), t, q, v, None) for f in (bare, with_derivative, with_value))
    np.testing.assert_allclose(same, expected, rtol=1e-12)
    assert np.max(np.abs(other - expected)) > 0.1


def test_force_and_dissipation_signs():
    """Q enters as +Q, Rayleigh's ½ c v² as -c v."""
    system = System(
        lambda t, q, v, params: 0.5 * params["m"] * v**2,
        force=lambda t, q, v, params: params["F"] * jnp.cos(t),
        dissipation=lambda t, q, v, params: 0.5 * params["c"] * v**2,
    )
    a, _ = accelerations(system, 0.0, 0.0, 3.0, {"m": 2.0, "F": 5.0, "c": 0.5})
    assert float(a) == (5.0 - 0.5 * 3.0) / 2.0


def test_time_dependent_mass():
    """∂p/∂t counts: L = ½ e^(ct) v² gives a = -c v."""
    system = System(lambda t, q, v, params: 0.5 * jnp.exp(params * t) * v**2)
    a, _ = accelerations(system, 1.0, 0.0, 3.0, 0.25)
    np.testing.assert_allclose(a, -0.75, rtol=1e-14)
