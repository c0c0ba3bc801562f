"""A system in single numbers: the same values, of fewer operations once the parameters are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.jaxtools.scalarize import TooLong
from lagjax.mechanics.scalar_form import Numbers, in_numbers
from lagjax.system.model import model_of


def lagrangian(t, q, v, params):
    """Two points on springs, whose stiffness needs some arithmetic of the parameters alone."""
    stiffness = jnp.exp(jnp.sin(params["k"]))
    return 0.5 * jnp.sum(v["x"] ** 2) + 0.5 * v["y"] ** 2 - 0.5 * stiffness * (jnp.sum(q["x"] ** 2) + q["y"] ** 2 * t)


SYSTEM = lj.System(lagrangian, force=lambda t, q, v, params: {"x": -v["x"], "y": params["k"] * q["y"]})
STATE = (
    jnp.asarray(0.5),
    {"x": jnp.array([1.0, 2.0]), "y": jnp.asarray(3.0)},
    {"x": jnp.array([-1.0, 0.5]), "y": jnp.asarray(0.25)},
)
MODEL = model_of(SYSTEM, *STATE, {"k": jnp.asarray(0.75)})


def energy(model, t, q, v):
    """L and the force of a model, in the structure of its coordinates."""
    return model.system.lagrangian(t, q, v, model.params), model.system.force(t, q, v, model.params)


def test_the_same_in_numbers():
    """L and Q of tuples of numbers are those of the user's structure."""
    flat, expected = in_numbers(MODEL), energy(MODEL, *STATE)
    q, v = (tuple(x) for x in MODEL.vectors(*STATE[1:]))
    value, force = energy(flat, STATE[0], q, v)
    np.testing.assert_allclose(value, expected[0], rtol=1e-15)
    assert flat.names == ["q[0]", "q[1]", "q[2]"] and flat.n == 3
    np.testing.assert_allclose(force, MODEL.vector(expected[1]), rtol=1e-15)


def test_prepared_with_its_parameters():
    """Written out, prepared once and evaluated at states, with their derivatives; twin: prepared for another k."""
    numbers = Numbers(energy, in_numbers(MODEL))
    q, v = (tuple(x) for x in MODEL.vectors(*STATE[1:]))
    other = in_numbers(MODEL.of({"k": jnp.asarray(0.5)}))
    prepared, of_other = numbers.prepare(in_numbers(MODEL)), numbers.prepare(other)
    right = energy(MODEL, *STATE)[0]
    np.testing.assert_allclose(numbers.at(prepared, STATE[0], q, v)[0], right, rtol=1e-15)
    assert abs(numbers.at(of_other, STATE[0], q, v)[0] - right) > 1e-2
    np.testing.assert_allclose(numbers(other, STATE[0], q, v)[0], energy(other, STATE[0], q, v)[0], rtol=1e-15)
    slope = jax.grad(lambda t: numbers.at(prepared, t, q, v)[0])(STATE[0])
    np.testing.assert_allclose(slope, -4.5 * np.exp(np.sin(0.75)), rtol=1e-14)
    assert not numbers.calls_host and 0 < numbers.length < 40


def test_what_is_too_long_is_left():
    """More operations than are allowed are refused."""
    with pytest.raises(TooLong):
        Numbers(energy, in_numbers(MODEL), most=3)
