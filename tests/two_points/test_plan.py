"""Controls as functions of time."""

import jax
import numpy as np

from lagjax.two_points.steering import plan_of


def test_a_plan_is_its_polynomials():
    """Between knots a cubic through its points, and the next one from each knot on."""
    knots, nodes = np.array([1.0, 1.5, 3.0]), np.array([0.1, 0.3, 0.6, 0.9])
    polynomials = [np.polynomial.Polynomial([1.0, -2.0, 0.5, 3.0]), np.polynomial.Polynomial([0.0, 1.0, -1.0, 0.2])]
    times = knots[:-1, None] + np.diff(knots)[:, None] * nodes
    rows = np.stack([p(t) for p, t in zip(polynomials, times)])[..., None]
    plan = plan_of(knots, rows, np.array([[-np.inf], [np.inf]]), {"push": np.zeros(())}, nodes, 5)
    ts = np.array([1.0, 1.2, 1.499, 1.5, 2.0, 3.0])
    exact = [polynomials[int(t >= 1.5)](t) for t in ts]
    np.testing.assert_allclose(plan.at(ts)[:, 0], exact, atol=1e-12)
    np.testing.assert_allclose(plan.knots, knots)
    value, slope = jax.jit(jax.value_and_grad(lambda t: plan(t)["push"]))(1.5)
    assert abs(value - polynomials[1](1.5)) < 1e-12 and abs(slope - polynomials[1].deriv()(1.5)) < 1e-12
    # Twin: with bounds it is cut off at them.
    cut = plan_of(knots, rows, np.array([[-0.1], [0.5]]), {"push": np.zeros(())}, nodes, 5).at(ts)[:, 0]
    np.testing.assert_allclose(cut, np.clip(exact, -0.1, 0.5), atol=1e-12)
    assert np.max(np.abs(cut - exact)) > 0.1
