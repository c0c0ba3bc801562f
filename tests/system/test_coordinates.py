"""Pytrees of coordinates: names, order, dtypes."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system import coordinates


class Polar(NamedTuple):
    """Two coordinates by attribute."""

    r: float
    theta: float


@pytest.mark.parametrize(
    ("tree", "names"),
    [
        (0.5, ["q"]),
        (np.zeros(2), ["q[0]", "q[1]"]),
        (np.zeros((2, 2)), ["q[0, 0]", "q[0, 1]", "q[1, 0]", "q[1, 1]"]),
        ({"theta": 0.0, "r": np.zeros(2)}, ["r[0]", "r[1]", "theta"]),
        (Polar(1.0, 2.0), ["r", "theta"]),
        ([0.0, {"a": 1.0}], ["q[0]", "q[1].a"]),
    ],
)
def test_names_follow_the_vector(tree, names):
    """There is one name per entry of the vector, written as the user writes it."""
    assert coordinates.names(tree) == names
    assert coordinates.flatten(tree)[0].shape == (len(names),)


def test_state_keeps_the_dtype():
    """float32 coordinates stay float32, and Python floats in params follow them."""
    s = coordinates.state(0.0, np.float32(1.0), np.float32(0.0), {"g": 9.8, "table": np.arange(3)})
    assert s.q.dtype == s.t.dtype == s.params["g"].dtype == jnp.float32
    assert s.params["table"].dtype == jnp.arange(3).dtype


def test_python_numbers_that_are_not_floats_stay_static():
    """An int or a string in params is left alone: it may choose a shape or a branch."""
    params = coordinates.state(0.0, 1.0, 0.0, {"order": 3, "name": "a"}).params
    assert params == {"order": 3, "name": "a"}


def test_a_float_is_one_in_whatever_it_comes():
    """Each form of a float has the same type for JAX, so none compiles again. Twin: another dtype stays as it is."""
    of = lambda g: jax.typeof(coordinates.state(0.0, 1.0, 0.0, {"g": g}).params["g"])
    assert of(9.81) == of(jnp.array(9.81)) == of(np.float64(9.81)) == of(jnp.asarray(9.81, jnp.float64))
    assert not of(jnp.array(9.81)).weak_type and jnp.array(9.81).weak_type
    assert of(jnp.asarray(9.81, jnp.float32)).dtype == jnp.float32


@pytest.mark.parametrize("half", (jnp.float16, jnp.bfloat16))
def test_half_precision(half):
    """A state in half precision is refused; twin: the parameters may be, and stay so."""
    with pytest.raises(TypeError, match=r"(?s)q and v are b?float16.*Fix: q0 and v0 of np.float32"):
        coordinates.state(0.0, half(1.0), half(0.0), None)
    assert coordinates.state(0.0, np.float32(1.0), np.float32(0.0), {"w": half(1.0)}).params["w"].dtype == half


def test_what_is_no_number():
    """Text and a quantity with its unit raise, with the coordinate and the usual cause."""

    class Quantity:
        magnitude, unit = 2.0, "m"

        def __repr__(self):
            return "2.0 m"

    for x, words in (("2 m", "'2 m'.*text from a file"), (Quantity(), "2.0 m.*with its unit.*\n.*magnitude")):
        with pytest.raises(TypeError, match="(?s)coordinate 'x' of v is " + words):
            coordinates.state(0.0, {"x": 1.0}, {"x": x}, None)


def test_a_time_is_one_number():
    """One number of any kind is a time; twin: a vector of times, a dict, text and a condition raise."""
    for t in (0, 0.0, np.float32(0.0), np.zeros((), int), jnp.zeros(())):
        assert coordinates.state(t, 1.0, 0.0, None).t.dtype == np.float64
    for t in (np.zeros(1), {"x": 0.0}, "0", True, None):
        with pytest.raises(TypeError, match="t must be one number, not (?s:.*)another order"):
            coordinates.state(t, 1.0, 0.0, None)


def test_random_keys_in_params():
    """A typed key is refused with the remedy; the remedy gives the numbers that the key gives."""
    spread = lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2 * (1 + jax.random.normal(p["key"]) ** 2)
    key, system = jax.random.key(1), lj.System(spread)
    with pytest.raises(TypeError, match=r"typed random key[^\n]*\nFix: \"key\": jax.random.key_data"):
        lj.accelerations(system, 0.0, 1.0, 0.0, {"key": key})
    found, _ = lj.accelerations(system, 0.0, 1.0, 0.0, {"key": jax.random.key_data(key)})
    np.testing.assert_allclose(found, -(1 + jax.random.normal(key) ** 2), rtol=1e-12)
