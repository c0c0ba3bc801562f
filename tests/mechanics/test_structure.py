"""What is read off a jaxpr: angles, each with a coordinate that is none."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics import coordinates
from lagjax.mechanics.structure import angles, conserves_jacobi_integral

free = lambda t, q, v, params: 0.5 * (v["a"] ** 2 + v["b"] ** 2)


@pytest.mark.parametrize(
    ("potential", "found"),
    [
        (lambda q: jnp.cos(q["a"]) + q["b"] ** 2, (True, False)),
        (lambda q: jnp.sin(2 * q["a"] - q["b"] / 3) * jnp.exp(jnp.cos(q["b"])), (True, True)),
        (lambda q: jnp.sin(jnp.stack([q["a"], q["b"]])).sum(), (True, True)),
        (lambda q: jnp.cos(q["a"]) + 0.1 * q["a"], (False, False)),
        (lambda q: jnp.cos(q["a"] ** 2), (False, False)),
        (lambda q: jnp.cos(q["a"] * q["b"]) + jnp.cos(q["a"]), (True, True)),
        (lambda q: jnp.where(q["a"] > 0, jnp.cos(q["a"]), 1.0), (False, False)),
        (lambda q: jnp.linalg.norm(jnp.stack([jnp.cos(q["a"]), 2 + jnp.sin(q["b"])])), (True, True)),
        (lambda q: q["a"] * jnp.cos(q["a"]), (False, False)),
        (lambda q: 0.0, (False, False)),
    ],
)
def test_angles(potential, found):
    """A coordinate is an angle where it is seen through sines and cosines alone."""
    system = lj.System(lambda t, q, v, params: free(t, q, v, params) - potential(q))
    s = coordinates.state(0.0, {"a": 0.1, "b": 0.2}, {"a": 0.0, "b": 0.0}, None)
    assert tuple(angles(system, *s).values()) == found


def test_constraints_and_forces_count():
    """An angle in L is none where a constraint, a force or the dissipation sees its value."""
    turning = lambda t, q, v, params: free(t, q, v, params) + jnp.cos(q["a"]) + jnp.cos(q["b"])
    s = coordinates.state(0.0, {"a": 0.1, "b": 0.2}, {"a": 0.0, "b": 0.0}, None)
    gear = {"gear": lj.Holonomic(lambda t, q, params: q["a"] - 2 * q["b"])}
    spring = lambda t, q, v, params: {"a": -q["a"], "b": jnp.zeros(())}
    assert tuple(angles(lj.System(turning), *s).values()) == (True, True)
    assert tuple(angles(lj.System(turning, gear), *s).values()) == (False, False)
    assert tuple(angles(lj.System(turning, force=spring), *s).values()) == (False, True)


def test_vectors_of_angles():
    """A chain's vector of angles is one leaf, taken as a whole."""
    chain = lambda t, q, v, params: 0.5 * v @ v + jnp.sum(jnp.cos(q[:, None] - q[None, :])) + jnp.cos(q).sum()
    s = coordinates.state(0.0, np.zeros(4), np.zeros(4), None)
    assert angles(lj.System(chain), *s) is True
    mixed = lambda t, q, v, params: 0.5 * v @ v + jnp.cos(q[0]) - q[1] ** 2
    assert angles(lj.System(mixed), *s) is False


def test_conserved_jacobi_integral():
    """Explicit time in L or a constraint, a force, dissipation or a velocity constraint each take it away."""
    s = coordinates.state(0.0, {"a": 0.1, "b": 0.2}, {"a": 0.0, "b": 0.0}, {"k": 1.0})
    known = lambda **parts: conserves_jacobi_integral(lj.System(**({"lagrangian": free} | parts)), *s)
    fixed, moving = (lj.Holonomic(lambda t, q, params, rate=rate: q["a"] - q["b"] * (1 + rate * t)) for rate in (0, 1))
    assert known() and known(constraints={"fixed": lj.Holonomic(lambda t, q, params: q["a"] - q["b"])})
    assert not known(lagrangian=lambda t, q, v, params: free(t, q, v, params) * jnp.cos(t))
    assert not known(constraints={"moving": moving})
    assert not known(constraints={"rolling": lj.Nonholonomic(lambda t, q, v, params: v["a"] - v["b"])})
    assert not known(force=lambda t, q, v, params: v)
    assert not known(dissipation=lambda t, q, v, params: v["a"] ** 2)
    # Time enters the expression but multiplies zero: not seen as constant, which errs on the safe side.
    assert not known(constraints={"fixed": fixed})
