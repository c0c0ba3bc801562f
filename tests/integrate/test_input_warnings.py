"""A warning of input that is hardly ever meant: a force in place of R."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.input_warnings import warn_of_odd_dissipation
from lagjax.system import coordinates

ODD = {
    "a force": lambda t, q, v, p: -p["c"] * v,
    "its opposite": lambda t, q, v, p: p["c"] * v * jnp.cos(q),
    "of the square": lambda t, q, v, p: -p["c"] * v * jnp.abs(v),
    "of a constant size": lambda t, q, v, p: -p["c"] * jnp.sign(v),
}
RIGHT = {
    "linear friction": lambda t, q, v, p: 0.5 * p["c"] * v**2,
    "in a wind": lambda t, q, v, p: 0.5 * p["c"] * (v - 3.0) ** 2,
    "on a belt": lambda t, q, v, p: p["c"] * jnp.sqrt(1e-6 + (v - jnp.sin(t) - 0.1) ** 2),
    "easier one way": lambda t, q, v, p: jnp.where(v > 0, 0.5, 0.1) * v**2,
    "in the other direction none": lambda t, q, v, p: jnp.maximum(v, 0.0) ** 2,
    "of air": lambda t, q, v, p: p["c"] * jnp.abs(v) ** 3,
    "that feeds": lambda t, q, v, p: 0.5 * (q**2 - 1.0) * v**2,
    "none here": lambda t, q, v, p: 0.0 * v,
}
STARTS = [(0.3, 0.0), (0.3, 1.7), (0.0, -2.0), (2.0, 1e-3)]


@pytest.mark.parametrize("q, v", STARTS)
@pytest.mark.parametrize("which", ODD)
def test_a_force_in_place_of_a_dissipation(which, q, v):
    """The warning is given at rest too, with both remedies."""
    with pytest.warns(UserWarning, match=r"changes its sign with v(.|\n)*force=f(.|\n)*R = 0.5 c v²"):
        warn_of_odd_dissipation(ODD[which], coordinates.state(0.5, q, v, {"c": 0.3}))


@pytest.mark.parametrize("q, v", STARTS)
@pytest.mark.parametrize("which", RIGHT)
def test_what_dissipates_is_left_alone(which, q, v):
    """Twin: no warning, which would be an error here."""
    new = lambda *of_state: RIGHT[which](*of_state)
    warn_of_odd_dissipation(new, coordinates.state(0.5, q, v, {"c": 0.3}))


def test_integrate_tells_and_goes_on():
    """`integrate` warns by the function's name, goes on with its constant force of 0.5, and ignores traced values."""

    def drag(t, q, v, params):
        return -0.5 * v["x"]

    free = lj.System(lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2), dissipation=drag)
    start = {"x": 0.0, "y": 0.0}, {"x": 0.0, "y": 1.0}
    with pytest.warns(UserWarning, match="Fix: force=drag"):
        motion = lj.integrate(free, *start, None, ts=jnp.array([0.0, 2.0]))
    np.testing.assert_allclose(motion.q["x"][-1], 0.5 * 0.5 * 2.0**2, rtol=1e-12)

    def traced(y, c):
        closed = lj.System(free.lagrangian, dissipation=lambda t, q, v, params: c * v["x"])
        ts = jnp.array([0.0, 2.0])
        of_start = lj.integrate(free, start[0] | {"y": y}, start[1], None, ts=ts)
        return of_start.q["x"] + lj.integrate(closed, *start, None, ts=ts).q["x"]

    assert jax.eval_shape(traced, 0.5, 0.5).shape == (2,)
