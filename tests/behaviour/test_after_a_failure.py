"""After a failure nothing is finite; guards that touch zero; the verdict does not depend on units."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import HybridTrajectory

# Two balls that attract each other; slow impacts halve the speed, those faster than 100 are elastic.
attracted = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - p["g"] * (q[1] - q[0]))
hit = lj.guards.touches(lambda t, q, p: q[1] - q[0] - p["d"], lambda speed: jnp.where(speed > 100.0, 1.0, 0.5))
zeno = lj.Hybrid({"flying": attracted}, [lj.Switch("flying", to="flying", when=hit)], most_switches=50)
TS = np.array([0.0, 1.0, 3.5])


def thrown(q, v, g=0.0, d=0.0):
    """A motion of the two balls."""
    return lj.integrate(zeno, np.array(q), np.array(v), {"g": g, "d": d}, ts=TS, throw=False)


def finite_after(traj, t):
    """The names of the fields that hold a finite number at outputs, crossings or switches after a time."""
    found = []
    rows = {"q": traj.q, "v": traj.v, "multipliers": traj.multipliers}
    if traj.error is not None:
        rows |= {"error.q": traj.error.q, "error.v": traj.error.v}
    late = np.asarray(traj.t) > t
    for name, tree in rows.items():
        found += [name for x in jax.tree.leaves(tree) if np.isfinite(np.asarray(x)[late]).any()]
    events = dict(traj.events) | ({"switches": traj.switches} if isinstance(traj, HybridTrajectory) else {})
    for name, crossings in events.items():
        times = np.asarray(crossings.t)
        found += [name] if np.any(times[np.isfinite(times)] > t + 1e-9) else []
    return found


def test_bounces_that_accumulate():
    """From 5 apart, at an acceleration of 10, infinitely many impacts until t = 3; from there on nothing is finite.

    Twin: at speeds at which they are elastic, they hit three times until 3.5, and are known throughout.
    """
    traj = thrown([-2.5, 2.5], [0.0, 0.0], 5.0)
    assert traj.result == lj.RESULTS.too_many_switches and np.isinf(traj.scaled_error)
    np.testing.assert_allclose(traj.end.t, 3.0, rtol=1e-9)
    assert np.isfinite(np.asarray(traj.q)[:2]).all() and not finite_after(traj, 3.0)
    with pytest.raises(RuntimeError, match="(?s)infinitely many switches.*each takes 0.5 of.*about t = 3\\b"):
        lj.integrate(zeno, np.array([-2.5, 2.5]), np.zeros(2), {"g": 5.0, "d": 0.0}, ts=TS)
    with pytest.raises(ValueError, match="ended at t = 3"):
        traj.at(3.2)
    fast = np.asarray(thrown([-2.5e4, 2.5e4], [0.0, 0.0], 5e4).q)
    np.testing.assert_allclose(fast[:, 1] - fast[:, 0], 5e4 * np.array([1.0, 0.0, 0.75]), atol=1e-4)


@pytest.mark.parametrize(
    ("q", "v", "right", "count"),
    [
        # Gaps of -2.8e-17 and +5.6e-17, and none that closes.
        ([0.1, 0.3], [0.0, 0.0], [0.0, 0.0], 0),
        ([0.9, 1.1], [0.0, 0.0], [0.0, 0.0], 0),
        ([0.9, 1.1], [-200.0, 0.0], [-200.0, 0.0], 0),
        # Twin: what closes hits at once.
        ([0.1, 0.3], [200.0, 0.0], [0.0, 200.0], 1),
        ([0.9, 1.1], [200.0, -200.0], [-200.0, 200.0], 1),
    ],
)
def test_two_balls_that_touch(q, v, right, count):
    """A gap at round-off, of either sign, is touched: an impact happens only where it closes."""
    traj = thrown(q, v, d=0.2)
    np.testing.assert_allclose(np.asarray(traj.v)[-1], right, atol=200 * 1e-14)
    assert isinstance(traj, HybridTrajectory)
    assert int(traj.switches.count) == count and not bool(traj.switches.uncertain)


@pytest.mark.slow
def test_steps_that_collapse():
    """A fall into a centre: nothing is finite after the failure; at(t) refuses."""
    fall = lj.System(lambda t, q, v, p: 0.5 * v**2 + 1.0 / q)
    events = {"low": lj.Crossing(lambda t, q, v, p: q - 0.5, terminal=False, most=4)}
    ts = np.array([0.0, 0.5, 1.0, 1.5, 2.0])
    traj = lj.integrate(fall, 1.0, 0.0, ts=ts, events=events, throw=False)
    assert not lj.RESULTS.successful == traj.result and float(traj.end.t) < 1.2
    assert not finite_after(traj, float(traj.end.t)) and np.isinf(traj.scaled_error)
    assert np.isfinite(traj.q[:3]).all()
