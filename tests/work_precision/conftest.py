"""A comparison that several tests look at."""

import pytest

from tests.work_precision.test_work_precision import compared


@pytest.fixture(scope="module")
def found():
    """A comparison with all defaults."""
    return compared()
