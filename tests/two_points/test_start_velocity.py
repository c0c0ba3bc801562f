"""Motions between two ends by shooting alone: a knife edge on an incline, and friction that depends on a multiplier."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

edge = lj.Nonholonomic(lambda t, q, v, params: v[0] * jnp.sin(q[2]) - v[1] * jnp.cos(q[2]))
skate = lj.System(
    lambda t, q, v, params: 0.5 * (v[0] ** 2 + v[1] ** 2) + 0.5 * params["J"] * v[2] ** 2 + params["g"] * q[0],
    {"edge": edge},
)
PARAMS, TIME, SPEED, TURN = {"g": 3.0, "J": 0.4}, 1.7, 0.8, 1.3


def on_the_incline(time, speed, turn, g):
    """(x, y, φ) of a knife edge that starts downhill at `speed` and turns at the constant rate `turn`: u̇ = g cos φ."""
    angle = turn * time
    x = g / (2 * turn**2) * np.sin(angle) ** 2 + speed / turn * np.sin(angle)
    y = g / (2 * turn**2) * (angle - 0.5 * np.sin(2 * angle)) + speed / turn * (1 - np.cos(angle))
    return np.array([x, y, angle])


END = on_the_incline(TIME, SPEED, TURN, PARAMS["g"])


def to_the_end(t, q, v, params):
    """The place downhill and the angle: two conditions for two free start velocities."""
    return jnp.stack([q[0] - END[0], q[2] - END[2]])


@pytest.mark.slow
def test_knife_edge():
    """The start velocity and the end of the closed form to 1e-12; with a free time all three numbers of the end can be
    asked for. Twin: with half of the slope the start is faster."""
    found = lj.connect(skate, np.zeros(3), END, 0.0, TIME, PARAMS, end=to_the_end, outputs=5)
    exact = np.array([SPEED, 0.0, TURN])
    assert found.kind == "not variational: there is a velocity constraint" and bool(found.converged)
    assert np.max(np.abs(found.start_velocity - exact)) < 1e-12 and np.max(np.abs(found.q[-1] - END)) < 1e-12
    known = lj.integrate(skate, np.zeros(3), exact, PARAMS, ts=found.t, rtol=1e-13)
    assert np.max(np.abs(found.multipliers["edge"] - known.multipliers["edge"])) < 1e-10
    free = lj.connect(
        skate, np.zeros(3), END, 0.0, 1.0, PARAMS, end=lambda t, q, v, params: q - END, free_time=True, outputs=5
    )
    assert abs(free.duration - TIME) < 1e-12 and np.max(np.abs(free.start_velocity - exact)) < 1e-12
    slower = lj.connect(skate, np.zeros(3), END, 0.0, TIME, PARAMS | {"g": 1.5}, end=to_the_end, outputs=5)
    assert slower.start_velocity[0] > SPEED + 0.1


@pytest.mark.exhaustive
def test_derivatives():
    """By a parameter and by what is asked, in both modes, under `jit`: v_x = (x - g sin² / 2 ω²) ω / sin."""

    def speed(g, x):
        return lj.connect(
            skate, np.zeros(3), END, 0.0, TIME, PARAMS | {"g": g}, outputs=2,
            end=lambda t, q, v, params: jnp.stack([q[0] - x, q[2] - END[2]]),
        ).start_velocity[0]  # fmt: skip

    exact = -np.sin(END[2]) / (2 * TURN), TURN / np.sin(END[2])
    for mode in (jax.jacfwd, jax.jacrev):
        assert np.allclose(jax.jit(mode(speed, (0, 1)))(PARAMS["g"], END[0]), exact, rtol=1e-9)


@pytest.mark.exhaustive
def test_friction():
    """A block on an incline with friction μ N: uniformly accelerated, so the start velocity is known. Twin: without
    friction it is slower. Where no motion gets there, that is said with what was tried."""
    block = lj.System(
        lambda t, q, v, params: 0.5 * (v[0] ** 2 + v[1] ** 2) + params["along"] * q[0] - params["across"] * q[1],
        {"floor": lj.Holonomic(lambda t, q, params: q[1])},
        force=lambda t, q, v, multipliers, params: jnp.stack(
            [-params["mu"] * multipliers["floor"] + 0.0 * v[0], 0.0 * v[1]]
        ),
    )
    params = {"along": 3.0, "across": 9.0, "mu": 0.2}
    for mu in (0.2, 0.0):
        found = lj.connect(block, np.zeros(2), np.array([4.0, 0.0]), 0.0, 2.0, params | {"mu": mu}, outputs=3)
        exact = 4.0 / 2.0 - 0.5 * (params["along"] - mu * params["across"]) * 2.0
        assert np.max(np.abs(found.start_velocity - np.array([exact, 0.0]))) < 1e-12
        assert np.allclose(found.multipliers["floor"], params["across"], rtol=1e-12)
    with pytest.warns(lj.ConnectWarning, match="Newton's method by integration failed beyond"):
        missed = lj.connect(
            block, np.zeros(2), np.zeros(2), 0.0, 2.0, params, end=lambda t, q, v, params: q[0] ** 2 + 1.0, outputs=3
        )
    assert not bool(missed.converged) and np.all(np.isnan(missed.start_velocity))


@pytest.mark.parametrize(
    "change, words",
    [
        ({}, "q_b has 3 free coordinates, and the motion 2 free start velocities: 'edge' restricts velocities"),
        ({"end": lambda t, q, v, params: q}, "there are 3 conditions on the end, and there must be 2"),
        ({"end": lambda t, q, v, params: v[0]}, "there is one condition with velocities on the end"),
        ({"end": to_the_end, "free_time": True}, "there are 2 conditions on the end, and there must be 3"),
    ],
)
def test_refused(change, words):
    """What cannot be reached is counted in words."""
    with pytest.raises(ValueError, match=words):
        lj.connect(skate, np.zeros(3), END, 0.0, TIME, PARAMS, **change)
