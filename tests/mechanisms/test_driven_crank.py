"""The driven crank against its closed form, and its motor's torque."""

import numpy as np

from lagjax.mechanisms import driven_crank
from tests.by_numpy import equations
from tests.mechanisms.test_mechanism import assert_reference, stacked


def test_driven_crank():
    """The closed form gives the stored start and end, and its velocity is its position's derivative."""
    mechanism = driven_crank.MECHANISM
    q, v, _ = driven_crank.exact(mechanism.end, mechanism.params)
    assert_reference(mechanism, stacked(q), stacked(v))
    q, v, _ = driven_crank.exact(0.0, mechanism.params)
    np.testing.assert_allclose(stacked((q, v)), stacked((mechanism.q0, mechanism.v0)), atol=1e-14)
    at = lambda t: stacked(driven_crank.exact(t, mechanism.params)[0])
    step = 2.0**-20
    np.testing.assert_allclose(
        (at(0.03 + step) - at(0.03 - step)) / (2 * step),
        stacked(driven_crank.exact(0.03, mechanism.params)[1]),
        rtol=1e-6,
        atol=1e-6,
    )


def test_torque_of_the_motor():
    """At a state the motor's multiplier is the closed form's torque."""
    params = driven_crank.PARAMS | {"rate": 3.0}
    q, v, torque = driven_crank.exact(0.3, params)
    found = equations(driven_crank.system, 0.3, q, v, params).multipliers["motor"]
    np.testing.assert_allclose(found, torque, rtol=1e-12)
