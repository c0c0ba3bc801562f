"""Sampled controls against the exact solutions of linear plants between instants."""

from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import lagjax as lj
from tests.integrate.elements.test_motions import moved

W, Z, T, N = 2.0, 0.1, 0.13, 40
GAINS = {"kp": 3.0, "kd": 1.0}
PLANT = np.array([[0.0, 1.0, 0.0], [-(W**2), -2 * Z * W, 1.0], [0.0, 0.0, 0.0]])
START = {"x": 1.0, "u": 0.0}, {"x": 0.0}
pushed = lambda t, q, v, p: {"x": q["u"], "u": 0.0}


def controller(t, q, v, p):
    """A controller with memory: half of its last output, and the state."""
    return 0.5 * q["u"] - p["kp"] * q["x"] - p["kd"] * v["x"]


def oscillator(every) -> lj.System:
    """A damped oscillator under that control."""
    return lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2 - 0.5 * W**2 * q["x"] ** 2,
        dissipation=lambda t, q, v, p: Z * W * v["x"] ** 2,
        force=pushed,
        elements={"u": lj.SampledControl(controller, every=every)},
    )


def exact(gains, every=T, end=N * T):
    """The states at instants, the held outputs, and the last state: x_{k+1} = A x_k + B u_k."""
    x, u, states, outputs, times = np.array([1.0, 0.0]), 0.0, [], [], np.arange(0.0, end * (1 - 1e-14), every)
    for t, after in pairwise([*times, end]):
        u = 0.5 * u - gains["kp"] * x[0] - gains["kd"] * x[1]
        states.append(x)
        outputs.append(u)
        x = (expm(PLANT * (after - t)) @ np.array([*x, u]))[:2]
    return np.array([*states, x]), np.array(outputs)


@pytest.mark.slow
def test_an_oscillator():
    """The state at forty instants, and what is held from each on. Twin: another period ends elsewhere."""
    traj, (states, outputs) = moved(oscillator(T), *START, GAINS, ts=np.arange(N + 1) * T, rtol=1e-12), exact(GAINS)
    np.testing.assert_allclose(np.stack([traj.q["x"], traj.v["x"]], 1), states, atol=1e-12)
    np.testing.assert_allclose(traj.q["u"][:-1], outputs, atol=1e-12)
    assert len(traj.switches) == N - 1 and np.asarray(traj.modes)[:, 0].tolist() == [*range(1, N + 1), N]
    np.testing.assert_allclose(traj.switches.t[: N - 1], np.arange(1, N) * T, rtol=1e-15)
    assert abs(exact(GAINS, 1.1 * T)[0][-1, 0] - states[-1, 0]) > 1e-3


@pytest.mark.exhaustive
def test_derivatives_by_gains_and_period():
    """In both modes, by complex steps of the exact solution, and by differences for the period."""
    system = oscillator(lambda p: p["T"])

    def end(p):
        return lj.integrate(system, *START, p, ts=np.array([0.0, 2.0]), rtol=1e-12, estimate_error=False).q["x"][-1]

    period, h = 0.3, 1e-6
    p = GAINS | {"T": period}
    wanted = {k: exact(GAINS | {k: GAINS[k] + 1e-30j}, period, 2.0)[0][-1, 0].imag / 1e-30 for k in GAINS}
    wanted["T"] = (exact(GAINS, period + h, 2.0)[0][-1, 0] - exact(GAINS, period - h, 2.0)[0][-1, 0]) / (2 * h)
    for found in (jax.jacfwd(end)(p), jax.grad(end)(p)):
        for k in GAINS:
            np.testing.assert_allclose(found[k], wanted[k], rtol=1e-10)
        np.testing.assert_allclose(found["T"], wanted["T"], rtol=1e-8)
    periods = jnp.array([0.13, 0.3, 0.5, 1.7])
    lanes = jax.jit(jax.vmap(lambda T: end(GAINS | {"T": T})))(periods)
    np.testing.assert_allclose(lanes, [exact(GAINS, float(T), 2.0)[0][-1, 0] for T in periods], atol=1e-11)


def against_a_stop(gain, ts):
    """A free mass under gain cos(2 t), held for 1/4 each, with a plastic stop at 0.2: exact, instant by instant."""
    x, v, found = 0.0, 0.0, {0.0: 0.0}
    for t, after in pairwise(np.arange(0.0, ts[-1] + 0.1, 0.25)):
        u, h = gain * np.cos(2 * t), 0.25
        rests = x == 0.2 and v == 0.0 and u > 0
        reach = [s.real for s in np.roots([0.5 * u, v, x - 0.2]) if s.imag == 0 and 1e-12 < s.real <= h]
        if rests or reach:
            x, v = 0.2, 0.0
            assert rests or u > 0
        else:
            x, v = x + v * h + 0.5 * u * h**2, v + u * h
        found[after] = x
    return np.array([found[t] for t in ts])


@pytest.mark.exhaustive
def test_a_motor_against_a_stop():
    """It drives a mass to a stop, presses, and draws it back at the instant at which its force turns."""
    motor = lj.SampledControl(lambda t, q, v, gain: gain * jnp.cos(2.0 * t), every=0.25)
    end = lj.Stop(lambda t, q, p: q["x"], high=0.2)
    system = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2, force=pushed, elements={"u": motor, "end": end})
    ts = np.arange(0.0, 4.1, 0.5)
    traj = moved(system, {"x": 0.0, "u": 0.0}, {"x": 0.0}, 1.0, ts=ts, rtol=1e-12)
    np.testing.assert_allclose(traj.q["x"], against_a_stop(1.0, ts), atol=1e-12)
    assert traj.switches.ways == ("end", "u") and np.asarray(traj.switches.way)[:4].tolist() == [1, 1, 0, 1]
    assert np.max(np.abs(traj.q["x"] - against_a_stop(1.01, ts))) > 1e-3


@pytest.mark.exhaustive
def test_two_periods_and_an_event():
    """Two controllers, one of which reads the other's output, with instants in common, until an event; a motion that is
    continued from its end goes on as if it had not ended."""
    outer = lj.SampledControl(lambda t, q, v, p: 1.0 - q["x"], every=0.3)
    inner = lj.SampledControl(lambda t, q, v, p: 4.0 * q["w"] - 2.0 * v["x"], every=0.2, offset=0.1)
    system = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2, force=lambda t, q, v, p: {"x": q["u"], "u": 0.0, "w": 0.0},
                       elements={"u": inner, "w": outer})  # fmt: skip
    start = {"x": 0.0, "u": 0.0, "w": 0.0}, {"x": 0.0}
    x = v = u = w = 0.0
    k = 0
    for k in range(50):
        u, w = 4.0 * w - 2.0 * v if k % 2 == 1 else u, 1.0 - x if k % 3 == 0 else w
        after = x + 0.1 * v + 0.005 * u
        if after > 0.5:
            break
        x, v = after, v + 0.1 * u
    reached = lambda s: x + v * s + 0.5 * u * s**2 - 0.5
    passes = 0.1 * k + float(np.asarray(brentq(reached, 0.0, 0.1, xtol=1e-15)))
    half = {"half": lj.Crossing(lambda t, q, v, p: q["x"] - 0.5)}
    traj = moved(system, *start, None, ts=np.array([0.0, 5.0]), events=half, rtol=1e-12)
    np.testing.assert_allclose(traj.end.t, passes, rtol=1e-12)
    ts = np.array([0.0, 0.9, 2.0])
    whole, first = (moved(system, *start, None, ts=x, rtol=1e-12) for x in (ts, ts[:2]))
    rest = moved(system, first.end.q, first.end.v, None, ts=ts[1:], rtol=1e-12)
    np.testing.assert_allclose([rest.q[k][-1] for k in "xuw"], [whole.q[k][-1] for k in "xuw"], atol=1e-11)
