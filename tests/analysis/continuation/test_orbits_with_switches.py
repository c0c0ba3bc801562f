"""Branches of cycles with switches: sticking and slipping on a belt, and a ball that bounces, in closed form."""

import numpy as np
import pytest

import lagjax as lj
from tests.analysis.orbits.test_switching_flow import BELT, FLIPS, block, bounce_of, bouncing, stick_slip


@pytest.mark.exhaustive
def test_stick_slip():
    """The period along the belt's speed, and along μ until the start comes to a switch.

    The block sticks from x = (2μ - μ_s)/k on, which is the start's x, 0.1, at μ = 0.575. Twin: the period moves.
    """
    orbit = lj.periodic_orbit(block, (0.1, 0.25), 1.1 * stick_slip(BELT), BELT)
    branch = lj.continue_orbits(orbit, along="V", to=0.6)
    assert branch.status == "the end of the range" and branch.stable.all()
    exact = [stick_slip(BELT | {"V": V}) for V in branch.parameter]
    np.testing.assert_allclose(branch.period, exact, rtol=1e-10)
    np.testing.assert_allclose(branch.multipliers, np.tile([1.0, 0.0], (len(branch), 1)), atol=1e-9)
    assert np.ptp(exact) > 0.5 and branch[1].switches is None
    ended = lj.continue_orbits(orbit, along="mu", to=0.7)
    exact = [stick_slip(BELT | {"mu": mu}) for mu in ended.parameter]
    np.testing.assert_allclose(ended.period, exact, rtol=1e-10)
    np.testing.assert_allclose(ended.parameter[-1], 0.575, atol=1e-3)
    assert "the start comes to a switch" in ended.status
    # The largest x is that of the slip, about x = μ/k with the amplitude of its start.
    k, V, mu, static = BELT.values()
    at, reach = mu / k, np.hypot((static - mu) / k, V / k**0.5)
    np.testing.assert_allclose([ended.high[0], ended.low[0]], [at + reach, at - reach], atol=1e-5)


@pytest.mark.exhaustive
def test_bouncing_ball():
    """A multiplier passes -1 at the amplitude of the closed form; a drive that only the guard sees is refused."""
    orbit, _ = bounce_of(bouncing, 0.07)
    branch = lj.continue_orbits(orbit, along="A", to=1.02 * FLIPS)
    (flip,) = branch.of_kind("period doubling")
    np.testing.assert_allclose(flip.parameter, FLIPS, rtol=1e-9)
    assert branch.stable[0] and not branch.stable[-1]
    with pytest.raises(ValueError, match="the period of the drive changes with it"):
        lj.continue_orbits(orbit, along="omega", to=8.5)
