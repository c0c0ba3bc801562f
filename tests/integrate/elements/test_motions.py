"""Motions of systems with elements, each against its closed form."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from tests.system.test_system import G, in_phases

K, MU = 100.0, 0.3
# The block's last turn, half swings of ω = 10 that lose 2 μ g/k each, and its derivative by μ.
REST, WHEN, BY_MU = 0.5 - 16 * MU * 9.81 / K, 8 * np.pi / 10, -16 * 9.81 / K


def moved(*motion, **options) -> HybridTrajectory:
    """A motion with elements, without estimates of its errors."""
    traj = lj.integrate(*motion, estimate_error=False, **options)
    assert isinstance(traj, HybridTrajectory) and traj.modes is not None
    return traj


# A block on a spring and a rough floor, from one element.
rubbed = lj.System(
    lambda t, q, v, mu: 0.5 * v**2 - 0.5 * K * q**2,
    elements={"floor": lj.Friction(lambda t, q, v, mu: v, lambda mu: mu, normal=9.81)},
)


@pytest.mark.slow
def test_dry_friction_on_a_spring():
    """The block rests where and when the closed form says. Twin: with another μ it is somewhere else."""
    slowing = lambda mu: moved(rubbed, 0.5, 0.0, mu, ts=jnp.array([0.0, 2.6, 4.0]), rtol=1e-11)
    traj = slowing(MU)
    assert len(traj.switches) == 8 and np.asarray(traj.modes)[:, 0].tolist() == [-1, 2, 2]
    np.testing.assert_allclose(traj.q[1:], REST, atol=1e-10)
    np.testing.assert_allclose(traj.switches.t[7], WHEN, atol=1e-10)
    np.testing.assert_allclose(traj.multipliers["floor"][1:], K * REST, rtol=1e-8)
    assert abs(slowing(1.01 * MU).q[-1] - REST) > 1e-3


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("impacts", "after"), [("sequential", [0.0, 0.0, 1.0]), ("simultaneous", [-1 / 3, 2 / 3, 2 / 3])]
)
def test_a_row_of_balls(impacts, after):
    """One ball strikes two that touch, in decimal positions: the textbook's answers, in one switch; touching balls that
    travel together are none. Twin: with a gap between them simultaneous impacts are sequential ones."""
    gaps = lj.Contact(lambda t, q, d: q[1:] - q[:-1] - d, restitution=1.0)
    balls = lj.Elements({"balls": gaps}, impacts=impacts)
    system = lj.System(lambda t, q, v, d: 0.5 * jnp.sum(v**2), elements=balls)
    for q0, v0, ends, switches in (
        ([-1.0, 0.1, 0.2], [1.0, 0.0, 0.0], after, 1),
        ([0.1, 0.2, 0.1 + 0.2], [0.7, 0.7, 0.7], [0.7, 0.7, 0.7], 0),
        ([-1.0, 0.1, 0.21], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], 2),
    ):
        traj = moved(system, np.array(q0), np.array(v0), 0.1, ts=jnp.array([0.0, 3.0]))
        np.testing.assert_allclose(traj.v[-1], ends, atol=1e-13)
        assert len(traj.switches) == switches


SHAKEN = {"g": G, "a": 0.02, "w": 30.0}
over = lambda t, q, p: q - p["a"] * jnp.sin(p["w"] * t)
body = lambda t, q, v, p: 0.5 * v**2 - p["g"] * q
on_table = lj.System(body, {"table": lj.Holonomic(over)})


def shaken(system, **options) -> HybridTrajectory:
    """A body on a shaken table."""
    ts = np.array([0.0, 0.1, 0.2])
    return in_phases(system, 0.0, 0.6, SHAKEN, ts=ts, rtol=1e-11, estimate_error=False, **options)


def in_two_phases(**options) -> lj.Hybrid:
    """A body that lies on the table or flies."""
    leave = lj.Switch("lies", to="flies", when=lj.guards.releases("table"), **options)
    land = lj.Switch("flies", to="lies", when=lj.guards.touches(over))
    return lj.Hybrid({"lies": on_table, "flies": lj.System(body)}, [leave, land], most_switches=4)


@pytest.mark.exhaustive
def test_lets_go_and_touches_again():
    """A body leaves a shaken table at a² = g, flies, and lands, from one element and as a hybrid of two phases. Twin:
    one that is thrown back at the table by 1e-9 never leaves it."""
    w, a = SHAKEN["w"], SHAKEN["a"]
    leaves = np.arcsin(G / (a * w**2)) / w
    z, v = a * np.sin(w * leaves), a * w * np.cos(w * leaves)
    height = lambda s: z + v * s - 0.5 * G * s**2 - a * np.sin(w * (leaves + s))
    lands = leaves + float(np.asarray(optimize.brentq(height, 0.02, 0.19, xtol=1e-15)))
    one = shaken(lj.System(body, elements={"table": lj.Contact(over)}))
    two = shaken(in_two_phases())
    for traj, rtol in ((one, 1e-11), (two, 1e-10)):
        np.testing.assert_allclose(traj.switches.t[:2], [leaves, lands], rtol=rtol)
        assert len(traj.switches) == 2
    assert np.asarray(one.modes)[:, 0].tolist() == [1, 0, 1] and abs(two.switches.impulse[0]) < 1e-13
    assert list(two.named_phases()) == ["lies", "flies", "lies"]
    with pytest.raises(RuntimeError, match="most_switches = 4"):
        shaken(in_two_phases(reset=lambda t, q, v, p: v - 1e-9))
