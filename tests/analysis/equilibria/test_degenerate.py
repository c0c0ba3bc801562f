"""Singular or indefinite mass matrices and singular coordinates: solved if possible, otherwise refused by name."""

import itertools

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

TIGHT = 1e-11


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
CRANK_RATE = np.sqrt((CRANK["k"] + CRANK["kappa"]) / CRANK["m"])
CRANK_TS = np.linspace(0.0, 6.0, 13)


def crank_state(x, u):
    """Return (q, v) of the crank with its slider at x, moving at u."""
    angle = np.arccos(x / CRANK["l"])
    return {"crank": angle, "x": x}, {"crank": -u / (CRANK["l"] * np.sin(angle)), "x": u}


@pytest.mark.exhaustive
def test_massless_crank():
    """θ's equation κ l² sin θ cos θ + λ l sin θ = 0 gives λ = -κ x, so x swings at √((k + κ)/m) and θ follows."""
    q0, v0 = crank_state(0.5, 1.0)
    traj = lj.integrate(crank, q0, v0, CRANK, ts=CRANK_TS, rtol=TIGHT, atol=TIGHT)
    x = 0.5 * np.cos(CRANK_RATE * CRANK_TS) + np.sin(CRANK_RATE * CRANK_TS) / CRANK_RATE
    np.testing.assert_allclose(traj.q["x"], x, atol=1e-10)
    np.testing.assert_allclose(traj.q["crank"], np.arccos(x / CRANK["l"]), atol=1e-10)
    np.testing.assert_allclose(traj.multipliers["rod"], -CRANK["kappa"] * x, atol=1e-10)
    # Twin: without the rod's force the slider would swing at √(k/m).
    slower = np.sqrt(CRANK["k"] / CRANK["m"])
    assert np.max(np.abs(x - 0.5 * np.cos(slower * CRANK_TS) - np.sin(slower * CRANK_TS) / slower)) > 0.5


@pytest.mark.exhaustive
def test_massless_crank_reaches_its_dead_centre():
    """If faster, the slider reaches l, where nothing determines θ: the error gives the time and place."""
    speed = 2.5
    reach, phase = np.hypot(0.5, speed / CRANK_RATE), np.arctan2(speed / CRANK_RATE, 0.5)
    dead_centre = (phase - np.arccos(CRANK["l"] / reach)) / CRANK_RATE
    where = rf"stopped at t = {dead_centre:.6f}\d*,(?s:.*)crank = \S+, x = 1\.5"
    with pytest.raises(RuntimeError, match=where):
        lj.integrate(crank, *crank_state(0.5, speed), CRANK, ts=CRANK_TS, rtol=TIGHT, atol=TIGHT)


# A charge in its proper time: M = m diag(-1, 1, 1) is indefinite. E along x, B along z, and a scalar field f x.


def covariant_lagrangian(tau, q, u, params):
    """L = ½ m η(u, u) + e A·u + f x, A = (E x, 0, B x), signature (-, +, +), c = 1."""
    e, x = params["e"], q["x"]
    kinetic = 0.5 * params["m"] * (-(u["t"] ** 2) + u["x"] ** 2 + u["y"] ** 2)
    return kinetic + e * (params["E"] * x * u["t"] + params["B"] * x * u["y"]) + params["f"] * x


def mass_shell(tau, q, u, params):
    """η(u, u) = -1."""
    return -(u["t"] ** 2) + u["x"] ** 2 + u["y"] ** 2 + 1


charge = lj.System(covariant_lagrangian)
charge_on_shell = lj.System(covariant_lagrangian, {"shell": lj.Nonholonomic(mass_shell)})
MAGNET = {"m": 1.5, "e": 0.75, "E": 0.0, "B": 2.5, "f": 0.0}
PROPER_TIMES = np.linspace(0.0, 4.0, 9)


def four_velocity(ux, uy):
    """Return u on the mass shell."""
    return np.array([np.sqrt(1 + ux**2 + uy**2), ux, uy])


def charge_exact(params, tau, start, flip=1.0):
    """(t, x, y) and u of a charge in crossed fields with B > E: du/dτ = F u, F³ = -κ² F, κ = (e/m) √(B² - E²).

    Source: Landau & Lifshitz, *The Classical Theory of Fields*, §21-22.
    """
    electric, magnetic = (params["e"] / params["m"] * params[name] for name in ("E", "B"))
    field = np.array([[0, electric, 0], [flip * electric, 0, magnetic], [0, -magnetic, 0]])
    k = np.sqrt(magnetic**2 - electric**2)
    once, twice = field @ start, field @ field @ start
    s, c = np.sin(k * tau)[:, None], np.cos(k * tau)[:, None]
    u = start + s / k * once + (1 - c) / k**2 * twice
    q = tau[:, None] * start + (1 - c) / k**2 * once + (k * tau[:, None] - s) / k**3 * twice
    return q, u


def scalar_exact(params, tau, first):
    """(t, x), u and μ on the mass shell in the scalar field alone: u = (sec s, tan s), s = f τ/m + s₀, 2 μ = f tan s.

    m du/dτ = f x̂ + 2 μ u, with μ such that η(u, u) stays: dχ/dτ = (f/m) cosh χ for the rapidity χ = gd⁻¹(s).
    """
    k = params["f"] / params["m"]
    s = first + k * tau
    q = np.stack([np.arcsinh(np.tan(s)) - np.arcsinh(np.tan(first)), np.log(np.cos(first) / np.cos(s))], axis=-1) / k
    return q, np.stack([1 / np.cos(s), np.tan(s)], axis=-1), 0.5 * params["f"] * np.tan(s)


def by_name(values):
    """A vector (t, x, y) by name."""
    return dict(zip("txy", values))


def stacked(tree):
    """Return curves, given by name, as one array."""
    return np.stack(list(tree.values()), axis=-1)


def on_shell(params, start, tol=TIGHT):
    """A trajectory of the charge on its mass shell, from the origin."""
    return lj.integrate(
        charge_on_shell, by_name(np.zeros(3)), by_name(start), params, ts=PROPER_TIMES, rtol=tol, atol=tol
    )


@pytest.mark.exhaustive
def test_charge_on_its_mass_shell():
    """Indefinite M under a nonlinear velocity constraint: cyclotron, crossed fields, a force that the shell alters."""
    start = four_velocity(0.75, -1.25)
    for params in (MAGNET, MAGNET | {"E": 1.5}):
        q, u = charge_exact(params, PROPER_TIMES, start)
        traj = on_shell(params, start)
        np.testing.assert_allclose(stacked(traj.q), q, atol=1e-10)
        np.testing.assert_allclose(stacked(traj.v), u, atol=1e-10)
        # Electromagnetic forces keep the mass shell by themselves.
        np.testing.assert_allclose(traj.multipliers["shell"], 0.0, atol=1e-12)
    # With the sign of one E reversed, as for a positive metric, the motion is another.
    assert np.max(np.abs(charge_exact(params, PROPER_TIMES, start, flip=-1.0)[0] - q)) > 1.0

    scalar, first = MAGNET | {"B": 0.0, "f": 0.5}, -0.75
    q, u, multiplier = scalar_exact(scalar, PROPER_TIMES, first)
    start = np.array([*u[0], 0.0])
    tight, loose = on_shell(scalar, start), on_shell(scalar, start, 1e-5)
    np.testing.assert_allclose(stacked(tight.q)[:, :2], q, atol=1e-10)
    np.testing.assert_allclose(stacked(tight.v)[:, :2], u, atol=1e-10)
    np.testing.assert_allclose(tight.multipliers["shell"], multiplier, atol=1e-10)
    assert np.max(np.abs(mass_shell(0.0, None, by_name(stacked(loose.v).T), None))) < 1e-12
    # Off the shell, u_x would grow in proportion to τ.
    assert np.max(np.abs(u[0, 1] + scalar["f"] / scalar["m"] * PROPER_TIMES - u[:, 1])) > 0.1


@pytest.mark.exhaustive
def test_cyclotron_without_its_mass_shell():
    """With the indefinite M alone: radius γ m v / (e B), rate e B / (γ m) in laboratory time; η(u, u) is constant."""
    start = four_velocity(0.75, -1.25)
    run = lambda params: lj.integrate(
        charge, by_name(np.zeros(3)), by_name(start), params, ts=PROPER_TIMES, rtol=TIGHT, atol=TIGHT
    )
    traj = run(MAGNET)
    t, x, y = stacked(traj.q).T
    gamma, rate = start[0], MAGNET["e"] * MAGNET["B"] / (MAGNET["m"] * start[0])
    np.testing.assert_allclose(t, gamma * PROPER_TIMES, rtol=1e-12)
    # ż = (u_x + i u_y)/γ turns clockwise.
    velocity = (start[1] + 1j * start[2]) / gamma
    np.testing.assert_allclose(x + 1j * y, velocity * (np.exp(-1j * rate * t) - 1) / (-1j * rate), atol=1e-10)
    crossed = run(MAGNET | {"E": 1.5})
    q, u = charge_exact(MAGNET | {"E": 1.5}, PROPER_TIMES, start)
    np.testing.assert_allclose(stacked(crossed.q), q, atol=1e-10)
    np.testing.assert_allclose(np.sum(np.array([-1, 1, 1]) * stacked(crossed.v) ** 2, axis=-1), -1.0, atol=1e-10)


# The same charge in laboratory time: L is not quadratic in v, M = ∂p/∂v grows as γ³.


def relativistic_lagrangian(t, q, v, params):
    """L = -m c² √(1 - v²/c²) - e (Φ - A·v), Φ = -E x, A = (0, B x)."""
    m, c, e = params["m"], params["c"], params["e"]
    return -m * c**2 * jnp.sqrt(1 - jnp.sum(v**2) / c**2) + e * q[0] * (params["E"] + params["B"] * v[1])


relativistic = lj.System(relativistic_lagrangian)
RELATIVISTIC = {"m": 1.5, "c": 2.0, "e": 0.75, "E": 0.0, "B": 0.0, "ux": -1.25, "uy": 0.75}


def hyperbolic(params, t):
    """Position in a uniform E: p grows in proportion to t, x = Δ(energy)/(e E), y by an inverse hyperbolic sine.

    Source: Landau & Lifshitz, *The Classical Theory of Fields*, §20.
    """
    m, c, force = params["m"], params["c"], params["e"] * params["E"]
    gamma = 1 / jnp.sqrt(1 - (params["ux"] ** 2 + params["uy"] ** 2) / c**2)
    px, py = m * gamma * params["ux"] + force * jnp.stack([jnp.zeros_like(t), t]), m * gamma * params["uy"]
    transverse = jnp.sqrt((m * c) ** 2 + py**2)
    x = c * jnp.sqrt(transverse**2 + px**2) / force
    y = py * c / force * jnp.arcsinh(px / transverse)
    return jnp.stack([x[1] - x[0], y[1] - y[0]])


def gyrating(params, t):
    """Position in a uniform B: a circle at the rate e B / (γ m)."""
    gamma = 1 / jnp.sqrt(1 - (params["ux"] ** 2 + params["uy"] ** 2) / params["c"] ** 2)
    rate = params["e"] * params["B"] / (gamma * params["m"])
    s, c = jnp.sin(rate * t) / rate, (1 - jnp.cos(rate * t)) / rate
    return jnp.stack([params["ux"] * s + params["uy"] * c, params["uy"] * s - params["ux"] * c])


@pytest.mark.exhaustive
def test_relativistic_charge():
    """Hyperbolic motion from γ = 1.5 to 4.5, and the circle in B, with derivatives with respect to every parameter."""
    t = jnp.asarray(12.0)

    def final(params):
        start = jnp.stack([params["ux"], params["uy"]])
        traj = lj.integrate(
            relativistic, jnp.zeros(2), start, params, ts=jnp.stack([0.0 * t, t]), rtol=TIGHT, atol=TIGHT
        )
        return traj.q[-1], (traj.q[-1], traj.v[-1])

    derivative = jax.jit(jax.jacfwd(final, has_aux=True))
    for fields, exact, absent in (({"E": 1.75}, hyperbolic, "B"), ({"B": 1.25}, gyrating, "E")):
        params = RELATIVISTIC | fields
        slopes, (q, v) = derivative(params)
        np.testing.assert_allclose(q, exact(params, t), atol=1e-9)
        np.testing.assert_allclose(v, jax.jacfwd(exact, argnums=1)(params, t), atol=1e-10)
        expected = jax.jacfwd(exact)(params, t)
        for name in set(params) - {absent}:
            np.testing.assert_allclose(slopes[name], expected[name], rtol=1e-9, atol=1e-9, err_msg=name)
        # Without relativity the derivative with respect to c would vanish.
        assert np.max(np.abs(expected["c"])) > 0.1


# L homogeneous of degree one in v: p does not depend on |v|, so M v = 0 at every state.


def proper_time(s, q, v, params):
    """L = -(1 + k x) √(-η(v, v)): the same path for every parametrisation."""
    return -(1 + params["k"] * q["x"]) * jnp.sqrt(v["t"] ** 2 - v["x"] ** 2 - v["y"] ** 2)


paced = lj.System(proper_time)
PACED = ({"t": 0.0, "x": 0.0, "y": 0.0}, {"t": 1.25, "x": 0.5, "y": 0.25})


# The azimuth is singular at the poles of a sphere; great circles are not.

polar = lj.System(lambda t, q, v, params: 0.5 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2))
embedded = lj.System(
    lambda t, q, v, params: 0.5 * jnp.sum(v**2), {"sphere": lj.Holonomic(lambda t, q, params: jnp.sum(q**2) - 1)}
)
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


@pytest.mark.exhaustive
def test_the_same_great_circle_in_cartesian_coordinates():
    """On |q| = 1 there is no pole: the motion passes through it, position and tension λ = -½ to the tolerance."""
    ts = np.linspace(-1.0, 1.25, 10)
    for miss in (0.0, 1e-12, 1e-6):
        start = great_circle(miss, np.array([-1.0, -1.0 + np.pi / 2]))
        traj = lj.integrate(embedded, *start, ts=ts, rtol=TIGHT, atol=TIGHT)
        np.testing.assert_allclose(traj.q, great_circle(miss, ts), atol=1e-10)
        np.testing.assert_allclose(traj.multipliers["sphere"], -0.5, atol=1e-11)
        assert float(traj.residual()) < 1e-14


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


@pytest.mark.parametrize(
    "name", ["the pole", *(pytest.param(name, marks=pytest.mark.slow) for name in list(SINGULAR)[1:])]
)
def test_accelerations_are_refused(name):
    """Where M is singular along a motion that is allowed, the coordinate is named, with a remedy."""
    system, state, params, coordinate, remedy = SINGULAR[name]
    with pytest.raises(ValueError, match=f"(?s)singular in coordinate '{coordinate}'.*{remedy}"):
        lj.accelerations(system, 0.0, *state, params)


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", SINGULAR)
def test_motions_are_refused(name):
    """Nor is such a system integrated."""
    system, state, params, coordinate, remedy = SINGULAR[name]
    with pytest.raises((ValueError, RuntimeError), match=f"(?s)singular in coordinate '{coordinate}'.*{remedy}"):
        lj.integrate(system, *state, params, ts=np.array([0.0, 1.0]), max_steps=256)
