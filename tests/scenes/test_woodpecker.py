"""The woodpecker toy: its cycle and the derivatives of its period against an independent computation."""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.scenes.woodpecker import PARAMS, TURN, Lap, beak, lap, motion
from tests.scenes import woodpecker_by_events as by_events

TS = np.linspace(0.0, 0.18, 19)
NAMES = ("y", "sleeve", "bird")


def test_the_independent_cycle():
    """The other computation: the bird turns where it did, the modes of the cycle, and no energy for its edges to gain.

    Twin: without friction in the impacts the bird turns elsewhere.
    """
    turn, period = by_events.cycle(PARAMS, TURN)
    np.testing.assert_allclose([turn, period], [TURN, 0.145976065], rtol=1e-8)
    found = by_events.changes(PARAMS, turn)
    assert [change.why for change in found] == [
        *("slides", "leaves", "upper", "beak", "upper", "leaves", "lower", "lower", "stops", "slides")
    ]
    np.testing.assert_allclose(found[0].z[:6] - found[-1].z[:6], [0.0194453792, 0, 0, 0, 0, 0], atol=1e-9)
    assert abs(by_events.lap(PARAMS, turn, impact_mu=0.0)[1]) > 0.1


@pytest.mark.slow
def test_the_cycle():
    """Times, states and impulses of all switches of a period, and no beak in the pole. Twin: a stiffer spring's."""
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


def of_parameters(given, **options):
    """The period and what the bird gains, of (turn, mu, c)."""
    turn, mu, c = given
    found: Lap = lap(motion(PARAMS | {"mu": mu, "c": c}, TS[:: len(TS) - 1], turn, estimate_error=False, **options))
    return jnp.stack([found.period, found.gained])


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_period_by_its_parameters(mode):
    """The derivative of the period of the cycle, by friction and by stiffness, against differences. Twin: at one turn.

    The cycle moves with them: dT/dp = T_p - T_a r_p / r_a, with a the angle of the turn and r what the bird gains.
    """
    given = jnp.array([TURN, PARAMS["mu"], PARAMS["c"]])
    slopes = jax.jit((jax.jacfwd if mode == "forward" else jax.jacrev)(of_parameters))(given)
    (of_turn, *direct), (gain_of_turn, *gains) = np.asarray(slopes)
    found = np.array(direct) - of_turn * np.array(gains) / gain_of_turn
    for k, name in enumerate(("mu", "c")):
        step = 1e-4 * cast(float, PARAMS[name])
        above, below = (by_events.cycle(PARAMS | {name: PARAMS[name] + s * step}, TURN)[1] for s in (1, -1))
        np.testing.assert_allclose(found[k], (above - below) / (2 * step), rtol=1e-5)
        assert abs(direct[k] / found[k] - 1) > 1e-2
