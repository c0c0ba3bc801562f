"""The carriage on the rotating rails: two frames, modes and stability, the energy balance, gradients.

Formulas are evaluated in NumPy; `python -m lagjax` integrates.
"""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lagjax.mechanics.lagrangian import jacobi_integral, momentum
from lagjax.report import relative_error
from lagjax.scenes import cross_rails as scene
from lagjax.system.system import System
from tests.by_numpy import by_numpy, equations
from tests.references import keys, reference

PARAMS, Q0, V0 = scene.PARAMS, scene.Q0, scene.V0
AT = {
    "2.5": PARAMS,
    "5": PARAMS | {"omega": 5.0},
    "8": PARAMS | {"omega": 8.0},
    "critical": PARAMS | {"omega": float(np.sqrt(40.0))},
}
ISOTROPIC = PARAMS | {"K": 8.0, "omega": 3.0}
exact_motion = by_numpy(scene.exact_motion)
balance = by_numpy(scene.balance)
mode_squares = by_numpy(scene.mode_squares)


def _state_values(stem, params, q, v):
    """The keys of one instant of a motion."""
    books = scene.balance(params, q, v)
    return {
        **{f"{stem}.{name}({{t}})": value for name, value in (("R", q["R"]), ("r", q["r"]))},
        **{f"{stem}.{name}dot({{t}})": value for name, value in (("R", v["R"]), ("r", v["r"]))},
        f"{stem}.E({{t}})": books.E,
        f"{stem}.dEdt({{t}})": books.power,
    }


def _motion_values(motion):
    """The keys of all instants, from `motion(params, t)` in the rotating coordinates."""
    values = {}
    for speed in ("2.5", "8"):
        for t in (1.0, 10.0):
            found = _state_values(f"s6.w={speed}", AT[speed], *motion(AT[speed], t))
            values |= {key.format(t=f"t={t:g}"): value for key, value in found.items()}
    q, v = motion(AT["critical"], 1.0)
    values |= {f"s6.w^2=K/m.{name}(t=1)": q[name] for name in q}
    return values | {f"s6.w^2=K/m.{name}dot(t=1)": v[name] for name in v}


def _single_evaluations():
    """The value of every key of the section, from a closed form."""
    values = _motion_values(lambda params, t: scene.exact_motion(params, Q0, V0, t))
    for speed in ("2.5", "8"):
        books = scene.balance(AT[speed], Q0, V0)
        values |= {
            f"s6.w={speed}.E(0)": books.E,
            f"s6.w={speed}.hprime": books.h,
            f"s6.w={speed}.Lz(0)": books.L_z,
            f"s6.w={speed}.dEdt(0)": books.power,
        }
    for speed in ("2.5", "5", "8"):
        squares = scene.mode_squares(AT[speed])
        values[f"s6.w={speed}.R_eq"] = scene.equilibrium_length(AT[speed])
        values[f"s6.w={speed}.Omega_fast"] = jnp.sqrt(squares.fast)
        if speed == "5":
            values["s6.w=5.growth_rate"] = jnp.sqrt(-squares.slow)
        else:
            values[f"s6.w={speed}.Omega_slow"] = jnp.sqrt(squares.slow)
    isotropic = scene.mode_squares(ISOTROPIC)
    values["s6.isotropic(k/m=16,w=3).fast"] = jnp.sqrt(isotropic.fast)
    values["s6.isotropic.slow"] = jnp.sqrt(isotropic.slow)
    names = ("s6.strip.max_growth", "s6.strip.max_growth_at_w")
    values |= dict(zip(names, scene.strongest_growth(PARAMS)))
    values |= dict(zip(("s6.critical_speed_low", "s6.critical_speed_high"), scene.critical_speeds(PARAMS)))
    names = ("s6.w^2=K/m.secular_R_accel", "s6.w^2=K/m.secular_r_rate")
    return values | dict(zip(names, scene.escape(PARAMS)))


def seed_lagrangian(t, q, v, params):
    """The Lagrangian whose equations are the source's printed ones: Coriolis with the factor 1."""
    omega = params["omega"]
    half = 0.5 * params["m"] * omega * (q["R"] * v["r"] - q["r"] * v["R"])
    return scene.rotating_lagrangian(t, q, v, params) - half


seed_system = System(seed_lagrangian)


def test_every_reference_value():
    """Each key of the section agrees with its closed form to 1e-12, and none is omitted."""
    values = by_numpy(_single_evaluations)()
    assert set(values) == set(keys("s6"))
    for key, value in values.items():
        assert float(value) == pytest.approx(reference(key), rel=1e-12, abs=0), key


def test_exact_motion_is_the_matrix_exponential():
    """Sylvester's formula agrees with the exponential of the augmented 5 x 5 matrix at all kinds of speed."""
    for omega in (0.0, 2.5, 4.0, 4.0 + 2.0**-30, 5.0, float(np.sqrt(40.0)), 8.0, -3.0):
        for K in (20.0, 8.0):
            params = PARAMS | {"omega": omega, "K": K}
            kappa, Kappa = params["k"] / params["m"], K / params["m"]
            rows = np.eye(5, k=2)[:2], [[0, 0, 0, 2 * omega, Kappa * params["R0"]], [0, 0, -2 * omega, 0, 0], 5 * [0]]
            matrix = mpmath.matrix(np.concatenate(rows).tolist())
            matrix[2, 0], matrix[3, 1] = mpmath.mpf(omega) ** 2 - Kappa, mpmath.mpf(omega) ** 2 - kappa
            with mpmath.workdps(40):
                z = mpmath.expm(3 * matrix) * mpmath.matrix([1, 0.125, 0.25, -0.5, 1])
            q, v = exact_motion(params, Q0, V0, 3.0)
            got = np.array([q["R"], q["r"], v["R"], v["r"]])
            expected = np.array([float(x) for x in z[:4]])
            assert np.max(np.abs(got - expected)) < 1e-12 * np.max(np.abs(expected)), (omega, K)


def test_books_balance_at_random_states():
    """dL_z/dt = τ, dE/dt = ωτ, dh'/dt = 0, h' = E - ωL_z; the factor-1 equations fail the first two, not the third."""
    rng = np.random.default_rng(6)
    rates = by_numpy(lambda params, q, v, a: jax.jvp(lambda q, v: scene.balance(params, q, v), (q, v), (v, a))[1])
    of_system = by_numpy(lambda q, v, params: jacobi_integral(scene.rotating_system, 0.0, q, v, params))
    for _ in range(3):
        R, r, R_rate, r_rate, omega = rng.uniform(-2.0, 2.0, 5)
        params = PARAMS | {"omega": omega}
        q, v = {"R": R, "r": r}, {"R": R_rate, "r": r_rate}
        books = balance(params, q, v)
        assert float(books.h) == pytest.approx(float(books.E - omega * books.L_z), rel=1e-12)
        assert float(books.h) == pytest.approx(float(of_system(q, v, params)))
        for system, right in ((scene.rotating_system, True), (seed_system, False)):
            rate = rates(params, q, v, equations(system, 0.0, q, v, params).a)
            scale = abs(books.power) + abs(books.torque)
            assert abs(rate.h) < 1e-12 * scale
            assert (abs(rate.L_z - books.torque) < 1e-12 * scale) == right
            assert (abs(rate.E - books.power) < 1e-12 * scale) == right


def test_lab_lagrangian_and_printed_kinetic_energy():
    """The two forms of L are the same function of the motion, including m; T without m is detected."""
    t, params = 0.7, PARAMS
    q, v = by_numpy(scene.to_lab)(params, t, Q0, V0)
    L = float(by_numpy(scene.rotating_lagrangian)(t, Q0, V0, params))
    assert by_numpy(scene.lab_lagrangian)(t, q, v, params) == pytest.approx(L, rel=1e-13)
    T = 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2)
    assert abs(T / params["m"] - T) > 0.1 * abs(L)
    assert relative_error(by_numpy(scene.to_rotating)(params, t, q, v), (Q0, V0)) < 1e-14
    energy = by_numpy(lambda q, v: jacobi_integral(scene.lab_system, t, q, v, params))(q, v)
    assert energy == pytest.approx(float(balance(params, Q0, V0).E), rel=1e-13)
    p = by_numpy(lambda q, v, params: momentum(scene.rotating_system, t, q, v, params))(Q0, V0, params)
    assert Q0["R"] * p["r"] - Q0["r"] * p["R"] == pytest.approx(reference("s6.w=2.5.Lz(0)"), rel=1e-14)


def test_equations_and_equilibrium():
    """The accelerations have the factor 2; R_eq is a solution, above R0 below K/m, and beyond the axis above K/m."""
    rest = {"R": 0.0, "r": 0.0}
    for params in (PARAMS, AT["8"]):
        length = float(by_numpy(scene.equilibrium_length)(params))
        states = (Q0, V0), (Q0, rest), ({"R": length, "r": 0.0}, rest)
        a, still, there = (equations(scene.rotating_system, 0.0, *state, params).a for state in states)
        turning = 2 * params["omega"] * np.array([V0["r"], -V0["R"]])
        np.testing.assert_allclose([a["R"] - still["R"], a["r"] - still["r"]], turning, rtol=1e-12)
        assert abs(there["R"]) < 1e-12 * params["K"] / params["m"] and there["r"] == 0.0
        assert length > PARAMS["R0"] if params is PARAMS else length < 0.0


def test_modes_and_verdict():
    """Modes are the eigenvalues of the linear equations, the verdict their growth; factor 1 gives other modes."""
    rng, is_stable = np.random.default_rng(7), by_numpy(scene.is_stable)
    for m, K, k, omega in rng.uniform(0.2, 5.0, (40, 4)):
        params = PARAMS | {"m": m, "K": K, "k": k, "omega": omega}
        block = np.array([[omega**2 - K / m, 0.0], [0.0, omega**2 - k / m]])
        turn = np.array([[0.0, 2 * omega], [-2 * omega, 0.0]])
        modes = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [block, turn]]))
        squares, stable = mode_squares(params), is_stable(params)
        expected = sorted(np.real(-(modes**2)))
        np.testing.assert_allclose(expected[::3], [squares.slow, squares.fast], rtol=1e-8, atol=1e-10)
        assert bool(stable) == (np.max(modes.real) < 1e-6)
        wrong = np.linalg.eigvals(np.block([[np.zeros((2, 2)), np.eye(2)], [block, 0.5 * turn]]))
        assert np.min(np.abs(wrong[:, None] ** 2 + squares.fast)) > 1e-3
    # The strongest growth is a maximum over ω.
    rate, speed = by_numpy(scene.strongest_growth)(PARAMS)
    near = np.sqrt([-mode_squares(PARAMS | {"omega": speed * x}).slow for x in (0.99, 1.0, 1.01)])
    assert near[1] == pytest.approx(float(rate), rel=1e-12) and np.max(near) == near[1]


def test_slow_mode_near_a_critical_speed():
    """Next to ω² = k/m the slow mode is accurate, while the difference of half sum and root has lost its digits."""
    for step in (-(2.0**-44), 2.0**-44):
        params = PARAMS | {"omega": 4.0 * (1 + step)}
        with mpmath.workdps(60):
            squared = mpmath.mpf(params["omega"]) ** 2
            half_sum, product = 28 + squared, (16 - squared) * (40 - squared)
            exact = float(half_sum - mpmath.sqrt(half_sum**2 - product))
        assert float(mode_squares(params).slow) == pytest.approx(exact, rel=1e-12)
        half_sum = 28 + params["omega"] ** 2
        by_difference = half_sum - np.sqrt(half_sum**2 - (16 - params["omega"] ** 2) * (40 - params["omega"] ** 2))
        assert abs(by_difference / exact - 1) > 1e-6
