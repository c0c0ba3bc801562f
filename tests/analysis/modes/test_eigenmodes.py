"""From linear equations to modes: verdicts, signs of energies, symmetries and double roots."""

import jax
import numpy as np
import pytest

import lagjax as lj
from tests.analysis import small_systems as small
from tests.analysis.modes.test_normal_modes import STILL


@pytest.mark.slow
def test_where_a_stiffness_vanishes_the_next_term_decides():
    """q⁴ is stable, which a zero mode says; twin: -q⁴ is not."""
    quartic = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["c"] * q["x"] ** 4 - q["y"] ** 2)
    modes = lj.normal_modes(quartic, 0.0, STILL, STILL, {"c": 1.0})
    assert modes.verdict == "stable" and list(modes.zero) == [True, False]
    hill = lj.normal_modes(quartic, 0.0, STILL, STILL, {"c": -1.0})
    assert hill.verdict == "divergence" and "first term that does not vanish" in repr(hill)


def test_damping_and_circulation():
    """Damped and overdamped roots; stable up to 2n = |k₁ - k₂| and flutter above it, as Ziegler found."""
    at = lambda **params: lj.normal_modes(small.circulating, 0.0, STILL, STILL, params)
    modes = at(k1=1.0, k2=4.0, n=0.0, c=0.5)
    np.testing.assert_allclose(modes.roots, [-0.25 + 1j * np.sqrt(k - 0.0625) for k in (1.0, 4.0)], rtol=1e-12)
    assert modes.verdict == "asymptotically stable"
    modes = at(k1=1.0, k2=4.0, n=0.0, c=5.0)
    np.testing.assert_allclose(modes.roots, np.sort([*np.roots([1, 5, 1]), *np.roots([1, 5, 4])])[::-1], rtol=1e-10)
    assert at(k1=1.0, k2=1.5, n=0.249, c=0.0).verdict == "stable"
    modes = at(k1=1.0, k2=1.5, n=0.251, c=0.0)
    assert modes.verdict == "flutter"
    np.testing.assert_allclose(modes.linearisation.circulatory, [[0.0, -0.251], [0.251, 0.0]])
    np.testing.assert_allclose(at(k1=1.0, k2=1.5, n=0.0, c=0.5).linearisation.damping, 0.5 * np.eye(2))


@pytest.mark.exhaustive
def test_a_double_root_is_reported():
    """An isotropic oscillator has finite derivatives, those of the mean, and is reported as double."""
    at = lambda k1: lj.normal_modes(small.circulating, 0.0, STILL, STILL, {"k1": k1, "k2": 4.0, "n": 0.0, "c": 0.0})
    modes = at(4.0)
    assert list(modes.double) == [True, True] and "double" in repr(modes)
    slope = jax.jacfwd(lambda k1: at(k1).frequency)(4.0)
    assert np.isfinite(slope).all()
    np.testing.assert_allclose(np.sort(np.abs(slope))[-2:], 0.125, rtol=1e-8)
    np.testing.assert_allclose(np.max(jax.jacfwd(lambda k1: at(k1).frequency)(4.1)), 1 / (2 * np.sqrt(4.1)), rtol=1e-8)
