"""The car axis against the printed equations of the test set."""

import numpy as np

from lagjax.mechanisms import car_axis
from tests.by_numpy import by_numpy
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_close, equations, residuals


def test_car_axis_against_the_printed_equations():
    """Mass, springs, both constraints and the signs of both multipliers are the test set's at a random state."""
    rng = np.random.default_rng(6)
    q, t, params = np.array([0.1, 0.5, 1.1, 0.4]) + rng.uniform(-0.2, 0.2, 4), 1.23, car_axis.PARAMS
    v = rng.uniform(-1, 1, 4)
    mass, force, jacobian, gamma = equations(car_axis.MECHANISM, t, car_axis.AxleEnds(*q), car_axis.AxleEnds(*v))
    k, f, g, G = published.car_axis(t, q, params)
    # The source lists the upright spring first, lagjax the names in order: axle, upright.
    g, G = g[::-1], G[::-1]
    assert_close(mass, k * np.eye(4))
    assert_close(force, f)
    assert_close(jacobian, G)
    assert_close(by_numpy(residuals(car_axis.MECHANISM))(t, car_axis.AxleEnds(*q)), g)
    # gamma = -d²g/dt² at a = 0, by a sixth-order difference along q + v t.
    along = lambda s: published.car_axis(t + s, q + v * s, params)[2][::-1]
    step, weights = 1e-2, (1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90)
    second = sum(w * along(i * step) for i, w in zip(range(-3, 4), weights)) / step**2
    assert_close(gamma, -second, 1e-5)
    # Twin: the wheel half a wave earlier.
    assert not np.allclose(force, published.car_axis(t - np.pi / params["omega"], q, params)[1], rtol=1e-12)
