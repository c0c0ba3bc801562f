"""The linear-quadratic regulator about a trajectory: Riccati's equation by SciPy; a swing-up that is held."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are

import lagjax as lj
from tests.systems import motion as reference_motion

T, PARAMS = 3.0, {"m": 2.0, "k": 1.5}


def lagrangian(t, q, v, p):
    """A mass on a spring that hardens, and whose stiffness depends on time."""
    return 0.5 * p["m"] * v**2 - 0.5 * p["k"] * (1 + 0.3 * jnp.sin(t)) * q**2 - 0.25 * q**4


mass = lj.System(lagrangian, force=lambda t, q, v, p: p["push"] + 0.0 * v)
driven = lj.System(lagrangian, force=lambda t, q, v, p: jnp.sin(2 * t) + 0.0 * v)


def pushes(t):
    """The controls of the motion."""
    return {"push": jnp.sin(2 * t)}


def squares(t, q, v, u, p):
    """A cost with a product of position and push; its gradient along the motion is not zero."""
    return 3.0 * q**2 + 0.5 * v**2 + 2.0 * u["push"] ** 2 + 0.8 * q * u["push"]


def riccati(motion, times):
    """S (T, 2, 2) by DOP853 backward from 5 q² + v², with the motion itself."""

    def slopes(t, y):
        s, (q, v) = y[:4].reshape(2, 2), y[4:]
        stiffness = PARAMS["k"] * (1 + 0.3 * np.sin(t))
        a, b = np.array([[0.0, 1.0], [-(stiffness + 3 * q**2) / PARAMS["m"], 0.0]]), np.array([[0.0], [0.5]])
        cross = np.array([[0.4], [0.0]])
        ds = a.T @ s + s @ a - (s @ b + cross) @ (s @ b + cross).T / 2.0 + np.diag([3.0, 0.5])
        return np.concatenate([-ds.ravel(), [v, (np.sin(2 * t) - stiffness * q - q**3) / PARAMS["m"]]])

    end = np.concatenate([[5.0, 0.0, 0.0, 1.0], [motion.q[-1], motion.v[-1]]])
    found = solve_ivp(slopes, (T, 0.0), end, "DOP853", rtol=1e-12, atol=1e-12, t_eval=times[::-1])
    return found.y[:4, ::-1].T.reshape(-1, 2, 2)


@pytest.mark.slow
def test_riccati():
    """The cost to go to 1e-10 and gains to 1e-7 of SciPy's. Twin: without the end's cost they are others. Long before
    the end of an equilibrium the gains are those of the algebraic equation."""
    motion = lj.integrate(driven, 1.0, 0.0, PARAMS, ts=np.linspace(0.0, T, 21), rtol=1e-12, estimate_error=False)
    found = lj.lqr(mass, pushes, motion, squares, PARAMS, end_cost=lambda t, q, v, p: 5 * q**2 + v**2)
    times = np.array([0.0, 0.1, 1.234, 2.9])
    s = riccati(motion, times)
    np.testing.assert_allclose(found.cost_to_go, s[0], atol=1e-10)
    for t, at in zip(times, s):
        gain = (np.array([[0.0, 0.5]]) @ at + np.array([[0.4, 0.0]])) / 2.0
        np.testing.assert_allclose(found.gain(t), gain, atol=1e-7)
    off = np.array([0.02, -0.03])
    held = found.control(1.234, motion.at(1.234).q + off[0], motion.at(1.234).v + off[1])["push"]
    assert abs(held - (np.sin(2.468) - found.gain(1.234)[0] @ off)) < 1e-7
    bare = lj.lqr(mass, pushes, motion, squares, PARAMS)
    assert np.max(np.abs(bare.gain(2.9) - found.gain(2.9))) > 0.1

    spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, force=lambda t, q, v, p: p["push"] + 0.0 * v)
    rest = lj.integrate(spring, 0.0, 0.0, {"push": 0.0}, ts=[0.0, 30.0])
    long = lj.lqr(spring, lambda t: {"push": 0.0}, rest, lambda t, q, v, u, p: q**2 + v**2 + u["push"] ** 2)
    algebraic = solve_continuous_are(
        np.array([[0.0, 1.0], [-1.0, 0.0]]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1)
    )
    np.testing.assert_allclose(long.cost_to_go, algebraic, atol=1e-9)


@pytest.mark.exhaustive
def test_on_a_constraint():
    """A point that turns on a circle, by its angle and by its place on a rod: |q|² + |v|² + 3 (1 + y), which is
    1 + ω² + 3 (1 + sin θ) on the circle, has the same pushes and cost to go, and so has y as an end's cost. Twin:
    with the second derivatives of |q|² in the plane they are others."""
    turn, ts = 1.5, np.linspace(0.0, 2.0, 9)
    angle = lj.System(lambda t, q, v, p: 0.5 * v**2, force=lambda t, q, v, p: p["push"] + 0.0 * v)
    rod = lj.System(
        lambda t, q, v, p: 0.5 * v @ v,
        {"rod": lj.Holonomic(lambda t, q, p: 0.5 * (q @ q - 1.0))},
        force=lambda t, q, v, p: p["push"] * jnp.stack([-q[1], q[0]]),
    )
    by_angle, by_place = (
        lj.integrate(system, *start, {"push": 0.0}, ts=ts, rtol=1e-12)
        for system, start in ((angle, (0.0, turn)), (rod, (np.array([1.0, 0.0]), np.array([0.0, turn]))))
    )

    def none(t):
        return {"push": 0.0}

    one, bare = (
        lj.lqr(
            angle, none, by_angle,
            lambda t, q, v, u, p, w=w: w * q**2 + v**2 + 3 * (1 + jnp.sin(q)) + u["push"] ** 2,
            end_cost=lambda t, q, v, p: -jnp.sin(q),
        )
        for w in (0.0, 1.0)
    )  # fmt: skip
    other = lj.lqr(
        rod, none, by_place, lambda t, q, v, u, p: q @ q + v @ v + 3 * (1 + q[1]) + u["push"] ** 2,
        end_cost=lambda t, q, v, p: -q[1],
    )  # fmt: skip
    for t in (0.0, 0.7):
        along, out = np.array([-np.sin(turn * t), np.cos(turn * t)]), np.array([np.cos(turn * t), np.sin(turn * t)])
        # The columns: a turned place, with the velocity that turns with it, and a faster turn.
        moved = np.stack([np.concatenate([along, -turn * out]), np.concatenate([np.zeros(2), along])], axis=1)
        np.testing.assert_allclose(other.gain(t) @ moved, one.gain(t), atol=1e-6)
        if not t:
            np.testing.assert_allclose(moved.T @ other.cost_to_go @ moved, one.cost_to_go, atol=1e-10)
    assert np.max(np.abs(one.gain(0.0) - bare.gain(0.0))) > 0.1


def test_questions_that_are_wrong():
    """Controls that are no function, an end's cost without an end, and a control for nothing."""
    motion = reference_motion("driven")
    with pytest.raises(TypeError, match="controls about a trajectory must be a function of time, not {"):
        lj.lqr(mass, {"push": 0.0}, motion, squares, PARAMS)
    with pytest.raises(ValueError, match="end_cost belongs to a trajectory"):
        lj.lqr(mass, {"push": 0.0}, (0.0, 0.0), squares, PARAMS, end_cost=lambda t, q, v, p: q**2)
