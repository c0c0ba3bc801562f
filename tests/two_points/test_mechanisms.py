"""Motions on constraints from one position to another: a slider-crank and a rod, against the equation of one angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanisms import slider_crank


def flat(tree):
    """All numbers of a state, in a row."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


@pytest.mark.exhaustive
def test_slider_crank():
    """From the end of a motion back to its start's 150 rad/s, the end's velocity and the multipliers of `integrate`.

    The motion has one degree of freedom, never stops and so is a minimum: on rows in units of constraints (1e-5 of
    those of the mass) the index must be counted to say so. Twin: in a shorter time the start is faster.
    """
    crank, time = slider_crank, 0.012
    known = lj.integrate(crank.system, crank.q0, crank.v0, crank.params, ts=np.linspace(0.0, time, 9), rtol=1e-13)
    reach = lambda time: lj.connect(crank.system, crank.q0, known.end.q, 0.0, time, crank.params, outputs=9)
    found = reach(time)
    assert found.kind == "minimum" and found.trajectory is not None
    for ours, exact in ((found.start_velocity, crank.v0), (found.end_velocity, known.end.v)):
        assert np.allclose(flat(ours), flat(exact), rtol=0, atol=150 * 1e-10)
    assert np.allclose(flat(jax.tree.map(lambda x: x[-1], found.q)), flat(known.end.q), rtol=0, atol=1e-10)
    assert np.allclose(flat(found.multipliers), flat(known.multipliers), rtol=0, atol=1600 * 1e-10)
    assert reach(0.99 * time).start_velocity.crank.angle > 151.0


@pytest.mark.exhaustive
def test_derivatives_on_a_constraint():
    """By a parameter and an end on the constraint, in both modes: of θ'' = -g cos θ, beside the turn φ t/T at g = 0."""
    rod = lj.System(
        lambda t, q, v, params: 0.5 * v @ v - params["g"] * q[1],
        {"rod": lj.Holonomic(lambda t, q, params: q @ q - 1.0)},
    )

    def start_speed(g, angle):
        end = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return lj.connect(rod, jnp.array([1.0, 0.0]), end, 0.0, 0.5, {"g": g}, outputs=2).start_velocity[1]

    angle, time = 0.7, 0.5
    exact = (1 - np.cos(angle)) * time / angle**2, 1 / time
    for mode in (jax.jacfwd, jax.jacrev):
        assert np.allclose(jax.jit(mode(start_speed, (0, 1)))(0.0, angle), exact, rtol=1e-9)
