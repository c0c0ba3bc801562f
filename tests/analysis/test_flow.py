"""Orbits with switches: bouncing, sticking and slipping, walking and striking, by closed forms and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

import lagjax as lj
from lagjax.integrate import HybridTrajectory

G = 9.8125

# A ball on a table that moves as A sin ωt: v after an impact is gT/2, and the table's velocity there W.


def table(t, q, v, p):
    """The height of the ball over the table."""
    return q - p["A"] * jnp.sin(p["omega"] * t)


def bounced(t, q, v, p):
    """The velocity after an impact: relative to the table it is -e times that before."""
    return -p["e"] * v + (1 + p["e"]) * p["A"] * p["omega"] * jnp.cos(p["omega"] * t)


def falling(t, q, v, p):
    """A unit mass that falls."""
    return 0.5 * v**2 - G * q


bouncing = lj.Hybrid({"flying": lj.System(falling)}, [lj.Switch("flying", to="flying", when=table, reset=bounced)])
bouncing_by_element = lj.System(
    falling, elements={"table": lj.Contact(lambda t, q, p: table(t, q, None, p), restitution=lambda p: p["e"])}
)
OMEGA, E = 8.0, 0.8
PERIOD = 2 * np.pi / OMEGA
# The fraction of the period after the impact at which the orbit starts.
AFTER = 0.3
PUSHES = G * PERIOD / 2 * (1 - E) / (1 + E)
# The largest amplitude at which a bounce in each period is stable; there a multiplier is -1.
FLIPS = np.hypot(PUSHES / OMEGA, 2 * G * (1 + E**2) / (1 + E) ** 2 / OMEGA**2)


def bounce(A):
    """t, q, v of the orbit at its start, and the trace of its monodromy matrix."""
    phase = np.arccos(PUSHES / (A * OMEGA))
    after = AFTER * PERIOD
    q = A * np.sin(phase) + G * PERIOD / 2 * after - G * after**2 / 2
    # A flight is [[1, τ], [0, 1]], and an impact [[-e, 0], [s, -e]].
    s = (1 + E) ** 2 * (G - A * OMEGA**2 * np.sin(phase)) / (G * PERIOD)
    return phase / OMEGA + after, q, G * PERIOD / 2 - G * after, -2 * E + PERIOD * s


def bounce_of(system, A):
    """The same by lagjax, from a start that is off; with its multipliers."""
    t, q, v, _ = bounce(A)
    orbit = lj.periodic_orbit(system, (1.01 * q, 0.98 * v), PERIOD, {"A": A, "omega": OMEGA, "e": E}, t=t)
    return orbit, lj.floquet(orbit)


@pytest.mark.exhaustive
def test_ball_on_a_moving_table():
    """One bounce in a period: state, M and the amplitude where it becomes unstable; twin: a table that is not curved.

    Holmes, *J. Sound Vib.* 84 (1982) 173, §3.
    """
    for A in (1.2 * PUSHES / OMEGA, 0.07, FLIPS):
        _, q, v, trace = bounce(A)
        orbit, found = bounce_of(bouncing, A)
        assert bool(orbit.converged) and int(orbit.switches.count) == 1 and "flying -> flying" in repr(orbit)
        np.testing.assert_allclose([orbit.q, orbit.v], [q, v], atol=1e-12)
        np.testing.assert_allclose(np.trace(found.monodromy), trace, atol=1e-10)
        np.testing.assert_allclose(found.product, E**2, rtol=1e-10)
        # Without the acceleration of the table.
        assert abs(trace - (1 + E**2)) > 0.1
    np.testing.assert_allclose(np.sort(found.multipliers.real), [-1.0, -(E**2)], atol=1e-9)
    stable = [bool(bounce_of(bouncing, FLIPS * (1 + off))[1].stable) for off in (-1e-6, 1e-6)]
    assert stable == [True, False] and np.isnan(found.log_volume) and "Liouville" not in repr(found)
    _refused(*bounce(FLIPS)[:3])


def _refused(t, q, v):
    """In the same program: a rounded period, no orbit near, and a state that does not come back."""
    params = {"A": FLIPS, "omega": OMEGA, "e": E}
    with pytest.raises(ValueError, match="the system is not the same after period = 0.79"):
        lj.periodic_orbit(bouncing, (q, v), 1.01 * PERIOD, params, t=t)
    with pytest.warns(lj.OrbitWarning, match="and 0 switches in it") as warned:
        none = lj.periodic_orbit(bouncing, (20.0, v), PERIOD, params, t=t)
    assert "Fix: a start between two switches" in str(warned[0].message) and "not converged" in repr(none)
    with pytest.raises(ValueError, match="does not come back after period"):
        lj.floquet(bouncing, t, q + 0.1, v, params, PERIOD)


@pytest.mark.exhaustive
def test_ball_on_a_moving_element():
    """The same orbit by an element."""
    A = 0.07
    _, q, v, trace = bounce(A)
    orbit, found = bounce_of(bouncing_by_element, A)
    np.testing.assert_allclose([orbit.q, orbit.v], [q, v], atol=1e-12)
    np.testing.assert_allclose(np.trace(found.monodromy), trace, atol=1e-10)
    assert "table is struck, then open" in repr(orbit)


@pytest.mark.exhaustive
def test_derivatives_and_lanes():
    """The start in lanes inside `jit`, and its derivative by A in both modes, against the closed form."""
    t, q, v, _ = bounce(0.07)

    def start(A):
        found = lj.periodic_orbit(bouncing, (q, v), PERIOD, {"A": A, "omega": OMEGA, "e": E}, t=t)
        return found.q

    def exact(A):
        # At the time t of the start of A = 0.07.
        phase = jnp.arccos(PUSHES / (A * OMEGA))
        after = t - phase / OMEGA
        return A * jnp.sin(phase) + G * PERIOD / 2 * after - G * after**2 / 2

    A = jnp.array([0.068, 0.07, 0.072])
    value, slope = jax.jit(jax.vmap(lambda A: (start(A), jax.jacfwd(start)(A))))(A)
    np.testing.assert_allclose(value, exact(A), atol=1e-11)
    np.testing.assert_allclose(slope, jax.vmap(jax.grad(exact))(A), rtol=1e-8)
    np.testing.assert_allclose(jax.jit(jax.grad(start))(0.07), slope[1], rtol=1e-9)


# A mass on a belt: the spring pulls it off where it reaches the force of sticking.


def block_lagrangian(t, q, v, p):
    """A unit mass on a spring."""
    return 0.5 * v**2 - 0.5 * p["k"] * q**2


def against_belt(t, q, v, p):
    """The velocity on the belt."""
    return v - p["V"]


coulomb = lj.Friction(against_belt, lambda p: p["mu"], normal=1.0, static=lambda p: p["static"])
block = lj.System(block_lagrangian, elements={"belt": coulomb})
BELT = {"k": 1.5, "V": 0.25, "mu": 0.5, "static": 1.0}


def stick_slip(p):
    """Its period: a wait of 2a/V, and a slip of 2π - 2 arctan(aω/V) over ω; a = (μ_s - μ)/k."""
    a, omega = (p["static"] - p["mu"]) / p["k"], np.sqrt(p["k"])
    return 2 * a / p["V"] + (2 * np.pi - 2 * np.arctan(a * omega / p["V"])) / omega


@pytest.mark.exhaustive
def test_stick_slip():
    """The period, from starts that stick or slip; multipliers 1 and 0; twin: with half the jump of μ."""
    exact = stick_slip(BELT)
    assert abs(exact - stick_slip(BELT | {"static": 0.75})) > 0.5
    for q, v in ((0.1, 0.25), (0.7, -0.1)):
        orbit = lj.periodic_orbit(block, (q, v), 1.1 * exact, BELT)
        np.testing.assert_allclose(orbit.period, exact, rtol=1e-11)
        found = lj.floquet(orbit)
        np.testing.assert_allclose(found.multipliers, [1.0, 0.0], atol=1e-9)
        assert found.trivial.tolist() == [True, False] and bool(found.attracts)
        assert "belt sticks" in repr(orbit) and "0 within the errors of M, as after sticking" in repr(found)
        assert isinstance(orbit.trajectory, HybridTrajectory)


# A rimless wheel that walks down a slope.


def spoke(t, q, v, p):
    """A point mass on a spoke that leans by q."""
    return 0.5 * p["l"] ** 2 * v**2 - p["l"] * p["g"] * jnp.cos(q)


def touches_down(t, q, v, p):
    """How far the wheel must turn until the next spoke touches."""
    return p["slope"] + p["alpha"] - q


def next_spoke(t, q, v, p):
    """The same wheel by its next spoke, whose end is struck without a rebound."""
    return q - 2 * p["alpha"], jnp.cos(2 * p["alpha"]) * v


wheel = lj.Hybrid(
    {"rolling": lj.System(spoke)}, [lj.Switch("rolling", to="rolling", when=touches_down, reset=next_spoke)]
)
WHEEL = {"l": 1.0, "g": G, "slope": 0.125, "alpha": 0.3}


@pytest.mark.exhaustive
def test_rimless_wheel():
    """The speed after a step, ω² = 4 g/l sin γ sin α cot² 2α, the period by quadrature, and the multiplier cos² 2α.

    McGeer, *Int. J. Robotics Res.* 9 (1990) 62, §2. Twin: without the loss there is no such orbit.
    """
    l, g, slope, alpha = WHEEL.values()
    gain = 4 * g / l * np.sin(slope) * np.sin(alpha)
    first = gain / np.tan(2 * alpha) ** 2
    speed = lambda q: np.sqrt(first + 2 * g / l * (np.cos(slope - alpha) - np.cos(q)))
    exact = integrate.quad(lambda q: 1 / speed(q), slope - alpha, slope + alpha, epsabs=1e-13)[0]
    orbit = lj.periodic_orbit(wheel, (0.05, 0.9 * speed(0.05)), 0.9 * exact, WHEEL)
    assert bool(orbit.converged)
    np.testing.assert_allclose(orbit.period, exact, rtol=1e-11)
    np.testing.assert_allclose(orbit.v, speed(orbit.q), rtol=1e-11)
    found = lj.floquet(orbit)
    np.testing.assert_allclose(found.multipliers, [1.0, np.cos(2 * alpha) ** 2], rtol=1e-9)
    assert found.trivial.tolist() == [True, False]
    with pytest.warns(lj.OrbitWarning):
        lj.periodic_orbit(wheel, (0.05, 2.0), 0.9 * exact, WHEEL | {"slope": -0.125})
    with pytest.raises(ValueError, match="a guard of phase 'rolling' is below zero at the start"):
        lj.periodic_orbit(wheel, (1.0, 2.0), exact, WHEEL)


def driven(t, q, v, p):
    """A unit mass on a spring with a driving force."""
    return 0.5 * v**2 - 0.5 * q**2 + p["f"] * q * jnp.cos(p["omega"] * t)


def damping(t, q, v, p):
    """Linear damping."""
    return 0.5 * p["c"] * v**2


wall = lj.Stop(lambda t, q, p: q, high=0.1, restitution=lambda p: p["e"])
striking = lj.System(driven, dissipation=damping, elements={"wall": wall})
