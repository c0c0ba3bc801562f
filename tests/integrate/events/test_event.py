"""Crossings of guards: none missed, none invented, in order, with their states, multipliers and derivatives."""

import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.events.event import crossings_of
from tests.systems import PARAMS, rod_pendulum
from tests.tiers import exhaustive_but

G = 10.0
HIT = diffrax.Event(lambda t, y, p, **kwargs: y[0], direction=False)
oscillator = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2)
# Most tests below share one program and differ only in numbers: a mass on a spring, or a ball that falls.
plant = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["k"] * q**2 - p["g"] * q)
EVENTS = {
    "level": lj.Crossing(lambda t, q, v, p: q - p["level"], terminal=False, most=6),
    "stop": lj.Crossing(lambda t, q, v, p: p["by_q"] * q + p["by_v"] * v - p["stop"], direction=-1),
    "up": lj.Crossing(lambda t, q, v, p: q - p["level"], direction=1, terminal=False),
}
SPRING = {"k": 1.0, "g": 0.0, "by_q": 0.0, "by_v": 1.0}
BALL = {"k": 0.0, "g": G, "by_q": 1.0, "by_v": 0.0, "level": 1.0}
doubt = pytest.warns(lj.EventWarning, match="may be missing")


def swing(q0, v0, level, ts, stop=2.0, rtol=1e-9, **options):
    """The oscillator of period 2π with recorded crossings of a level; it stops where v falls below `stop`."""
    params = SPRING | {"level": level, "stop": stop}
    return lj.integrate(plant, q0, v0, params, ts=ts, events=EVENTS, rtol=rtol, atol=rtol, **options)


def fall(q0, v0, ts, floor=0.0):
    """The ball, until it falls through the floor."""
    return lj.integrate(plant, q0, v0, BALL | {"stop": floor}, ts=ts, events=EVENTS, rtol=1e-9, atol=1e-9)


def times(traj, name="level"):
    """Return the times of the crossings that were found."""
    return traj.events[name].found().t


# Basic use.


def test_a_ball_bounces_fifty_times():
    """The floor is hit within the first step, and after each bounce down to heights of 1e-12: no hit is missed."""
    end = fall(0.0, 0.05, [0.0, 0.05, 0.1]).end
    assert float(end.t) == pytest.approx(0.01, abs=1e-15)
    assert float(end.q) == pytest.approx(0.0, abs=1e-17)
    t, q, v, restitution = 0.0, 0.0, 3.0, 0.75
    for bounce in range(50):
        traj = fall(q, v, [t, t + 5.0, t + 10.0])
        assert traj.result == lj.RESULTS.event_occurred, bounce
        t, q, v = float(traj.end.t), float(traj.end.q), -restitution * float(traj.end.v)
    np.testing.assert_allclose(v, 3.0 * restitution**50, rtol=1e-6)
    np.testing.assert_allclose(t, 2 * 3.0 / G * (1 - restitution**50) / (1 - restitution), rtol=1e-12)


def test_recorded_until_a_terminal_one():
    """In the step that ends the motion, crossings and outputs are recorded up to the end, with their states."""
    for end in (1.0, 1.5, 2.5, 3.1):
        traj = swing(0.0, 1.0, 0.9, [0.0, 1.2, 10.0], stop=np.cos(end))
        before = [t for t in (np.arcsin(0.9), np.pi - np.arcsin(0.9)) if t < end]
        np.testing.assert_allclose(times(traj), before, atol=1e-8)
        assert int(traj.events["level"].count) == len(before)
        np.testing.assert_allclose(times(traj, "stop"), [end], atol=1e-8)
        assert np.isfinite(traj.q).tolist() == [True, end > 1.2, False]
        found = traj.events["level"].found()
        np.testing.assert_allclose(found.q, 0.9, atol=1e-14)
        np.testing.assert_allclose(found.v, np.cos(before), atol=1e-8)


def test_more_than_are_kept():
    """All crossings are counted, the first ones are kept, and a warning says so."""
    with pytest.warns(lj.EventWarning, match="happened 8 times, but only the first 6 are kept"):
        found = swing(0.0, 1.0, 0.3, [0.0, 10.0, 25.0]).events["level"]
    assert int(found.count) == 8 and found.t.shape == (6,)
    assert "8, of which the first 6" in repr(found)
    first, k = np.arcsin(0.3), np.arange(6)
    np.testing.assert_allclose(found.t, np.pi * k + first * (-1.0) ** k, atol=1e-7)


def test_what_is_printed():
    """The number of crossings and their times are printed."""
    traj = swing(0.0, 1.0, 0.9, [0.0, 3.0, 6.0])
    assert repr(traj.events["level"]) == "Crossings: 2, at t = 1.11976951, 2.02182314"
    assert repr(traj.events["stop"]) == "Crossings: 0"
    assert "event 'level'" in str(traj)
    t = np.arcsin(0.9)
    assert len(times(swing(0.0, 1.0, 0.9, [0.0, t, 3.0]))) == 2


guard = lambda t, q, v, p: q
asked = lambda **options: lj.integrate(oscillator, 0.0, 1.0, {"level": 0.5}, ts=[0.0, 1.0], **options)
by = lambda guard: lambda: asked(events={"level": lj.Crossing(guard)})
REFUSED = [
    (lambda: asked(events=[EVENTS["level"]]), TypeError, "by name"),
    (lambda: asked(events={"level": guard}), TypeError, "lj.Crossing"),
    (by(lambda t, y: y[0]), TypeError, "guard"),
    (by(lambda t, q, v, p: jnp.stack([q, v])), ValueError, "one real number"),
    (by(lambda t, q, v, p: None), ValueError, "one real number"),
    (by(lambda t, q, v, p: 1), ValueError, "one real number"),
    (by(lambda t, q, v, p: 1j * q), ValueError, "one real number"),
    (by(lambda t, q, v, p: p["lvl"]), (KeyError, TypeError, ValueError), "lvl"),
    (lambda: asked(events={"event": EVENTS["level"]}, event=HIT), ValueError, "two events, .* called 'event'"),
    *((lambda x=x: asked(event=x), TypeError, "diffrax.Event") for x in (lambda t, y: y[0], EVENTS["level"], EVENTS)),
    *((lambda x=x: lj.Crossing(guard, direction=x), ValueError, "direction") for x in (2, "up", False, 0.5)),
    *((lambda x=x: lj.Crossing(guard, most=x), ValueError, "most") for x in (0, -1, 1.5, None)),
    (lambda: lj.Crossing(1.0), TypeError, "a function of"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_refused_in_words(call, error, words):
    """Anything but an event, guards that cannot be called, wrong directions: refused before anything is compiled."""
    with pytest.raises(error, match=words) as raised:
        call()
    assert "Fix:" in str(raised.value) or isinstance(raised.value, KeyError)


# Slow tests: each compiles a program.


@pytest.mark.exhaustive
def test_lanes():
    """Lanes with two crossings, with none, started on the guard, refused, and ended give the same as single runs."""
    q0, v0 = jnp.array([0.0, 0.0, 0.5, jnp.nan, 0.0]), jnp.array([1.0, 0.1, 0.75**0.5, 1.0, 1.0])
    levels, stops = jnp.array([0.999999, 0.9, 0.5, 0.9, 0.5]), jnp.array([2.0, 2.0, 2.0, 2.0, 0.0])
    one = lambda *start: swing(*start[:3], jnp.array([0.0, 3.0, 6.0]), start[3], throw=False)
    lanes = jax.jit(jax.vmap(one))(q0, v0, levels, stops)
    found = lanes.events["level"]
    assert found.count.tolist() == [2, 0, 1, 0, 1]
    assert np.isfinite(found.t).sum(axis=1).tolist() == [2, 0, 1, 0, 1]
    assert not found.uncertain.any()
    top = np.arcsin(0.999999)
    np.testing.assert_allclose(found.t[0, :2], [top, np.pi - top], atol=1e-6)
    np.testing.assert_allclose(np.asarray(found.t)[[2, 4], 0], [2 * np.pi / 3, np.pi / 6], atol=1e-8)
    np.testing.assert_allclose(np.asarray(lanes.end.t)[[0, 1, 2, 4]], [6.0, 6.0, 6.0, np.pi / 2], atol=1e-8)
    assert "5 lanes, 0 to 2 each" in repr(found)


@pytest.mark.optimised
@pytest.mark.exhaustive
def test_what_jumps():
    """A sign and a boolean condition cross where they jump, to the resolution of time."""
    events = {
        "early": lj.Crossing(lambda t, q, v, p: t > p, terminal=False),
        "sign": lj.Crossing(lambda t, q, v, p: jnp.sign(q - 0.9), terminal=False),
        "true": lj.Crossing(lambda t, q, v, p: q > 0.9, direction=-1, terminal=False),
    }
    with warnings.catch_warnings():
        # Several crossings in one step are found, with a warning that some may be missing.
        warnings.simplefilter("ignore", lj.EventWarning)
        traj = lj.integrate(oscillator, 0.0, 1.0, 0.123, ts=[0.0, 6.0], events=events)
    np.testing.assert_allclose(times(traj, "early"), [0.123], atol=1e-14)
    top = np.arcsin(0.9)
    np.testing.assert_allclose(times(traj, "sign"), [top, np.pi - top], atol=1e-8)
    np.testing.assert_allclose(times(traj, "true"), [np.pi - top], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("drift", exhaustive_but(("project",), ("project", "none", "baumgarte")))
def test_constrained_whatever_keeps_it_there(drift):
    """The rod pendulum is at its bottom at odd quarters of its period."""
    special = pytest.importorskip("scipy.special")
    quarter = special.ellipk(0.5) * np.sqrt(PARAMS["l"] / PARAMS["g"])
    start = {"x": 1.25, "y": 0.0}, {"x": 0.0, "y": 0.0}
    bottom = {"bottom": lj.Crossing(lambda t, q, v, p: q["x"], terminal=False)}
    traj = lj.integrate(rod_pendulum, *start, PARAMS, ts=[0.0, 6.0 * quarter], events=bottom, drift=drift)
    np.testing.assert_allclose(times(traj, "bottom"), quarter * np.array([1.0, 3.0, 5.0]), rtol=1e-6)


@pytest.mark.exhaustive
def test_float32():
    """In float32 crossings are found to its own tolerance."""
    single = np.float32
    params = {name: single(x) for name, x in (SPRING | {"level": 0.9, "stop": -0.9}).items()}
    traj = lj.integrate(plant, single(0), single(1), params, ts=[0.0, 1.0, 6.0], events=EVENTS)
    top = np.arcsin(0.9)
    found = traj.events["level"]
    assert found.t.dtype == found.q.dtype == jnp.float32
    np.testing.assert_allclose(times(traj), [top, np.pi - top], atol=1e-3)
    np.testing.assert_allclose(traj.end.t, np.arccos(-0.9), atol=1e-3)


# A guard whose slope is infinite or unknown at one instant.

FREE = lj.System(lambda t, q, v, p: 0.5 * v**2)
STEEP = {
    "root": (lambda t, q, v, p: jnp.sqrt(t) - 1.0, [1.0]),
    "cube root": (lambda t, q, v, p: jnp.cbrt(q) - 1.0, [1.0]),
    "arc": (lambda t, q, v, p: jnp.arccos(jnp.clip(t / 5 - 1, -1, 1)) - 1.0, [5 * (1 + np.cos(1.0))]),
    "at the end": (lambda t, q, v, p: jnp.sqrt(10 - t) - 1.0, [9.0]),
    "logarithm": (lambda t, q, v, p: jnp.log(t), [1.0]),
    "Chebyshev": (
        lambda t, q, v, p: jnp.cos(30 * jnp.arccos(jnp.clip(t / 5 - 1, -1, 1))),
        5 + 5 * np.cos(np.pi * (np.arange(30) + 0.5) / 30)[::-1],
    ),
}


@pytest.mark.exhaustive
def test_an_infinite_slope_does_not_stop_the_motion():
    """sqrt(t), ∛q, arccos, log and T₃₀, steep at the start or the end, cross at their roots, in a few hundred looks."""
    events = {name: lj.Crossing(guard, terminal=False, most=40) for name, (guard, _) in STEEP.items()}
    motion = lj.integrate(FREE, 0.0, 1.0, ts=jnp.array([0.0, 10.0]), events=events)
    for name, (_, roots) in STEEP.items():
        np.testing.assert_allclose(times(motion, name), roots, rtol=0, atol=2e-14, err_msg=name)
        assert not bool(motion.events[name].uncertain)
    assert int(motion.stats["num_rejected_steps"]) < 1000


def test_directions_of_diffrax():
    """True is from below, False from above, None both, as diffrax has it."""
    assert lj.Crossing(guard, direction=True).direction == 1
    for theirs, ours in ((True, 1), (False, -1), (None, 0)):
        event = diffrax.Event(lambda t, y, args, **kwargs: y[0], direction=theirs)
        assert crossings_of({}, event)["event"].direction == ours
