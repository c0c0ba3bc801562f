"""The wedge: every reference value, both ends of the mass ratio, the signs of the work."""

from pathlib import Path

import jax
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.equations import equations_of
from lagjax.scenes import sliding_wedge as wedge
from lagjax.system.model import model_of
from tests.by_numpy import by_numpy
from tests.references import keys, reference

T = 0.75
PARAMS = wedge.PARAMS
CASES = {
    "m/M=2^-40": {"m": 2.0**-40, "M": 1.0},
    "m/M=2^40": {"m": 2.0**40, "M": 1.0},
    "alpha=2^-30": {"alpha": 2.0**-30},
    "alpha=2^-20,m/M=2^40": {"alpha": 2.0**-20, "m": 2.0**40, "M": 1.0},
    "alpha=pi/2-2^-30 (exact real)": {"alpha": np.pi / 2 - 2.0**-30},
}
# Limits due to round-off. P_m = λ (ẋ sin α - ẏ cos α) cancels: by M/m for a light particle, by 1/α and α for an extreme
# angle; it is checked through -P_M below, which does not cancel. cos(π/2 - 2^-30) of the nearest double has a relative
# error of 7e-8 (π/2 is not a double), and so has everything proportional to cos α; the power is proportional to its
# square.
NOT_AT_1E_12 = {"alpha=pi/2-2^-30 (exact real)": 2e-7}


RATIOS, ANGLES = (x.ravel() for x in np.meshgrid(2.0 ** np.arange(-40, 41, 8), np.linspace(0.0, np.pi / 2, 9)))
GRID = [{"m": m, "M": 1.0, "alpha": alpha} for m, alpha in zip(RATIOS, ANGLES)]
CHANGES = {"": {}, **CASES, "massless": {"M": 0.0}, **dict(enumerate(GRID))}


@pytest.fixture(scope="module")
def solved():
    """Accelerations and multipliers at the start in all cases, by one program for lanes."""

    def at_the_start(params):
        start = 0.0, wedge.Q0, wedge.V0
        return equations_of(model_of(wedge.system, *start, params)).accelerations(*start)

    params = jax.tree.map(lambda *x: np.array(x), *(PARAMS | change for change in CHANGES.values()))
    lanes = by_numpy(jax.vmap(at_the_start))(params)
    return {name: jax.tree.map(lambda x, i=i: x[i], lanes) for i, name in enumerate(CHANGES)}


def named(a, multipliers, params):
    """The accelerations under the reference's names, with those along and across the incline."""
    s = np.sin(params["alpha"])
    x, y, X, force = float(a["x"]), float(a["y"]), float(a["X"]), float(multipliers["incline"])
    return {"xdd": x, "ydd": y, "Xdd": X, "lambda": force, "ldd": y / s, "P_m/t": force * X * s}


@pytest.mark.parametrize("case", CASES)
def test_extreme_accelerations(solved, case):
    """Accelerations, normal force and power at both ends of m/M and α, to 1e-12 except where round-off forbids it."""
    got = named(*solved[case], PARAMS | CASES[case])
    for name, value in got.items():
        allowed = NOT_AT_1E_12.get(case, 1e-12)
        assert abs(value / reference(f"s5.{case}.{name}") - 1) < allowed, name


def test_accelerations(solved):
    """The accelerations, the normal force, and their components along and across the incline."""
    a, multipliers = solved[""]
    s, c = np.sin(PARAMS["alpha"]), np.cos(PARAMS["alpha"])
    got = {
        "xdd": a["x"],
        "ydd": a["y"],
        "Xdd": a["X"],
        "lambda": multipliers["incline"],
        "ldd (acceleration relative to the wedge)": a["y"] / s,
        "a_s (lab, tangential) = g sin a": a["x"] * c + a["y"] * s,
        "a_n (lab, along N)": a["x"] * s - a["y"] * c,
        "floor_reaction": PARAMS["M"] * PARAMS["g"] + multipliers["incline"] * c,
    }
    for name, value in got.items():
        assert abs(float(value) / reference(f"s5.{name}") - 1) < 1e-12, name


def test_motion():
    """Positions, energies, power, work and momentum after 0.75 s, and the drop to y = 1, of the exact motion."""
    m, M, g = PARAMS["m"], PARAMS["M"], PARAMS["g"]
    s, a = np.sin(PARAMS["alpha"]), by_numpy(wedge.exact_accelerations)(PARAMS)
    exact = by_numpy(lambda q, v, t: wedge.exact_motion(PARAMS, q, v, t))
    drop = np.sqrt(2 / a.y)
    moving = wedge.start_on_incline(PARAMS, X=0.25, X_rate=0.5, along=0.125, along_rate=-0.75)
    (q, v), (qi, vi), (qd, vd) = exact(wedge.Q0, wedge.V0, T), exact(*moving, T), exact(wedge.Q0, wedge.V0, drop)
    on_particle, on_wedge = by_numpy(wedge.power_of_normal_force)(PARAMS, v, a.incline)
    kinetic_m, kinetic_M = 0.5 * m * (v["x"] ** 2 + v["y"] ** 2), 0.5 * M * v["X"] ** 2
    energy = by_numpy(lambda q, v: lj.jacobi_integral(wedge.system, T, q, v, PARAMS))
    got = {
        "x(t)": q["x"],
        "y(t)": q["y"],
        "X(t)": q["X"],
        "l(t)": q["y"] / s,
        "P_m(t)=dW_m/dt": on_particle,
        "P_M(t)=dW_M/dt": on_wedge,
        # Work-energy theorem: the normal force does the work that gravity's m g y does not.
        "W_m(0..t)": kinetic_m - m * g * q["y"],
        "W_M(0..t)": kinetic_M,
        "T_m(t)": kinetic_m,
        "T_M(t)": kinetic_M,
        "time to drop y=1": drop / np.sqrt(qd["y"]),
        "speed of mass at y=1": np.hypot(vd["x"], vd["y"]),
        "wedge speed at y=1": abs(vd["X"]),
        "init.x(t)": qi["x"],
        "init.X(t)": qi["X"],
        "init.p_x": wedge.horizontal_momentum(PARAMS, vi),
        "init.E": energy(qi, vi),
    }
    for name, value in got.items():
        assert abs(float(value) / reference(f"s5.{name}") - 1) < 1e-12, name
    assert abs(energy(q, v) - reference("s5.h=E")) < 1e-12
    assert abs(wedge.horizontal_momentum(PARAMS, v) - reference("s5.p_x(t)")) < 1e-12
    assert vi["y"] / (vi["x"] - vi["X"]) == pytest.approx(np.tan(PARAMS["alpha"]), rel=1e-12)


def test_signs_of_the_work(solved):
    """The normal force brakes the particle and drives the wedge; both signs of the source are wrong."""
    a, multipliers = solved[""]
    v = {name: T * x for name, x in a.items()}
    on_particle, on_wedge = by_numpy(wedge.power_of_normal_force)(PARAMS, v, multipliers["incline"])
    assert on_particle < 0 < on_wedge
    gained = 0.5 * PARAMS["M"] * v["X"] ** 2
    np.testing.assert_allclose(on_wedge, 2 * gained / T, rtol=1e-12)
    assert abs(-on_wedge - 2 * gained / T) > 1.0


def test_massless_wedge(solved):
    """M = 0: the mass matrix is singular, the equations are not; the particle falls freely, Ẍ = -g cot α."""
    a, multipliers = solved["massless"]
    np.testing.assert_allclose([a["x"], a["y"]], [0.0, PARAMS["g"]], atol=1e-15)
    np.testing.assert_allclose(a["X"], -PARAMS["g"] / np.tan(PARAMS["alpha"]), rtol=1e-14)
    assert abs(multipliers["incline"]) < 1e-14


def test_sweep_over_mass_ratio_and_angle(solved):
    """For m/M from 2^-40 to 2^40 and α from 0 to π/2 the closed form agrees everywhere, and is a motion."""
    exact = by_numpy(wedge.exact_accelerations)(PARAMS | {"m": RATIOS, "M": np.ones(RATIOS.shape), "alpha": ANGLES})
    for i, expected in enumerate(zip(exact.x, exact.y, exact.X, exact.incline)):
        a, multipliers = solved[i]
        got = a["x"], a["y"], a["X"], multipliers["incline"]
        np.testing.assert_allclose(got, expected, rtol=1e-12, atol=1e-300, err_msg=str(GRID[i]))


def test_every_reference_value_is_checked():
    """The tests above check all keys of §5."""
    source = Path(__file__).read_text()
    for key in keys("s5"):
        name = key.removeprefix("s5.")
        case = next((c for c in CASES if name.startswith(c + ".")), None)
        shown = name.removeprefix(case + ".") if case else name
        assert f'"{shown}"' in source or f'"s5.{shown}"' in source, key
