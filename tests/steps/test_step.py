"""One step: the method's own formula, measured orders, constraints at round-off, dtypes, and what is refused."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from tests.by_numpy import equations
from tests.systems import DRIVEN_PARAMS, HORIZONTAL, PARAMS, driven, pendulum, rod_pendulum

# The driven oscillator, so that L, a force that depends on time, and dissipation all enter.
START = 0.4, 1.2, -0.5


def rate(t, y):
    """Its equation by hand."""
    m, k, c, pull, w = (DRIVEN_PARAMS[name] for name in ("m", "k", "c", "pull", "rate"))
    return np.array([y[1], (pull * np.cos(w * t) - c * y[1] - k * y[0]) / m])


def kutta(t, y, h, last=1 / 6):
    """Kutta's step by hand; `last`: the weight of the fourth stage."""
    k1 = rate(t, y)
    k2 = rate(t + h / 2, y + h / 2 * k1)
    k3 = rate(t + h / 2, y + h / 2 * k2)
    k4 = rate(t + h, y + h * k3)
    return y + h * (k1 / 6 + k2 / 3 + k3 / 3 + last * k4)


def after(system, q, v, params, span, count, method):
    """The position and velocity after so many steps, which are one program whatever their length."""
    state = 0.0, q, v
    for _ in range(count):
        state = lj.step(system, *state, params, span / count, method=method)
    return jax.tree.map(np.asarray, state[1:])


def assert_orders(errors, order):
    """Between step lengths that are halved; another order would not pass."""
    measured = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(np.abs(measured - order) < 0.35), errors
    assert not np.any(np.abs(measured - (9 - order)) < 0.35)


def test_kuttas_formula():
    """The step by hand; twin: with another weight it differs. Backward, the method of the same formula."""
    t, *y = START
    for h in (0.1, -0.1):
        found = lj.step(driven, *START, DRIVEN_PARAMS, h)
        np.testing.assert_allclose(found, [t + h, *kutta(t, np.array(y), h)], rtol=1e-14)
    assert abs(found[2] - kutta(t, np.array(y), -0.1, last=0.2)[1]) > 1e-2


def swung(angle, rate, span, pull):
    """The pendulum's angle and rate after a span, by SciPy."""
    slope = lambda t, y: [y[1], -pull * np.sin(y[0])]
    return solve_ivp(slope, (0.0, span), [angle, rate], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]


@pytest.mark.parametrize(("method", "order"), [(None, 4), (lj.Tsit5(), 5)])
def test_orders(method, order):
    """The method's order on a nonlinear motion, against SciPy."""
    exact, params = swung(2.0, 1.0, 4.0, 1.0), {"g": 1.0, "l": 1.0}
    ends = [after(pendulum, 2.0, 1.0, params, 4.0, count, method) for count in (32, 64, 128)]
    assert_orders([np.max(np.abs(np.array(end) - exact)) for end in ends], order)


def off_the_rod(q, v):
    """By how much both levels of the constraint are missed, in units of the round-off of l²."""
    unit = 16 * np.finfo(float).eps * PARAMS["l"] ** 2
    levels = q["x"] ** 2 + q["y"] ** 2 - PARAMS["l"] ** 2, (q["x"] * v["x"] + q["y"] * v["y"]) / 8
    return np.max(np.abs(levels)) / unit


def test_order_and_residuals_on_a_rod():
    """Order 4 with the constraint, which holds to round-off after steps of any length; twin: without the return not."""
    angle, _ = swung(np.pi / 2, 0.0, 1.0, PARAMS["g"] / PARAMS["l"])
    exact = PARAMS["l"] * np.array([np.sin(angle), -np.cos(angle)])
    errors = []
    for count in (16, 32, 64):
        q, v = after(rod_pendulum, *HORIZONTAL, PARAMS, 1.0, count, None)
        errors.append(np.hypot(q["x"] - exact[0], q["y"] - exact[1]))
        assert off_the_rod(q, v) < 1
    assert_orders(errors, 4)
    assert off_the_rod(*after(rod_pendulum, *HORIZONTAL, PARAMS, 0.4, 1, None)) < 1
    # Twin: Kutta's formula on the accelerations.
    x, h = np.array([1.25, 0.0, 0.0, -3.0]), 0.2

    def slope(y):
        a = equations(rod_pendulum, 0.0, dict(x=y[0], y=y[1]), dict(x=y[2], y=y[3]), PARAMS).a
        return np.array([y[2], y[3], a["x"], a["y"]])

    k1 = slope(x)
    k2 = slope(x + h / 2 * k1)
    k3 = slope(x + h / 2 * k2)
    x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))
    assert abs(x[0] ** 2 + x[1] ** 2 - PARAMS["l"] ** 2) > 1e-6


def skate_lagrangian(t, q, v, params):
    """A skate on level ice: a unit mass that also turns."""
    return 0.5 * jnp.sum(v**2)


skate = lj.System(
    skate_lagrangian, {"blade": lj.Nonholonomic(lambda t, q, v, params: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))}
)


@pytest.mark.slow
def test_a_constraint_of_velocities():
    """A skate that turns steadily runs on a circle, and its blade does not slip."""
    errors = []
    for count in (16, 32, 64):
        q, v = after(skate, np.zeros(3), np.array([1.5, 0.0, 2.0]), None, 2.0, count, None)
        errors.append(np.max(np.abs(q[:2] - 0.75 * np.array([np.sin(4.0), 1 - np.cos(4.0)]))))
        assert abs(v[0] * np.sin(q[2]) - v[1] * np.cos(q[2])) < 1e-14
    assert_orders(errors, 4)


@pytest.mark.slow
def test_a_closed_loop():
    """Two rods of the same equation depend on each other: the step is that with one of them."""
    twice = lj.System(rod_pendulum.lagrangian, {**rod_pendulum.constraints, "again": rod_pendulum.constraints["rod"]})
    one, two = (lj.step(system, 0.0, *HORIZONTAL, PARAMS, 0.05) for system in (rod_pendulum, twice))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14), one, two)


def test_float32_stays_and_late_steps_are_as_long():
    """The dtype of the state, and steps of dt itself: the difference of two late times in float32 is rounded."""
    t, q, v = lj.step(pendulum, 1e4, np.float32(0.0), np.float32(1.0), {"g": 0.0, "l": 1.0}, 1e-3)
    assert {x.dtype for x in (t, q, v)} == {np.dtype("float32")}
    assert abs(q - 1e-3) < 1e-9 < abs((np.float32(1e4) + np.float32(1e-3)) - np.float32(1e4) - 1e-3)


def test_refused():
    """A hybrid, an implicit method, a class, and a step that is no number, in words."""
    wall = lj.guards.touches(lambda t, q, params: q, restitution=0.5)
    bouncing = lj.Hybrid({"flying": pendulum}, [lj.Switch("flying", to="flying", when=wall)])
    with pytest.raises(TypeError, match="has one for each of its phases"):
        lj.step(bouncing, 0.0, 1.0, 0.0, PARAMS, 0.1)
    for method in (lj.Radau5(), lj.RK4, diffrax.Kvaerno5()):
        with pytest.raises(TypeError, match=r"method must be lj.RK4\(\)"):
            lj.step(pendulum, 0.0, 1.0, 0.0, PARAMS, 0.1, method=method)
    for dt in (np.ones(2), "0.1", float("nan"), None):
        with pytest.raises(ValueError, match="dt must be one finite number"):
            lj.step(pendulum, 0.0, 1.0, 0.0, PARAMS, dt)
