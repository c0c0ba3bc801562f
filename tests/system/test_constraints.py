"""Constraints at three levels, in closed form; accelerations: `tests/mechanics/test_constrained_state.py`."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system import constraints
from lagjax.system.model import model_of
from tests.jaxtools.in_numpy import evaluated

# A rod that grows, and a velocity along a direction that turns with the position and in time.
SYSTEM = lj.System(
    lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2),
    {
        "rod": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - (1.0 + params["rate"] * t) ** 2),
        "skate": lj.Nonholonomic(lambda t, q, v, params: v["x"] * jnp.sin(q["y"] + t) - v["y"] * q["x"]),
    },
)
T, X, U, RATE = 0.3, np.array([0.6, -0.9]), np.array([0.4, 1.1]), 0.25
MODEL = model_of(SYSTEM, np.asarray(T), {"x": 0.6, "y": -0.9}, {"x": 0.4, "y": 1.1}, {"rate": RATE})


def test_residuals_and_closed_forms():
    """g, dg/dt, phi and the matrix A are those by hand, stacked in the order of the names."""
    g = X @ X - (1 + RATE * T) ** 2
    of_v = [2 * X @ U - 2 * RATE * (1 + RATE * T), U[0] * np.sin(X[1] + T) - U[1] * X[0]]
    # g'' + 2 k g' + k² g = 0 and phi' + k phi = 0 with k = 3.
    feedback = [-6 * of_v[0] - 9 * g, -3 * of_v[1]]
    for function, args, expected in (
        (constraints.position_residual, (T, X), [g]),
        (constraints.velocity_residual, (T, X, U), of_v),
        (constraints.jacobian, (T, X, U), [2 * X, [np.sin(X[1] + T), -X[0]]]),
        (constraints.baumgarte_feedback, (T, X, U, 3.0), feedback),
    ):
        np.testing.assert_allclose(*evaluated(partial(function, MODEL), *args), expected, rtol=1e-14)


@pytest.mark.parametrize("kind", [lj.Holonomic, lj.Nonholonomic])
def test_no_function_no_constraint(kind):
    """A number is refused with the fix; twin: a function is taken, and named."""
    with pytest.raises(TypeError, match=f"must be a function of(.|\n)*Fix: lj.{kind.__name__}"):
        kind(1.0)
    assert repr(kind(np.hypot)) == f"{kind.__name__}(hypot)"


def test_without_constraints():
    """No equations: empty arrays of the right dtype."""
    model = model_of(lj.System(SYSTEM.lagrangian), np.float32(0.0), {"x": 0.6, "y": -0.9}, None, None)
    state = np.float32(T), X.astype(np.float32), U.astype(np.float32)
    rows = jax.eval_shape(partial(constraints.acceleration_rows, model), *state)
    assert rows.jacobian.shape == (0, 2) and rows.gamma.shape == (0,) and rows.gamma.dtype == np.float32
