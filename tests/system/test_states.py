"""First-order states as they are given: what is refused, in the user's words."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system.checks import with_rates

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


def at(system, q=START[0], v=START[1]):
    """Accelerations at the start."""
    return lj.accelerations(system, 0.0, q, v, None)[0]


def moved(q, v):
    """A motion from a start."""
    return lj.integrate(with_state(square), q, v, ts=[0.0, 1.0])


held = {"held": lj.Holonomic(lambda t, q, p: q["x"] - q["z"])}
BY_NAME = "(?s)states must be functions by name.*its start value is q0"
ELSEWHERE = "not done for systems with states, as 'z' here"
REFUSED = [
    # What is given as states.
    *((lambda x=x: lj.System(oscillator, states=x), TypeError, BY_NAME) for x in (square, {"z": 0.0}, {1: square})),
    # Wrong rates, and functions that read what they must not.
    (lambda: at(with_state(lambda t, q, v, p: jnp.ones(1))), ValueError,
     r"(?s)of shape \(\), and returned shape \(1,\).*\nFix: "),
    (lambda: at(with_state(lambda t, q, v, p: None)), ValueError, r"(?s)returned None.*\nFix: "),
    (lambda: at(with_state(lambda t, q, v, p: 1.0 - v["z"])), ValueError,
     r"(?s)rate of state 'z' contains v\['z'\].*\nFix: "),
    (lambda: at(with_state(square, force=lambda t, q, v, p: q)), ValueError, r"(?s)force acts on state 'z'.*\nFix: "),
    (lambda: at(with_state(square, constraints=held)), ValueError,
     r"(?s)constraint 'held' contains state 'z'.*\nFix: "),
    (lambda: at(with_state(square, dissipation=lambda t, q, v, p: v["z"] ** 2)), ValueError,
     r"(?s)dissipation contains the velocity.*\nFix: "),
    (lambda: at(with_state(lambda t, q, v, z, p: z)), TypeError,
     r"(?s)the state as an argument of its own: it is q\['z'\]"),
    (lambda: at(lj.System(oscillator, states={"x": lambda t, q, v, p: 1.0}), {"x": 1.0}, {"x": 0.0}), ValueError,
     "(?s)L contains the velocity of 'x', which is a state.*coordinate by the same"),
    # Its start value is an entry of q0.
    (lambda: moved(1.0, 0.0), ValueError, "it is a number"),
    (lambda: moved({"x": 1.0}, {"x": 0.0}), ValueError, "has no start value; q has 'x'"),
    (lambda: moved({"x": 1.0, "z": [0.0]}, {"x": 0.0}), ValueError, "no number or arr"),
    # What is for coordinates alone.
    (lambda: lj.linearise(with_state(square), 0.0, *START, None), ValueError, ELSEWHERE),
    (lambda: lj.equilibria(with_state(square), None, starts=[START[0]]), ValueError, ELSEWHERE),
    (lambda: lj.hamiltonian(with_state(square)), ValueError, ELSEWHERE),
]  # fmt: skip


@pytest.mark.parametrize(("call", "error", "words"), REFUSED)
def test_what_is_refused(call, error, words):
    """Each in the user's words. Twin: the right rate is taken."""
    with pytest.raises(error, match=words):
        call()
    assert at(with_state(square))["z"] == 0.0


def test_start_velocities():
    """v0 may leave out states, and nothing else; the dtype of the start stays."""
    system = with_state(square)
    v = with_rates(system, {"x": np.float32(1.0), "z": np.zeros(2, np.float32)}, {"x": np.float32(0.0)})
    assert v["z"].dtype == np.float32 and v["z"].shape == (2,)
    assert with_rates(system, {"x": 1.0}, {}) == {}


def test_equal_and_printed():
    """Systems with the same states are equal. Twin: other rates are not."""
    assert with_state(square) == with_state(square) != with_state(oscillator)
    assert hash(with_state(square)) == hash(with_state(square))
    assert repr(with_state(square)) == "System(oscillator; states: z)"
