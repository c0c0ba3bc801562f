"""Tolerances, numbers of steps and times that cannot be meant are refused in words."""

import diffrax
import jax
import numpy as np
import pytest

import lagjax as lj
from tests.behaviour.test_bad_input import refusal
from tests.systems import HORIZONTAL, PARAMS, TS, pendulum, rod_pendulum

spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2)


@pytest.mark.parametrize(
    "options, words",
    [
        ({"rtol": np.inf}, "rtol is infinite"),
        ({"atol": np.inf}, "atol is infinite"),
        ({"rtol": (1e-9, np.inf)}, "rtol is infinite"),
        ({"max_steps": 2**70}, "more than can be counted.*2,147,483,647"),
        ({"max_steps": 2**31}, "more than can be counted"),
        ({"ts": [1e16, 1e16 + 2]}, "no room for steps"),
        ({"ts": [1e16 + 400, 1e16]}, "no room for steps"),
    ],
)
def test_refused(options, words):
    """Each is a ValueError that says what is wrong; twin: its neighbour that can be meant passes the same check."""
    with pytest.raises(ValueError, match=f"(?s){words}.*Fix:"):
        lj.integrate(spring, 1.0, 0.0, **({"ts": [0.0, 1.0]} | options))


def test_what_can_be_meant():
    """The largest countable number of steps, and a loose tolerance, are taken."""
    traj = lj.integrate(spring, 1.0, 0.0, ts=[0.0, 1.0], rtol=1e-6, max_steps=2**31 - 1)
    np.testing.assert_allclose(traj.q[-1], np.cos(1.0), rtol=1e-4)


def test_float32_out_of_reach():
    """A tolerance below float32's round-off is refused, with the switch to float64 as the fix."""
    with refusal(ValueError, "rtol = 1e-09", "float32", "jax_enable_x64"):
        lj.integrate(pendulum, np.float32(1.0), np.float32(0.0), PARAMS, ts=TS, rtol=1e-9)


def test_tolerance_out_of_reach_in_float64():
    """A tolerance below float64's round-off is refused, too."""
    with refusal(ValueError, "rtol = 1e-17", "float64"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, rtol=1e-17)


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
    ],
)
def test_times(ts, words):
    """`ts` that is not monotonic, or is not a vector."""
    with refusal(ValueError, words):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=ts)


OPTIONS = {
    "dt0": ("small", ValueError, "one positive number, not 'small'"),
    "rtol": ("1e-9", ValueError, "It is '1e-9'"),
    "atol": (1j, ValueError, "one number, or two"),
    "max_steps": (1e6, ValueError, r"not 1000000.0.*10\*\*6"),
    "adjoint": ("backsolve", TypeError, "an adjoint of diffrax, not str"),
    "stepsize_controller": (diffrax.PIDController, TypeError, "the class PIDController"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_of_another_kind(name):
    """Text for a number, a float for a count, a class for an instance: the option is named before anything runs."""
    given, kind, words = OPTIONS[name]
    with refusal(kind, name, words):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **{name: given})


@pytest.mark.parametrize("name", ("dt0", "max_step"))
def test_lengths_of_steps(name):
    """`dt0` and `max_step` that are not positive are refused; while tracing, in the result."""
    with refusal(ValueError, f"{name} must be one positive number, not -0.1", "where ts decreases"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **{name: -0.1})
    run = jax.jit(lambda x: lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, throw=False, **{name: x}).result)
    assert run(-0.1) == lj.RESULTS.unordered


def test_times_of_jumps():
    """`jump_ts` that is not a vector of finite times."""
    for jump_ts, words in ((np.ones((2, 2)), "vector of times"), ([0.5, np.nan], "NaN or infinity"), (["a"], "vector")):
        with refusal(ValueError, "jump_ts", words):
            lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, jump_ts=jump_ts)


def test_limits_on_steps_that_another_controller_chooses():
    """`max_step` and `jump_ts` together with a controller: the message says what the controller takes instead."""
    given = {"stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-6)}
    with refusal(ValueError, "max_step", "dtmax"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **given, max_step=0.1)
    with refusal(ValueError, "jump_ts", "ClipStepSizeController"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **given, jump_ts=[0.5])
    with refusal(ValueError, "jump_ts", "BacksolveAdjoint"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, adjoint=diffrax.BacksolveAdjoint(), jump_ts=[0.5])


def test_solver_class():
    """The class instead of an instance."""
    with refusal(TypeError, "Tsit5 is the class", r"diffrax.Tsit5\(\)"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, method=diffrax.Tsit5)


def test_solver_for_split_fields():
    """A method that needs a separable field."""
    with refusal(TypeError, "SemiImplicitEuler", "of a special form"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, method=diffrax.SemiImplicitEuler())


def test_adjoint_that_leaves_the_constraints():
    """BacksolveAdjoint is refused for a constrained system, where it would be silently wrong."""
    with refusal(ValueError, "BacksolveAdjoint"):
        lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS, adjoint=diffrax.BacksolveAdjoint())


def test_unknown_drift():
    """A misspelt option is refused."""
    with pytest.raises(ValueError, match="drift"):
        lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS, drift="projct")
