"""Errors inside the user's functions keep their cause; what is not recognised is raised unchanged."""

import traceback

import jax
import pytest

import lagjax as lj
from tests.behaviour.test_first_minutes import by_numpy, move, needs_mass


def test_the_users_error_is_kept():
    """The message is raised from the original error, whose traceback ends at the user's line."""
    for lagrangian, kind in ((by_numpy, jax.errors.TracerArrayConversionError), (needs_mass, KeyError)):
        with pytest.raises((TypeError, ValueError)) as caught:
            move(lagrangian)
        cause = caught.value.__cause__
        assert isinstance(cause, kind)
        frames = [frame.name for frame in traceback.extract_tb(cause.__traceback__)]
        assert lagrangian.__name__ in frames
    # Twin: an error without a message of ours has no cause.
    with pytest.raises(NameError) as caught:
        move(lambda t, q, v, params: 0.5 * mass * v["theta"] ** 2)  # noqa: F821  # pyright: ignore[reportUndefinedVariable]
    assert caught.value.__cause__ is None


def test_other_names_are_no_other_order():
    """Twin: argument names are free; a usual name in another position is no error."""
    for lagrangian in (
        lambda s, x, u, p: 0.5 * u["theta"] ** 2,
        lambda t, v, w, p: 0.5 * w["theta"] ** 2,
        lambda *state: 0.5 * state[2]["theta"] ** 2,
    ):
        assert float(lj.momentum(lj.System(lagrangian), 0, {"theta": 0}, {"theta": 2}, None)["theta"]) == 2.0


def test_an_unknown_error_is_the_users_own():
    """Unrecognised errors are raised unchanged."""

    def fails(t, q, v, params):
        raise RuntimeError("my own")

    with pytest.raises(RuntimeError, match="my own"):
        move(fails)
    with pytest.raises(TypeError, match="unsupported operand"):
        move(lambda t, q, v, params: 0.5 * v["theta"] ** 2 + set())
