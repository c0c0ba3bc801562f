"""The benchmarks' vehicle is the published bicycle: its accelerations obey the linear equations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from benchmarks.speed import bicycle

SPEED, SMALL = 5.0, 1e-6


def disturbed(params, roll, steer, roll_rate, steer_rate):
    """A state near straight running, consistent to first order: the wheels turn the frame, tipping moves the hub."""
    q, v = bicycle.straight(SPEED, roll_rate)
    yaw_rate = (SPEED * steer + params["trail"] * steer_rate) * np.cos(params["tilt"]) / params["wheelbase"]
    return q | {"roll": roll, "steer": steer}, v | {"steer": steer_rate, "yaw": yaw_rate}


@pytest.mark.exhaustive
def test_it_runs_straight_and_obeys_the_published_linear_equations():
    """M a = -u C₁ rates - (g K₀ + u² K₂) angles, for each of four disturbances; with another trail it does not."""
    respond = jax.jit(lambda q, v, params: lj.accelerations(bicycle.system, 0.0, q, v, params))

    def left(params):
        found = []
        for disturbance in SMALL * np.eye(4):
            q, v = disturbed(params, *disturbance)
            off = jnp.concatenate([bicycle.contact(0.0, q, params), bicycle.slip(0.0, q, v, params)])
            assert float(jnp.max(jnp.abs(off))) < 100 * SMALL**2
            a, _ = respond(q, v, params)
            x, rate, second = disturbance[:2], disturbance[2:], np.array([a["roll"], a["steer"]])
            stiffness = params["g"] * bicycle.K0 + SPEED**2 * bicycle.K2
            inertia = bicycle.M @ second
            found.append(np.max(np.abs(inertia + SPEED * bicycle.C1 @ rate + stiffness @ x)) / np.max(np.abs(inertia)))
        return np.array(found)

    assert np.max(left(bicycle.PARAMS)) < 1e-4
    assert np.max(left(bicycle.PARAMS | {"trail": 0.1})) > 1e-2
    # In straight running only gravity acts: 94 kg stand on two contacts.
    a, forces = respond(*bicycle.straight(SPEED), bicycle.PARAMS)
    assert max(abs(float(x)) for x in a.values()) < 1e-9
    np.testing.assert_allclose(np.sum(forces["contact"]), -94 * bicycle.PARAMS["g"], rtol=1e-12)
