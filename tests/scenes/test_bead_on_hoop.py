"""The bead on the rotating hoop: closed forms, measured periods, the motor's torque, gradients.

Formulas are evaluated in NumPy; `python -m lagjax` integrates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.integrate.integrate import integrate
from lagjax.mechanics.lagrangian import jacobi_integral, momentum
from lagjax.report import relative_error
from lagjax.scenes import bead_on_hoop as scene
from lagjax.scenes.potentials import agm
from tests.by_numpy import by_numpy, equations
from tests.references import keys, reference

SLOW, FAST, CRITICAL = scene.PARAMS | {"omega": 2.5}, scene.PARAMS, scene.CRITICAL
STATE = (1.25, -2.0)

# Periods by (params, the point of release at rest), both measured and evaluated.
PERIODS = {
    **{f"s3.w=2.5.T(psi_m={psi})": (SLOW, psi) for psi in (0.5, 1.0, 2.0, 3.0)},
    "s3.w=0.T(psi_m=1.0)": (SLOW | {"omega": 0.0}, 1.0),
    "s3.w=6.T_cross_bottom(psi_m=2.5)": (FAST, 2.5),
    **{f"s3.crit(g=12,a=.75,w=4).T(psi_m={psi})": (CRITICAL, psi) for psi in (1.0, 0.125, 0.0009765625)},
    **{f"s3.w=6.T_alpha(turning {psi})": (FAST, psi) for psi in (1.0, 0.5, 0.0009765625)},
}
TURNING = {f"s3.w=6.other_turning({psi})": psi for psi in (1.0, 0.5, 0.0009765625)}
OUTER = reference("s3.w=6.other_turning(1.0)")
# Motions by (params, point of release, time): the keys of ψ, and of ψ̇ if there is one.
MOTIONS = {
    "s3.w=2.5.psi(t=1.0;start rest 1.0)": (SLOW, 1.0, 1.0, "s3.w=2.5.psidot(t=1.0;start rest 1.0)"),
    "s3.w=2.5.psi(t=3.0;start rest 2.0)": (SLOW, 2.0, 3.0, "s3.w=2.5.psidot(t=3.0;start rest 2.0)"),
    "s3.w=6.psi(t=1.25;start rest 2.5)": (FAST, 2.5, 1.25, "s3.w=6.psidot(t=1.25;start rest 2.5)"),
    "s3.w=6.psi(t=0.3;start rest at outer turning of 1.0)": (FAST, OUTER, 0.3, None),
    "s3.w=6.psi(1.25;rest 1.0)": (FAST, 1.0, 1.25, "s3.w=6.psidot(1.25;rest 1.0)"),
}
ROTATIONS = {"s3.w=2.5.T_rot(H=64)": SLOW, "s3.w=6.0.T_rot(H=64)": FAST}
HOMOCLINIC = "s3.w=6.homoclinic psi(0.5)"
WORK = "s3.w=6.work_of_motor(0..1.25)"


def work(psi, psi_rate):
    """The motor's work from rest at ψ = 1: E(t) - E(0)."""
    return scene.balance(FAST, psi, psi_rate).E - scene.balance(FAST, 1.0, 0.0).E


def single_evaluations():
    """The value of every key of the section but ψ̈, from a closed form."""
    state = scene.balance(FAST, *STATE)
    slow, fast = scene.small_motion(SLOW), scene.small_motion(FAST)
    values = {
        "s3.omega0": scene.natural_rate(FAST),
        "s3.w=2.5.Omega_bottom": scene.frequency(slow.bottom),
        # The pendulum of length a with this frequency: g' = a Ω².
        "s3.w=2.5.g_prime": SLOW["a"] * slow.bottom,
        "s3.w=2.5.top_growth": scene.growth(slow.top),
        "s3.w=6.alpha": scene.equilibrium_angle(FAST),
        "s3.w=6.Omega_alpha": scene.frequency(fast.alpha),
        "s3.w=6.bottom_growth": scene.growth(fast.bottom),
        "s3.w=6.top_growth": scene.growth(fast.top),
        "s3.crit.T*psi_m/(1/w0) limit": 4 * jnp.sqrt(2.0) * 0.5 * jnp.pi / agm(1.0, jnp.sqrt(0.5)),
        "s3.w=6.homoclinic_outer": scene.other_turning_point(FAST, 0.0),
        HOMOCLINIC: scene.homoclinic_motion(FAST, 0.5)[0],
        "s3.H_separatrix_top": 2 * FAST["g"] / FAST["a"],
        "s3.state.E": state.E,
        "s3.state.h": state.h,
        "s3.state.Lz": state.L_z,
        "s3.state.p_psi": state.p_psi,
        "s3.state.torque": state.torque,
        "s3.state.power": state.power,
        "s3.state.N_r": state.radial,
        "s3.state.N_perp": state.sideways,
        "s3.alpha at w^2=w0^2(1+2^-30)": scene.tilt(2.0**-30),
        "s3.alpha at w^2=w0^2(1+2^-50)": scene.tilt(2.0**-50),
        WORK: work(*scene.exact_motion(FAST, 1.0, 1.25)),
    }
    for omega in (100.0, 1e6):
        params = FAST | {"omega": omega}
        values[f"s3.w={omega}.pi/2-alpha"] = scene.short_of_horizontal(params)
        values[f"s3.w={omega}.w-Omega"] = scene.lag_behind_hoop(params)
    for key, (params, psi) in PERIODS.items():
        values[key] = scene.exact_period(params, psi)
    for key, psi in TURNING.items():
        values[key] = scene.other_turning_point(FAST, psi)
    for key, (params, psi, t, rate_key) in MOTIONS.items():
        values[key], rate = scene.exact_motion(params, psi, t)
        if rate_key:
            values[rate_key] = rate
    for key, params in ROTATIONS.items():
        values[key] = scene.rotation_period(params, 64.0)
    return values


def second(params, psi, psi_rate):
    """ψ̈ from the Lagrangian."""
    return float(equations(scene.system, 0.0, psi, psi_rate, params).a)


def rate_of_balance(params, psi, psi_rate, psi_second):
    """How fast the balance's entries change."""
    along = lambda q, v, a: jax.jvp(lambda *y: scene.balance(params, *y), (q, v), (v, a))[1]
    return by_numpy(along)(psi, psi_rate, psi_second)


def test_every_reference_value():
    """Each key of the section agrees with its closed form to 1e-12, and none is omitted."""
    values = by_numpy(single_evaluations)() | {"s3.state.psidd": second(FAST, *STATE)}
    assert set(values) == set(keys("s3"))
    for key, value in values.items():
        assert float(value) == pytest.approx(reference(key), rel=1e-12, abs=0), key


def test_torque_is_the_multiplier():
    """The motor's multiplier is τ = 2 m a² ω sin ψ cos ψ ψ̇ = dL_z/dt and ω τ = dE/dt; a flipped sign is detected."""
    balance = by_numpy(scene.balance)
    of_systems = by_numpy(
        lambda q, v, params: (
            momentum(scene.driven_system, 0.5, q, v, params)["theta"],
            jacobi_integral(scene.system, 0.0, q["psi"], v["psi"], params),
        )
    )
    for psi, psi_rate, omega in np.random.default_rng(3).uniform(-3.0, 3.0, (4, 3)):
        params = FAST | {"omega": omega}
        q, v = {"psi": psi, "theta": 0.5 * omega}, {"psi": psi_rate, "theta": omega}
        found = equations(scene.driven_system, 0.5, q, v, params)
        torque, state = float(found.multipliers["motor"]), balance(params, psi, psi_rate)
        assert torque == pytest.approx(float(state.torque), rel=1e-12)
        rate = rate_of_balance(params, psi, psi_rate, found.a["psi"])
        assert [rate.L_z, rate.E] == pytest.approx([torque, omega * torque], rel=1e-11)
        assert abs(rate.E + omega * torque) > 0.1 * abs(rate.E)
        assert abs(rate.h) < 1e-12
        # The hoop is where its motor wants it, and stays there.
        turned = jax.jvp(lambda t, q: scene.motor(t, q, params), (0.5, q), (1.0, v))
        assert turned == pytest.approx((0.0, 0.0), abs=1e-15)
        # L_z of the hoop at the angle θ is the momentum of θ; E - ω L_z is the Jacobi integral of ψ alone.
        assert of_systems(q, v, params) == pytest.approx((float(state.L_z), float(state.h)))


def test_speed_zero_amplitude_and_reversal():
    """At ω = ω0 nothing is NaN; below it α = 0 with a zero gradient; ω < 0 changes only τ, L_z and N_perp."""
    squares, angle = by_numpy(scene.small_motion)(CRITICAL), by_numpy(scene.equilibrium_angle)
    assert (squares.bottom, squares.alpha, by_numpy(scene.frequency)(squares.bottom)) == (0.0, 0.0, 0.0)
    assert angle(CRITICAL) == 0.0
    assert by_numpy(jax.grad(lambda w: scene.equilibrium_angle(SLOW | {"omega": w})))(2.5) == 0.0
    assert angle(FAST | {"g": 0.0}) == pytest.approx(np.pi / 2)
    state, mirrored = (by_numpy(scene.balance)(FAST | {"omega": w}, *STATE) for w in (6.0, -6.0))
    for name in state._fields:
        sign = -1 if name in ("torque", "L_z", "sideways") else 1
        assert getattr(mirrored, name) == sign * getattr(state, name), name


@pytest.mark.slow
def test_constraint_holds_for_a_thousand_periods():
    """After 1,000 natural periods the residual is at most 1e-12, and h = E - ω L_z and the phase are right to 1e-6."""
    ts = reference("s3.w=2.5.T(psi_m=1.0)") * np.linspace(0.0, 1000.3, 11)
    start = scene.driven_start(SLOW, 1.0)
    trajectory = integrate(scene.driven_system, *start, SLOW, ts=ts, rtol=1e-12, atol=1e-12)
    assert float(trajectory.residual()) <= 1e-12
    got = np.asarray(trajectory.q["psi"]), np.asarray(trajectory.v["psi"])
    assert relative_error(got, by_numpy(scene.exact_motion)(SLOW, 1.0, ts)) < 1e-6
    state = by_numpy(scene.balance)(SLOW, *got)
    assert np.ptp(state.h) < 1e-6 * np.max(np.abs(state.h))
    assert np.ptp(state.E) > 0.05 * np.max(np.abs(state.E))
