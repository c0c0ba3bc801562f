"""Roots of matrices: small ones with all their digits."""

import mpmath
import numpy as np
import pytest

from tests.analysis.test_normal_modes import rails


@pytest.mark.slow
def test_small_roots_have_all_digits():
    """Near critical speeds at large ω the small root agrees with mpmath's to 1e-10."""
    m = 1.0
    for omega, over_K, over_k in ((1e4, 1e-3, 0.5), (1e4, 1e-4, 1e-4), (1e6, 0.5, 1e-3), (1e3, -1e-3, -0.5)):
        params = {"m": m, "K": m * omega**2 * (1 + over_K), "k": m * omega**2 * (1 + over_k), "R0": 0.0, "omega": omega}
        with mpmath.workdps(50):
            K, k, squared = (mpmath.mpf(float(x)) for x in (params["K"], params["k"], omega**2))
            half = (K + k) / 2 + squared
            fast = half + mpmath.sqrt(half**2 - (K - squared) * (k - squared))
            exact = mpmath.sqrt((K - squared) * (k - squared) / fast)
        got = np.min(rails(params).frequency)
        # The exact root uses ω² and K as rounded to double precision.
        assert abs(got / float(exact) - 1) < 1e-10, (omega, over_K, over_k)
