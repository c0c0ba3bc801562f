"""The slider crank: its stored end against the equation of the crank's angle."""

import pytest

from lagjax.mechanisms import slider_crank
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_reference


def test_slider_crank():
    """DOP853 on the equation of the crank's angle gives the stored end; without gravity it does not."""
    mechanism = slider_crank.MECHANISM
    assert_reference(mechanism, *published.slider_crank_end(mechanism.end, mechanism.params))
    with pytest.raises(AssertionError):
        assert_reference(mechanism, *published.slider_crank_end(mechanism.end, {**mechanism.params, "g": 0.0}))
