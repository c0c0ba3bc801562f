"""The flow and its tangents: their volume is that of Liouville's formula; equations that fail are named."""

import numpy as np
import pytest

import lagjax as lj
from tests.systems import PARAMS, pendulum, rod_pendulum


@pytest.mark.exhaustive
def test_liouville_on_a_rod():
    """R = ½ c v² gives the product e^(-cT) of the one freedom (without a rod: `test_damped_and_driven`)."""
    c, period = 0.375, 1.25
    start = {"x": 0.0, "y": -PARAMS["l"]}, {"x": 0.0, "y": 0.0}
    drag = lambda t, q, v, p: 0.5 * p["c"] * (v["x"] ** 2 + v["y"] ** 2)
    rod = lj.System(rod_pendulum.lagrangian, dict(rod_pendulum.constraints), dissipation=drag)
    on_rod = lj.floquet(rod, 0.0, *start, PARAMS | {"c": c}, period)
    assert on_rod.multipliers.shape == (2,)
    np.testing.assert_allclose(on_rod.liouville, np.exp(-c * period), rtol=1e-11)
    np.testing.assert_allclose(on_rod.product, np.exp(-c * period), rtol=1e-10)


@pytest.mark.exhaustive
def test_equations_that_fail():
    """A degenerate L and a NaN parameter are named in the message, also in the search for an orbit."""
    massless = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2 - q["x"] ** 2 - (q["y"] - q["x"]) ** 2)
    start = {"x": 1.0, "y": 1.0}, {"x": 0.0, "y": 0.0}
    with pytest.raises(ValueError, match="the mass matrix is singular in coordinate 'y'"):
        lj.floquet(massless, 0.0, *start, None, 1.0)
    with pytest.raises(ValueError, match="the mass matrix is singular in coordinate 'y'"):
        lj.periodic_orbit(massless, start, 4.0)
    with pytest.raises(ValueError, match="L is nan at t = 0"):
        lj.periodic_orbit(pendulum, (1.0, 0.0), 2.0, PARAMS | {"g": np.nan})
