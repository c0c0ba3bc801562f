"""One motion to its end or its event, which is located by the method; in lanes, with derivatives."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.solve import one_motion
from lagjax.mechanics import equations_of
from lagjax.system import coordinates, model_of
from tests.by_hand import swing
from tests.systems import PARAMS


@pytest.mark.exhaustive
def test_a_long_loop_in_parts(monkeypatch):
    """A mass on a rod whose angle has no mass of its own, 1e-9 from the elliptic function, its loop compiled in parts.

    Twin: below the limit the same loop is one function.
    """
    in_parts, made = [], one_motion._solver

    def seen(*given):
        in_parts.append(made(*given).in_parts)
        return made(*given)

    def hangs(t, q, params):
        return q["at"] - params["l"] * jnp.stack([jnp.sin(q["angle"]), -jnp.cos(q["angle"])])

    def lagrangian(t, q, v, params):
        return 0.5 * v["at"] @ v["at"] - params["g"] * q["at"][1]

    hanging = lj.System(lagrangian, {"rod": lj.Holonomic(hangs)})
    q0 = {"at": PARAMS["l"] * np.array([np.sin(0.9), -np.cos(0.9)]), "angle": np.array(0.9)}
    v0 = {"at": np.zeros(2), "angle": np.array(0.0)}
    ts = np.linspace(0.0, 1.0, 4)
    monkeypatch.setattr(one_motion, "_solver", seen)
    monkeypatch.setattr(one_motion, "IN_PARTS_FROM", 0)
    traj = lj.integrate(hanging, q0, v0, PARAMS, ts=ts, rtol=1e-11, atol=1e-11)
    exact, _ = swing(ts, 0.9, np.sqrt(PARAMS["g"] / PARAMS["l"]))
    np.testing.assert_allclose(traj.q["angle"], exact, atol=1e-9)
    assert in_parts and all(in_parts)
    equations = equations_of(model_of(hanging, *coordinates.state(0.0, q0, v0, PARAMS)), fast=True)
    assert one_motion._is_long(equations)
    monkeypatch.setattr(one_motion, "IN_PARTS_FROM", 1000)
    assert not one_motion._is_long(equations)
