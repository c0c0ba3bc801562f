"""The explicit splitting with constraints on positions: RATTLE, and steps of it after each other.

Its orders and what it keeps are in `test_properties.py` and `test_equal_steps.py`, beside those of other steps.
"""

import numpy as np
import pytest

import lagjax as lj
from lagjax.numerics import lengths


def test_lengths():
    """Conditions of order: sums of the odd powers, of which Kahan and Li's are solved to round-off."""
    for order, powers in ((4, (3,)), (6, (3, 5)), (8, (3, 5, 7))):
        parts = lengths(order)
        np.testing.assert_allclose([np.sum(parts**k) for k in (1, *powers)], [1.0, *(0.0 for _ in powers)], atol=1e-14)
        np.testing.assert_array_equal(parts, parts[::-1])


@pytest.mark.slow
def test_an_oscillation_that_grows():
    """A spring in steps of three of its radians: which step would do is said."""
    spring = lj.System(lambda t, q, v, k: 0.5 * v**2 - 500.0 * k * q**2)
    with pytest.raises(RuntimeError, match=r"(?s)of the period 0\.0634, turns by 3 radians.*Fix: dt0=0\.01;"):
        lj.integrate(spring, 1.0, 0.0, 9.81, ts=[0.0, 90.0], method=lj.Splitting(2), dt0=0.0303, estimate_error=False)
