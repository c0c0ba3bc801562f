"""The equations of a branch: the parameter along it, and rates that a constraint determines."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.scenes import bead_on_hoop
from tests.analysis.continuation.test_equilibria import check

BEAD = bead_on_hoop.PARAMS


@pytest.mark.exhaustive
def test_a_moving_constraint():
    """A constraint drives the hoop, and the equations find its rate: the same pitchfork, with the motor's torque."""
    start = {"psi": 0.0, "theta": 0.0}
    settings = {"velocity": start | {"theta": 1.0}, "cyclic": "theta", "hold": None}
    params = BEAD | {"omega": 1.0}
    found = lj.continue_equilibria(bead_on_hoop.driven_system, params, start, along="omega", to=8.0, **settings)
    (critical,) = found.critical
    assert critical.kind == "pitchfork"
    check(critical, lambda p: jnp.sqrt(p["g"] / p["a"]), BEAD, "omega")
    np.testing.assert_allclose(found[1].v["theta"], found[1].parameter, rtol=1e-12)
    np.testing.assert_allclose(found[1].multipliers["motor"], 0.0, atol=1e-10)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"along": "speed"}, "along='speed' is no number in params; there are 'a', 'g', 'm' and 'omega'"),
        ({"to": 6.0}, "leaves the parameter 'omega' no range: it starts at 6"),
        ({"velocity": 1.0}, "L depends on 'q'"),
    ],
)
def test_bad_input(change, words):
    """Errors name what is wrong."""
    settings = {"along": "omega", "to": 8.0} | change
    with pytest.raises(ValueError, match=words):
        lj.continue_equilibria(bead_on_hoop.system, BEAD, 1.0, **settings)
