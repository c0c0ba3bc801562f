"""Steps end on the constraints; without projection they drift."""

from dataclasses import replace

import numpy as np

import lagjax as lj
from tests.systems import HORIZONTAL, PARAMS, TS, motion, rod_pendulum


def test_constraints_hold_at_every_output():
    """Position and velocity residuals are at round-off at a loose tolerance; twin: off by a little they are not."""
    traj = lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=5 * TS, rtol=1e-6)
    assert float(traj.residual()) < 1e-14
    for name in ("q", "v"):
        of = getattr(traj, name)
        assert float(replace(traj, **{name: of | {"x": of["x"] + 1e-7}}).residual()) > 1e-8


def test_multipliers_belong_to_the_projected_states():
    """λ at every output is the tension of the state there: -3 g cos(angle) / (2 l) for a release at 90 degrees."""
    traj = motion("rod pendulum")
    tension = 3 * PARAMS["g"] * np.asarray(traj.q["y"]) / PARAMS["l"] / (2 * PARAMS["l"])
    np.testing.assert_allclose(traj.multipliers["rod"], tension, atol=1e-7)
