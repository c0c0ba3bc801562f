"""The hoop with friction: slips, leaves and lands where the closed forms say, for coefficients from 1/16 to 16."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import rolling_hoop
from lagjax.scenes.slipping_hoop import FIRST, PARAMS, exact, hybrid, roll_and_slip
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


@pytest.mark.exhaustive
def test_derivative_of_the_departure():
    """d(angle)/dμ at the departure agrees in both modes with the closed form; each compiles for minutes."""
    until_it_flies = lj.Hybrid(dict(zip(hybrid.names[:3], hybrid.systems)), hybrid.switches[:3], most_switches=3)
    start = rolling_hoop.start(PARAMS, FIRST, rolling_hoop.exact_rate(PARAMS, FIRST, rolling_hoop.TOP))

    def leaves(mu):
        settings = {"ts": jnp.array([0.0, 2.0]), "rtol": 1e-11, "estimate_error": False}
        traj = lj.integrate(until_it_flies, *start, PARAMS | {"mu": mu}, **settings)
        assert isinstance(traj, lj.HybridTrajectory)
        return traj.switches.q["theta"][1]

    difference = lambda h: (exact(PARAMS | {"mu": 0.25 + h}).leaves - exact(PARAMS | {"mu": 0.25 - h}).leaves) / (2 * h)
    expected = (4 * difference(5e-4) - difference(1e-3)) / 3
    for mode in (jax.jacfwd, jax.grad):
        np.testing.assert_allclose(mode(leaves)(0.25), expected, rtol=1e-8)
