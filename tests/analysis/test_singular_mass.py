"""Singular or indefinite mass matrices and singular coordinates: solved if possible, otherwise refused by name."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

# A massless crank: M is singular, but definite on the motions that the rod allows, except at its dead centres.


def crank_lagrangian(t, q, v, params):
    """L = ½ m ẋ² - ½ k x² + ½ κ l² sin²θ; θ has no kinetic energy."""
    slider = 0.5 * params["m"] * v["x"] ** 2 - 0.5 * params["k"] * q["x"] ** 2
    return slider + 0.5 * params["kappa"] * (params["l"] * jnp.sin(q["crank"])) ** 2


def rod(t, q, params):
    """x = l cos θ."""
    return q["x"] - params["l"] * jnp.cos(q["crank"])


crank = lj.System(crank_lagrangian, {"rod": lj.Holonomic(rod)})
CRANK = {"m": 1.5, "k": 2.0, "kappa": 1.25, "l": 1.5}


def crank_state(x, u):
    """Return (q, v) of the crank with its slider at x, moving at u."""
    angle = np.arccos(x / CRANK["l"])
    return {"crank": angle, "x": x}, {"crank": -u / (CRANK["l"] * np.sin(angle)), "x": u}


@pytest.mark.slow
def test_massless_crank():
    """θ's equation κ l² sin θ cos θ + λ l sin θ = 0 gives λ = -κ x, so that m x'' = -(k + κ) x. Twin: -k x."""
    a, multipliers = lj.accelerations(crank, 0.0, *crank_state(0.5, 1.0), CRANK)
    np.testing.assert_allclose(multipliers["rod"], -CRANK["kappa"] * 0.5, rtol=1e-12)
    np.testing.assert_allclose(a["x"], -(CRANK["k"] + CRANK["kappa"]) / CRANK["m"] * 0.5, rtol=1e-12)


# A charge in its proper time: M = m diag(-1, 1, 1) is indefinite. E along x, B along z, and a scalar field f x.


def covariant_lagrangian(tau, q, u, params):
    """L = ½ m η(u, u) + e A·u + f x, A = (E x, 0, B x), signature (-, +, +), c = 1."""
    e, x = params["e"], q["x"]
    kinetic = 0.5 * params["m"] * (-(u["t"] ** 2) + u["x"] ** 2 + u["y"] ** 2)
    return kinetic + e * (params["E"] * x * u["t"] + params["B"] * x * u["y"]) + params["f"] * x


def mass_shell(tau, q, u, params):
    """η(u, u) = -1."""
    return -(u["t"] ** 2) + u["x"] ** 2 + u["y"] ** 2 + 1


charge_on_shell = lj.System(covariant_lagrangian, {"shell": lj.Nonholonomic(mass_shell)})
MAGNET = {"m": 1.5, "e": 0.75, "E": 0.0, "B": 2.5, "f": 0.0}


@pytest.mark.slow
def test_charge_on_its_mass_shell():
    """Indefinite M under a nonlinear velocity constraint: m du/dτ = e F u, which keeps the shell, and a force.

    Source: Landau & Lifshitz, *The Classical Theory of Fields*, §23. The force f x̂ moves u = (cosh χ, sinh χ) by
    m dχ/dτ = f cosh χ under 2 μ u, 2 μ = f sinh χ. Twin: the sign of one E reversed, as for a positive metric.
    """
    by_name = lambda values: dict(zip("txy", values))

    def found(params, u):
        a, multipliers = lj.accelerations(charge_on_shell, 0.0, by_name(np.zeros(3)), by_name(u), params)
        return np.array([a[x] for x in "txy"]), float(multipliers["shell"])

    u, crossed = np.array([np.sqrt(1 + 0.75**2 + 1.25**2), 0.75, -1.25]), MAGNET | {"E": 1.5}
    F = lambda sign: np.array([[0, 1.5, 0], [sign * 1.5, 0, 2.5], [0, -2.5, 0]]) * crossed["e"] / crossed["m"]
    a, multiplier = found(crossed, u)
    np.testing.assert_allclose([*a, multiplier], [*F(1) @ u, 0.0], atol=1e-13)
    assert np.max(np.abs(F(-1) @ u - a)) > 1.0
    chi, f = -0.75, 0.5
    a, multiplier = found(MAGNET | {"B": 0.0, "f": f}, np.array([np.cosh(chi), np.sinh(chi), 0.0]))
    rate = f / MAGNET["m"] * np.cosh(chi) * np.array([np.sinh(chi), np.cosh(chi)])
    np.testing.assert_allclose([*a, multiplier], [*rate, 0.0, 0.5 * f * np.sinh(chi)], atol=1e-13)


# L homogeneous of degree one in v: p does not depend on |v|, so M v = 0 at every state.


def proper_time(s, q, v, params):
    """L = -(1 + k x) √(-η(v, v)): the same path for every parametrisation."""
    return -(1 + params["k"] * q["x"]) * jnp.sqrt(v["t"] ** 2 - v["x"] ** 2 - v["y"] ** 2)


paced = lj.System(proper_time)
PACED = ({"t": 0.0, "x": 0.0, "y": 0.0}, {"t": 1.25, "x": 0.5, "y": 0.25})


polar = lj.System(lambda t, q, v, params: 0.5 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2))


# What is refused: the system, a state where M is singular, the coordinate that is named, and a remedy.

DEAD_CENTRE = {"crank": 0.0, "x": CRANK["l"]}, {"crank": 0.25, "x": 0.0}
POLE = {"psi": 0.0, "theta": 0.25}, {"psi": 1.0, "theta": 0.0}
SINGULAR = {
    "the pole": (polar, POLE, None, "theta", "azimuth at the pole.*Cartesian"),
    "the dead centre": (crank, DEAD_CENTRE, CRANK, "crank", "Fix:"),
    "without a rod": (lj.System(crank_lagrangian), crank_state(0.5, 1.0), CRANK, "crank", "Fix:"),
    "an arbitrary parameter": (paced, PACED, {"k": 0.0}, "[txy]", "Fix:"),
    "the same with a force": (paced, PACED, {"k": 0.5}, "[txy]", "Fix:"),
}


def moved(system, t, q, v, params):
    """A motion from there."""
    return lj.integrate(system, q, v, params, ts=np.array([t, 1.0]), max_steps=256)


@pytest.mark.parametrize(
    ("name", "act"),
    [
        ("the pole", lj.accelerations),
        *(pytest.param(name, lj.accelerations, marks=pytest.mark.slow) for name in list(SINGULAR)[1:]),
        *(pytest.param(name, moved, marks=pytest.mark.exhaustive) for name in SINGULAR),
    ],
)
def test_what_is_refused(name, act):
    """Where M is singular along a motion that is allowed, the coordinate is named, with a remedy."""
    system, state, params, coordinate, remedy = SINGULAR[name]
    with pytest.raises((ValueError, RuntimeError), match=f"(?s)singular in coordinate '{coordinate}'.*{remedy}"):
        act(system, 0.0, *state, params)
