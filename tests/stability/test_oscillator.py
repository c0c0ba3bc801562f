"""The largest stable step of a method, from its stability function."""

import diffrax
import numpy as np
import pytest

from lagjax.stability import oscillator


def test_stability_function():
    """R of Bogacki & Shampine's method is 1 + z + z²/2 + z³/6, stable up to √3 on the imaginary axis."""
    z = np.array([0.3 - 2.0j, 1.5j])
    np.testing.assert_allclose(oscillator.amplification(diffrax.Bosh3(), z), 1 + z + z**2 / 2 + z**3 / 6, rtol=1e-14)
    assert oscillator.stable_limit(diffrax.Bosh3()) == pytest.approx(3**0.5, rel=1e-3)
    assert oscillator.stable_limit(diffrax.Kvaerno5()) == np.inf
