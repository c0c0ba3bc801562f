"""Motions in phases as trajectories: each output in its own phase, between outputs too."""

import jax
import numpy as np
import pytest

import lagjax as lj


def ball(t, q, v, params):
    """A ball under gravity."""
    return 0.5 * v**2 - params["g"] * q


@pytest.mark.exhaustive
def test_motions_in_phases():
    """A ball that bounces with half of its speed: parabolas between the impacts at t = 1, 2 and 2.5."""
    floor = [
        lj.Switch(one, to=other, when=lambda t, q, v, params: q, reset=lambda t, q, v, params: -0.5 * v)
        for one, other in (("up", "down"), ("down", "up"))
    ]
    system = lj.System(ball)
    bouncing = lj.Hybrid({"up": system, "down": system}, floor, most_switches=4)
    traj = lj.integrate(bouncing, 5.0, 0.0, {"g": 10.0}, ts=np.array([0.0, 0.4, 2.7]))
    t = np.array([2.6, 0.2, 0.99, 1.01, 1.5, 2.25])
    since, speed = np.array([2.5, 0, 0, 1.0, 1.0, 2.0]), np.array([1.25, 0, 0, 5.0, 5.0, 2.5])
    height = np.where(since == 0, 5.0, 0.0) + speed * (t - since) - 5.0 * (t - since) ** 2
    found = traj.at(t)
    np.testing.assert_allclose(found.q, height, atol=1e-8)
    np.testing.assert_allclose(found.v, speed - 10.0 * (t - since), atol=1e-7)
    with pytest.raises(TypeError, match="needs the values of its switches"):
        jax.jit(lambda traj: traj.at(0.3))(traj)
