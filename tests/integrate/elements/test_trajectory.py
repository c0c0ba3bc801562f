"""What is done with a motion with elements: a block that bounces, slides and stops, in closed form."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

PARAMS = {"g": 9.81, "mu": 0.1}
G, MU, E, THROWN = 9.81, 0.1, 0.5, 4.0
FALL = np.sqrt(2 / G)
# Impacts in the ratio e; each takes μ of its impulse from the sliding velocity. Then it slides and stops.
RESTS = FALL * (1 + 2 * E / (1 - E))
SPEED = THROWN - MU * G * FALL * (1 + E) / (1 - E)
STOPS = RESTS + SPEED / (MU * G)

floor = lj.Contact(
    lambda t, q, p: q[1], restitution=E, friction=lambda p: p["mu"], sliding=lambda t, q, v, p: v[0]
)  # fmt: skip
block = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - p["g"] * q[1], elements={"floor": floor})


def thrown(mu=MU, ts=(0.0, 1.0, 5.0), **options) -> lj.HybridTrajectory:
    """The block thrown from height 1."""
    start = np.array([0.0, 1.0]), np.array([THROWN, 0.0])
    traj = lj.integrate(block, *start, PARAMS | {"mu": mu}, ts=np.array(ts), estimate_error=False, **options)
    assert isinstance(traj, lj.HybridTrajectory)
    return traj


computed = functools.cache(thrown)


@pytest.mark.slow
def test_between_outputs():
    """In flight, between impacts, sliding and at rest as in closed form, from outputs far apart. Twin: free fall."""
    traj = computed()
    u, t = E * G * FALL, np.array([0.3, 0.7, 3.0, 4.5])
    found = traj.at(t)
    after = THROWN - MU * (1 + E) * G * FALL
    slid = SPEED - MU * G * (3.0 - RESTS)
    np.testing.assert_allclose(found.v[:, 0], [THROWN, after, slid, 0.0], atol=1e-8)
    height = u * (0.7 - FALL) - G / 2 * (0.7 - FALL) ** 2
    np.testing.assert_allclose(found.q[:, 1], [1 - G / 2 * 0.3**2, height, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(found.multipliers["floor"], [0.0, 0.0, G, G], rtol=1e-9)
    assert np.all(1 - G / 2 * t[1:] ** 2 < found.q[1:, 1] - 1.0)
    assert float(traj.residual()) < 1e-14 and abs(float(traj.switches.t[len(traj.switches) - 1]) - STOPS) < 1e-6
    assert "at the end: floor closed, floor friction sticks" in repr(traj)
    assert "floor is struck, then open" in repr(traj.switches)


@pytest.mark.slow
def test_in_a_file(tmp_path):
    """It comes back bit for bit, with its modes, and continues. Twins: with another restitution, or another friction
    of the same sliding velocity, it is another system."""
    traj, path = computed(), tmp_path / "motion.npz"
    traj.save(path)
    numbers = lambda traj: jax.tree.leaves((traj.rows(), traj.switches, traj.end, traj.events, traj.stats))
    again, alone = lj.load_trajectory(path, block), lj.load_trajectory(path)
    for found in (again, alone):
        for a, b in zip(numbers(traj), numbers(found), strict=True):
            assert a.dtype == b.dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert repr(again) == repr(traj) and np.array_equal(again.at(0.7).q, traj.at(0.7).q)
    kept = {"friction": floor.friction, "sliding": floor.sliding}
    others = lj.Contact(floor.gap, 0.6, **kept), lj.Contact(floor.gap, E, **kept | {"friction": 0.2})
    for other, words in zip(others, ("the restitution of 'floor'", "the coefficients of 'floor friction'")):
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path, lj.System(block.lagrangian, elements={"floor": other}))


@pytest.mark.slow
def test_as_a_dataset():
    """The modes are a variable with the names of the modes as coordinate."""
    modes = computed().to_xarray()["modes"]
    assert modes.dims == ("t", "mode") and modes.sel(mode="floor friction").values.tolist() == [0, 0, 2]


@pytest.mark.exhaustive
def test_a_lane_of_a_batch(tmp_path):
    """A lane of a batch, which has its own modes, continues, before and after it was in a file."""
    mu = jnp.array([MU, 2 * MU])
    lanes = jax.vmap(thrown)(mu)
    lanes.save(tmp_path / "lanes.npz")
    for batch in (lanes, lj.load_trajectory(tmp_path / "lanes.npz", block)):
        lane = jax.tree.map(lambda x: x[1], batch)
        np.testing.assert_allclose(lane.at(0.7).v[0], THROWN - 2 * MU * (1 + E) * G * FALL, atol=1e-8)
