"""Singular or indefinite mass matrices and singular coordinates: solved if possible, otherwise refused by name."""

import itertools

import diffrax
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


# The azimuth is singular at the poles of a sphere; great circles are not.

polar = lj.System(lambda t, q, v, params: 0.5 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2))
NEAR_MISSES = (0.0, 1e-300, 1e-100, 1e-17, 1e-15, 1e-13, 1e-12, 1e-9, 1e-6, 1e-3)


def great_circle(miss, s):
    """The points at arc lengths s of the great circle that passes the pole at the distance `miss` at s = 0."""
    nearest, across = np.array([np.sin(miss), 0.0, np.cos(miss)]), np.array([0.0, 1.0, 0.0])
    return np.cos(s)[..., None] * nearest + np.sin(s)[..., None] * across


def polar_state(miss, s):
    """(q, v) of that great circle in colatitude and azimuth, to round-off however near the pole."""
    c, sine = np.cos(s), np.sin(s)
    distance = np.hypot(np.sin(miss) * c, sine)
    q = {"psi": np.arctan2(distance, np.cos(miss) * c), "theta": np.arctan2(sine, np.sin(miss) * c)}
    # sin²ψ dθ/ds = sin(miss), Clairaut.
    return q, {"psi": np.cos(miss) * sine / distance, "theta": np.sin(miss) / distance**2}


def distance_to_great_circle(traj, miss):
    """The largest distance, at the outputs, between a path in ψ and θ and its great circle."""
    psi, theta = np.asarray(traj.q["psi"]), np.asarray(traj.q["theta"])
    path = np.stack([np.sin(psi) * np.cos(theta), np.sin(psi) * np.sin(theta), np.cos(psi)], axis=-1)
    return np.max(np.abs(path - great_circle(miss, np.asarray(traj.t))))


@pytest.mark.exhaustive
def test_through_the_pole_or_not_at_all():
    """A path into the pole continues on its great circle, to the tolerance, or ends at the pole; nothing else."""
    outcomes, ts = [], np.array([-1.0, -0.25, 0.5, 1.25])
    for miss, tol, first in itertools.product(NEAR_MISSES, (1e-6, 1e-9, 1e-12), (-1.0, -0.77, -1.31)):
        settings = {"rtol": tol, "atol": tol, "throw": False}
        traj = lj.integrate(polar, *polar_state(miss, first), ts=np.array([first, *ts[1:]]), **settings)
        through = bool(traj.result == lj.RESULTS.successful)
        outcomes.append(through)
        if through:
            assert distance_to_great_circle(traj, miss) < 20 * tol, (miss, tol, first)
        else:
            assert abs(float(traj.end.t)) < 1e-12 and abs(float(traj.end.q["psi"])) < 1e-12, (miss, tol, first)
    # Twin: fixed steps that are too long for the passage leave the great circle.
    fixed = {"dt0": 0.125, "stepsize_controller": diffrax.ConstantStepSize()}
    assert distance_to_great_circle(lj.integrate(polar, *polar_state(0.05, -1.0), ts=ts, **fixed), 0.05) > 1e-3
    # Both outcomes occur, and the error says where.
    assert set(outcomes) == {True, False}
    with pytest.raises(RuntimeError, match=r"stopped at t = -?\d\.\d+e-14,(?s:.*)psi = \d\.\d+e-14, theta ="):
        lj.integrate(polar, *polar_state(1e-15, -1.0), ts=ts, rtol=1e-12, atol=1e-12)


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
