"""The governor: its stored end against the two equations of its angle and its height."""

import pytest

from lagjax.mechanisms import governor
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_reference


@pytest.mark.slow
def test_governor():
    """Radau on the two equations of α and z gives the stored end."""
    mechanism = governor.MECHANISM
    assert_reference(mechanism, *published.governor_end(mechanism.end, mechanism.params))
