"""Motions of systems with elements, each against its closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.integrate.contacts.test_contacts import SHAKEN, G, over

K, MU = 100.0, 0.3
# The block's last turn, half swings of ω = 10 that lose 2 μ g/k each, and its derivative by μ.
REST, WHEN, BY_MU = 0.5 - 16 * MU * 9.81 / K, 8 * np.pi / 10, -16 * 9.81 / K


def moved(*motion, **options) -> lj.HybridTrajectory:
    """A motion with elements, without estimates of its errors."""
    traj = lj.integrate(*motion, estimate_error=False, **options)
    assert isinstance(traj, lj.HybridTrajectory) and traj.modes is not None
    return traj


def rubbed():
    """A block on a spring and a rough floor, from one element."""
    spring = lambda t, q, v, mu: 0.5 * v**2 - 0.5 * K * q**2
    floor = lj.Friction(lambda t, q, v, mu: v, lambda mu: mu, normal=9.81)
    return lj.System(spring, elements={"floor": floor})


def slowing(mu, system=rubbed(), **options):
    """The block let go at 0.5."""
    return moved(system, 0.5, 0.0, mu, ts=jnp.array([0.0, 2.6, 4.0]), rtol=1e-11, **options)


@pytest.mark.slow
def test_dry_friction_on_a_spring():
    """The block rests where and when the closed form says. Twin: with another μ it is somewhere else."""
    traj = slowing(MU)
    assert len(traj.switches) == 8 and np.asarray(traj.modes)[:, 0].tolist() == [-1, 2, 2]
    np.testing.assert_allclose(traj.q[1:], REST, atol=1e-10)
    np.testing.assert_allclose(traj.switches.t[7], WHEN, atol=1e-10)
    np.testing.assert_allclose(traj.multipliers["floor"][1:], K * REST, rtol=1e-8)
    assert abs(slowing(1.01 * MU).q[-1] - REST) > 1e-3


@pytest.mark.exhaustive
def test_derivatives_by_friction():
    """The derivative of the place of rest by μ, in both modes."""
    last = lambda mu: slowing(mu).q[-1]
    np.testing.assert_allclose(jax.jvp(last, (MU,), (1.0,))[1], BY_MU, atol=1e-8)
    np.testing.assert_allclose(jax.grad(last)(MU), BY_MU, atol=1e-8)


def row(impacts: str, count: int) -> lj.System:
    """Balls of diameter d in a row."""
    gaps = lj.Contact(lambda t, q, d: q[1:] - q[:-1] - d, restitution=1.0)
    return lj.System(lambda t, q, v, d: 0.5 * jnp.sum(v**2), elements=lj.Elements({"balls": gaps}, impacts=impacts))


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("impacts", "after"), [("sequential", [0.0, 0.0, 1.0]), ("simultaneous", [-1 / 3, 2 / 3, 2 / 3])]
)
def test_a_row_of_balls(impacts, after):
    """One ball strikes two that touch, in decimal positions: the textbook's answers; touching balls at rest, and those
    that travel together, are no switches. Twin: with a gap between them simultaneous impacts are sequential ones."""
    system = row(impacts, 3)

    def run(q0, v0):
        return moved(system, np.array(q0), np.array(v0), 0.1, ts=jnp.array([0.0, 3.0]))

    struck = run([-1.0, 0.1, 0.2], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(struck.v[-1], after, atol=1e-13)
    np.testing.assert_allclose([struck.v[-1].sum(), (struck.v[-1] ** 2).sum()], 1.0, atol=1e-13)
    assert len(struck.switches) == 1
    for v0 in ([0.0, 0.0, 0.0], [0.7, 0.7, 0.7]):
        together = run([0.1, 0.2, 0.1 + 0.2], v0)
        assert len(together.switches) == 0
        np.testing.assert_allclose(together.v[-1], v0, atol=1e-14)
    apart = run([-1.0, 0.1, 0.21], [1.0, 0.0, 0.0])
    np.testing.assert_allclose(apart.v[-1], [0.0, 0.0, 1.0], atol=1e-13)
    with pytest.raises(ValueError, match=r"(?s)starts inside a contact: the gap 'balls\[1\]' = -0.05"):
        run([-1.0, 0.1, 0.15], [1.0, 0.0, 0.0])


@pytest.mark.exhaustive
def test_lets_go_and_touches_again():
    """A body leaves a shaken table at a² = g and lands, from one element: as by a hybrid of two phases."""
    table = lj.Contact(lambda t, q, p: over(t, q, p))
    body = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q, elements={"table": table})
    traj = moved(body, 0.0, SHAKEN["a"] * SHAKEN["w"], SHAKEN, ts=np.array([0.0, 0.1, 0.2]), rtol=1e-11)  # fmt: skip
    w, a = SHAKEN["w"], SHAKEN["a"]
    leaves = np.arcsin(G / (a * w**2)) / w
    np.testing.assert_allclose(traj.switches.t[0], leaves, rtol=1e-9)
    assert np.asarray(traj.modes)[:, 0].tolist() == [1, 0, 1] and len(traj.switches) == 2
