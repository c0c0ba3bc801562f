"""Reverse mode by replay, whatever the number of parameters."""

import pytest

from lagjax.integrate import both_modes
from lagjax.jaxtools import columns


@pytest.fixture
def in_reverse(monkeypatch):
    """Replay also with few parameters; each test makes its own systems, since JAX caches what it has transformed."""
    monkeypatch.setattr(both_modes, "FEW", 0)
    monkeypatch.setattr(columns, "FEW", 0)
