"""A motion that several fits measure."""

import pytest

from tests.fit.cases import PENDULUM, TS, swung


@pytest.fixture(scope="module")
def swinging():
    """A pendulum's angle and rate at `TS`, by SciPy."""
    return swung(TS, 1.0, 0.0, PENDULUM)
