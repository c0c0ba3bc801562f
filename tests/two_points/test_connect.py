"""Motions between two ends against closed forms; what kind they are; conditions on a free end; what is refused."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import ellipe, ellipkm1

import lagjax as lj
from lagjax.two_points.answer import Connection, is_same

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
        ({"q_b": np.zeros(3)}, "q_b must be like q_a, in structure and shapes"),
        ({"t_b": 0.0}, "is not after t_a"),
        ({"t_b": np.inf}, "t_b is inf, and a motion goes from one finite state"),
        ({"q_b": np.array([4.0, np.nan])}, r"coordinate 'q\[1\]' of q_b is nan, and a motion goes"),
        ({"t_b": -1.0}, "is not after t_a"),
        ({"end": lambda t, q, v, params: jnp.zeros(3)}, "there are 3 conditions of positions on the end"),
        ({"end": lambda t, q, v, params: v[0]}, "there is one condition with velocities"),
        ({"end": lambda t, q, v, params: (q, v)}, "must return a scalar or a vector that vanishes"),
        ({"starts": 0}, "starts must be a whole number above zero, not 0"),
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


swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.cos(q))


@pytest.mark.exhaustive
def test_over_the_top():
    """A pendulum that swings once from 0 to 0 in 20, to within 4e-4 of its top: the start speed and the action of the
    elliptic integrals, and the trajectory that is returned ends there. Twin: in 40 errors grow by 1e15, so that the
    path is all that there is, which is said: not converged, no trajectory."""
    found = lj.connect(swing, 0.0, 0.0, 0.0, 20.0, starts=lambda t: 3.14 * jnp.sqrt(jnp.sin(jnp.pi * t / 20)))
    # 2 K(k) = 20 by Newton's method from k' = 4 exp(-10); S = 8 E - 2 K - 4 k'² K.
    beside = 4 * np.exp(-10.0)
    for _ in range(3):
        beside *= np.exp(ellipkm1(beside**2) - 10)
    speed, action = 2 * np.sqrt(1 - beside**2), 8 * ellipe(1 - beside**2) - 20 - 40 * beside**2
    assert bool(found.converged) and found.kind == "minimum" and found.missed < 1e-6
    assert abs(abs(found.start_velocity) - speed) < 1e-12 and abs(found.action - action) < 1e-10
    assert found.trajectory is not None and abs(found.trajectory.q[-1]) < 1e-6
    with pytest.warns(lj.ConnectWarning, match="a path was found .* and no motion that follows it: motions from its"):
        longer = lj.connect(swing, 0.0, 0.0, 0.0, 40.0, starts=lambda t: 3.14 * jnp.sqrt(jnp.sin(jnp.pi * t / 40)))
    assert not bool(longer.converged) and longer.trajectory is None and longer.kind.startswith("a path alone: motions")
    assert abs(longer.action + 32) < 1e-9 and abs(abs(longer.start_velocity) - 2) < 1e-9


@pytest.mark.exhaustive
def test_ways_down():
    """From rest, a saddle of index six, the swing of least action is found on both sides.

    Twin: the line alone is rest.
    """
    found = lj.connect(swing, 0.0, 0.0, 0.0, 20.0, starts=2)
    assert abs(found.action + 12.0000000659569) < 1e-9 and found.kind == "minimum"
    assert found.start_velocity * found.others[0].start_velocity < 0 and found.others[0].kind == "minimum"
    rest = lj.connect(swing, 0.0, 0.0, 0.0, 20.0)
    assert rest.kind == "saddle of index 6" and abs(rest.action - 20) < 1e-12


def handed_out(**changes):
    """A connection by hand."""
    zero, numbers = np.zeros(()), {"action": np.ones(()), "index": np.zeros((), int), "amplification": np.ones(())}
    fields = {
        "t": np.linspace(0.0, 1.0, 3), "q": np.linspace(0.0, 1.0, 3), "v": np.ones(3), "multipliers": {},
        "trajectory": None, "start_velocity": zero + 1, "end_velocity": zero + 1, "duration": zero + 1,
        "missed": zero, "mesh_error": zero, "converged": np.asarray(True), "conjugate_times": None,
    }  # fmt: skip
    return Connection(**{**fields, **numbers, **changes})


@pytest.mark.parametrize(
    "changes, kind",
    [
        ({}, "minimum"),
        ({"index": np.array(2)}, "saddle of index 2"),
        ({"converged": np.array(False)}, "not found"),
        ({"converged": np.array(False), "why_not_variational": "there is a force"}, "not found"),
        ({"converged": np.array(False), "alone": "motions miss the end"}, "a path alone: motions miss the end"),
        ({"mesh_error": np.array(1e-3)}, "not resolved: the elements follow the path to 1e-03"),
        ({"amplification": np.array(1e14)}, "degenerate: ends are conjugate"),
    ],
)
def test_kinds(changes, kind):
    """What is said of an answer is decided by what it holds."""
    assert handed_out(**changes).kind == kind


def test_the_same_answer():
    """Answers are the same that start alike and stay together. Twins: another start; alike at first, and then apart."""
    one = handed_out()
    assert is_same(one, handed_out(start_velocity=np.array(1 + 1e-9)))
    assert not is_same(one, handed_out(start_velocity=np.array(1 + 1e-3)))
    assert not is_same(one, handed_out(q=np.array([0.0, 0.7, 1.0])))
    assert not is_same(one, handed_out(v=np.array([1.0, 1.0, -1.0])))
