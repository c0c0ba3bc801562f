"""The ellipse that eccentric orbits are compared with is a motion of the two-body problem."""

from functools import partial

import numpy as np
import pytest

from lagjax.stability.amplifying import _on_ellipse, amplifying, kepler
from tests.by_numpy import by_numpy
from tests.stability.closed_forms import defect

TIMES = np.array([1.0, 3.0, 5.0])


@pytest.mark.parametrize("eccentricity", [0.0, 0.5, 0.9])
def test_the_ellipse_is_a_motion(eccentricity):
    """It obeys the equations for k = 1, and begins at the pericentre; twin: not those of another attraction."""
    exact = partial(_on_ellipse, eccentricity)
    assert defect(kepler, exact, None, None, {"k": 1.0}, TIMES) < 1e-8
    assert defect(kepler, exact, None, None, {"k": 1.01}, TIMES) > 1e-3
    q, v = by_numpy(exact)(None, None, None, 0.0)
    np.testing.assert_allclose(q, [1 - eccentricity, 0.0], atol=1e-15)
    np.testing.assert_allclose(v, [0.0, np.sqrt((1 + eccentricity) / (1 - eccentricity))], rtol=1e-13, atol=1e-15)


def test_rows_start_on_their_ellipses():
    """The starts of the report are those of the closed form, and each turn ends where it began."""
    for row in amplifying()[:3]:
        assert row.exact is not None
        exact = by_numpy(partial(row.exact, row.q0, row.v0, row.params))
        q, v = exact(row.ts[0])
        np.testing.assert_allclose(q, row.q0, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(v, row.v0, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(exact(2 * np.pi)[0], row.q0, atol=1e-9)
