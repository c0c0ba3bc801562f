"""What the residuals of a fit tell, in words."""

import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import TS, noisy


@pytest.mark.exhaustive
def test_what_the_residuals_tell():
    """As many unknowns as measurements leave no uncertainty; residuals on a curve are not measurement errors."""
    spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["k"] * q**2)
    with pytest.warns(lj.FitWarning, match="as many unknowns as measurements.*\n.*sigma="):
        found = lj.fit(spring, lj.Record([0.0, 0.5, 1.0], q=[1.0, 0.9, 0.6]), {"k": 1.0})
    assert np.isnan(found.sd).all() and np.isnan(found.start_sd[0][0])
    # Twin: the same with the size of the errors given.
    told = lj.fit(spring, lj.Record([0.0, 0.5, 1.0], q=[1.0, 0.9, 0.6], sigma=0.01), {"k": 1.0})
    assert np.isfinite(told.sd).all()
    clean = lj.integrate(spring, 1.0, 0.0, {"k": 4.0}, ts=TS).q
    data = noisy(np.asarray(clean) + 0.3 * np.cos(9 * TS), 0.02)
    with pytest.warns(lj.FitWarning, match="residuals of 'q' are not measurement errors"):
        lj.fit(spring, lj.Record(TS, q=data), {"k": 3.0})
    # Twin: residuals as large, but uncorrelated.
    lj.fit(spring, lj.Record(TS, q=noisy(np.asarray(clean), 0.25)), {"k": 3.0})
