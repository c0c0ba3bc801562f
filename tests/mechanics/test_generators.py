"""Generators of motions: axes and centres, gauge terms, and those of the wrong structure."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.symmetric_systems import IN_SPACE, KEPLER, OF_KEPLER, OF_STONE, STONE


def test_a_vector_as_axis_and_a_center():
    """n·L about a point c is n·((q - c) x p); translations along n give n·p. Twin: another centre."""
    q, v = IN_SPACE
    axis, center, p = np.array([1.0, 2.0, 2.0]), (0.5, -1.0, 0.25), OF_KEPLER["m"] * v
    charge = lj.noether_charge(KEPLER, lj.Generator.rotation(axis, about=center))(0.0, q, v, OF_KEPLER)
    np.testing.assert_allclose(charge, axis @ np.cross(q - np.array(center), p), rtol=1e-14)
    assert abs(charge - axis @ np.cross(q, p)) > 0.1
    along = lj.noether_charge(KEPLER, lj.Generator.translation(axis))(0.0, q, v, OF_KEPLER)
    np.testing.assert_allclose(along, axis @ p, rtol=1e-14)


def test_a_boost_needs_its_gauge_term():
    """t p - m x is conserved along a free direction; twins: without the gauge term, another mass."""
    start = {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}
    boost = lambda axis, m: lj.Generator.boost(axis, lambda t, q, params: m * q[axis])
    assert lj.is_symmetry(STONE, boost("x", OF_STONE["m"]), *start, OF_STONE)
    bare = lj.Generator(boost("x", 1.0).delta, name="bare")
    for wrong in (bare, boost("x", 1.0)):
        found = lj.is_symmetry(STONE, wrong, *start, OF_STONE)
        assert not found and found.residual > 1e-3, found
    # In free fall L changes by -m g = dF/dt with F = -m g t.
    fall = lj.Generator.shift("y") + lj.Generator(gauge=lambda t, q, p: -p["m"] * p["g"] * t)
    assert lj.is_symmetry(STONE, fall, *start, OF_STONE)


def test_a_generator_of_the_wrong_structure_is_named():
    """Each message names the coordinate or the wrong value."""
    state = 0.0, {"x": 0.5, "y": 1.0}, {"x": 2.0, "y": 0.5}, OF_STONE
    cases = [
        (lambda t, q, params: {"x": 1.0}, ValueError, "it lacks 'y'"),
        (lambda t, q, params: {"x": 1.0, "z": 0.0}, ValueError, "q has no 'z'"),
        (lambda t, q, params: 1.0, ValueError, "where q has 'x' and 'y'"),
        (lambda t, q, params: {"x": jnp.ones(3), "y": 0.0}, ValueError, r"moves 'x', of shape \(\)"),
        (lambda t, q: q, TypeError, "is called with 3 arguments"),
        (lambda t, q, params: {"x": q["r"], "y": 0.0}, ValueError, "asks for 'r'"),
        (lj.Generator.shift("phi"), ValueError, "names 'phi', which is no coordinate; there are 'x' and 'y'"),
        (lj.Generator(time=lambda t, q, params: jnp.ones(2)), ValueError, "must return one number"),
    ]
    for generator, kind, words in cases:
        with pytest.raises(kind, match=words):
            lj.noether_charge(STONE, generator)(*state)
        with pytest.raises(kind, match=words):
            lj.is_symmetry(STONE, generator, *state[1:])
    with pytest.raises(TypeError, match="a generator must be a function .* or a lj.Generator"):
        lj.noether_charge(STONE, 1.0)
    with pytest.raises(ValueError, match="no points to move in space among the coordinates"):
        lj.noether_charge(lj.System(lambda t, q, v, p: v**2), lj.Generator.rotation("z"))(0.0, 0.5, 0.5, None)
    with pytest.raises(TypeError, match="must move something"):
        lj.Generator()
    with pytest.raises(ValueError, match="an axis must be 'x', 'y', 'z' or a vector"):
        lj.Generator.rotation("w")
