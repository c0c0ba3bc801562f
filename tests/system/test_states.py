"""First-order states as they are given: what is refused, in the user's words."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system.states import with_rates

START = {"x": 1.0, "z": 0.0}, {"x": 0.0}


def oscillator(t, q, v, params):
    """A mass on a spring."""
    return 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2


def square(t, q, v, params):
    """A rate."""
    return v["x"] ** 2


def with_state(rate, **others):
    """The oscillator with a state z."""
    return lj.System(oscillator, states={"z": rate}, **others)


@pytest.mark.parametrize("given", [square, {"z": 0.0}, {1: square}], ids=["no names", "a number", "no text"])
def test_functions_by_name(given):
    """States are functions by name."""
    with pytest.raises(TypeError, match="(?s)states must be functions by name.*its start value is q0"):
        lj.System(oscillator, states=given)


WRONG = {
    "shape": (lambda t, q, v, p: jnp.ones(1), {}, r"of shape \(\), and returned shape \(1,\)"),
    "nothing": (lambda t, q, v, p: None, {}, "returned a NoneType"),
    "its own rate": (lambda t, q, v, p: 1.0 - v["z"], {}, r"rate of state 'z' contains v\['z'\]"),
    "a force on it": (square, {"force": lambda t, q, v, p: q}, "force acts on state 'z'"),
    "in a constraint": (
        square,
        {"constraints": {"held": lj.Holonomic(lambda t, q, p: q["x"] - q["z"])}},
        "constraint 'held' contains state 'z'",
    ),
    "in the dissipation": (
        square,
        {"dissipation": lambda t, q, v, p: v["z"] ** 2},
        "dissipation contains the velocity",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_is_refused(name):
    """Wrong rates, and functions that read what they must not. Twin: the right one is taken."""
    rate, others, words = WRONG[name]
    with pytest.raises(ValueError, match=words + r"(?s:.*)\nFix: "):
        lj.accelerations(with_state(rate, **others), 0.0, *START, None)
    assert lj.accelerations(with_state(square), 0.0, *START, None)[0]["z"] == 0.0


def test_the_state_as_an_argument():
    """The form of other libraries, f(t, q, v, z, params)."""
    with pytest.raises(TypeError, match=r"(?s)the state as an argument of its own: it is q\['z'\]"):
        lj.accelerations(with_state(lambda t, q, v, z, p: z), 0.0, *START, None)


def test_a_coordinate_by_the_same_name():
    """A state that L gives inertia."""
    twice = lj.System(oscillator, states={"x": lambda t, q, v, p: 1.0})
    with pytest.raises(
        ValueError, match="(?s)L contains the velocity of 'x', which is a state.*coordinate by the same"
    ):
        lj.accelerations(twice, 0.0, {"x": 1.0}, {"x": 0.0}, None)


@pytest.mark.parametrize(
    ("q", "words"),
    [
        (1.0, "it is a number"),
        ({"x": 1.0}, "has no start value; q has 'x'"),
        ({"x": 1.0, "z": [0.0]}, "no number or arr"),
    ],
)
def test_starts(q, words):
    """Its start value is an entry of q0."""
    v = {"x": 0.0} if isinstance(q, dict) else 0.0
    with pytest.raises(ValueError, match=re.escape(words)):
        lj.integrate(with_state(square), q, v, ts=[0.0, 1.0])


def test_start_velocities():
    """v0 may leave out states, and nothing else; the dtype of the start stays."""
    system = with_state(square)
    v = with_rates(system, {"x": np.float32(1.0), "z": np.zeros(2, np.float32)}, {"x": np.float32(0.0)})
    assert v["z"].dtype == np.float32 and v["z"].shape == (2,)
    assert with_rates(system, {"x": 1.0}, {}) == {}


def test_other_rooms():
    """What is for coordinates alone says so."""
    for call in (
        lambda system: lj.linearise(system, 0.0, *START, None),
        lambda system: lj.equilibria(system, None, starts=[START[0]]),
        lambda system: lj.hamiltonian(system),
    ):
        with pytest.raises(ValueError, match="not done for systems with states, as 'z' here"):
            call(with_state(square))


def test_equal_and_printed():
    """Systems with the same states are equal. Twin: other rates are not."""
    assert with_state(square) == with_state(square) != with_state(oscillator)
    assert hash(with_state(square)) == hash(with_state(square))
    assert repr(with_state(square)) == "System(oscillator; states: z)"
