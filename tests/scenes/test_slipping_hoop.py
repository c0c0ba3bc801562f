"""The hoop with friction: slips, leaves and lands where the closed forms say, for coefficients from 1/16 to 16."""

import numpy as np
import pytest

from lagjax.scenes.slipping_hoop import PARAMS, exact, roll_and_slip
from tests.references import reference

COEFFICIENTS = (0.0625, 0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 16.0)


def test_closed_forms():
    """They agree with the reference to its last digits; twin: another moment of inertia slips and leaves elsewhere."""
    for mu in COEFFICIENTS:
        found = exact(PARAMS | {"mu": mu})
        np.testing.assert_allclose(found.slips, float(reference(f"s2.fric={mu}.slip_theta_rad")), rtol=1e-13)
        np.testing.assert_allclose(found.leaves, float(reference(f"s2.fric={mu}.depart_rad")), rtol=1e-13)
        np.testing.assert_allclose(found.speed, float(reference(f"s2.fric={mu}.depart_speed")), rtol=1e-13)
    for mu in (0.25, 1.0):
        spin = exact(PARAMS | {"mu": mu}).spin
        np.testing.assert_allclose(spin, float(reference(f"s2.fric={mu}.depart_spin")), rtol=1e-12)
    assert abs(exact(PARAMS | {"beta": 0.5}).slips - exact(PARAMS).slips) > 0.01


@pytest.mark.exhaustive
def test_it_slips_leaves_and_lands():
    """Angles, speeds, spins and places for all coefficients, by one program, to 1e-9."""
    l = PARAMS["R"] + PARAMS["a"]
    for mu in COEFFICIENTS:
        params = PARAMS | {"mu": mu}
        traj, expected = roll_and_slip(params, np.array([0.0, 3.0]), rtol=1e-11, estimate_error=False), exact(params)
        assert len(traj.switches) == 3 and list(traj.switches.to[:3]) == [1, 2, 3]
        slips, leaves, lands = ({name: x[k] for name, x in traj.switches.q.items()} for k in range(3))
        v = {name: x[1] for name, x in traj.switches.v.items()}
        np.testing.assert_allclose(slips["theta"], expected.slips, rtol=1e-9)
        np.testing.assert_allclose(leaves["theta"], expected.leaves, rtol=1e-9)
        np.testing.assert_allclose([-l * v["theta"], v["phi"]], [expected.speed, expected.spin], rtol=1e-9)
        np.testing.assert_allclose(lands["r"] * np.cos(lands["theta"]), expected.lands, rtol=1e-9)
