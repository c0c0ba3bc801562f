"""Radau IIA and its Newton iteration: order, stability, published stiff end states, derivatives, failures."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import lagjax as lj
from lagjax.numerics.methods import radau
from lagjax.numerics.methods.radau import Radau5, SimplifiedNewton, with_tolerances
from tests.systems import HORIZONTAL, PARAMS, rod_pendulum
from tests.tiers import exhaustive_but

EXACT = SimplifiedNewton(rtol=1e-12, atol=1e-14)
OF_CONTROLLER = diffrax.with_stepsize_controller_tols(SimplifiedNewton)


def solve(field, y0, args=None, *, tol=1e-8, atol=None, t1=1.0, ts=None, method=None, **options):
    """An adaptive solve by plain diffrax."""
    control = diffrax.PIDController(rtol=tol, atol=tol if atol is None else atol)
    saveat = diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=ts)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), Radau5() if method is None else method, 0.0, t1, options.pop("dt0", 1e-6), y0, args,
        saveat=saveat, stepsize_controller=control, max_steps=2**14, throw=False, **options,
    )  # fmt: skip


def constant(field, y0, args, steps, *, ts=None, t1=1.0, method=None):
    """Constant steps by plain diffrax; the number of steps may be traced."""
    saveat = diffrax.SaveAt(t1=True) if ts is None else diffrax.SaveAt(ts=ts)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), Radau5(root_finder=EXACT) if method is None else method, 0.0, t1, t1 / steps, y0, args,
        saveat=saveat, throw=False, max_steps=2**12,
    )  # fmt: skip


# The method ----------------------------------------------------------------------------------------------------------


def test_tableau():
    """The simplifying assumptions B(5) and C(3) hold, B(6) and C(4) do not, and gamma has its closed form."""
    moments = lambda k: radau.A @ radau.C ** (k - 1) - radau.C**k / k
    for k in range(1, 6):
        assert abs(moments(k)[2]) < 1e-15
    assert abs(moments(6)[2]) > 1e-3
    assert np.max(np.abs([moments(k) for k in (1, 2, 3)])) < 1e-15
    assert np.max(np.abs(moments(4))) > 1e-3
    assert abs(radau.GAMMA - (3 + np.cbrt(9.0) - np.cbrt(3.0))) < 1e-13


@pytest.mark.optimised
@pytest.mark.slow
def test_stability():
    """One step is R(z) of Hairer & Wanner II, table IV.3.3 in all of the left half-plane; R(-1e6) = 3e-6 (L-stable)."""
    z = np.array([-1e6, -1e2, -3.0, 0.5, 1e-3j, 1j, 30j, 1e6j, -1 + 2j, -50 + 1e4j])
    turn = lambda t, y, z: jnp.stack([z[0] * y[0] - z[1] * y[1], z[1] * y[0] + z[0] * y[1]])
    step = lambda z: constant(turn, jnp.array([1.0, 0.0]), z, 1).ys[0]
    found = np.asarray(jax.jit(jax.vmap(step))(np.stack([np.real(z), np.imag(z)], axis=1))) @ np.array([1, 1j])
    expected = (1 + 2 * z / 5 + z**2 / 20) / (1 - 3 * z / 5 + 3 * z**2 / 20 - z**3 / 60)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-13)
    assert np.max(np.abs(found[np.real(z) <= 0])) <= 1 + 1e-15
    assert abs(found[0]) < 4e-6


def predator(t, y, args):
    """Volterra's equations with a seasonal term: nonlinear and not autonomous."""
    rabbits, foxes = y["rabbits"], y["foxes"]
    return {"rabbits": rabbits * (1.5 - foxes), "foxes": foxes * (rabbits - 1 + 0.5 * jnp.sin(3 * t))}


@pytest.mark.optimised
@pytest.mark.slow
def test_order():
    """Order 5 at the ends of steps; twin: the same measurement finds order 4 for diffrax's interpolant."""
    integrate = pytest.importorskip("scipy.integrate")
    ts = np.linspace(0.0, 2.0, 151)[1:]
    start = {"rabbits": jnp.array(1.25), "foxes": jnp.array(0.5)}
    right = lambda t, y: [y[0] * (1.5 - y[1]), y[1] * (y[0] - 1 + 0.5 * np.sin(3 * t))]
    exact = integrate.solve_ivp(right, (0, 2), [1.25, 0.5], "DOP853", ts, rtol=2.5e-14, atol=1e-15).y
    steps = np.array([12.0, 18.0, 26.0])
    many = jax.jit(jax.vmap(lambda n: constant(predator, start, None, n, ts=ts, t1=2.0).ys))(steps)
    errors = np.abs(np.stack([many["rabbits"], many["foxes"]], axis=1) - exact)
    order = lambda errors: -np.polyfit(np.log(steps), np.log(np.linalg.norm(errors, axis=1)), 1)[0]
    assert abs(order(errors[:, :, -1]) - 5) < 0.35
    between = order(errors[:, :, :-1].reshape(3, -1))
    assert abs(between - 4) < 0.45
    assert not abs(between - 5) < 0.35


@pytest.mark.optimised
@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(("rod_pendulum",), ("pendulum", "rod_pendulum")))
def test_order_of_a_motion(name):
    """Order 5 at outputs between the steps of `lagjax.integrate`, free and under a constraint (round-off)."""
    integrate = pytest.importorskip("scipy.integrate")
    ts = np.concatenate([[0.0], np.linspace(0.3, 2.0, 12) + 0.013 * np.sin(7 * np.arange(12.0))])
    g, length = PARAMS["g"], PARAMS["l"]
    swing = lambda t, y: [y[1], -g / length * np.sin(y[0])]
    exact = integrate.solve_ivp(
        swing, (0, ts[-1]), [np.pi / 2, 0.0], "DOP853", ts, rtol=2.5e-14, atol=1e-15
    ).y[0]  # fmt: skip
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] / params["l"] * jnp.cos(q))
    system, start = (system, (np.pi / 2, 0.0)) if name == "pendulum" else (rod_pendulum, HORIZONTAL)
    errors, steps = [], np.array([24, 36, 50])
    for n in steps:
        traj = lj.integrate(
            system, *start, PARAMS, ts=ts, method=Radau5(root_finder=EXACT), dt0=jnp.asarray(1 / n),
            stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip
        angle = traj.q if name == "pendulum" else np.unwrap(np.arctan2(traj.q["x"], -traj.q["y"]))
        errors.append(np.linalg.norm(angle - exact))
        if name == "rod_pendulum":
            assert np.max(np.abs(traj.q["x"] ** 2 + traj.q["y"] ** 2 - length**2)) < 1e-14
    assert abs(-np.polyfit(np.log(steps), np.log(errors), 1)[0] - 5) < 0.35


# Stiff equations -----------------------------------------------------------------------------------------------------


def test_robertson():
    """Robertson's reaction at t = 1e11, to 10 rtol of the published values (IVP test set, problem ROBER)."""

    def reaction(t, y, args):
        slow, fast = -0.04 * y[0] + 1e4 * y[1] * y[2], 3e7 * y[1] ** 2
        return jnp.stack([slow, -slow - fast, fast])

    published = np.array([0.2083340149701255e-07, 0.8333360770334713e-13, 0.9999999791665050])
    end = jax.jit(lambda tol: solve(reaction, jnp.array([1.0, 0.0, 0.0]), tol=tol, atol=1e-8 * tol, t1=1e11))
    for tol in (1e-6, 1e-8):
        found = end(jnp.asarray(tol))
        np.testing.assert_allclose(found.ys[0], published, rtol=10 * tol)
        assert found.stats["num_steps"] < 2000


def van_der_pol(t, y, epsilon):
    """Van der Pol's equation in Liénard's time."""
    return jnp.stack([y[1], ((1 - y[0] ** 2) * y[1] - y[0]) / epsilon])


@pytest.mark.optimised
@pytest.mark.slow
def test_van_der_pol():
    """Van der Pol's oscillator at epsilon = 1e-6, to 10 rtol of the published values (IVP test set, problem VDPOL)."""
    published = np.array([0.1706167732170483e1, -0.8928097010247975])
    end = jax.jit(lambda tol: solve(van_der_pol, jnp.array([2.0, 0.0]), 1e-6, tol=tol, t1=2.0))
    for tol in (1e-6, 1e-8):
        np.testing.assert_allclose(end(jnp.asarray(tol)).ys[0], published, rtol=10 * tol)


def spring_pendulum(t, y, k):
    """A unit mass on a spring of unit length."""
    q, v = y
    r = jnp.sqrt(q @ q)
    return v, -k * (1 - 1 / r) * q - jnp.array([0.0, 9.8125])


def rod_like(k):
    """A start on the slow motion of the spring pendulum: at angle 0.9, turning by 2."""
    angle, rate, g = 0.9, 2.0, 9.8125
    along, across = np.array([np.sin(angle), -np.cos(angle)]), np.array([np.cos(angle), np.sin(angle)])
    r = (k + g * np.cos(angle)) / (k - rate**2)
    return r * along, r * rate * across - 3 * g * np.sin(angle) * rate / k * along


@pytest.mark.slow
def test_stiff_springs_cost_no_steps():
    """With velocity errors weighted by h, k = 1e6 and 1e10 take under 300 steps; error below 1e-7 + 100/k."""
    integrate = pytest.importorskip("scipy.integrate")
    swing = lambda t, y: [y[1], -9.8125 * np.sin(y[0])]
    angle = integrate.solve_ivp(swing, (0, 2), [0.9, 2.0], "DOP853", rtol=2.5e-14, atol=1e-15).y[0, -1]
    method = Radau5(step_powers=(0, 1))
    end = jax.jit(lambda k, *y: solve(spring_pendulum, y, k, t1=2.0, method=method))
    for k in (1e6, 1e8, 1e10):
        found = end(k, *rod_like(k))
        assert found.stats["num_steps"] < 300
        np.testing.assert_allclose(found.ys[0][0], [np.sin(angle), -np.cos(angle)], atol=1e-7 + 100 / k)


@pytest.mark.exhaustive
def test_kvaerno_with_this_root_finder():
    """Kvaerno5 on a stiff spring: at most half of the steps that it takes with diffrax's root finder, same accuracy."""
    k = 1e4
    steps = {}
    for name, finder in (("ours", OF_CONTROLLER()), ("diffrax", diffrax.Kvaerno5().root_finder)):
        found = solve(spring_pendulum, rod_like(k), k, tol=1e-6, t1=2.0, method=diffrax.Kvaerno5(root_finder=finder))
        steps[name] = int(found.stats["num_steps"])
        if name == "ours":
            exact = solve(spring_pendulum, rod_like(k), k, tol=1e-11, t1=2.0, method=diffrax.Dopri8())
            np.testing.assert_allclose(found.ys[0][0], exact.ys[0][0], atol=1e-5)
    assert 2 * steps["ours"] < steps["diffrax"]


# Derivatives ---------------------------------------------------------------------------------------------------------


def decay(t, y, args):
    """y' = -k y^2, so that y = y0 / (1 + k t y0)."""
    return -args * y**2


def end_of_decay(p, adjoint):
    """y(1) as a function of p = (k, y0), at a tolerance of 1e-10."""
    return solve(decay, p[1], p[0], tol=1e-10, adjoint=adjoint, dt0=0.01).ys[0]


def gradient_of_decay(k, y0):
    """The derivatives of y(1) with respect to k and y0."""
    return np.array([-(y0**2), 1.0]) / (1 + k * y0) ** 2


@pytest.mark.slow
def test_forward_derivative():
    """The derivative of an end state with respect to parameter and start equals the closed form."""
    forward = jax.jit(jax.jacfwd(lambda p: end_of_decay(p, diffrax.ForwardMode())))
    np.testing.assert_allclose(forward(jnp.array([3.0, 1.5])), gradient_of_decay(3.0, 1.5), rtol=1e-7)


@pytest.mark.exhaustive
def test_reverse_derivative():
    """The gradient through the checkpointed solve equals the closed form as well, also in lanes."""
    reverse = jax.jit(jax.vmap(jax.grad(lambda p: end_of_decay(p, diffrax.RecursiveCheckpointAdjoint()))))
    points = np.array([[3.0, 1.5], [0.5, 2.0], [40.0, 1.0]])
    np.testing.assert_allclose(reverse(points), [gradient_of_decay(*p) for p in points], rtol=1e-7)


@pytest.mark.exhaustive
def test_derivatives_of_a_motion():
    """A stiff oscillator through `lagjax.integrate`: dq/dk of cos(sqrt(k) t) in both modes."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params * q**2)
    end = lambda k: lj.integrate(
        system, 1.0, 0.0, k, ts=np.array([0.0, 1.0]), method=Radau5(), rtol=1e-10, atol=1e-10
    ).q[-1]
    k = 30.0
    exact = -np.sin(np.sqrt(k)) / (2 * np.sqrt(k))
    assert abs(jax.jacfwd(end)(k) - exact) < 1e-7
    assert abs(jax.grad(end)(k) - exact) < 1e-7


# Lanes, precision, failure -------------------------------------------------------------------------------------------


def towards(t, y, k):
    """Decay onto a cosine."""
    return -k * (y - jnp.cos(t))


def test_lanes_in_float32():
    """Lanes of stiffness 1 to 1e7 in single precision: the NaN lane fails, the others are correct."""
    k = np.array([1.0, 1e3, 1e5, 1e7, np.nan], np.float32)
    end = lambda k: solve(towards, jnp.zeros((), k.dtype), k, tol=1e-4, dt0=np.float32(0.01))
    found = jax.jit(jax.vmap(end))(k)
    assert found.ys.dtype == np.float32
    exact = (k**2 * np.cos(1) + k * np.sin(1) - k**2 * np.exp(-k)) / (1 + k**2)
    np.testing.assert_allclose(found.ys[:4, 0], exact[:4], atol=5e-4)
    np.testing.assert_array_equal(found.result == diffrax.RESULTS.successful, [True, True, True, True, False])


def test_unsolvable_step():
    """A step whose equations have no solution says so, has infinite error, and ends a solve of constant steps."""
    explosion = lambda t, y, args: 1 + y**2
    term, y0 = diffrax.ODETerm(explosion), jnp.array(0.0)
    method = Radau5(root_finder=EXACT)

    def step(t1):
        state = method.init(term, jnp.array(0.0), t1, y0, None)
        y1, error, _, _, result = method.step(term, jnp.array(0.0), t1, y0, None, state, False)
        return y1, error, result == diffrax.RESULTS.successful

    y1, error, success = jax.jit(jax.vmap(step))(np.array([0.1, 30.0]))
    np.testing.assert_array_equal(success, [True, False])
    assert abs(y1[0] - np.tan(0.1)) < 1e-6 and np.isfinite(error[0])
    assert np.isfinite(y1[1]) and np.isinf(error[1])


# The root finder -----------------------------------------------------------------------------------------------------


def test_jacobian_is_renewed_where_it_fails():
    """From a start with the wrong slope the kept Jacobian diverges with that result; recomputed, it finds the root."""
    cubic = lambda y, a: y**3 + y - a
    far, near = jnp.array([0.0]), jnp.array([1.2])
    found = {}
    for name, start, slow in (("renewed", far, 0.3), ("kept", far, np.inf), ("kept, near", near, np.inf)):
        finder = SimplifiedNewton(rtol=1e-12, atol=1e-12, slow=slow)
        found[name] = optx.root_find(cubic, finder, start, jnp.array([2.0]), throw=False, max_steps=40)
    for name in ("renewed", "kept, near"):
        assert found[name].result == optx.RESULTS.successful
        assert abs(found[name].value[0] - 1) < 1e-12
    assert found["kept"].result == optx.RESULTS.nonlinear_divergence


def test_tolerances_for_constant_steps():
    """A root finder without a controller gets the given tolerances; an implicit Euler step is then y/(1 + h k)."""
    method = with_tolerances(diffrax.ImplicitEuler(root_finder=OF_CONTROLLER()), 1e-10, 1e-12)
    found = constant(lambda t, y, k: -k * y, jnp.array(1.0), 1e3, 4, method=method)
    assert abs(found.ys[0] / (1 + 250.0) ** -4 - 1) < 1e-9
    explicit = diffrax.Tsit5()
    assert with_tolerances(explicit, 1e-10, 1e-12) is explicit
