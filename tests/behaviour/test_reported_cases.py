"""Systems that users of this and other libraries reported, each with its right value."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

ONE = np.array([0.0, 1.0])
kinetic = lambda t, q, v, p: 0.5 * v**2

# Whose numbers: what a function reads from outside.


@pytest.mark.slow
def test_a_new_model_has_its_own_numbers():
    """A model made after one of the same code has changed: h(1) = g and x(1) = -g/2. Twin: the one that has changed."""
    weighed = lambda model: lj.System(lambda t, q, v, p: kinetic(t, q, v, p) - model["g"] * q)
    integral = lambda s: lj.jacobi_integral(s, 0.0, 1.0, 0.0, None)
    fallen = lambda s: -2 * lj.integrate(s, 0.0, 0.0, ts=ONE, method=lj.Tsit5(), estimate_error=False).q[-1]
    first = {"g": 9.81}
    for of in (integral, fallen):
        np.testing.assert_allclose(of(weighed(first)), 9.81, rtol=1e-12)
    first["g"] = 4.0
    for of in (integral, fallen):
        np.testing.assert_allclose([of(weighed({"g": 9.81})), of(weighed(first))], [9.81, 4.0], rtol=1e-12)


OUTSIDE = types.SimpleNamespace(level=1.0, push=1.0)


def when_reached(level):
    """The time at which q = 2 t reaches a level that the guard reads from outside."""
    OUTSIDE.level = level
    at_level = {"level": lj.Crossing(lambda t, q, v, p: q - OUTSIDE.level)}
    return lj.integrate(lj.System(kinetic), 0.0, 2.0, ts=10 * ONE, events=at_level).end.t


def pushed(push):
    """Where a force that is read from outside has moved a unit mass at t = 1."""
    OUTSIDE.push = push
    return lj.integrate(lj.System(kinetic, force=lambda t, q, v, p: OUTSIDE.push), 0.0, 0.0, ts=ONE).q[-1]


@pytest.mark.slow
@pytest.mark.parametrize("function", [when_reached, pushed])
def test_a_guard_and_a_force_read_traced_numbers(function):
    """level/2 and push/2, and their derivatives, compiled, at two numbers."""
    compiled = jax.jit(jax.value_and_grad(function))
    np.testing.assert_allclose([compiled(3.0), compiled(4.0)], [[1.5, 0.5], [2.0, 0.5]], rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("nan", [3.0, 2.0])
def test_a_lagrangian_that_asks_for_nan(nan):
    """V = c q² with c where 0 · ∞ gives NaN: a = -2 c and q(1) = cos(sqrt(2 c)), for two c."""
    asked = lj.System(
        lambda t, q, v, p: kinetic(t, q, v, p) - jnp.nan_to_num(0.0 * (1 / jnp.array(0.0)), nan=nan) * q**2
    )
    np.testing.assert_allclose(lj.accelerations(asked, 0.0, 1.0, 0.0, None)[0], -2 * nan, rtol=1e-14)
    np.testing.assert_allclose(lj.integrate(asked, 1.0, 0.0, ts=ONE).q[-1], np.cos(np.sqrt(2 * nan)), rtol=1e-9)


# Advice.


@pytest.mark.slow
def test_no_advice_to_take_what_is_there():
    """In float64 at 1e-13 neither float64 nor a tighter rtol is advised, but a shorter span. Twin: that one helps."""
    lagrangian = lambda t, q, v, p: (
        0.5 * v @ v + 0.5 * v[0] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1]) + 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
    )
    until = lambda t: lj.integrate(lj.System(lagrangian), np.array([2.0, 2.5]), np.zeros(2), ts=[0.0, t], rtol=1e-13)
    with pytest.warns(lj.AccuracyWarning, match="(?s)amplifies errors.*\nFix: a shorter span") as said:
        until(30.0)
    fix = str(said[0].message).split("Fix:")[1]
    assert "float64" not in fix and "rtol" not in fix
    assert until(5.0).scaled_error < 1


# States of first order beside mechanics: coordinates without mass, whose velocities are constraints.

springs = lambda t, q, v, p: 0.5 * v["x"] ** 2 - 1.5 * q["s"] ** 2 - 3.0 * (q["x"] - q["s"]) ** 2
BETWEEN = {"x": 1.0, "s": 2 / 3}, {"x": 0.0, "s": 0.0}


@pytest.mark.slow
def test_a_massless_point_between_springs():
    """Springs of 3 and 6 in series are one of 2. The point's place must be said: without it, it is refused by name."""
    with pytest.raises(ValueError, match="(?s)singular in coordinate 's'.*or a constraint that determines it"):
        lj.accelerations(lj.System(springs), 0.0, *BETWEEN, None)
    balanced = lj.Holonomic(lambda t, q, p: 6.0 * (q["x"] - q["s"]) - 3.0 * q["s"])
    motion = lj.integrate(lj.System(springs, {"balanced": balanced}), *BETWEEN, ts=ONE)
    np.testing.assert_allclose(motion.q["x"][-1], np.cos(np.sqrt(2.0)), rtol=1e-9)
