"""Motion under redundant constraints: motion, derivatives and batches are those of the system without redundancy."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.mechanics.test_saddle_point import DOOR_STATE, RATE, door
from tests.systems import PARAMS, cartesian_lagrangian, rod
from tests.tiers import exhaustive_but

TOLERANCE = 1e-10
START = ({"x": 1.0, "y": 0.75}, {"x": -1.5, "y": 2.0})


@pytest.mark.exhaustive
@pytest.mark.parametrize("drift", exhaustive_but(("project",), ("project", "none")))
def test_door_swings_like_its_angle(drift):
    """A door with 18 equations of which 11 are independent follows its one-angle equation, whatever the drift control.

    The equations are dependent only where they hold: solved with all of them, the door would fly off.
    """
    field = DOOR_STATE[3]["field"]
    by_angle = lj.System(lambda t, q, v, params: 0.5 * 2 * v**2 + 2 * (field[0] * jnp.cos(q) + field[1] * jnp.sin(q)))
    ts = np.array([0.0, 2.0, 5.0])
    tolerance = {"rtol": TOLERANCE, "atol": TOLERANCE}
    angle = lj.integrate(by_angle, 0.4, RATE, ts=ts, **tolerance)
    traj = lj.integrate(door, *DOOR_STATE[1:], ts=ts, drift=drift, **tolerance)
    outward = traj.q["corner"][:, 2]
    np.testing.assert_allclose(outward[:, 0], np.cos(angle.q), atol=1e-8)
    np.testing.assert_allclose(outward[:, 1], np.sin(angle.q), atol=1e-8)
    assert float(traj.residual()) < (1e-14 if drift == "project" else 1e-7)


@pytest.mark.exhaustive
def test_redundancy_that_ends_is_reported():
    """Two rods of equal length agree; once one of them grows, no motion satisfies both, and this is reported."""
    grows = lj.Holonomic(lambda t, q, params: rod(t, q, params) - jnp.where(t > 0.5, (t - 0.5) ** 3, 0.0))
    system = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "grows": grows})
    with pytest.raises(RuntimeError, match="stopped at t = 0.5"):
        lj.integrate(system, *START, PARAMS, ts=np.array([0.0, 1.0]))
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.01}
    with pytest.raises(RuntimeError, match="stopped at t = 0.5.*"):
        lj.integrate(system, *START, PARAMS, ts=np.array([0.0, 1.0]), **fixed)
