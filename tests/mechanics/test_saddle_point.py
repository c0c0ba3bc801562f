"""Redundant constraints: the same accelerations, the shortest multipliers, finite derivatives; contradictions named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.jaxtools import length
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanics.saddle_point import linear_equations
from lagjax.system import constraints, coordinates, model_of
from tests.jaxtools.in_numpy import in_numpy
from tests.systems import PARAMS, cartesian_lagrangian, rod
from tests.tiers import exhaustive_but

STATE = (
    0.0,
    {"x": 1.25 * np.sin(2.0), "y": -1.25 * np.cos(2.0)},
    {"x": 3.75 * np.cos(2.0), "y": 3.75 * np.sin(2.0)},
    PARAMS,
)


def twice(factor):
    """The rod given again, in another scale."""
    again = lj.Holonomic(lambda t, q, params: factor * rod(t, q, params))
    return lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "again": again})


def test_momenta_and_constraints_are_linearised_together():
    """M, F, A and gamma are those of separate derivatives, in three quarters of the operations."""

    def turning(t, q, v, params):
        return 0.5 * jnp.sum(jnp.cos(q[1:] - t) * v[1:] ** 2) + 0.5 * v @ v * jnp.exp(jnp.sin(q[0] * q[1])) - q[2]

    def bent(t, q, params):
        return jnp.stack([jnp.sin(q[0] * q[1]) + t * q[2], jnp.exp(q[1]) - q[2] ** 3])

    def slides(t, q, v, params):
        return v[0] * jnp.cos(q[1]) - v[2] * jnp.tanh(q[0]) + t

    system = lj.System(turning, {"bent": lj.Holonomic(bent), "slides": lj.Nonholonomic(slides)})
    s = coordinates.state(0.3, np.array([0.4, -0.7, 0.2]), np.array([1.1, 0.5, -0.8]), None)
    model = model_of(system, *s)

    def separately(t, x, u):
        return (*mass_and_forcing(model, t, x, u)[:2], *constraints.acceleration_rows(model, t, x, u))

    def together(t, x, u):
        linear, rows = linear_equations(model, t, x, u)
        return (*linear[:2], *rows)

    for found, expected in zip(in_numpy(together)(*s[:3]), in_numpy(separately)(*s[:3])):
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)
    few, many = (length(jax.make_jaxpr(f)(*s[:3]).jaxpr) for f in (together, separately))
    assert few < 0.8 * many


def door_lagrangian(t, q, v, params):
    """A door: four points of its plate, each of a quarter of its mass, in a field that is not along the hinge line."""
    return 0.5 * jnp.sum(v["corner"] ** 2) + jnp.sum(q["corner"] @ params["field"])


def hinges(t, q, params):
    """The plate's lower and upper inner corner, and a third hinge halfway up, each held in all three directions."""
    lower, upper = q["corner"][0], q["corner"][1]
    return jnp.concatenate(
        [lower, upper - jnp.array([0.0, 0.0, 2.0]), 0.5 * (lower + upper) - jnp.array([0.0, 0.0, 1.0])]
    )


def rigid(t, q, params):
    """The plate's fourth corner from the other three, and all six distances between corners: three would do."""
    corner = q["corner"]
    rectangle = corner[3] - corner[1] - corner[2] + corner[0]
    pairs = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    lengths = [2.0, 1.0, np.sqrt(5.0), np.sqrt(5.0), 1.0, 2.0]
    distances = jnp.stack([jnp.sum((corner[i] - corner[j]) ** 2) - l**2 for (i, j), l in zip(pairs, lengths)])
    return jnp.concatenate([rectangle, distances])


door = lj.System(door_lagrangian, {"hinges": lj.Holonomic(hinges), "rigid": lj.Holonomic(rigid)})
ANGLE, RATE = 0.4, 1.5
OUTWARD, ALONG = np.array([np.cos(ANGLE), np.sin(ANGLE), 0.0]), np.array([-np.sin(ANGLE), np.cos(ANGLE), 0.0])
AXIS = np.array([0.0, 0.0, 2.0])
DOOR_STATE = (
    0.0,
    {"corner": np.stack([0 * AXIS, AXIS, OUTWARD, AXIS + OUTWARD])},
    {"corner": RATE * np.stack([0 * AXIS, 0 * AXIS, ALONG, ALONG])},
    {"field": np.array([0.25, -0.5, -1.0])},
)


@pytest.mark.parametrize("factor", [-3.0, *(pytest.param(factor, marks=pytest.mark.slow) for factor in (1.0, 1e5))])
def test_constraint_given_twice(factor):
    """The accelerations are those of the rod given once, and the multipliers the shortest that exert its force."""
    a, multipliers = lj.accelerations(twice(factor), *STATE)
    # A length of 1.25 at an angle of 2 from the vertical, which turns at 3.
    across, inward, g = np.array([np.cos(2.0), np.sin(2.0)]), np.array([-np.sin(2.0), np.cos(2.0)]), PARAMS["g"]
    expected = -g * np.sin(2.0) * across + 1.25 * 9.0 * inward
    np.testing.assert_allclose([a["x"], a["y"]], expected, rtol=1e-13)
    share = -(1.25 * 9.0 + g * np.cos(2.0)) / 2.5 / (1 + factor**2)
    np.testing.assert_allclose(multipliers["rod"], share, rtol=1e-12)
    np.testing.assert_allclose(multipliers["again"], factor * share, rtol=1e-12)


def test_door_on_three_hinges():
    """A plate with 18 equations of which 11 are independent turns about its hinge line as its one-angle equation says.

    Multipliers: the least-squares solution of Aᵀ λ = M a - F by NumPy's pseudo-inverse.
    """
    a, multipliers = lj.accelerations(door, *DOOR_STATE)
    # Two corners at radius 1: 2 phi'' = the two forces along the direction of turning.
    turning = DOOR_STATE[3]["field"] @ ALONG
    np.testing.assert_allclose(a["corner"][2], turning * ALONG - RATE**2 * OUTWARD, atol=1e-12)
    np.testing.assert_allclose(a["corner"][:2], 0.0, atol=1e-12)
    x = DOOR_STATE[1]["corner"].ravel()
    unstack = lambda x: {"corner": x.reshape(4, 3)}
    both = lambda x: jnp.concatenate([g(0.0, unstack(x), None) for g in (hinges, rigid)])
    rows = in_numpy(jax.jacobian(both))(x)
    assert np.linalg.matrix_rank(rows, 1e-9) == 11
    forces = np.ravel(a["corner"]) - np.tile(DOOR_STATE[3]["field"], 4)
    shortest = np.linalg.pinv(rows.T, 1e-9) @ forces
    np.testing.assert_allclose(np.concatenate([multipliers["hinges"], multipliers["rigid"]]), shortest, atol=1e-11)


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", exhaustive_but((jax.jacrev,), (jax.jacfwd, jax.jacrev)))
def test_derivatives_of_shared_multipliers(mode):
    """Accelerations and shortest multipliers have the derivatives of their closed forms, in lanes too."""

    def outcome(x):
        q = {"x": x["l"] * jnp.sin(x["angle"]), "y": -x["l"] * jnp.cos(x["angle"])}
        v = {"x": x["l"] * x["rate"] * jnp.cos(x["angle"]), "y": x["l"] * x["rate"] * jnp.sin(x["angle"])}
        again = lj.Holonomic(lambda t, q, params: params["factor"] * rod(t, q, params))
        system = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "again": again})
        a, multipliers = lj.accelerations(system, 0.0, q, v, {"g": 9.8125, "l": x["l"], "factor": x["factor"]})
        tangential = jnp.cos(x["angle"]) * a["x"] + jnp.sin(x["angle"]) * a["y"]
        return jnp.stack([tangential, multipliers["rod"], multipliers["again"]])

    def exact(x):
        tension = x["l"] * x["rate"] ** 2 + 9.8125 * jnp.cos(x["angle"])
        share = -tension / (2 * x["l"] * (1 + x["factor"] ** 2))
        return jnp.stack([-9.8125 * jnp.sin(x["angle"]), share, x["factor"] * share])

    lanes = {name: jnp.array(values) for name, values in
             {"l": [1.25, 0.5], "angle": [2.0, 0.3], "rate": [3.0, -1.0], "factor": [0.5, -2.0]}.items()}  # fmt: skip
    got, expected = jax.vmap(mode(outcome))(lanes), jax.vmap(jax.jacfwd(exact))(lanes)
    for name in lanes:
        np.testing.assert_allclose(got[name], expected[name], atol=1e-11)


def test_equilibrium_is_no_contradiction():
    """At rest in equilibrium all accelerations are round-off; that does not count as disagreement."""
    hanging = {"x": 0.0, "y": -1.25}
    a, multipliers = lj.accelerations(twice(-3.0), 0.0, hanging, {"x": 0.0, "y": 0.0}, PARAMS)
    assert abs(float(a["y"])) < 1e-14
    total = float(multipliers["rod"]) - 3.0 * float(multipliers["again"])
    assert total == pytest.approx(-PARAMS["g"] / 2.5, rel=1e-13)
