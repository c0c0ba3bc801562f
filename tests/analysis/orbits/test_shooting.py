"""Shooting: an unstable orbit in parts, a stiff cycle, and where there is none."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.closed_forms import VAN_DER_POL, van_der_pol
from tests.systems import PARAMS, pendulum


def inverted_lagrangian(t, q, v, p):
    """A pendulum by its angle from the upward vertical, pushed back and forth."""
    return 0.5 * v**2 - p["k"] * jnp.cos(q) + p["f"] * q * jnp.cos(t)


@pytest.mark.exhaustive
def test_unstable_orbit_by_parts():
    """A pushed pendulum stays up for two periods of the push, in which neighbours leave it e^(4π)-fold.

    For small pushes f, q = -f cos(t)/(1 + k) up to f³; the motion from a guess of zero leaves it at once.
    """
    inverted, f = lj.System(inverted_lagrangian), 0.01
    orbit = lj.periodic_orbit(inverted, (0.0, 0.0), 4 * np.pi, {"k": 1.0, "f": f}, parts=8)
    assert bool(orbit.converged) and orbit.nodes.shape == (8, 2)
    np.testing.assert_allclose(orbit.q, -f / 2, atol=f**3)
    np.testing.assert_allclose(orbit.nodes[:, 0], -f / 2 * np.cos(np.pi / 2 * np.arange(8)), atol=f**3)
    found = lj.floquet(orbit)
    np.testing.assert_allclose(found.multipliers[0], np.exp(4 * np.pi), rtol=1e-3)
    np.testing.assert_allclose(found.product, 1.0, rtol=1e-5)
    assert not bool(found.stable)


@pytest.mark.exhaustive
def test_stiff_cycle():
    """Van der Pol's at μ = 10: states fall onto the cycle; the other multiplier is almost 0, and called unknown."""
    orbit = lj.periodic_orbit(van_der_pol, (2.0, 0.0), 18.0, {"mu": 10.0})
    np.testing.assert_allclose(orbit.period, VAN_DER_POL[10.0], atol=1e-8)
    found = lj.floquet(orbit)
    assert bool(found.attracts) and float(found.liouville) < 1e-100
    assert "1 of the multipliers is not known" in repr(found)
    # Twin: at μ = 1 the multiplier is 9e-4, and known.
    assert "not known" not in repr(lj.floquet(lj.periodic_orbit(van_der_pol, (2.0, 0.0), 6.5, {"mu": 1.0})))


@pytest.mark.exhaustive
def test_no_cycle_of_a_damped_pendulum():
    """There is only rest, which does not count as an orbit; the best candidate is returned, with a warning."""
    damped = lj.System(pendulum.lagrangian, dissipation=lambda t, q, v, p: 0.5 * p["c"] * v**2)
    with pytest.raises(ValueError, match="the Jacobi integral is not conserved here"):
        lj.periodic_orbit(damped, (2.0, 0.0), 3.0, PARAMS | {"c": 0.5}, hold="energy")
    with pytest.warns(lj.OrbitWarning, match="a state of rest"):
        orbit = lj.periodic_orbit(damped, (2.0, 0.0), 3.0, PARAMS | {"c": 0.5})
    assert not bool(orbit.converged) and np.isfinite(float(orbit.period)) and float(orbit.residual) > 1e-3
