"""The great circles that geodesics are compared with are motions, in angles and over the azimuth."""

from functools import partial

import jax
import numpy as np

from lagjax.scenes import sphere_geodesic
from lagjax.stability.geodesics import _circle_from_angles, by_angles
from tests.by_numpy import by_numpy, equations

PARAMS = sphere_geodesic.PARAMS


def test_the_circle_from_angles():
    """The path in space begins along the start's velocity, stays on the sphere, and bends as the angles do."""
    q0, v0 = {"psi": 0.7, "theta": 0.2}, {"psi": 0.4, "theta": 0.3}
    a = equations(by_angles, 0.0, q0, v0, PARAMS).a

    def along(t, bend=1.0):
        q = jax.tree.map(lambda q, v, a: q + v * t + 0.5 * bend * a * t**2, q0, v0, a)
        return sphere_geodesic.cartesian(PARAMS, q["psi"], q["theta"])

    path = lambda t: _circle_from_angles(q0, v0, PARAMS, t[None])[0]
    at_start = lambda f: by_numpy(lambda t: (f(t), jax.jacfwd(f)(t), jax.jacfwd(jax.jacfwd(f))(t)))(0.0)
    found = at_start(path)
    for one, other in zip(found, at_start(along)):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(by_numpy(path)(1.3)), PARAMS["R"], rtol=1e-14)
    # Twin: without the accelerations the path bends otherwise.
    assert np.max(np.abs(found[2] - at_start(partial(along, bend=0.0))[2])) > 1e-2
