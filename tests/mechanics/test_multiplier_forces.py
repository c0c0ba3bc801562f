"""Forces that depend on multipliers, against closed forms; a paradox of friction is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.system.test_system import G


@pytest.mark.slow
def test_forces_of_multipliers():
    """Friction enters the equations: a block on an incline, written out, in arrays, and with the robust way."""
    incline = lj.Holonomic(lambda t, q, p: q["y"] - jnp.tan(p["angle"]) * q["x"])

    def drag(t, q, v, multipliers, p):
        # λ of y - x tan(angle) is the normal force times cos(angle); the block slides down, to smaller x.
        normal = multipliers["incline"] / jnp.cos(p["angle"])
        return {"x": p["mu"] * normal * jnp.cos(p["angle"]), "y": p["mu"] * normal * jnp.sin(p["angle"])}

    kinetic = lambda t, q, v, p: 0.5 * p["m"] * (v["x"] ** 2 + v["y"] ** 2) - p["m"] * p["g"] * q["y"]
    block = lj.System(kinetic, {"incline": incline}, force=drag)
    params = {"m": 2.0, "g": G, "mu": 0.25, "angle": 0.7}
    zero = {"x": 0.0, "y": 0.0}
    along = G * (np.sin(0.7) - 0.25 * np.cos(0.7))
    a, multipliers = lj.accelerations(block, 0.0, zero, zero, params)
    np.testing.assert_allclose([a["x"], a["y"]], [-along * np.cos(0.7), -along * np.sin(0.7)], rtol=1e-14)
    np.testing.assert_allclose(multipliers["incline"], 2.0 * G * np.cos(0.7) ** 2, rtol=1e-14)
    traj = lj.integrate(block, zero, zero, params, ts=np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(traj.q["x"][-1], -0.5 * along * np.cos(0.7), rtol=1e-9)
    of_mu = jax.jacfwd(lambda mu: lj.accelerations(block, 0.0, zero, zero, params | {"mu": mu})[0]["x"])(0.25)
    np.testing.assert_allclose(of_mu, G * np.cos(0.7) ** 2, rtol=1e-13)
    absolute = lj.System(kinetic, {"incline": incline}, force=lambda t, q, v, multipliers, p: {
        "x": jnp.abs(multipliers["incline"]), "y": 0.0})  # fmt: skip
    with pytest.raises(ValueError, match="must be linear in the multipliers"):
        lj.accelerations(absolute, 0.0, zero, zero, params)


def test_a_paradox_is_named():
    """A rod that is pushed into the ground by its own friction (Painlevé): one motion, or none."""
    tip = lj.Holonomic(lambda t, q, p: q["y"] - p["l"] * jnp.sin(q["angle"]))

    def friction(t, q, v, multipliers, p):
        force = p["mu"] * multipliers["tip"]
        return {"x": force, "y": 0.0, "angle": force * p["l"] * jnp.sin(q["angle"])}

    rod = lj.System(
        lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2 + v["angle"] ** 2 / 3) - p["g"] * q["y"],
        {"tip": tip},
        force=friction,
    )
    angle = np.arctan(2.0)
    q, v = {"x": 0.0, "y": np.sin(angle), "angle": angle}, {"x": -1.0, "y": 0.0, "angle": 0.0}
    # 1 + 3 cos² - 3 μ sin cos of the angle is zero at μ = 4/3, its least value.
    _, multipliers = lj.accelerations(rod, 0.0, q, v, {"l": 1.0, "g": G, "mu": 1.3})
    np.testing.assert_allclose(multipliers["tip"], G / (1.6 - 1.2 * 1.3), rtol=1e-12)
    with pytest.raises(ValueError, match="Painlevé"):
        lj.accelerations(rod, 0.0, q, v, {"l": 1.0, "g": G, "mu": 1.4})
