"""The double pendulum on rods: its stored end against the equations of the angles."""

import pytest

from lagjax.mechanisms import double_pendulum
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_reference


def test_double_pendulum():
    """DOP853 on the equations of the angles gives the stored end; with other masses it does not."""
    mechanism = double_pendulum.MECHANISM
    assert_reference(mechanism, *published.double_pendulum_end(mechanism.end, mechanism.params))
    with pytest.raises(AssertionError):
        assert_reference(mechanism, *published.double_pendulum_end(mechanism.end, {**mechanism.params, "m2": 1.1}))
