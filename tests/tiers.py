"""Mark cases of a test that run only before a release; `conftest.py` describes the tiers."""

import pytest


def exhaustive_but(kept, cases):
    """All cases, with those not in `kept` marked `exhaustive`."""
    return [case if case in kept else pytest.param(case, marks=pytest.mark.exhaustive) for case in cases]
