"""The woodpecker toy: its cycle against another computation (`benchmarks/speed/woodpecker.py`: its derivatives)."""

import jax
import numpy as np
import pytest

from lagjax.scenes.woodpecker import PARAMS, TURN, beak, lap, motion
from tests.scenes import woodpecker_by_events as by_events

TS = np.linspace(0.0, 0.18, 19)
NAMES = ("y", "sleeve", "bird")


def test_the_independent_cycle():
    """The independent computation: from this angle, and no other, the toy repeats itself, after this period.

    Twin: without friction in the impacts it does not.
    """
    found = by_events.changes(PARAMS, TURN)
    assert [change.why for change in found] == [
        *("slides", "leaves", "upper", "beak", "upper", "leaves", "lower", "lower", "stops", "slides")
    ]
    np.testing.assert_allclose(found[0].z[:6] - found[-1].z[:6], [0.0194453792, 0, 0, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(found[-1].t - found[0].t, 0.145976065, rtol=1e-8)
    more, less = (by_events.lap(PARAMS, TURN * (1 + s * 1e-8))[1] for s in (1, -1))
    assert more * less < 0
    assert abs(by_events.lap(PARAMS, TURN, impact_mu=0.0)[1]) > 0.1


@pytest.mark.exhaustive
def test_the_cycle():
    """Times, states and impulses of all switches of a period, and a beak that stays outside. Twin: a stiffer spring."""
    traj = motion(PARAMS, TS, rtol=1e-11, estimate_error=False)
    expected, switches = by_events.changes(PARAMS, TURN), traj.switches
    t = np.asarray(switches.t)[: len(switches)]
    # A switch that ends a phase at once has the time of the one before.
    last = np.append(np.diff(t) > 1e-12, True)
    np.testing.assert_allclose(t[last], [change.t for change in expected], rtol=1e-9)
    for names, rows, places in ((switches.q_after, slice(0, 3), 1e-9), (switches.v_after, slice(3, 6), 1e-7)):
        got = np.stack([np.asarray(names[name])[: len(switches)][last] for name in NAMES], axis=1)
        np.testing.assert_allclose(got, np.stack([change.z[rows] for change in expected]), rtol=1e-8, atol=places)
    found = lap(traj)
    np.testing.assert_allclose([found.period, found.fallen], [0.145976065144, -0.0194453793], rtol=1e-8)
    assert abs(found.gained) < 1e-7
    assert np.all(np.asarray(jax.vmap(lambda t, q: beak(t, q, PARAMS))(traj.t, traj.q)) > 0)
    stiffer = by_events.changes(PARAMS | {"c": 1.001 * PARAMS["c"]}, TURN)
    assert abs(stiffer[-1].t - expected[-1].t) > 1e-5
