"""The linear-quadratic regulator: closed forms, free and on a constraint."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

import lagjax as lj
from lagjax.two_points import LQR

mass = lj.System(
    lambda t, q, v, p: 0.5 * p["m"] * v**2 - 0.5 * p["k"] * q**2, force=lambda t, q, v, p: p["push"] + 0.0 * v
)


def squares(t, q, v, u, p):
    """A cost with a product of position and push."""
    return 3.0 * q**2 + 0.5 * v**2 + 2.0 * u["push"] ** 2 + 0.8 * q * u["push"]


def test_a_mass():
    """Riccati's equation of a mass on a spring, with a cost of position times push, is solved."""
    m, k = 2.0, -5.0
    found = lj.lqr(mass, {"push": 0.0}, (0.0, 0.0), squares, {"m": m, "k": k})
    assert isinstance(found, LQR)
    a, b = np.array([[0.0, 1.0], [-k / m, 0.0]]), np.array([[0.0], [1 / m]])
    cross, s = np.array([[0.4], [0.0]]), np.asarray(found.cost_to_go)
    residual = a.T @ s + s @ a - (s @ b + cross) @ (b.T @ s + cross.T) / 2.0 + np.diag([3.0, 0.5])
    np.testing.assert_allclose(residual, 0.0, atol=1e-12 * np.max(np.abs(a.T @ s)))
    np.testing.assert_allclose(found.gain, (b.T @ s + cross.T) / 2.0, rtol=1e-12)
    assert np.max(np.real(found.eigenvalues)) < 0 and np.all(np.linalg.eigvalsh(s) > 0)
    # Twin: the sign of the spring changes the gain.
    other = lj.lqr(mass, {"push": 0.0}, (0.0, 0.0), squares, {"m": m, "k": -k})
    assert isinstance(other, LQR) and np.max(np.abs(other.gain - found.gain)) > 1.0
    assert abs(found.control(1.0, 2.0)["push"] + found.gain[0, 0] + 2 * found.gain[0, 1]) < 1e-12


def test_questions_that_are_wrong():
    """No equilibrium, a cost that is not least there, a control for nothing, a motion that is not reached."""
    spring, rest = {"m": 1.0, "k": 1.0}, (0.0, 0.0)
    with pytest.raises(ValueError, match="not an equilibrium: 'q' accelerates by -1"):
        lj.lqr(mass, {"push": 0.0}, (1.0, 0.0), lambda t, q, v, u, p: (q - 1) ** 2 + u["push"] ** 2, spring)
    held = lj.lqr(mass, {"push": 1.0}, (1.0, 0.0), lambda t, q, v, u, p: (q - 1) ** 2 + (u["push"] - 1) ** 2, spring)
    assert abs(held.control(1.0, 0.0)["push"] - 1.0) < 1e-12
    with pytest.raises(ValueError, match="the cost is not least"):
        lj.lqr(mass, {"push": 1.0}, (1.0, 0.0), lambda t, q, v, u, p: (q - 1) ** 2 + u["push"] ** 2, spring)
    with pytest.raises(ValueError, match="'push' costs nothing"):
        lj.lqr(mass, {"push": 0.0}, rest, lambda t, q, v, u, p: q**2, spring)
    two = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2), force=lambda t, q, v, p: jnp.array([1.0, 0.0]) * p["push"])
    with pytest.raises(ValueError, match=r"do not reach the motion of '(q|v)\[1\]'"):
        lj.lqr(two, {"push": 0.0}, (jnp.zeros(2), jnp.zeros(2)), lambda t, q, v, u, p: jnp.sum(q**2) + u["push"] ** 2)


@pytest.mark.slow
def test_a_cost_that_slopes_across_a_constraint():
    """A pendulum on a rod, hanging and upright, with 10 (1 ∓ y): on the rod that is 10 (1 - cos), whose curvature the
    second derivatives in the plane lack. Gains are those of the angle, by SciPy. Twin: without it they are others."""
    rod = lj.Holonomic(lambda t, q, p: q["x"] ** 2 + q["y"] ** 2 - 1)
    pendulum = lj.System(
        lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 9.81 * q["y"],
        {"rod": rod},
        force=lambda t, q, v, p: {"x": -q["y"] * p["u"], "y": q["x"] * p["u"]},
    )
    for sign, y in ((1, -1.0), (-1, 1.0)):
        at = {"x": 0.0, "y": y}, {"x": 0.0, "y": 0.0}
        found = lj.lqr(
            pendulum, {"u": 0.0}, at,
            lambda t, q, v, u, p, sign=sign: 10 * (1 + sign * q["y"]) + v["x"] ** 2 + v["y"] ** 2 + u["u"] ** 2,
        )  # fmt: skip
        assert isinstance(found, LQR)
        a, b = np.array([[0.0, 1.0], [-sign * 9.81, 0.0]]), np.array([[0.0], [1.0]])
        s, bare = (solve_continuous_are(a, b, np.diag([w, 1.0]), np.eye(1)) for w in (5.0, 0.0))
        np.testing.assert_allclose(np.abs(found.gain[0, [0, 2]]), s[1], rtol=1e-9)
        roots = np.sort_complex(np.linalg.eigvals(a - b @ b.T @ s))
        np.testing.assert_allclose(np.sort_complex(found.eigenvalues), roots, rtol=1e-8)
        assert np.max(np.abs(s[1] - bare[1])) > 0.03
