"""A warning of input that is hardly ever meant: a force in place of R."""

import importlib

import jax
import jax.numpy as jnp
import pytest

import lagjax as lj
from lagjax.integrate.arguments import _in_order, warn_of_odd_dissipation
from lagjax.system import coordinates
from tests.systems import PARAMS, TS, motion, pendulum

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


@pytest.mark.parametrize("which", ODD)
def test_a_force_in_place_of_a_dissipation(which):
    """The warning is given at rest too, with both remedies."""
    for q, v in STARTS:
        with pytest.warns(UserWarning, match=r"changes its sign with v(.|\n)*force=f(.|\n)*R = 0.5 c v²"):
            warn_of_odd_dissipation(ODD[which], coordinates.state(0.5, q, v, {"c": 0.3}))


@pytest.mark.parametrize("which", RIGHT)
def test_what_dissipates_is_left_alone(which):
    """Twin: no warning, which would be an error here."""
    for q, v in STARTS:
        # What was found right is not looked at again.
        _in_order.discard(RIGHT[which])
        warn_of_odd_dissipation(RIGHT[which], coordinates.state(0.5, q, v, {"c": 0.3}))
        assert RIGHT[which] in _in_order


def test_integrate_tells_and_goes_on(monkeypatch):
    """`integrate` warns by the function's name, and goes on; twin: traced values are ignored."""

    def drag(t, q, v, params):
        return -0.5 * v

    done, solved = motion("pendulum"), lambda problem: done
    monkeypatch.setattr(importlib.import_module("lagjax.integrate.integrate"), "run", solved)
    dragged = lj.System(pendulum.lagrangian, dissipation=drag)
    run = lambda q0: lj.integrate(dragged, q0, 1.0, PARAMS, ts=TS, throw=False)
    with pytest.warns(UserWarning, match="Fix: force=drag"):
        assert run(0.5) is done
    jax.eval_shape(lambda q0: run(q0).q, 0.5)
