"""States of first order beside elements: actuators, running costs and bristles, with stops, friction and contacts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from tests.integrate.elements.test_motions import BY_MU, MU, REST, K, moved

LAG = 0.3


@pytest.mark.exhaustive
def test_an_actuator_with_a_stop():
    """A drive that lags pushes a mass against a stop, by SciPy from impact to impact; a cost as large as 1e6 beside it
    changes nothing. Twin: without the lag the stop is struck earlier."""
    drive = lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2,
        force=lambda t, q, v, p: {"x": q["z"], "z": 0.0, "cost": 0.0},
        states={"z": lambda t, q, v, p: (p - q["z"]) / LAG, "cost": lambda t, q, v, p: 1e6 * v["x"] ** 2},
        elements={"end": lj.Stop(lambda t, q, p: q["x"], high=1.0, restitution=0.5)},
    )
    run = lambda w: moved(drive, {"x": 0.0, "z": 0.0, "cost": 0.0}, {"x": 0.0}, w, ts=np.array([0.0, 2.5]), rtol=1e-12)

    def struck(w: float):
        end: Any = lambda t, y: y[0] - 1.0
        end.terminal, end.direction = True, 1
        rate = lambda t, y: [y[1], y[2], (w - y[2]) / LAG, 1e6 * y[1] ** 2]
        first = solve_ivp(rate, (0.0, 2.5), np.zeros(4), "DOP853", events=end, rtol=1e-13, atol=1e-13)
        y = first.y[:, -1] * np.array([1.0, -0.5, 1.0, 1.0]) - np.array([1e-14, 0.0, 0.0, 0.0])
        last = solve_ivp(rate, (first.t[-1], 2.5), y, "DOP853", rtol=1e-13, atol=1e-13)
        return first.t[-1], last.y[:, -1]

    traj, (when, end) = run(1.0), struck(1.0)
    assert len(traj.switches) == 1
    np.testing.assert_allclose(traj.switches.t[0], when, rtol=1e-10)
    np.testing.assert_allclose([traj.q["x"][-1], traj.v["x"][-1], traj.q["z"][-1]], end[:3], atol=1e-9)
    np.testing.assert_allclose(traj.q["cost"][-1], end[3], rtol=1e-9)
    np.testing.assert_allclose(traj.switches.v_after["cost"][0], 1e6 * traj.switches.v_after["x"][0] ** 2, rtol=1e-14)
    slope = (struck(1.0 + 1e-5)[1][0] - struck(1.0 - 1e-5)[1][0]) / 2e-5
    np.testing.assert_allclose(jax.grad(lambda w: run(w).q["x"][-1])(1.0), slope, rtol=1e-6)
    assert when > np.sqrt(2.0) + 0.1


@pytest.mark.exhaustive
def test_a_cost_beside_friction():
    """The integral of v² while dry friction stops a block on a spring: A² ω π/2 for each half swing A; derivatives in
    both modes. Twin: the derivative without that of the amplitudes is zero."""
    costly = lj.System(
        lambda t, q, v, mu: 0.5 * v["x"] ** 2 - 0.5 * K * q["x"] ** 2,
        states={"cost": lambda t, q, v, mu: v["x"] ** 2},
        elements={"floor": lj.Friction(lambda t, q, v, mu: v["x"], lambda mu: mu, normal=9.81)},
    )
    run = lambda mu: moved(costly, {"x": 0.5, "cost": 0.0}, {"x": 0.0}, mu, ts=np.array([0.0, 4.0]), rtol=1e-12)
    swings, by_mu = 0.5 - np.arange(1, 16, 2) * MU * 9.81 / K, -np.arange(1, 16, 2) * 9.81 / K
    last = run(MU)
    np.testing.assert_allclose(last.q["x"][-1], REST, atol=1e-10)
    np.testing.assert_allclose(last.q["cost"][-1], 5 * np.pi * np.sum(swings**2), rtol=1e-10)
    ends = lambda mu: (lambda q: jnp.stack([q["x"][-1], q["cost"][-1]]))(run(mu).q)
    for found in (jax.jvp(ends, (MU,), (1.0,))[1], jax.jacrev(ends)(MU)):
        np.testing.assert_allclose(found, [BY_MU, 10 * np.pi * np.sum(swings * by_mu)], rtol=1e-8)


@pytest.mark.exhaustive
def test_a_bristle_beside_a_contact():
    """LuGre's bristle under a block, beside balls that bounce off a mat and a rigid floor: it moves as if alone."""
    bending = lambda t, q, v, p: v["x"] - 100.0 * jnp.sqrt(v["x"] ** 2 + 1e-6) * q["z"]
    energy = lambda t, q, v, p: 0.5 * v["x"] ** 2 - (0.1 * t - q["x"]) ** 2
    rub = lambda t, q, v, p: {k: jnp.zeros(()) for k in q} | {"x": -100.0 * q["z"] - 10.0 * v["z"]}
    alone = lj.System(energy, force=rub, states={"z": bending})
    beside = lj.System(
        lambda t, q, v, p: energy(t, q, v, p) + 0.5 * (v["y"] ** 2 + v["s"] ** 2) - 10.0 * (q["y"] + q["s"]),
        force=rub,
        states={"z": bending},
        elements={
            "floor": lj.Contact(lambda t, q, p: q["y"], restitution=0.5),
            "mat": lj.CompliantContact(lambda t, q, p: q["s"], 400.0),
        },
    )
    ts, start = np.array([0.0, 2.0, 4.0]), {"x": 0.0, "z": 0.0}
    one = lj.integrate(alone, start, {"x": 0.0}, ts=ts, rtol=1e-11)
    both = moved(beside, start | {"y": 5.0, "s": 5.0}, {"x": 0.0, "y": 0.0, "s": 0.0}, None, ts=ts, rtol=1e-11)
    np.testing.assert_allclose(both.q["x"], one.q["x"], atol=1e-9)
    np.testing.assert_allclose(both.q["z"], one.q["z"], atol=1e-9)
    assert "floor" in {both.switches.ways[i] for i in both.switches.way[: len(both.switches)]}
    np.testing.assert_allclose(0.5 * both.v["s"][-1] ** 2 + 10.0 * both.q["s"][-1], 50.0, rtol=1e-8)
