"""Measurements that the motion does not have, and a guess that cannot move, are refused."""

import pytest

import lagjax as lj
from tests.fit.cases import HUNG, PENDULUM, hung, pendulum
from tests.fit.problem.test_arguments import RECORD, Q, T


def test_wrong_names_of_coordinates_and_constraints():
    """Measurements of names that the motion does not have are refused."""
    start = dict(q0={"x": 2.0, "y": 0.0}, v0={"x": 0.0, "y": 0.0})
    for measured in ({"q": {"z": Q}}, {"multipliers": {"rope": Q}}):
        with pytest.raises(ValueError, match="but the motion has no such name"):
            lj.fit(hung, lj.Record(T, **measured, **start), HUNG)


@pytest.mark.slow
def test_a_guess_that_cannot_move():
    """A guess from which the motion fails at once gives an error with the message of `integrate`."""
    with pytest.raises(ValueError, match="(?s)from the guess the motion of record 0 fails.*mass matrix"):
        lj.fit(pendulum, RECORD, PENDULUM | {"l": 0.0}, free="g")
