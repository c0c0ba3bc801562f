"""Orbits draw themselves."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.analysis.closed_forms import swinging
from tests.systems import pendulum


@pytest.mark.exhaustive
def test_whole_numbers_and_pictures():
    """A start and parameters in whole numbers work; the drawn orbit is closed."""
    orbit = lj.periodic_orbit(pendulum, (jnp.float64(1), jnp.float64(0)), 3, {"g": 10, "l": 1})
    np.testing.assert_allclose(orbit.period, swinging(1.0, {"g": 10, "l": 1}), rtol=1e-10)
    line = np.asarray(orbit.plot().axes[0].lines[0].get_xydata())
    np.testing.assert_allclose(line[0], line[-1], atol=1e-7)
    assert line[:, 0].max() == pytest.approx(1.0, abs=1e-9) and line[:, 0].min() == pytest.approx(-1.0, abs=1e-3)
