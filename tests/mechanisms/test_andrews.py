"""Andrews' squeezer: printed equations, published multipliers."""

import numpy as np

from lagjax.mechanisms import andrews
from tests import by_numpy
from tests.mechanisms import published
from tests.mechanisms.test_mechanism import assert_close, equations, residuals


def test_andrews_against_the_printed_equations():
    """M, f, g, G and the acceleration level from the Lagrangian are Hairer & Wanner's at a random state."""
    rng = np.random.default_rng(5)
    q, v = rng.uniform(-1, 1, 7), rng.uniform(-100, 100, 7)
    params = andrews.PARAMS
    mass, force, jacobian, gamma = equations(andrews.MECHANISM, q=andrews.Angles(*q), v=andrews.Angles(*v))
    M, f, g, G = published.andrews(q, v, params)
    G_rate = published.andrews(q + 1e-30j * v, v + 0j, params)[3].imag / 1e-30
    assert_close(mass, M)
    assert_close(force, f)
    assert_close(jacobian, G)
    assert_close(gamma, -G_rate @ v)
    assert_close(by_numpy.by_numpy(residuals(andrews.MECHANISM))(0.0, andrews.Angles(*q)), g)
    # Twin: a motor of twice the torque, a joint half a millimetre away.
    assert not np.allclose(force, published.andrews(q, v, params | {"mom": 0.066})[1], rtol=1e-12)
    assert not np.allclose(jacobian, published.andrews(q, v, params | {"d": 0.0285})[3], rtol=1e-12)


def test_andrews_multipliers_at_the_start():
    """λ(0) is the source's with its sign reversed."""
    start = andrews.MECHANISM
    found = by_numpy.equations(start.system, 0.0, start.q0, start.v0, start.params).multipliers["loops"]
    assert np.max(np.abs(found + andrews.SOURCE_MULTIPLIERS[0])) <= 1e-10
