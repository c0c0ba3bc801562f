"""Combinations that the data determine: a force shows the mass that a motion does not."""

import pytest

import lagjax as lj
from tests.fit.cases import CASES, HUNG, hung


@pytest.mark.exhaustive
def test_a_measured_force_shows_the_mass():
    """A motion does not determine the scale of L, but a multiplier does."""
    case = CASES["pendulum on a rod"]
    traj = case.truth()
    record = lambda **measured: lj.Record(
        case.ts, **measured, q0=case.q0, v0=case.v0, sigma={"q": 0.01, "multipliers": 0.1}
    )
    free = ["g", "l", "m"]
    assert lj.identifiability(hung, record(q=traj.q), HUNG, free=free).unseen() == ["m"]
    assert lj.identifiability(hung, record(q=traj.q, multipliers=traj.multipliers), HUNG, free=free).rank == 3
