"""Contacts beside constraints of any name; coefficients that cannot be are refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.by_numpy import by_numpy
from tests.integrate.test_impacts import PARAMS, R, above, flying, on_wire, sliding


def after_impact(guard, system, *state):
    """The velocities after an impact."""
    return guard.reset.between(system, system)(0.0, *state)


def test_what_holds_goes_by_any_name():
    """A bead stays on its wire and halves its speed, whether the constraint's name sorts before the gap's or after."""

    @by_numpy
    def both(q, v, p):
        wires = [on_wire(name) for name in ("a wire", "wire")]
        return jnp.stack([after_impact(wire.switches[0].when, *wire.systems, q, v, p) for wire in wires])

    found = both(np.zeros(2), np.array([-8.0, -4.0]), {"mu": 0.1})
    np.testing.assert_allclose(found, [[4.0, 2.0]] * 2, rtol=1e-13)


def test_said_by_name():
    """Invalid friction is refused by name."""
    with pytest.raises(ValueError, match="friction is given, but sliding is not"):
        lj.guards.touches(above, 0.5, friction=0.2)
    with pytest.raises(ValueError, match="sliding is given, but friction is not"):
        lj.guards.touches(above, 0.5, sliding=sliding)
    with pytest.raises(ValueError, match="(?s)needs a restitution.*restitution=0.0"):
        lj.guards.touches(above, friction=0.2, sliding=sliding)
    with pytest.raises(TypeError, match="sliding must be a function"):
        lj.guards.touches(above, 0.5, friction=0.2, sliding=1.0)  # pyright: ignore
    q, v = {"x": 0.0, "y": R, "phi": 0.0}, {"x": 1.0, "y": -1.0, "phi": 0.0}
    for wrong, said in (
        (lambda t, q, v, p: jnp.stack([v["x"], v["y"]]), r"one number, but returned \(2,\)"),
        (lambda t, q, v, p: jnp.abs(v["x"]), "linear in v, but its slope depends on v"),
    ):
        guard = lj.guards.touches(above, 0.5, friction=0.2, sliding=wrong)
        with pytest.raises(ValueError, match=said):
            jax.eval_shape(partial(after_impact, guard, flying), q, v, PARAMS)
