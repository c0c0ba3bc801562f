"""Reverse mode by replay, whatever the number of parameters."""

import pytest

from lagjax.integrate import both_modes


@pytest.fixture
def in_reverse(monkeypatch):
    """Replay also with few parameters; each test makes its own systems, since JAX caches what it has transformed."""
    monkeypatch.setattr(both_modes, "PUSH_UP_TO", 0)
