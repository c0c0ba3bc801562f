"""Results and their messages: each has a number and words of its own.

The error of a motion, judged and in words: its cause, and sizes that are not known.
"""

import re
from functools import partial
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.results import (
    RESULTS,
    ended_well,
    in_units_of,
    in_words,
    is_among,
    item,
    message,
    scaled_error,
    warning_of,
)
from tests.by_hand import HOW, by_hand
from tests.by_numpy import by_numpy

NAMES = sorted(RESULTS._name_to_item)


@pytest.mark.parametrize("name", NAMES)
def test_each_result_has_words(name):
    """A result is found by its number, and its message is that of no other one."""
    result = getattr(RESULTS, name)
    code = int(result._value)
    assert bool(item(RESULTS.successful, code) == result) and in_words(np.int32(code)) == message(result) != ""
    others = [message(getattr(RESULTS, other)) for other in NAMES if other != name]
    assert message(result) not in others


def test_diffrax_results_keep_their_numbers():
    """A result of diffrax's loop means the same; ours come after them."""
    of_diffrax = {name: int(x._value) for name, x in diffrax.RESULTS._name_to_item.items()}
    assert of_diffrax.items() <= {name: int(getattr(RESULTS, name)._value) for name in NAMES}.items()
    assert int(RESULTS.raised._value) > max(of_diffrax.values())


def test_what_ended_well():
    """A motion to its end or to its event; nothing else, and lane by lane."""
    good = [name for name in NAMES if bool(ended_well(getattr(RESULTS, name)))]
    assert good == ["event_occurred", "successful"]
    codes = jnp.array([int(getattr(RESULTS, name)._value) for name in NAMES])
    lanes = jax.vmap(lambda code: ended_well(item(RESULTS.successful, code)))(codes)
    assert [name for name, well in zip(NAMES, lanes) if well] == good
    assert is_among(RESULTS.raised, [RESULTS.misfit, RESULTS.raised]) and not is_among(RESULTS.raised, [])


def test_used_up_steps_have_a_next_thing_to_do():
    """A program that used up its steps cannot say why; its message says where one learns it, without a guess."""
    words = message(RESULTS.max_steps_reached)
    assert "outside of jit, vmap and grad" in words and "Try increasing" not in words


free = lj.System(lambda t, q, v, p: 0.5 * v**2)
T = np.linspace(0.0, 30.0, 31)
STEADY, AT_ONCE = 1e-10 * np.exp(T), np.where(T > 14.5, 1e-2, 1e-9)
PEAK, EVEN = np.where(T == 15.0, 100.0, 1.0), 1.0 + 0.0 * T
# Velocities and errors of motions along q = 1; and how they were computed.
CAUSES = {
    "amplifies": (EVEN, STEADY, {}, r"the motion itself amplifies errors, here 1e\+09 times.\nFix: rtol=1e-12"),
    "at a peak": (PEAK, AT_ONCE, {}, "near a singularity: v of q grows to 1e[+]02 times its median"),
    "after a peak": (PEAK, STEADY, {}, "the motion itself amplifies errors, here 3e[+]08 times"),
    "somewhere": (EVEN, AT_ONCE, {}, "between t = 14 and 15 the error grows .* possible causes: the motion amplifies"),
    "steps": (EVEN, 1e-2 * T, {"how": HOW._replace(steps="fixed")}, "fixed steps that are too long: .* by 0.3"),
    "many steps": (EVEN, 1e-3 * T, {"tolerance": (1e-5, 1e-5)}, "the errors of 400 steps add up, at a loose tolerance"),
    "round-off": (EVEN, 1e-4 * T, {"tolerance": (1e-14, 1e-14), "steps": 10**10}, "round-off: rtol = 1e-14 is 45 "),
    "beyond round-off": (EVEN, STEADY, {"tolerance": (1e-14, 1e-14)}, "a tighter one keeps hardly more digits"),
    "a narrow force": (0 * T, AT_ONCE, {"q": 0 * T}, "the motion is zero throughout in this run, and not in a second"),
}  # fmt: skip


@pytest.mark.parametrize("name", CAUSES)
def test_each_cause_is_told_apart(name):
    """The warning has the words of the right cause, and of no other one."""
    v, off, options, words = CAUSES[name]
    options = {"steps": 400, "q": EVEN} | options
    said = warning_of(by_hand(free, T, options.pop("q"), v, off=(off, 0 * off), **options))
    assert re.search(words, said), said
    others = {"near a singularity", "amplifies errors, here", "between t", "fixed steps", "add up", "Cause: round-off"}
    assert sum(other in said for other in others) == (name != "a narrow force")


def test_errors_of_zero_have_no_unit():
    """Where a size is unknown the error is the size, in NumPy and in JAX; twin: an error of zero is none."""
    given = np.array([0.595, 0.595e-6, 0.595e6, 0.0, 2.0]), np.array([0.0, 0, 0, 0, 1])
    for found in (in_units_of(np, *given), by_numpy(partial(in_units_of, jnp))(*given)):
        np.testing.assert_allclose(found, [2000, 2000, 2000, 0, 2])


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_a_number_that_is_zero_throughout(unit):
    """The error of a run that steps over a pulse is its size, in any unit of length; twin: of a run that sees it."""
    traj = SimpleNamespace(stats={"num_accepted_steps": 50}, scaled_error=np.inf, any_system=free)
    traj.model = by_hand(free, T, EVEN, EVEN).model
    judge = lambda off, size: scaled_error(
        np, unit * np.array([[off], [off]]), unit * np.array([[size], [size]]), traj, np.array([0.0, 10.0]),
        (np.full(2, 1e-9), np.zeros(2)),
    )  # fmt: skip
    np.testing.assert_allclose(judge(0.595, 0.0), 2000.0)
    assert judge(0.595e-9, 0.595) < 1e-2
