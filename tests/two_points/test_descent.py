"""Ways down from saddles: the metric of displacements, the size of steps, and the slope of the discrete action."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system import State, model_of
from lagjax.two_points import starts
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import FIXED, Ends
from lagjax.two_points.starts import DEGREE, Sizes, sizes_of


def test_kinetic_energy_of_a_wave():
    """∫ m q̇² of A sin(π t / T) is m A² π² / 2 T, on uneven elements, for two coordinates with a coupled mass matrix."""
    times, mass = np.array([0.0, 0.4, 1.5, 2.0]), np.array([[2.0, 0.3], [0.3, 1.0]])
    amplitude = np.array([0.7, -1.1])
    t = (times[:-1, None] + np.diff(times)[:, None] * rule_of_degree(DEGREE).nodes[1:]).ravel()[:-1]
    wave = (np.sin(np.pi * t / 2.0)[:, None] * amplitude).ravel()
    exact = amplitude @ mass @ amplitude * np.pi**2 / 4.0
    assert abs(wave @ starts._kinetic(times, DEGREE, mass) @ wave / exact - 1) < 1e-9


def test_steps_within_a_radius():
    """The shift makes a step as long as the radius, and is zero where it is shorter."""
    slope, values = np.array([3.0, -1.0, 0.5]), np.array([1.0, 0.1, 2.0])
    shift = starts._shift(slope, values, 0.5)
    assert abs(np.linalg.norm(slope / (values + shift)) - 0.5) < 1e-9
    assert starts._shift(slope, values, 100.0) == 0.0


def ends_of(a, b, time):
    """Two fixed ends."""
    return Ends(*map(jnp.asarray, (0.0, a, b, time)), None, FIXED, False, 0)


def model(lagrangian, constraints, q):
    """The model of a system at a place."""
    system = lj.System(lagrangian, constraints)
    return model_of(system, *State(jnp.zeros(()), jnp.asarray(q), jnp.zeros(len(q)), None))


@pytest.mark.slow
def test_slope_and_descent_on_a_constraint():
    """On the sphere, off a great circle, the reduced slope is the difference of actions along an allowed step; and what
    the descent ends at has the action of the great circle, ½ θ². Twin: the start has more."""
    sphere = model(lambda t, q, v, p: 0.5 * v @ v, {"r": lj.Holonomic(lambda t, q, p: q @ q - 1.0)}, [1.0, 0.0, 0.0])
    ends = ends_of([1.0, 0.0, 0.0], [np.cos(2.0), np.sin(2.0), 0.0], 1.0)
    parts = np.linspace(0.0, 1.0, 3)
    at = (parts[:-1, None] + 0.5 * rule_of_degree(DEGREE).nodes[1:]).ravel()
    height = 0.5 * np.sin(np.pi * at)
    x = np.stack([np.cos(2 * at), np.sin(2 * at), height], axis=1)
    x = (x / np.linalg.norm(x, axis=1, keepdims=True)).reshape(2, DEGREE, 3)
    ground = starts._Ground(sphere, ends, parts, Sizes(np.ones(3), np.eye(3)))
    place = ground.at(x, None)
    assert place is not None and place.allowed is not None
    step = 1e-4 * np.random.default_rng(0).normal(size=place.slope.size)
    there, back = (ground.at(starts._moved(place, sign * step), place.multipliers) for sign in (1, -1))
    assert there is not None and back is not None
    assert abs((there.action - back.action) / 2 / (place.slope @ step) - 1) < 1e-5
    second = there.action + back.action - 2 * place.action
    assert abs(second / (step @ place.curvature @ step) - 1) < 1e-3
    lower = ground.at(ground.descended(place), place.multipliers)
    assert lower is not None and abs(lower.action - 2.0) < 1e-4 and place.action > 2.1


@pytest.mark.slow
def test_sizes_of_coordinates():
    """Kilometres beside radians: each has the length of the line in its own units by its mass; an angle on whose turns
    L depends has π. Twin: a coordinate that L does not know, and one whose L grows, has none of the latter."""

    def lagrangian(t, q, v, p):
        return 0.5 * v[0] ** 2 + 0.5 * 6400.0**2 * v[1] ** 2 + 0.5 * v[2] ** 2 + 1e-3 * jnp.cos(q[2]) - 1e-9 * q[0] ** 2

    found = sizes_of(model(lagrangian, {}, np.zeros(3)), ends_of([0.0, 0.0, 0.0], [10.0, 1.0, 0.1], 1.0))
    length = np.sqrt(10.0**2 + 6400.0**2 + 0.1**2)
    np.testing.assert_allclose(found.sizes, [length, length / 6400.0, np.pi], rtol=1e-12)
    np.testing.assert_allclose(np.diag(found.mass), [1.0, 6400.0**2, 1.0], rtol=1e-12)
