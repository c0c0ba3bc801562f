"""Tolerances, numbers of steps and times that cannot be meant are refused in words.

A warning of input that is hardly ever meant: a force in place of R.
"""

import importlib

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import arguments
from lagjax.integrate.arguments import _in_order, warn_of_odd_dissipation
from lagjax.system import coordinates
from tests.behaviour.test_bad_input import refusal
from tests.systems import HORIZONTAL, PARAMS, TS, motion, pendulum, rod_pendulum

given = lambda **options: lj.integrate(pendulum, 1.0, 0.0, PARAMS, **{"ts": TS} | options)


def test_what_can_be_meant():
    """The largest countable number of steps, and the tightest tolerances; twin: their neighbours are refused, below."""
    arguments.check_max_steps(2**31 - 1)
    for dtype, rtol in ((np.float64, 2e-15), (np.float32, 1e-6), (np.float32, None), (np.float64, (1e-9, 1e-6))):
        assert arguments.tolerance(rtol, "rtol", np.dtype(dtype)).dtype == dtype
    np.testing.assert_array_equal(arguments.tolerance((1e-9, 1e-6), "rtol", np.dtype(float)), [1e-9, 1e-6])
    np.testing.assert_array_equal(arguments.tolerance(None, "rtol", np.dtype(float)), [1e-9, 1e-9])


@pytest.mark.parametrize(
    ("ts", "words"),
    [
        ([0.0, 1.0, 0.5], r"ts\[2\] = 0.5 follows ts\[1\] = 1"),
        ([2.0, 0.0, 1.0], r"must decrease throughout.*ts\[2\] = 1 follows ts\[1\] = 0"),
        ([0.0, 1.0, 1.0], "must increase"),
        ([0.0], "at least two times"),
        (3.0, "at least two times"),
        (None, "two times, and is None"),
        ("0..1", "two times, and is '0..1'"),
        (["0", "1"], r"two times, and is \['0', '1'\]"),
        ([0j, 1j], "two times, and is"),
        (np.ones((2, 2)), r"has shape \(2, 2\)"),
        ([1e16, 1e16 + 2], "no room for steps"),
        ([1e16 + 400, 1e16], "no room for steps"),
    ],
)
def test_times(ts, words):
    """`ts` that is not monotonic, or is not a vector, or cannot be told apart."""
    with refusal(ValueError, words):
        given(ts=ts)


PID = {"stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-6)}
BACKSOLVE = diffrax.BacksolveAdjoint()
OPTIONS = [
    (ValueError, {"rtol": np.inf}, "rtol is infinite"),
    (ValueError, {"atol": np.inf}, "atol is infinite"),
    (ValueError, {"rtol": (1e-9, np.inf)}, "rtol is infinite"),
    (ValueError, {"rtol": 1e-17}, "rtol = 1e-17", "float64"),
    (ValueError, {"max_steps": 2**70}, "from 1 to 2,147,483,647", "None for no limit"),
    (ValueError, {"max_steps": 2**31}, "from 1 to 2,147,483,647"),
    (ValueError, {"max_steps": 1e6}, "max_steps", r"not 1000000.0.*10\*\*6"),
    (ValueError, {"dt0": "small"}, "dt0", "one positive number, not 'small'"),
    (ValueError, {"rtol": "1e-9"}, "rtol", "not '1e-9'"),
    (ValueError, {"atol": 1j}, "atol", "one number, or two"),
    (TypeError, {"adjoint": "backsolve"}, "adjoint", "an adjoint of diffrax, not 'backsolve'"),
    (TypeError, {"stepsize_controller": diffrax.PIDController}, "stepsize_controller", "the class PIDController"),
    (ValueError, {"dt0": -0.1}, "dt0 must be one positive number, not -0.1", "where ts decreases"),
    (ValueError, {"max_step": -0.1}, "max_step must be one positive number, not -0.1", "where ts decreases"),
    (ValueError, {"jump_ts": np.ones((2, 2))}, "jump_ts", "vector of times"),
    (ValueError, {"jump_ts": [0.5, np.nan]}, "jump_ts", "NaN or infinity"),
    (ValueError, {"jump_ts": ["a"]}, "jump_ts", "vector"),
    (ValueError, {"jumps": [0.5]}, "jumps must be 'found' or 'ignored'", "jump_ts="),
    (ValueError, PID | {"max_step": 0.1}, "max_step", "dtmax"),
    (ValueError, PID | {"jump_ts": [0.5]}, "jump_ts", "ClipStepSizeController"),
    (ValueError, {"adjoint": BACKSOLVE, "jump_ts": [0.5]}, "jump_ts", "BacksolveAdjoint"),
    (TypeError, {"method": diffrax.Tsit5}, "the class Tsit5", r"diffrax.Tsit5\(\)"),
    (TypeError, {"method": diffrax.SemiImplicitEuler()}, "SemiImplicitEuler", "of a special form"),
    (ValueError, {"drift": "projct"}, "drift must be .* not 'projct'"),
]


@pytest.mark.parametrize(("kind", "options", "words"), [(kind, of, words) for kind, of, *words in OPTIONS], ids=str)
def test_options(kind, options, words):
    """What is of another kind, out of reach or has no meaning beside another is named, before anything runs."""
    with refusal(kind, *words):
        given(**options)


def test_float32_out_of_reach():
    """A tolerance below float32's round-off is refused, with the switch to float64 as the fix."""
    with refusal(ValueError, "rtol = 1e-09", "float32", "jax_enable_x64"):
        lj.integrate(pendulum, np.float32(1.0), np.float32(0.0), PARAMS, ts=TS, rtol=1e-9)


def test_adjoint_that_leaves_the_constraints():
    """BacksolveAdjoint is refused for a constrained system, where it would be silently wrong."""
    with refusal(ValueError, "BacksolveAdjoint"):
        lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS, adjoint=BACKSOLVE)


ODD = {
    "a force": lambda t, q, v, p: -p["c"] * v,
    "its opposite": lambda t, q, v, p: p["c"] * v * jnp.cos(q),
    "of the square": lambda t, q, v, p: -p["c"] * v * jnp.abs(v),
    "of a constant size": lambda t, q, v, p: -p["c"] * jnp.sign(v),
}
RIGHT = {
    "linear friction": lambda t, q, v, p: 0.5 * p["c"] * v**2,
    "in a wind": lambda t, q, v, p: 0.5 * p["c"] * (v - 3.0) ** 2,
    "on a belt": lambda t, q, v, p: p["c"] * jnp.sqrt(1e-6 + (v - jnp.sin(t) - 0.1) ** 2),
    "easier one way": lambda t, q, v, p: jnp.where(v > 0, 0.5, 0.1) * v**2,
    "in the other direction none": lambda t, q, v, p: jnp.maximum(v, 0.0) ** 2,
    "of air": lambda t, q, v, p: p["c"] * jnp.abs(v) ** 3,
    "that feeds": lambda t, q, v, p: 0.5 * (q**2 - 1.0) * v**2,
    "none here": lambda t, q, v, p: 0.0 * v,
}
STARTS = [(0.3, 0.0), (0.3, 1.7), (0.0, -2.0), (2.0, 1e-3)]


@pytest.mark.parametrize("which", ODD)
def test_a_force_in_place_of_a_dissipation(which):
    """The warning is given at rest too, with both remedies."""
    for q, v in STARTS:
        with pytest.warns(UserWarning, match=r"changes its sign with v(.|\n)*force=f(.|\n)*R = 0.5 c v²"):
            warn_of_odd_dissipation(ODD[which], coordinates.state(0.5, q, v, {"c": 0.3}))


@pytest.mark.parametrize("which", RIGHT)
def test_what_dissipates_is_left_alone(which):
    """Twin: no warning, which would be an error here."""
    for q, v in STARTS:
        # What was found right is not looked at again.
        _in_order.discard(RIGHT[which])
        warn_of_odd_dissipation(RIGHT[which], coordinates.state(0.5, q, v, {"c": 0.3}))
        assert RIGHT[which] in _in_order


def test_integrate_tells_and_goes_on(monkeypatch):
    """`integrate` warns by the function's name, and goes on; twin: traced values are ignored."""

    def drag(t, q, v, params):
        return -0.5 * v

    done, solved = motion("pendulum"), lambda problem: done
    monkeypatch.setattr(importlib.import_module("lagjax.integrate.integrate"), "run", solved)
    dragged = lj.System(pendulum.lagrangian, dissipation=drag)
    run = lambda q0: lj.integrate(dragged, q0, 1.0, PARAMS, ts=TS, throw=False)
    with pytest.warns(UserWarning, match="Fix: force=drag"):
        assert run(0.5) is done
    jax.eval_shape(lambda q0: run(q0).q, 0.5)
