"""Which cases of a test are run always, and which only before a release; `conftest.py` says what the tiers are."""

import pytest


def exhaustive_but(kept, cases):
    """All cases, those that are not kept marked `exhaustive`."""
    return [case if case in kept else pytest.param(case, marks=pytest.mark.exhaustive) for case in cases]
