"""Contacts with springs and dampers against closed forms and SciPy.

Sampled controls against the exact solutions of linear plants between instants.
"""

from itertools import pairwise, product
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import brentq
from scipy.special import gamma

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from tests.integrate.elements.test_motions import moved

K, G, MU = 1000.0, 9.81, 0.2


mat = lj.CompliantContact(lambda t, q, p: q, lambda p: p["k"], lambda p: p["c"])
thrown = lj.System(lambda t, q, v, p: 0.5 * v**2, elements={"mat": mat})


def returned(k, c):
    """The speed after an impact of speed 1."""
    ts = np.array([0.0, 3.0])
    return lj.integrate(thrown, 1.0, -1.0, {"k": k, "c": c}, ts=ts, rtol=1e-12, estimate_error=False).v[-1]


def restitution(k, c):
    """Schwager & Pöschel 2007: the contact ends where its force does, at ω t = π - arctan2(2 β ω, ω² - β²)."""
    b, w = c / 2, jnp.sqrt(k - c**2 / 4)
    return jnp.exp(-b / w * (jnp.pi - jnp.arctan2(2 * b * w, w**2 - b**2)))


@pytest.mark.exhaustive
def test_restitution():
    """Impacts of four dampings at once, up to heavy ones, and derivatives by stiffness and damping in both modes. Twin:
    contacts that pull until the gap opens return less."""
    c = np.array([0.0, 8.0, 40.0, 60.0])
    found = jax.vmap(lambda c: returned(K, c))(c)
    np.testing.assert_allclose(found, restitution(K, c), atol=1e-12)
    assert np.all(found[1:] > np.exp(-np.pi * c / 2 / np.sqrt(K - c**2 / 4))[1:] + 1e-3)
    wanted = jax.grad(restitution, (0, 1))(K, 8.0)
    for mode in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(mode(returned, (0, 1))(K, 8.0), wanted, rtol=1e-9)


def by_scipy(rate, start, ts, *args):
    """States (len(ts), n) of a motion whose forces have kinks, in small steps."""
    options = {"method": "DOP853", "rtol": 1e-11, "atol": 1e-13, "max_step": 2e-3}
    return solve_ivp(rate, (0.0, ts[-1]), start, t_eval=ts, args=args, **options).y.T


@pytest.mark.exhaustive
def test_a_damped_bounce():
    """A ball bounces, lets go below the mat's surface each time, where the mat would pull, and comes to rest on it."""
    ts, p = np.array([0.0, 0.5, 1.0, 2.0, 5.0]), {"k": K, "c": 8.0}
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - G * q, elements={"mat": mat})
    traj = moved(system, 0.5, 0.0, p, ts=ts, rtol=1e-12)
    push = lambda q, v: np.maximum(-K * q - 8.0 * v, 0.0) * (q < 0)
    states = by_scipy(lambda t, y: [y[1], push(*y) - G], [0.5, 0.0], ts)
    np.testing.assert_allclose(np.stack([traj.q, traj.v], 1), states, atol=1e-8)
    np.testing.assert_allclose(traj.multipliers["mat"], push(*states.T), atol=1e-5)
    assert len(traj.switches) == 9
    q, v = np.asarray(traj.switches.q)[:9], np.asarray(traj.switches.v)[:9]
    np.testing.assert_allclose(traj.switches.t[0], np.sqrt(1 / G), rtol=1e-12)
    np.testing.assert_allclose(q[::2], 0.0, atol=1e-11)
    np.testing.assert_allclose((K * q + 8.0 * v)[1::2], 0.0, atol=1e-8)
    assert np.all(q[1::2] < -1e-3)


@pytest.mark.exhaustive
@pytest.mark.parametrize("as_one", [False, True])
def test_friction_on_a_spring(as_one):
    """A block falls on a mat and slides until μ times the push, added up, has taken its speed: the time in closed form,
    from one element or two. Twin: the friction of its weight alone stops it at another time."""
    gap, sliding, mu = lambda t, q, p: q["y"], lambda t, q, v, p: v["x"], lambda p: p
    if as_one:
        elements: Any = {"mat": lj.CompliantContact(gap, K, 20.0, friction=mu, sliding=sliding)}
    else:
        elements = {"mat": lj.CompliantContact(gap, K, 20.0), "rub": lj.Friction(sliding, mu, normal="mat")}
    system = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - G * q["y"], elements=elements)
    start = {"x": 0.0, "y": 0.0}, {"x": 2.0, "y": -1.0}
    traj = moved(system, *start, MU, ts=np.array([0.0, 0.1, 3.0]), rtol=1e-12)
    w = np.sqrt(K - 100.0)
    of_speed = np.linalg.solve([[1, 0], [-10.0, w]], [G / K, -1.0])

    def speed(t):
        swing = np.exp(-10.0 * t) * np.array([np.cos(w * t), np.sin(w * t)])
        turned = np.array([-10.0 * swing[0] - w * swing[1], -10.0 * swing[1] + w * swing[0]])
        return 2.0 - MU * (of_speed @ turned + 1.0 + G * t)

    stops = float(np.asarray(brentq(speed, 0.5, 1.5, xtol=1e-14)))
    assert len(traj.switches) == 1 and np.asarray(traj.modes).tolist() == [[1, 1], [1, 1], [2, 1]]
    np.testing.assert_allclose(traj.switches.t[0], stops, rtol=1e-11)
    np.testing.assert_allclose(traj.v["x"][1:], [speed(0.1), 0.0], atol=1e-11)
    np.testing.assert_allclose(traj.multipliers["mat"][-1], G, rtol=1e-9)
    assert abs(stops - 2.0 / (MU * G)) > 0.05


@pytest.mark.exhaustive
def test_hertz():
    """Hertz's impact takes 4√π Γ(2/5)/(5 Γ(9/10)) times its depth over its speed; Hunt and Crossley's, by SciPy."""
    ball = lj.CompliantContact(lambda t, q, p: q, lambda d, p: 200.0 * d**0.5, lambda d, p: p * d**1.5)
    system = lj.System(lambda t, q, v, p: 0.5 * v**2, elements={"ball": ball})
    run = lambda c: moved(system, 1.0, -1.0, c, ts=np.array([0.0, 3.0]), rtol=1e-12)
    smooth = run(0.0)
    lasts = 4 * np.sqrt(np.pi) * gamma(0.4) / (5 * gamma(0.9)) * (5 / 800.0) ** 0.4
    np.testing.assert_allclose(smooth.switches.t[1] - smooth.switches.t[0], lasts, rtol=1e-11)
    np.testing.assert_allclose(smooth.v[-1], 1.0, atol=1e-11)
    out = lambda t, y: y[0] + 1e-30
    rate = lambda t, y: [y[1], max(-y[0], 0.0) ** 1.5 * (200.0 - 60.0 * y[1])]
    leaves = solve_ivp(rate, (0.0, 3.0), [0.0, -1.0], "DOP853", rtol=1e-12, atol=1e-15, events=out)
    np.testing.assert_allclose(run(60.0).v[-1], leaves.y[1, -1], atol=1e-9)


@pytest.mark.exhaustive
def test_single_precision_and_both_modes_in_lanes():
    """Lanes that fly, and that are pressed, in float32."""
    start, speed = np.array([[1.0, -0.01], [0.5, 0.0]], np.float32)
    p, ts = {"k": np.float32(K), "c": np.float32(0.0)}, np.array([0.0, 0.02], np.float32)
    found = jax.vmap(lambda q, v: lj.integrate(thrown, q, v, p, ts=ts))(start, speed)
    np.testing.assert_allclose(found.q[:, -1], [1.01, -0.01 * np.cos(0.02 * np.sqrt(K))], atol=1e-6)


@pytest.mark.exhaustive
def test_backlash_in_a_drive():
    """A motor turns a load through a play with elastic flanks, to and fro: by SciPy in small steps. Twin: without play
    the load goes elsewhere."""
    play, k, c = 0.05, 400.0, 2.0
    flanks = lambda t, q, p: p + jnp.stack([q["motor"] - q["load"], q["load"] - q["motor"]])
    drive = lj.System(
        lambda t, q, v, p: 0.5 * v["motor"] ** 2 + v["load"] ** 2,
        force=lambda t, q, v, p: {"motor": jnp.cos(3.0 * t), "load": 0.0},
        elements={"teeth": lj.CompliantContact(flanks, k, c)},
    )
    ts, still = np.array([0.0, 1.5, 3.0]), {"motor": 0.0, "load": 0.0}
    traj = moved(drive, still, still, play, ts=ts, rtol=1e-11)

    def rate(t, y, play):
        turn, speed = y[0] - y[1], y[2] - y[3]
        depth = abs(turn) - play
        push = np.sign(turn) * max(0.0, k * depth + c * np.sign(turn) * speed) if depth > 0 else 0.0
        return [y[2], y[3], np.cos(3.0 * t) - push, push / 2]

    end, tight = (by_scipy(rate, np.zeros(4), ts, b)[-1] for b in (play, 0.0))
    np.testing.assert_allclose([x[name][-1] for x in (traj.q, traj.v) for name in ("motor", "load")], end, atol=1e-8)
    assert {traj.switches.ways[i] for i in traj.switches.way[: len(traj.switches)]} == {"teeth[0]", "teeth[1]"}
    assert abs(tight[1] - end[1]) > 1e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("sliding", "v0", "ends", "steps"),
    [
        (lambda t, q, v, mu: v[0], [0.3, 0.0, 0.0], [3.0, 100.0, 1e4], 20),
        (lambda t, q, v, mu: v[:2], [1.2, 1.6, 0.0], [3.0, 100.0], 100),
    ],
)
@pytest.mark.filterwarnings("error")
def test_a_block_that_stops_in_a_long_motion(sliding, v0, ends, steps):
    """It stops after v²/2 μ g, along a line or in a plane, and stays, in steps that do not depend on how long it is
    followed, without a warning. Twin: with another μ it is somewhere else."""
    # A rough spring, in equilibrium at z = 0.
    rough = lj.CompliantContact(lambda t, q, mu: q[2] - G / K, K, friction=lambda mu: mu, sliding=sliding)
    system = lj.System(lambda t, q, v, mu: 0.5 * jnp.sum(v**2) - G * q[2], elements={"mat": rough})
    places = {mu: np.linalg.norm(v0) / (2 * mu * G) * np.array(v0) for mu in (0.3, 0.31)}
    for mu, T in product(places, ends):
        traj = lj.integrate(system, np.zeros(3), np.array(v0), mu, ts=np.array([0.0, T / 2, T]), rtol=1e-11)
        assert isinstance(traj, HybridTrajectory) and int(traj.stats["num_steps"]) < steps
        np.testing.assert_allclose(traj.q[1:], 2 * [places[mu]], rtol=1e-10, atol=1e-11)
        assert len(traj.switches) == 1 or np.size(traj.modes[0]) > 2
    assert np.linalg.norm(places[0.31] - places[0.3]) > 1e-5


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
