"""What is read off a jaxpr: angles, each with a coordinate that is not one."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics.structure import are_angles, is_diagonal, structure
from lagjax.system import coordinates
from lagjax.system.model import model_of

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
    """A coordinate is an angle if it occurs only inside sines and cosines."""
    system = lj.System(lambda t, q, v, params: free(t, q, v, params) - potential(q))
    s = coordinates.state(0.0, {"a": 0.1, "b": 0.2}, {"a": 0.0, "b": 0.0}, None)
    assert tuple(are_angles(model_of(system, *s))) == found


def test_constraints_and_forces_count():
    """An angle in L is not one if a constraint or a force depends on its value."""
    turning = lambda t, q, v, params: free(t, q, v, params) + jnp.cos(q["a"]) + jnp.cos(q["b"])
    s = coordinates.state(0.0, {"a": 0.1, "b": 0.2}, {"a": 0.0, "b": 0.0}, None)
    gear = {"gear": lj.Holonomic(lambda t, q, params: q["a"] - 2 * q["b"])}
    spring = lambda t, q, v, params: {"a": -q["a"], "b": jnp.zeros(())}
    assert tuple(are_angles(model_of(lj.System(turning), *s))) == (True, True)
    assert tuple(are_angles(model_of(lj.System(turning, gear), *s))) == (False, False)
    assert tuple(are_angles(model_of(lj.System(turning, force=spring), *s))) == (False, True)


def test_vectors_of_angles():
    """A chain's vector of angles is one leaf, taken as a whole."""
    chain = lambda t, q, v, params: 0.5 * v @ v + jnp.sum(jnp.cos(q[:, None] - q[None, :])) + jnp.cos(q).sum()
    s = coordinates.state(0.0, np.zeros(4), np.zeros(4), None)
    assert tuple(are_angles(model_of(lj.System(chain), *s))) == (True,) * 4
    mixed = lambda t, q, v, params: 0.5 * v @ v + jnp.cos(q[0]) - q[1] ** 2
    assert tuple(are_angles(model_of(lj.System(mixed), *s))) == (False,) * 4


def of(lagrangian, q, constraints=None, **functions):
    """The structure at some state."""
    s = coordinates.state(0.3, q, np.ones_like(q), None)
    return structure(model_of(lj.System(lagrangian, constraints, **functions), *s))


def test_mass_matrix():
    """What the mass matrix depends on and couples: constant or not, diagonal, in blocks, dense."""
    q = np.array([0.2, 0.4, 0.6])
    constant = of(lambda t, q, v, params: 0.5 * jnp.sum(v**2) - jnp.sum(q**2) * jnp.cos(t), q)
    assert constant.mass_depends_on == () and len(constant.blocks) == 3
    coupled = of(lambda t, q, v, params: 0.5 * jnp.sum(v**2) + v[0] * v[2] * jnp.cos(q[1] - q[2]) * t, q)
    assert coupled.mass_depends_on == ("t", "q[1]", "q[2]")
    assert coupled.blocks == (("q[0]", "q[2]"), ("q[1]",))
    dense = of(lambda t, q, v, params: -jnp.sqrt(1 - jnp.dot(v, v)), q)
    assert dense.mass_depends_on == ("velocities",) and len(dense.blocks) == 1
    # A zero at this state alone is not a zero entry.
    assert len(of(lambda t, q, v, params: jnp.dot(v, v) + v[0] * v[1] * (q[0] - 0.2), q).blocks) == 2


def test_time_cyclic_coordinates_and_linear_terms():
    """Cyclic coordinates, explicit time and linear terms, each with a twin that differs by one term."""
    q = np.array([0.2, 0.4])
    planar = lambda t, q, v, params: 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2)
    central = of(planar, q)
    assert (central.cyclic, central.explicit_time, central.linear_terms) == (("q[1]",), False, ())
    driven = of(lambda t, q, v, params: planar(t, q, v, params) + jnp.cos(q[1] - t), q)
    assert (driven.cyclic, driven.explicit_time) == ((), True)
    assert of(planar, q, force=lambda t, q, v, params: jnp.stack([jnp.cos(t), 0.0])).explicit_time
    turning = of(lambda t, q, v, params: planar(t, q, v, params) + 3.0 * q[0] ** 2 * v[1], q)
    assert turning.linear_terms == ("q[1]",)


def test_constraints():
    """Constraints that are linear with constant coefficients or not, moving or not."""
    q = np.array([0.2, 0.4])
    found = of(
        lambda t, q, v, params: 0.5 * jnp.sum(v**2),
        q,
        {
            "circle": lj.Holonomic(lambda t, q, params: jnp.dot(q, q) - 1),
            "line": lj.Holonomic(lambda t, q, params: q[0] - 2 * q[1] - jnp.sin(t)),
            "skate": lj.Nonholonomic(lambda t, q, v, params: v[0] * jnp.sin(q[1]) - v[1]),
            "drag": lj.Nonholonomic(lambda t, q, v, params: v[0] - 3.0 * v[1] + q[0] ** 2),
        },
    ).constraints
    assert {name: tuple(c) for name, c in found.items()} == {
        "circle": (False, False), "line": (True, True), "skate": (False, False), "drag": (True, False)
    }  # fmt: skip


def test_a_large_system_is_not_taken_apart():
    """Beyond two dozen coordinates the structure is not examined."""
    assert of(lambda t, q, v, params: 0.5 * jnp.sum(v**2), np.ones(25)) is None


def mass_by_quadrature(nodes):
    """A system with a mass by quadrature of many nodes, and a state."""
    angles = np.linspace(0.0, 6.0, nodes)
    apart = lambda q: (q[0] - jnp.cos(angles)) ** 2 + (q[1] - jnp.sin(angles)) ** 2 + q[2] ** 2
    wire = lambda q: jnp.sum(1 / jnp.sqrt(apart(q)) + jnp.exp(-apart(q)))
    system = lj.System(lambda t, q, v, params: 0.5 * v @ v * wire(q))
    return system, coordinates.state(0.0, np.array([2.0, 0.0, 0.3]), np.ones(3), None)


@pytest.mark.parametrize(("nodes", "known"), [(4, True), (500, False)])
def test_a_long_program_is_not_taken_apart(nodes, known):
    """A long mass matrix has no structure; twin: few nodes."""
    system, s = mass_by_quadrature(nodes)
    assert (structure(model_of(system, *s)) is not None) == known


def test_a_long_mass_matrix_is_not_known_to_be_diagonal():
    """Writing out a long program is given up before its end; the twin's is short."""

    def of(count):
        def lagrangian(t, q, v, params):
            mass = jnp.arange(float(count)) * q[0]
            for _ in range(20):
                mass = 1.0 + jnp.sin(mass)
            return jnp.sum(mass) * v @ v

        return lj.System(lagrangian)

    s = coordinates.state(0.0, np.ones(2), np.ones(2), None)
    assert is_diagonal(model_of(of(4), *s)) and not is_diagonal(model_of(of(500), *s))
