"""Steps end on the constraints; without projection they drift."""

import numpy as np

import lagjax as lj
from tests.systems import HORIZONTAL, PARAMS, TS, rod_pendulum


def test_constraints_hold_at_every_output():
    """Position and velocity residuals are at round-off at a loose tolerance; without projection they drift."""
    run = lambda drift: lj.integrate(
        rod_pendulum, *HORIZONTAL, PARAMS, ts=np.linspace(0, 5, 8), rtol=1e-6, atol=1e-6, drift=drift
    )
    projected, free = run("project"), run("none")
    assert float(projected.residual()) < 1e-14
    assert float(free.residual()) > 1e-8


def test_multipliers_belong_to_the_projected_states():
    """λ at every output is the tension of the state there: -3 g cos(angle) / (2 l) for a release at 90 degrees."""
    traj = lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(
        traj.multipliers["rod"], 3 * PARAMS["g"] * traj.q["y"] / PARAMS["l"] / (2 * PARAMS["l"]), atol=1e-9
    )
