"""Periodic orbits: by elliptic integrals, Kepler's law, a cycloid, SciPy, and the motions that `lj.integrate` makes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import lagjax as lj
from tests.analysis import closed_forms as known
from tests.analysis.closed_forms import VAN_DER_POL, van_der_pol
from tests.systems import PARAMS, pendulum, rod_pendulum

G_OVER_L = PARAMS["g"] / PARAMS["l"]


def closes(orbit, turned=0.0):
    """How far the motion of `lj.integrate` is from its start after the period, without its turns and shifts."""
    traj = orbit.trajectory
    gone = jax.tree.map(lambda x: x[-1] - x[0], traj.q)
    moved = jax.tree.map(lambda x, turns, shift: x - 2 * np.pi * turns - shift, gone, orbit.turns, orbit.shift)
    back = jax.tree.map(lambda x: x[-1] - x[0], traj.v)
    return max(float(np.max(np.abs(x))) for x in jax.tree.leaves((moved, back)))


# The pendulum.


@pytest.mark.parametrize(
    "hold", ["energy", *(pytest.param(x, marks=pytest.mark.exhaustive) for x in ("period", ("q", "v")))]
)
def test_pendulum(hold):
    """The held quantity stays; period and amplitude are those of the elliptic integral; twin: the others change."""
    guess = 0.9 * known.swinging(2.0) if hold != "period" else 1.02 * known.swinging(2.0)
    orbit = lj.periodic_orbit(pendulum, (2.0, 0.0), guess, PARAMS, hold=hold)
    assert bool(orbit.converged)
    amplitude = np.arccos(np.cos(orbit.q) - orbit.v**2 / (2 * G_OVER_L))
    np.testing.assert_allclose(orbit.period, known.swinging(amplitude), rtol=1e-11)
    if hold == "period":
        assert float(orbit.period) == guess and abs(amplitude - 2.0) > 1e-3
    else:
        np.testing.assert_allclose(amplitude, 2.0, rtol=1e-10)


@pytest.mark.exhaustive
def test_pendulum_that_goes_around():
    """It turns once in T = ∫ dφ / √(2 (E + cos φ)), counted automatically; twin: without a turn there is no orbit."""
    rate = 2.5 * np.sqrt(G_OVER_L)
    orbit = lj.periodic_orbit(pendulum, (0.0, rate), 1.0, PARAMS)
    energy = rate**2 / 2 - G_OVER_L
    exact = integrate.quad(lambda q: 1 / np.sqrt(2 * (energy + G_OVER_L * np.cos(q))), -np.pi, np.pi, epsabs=1e-13)[0]
    assert float(orbit.turns) == 1.0 and "turns     q +1" in repr(orbit)
    np.testing.assert_allclose(orbit.period, exact, rtol=1e-11)
    assert closes(orbit) < 1e-8
    with pytest.warns(lj.OrbitWarning, match="no periodic orbit was found near this start"):
        none = lj.periodic_orbit(pendulum, (0.0, rate), 1.0, PARAMS, turns={"q": 0}, most=12)
    assert not bool(none.converged) and "WARNING" in repr(none)


@pytest.mark.slow
@pytest.mark.parametrize("below", [1e-7, 1e-14])
def test_what_does_not_come_back_is_no_orbit(below):
    """So near the top that the motion amplifies any error to its own size, nothing has converged."""
    with pytest.warns(lj.OrbitWarning, match="no periodic orbit was found near this start"):
        orbit = lj.periodic_orbit(pendulum, (0.0, (2.0 - below) * np.sqrt(G_OVER_L)), 40.0 / np.sqrt(G_OVER_L), PARAMS)
    assert not bool(orbit.converged) and float(orbit.residual) > 1e-3 and "WARNING" in repr(orbit)


@pytest.mark.exhaustive
def test_pendulum_on_a_rod():
    """The same period with a constraint, which the orbit satisfies to round-off, from a start that violates it."""
    amplitude, l = 2.0, PARAMS["l"]
    start = {"x": l * np.sin(amplitude) + 0.01, "y": -l * np.cos(amplitude)}, {"x": 0.05, "y": 0.0}
    orbit = lj.periodic_orbit(rod_pendulum, start, 0.8 * known.swinging(amplitude), PARAMS)
    x, y, vx, vy = (float(z) for z in (orbit.q["x"], orbit.q["y"], orbit.v["x"], orbit.v["y"]))
    np.testing.assert_allclose([np.hypot(x, y), x * vx + y * vy], [l, 0.0], atol=1e-13)
    reached = np.arccos(-y / l - (vx**2 + vy**2) / (2 * PARAMS["g"] * l))
    np.testing.assert_allclose(orbit.period, known.swinging(reached), rtol=1e-11)
    found = lj.floquet(orbit)
    assert found.trivial.all() and found.multipliers.shape == (2,)


# Other families.


@pytest.mark.exhaustive
def test_kepler():
    """Every orbit of an energy has Kepler's period, found from a guess of two thirds of it: all multipliers are 1."""
    speed, mu = 1.25, 1.25
    exact = 2 * np.pi / np.sqrt(mu) * (2 - speed**2 / mu) ** -1.5
    orbit = lj.periodic_orbit(known.kepler, (np.array([1.0, 0.0]), np.array([0.0, speed])), 0.65 * exact, {"mu": mu})
    np.testing.assert_allclose(orbit.period, exact, rtol=1e-11)
    found = lj.floquet(orbit)
    np.testing.assert_allclose(found.multipliers, 1.0, atol=1e-5)
    assert found.trivial.sum() == 2 and bool(found.stable)
    # All orbits of an energy have one period: M - 1 has rank one, f times the slope of the energy.
    sizes = np.linalg.svd(found.monodromy - np.eye(4))[1]
    assert sizes[0] > 1 and np.all(sizes[1:] < 1e-7)
    line = np.asarray(orbit.plot().axes[0].lines[0].get_xydata())
    np.testing.assert_allclose(line[0], line[-1], atol=1e-7)
    assert np.ptp(line[:, 0]) > 1


def polar_lagrangian(t, q, v, p):
    """A unit mass attracted by r^power, in polar coordinates."""
    radius = q["r"]
    return 0.5 * (v["r"] ** 2 + (radius * v["phi"]) ** 2) - radius ** p["power"] / p["power"]


@pytest.mark.exhaustive
def test_relative_orbit():
    """In a central force r comes back and φ advances, both as by quadrature; twin: as a whole it does not close."""
    polar, power, speed = lj.System(polar_lagrangian), 1.0, 0.5
    start = {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": speed}
    orbit = lj.periodic_orbit(polar, start, 1.8, {"power": power}, relative="phi")
    r, w, vr = (float(x) for x in (orbit.q["r"], orbit.v["phi"], orbit.v["r"]))
    h, energy = r**2 * w, 0.5 * vr**2 + 0.5 * (r * w) ** 2 + r
    near, far = np.sort(np.roots([-1.0, energy, 0.0, -(h**2) / 2]).real)[-2:]
    # r = m + d sin s removes the square-root singularities at the ends.
    middle, half = (near + far) / 2, (far - near) / 2
    third = -(h**2) / 2 / (near * far)  # The cubic is -(r - near)(r - far)(r - third).

    def quadrature(f):
        radius = lambda s: middle + half * np.sin(s)
        speed = lambda r: np.sqrt(2 * (r - third)) / r
        return 2 * integrate.quad(lambda s: f(radius(s)) / speed(radius(s)), -np.pi / 2, np.pi / 2, epsabs=1e-13)[0]

    np.testing.assert_allclose(orbit.period, quadrature(lambda r: 1.0), rtol=1e-10)
    np.testing.assert_allclose(orbit.shift["phi"], quadrature(lambda r: h / r**2), rtol=1e-10)
    assert orbit.shift["r"] == 0 and abs(orbit.shift["phi"] - np.pi) > 0.1
    found = lj.floquet(orbit)
    assert found.trivial.all() and "shift of phi" in repr(found) and "across momenta of phi" in repr(found)


@pytest.mark.exhaustive
def test_knife_edge_on_a_slope():
    """A velocity constraint: the blade turns at ω and moves on a cycloid, sideways and not down the slope."""

    def lagrangian(t, q, v, p):
        return 0.5 * (v["x"] ** 2 + v["y"] ** 2 + p["I"] * v["turn"] ** 2) + p["slope"] * q["y"]

    def along(t, q, v, p):
        return v["y"] * jnp.cos(q["turn"]) - v["x"] * jnp.sin(q["turn"])

    blade = lj.System(lagrangian, {"edge": lj.Nonholonomic(along)})
    omega, slope = 1.25, 0.75
    start = {"x": 0.0, "y": 0.0, "turn": 0.0}, {"x": 0.1, "y": 0.0, "turn": omega}
    period = 2 * np.pi / omega
    orbit = lj.periodic_orbit(blade, start, 0.95 * period, {"I": 0.5, "slope": slope}, relative="x", hold="v.turn")
    np.testing.assert_allclose(orbit.period, period, rtol=1e-11)
    # Along it d²s/dt² = g sin ωt, so that dx/dt = -(g/ω) cos² ωt + v cos ωt: Neimark & Fufaev, §II.1.
    np.testing.assert_allclose(orbit.shift["x"], -slope * np.pi / omega**2, rtol=1e-10)
    assert orbit.turns["turn"] == 1
    found = lj.floquet(orbit)
    assert found.multipliers.shape == (5,) and "shift of x" in repr(found) and bool(found.stable)


# Derivatives, lanes.


@pytest.mark.exhaustive
def test_derivatives():
    """Of the period by g and the amplitude, both modes, as of the elliptic integral; twin: of small swings one is 0."""

    def period(x):
        orbit = lj.periodic_orbit(pendulum, (x[1], 0.0 * x[1]), 3.0, {"g": x[0], "l": PARAMS["l"]}, hold=("q", "v"))
        return orbit.period

    g, amplitude = PARAMS["g"], 2.0
    exact = [-known.swinging(amplitude) / (2 * g), known.slope_of_swinging(amplitude)]
    x = jnp.array([g, amplitude])
    for mode in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(jax.jit(mode(period))(x), exact, rtol=1e-8)
    assert abs(exact[1]) > 0.1


@pytest.mark.exhaustive
def test_lanes():
    """A batch over μ has the periods of the literature, and agrees with a single orbit."""
    mu = jnp.array([0.5, 1.0, 2.0])
    find = lambda mu: lj.periodic_orbit(known.van_der_pol, (2.0, 0.0), 6.5, {"mu": mu})
    lanes = jax.jit(jax.vmap(find))(mu)
    np.testing.assert_allclose(lanes.period[1:], [known.VAN_DER_POL[1.0], known.VAN_DER_POL[2.0]], rtol=1e-11)
    assert "3 lanes, 3 converged" in repr(lanes)
    alone = find(0.5)
    np.testing.assert_allclose([lanes.q[0], lanes.period[0]], [alone.q, alone.period], rtol=1e-9)


# Bad input, and searches that fail.

SIMPLE = {"start": (2.0, 0.0), "period": 6.0}
REFUSED = {
    "no pair": (pendulum, {"start": 2.0}, TypeError, r"start must be a pair \(q, v\), not 2.0"),
    "a period below zero": (pendulum, {"period": -1.0}, ValueError, "period must be one positive number"),
    "no such name": (
        pendulum,
        {"hold": "theta"},
        ValueError,
        "hold names 'theta', which is no coordinate or velocity; there are 'energy', 'period', 'q' and 'v'",
    ),
    "seen": (pendulum, {"relative": "q"}, ValueError, "the system depends on it"),
    "no angle of that name": (pendulum, {"turns": {"phi": 1}}, ValueError, "turns names 'phi'"),
    "damped": (known.duffing, {"hold": "energy"}, ValueError, "so the orbit has the period of the drive"),
    "a rounded period": (known.duffing, {}, ValueError, "the system is not the same after period = 6"),
}


@pytest.mark.parametrize("system, given, error, words", REFUSED.values(), ids=REFUSED)
def test_refused_in_words(system, given, error, words):
    """Bad arguments are refused, with a fix."""
    given = SIMPLE | given
    with pytest.raises(error, match=words) as raised:
        lj.periodic_orbit(system, given.pop("start"), given.pop("period"), PARAMS | known.DUFFING, **given)
    assert "Fix:" in str(raised.value)


# Shooting in parts, a stiff cycle, and where there is none.


def inverted_lagrangian(t, q, v, p):
    """A pendulum by its angle from the upward vertical, pushed back and forth."""
    return 0.5 * v**2 - p["k"] * jnp.cos(q) + p["f"] * q * jnp.cos(t)


@pytest.mark.exhaustive
def test_unstable_orbit_by_parts():
    """A pushed pendulum stays up for two periods of the push, in which neighbours leave it e^(4π)-fold.

    For small pushes f, q = -f cos(t)/(1 + k) up to f³; the motion from a guess of zero leaves it at once.
    """
    inverted, f = lj.System(inverted_lagrangian), 0.01
    orbit = lj.periodic_orbit(inverted, (0.0, 0.0), 4 * np.pi, {"k": 1.0, "f": f}, parts=8)
    assert bool(orbit.converged) and orbit.nodes.shape == (8, 2)
    np.testing.assert_allclose(orbit.q, -f / 2, atol=f**3)
    np.testing.assert_allclose(orbit.nodes[:, 0], -f / 2 * np.cos(np.pi / 2 * np.arange(8)), atol=f**3)
    found = lj.floquet(orbit)
    np.testing.assert_allclose(found.multipliers[0], np.exp(4 * np.pi), rtol=1e-3)
    np.testing.assert_allclose(found.product, 1.0, rtol=1e-5)
    assert not bool(found.stable)


@pytest.mark.exhaustive
def test_stiff_cycle():
    """Van der Pol's at μ = 10: states fall onto the cycle; the other multiplier is almost 0, and called unknown."""
    orbit = lj.periodic_orbit(van_der_pol, (2.0, 0.0), 18.0, {"mu": 10.0})
    np.testing.assert_allclose(orbit.period, VAN_DER_POL[10.0], atol=1e-8)
    found = lj.floquet(orbit)
    assert bool(found.attracts) and float(found.liouville) < 1e-100
    assert "1 of the multipliers is not known" in repr(found)
    # Twin: at μ = 1 the multiplier is 9e-4, and known.
    assert "not known" not in repr(lj.floquet(lj.periodic_orbit(van_der_pol, (2.0, 0.0), 6.5, {"mu": 1.0})))


@pytest.mark.exhaustive
def test_no_cycle_of_a_damped_pendulum():
    """There is only rest, which does not count as an orbit; the best candidate is returned, with a warning."""
    damped = lj.System(pendulum.lagrangian, dissipation=lambda t, q, v, p: 0.5 * p["c"] * v**2)
    with pytest.raises(ValueError, match="the Jacobi integral is not conserved here"):
        lj.periodic_orbit(damped, (2.0, 0.0), 3.0, PARAMS | {"c": 0.5}, hold="energy")
    with pytest.warns(lj.OrbitWarning, match="a state of rest"):
        orbit = lj.periodic_orbit(damped, (2.0, 0.0), 3.0, PARAMS | {"c": 0.5})
    assert not bool(orbit.converged) and np.isfinite(float(orbit.period)) and float(orbit.residual) > 1e-3
