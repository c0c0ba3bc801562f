"""The nearest consistent state: it is the nearest, can hold coordinates, is differentiable, and fails openly.

Constraints at acceleration level: forces, signs, singular and indefinite mass matrices.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax import Holonomic, Nonholonomic, System, constraint_force, constraint_residual
from lagjax.mechanics.constrained_state import free_coordinates
from tests.jaxtools.in_numpy import accelerations
from tests.tiers import exhaustive_but

rng = np.random.default_rng(5)
MASSES = np.array([2.0, 0.5])


def lagrangian(t, q, v, params):
    """A particle whose inertia differs along its two axes: its metric is not Euclidean."""
    return 0.5 * (params["m"][0] * v["x"] ** 2 + params["m"][1] * v["y"] ** 2)


def ellipse(t, q, params):
    """An ellipse whose long axis grows with time."""
    return (q["x"] / (params["a"] + t)) ** 2 + q["y"] ** 2 - 1.0


on_ellipse = lj.System(lagrangian, {"ellipse": lj.Holonomic(ellipse)})
PARAMS = {"m": MASSES, "a": 1.5}
FAR = (0.5, {"x": 3.0, "y": 2.0}, {"x": 1.0, "y": -2.0})


def nearest_by_angle(t, q, v, params):
    """The same point by Newton on d(distance²)/d(angle) = 0 for the ellipse's angle, and its velocity by hand."""
    a = params["a"] + t
    point = lambda angle: jnp.stack([a * jnp.cos(angle), jnp.sin(angle)])
    given = jnp.stack([q["x"], q["y"]])
    slope = jax.grad(lambda angle: 0.5 * jnp.sum(params["m"] * (point(angle) - given) ** 2))
    angle = jnp.arctan2(q["y"], q["x"] / a)
    for _ in range(20):
        angle = angle - slope(angle) / jax.grad(slope)(angle)
    x, y = point(angle)
    # phi = normal . u + dg/dt; the shortest correction of u lies along the normal over the masses.
    normal, rate = jnp.stack([2 * x / a**2, 2 * y]), -2 * x**2 / a**3
    u = jnp.stack([v["x"], v["y"]])
    correction = (normal @ u + rate) / (normal @ (normal / params["m"]))
    return jnp.stack([x, y, *(u - correction * normal / params["m"])])


def flat(state):
    """Return (q, v) as one vector."""
    q, v = state
    return jnp.stack([q["x"], q["y"], v["x"], v["y"]])


AGAIN = lj.Holonomic(lambda t, q, params: 2.0 * ellipse(t, q, params))
twice = lj.System(lagrangian, {"ellipse": lj.Holonomic(ellipse), "again": AGAIN})


@pytest.mark.exhaustive
@pytest.mark.parametrize("system", [on_ellipse, twice], ids=["once", "given twice"])
def test_nearest_in_the_metric_of_the_masses(system):
    """From far away the nearest point of a moving ellipse is found, 1e-12 from its one-angle solution.

    The nearest in Euclid's metric is elsewhere: the masses count.
    """
    found = flat(lj.consistent_state(system, *FAR, PARAMS))
    np.testing.assert_allclose(found, nearest_by_angle(*FAR, PARAMS), atol=1e-12)
    euclidean = nearest_by_angle(*FAR, PARAMS | {"m": np.ones(2)})
    assert np.max(np.abs(found - euclidean)) > 0.05


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode", exhaustive_but((jax.jacrev,), (jax.jacfwd, jax.jacrev)))
def test_derivatives_by_everything(mode):
    """Derivatives by time, state and parameters are those of the one-angle solution, even from far off."""
    ours = lambda t, q, v, params: flat(lj.consistent_state(on_ellipse, t, q, v, params))
    got = mode(ours, argnums=(0, 1, 2, 3))(*FAR, PARAMS)
    expected = jax.jacfwd(nearest_by_angle, argnums=(0, 1, 2, 3))(*FAR, PARAMS)
    assert jax.tree.structure(got) == jax.tree.structure(expected)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(expected)):
        np.testing.assert_allclose(a, b, atol=1e-10)


def crank_slider_constraints(t, q, params):
    """A crank of length 1 and a rod of length 2.5 that ends on the x axis."""
    return jnp.stack(
        [jnp.cos(q["crank"]) + 2.5 * jnp.cos(q["rod"]) - q["slider"], jnp.sin(q["crank"]) + 2.5 * jnp.sin(q["rod"])]
    )


crank_slider = lj.System(
    lambda t, q, v, params: 0.5 * (v["crank"] ** 2 + 3 * v["rod"] ** 2 + 2 * v["slider"] ** 2),
    {"joint": lj.Holonomic(crank_slider_constraints)},
)


@pytest.mark.slow
def test_held_coordinates_keep_position_and_velocity():
    """With the crank's angle and speed held, rod and slider follow from the closed form of the mechanism."""
    guess = {"crank": 0.7, "rod": -0.2, "slider": 3.0}
    q, v = lj.consistent_state(crank_slider, 0.0, guess, {"crank": 2.0, "rod": 0.0, "slider": 0.0}, None, hold="crank")
    assert (float(q["crank"]), float(v["crank"])) == (0.7, 2.0)
    rod = -np.arcsin(np.sin(0.7) / 2.5)
    rod_rate = -2.0 * np.cos(0.7) / (2.5 * np.cos(rod))
    expected = (rod, np.cos(0.7) + 2.5 * np.cos(rod), rod_rate, -2 * np.sin(0.7) - 2.5 * np.sin(rod) * rod_rate)
    np.testing.assert_allclose([q["rod"], q["slider"], v["rod"], v["slider"]], expected, atol=1e-13)


@pytest.mark.slow
def test_random_starts_reach_the_manifold_in_lanes():
    """From random guesses of a crank-slider all lanes end on the constraints, nearly all at a stationary distance."""
    guesses = {name: jnp.asarray(rng.uniform(-3, 3, 200)) for name in ("crank", "rod", "slider")}
    rates = {name: jnp.asarray(rng.normal(size=200)) for name in guesses}
    solve = jax.jit(jax.vmap(lambda q, v: lj.consistent_state(crank_slider, 0.0, q, v, None)))
    q, v = solve(guesses, rates)
    residual = jax.vmap(lambda q: crank_slider_constraints(0.0, q, None))(q)
    np.testing.assert_allclose(residual, 0.0, atol=1e-13)
    masses = {"crank": 1.0, "rod": 3.0, "slider": 2.0}
    pull = {name: masses[name] * (q[name] - guesses[name]) for name in masses}
    # Stationary: no pull along the only free direction (1, rod', slider') of the mechanism.
    rod_rate = -jnp.cos(q["crank"]) / (2.5 * jnp.cos(q["rod"]))
    slider_rate = -jnp.sin(q["crank"]) - 2.5 * jnp.sin(q["rod"]) * rod_rate
    along = pull["crank"] + rod_rate * pull["rod"] + slider_rate * pull["slider"]
    assert np.mean(np.abs(along) < 1e-10) > 0.95


@pytest.mark.slow
def test_the_best_state_is_where_the_least_is_missing():
    """Two circles of radius one, their centres 2.5 apart, miss each other by 0.5: the point between by 0.25 each."""
    away = lambda x: lj.Holonomic(lambda t, q, params: jnp.hypot(q["x"] - x, q["y"]) - 1.0)
    system = lj.System(lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2), {"a": away(1.0), "b": away(-1.5)})
    with pytest.raises(ValueError, match="no consistent state") as caught:
        lj.consistent_state(system, 0.0, {"x": 0.3, "y": 0.8}, {"x": 0.0, "y": 0.0}, None)
    missed = [float(x) for x in re.findall(r"'[ab]' = ([-+0-9.e]+[0-9])", str(caught.value))]
    np.testing.assert_allclose(missed, [0.25, 0.25], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("factors", exhaustive_but(((1,),), ((1,), (1, 2))), ids=["once", "twice"])
def test_one_coordinate(factors):
    """One coordinate with one or two equations gets the position and velocity that these prescribe."""
    holds = lambda factor: lj.Holonomic(lambda t, q, params: factor * (q - jnp.sin(t)))
    held = lj.System(lambda t, q, v, params: 0.5 * v**2, {str(factor): holds(factor) for factor in factors})
    q, v = lj.consistent_state(held, 0.5, 2.0, 0.3, None)
    np.testing.assert_allclose([q, v], [np.sin(0.5), np.cos(0.5)], rtol=1e-12)


@pytest.mark.exhaustive
def test_a_held_coordinate_that_a_constraint_fixes():
    """A held value that satisfies a constraint makes it a dependent equation; one that violates it is reported."""
    particle = lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2)
    wall = lj.Holonomic(lambda t, q, params: q["x"] - jnp.sin(t))
    sphere = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 + q["z"] ** 2 - 1.0)
    moving = {"x": 1.0, "y": 0.5, "z": 0.0}
    alone, both = lj.System(particle, {"wall": wall}), lj.System(particle, {"wall": wall, "sphere": sphere})
    on_it = {"x": 0.0, "y": 1.5, "z": 0.25}
    q, v = lj.consistent_state(alone, 0.0, on_it, moving, None, hold="x")
    assert (q, v) == (on_it, moving)
    # Whether x is held or found, the nearest point of the sphere is the same.
    found, held = (lj.consistent_state(both, 0.0, on_it, moving, None, hold=hold) for hold in ((), "x"))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12), held, found)
    length = np.hypot(1.5, 0.25)
    np.testing.assert_allclose([held[0]["y"], held[0]["z"]], [1.5 / length, 0.25 / length], atol=1e-12)
    with pytest.raises(ValueError, match="with 'x' held: at the best state reached, constraint 'wall' = 0.3"):
        lj.consistent_state(alone, 0.0, on_it | {"x": 0.3}, moving, None, hold="x")
    with pytest.raises(ValueError, match="with 'x' held: at the best state reached, constraint d/dt 'wall' = -0.75"):
        lj.consistent_state(both, 0.0, on_it, moving | {"x": 0.25}, None, hold="x")
    slope = jax.jacfwd(lambda y: lj.consistent_state(both, 0.0, on_it | {"y": y}, moving, None, hold="x")[0]["z"])(1.5)
    np.testing.assert_allclose(slope, -1.5 * 0.25 / length**3, atol=1e-9)


@pytest.mark.slow
def test_a_position_alone_and_a_velocity_alone():
    """A crank's position held while a motor sets its speed: b = (3, 0), a' = (0, 5); twin: the speed held too."""

    def joints(t, q, params):
        a, b = q["a"], q["b"]
        rod, motor = (a - b) @ (a - b) - 4.0, a[1] * jnp.cos(5 * t) - a[0] * jnp.sin(5 * t)
        return jnp.stack([a @ a - 1.0, rod, b[1], motor])

    driven = lj.System(lambda t, q, v, p: 0.5 * (v["a"] @ v["a"] + v["b"] @ v["b"]), {"joints": lj.Holonomic(joints)})
    guess = {"a": jnp.array([1.0, 0.0]), "b": jnp.array([2.7, 0.3])}
    still = {"a": jnp.zeros(2), "b": jnp.zeros(2)}
    q, v = lj.consistent_state(driven, 0.0, guess, still, None, hold_position="a", hold_velocity="b")
    np.testing.assert_array_equal(q["a"], [1.0, 0.0])
    np.testing.assert_array_equal(v["b"], [0.0, 0.0])
    np.testing.assert_allclose(q["b"], [3.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(v["a"], [0.0, 5.0], atol=1e-12)
    with pytest.raises(ValueError, match=r"(?s)Fix: hold the position alone, hold_position=\['a\[0\]', 'a\[1\]'\]"):
        lj.consistent_state(driven, 0.0, guess, still, None, hold="a")
    with pytest.raises(ValueError, match=r"with the velocity of 'a\[0\]' and 'a\[1\]' held"):
        lj.consistent_state(driven, 0.0, guess, still, None, hold_velocity="a")
    with pytest.raises(ValueError, match="hold_velocity names 'c'"):
        lj.consistent_state(driven, 0.0, guess, still, None, hold_velocity="c")


def test_names_to_hold():
    """A coordinate is held by its own name, and by that of each part of q it lies in."""
    q = {"crank": lj.bodies.Pose.at(), "x": jnp.zeros(2)}
    for name, held in (
        ("crank", range(7)),
        ("crank.quaternion", range(3, 7)),
        ("crank.position[1]", [1]),
        ("x", (7, 8)),
    ):
        np.testing.assert_array_equal(np.flatnonzero(~free_coordinates(q, name)), held)
    with pytest.raises(ValueError, match="hold names 'cran', which is no coordinate; there are 'crank.position"):
        free_coordinates(q, "cran")


def plane_particle(t, q, v, params):
    """A particle in a uniform field."""
    return 0.5 * params["m"] * jnp.dot(v, v) - params["m"] * params["g"] * q[1]


def circle(t, q, params):
    """|q|² = l²."""
    return jnp.dot(q, q) - params["l"] ** 2


def test_pendulum_tension():
    """The rod's multiplier gives the tension m (v²/l + g cos); λ > 0 pushes along +∂g/∂q."""
    params = {"m": 1.5, "g": 9.8125, "l": 2.0}
    angle, rate = 0.75, 1.25
    q = 2.0 * np.array([np.sin(angle), -np.cos(angle)])
    v = 2.0 * rate * np.array([np.cos(angle), np.sin(angle)])
    system = System(plane_particle, {"rod": Holonomic(circle)})
    a, multipliers = lj.accelerations(system, 0.0, q, v, params)
    tension = params["m"] * (2.0 * rate**2 + params["g"] * np.cos(angle))
    np.testing.assert_allclose(multipliers["rod"], -tension / (2 * 2.0), rtol=1e-13)
    np.testing.assert_allclose(constraint_force(system, 0.0, q, v, params)["rod"], -tension * q / 2.0, rtol=1e-13)
    tangential = np.asarray(a) @ np.array([np.cos(angle), np.sin(angle)])
    np.testing.assert_allclose(tangential, -params["g"] * np.sin(angle), rtol=1e-13)


def test_moving_constraint():
    """A support in motion (explicit time in g) enters gamma: ∂²g/∂t² and 2 ∂²g/∂t∂q v both count."""
    lift = lambda t: jnp.sin(2 * t)
    tilt = lambda t: 0.5 * t
    floor = Holonomic(lambda t, q, params: q[1] - lift(t) - tilt(t) * q[0])
    t, params = 0.375, {"m": 1.5, "g": 9.8125}
    q = np.array([0.25, float(lift(t) + tilt(t) * 0.25)])
    v = np.array([0.75, float(2 * np.cos(2 * t) + 0.5 * 0.25 + tilt(t) * 0.75)])
    a, multipliers = accelerations(System(plane_particle, {"floor": floor}), t, q, v, params)
    slope = float(tilt(t))
    demanded = -4 * np.sin(2 * t) + 2 * 0.5 * 0.75  # of a_y - slope a_x
    force = (demanded + params["g"]) * params["m"] / (1 + slope**2)
    np.testing.assert_allclose(multipliers["floor"], force, rtol=1e-13)
    np.testing.assert_allclose(a, [-slope * force / 1.5, force / 1.5 - 9.8125], rtol=1e-13)


def test_nonlinear_velocity_constraint():
    """|v|² kept constant: Chetaev's rule gives a = F/m - v (v·F)/(m v²)."""
    cruise = Nonholonomic(lambda t, q, v, params: jnp.dot(v, v) - 4.0)
    v = 2.0 * np.array([0.6, 0.8])
    a, multipliers = accelerations(
        System(plane_particle, {"cruise": cruise}), 0.0, np.zeros(2), v, {"m": 1.5, "g": 9.8125}
    )
    gravity = np.array([0.0, -9.8125])
    np.testing.assert_allclose(a, gravity - v * (v @ gravity) / 4.0, rtol=1e-13)
    np.testing.assert_allclose(multipliers["cruise"], -1.5 * (v @ gravity) / (2 * 4.0), rtol=1e-13)


def test_velocity_constraint_with_time_and_position():
    """∂phi/∂t and (∂phi/∂q) v of a velocity constraint count: v_y = x t."""
    driven = Nonholonomic(lambda t, q, v, params: v[1] - q[0] * t)
    a, _ = accelerations(
        System(plane_particle, {"driven": driven}),
        2.0,
        np.array([0.5, 0.0]),
        np.array([3.0, 1.0]),
        {"m": 1.0, "g": 1.0},
    )
    np.testing.assert_allclose(a, [0.0, 0.5 + 3.0 * 2.0], rtol=1e-13)


def test_indefinite_mass_matrix():
    """L = ½ (v_x² - v_y²) with x = y + z tied: definite on what is free, so it is solved."""
    system = System(
        lambda t, q, v, params: 0.5 * (v[0] ** 2 - v[1] ** 2) + q[0],
        {"tie": Holonomic(lambda t, q, params: q[0] - 2 * q[1])},
    )
    a, multipliers = lj.accelerations(system, 0.0, np.zeros(2), np.zeros(2), None)
    # x = 2 y: L = ½ (4 - 1) v_y² + 2 y.
    np.testing.assert_allclose(a, [4 / 3, 2 / 3], rtol=1e-14)
    np.testing.assert_allclose(multipliers["tie"], 1 / 3, rtol=1e-14)


def test_residuals_by_level():
    """`level` chooses g or dg/dt."""
    system = System(plane_particle, {"rod": Holonomic(circle)})
    state = (0.0, np.array([3.0, 4.0]), np.array([1.0, 2.0]), {"m": 1.0, "g": 1.0, "l": 4.0})
    assert float(constraint_residual(system, *state)["rod"]) == 9.0
    assert float(constraint_residual(system, *state, level="velocity")["rod"]) == 22.0
