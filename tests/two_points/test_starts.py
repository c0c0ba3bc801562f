"""Where the search begins: answers that only a fan of motions finds, against closed forms."""


import numpy as np
import pytest
from scipy.optimize import brentq

import lagjax as lj

kepler = lj.System(lambda t, q, v, params: 0.5 * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + 1 / q[0])


@pytest.mark.exhaustive
def test_both_catenaries():
    """The surface of a soap film between two rings is a length, y² |dq|²: the upper catenary is a minimum, the lower
    one, which steeper launches find, a saddle of index 1. Twin: the straight line finds the upper one alone."""
    far, film = 0.5, lj.System(lambda t, q, v, params: 0.5 * q[1] ** 2 * (v @ v))
    a, b = np.array([-far, 1.0]), np.array([far, 1.0])
    launches = [
        lj.integrate(film, a, np.array([np.cos(steep), -np.sin(steep)]), ts=np.linspace(0, 1, 40), estimate_error=False)
        for steep in np.deg2rad([0.0, 60.0, 75.0])
    ]
    found = lj.geodesic(film, a, b, starts=launches, outputs=2)
    assert len(found.others) == 1
    for answer, bracket, kind in zip(
        (found, *found.others), ((0.5, 2.0), (0.1, 0.4)), ("minimum", "saddle of index 1"), strict=True
    ):
        neck = float(np.asarray(brentq(lambda neck: neck * np.cosh(far / neck) - 1, *bracket, xtol=1e-15)))
        area = neck * far + neck**2 / 2 * np.sinh(2 * far / neck)
        assert abs(answer.length - area) < 1e-12 and answer.kind == kind
        assert np.max(np.abs(answer.start_direction - np.array([neck, -np.sqrt(1 - neck**2)]))) < 1e-11
    straight = lj.geodesic(film, a, b, outputs=2)
    assert straight.others == () and abs(straight.length - found.length) < 1e-12
