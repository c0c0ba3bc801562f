"""Methods of equal steps: their orders, and what they keep over long motions."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate.equal_steps import loop
from lagjax.numerics import tableau
from tests.behaviour.test_orders import ROD_SWING, computed, double_pendulum_equation, orders, states, within
from tests.systems import DOUBLE_PARAMS, DOUBLE_SWING, double_pendulum, double_rods, rods_from_angles

TS = np.linspace(0.0, 8.0, 9)
TURN = 2 * np.pi
kepler = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) + params / jnp.sqrt(jnp.sum(q**2)))


def ellipse(eccentricity):
    """The pericentre of an orbit with the period 2π."""
    e = eccentricity
    return np.array([1 - e, 0.0]), np.array([0.0, np.sqrt((1 + e) / (1 - e))])


@pytest.fixture(scope="module")
def exact():
    """The double pendulum by angles and by rods, by SciPy."""
    y0 = np.concatenate(DOUBLE_SWING)
    y = solve_ivp(double_pendulum_equation, (0, TS[-1]), y0, "DOP853", TS, rtol=2.5e-14, atol=1e-15).y.T
    rods = jax.vmap(lambda angles, rates: rods_from_angles(angles, rates, DOUBLE_PARAMS))(y[:, :2], y[:, 2:])
    return {"free": {"q": y[:, :2], "v": y[:, 2:]}, "constrained": states(*jax.tree.map(np.asarray, rods))}


FORMS = {"free": (double_pendulum, DOUBLE_SWING), "constrained": (double_rods, ROD_SWING)}


def measured(exact, form, method, steps):
    """Its order in q, v and multipliers."""
    system, start = FORMS[form]

    def run(n):
        return lj.integrate(
            system, *start, DOUBLE_PARAMS, ts=TS, method=method, dt0=jnp.asarray(1 / n), estimate_error=False
        )

    return orders(exact[form], steps, lambda n: computed(form, run(n)))


STEPS = {1: (80, 160, 320), 2: (24, 34, 48), 3: (16, 22, 30), 4: (10, 14, 18)}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("form", "stages"),
    [
        pytest.param("constrained", 3, marks=pytest.mark.slow),
        *(pytest.param("free", s, marks=pytest.mark.exhaustive) for s in STEPS),
        *(pytest.param("constrained", s, marks=pytest.mark.exhaustive) for s in (1, 2, 4)),
    ],
)
def test_order_of_gauss(exact, form, stages):
    """Order 2 s in positions, velocities and multipliers. Twin: `test_a_wrong_order_would_be_seen`."""
    found = measured(exact, form, lj.Gauss(stages), STEPS[stages])
    assert all(within(2 * stages, found)), found


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore")
def test_a_wrong_order_would_be_seen(exact, monkeypatch):
    """Failing twin: the constraints' forces at equidistant nodes."""
    right = tableau(3)
    wrong = right.to_nodes + np.array([0.0, 0.06, -0.06, 0.0])[:, None] / right.weights * np.array([0.2, 0.6, 0.2])
    monkeypatch.setattr(loop, "tableau", lambda s: right._replace(to_nodes=wrong))
    found = measured(exact, "constrained", dataclasses.replace(lj.Gauss(3), newton=True), STEPS[3])
    assert not any(within(6, found)), found


@pytest.mark.exhaustive
@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_order_of_splitting(order):
    """On an ellipse, against Kepler's equation. Twin: each order is told from the others by itself."""
    e, end = 0.6, 2 * TURN + 2.0
    q0, v0 = ellipse(e)
    anomaly = 2.0
    for _ in range(60):
        anomaly = 2.0 + e * np.sin(anomaly)
    exact = np.array([np.cos(anomaly) - e, np.sqrt(1 - e**2) * np.sin(anomaly)])
    counts = {2: (1000, 2000), 4: (400, 800), 6: (250, 350), 8: (150, 200)}[order]
    run = lambda n: lj.integrate(
        kepler, q0, v0, 1.0, ts=[0.0, end], method=lj.Splitting(order), dt0=end / (2 * n), estimate_error=False
    )
    errors = [np.linalg.norm(run(n).q[-1] - exact) for n in counts]
    assert abs(np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0]) - order) < 0.35


def of_momenta(x, system, params, method, span):
    """(q, p) after a span, of (q, p) before."""
    q, p = jnp.split(x, 2)
    momentum = lambda q, v: jax.grad(lambda v: system.lagrangian(0.0, q, v, params))(v)
    mass = lambda q: jax.jacfwd(lambda v: momentum(q, v))(jnp.zeros_like(q))
    traj = lj.integrate(
        system, q, jnp.linalg.solve(mass(q), p), params, ts=np.array([0.0, span]), method=method, dt0=0.1,
        stepsize_controller=diffrax.ConstantStepSize(), estimate_error=False,
    )  # fmt: skip
    return jnp.concatenate([traj.q[-1], momentum(traj.q[-1], traj.v[-1])])


def spin(q, v):
    """The angular velocity in the axes of a body with the unit quaternion q."""
    w, x, y, z = q
    a, b, c, d = v
    return 2 * jnp.stack([w * b - x * a - y * d + z * c, w * c - y * a - z * b + x * d, w * d - z * a - x * c + y * b])


@pytest.mark.exhaustive
def test_a_heavy_top_by_quaternion():
    """Order 6 where the mass matrix is singular without the constraint, and depends on q."""
    inertia = np.array([1.0, 1.0, 0.5])

    def lagrangian(t, q, v, params):
        return 0.5 * jnp.sum(inertia * spin(q, v) ** 2) - params * (q[0] ** 2 - q[1] ** 2 - q[2] ** 2 + q[3] ** 2)

    top = lj.System(lagrangian, constraints={"unit": lj.Holonomic(lambda t, q, params: jnp.sum(q**2) - 1.0)})
    q0, turn = np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0]), np.array([0.3, 0.0, 6.0])
    v0 = 0.5 * np.array([-q0[1] * turn[0], q0[0] * turn[0], -q0[1] * turn[2], q0[0] * turn[2]])
    run = lambda **options: lj.integrate(
        top, q0, v0, 3.0, ts=np.linspace(0.0, 10.0, 11), estimate_error=False, **options
    )
    exact = run(rtol=1e-12).q
    errors = [float(np.max(np.abs(run(method=lj.Gauss(3), dt0=h).q - exact))) for h in (0.1, 0.05)]
    assert abs(np.log2(errors[0] / errors[1]) - 6) < 0.35 and errors[1] < 1e-7


@pytest.mark.exhaustive
def test_a_mass_that_depends_on_the_velocity():
    """A relativistic oscillator, whose L has a largest velocity. Twin: the classical one is far away."""
    rel = lj.System(lambda t, q, v, params: -jnp.sqrt(1 - v**2) - 0.5 * q**2)
    run = lambda system, **options: lj.integrate(
        system, 0.5, 0.0, ts=np.linspace(0.0, 10.0, 11), estimate_error=False, **options
    )
    exact = run(rel, rtol=1e-12).q
    np.testing.assert_allclose(run(rel, method=lj.Gauss(4), dt0=0.1).q, exact, atol=1e-11)
    classical = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2)
    assert np.max(np.abs(run(classical, rtol=1e-9).q - exact)) > 0.1


@pytest.mark.exhaustive
def test_steps_are_symplectic():
    """Dᵀ J D = J for twenty steps of a double pendulum, whose mass matrix depends on the angles. Twin: Dopri8."""
    q0, v0 = DOUBLE_SWING
    x0 = jnp.concatenate([q0, jax.grad(lambda v: double_pendulum.lagrangian(0.0, q0, v, DOUBLE_PARAMS))(v0)])
    J = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.eye(2), np.zeros((2, 2))]])

    def departs(method):
        D = jax.jit(jax.jacfwd(lambda x: of_momenta(x, double_pendulum, DOUBLE_PARAMS, method, 2.0)))(x0)
        return np.max(np.abs(D.T @ J @ D - J)) / np.max(np.abs(D)) ** 2

    assert departs(lj.Gauss(2)) < 1e-13
    assert departs(diffrax.Heun()) > 1e-6


@pytest.mark.slow
def test_a_thousand_turns_and_back():
    """Energy, angular momentum, and the way back, on an ellipse of e = 0.6. Twin: by Dopri8 the energy drifts."""
    q0, v0 = ellipse(0.6)
    ts = TURN * np.linspace(0.0, 1000.0, 41)
    for method, dt in ((lj.Splitting(6), TURN / 300), (lj.Gauss(3), TURN / 200)):
        there = lj.integrate(kepler, q0, v0, 1.0, ts=ts, method=method, dt0=dt, estimate_error=False)
        h = np.asarray(there.jacobi_integral())
        slope, rest = np.polyfit(ts, h, 1)[0], np.ptp(h)
        assert abs(slope) * ts[-1] < 1e-10 and rest < 1e-6
        momentum = there.q[:, 0] * there.v[:, 1] - there.q[:, 1] * there.v[:, 0]
        np.testing.assert_allclose(momentum, 0.8, rtol=1e-12)
        assert "drifts by" in repr(there)
        short = [there.q[2], there.v[2]]
        back = lj.integrate(kepler, *short, 1.0, ts=ts[2::-1], method=method, dt0=dt, estimate_error=False)
        np.testing.assert_allclose(back.q[-1], q0, atol=1e-8)
    drifting = lj.integrate(
        kepler, q0, v0, 1.0, ts=ts, method=lj.Dopri8(), dt0=TURN / 100, throw=False, estimate_error=False,
        stepsize_controller=diffrax.ConstantStepSize(),
    )  # fmt: skip
    h = np.asarray(drifting.jacobi_integral())
    assert abs(np.polyfit(ts, h, 1)[0]) * ts[-1] > 1e-7


@pytest.mark.exhaustive
def test_constraints_over_half_a_million_steps():
    """A pendulum on a rod, half a million steps: the rod's length to round-off, and the energy."""
    pendulum = lj.System(
        lambda t, q, v, g: 0.5 * jnp.sum(v**2) - g * q[1],
        constraints={"rod": lj.Holonomic(lambda t, q, g: jnp.sum(q**2) - 1.0)},
    )
    q0 = np.array([np.sin(1.5), -np.cos(1.5)])
    ts = np.linspace(0.0, 5000.0, 51)
    traj = lj.integrate(pendulum, q0, np.zeros(2), 9.81, ts=ts, method=lj.Gauss(3), dt0=0.01, estimate_error=False)
    assert int(traj.stats["num_steps"]) == 500_000
    np.testing.assert_allclose(np.sum(np.asarray(traj.q) ** 2, axis=1), 1.0, atol=1e-13)
    np.testing.assert_allclose(np.sum(np.asarray(traj.q * traj.v), axis=1), 0.0, atol=1e-12)
    h = np.asarray(traj.jacobi_integral())
    assert np.ptp(h) < 1e-8 and abs(np.polyfit(ts, h, 1)[0]) * ts[-1] < 1e-10
    # The tension by the energy: λ r = v²/2 - ... with g = 9.81 along -y, 2 λ = -(v² + 9.81 * y).
    tension = -(np.sum(np.asarray(traj.v) ** 2, axis=1) - 9.81 * np.asarray(traj.q)[:, 1]) / 2
    np.testing.assert_allclose(traj.multipliers["rod"], tension, rtol=1e-10)


@pytest.mark.exhaustive
def test_derivatives_in_both_modes():
    """d(end)/d(parameter), forward and in reverse, and as by steps that adapt."""
    pendulum = lj.System(lambda t, q, v, k: 0.5 * v**2 + k * jnp.cos(q))

    def end(k, **options):
        return lj.integrate(pendulum, 1.0, 0.0, k, ts=np.array([0.0, 20.0]), estimate_error=False, **options).q[-1]

    equal = lambda k: end(k, method=lj.Gauss(4), dt0=0.1)
    value = jax.jit(jax.grad(lambda k: end(k, rtol=1e-12)))(1.0)
    forward, reverse = jax.jit(lambda k: (jax.jvp(equal, (k,), (1.0,))[1], jax.grad(equal)(k)))(1.0)
    np.testing.assert_allclose([forward, reverse], value, rtol=1e-9)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)


def test_what_they_refuse():
    """Bad input, in words."""
    q0, v0 = ellipse(0.3)
    with pytest.raises(ValueError, match=r"(?s)makes steps of equal length, which is not given.*dt0=0.01"):
        lj.integrate(kepler, q0, v0, 1.0, ts=[0.0, 1.0], method=lj.Gauss(2))
    with pytest.raises(ValueError, match=r"events has no meaning for lj.Splitting\(4\)"):
        event = {"low": lj.Crossing(lambda t, q, v, p: q[0])}
        lj.integrate(kepler, q0, v0, 1.0, ts=[0.0, 1.0], method=lj.Splitting(), dt0=0.1, events=event)
    with pytest.raises(ValueError, match="stages must be a whole number from 1 to 8"):
        lj.Gauss(9)
    with pytest.raises(ValueError, match=r"order must be one of \(2, 4, 6, 8\)"):
        lj.Splitting(5)
    polar = lj.System(lambda t, q, v, p: 0.5 * (v["r"] ** 2 + (q["r"] * v["a"]) ** 2) + 1 / q["r"])
    start = {"r": 1.0, "a": 0.0}, {"r": 0.0, "a": 1.0}
    with pytest.raises(ValueError, match=r"(?s)the mass matrix depends on r.*lj.Gauss\(3\)"):
        lj.integrate(polar, *start, ts=[0.0, 1.0], method=lj.Splitting(), dt0=0.1)
    with pytest.raises(ValueError, match=r"(?s)'z' have none.*method=lj.Gauss\(3\)"):
        states = {"z": lambda t, q, v, p: q["x"]}
        cost = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2 - q["x"] ** 2, states=states)
        lj.integrate(cost, {"x": 1.0, "z": 0.0}, {"x": 0.0}, ts=[0.0, 1.0], method=lj.Splitting(), dt0=0.1)


@pytest.mark.exhaustive
def test_a_step_that_is_too_long():
    """A stiff spring: the iteration fails and says which step would do; Newton's method takes the long one."""
    spring = lj.System(lambda t, q, v, k: 0.5 * jnp.sum(v**2) - 9.81 * q[1] - 0.5 * k * (jnp.sqrt(q @ q) - 1) ** 2)
    start = np.array([np.sin(1.0), -np.cos(1.0)]), np.zeros(2)
    run = lambda method, dt, **options: lj.integrate(
        spring, *start, 1e6, ts=np.linspace(0.0, 2.0, 6), method=method, dt0=dt, estimate_error=False, **options
    )
    with pytest.raises(RuntimeError, match=r"(?s)stopped at t = 0, .*dt0=0\.00\d+, with which a step is solved there"):
        run(lj.Gauss(2), 0.01)
    stopped = run(lj.Gauss(2), 0.01, throw=False)
    assert bool(stopped.result == lj.RESULTS.unsolved_step) and np.isnan(np.asarray(stopped.q[1:])).all()
    slow = run(lj.Gauss(2, newton=True), 0.01)
    # The motion on a rigid rod, which the stiff one stays within the stretch g/k of.
    angle = solve_ivp(lambda t, y: [y[1], -9.81 * np.sin(y[0])], (0, 2), [1.0, 0.0], t_eval=slow.t, rtol=1e-10).y[0]
    np.testing.assert_allclose(slow.q, np.stack([np.sin(angle), -np.cos(angle)], 1), atol=2e-3)


@pytest.mark.exhaustive
def test_a_thermostat_and_a_rod_given_three_times():
    """A state beside a mass, order 6 against SciPy; twin: another Q. Dependent constraints share the rod's force."""
    hoover = lj.System(
        lambda t, q, v, Q: 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2,
        force=lambda t, q, v, Q: {"x": -q["z"] * v["x"], "z": 0.0},
        states={"z": lambda t, q, v, Q: (v["x"] ** 2 - 1.0) / Q},
    )

    def rate(t, y):
        x, v, z = y
        return [v, -x - z * v, (v**2 - 1.0) / 0.5]

    exact = solve_ivp(rate, (0, 10), [1.0, 0.0, 0.2], "DOP853", TS, rtol=1e-13, atol=1e-13).y

    def error(dt, Q=0.5):
        start, options = ({"x": 1.0, "z": 0.2}, {"x": 0.0}), {"method": lj.Gauss(3), "estimate_error": False}
        motion = lj.integrate(hoover, *start, Q, ts=TS, dt0=jnp.asarray(dt), **options)
        return np.max(np.abs(np.stack([motion.q["x"], motion.v["x"], motion.q["z"]]) - exact))

    errors = [error(dt) for dt in (0.2, 0.1)]
    assert abs(np.log2(errors[0] / errors[1]) - 6) < 0.35 and errors[1] < 1e-6 and error(0.1, 0.51) > 1e-3
    again = {
        "rod": lj.Holonomic(lambda t, q, p: q @ q - 1.0),
        "twice": lj.Holonomic(lambda t, q, p: 2.0 * (q @ q - 1.0)),
        "root": lj.Holonomic(lambda t, q, p: jnp.sqrt(q @ q) - 1.0),
    }
    door = lj.System(lambda t, q, v, p: 0.5 * v @ v - 9.81 * q[1], constraints=again)
    swing = lj.integrate(
        door, np.array([1.0, 0.0]), np.zeros(2), ts=TS, method=lj.Gauss(3), dt0=0.02, estimate_error=False
    )
    np.testing.assert_allclose(np.sum(np.asarray(swing.q) ** 2, axis=1), 1.0, atol=1e-14)
    # v² = -2 g y and a tension of -3 g y: A λ with the shortest λ in the shares 2, 4, 1 of the rows.
    shares = np.array([2.0, 4.0, 1.0]) / 21.0
    for name, share in zip(again, shares):
        np.testing.assert_allclose(swing.multipliers[name], 3 * 9.81 * swing.q[:, 1] * share, atol=1e-8)


@pytest.mark.exhaustive
def test_newtons_iteration_ends_at_every_length_of_a_step():
    """A stiff spring pendulum by long and short steps, against adaptive ones: an early end was taken for a failure."""
    spring = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) - 500.0 * (jnp.sqrt(jnp.sum(q**2)) - 1.0) ** 2)
    given = spring, jnp.array([1.1, 0.0]), jnp.array([0.0, 1.0]), None
    ts = jnp.array([0.0, 5.0, 10.0])
    exact = lj.integrate(*given, ts=ts, rtol=1e-12, estimate_error=False).q[-1]
    for dt, error in ((0.005, 1e-7), (0.01, 1e-6), (0.02, 3e-5)):
        found = lj.integrate(*given, ts=ts, method=lj.Gauss(3, newton=True), dt0=dt, estimate_error=False).q[-1]
        np.testing.assert_allclose(found, exact, atol=error)
        assert np.abs(found - exact).max() > error / 1000
