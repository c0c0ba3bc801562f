"""Motions between two ends against closed forms; what kind they are; conditions on a free end; what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

PARAMS = {"g": 9.81, "k": 0.3}
thrown = lj.System(
    lambda t, q, v, params: 0.5 * jnp.sum(v**2) - params["g"] * q[1],
    dissipation=lambda t, q, v, params: 0.5 * params["k"] * jnp.sum(v**2),
)
TO, TIME = np.array([4.0, 1.0]), 1.3


def start_velocity(to, time, g, k, xp=np):
    """Linear drag: x = v (1 - e^(-k t)) / k, and the same beside the fall at terminal velocity."""
    reach = (1 - xp.exp(-k * time)) / k
    return xp.stack([to[0] / reach, (to[1] + g / k * time) / reach - g / k])


@pytest.mark.exhaustive
def test_projectile_with_drag():
    """The start velocity to 1e-12, and its derivatives by parameters and the end in both modes. Twin: without drag."""

    def found(to, params):
        return lj.connect(thrown, np.zeros(2), to, 0.0, TIME, params, elements=4, outputs=2).start_velocity

    connection = lj.connect(thrown, np.zeros(2), TO, 0.0, TIME, PARAMS, elements=4, outputs=2)
    exact = start_velocity(TO, TIME, **PARAMS)
    assert np.max(np.abs(connection.start_velocity - exact)) < 1e-12
    assert connection.kind == "not variational: there is a dissipation" and connection.converged
    assert np.max(np.abs(connection.start_velocity - start_velocity(TO, TIME, PARAMS["g"], 1e-9))) > 0.1

    def by_hand(to, params):
        return start_velocity(to, TIME, params["g"], params["k"], jnp)

    expected = jax.jacfwd(by_hand, argnums=(0, 1))(jnp.asarray(TO), PARAMS)
    for mode in (jax.jacfwd, jax.jacrev):
        slopes = jax.jit(mode(found, argnums=(0, 1)))(jnp.asarray(TO), PARAMS)
        close = jax.tree.map(lambda a, b: np.allclose(a, b, rtol=1e-9, atol=1e-11), slopes, expected)
        assert all(jax.tree.leaves(close))


oscillator = lj.System(lambda t, q, v, params: 0.5 * (v @ v - q @ q))


@pytest.mark.slow
def test_index_and_conjugate_times():
    """Two equal oscillators: conjugate points of multiplicity two after each half period, found to 1e-11; the action is
    that of the closed form. Twin: before half a period it is a minimum."""
    a, b = np.array([1.0, 0.0]), np.array([0.5, 1.0])
    for time, index in ((3.1, 0), (10.0, 6)):
        found = lj.connect(oscillator, a, b, 0.0, time)
        action = ((a @ a + b @ b) * np.cos(time) - 2 * a @ b) / (2 * np.sin(time))
        assert abs(found.action / action - 1) < 1e-10 and found.index == index
        assert np.allclose(found.conjugate_times, np.pi * (1 + np.arange(index) // 2), atol=1e-11, rtol=0)
        assert found.kind == ("minimum" if not index else "saddle of index 6")
        assert np.allclose(found.start_velocity, (b - a * np.cos(time)) / np.sin(time), rtol=1e-11)


@pytest.mark.exhaustive
def test_free_ends():
    """A free height ends without vertical momentum; with a free time, a fall from rest to the ground at a given speed.
    Twin: the same with the height fixed has momentum left."""
    free = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) - params["g"] * q[1])
    found = lj.connect(
        free, np.zeros(2), TO, 0.0, TIME, PARAMS, end=lambda t, q, v, params: q[0] - 4.0, elements=4, outputs=2
    )
    assert np.allclose(found.start_velocity, [4.0 / TIME, PARAMS["g"] * TIME], rtol=1e-12)
    assert abs(found.end_velocity[1]) < 1e-12
    fixed = lj.connect(free, np.zeros(2), TO, 0.0, TIME, PARAMS, elements=4, outputs=2)
    assert abs(fixed.end_velocity[1]) > 0.1

    def landing(t, q, v, params):
        return jnp.stack([q[0] - 4.0, q[1], v[1] + 2.0])

    found = lj.connect(
        free, np.zeros(2), np.array([4.0, 0.1]), 0.0, 1.0, PARAMS, end=landing, free_time=True, elements=4, outputs=2
    )
    assert abs(found.duration - 4.0 / PARAMS["g"]) < 1e-12
    assert np.allclose(found.start_velocity, [PARAMS["g"], 2.0], rtol=1e-11)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"q_b": np.zeros(3)}, "must have the structure and shapes of q_a"),
        ({"t_b": 0.0}, "is not after t_a"),
        ({"t_b": -1.0}, "is not after t_a"),
        ({"end": lambda t, q, v, params: jnp.zeros(3)}, "there are 3 conditions of positions on the end"),
        ({"end": lambda t, q, v, params: v[0]}, "there is one condition with velocities"),
        ({"end": lambda t, q, v, params: (q, v)}, "must return a scalar or a vector that vanishes"),
        ({"starts": 0}, "there must be one at least"),
    ],
)
def test_refused(change, words):
    """What cannot be meant is refused in words."""
    given = {"q_a": np.zeros(2), "q_b": TO, "t_a": 0.0, "t_b": TIME, "params": PARAMS} | change
    with pytest.raises(ValueError, match=words):
        lj.connect(thrown, **given)


def test_refused_constraints():
    """An end off the constraints, and velocity constraints, are refused in words."""
    rod = {"rod": lj.Holonomic(lambda t, q, params: q @ q - 1.0)}
    with pytest.raises(ValueError, match="q_b is off the constraints by .* worst is 'rod'"):
        lj.connect(
            lj.System(lambda t, q, v, params: 0.5 * v @ v, rod), np.array([1.0, 0.0]), np.array([1.0, 1.0]), 0.0, 1.0
        )
