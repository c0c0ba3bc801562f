"""The woodpecker toy: its cycle against another computation (`benchmarks/speed/woodpecker.py`: its derivatives)."""

import jax
import numpy as np
import pytest

from lagjax.scenes.woodpecker import PARAMS, TURN, beak, edges, lap, motion

TS = np.linspace(0.0, 0.18, 19)
# t, y, sleeve, bird, and the rates of y and bird after each change, by a computation that shared nothing with lagjax:
# the modes of each contact are linear, z' = A z, solved by exponentials of A; guards were evaluated every 2e-5 s, their
# zeros found by Brent's method, and impacts solved by trying their modes.
CHANGES = np.array([
    (0.02841016058, 0.0, -0.1034482759, -0.2051353492, 0.0, 17.57466621),  # slides
    (0.03423091781, -5.552881343e-05, -0.1034482759, -0.1034482759, -0.0285936617, 17.41731333),  # leaves
    (0.04511998586, -0.002616096136, 0.1034482759, 0.06686490555, -0.1224668972, 16.70945211),  # upper
    (0.04822133952, -0.002929887563, 0.08940385274, 0.12, -0.09377519168, -8.455588684),  # beak
    (0.04880086106, -0.002992213586, 0.1034482759, 0.1150263273, 0.07225667475, -6.246388757),  # upper
    (0.05065555185, -0.00287635298, 0.1034482759, 0.1034482759, 0.05302650577, -6.240672359),  # leaves
    (0.08594396254, -0.005445576377, -0.1034482759, -0.09743000472, -0.2877100947, -6.27071399),  # lower
    (0.08867269657, -0.006267183282, -0.1034482759, -0.1145411154, -0.3137079239, -6.274969895),  # lower
    (0.1347928187, -0.01944537928, -0.1034482759, -0.4686515939, 0.0, -10.50379929),  # stops
    (0.1743862257, -0.01944537928, -0.1034482759, -0.2051353492, 0.0, 17.57466621),  # slides
])  # fmt: skip


def test_where_it_touches():
    """Edges and beak are at the pole where that computation has their contacts. Twin: elsewhere they are not."""
    y, sleeve, bird = CHANGES.T[1:4]
    at = lambda i: {"y": y[i], "sleeve": sleeve[i], "bird": bird[i]}
    of_edges = [edges(0.0, at(i), PARAMS) for i in (0, 2, 4, 6)]
    np.testing.assert_allclose([*of_edges, beak(0.0, at(3), PARAMS)], 0.0, atol=1e-12)
    assert edges(0.0, at(3), PARAMS) > 1e-5 and beak(0.0, at(4), PARAMS) > 1e-5


@pytest.mark.exhaustive
def test_the_cycle():
    """Times and states of all switches of a period, which repeats itself, and a beak that stays outside."""
    traj = motion(PARAMS, TS, TURN, rtol=1e-11, estimate_error=False)
    switches, count = traj.switches, len(traj.switches)
    t, q, v = jax.tree.map(lambda x: np.asarray(x)[:count], (switches.t, switches.q_after, switches.v_after))
    # A switch that ends a phase at once has the time of the one before.
    last = np.append(np.diff(t) > 1e-12, True)
    found = np.stack([t, q["y"], q["sleeve"], q["bird"], v["y"], v["bird"]], axis=1)[last]
    np.testing.assert_allclose(found, CHANGES, rtol=1e-8, atol=1e-7)
    np.testing.assert_allclose(found[:, 0], CHANGES[:, 0], rtol=1e-9)
    one = lap(traj)
    np.testing.assert_allclose([one.period, one.fallen], [0.145976065144, -0.0194453793], rtol=1e-8)
    assert abs(one.gained) < 1e-7
    assert np.all(np.asarray(jax.vmap(lambda t, q: beak(t, q, PARAMS))(traj.t, traj.q)) > 0)
