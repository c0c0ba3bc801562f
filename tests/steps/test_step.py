"""One step: the method's own formula, measured orders, constraints at round-off, dtypes, and what is refused."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from tests.systems import HORIZONTAL, PARAMS, rod_pendulum

DAMPED = {"g": 9.0, "c": 0.3, "push": 2.0}
damped = lj.System(
    lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q),
    force=lambda t, q, v, params: params["push"] * jnp.cos(3.0 * t),
    dissipation=lambda t, q, v, params: 0.5 * params["c"] * v**2,
)


def rate(t, y, xp=np):
    """The damped, driven pendulum's equation by hand."""
    force = DAMPED["push"] * xp.cos(3.0 * t) - DAMPED["c"] * y[1]
    return xp.stack([y[1], force - DAMPED["g"] * xp.sin(y[0])])


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
    return state[1:]


def orders(errors):
    """The orders between step lengths that are halved."""
    return np.log2(np.array(errors[:-1]) / np.array(errors[1:]))


def test_kuttas_formula():
    """The step by hand; twin: with another weight it differs. Backward, the method of the same formula."""
    for h in (0.1, -0.1):
        found = lj.step(damped, 0.4, 1.2, -0.5, DAMPED, h)
        np.testing.assert_allclose(found, [0.4 + h, *kutta(0.4, np.array([1.2, -0.5]), h)], rtol=1e-14)
    assert abs(found[2] - kutta(0.4, np.array([1.2, -0.5]), -0.1, last=0.2)[1]) > 1e-2


@pytest.mark.parametrize(("method", "order", "counts"), [(None, 4, (64, 128, 256)), (lj.Tsit5(), 5, (32, 64, 128))])
def test_orders(method, order, counts):
    """The method's order on a nonlinear motion with a force that depends on time, and dissipation, against SciPy."""
    exact = solve_ivp(rate, (0.0, 3.0), [1.2, -0.5], method="DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    errors = [np.max(np.abs(np.array(after(damped, 1.2, -0.5, DAMPED, 3.0, n, method)) - exact)) for n in counts]
    assert np.all(np.abs(orders(errors) - order) < 0.35), errors
    # Twin: a method of another order would not pass.
    assert not np.any(np.abs(orders(errors) - (9 - order)) < 0.35)


def test_order_and_residuals_on_a_rod():
    """Order 4 with the constraint, which holds to round-off after steps of any length; twin: without the return not."""
    swing = solve_ivp(
        lambda t, y: [y[1], -PARAMS["g"] / PARAMS["l"] * np.sin(y[0])], (0.0, 1.0), [np.pi / 2, 0.0],
        method="DOP853", rtol=1e-13, atol=1e-14,
    ).y[:, -1]  # fmt: skip
    exact = PARAMS["l"] * np.array([np.sin(swing[0]), -np.cos(swing[0])])
    errors = []
    # x² + y² is a sum of numbers of the size of l², each a unit of round-off or two off.
    round_off = 16 * np.finfo(float).eps * PARAMS["l"] ** 2
    for count in (16, 32, 64):
        q, v = after(rod_pendulum, *HORIZONTAL, PARAMS, 1.0, count, None)
        errors.append(np.hypot(q["x"] - exact[0], q["y"] - exact[1]))
        assert abs(q["x"] ** 2 + q["y"] ** 2 - PARAMS["l"] ** 2) < round_off
        assert abs(q["x"] * v["x"] + q["y"] * v["y"]) < 8 * round_off
    assert np.all(np.abs(orders(errors) - 4) < 0.35), errors
    _, q, _ = lj.step(rod_pendulum, 0.0, *HORIZONTAL, PARAMS, 0.4)
    assert abs(q["x"] ** 2 + q["y"] ** 2 - PARAMS["l"] ** 2) < round_off
    term = diffrax.ODETerm(lambda t, y, args: (y[1], lj.accelerations(rod_pendulum, t, *y, PARAMS)[0]))
    moving = HORIZONTAL[0], {"x": 0.0, "y": -3.0}
    (q, _), *_ = jax.jit(lambda y: lj.RK4().step(term, 0.0, 0.2, y, None, None, True))(moving)
    assert abs(q["x"] ** 2 + q["y"] ** 2 - PARAMS["l"] ** 2) > 1e-6


def skate_lagrangian(t, q, v, params):
    """A skate on level ice: a unit mass that also turns."""
    return 0.5 * jnp.sum(v**2)


skate = lj.System(
    skate_lagrangian,
    {"blade": lj.Nonholonomic(lambda t, q, v, params: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))},
)


def test_a_constraint_of_velocities():
    """A skate that turns steadily runs on a circle, and its blade does not slip."""
    errors = []
    for count in (16, 32, 64):
        q, v = after(skate, jnp.zeros(3), jnp.array([1.5, 0.0, 2.0]), None, 2.0, count, None)
        errors.append(np.max(np.abs(q[:2] - 0.75 * np.array([np.sin(4.0), 1 - np.cos(4.0)]))))
        assert abs(v[0] * np.sin(q[2]) - v[1] * np.cos(q[2])) < 1e-14
    assert np.all(np.abs(orders(errors) - 4) < 0.35), errors


@pytest.mark.slow
def test_a_closed_loop():
    """Two rods of the same equation depend on each other: the step is that with one of them."""
    twice = lj.System(rod_pendulum.lagrangian, {**rod_pendulum.constraints, "again": rod_pendulum.constraints["rod"]})
    one, two = (lj.step(system, 0.0, *HORIZONTAL, PARAMS, 0.05) for system in (rod_pendulum, twice))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14), one, two)


def test_float32_stays_and_late_steps_are_as_long():
    """The dtype of the state, and steps of dt itself: the difference of two late times in float32 is rounded."""
    free = lj.System(lambda t, q, v, params: 0.5 * v**2)
    t, q, v = lj.step(free, 1e4, np.float32(0.0), np.float32(1.0), None, 1e-3)
    assert {x.dtype for x in (t, q, v)} == {np.dtype("float32")}
    assert abs(q - 1e-3) < 1e-9 < abs((np.float32(1e4) + np.float32(1e-3)) - np.float32(1e4) - 1e-3)


def test_refused():
    """A hybrid, an implicit method, a class, and a step that is no number, in words."""
    wall = lj.touches(lambda t, q, params: q, restitution=0.5)
    bouncing = lj.Hybrid({"flying": damped}, [lj.Switch("flying", to="flying", when=wall)])
    with pytest.raises(TypeError, match="has one for each of its phases"):
        lj.step(bouncing, 0.0, 1.0, 0.0, DAMPED, 0.1)
    for method in (lj.Radau5(), lj.RK4, diffrax.Kvaerno5()):
        with pytest.raises(TypeError, match=r"method must be lj.RK4\(\)"):
            lj.step(damped, 0.0, 1.0, 0.0, DAMPED, 0.1, method=method)
    for dt in (np.ones(2), "0.1", float("nan"), None):
        with pytest.raises(ValueError, match="dt must be one finite number"):
            lj.step(damped, 0.0, 1.0, 0.0, DAMPED, dt)
