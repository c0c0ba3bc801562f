"""Events of a motion in phases: recorded in all of them, or ending the motion; and forces that jump."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import HybridTrajectory

G = 9.81
FALL, SPEED = np.sqrt(2 / G), 0.5 * np.sqrt(2 * G)
APEX = lj.Crossing(lambda t, q, v, params: v, terminal=False, most=2)


def falling(t, q, v, params):
    """A ball of unit mass."""
    return 0.5 * v**2 - G * q


floor = lj.Switch("flying", to="flying", when=lj.guards.touches(lambda t, q, params: q, 0.5))
bouncing = lj.Hybrid({"flying": lj.System(falling)}, [floor], most_switches=3)


def bounced(height, **options):
    """Two bounces, of a ball that falls from rest."""
    ts = np.array([0.0, 1.1])
    traj = lj.integrate(bouncing, height, 0.0, ts=ts, estimate_error=False, **options)
    assert isinstance(traj, HybridTrajectory)
    return traj


@pytest.mark.exhaustive
def test_recorded_through_all_phases():
    """Apices after the first two bounces agree with the closed form; a velocity that jumps over zero is not an apex."""
    traj = bounced(1.0, events={"apex": APEX})
    apex = traj.events["apex"]
    np.testing.assert_allclose(apex.t, [1.5 * FALL, 2.25 * FALL], rtol=1e-13)
    np.testing.assert_allclose(apex.q, [1 / 4, 1 / 16], rtol=1e-12)
    assert int(apex.count) == 2 and len(traj.switches) == 2 and "event 'apex'" in repr(traj)
    by_height = jax.jacfwd(
        lambda h: (lambda found: (found.t, found.q))(bounced(h, events={"apex": APEX}).events["apex"])
    )
    times, places = by_height(1.0)
    np.testing.assert_allclose(times, np.asarray(apex.t) / 2, rtol=1e-9)
    np.testing.assert_allclose(places, [1 / 4, 1 / 16], rtol=1e-9)


@pytest.mark.exhaustive
def test_ending_the_motion():
    """Events end the motion in the first fall, at the next apex, or at the floor before the switch."""
    at_height = lj.Crossing(lambda t, q, v, params: q - 0.2)
    at_apex = lj.Crossing(lambda t, q, v, params: v, direction=-1)
    first, second = (bounced(1.0, events={"ends": event}) for event in (at_height, at_apex))
    np.testing.assert_allclose(first.end.t, np.sqrt(2 * 0.8 / G), rtol=1e-12)
    np.testing.assert_allclose([second.end.t, second.end.q], [1.5 * FALL, 0.25], rtol=1e-12)
    assert (len(first.switches), len(second.switches), len(bounced(1.0).switches)) == (0, 1, 2)
    assert first.result == second.result == lj.RESULTS.event_occurred
    at_floor = lj.Crossing(lambda t, q, v, params: q, direction=-1)
    ended = bounced(1.0, events={"floor": at_floor})
    assert len(ended.switches) == 0 and abs(float(ended.end.v) + np.sqrt(2 * G)) < 1e-12


@pytest.mark.exhaustive
def test_forces_that_jump():
    """A push upward from a time between two bounces on agrees with the closed form; twin: from another time on."""
    pushed = lj.System(falling, force=lambda t, q, v, params: jnp.where(t < params, 0.0, 20.0))
    system, ts = lj.Hybrid({"flying": pushed}, [floor], most_switches=3), np.array([0.0, 0.7, 0.8])
    q, v = SPEED * (0.6 - FALL) - G / 2 * (0.6 - FALL) ** 2, SPEED - G * (0.6 - FALL)
    exact = [q + v * s + (20 - G) / 2 * s**2 for s in (0.1, 0.2)]
    given = {"ts": ts, "jumps": "ignored", "estimate_error": False}
    right, wrong = (lj.integrate(system, 1.0, 0.0, at, jump_ts=[at], **given) for at in (0.6, 0.61))
    np.testing.assert_allclose(right.q[1:], exact, rtol=1e-11)
    assert np.max(np.abs(wrong.q[1:] - np.array(exact))) > 1e-3


def test_refused():
    """Guards with multipliers, the name of the switches, and conditions for diffrax are refused."""
    ts = np.array([0.0, 1.0])
    of_multipliers = lj.Crossing(lambda t, q, v, multipliers, params: v)
    with pytest.raises(ValueError, match="event 'push' takes multipliers"):
        lj.integrate(bouncing, 1.0, 0.0, ts=ts, events={"push": of_multipliers})
    with pytest.raises(ValueError, match="called 'switches'"):
        lj.integrate(bouncing, 1.0, 0.0, ts=ts, events={"switches": APEX})
