"""The rolling hoop against its closed forms and the reference values of source §2."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from lagjax.integrate.integrate import integrate
from lagjax.mechanics.constrained_state import accelerations
from lagjax.scenes import rolling_hoop as hoop
from tests.by_numpy import by_numpy, equations
from tests.references import keys, reference
from tests.tiers import exhaustive_but

TOP, PARAMS = hoop.TOP, hoop.PARAMS
HOOP_REST = "s2.hoop.theta0=1.25."

# Other tests cover slipping and sliding friction; the energy check belongs to the reference's own computation.
EXCLUDED = {key for key in keys("s2") if "fric" in key} | {"s2.hoop.energy_check"}


def shape(name):
    """The parameters with the moment of inertia of a named body."""
    return PARAMS | {"beta": hoop.SHAPES[name]}


def single_evaluations():
    """Every key of a closed form, with the value that the scene gives."""
    got = {}
    for theta in (1.25, 1.0, 0.75, 0.625):
        force = hoop.exact_multipliers(PARAMS, theta, TOP)
        at = f"s2.top.theta={theta}."
        got[at + "thetadot"] = hoop.exact_rate(PARAMS, theta, TOP)
        got[at + "lambda"], got[at + "mu"] = force
        got[at + "mu/lambda"] = force.rolling / force.contact
    got["s2.top.depart_angle_deg"] = np.degrees(np.arcsin(hoop.departure_sine(PARAMS, TOP)))
    for name in hoop.SHAPES:
        sine = hoop.departure_sine(shape(name), TOP)
        got[f"s2.{name}.sin_depart_from_top"] = sine
        got[f"s2.{name}.depart_angle_deg"] = np.degrees(np.arcsin(sine))
        got[f"s2.{name}.depart_angle_from_theta0=1.25_rad"] = np.arcsin(hoop.departure_sine(shape(name), 1.25))
    got["s2.hoop.theta0=1.25,thetadot0=-1.5.depart_rad"] = np.arcsin(hoop.departure_sine(PARAMS, 1.25, -1.5))
    for name in ("hoop", "sphere"):
        for power in (3, 10, 20):
            got[f"s2.{name}.tdep.start_pi/2-2^-{power}"] = hoop.departure_time(shape(name), 2.0**-power)
        got[f"s2.{name}.tdep.start_theta0=1.25"] = hoop.departure_time(shape(name), TOP - 1.25)
    got["s2.hoop.tdep.asymptotic_2^-20"] = np.log(8 * np.tan(np.pi / 12) * 2.0**20) / hoop.rate(PARAMS)
    q, v = hoop.exact_motion(PARAMS, 1.25, 0.5)
    got[HOOP_REST + "theta(t=0.5)"], got[HOOP_REST + "thetadot(t=0.5)"] = q["theta"], v["theta"]
    at_start = hoop.exact_multipliers(PARAMS, 1.25, 1.25)
    got["s2.hoop.rest_start_theta0=1.25.mus_needed_at_start"] = at_start.rolling / at_start.contact
    left = hoop.leaving(PARAMS, TOP)
    got["s2.depart.speed"] = np.hypot(left.vx, left.vy)
    got |= {f"s2.depart.{name}": getattr(left, name) for name in ("x", "y", "vx", "vy")}
    got["s2.depart.spin_phidot"] = left.spin
    later, landing = hoop.flight(PARAMS, left, 0.25), hoop.time_to_floor(PARAMS, left)
    got["s2.parabola.x(0.25)"], got["s2.parabola.y(0.25)"] = later.x, later.y
    got["s2.parabola.rho^2(0.25)"] = later.x**2 + later.y**2
    got["s2.parabola.time_to_floor(y=-R+a)"] = landing
    got["s2.parabola.x_at_floor"] = hoop.flight(PARAMS, left, landing).x
    return got


def test_closed_forms_match_the_references():
    """Forces, departures, elliptic motion and flight agree with the references to 1e-12."""
    found = single_evaluations()
    for key, value in found.items():
        assert float(value) == pytest.approx(reference(key), rel=1e-12), key
    # No key of §2 is omitted except those of slipping.
    assert set(found) == set(keys("s2")) - EXCLUDED


def test_multipliers_from_the_lagrangian():
    """The saddle-point solve gives the closed λ and μ to 1e-12, and not those of another inertia or sign."""
    for beta in hoop.SHAPES.values():
        params = PARAMS | {"beta": beta}
        for theta in (1.2, 0.6, -0.4):
            rate = hoop.exact_rate(params, theta, 1.25)
            q, v = hoop.start(params, theta, rate)
            assert (hoop.contact(0.0, q, params), abs(hoop.rolling(0.0, q, v, params)) < 1e-14) == (0.0, True)
            a, got = accelerations(hoop.system, 0.0, q, v, params)
            exact = hoop.exact_multipliers(params, theta, 1.25)
            assert float(got["contact"]) == pytest.approx(float(exact.contact), rel=1e-12)
            assert float(got["rolling"]) == pytest.approx(float(exact.rolling), rel=1e-12, abs=1e-14)
            assert float(a["theta"]) == pytest.approx(-(float(hoop.rate(params)) ** 2) * np.cos(theta), rel=1e-12)
            wrong = hoop.exact_multipliers(params | {"beta": beta + 0.1}, theta, 1.25)
            assert float(got["contact"]) != pytest.approx(float(wrong.contact), rel=1e-4)
            assert float(a["theta"]) != pytest.approx(float(hoop.rate(params)) ** 2 * np.cos(theta), rel=1e-3)


def test_flight_is_the_same_lagrangian_without_constraints():
    """Unconstrained, the parabola is a motion in polar coordinates."""
    left = by_numpy(hoop.leaving)(PARAMS, TOP)

    def at(t):
        return hoop.flight_in_polar(hoop.flight(PARAMS, left, t), PARAMS)

    (q, v), (rate, second) = by_numpy(lambda t: jax.jvp(at, (t,), (1.0,)))(0.25)
    a = equations(hoop.in_flight, 0.0, q, v, PARAMS).a
    for name in ("r", "theta"):
        assert [rate[name], second[name]] == pytest.approx([float(v[name]), float(a[name])], rel=1e-12)
    assert a["phi"] == 0.0 and v["phi"] == left.spin
    assert q["r"] ** 2 == pytest.approx(reference("s2.parabola.rho^2(0.25)"), rel=1e-13)


@pytest.mark.parametrize("theta, theta_rate", [(1.25, -3.0), (-0.5, 0.0), (3.5, 0.0)])
def test_a_start_without_contact_is_refused(theta, theta_rate):
    """A negative normal force at the start raises, with its value and what to do."""
    with pytest.raises(ValueError, match="not held by the cylinder.*\n.*in_flight"):
        hoop.roll(PARAMS, theta, theta_rate, np.array([0.0, 1.0]))


def exact_final(params):
    """θ and λ at t = 0.5 near PARAMS: from rest, θ depends on the parameters through w alone."""
    theta, theta_rate = (reference(HOOP_REST + name) for name in ("theta(t=0.5)", "thetadot(t=0.5)"))
    stretch = hoop.rate(params) / hoop.rate(PARAMS) - 1
    theta = theta + theta_rate * 0.5 * stretch
    return jnp.stack([theta, hoop.exact_multipliers(params, theta, 1.25).contact])


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", exhaustive_but((jax.jacrev,), (jax.jacfwd, jax.jacrev)))
def test_gradients(mode):
    """∂(θ, λ)/∂(m, R, a, g, β) at t = 0.5 agrees with the exact one to 1e-6."""
    ts = np.array([0.0, 0.5])

    def final(params):
        start = hoop.start(params, 1.25, 0.0)
        got = integrate(hoop.system, *start, params, ts=ts, rtol=1e-10, atol=1e-10)
        return jnp.stack([got.q["theta"][-1], got.multipliers["contact"][-1]])

    params = jax.tree.map(jnp.asarray, PARAMS)
    got, exact = jax.jit(mode(final))(params), jax.jacfwd(exact_final)(params)
    for name in PARAMS:
        assert np.allclose(got[name], exact[name], rtol=1e-6, atol=1e-9), name
        wrong = exact[name] * np.array([-1.0, 1.1])
        assert not np.allclose(got[name], wrong, rtol=1e-3, atol=1e-9), name


def departure_time_by_mpmath(beta):
    """The time from rest at 1.25 to the departure, from Legendre's integrals with 30 digits."""
    with mpmath.workdps(30):
        tilt = mpmath.mpf(float(TOP)) - mpmath.mpf("1.25")
        end = mpmath.acos(2 * mpmath.cos(tilt) / (3 + beta))
        k = mpmath.cos(tilt / 2)
        w = mpmath.sqrt(mpmath.mpf(PARAMS["g"]) / ((1 + beta) * mpmath.mpf("1.25")))
        return (mpmath.ellipk(k**2) - mpmath.ellipf(mpmath.asin(mpmath.cos(end / 2) / k), k**2)) / w


@pytest.mark.exhaustive
def test_gradients_of_the_departure_time():
    """∂t_d/∂(m, R, a, g, β) of the event to 1e-6: forward and in reverse against the exact one."""
    ts = np.array([0.0, 2.0])

    def when(params):
        start = hoop.start(params, 1.25)
        return integrate(hoop.system, *start, params, ts=ts, rtol=1e-10, atol=1e-10, events=hoop.DEPARTURE).end.t

    t, length = reference("s2.hoop.tdep.start_theta0=1.25"), PARAMS["R"] + PARAMS["a"]
    by_beta = float(mpmath.diff(departure_time_by_mpmath, 1))
    exact = {"m": 0.0, "g": -t / (2 * PARAMS["g"]), "R": t / (2 * length), "a": t / (2 * length), "beta": by_beta}
    params = jax.tree.map(jnp.asarray, PARAMS)
    for mode in (jax.jacfwd, jax.jacrev):
        got = jax.jit(mode(when))(params)
        for name, value in exact.items():
            assert float(got[name]) == pytest.approx(value, rel=1e-6, abs=1e-9), (mode.__name__, name)
