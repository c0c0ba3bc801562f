"""Systems whose symmetries several tests use: a stone, a planet, and a disk that rolls."""

import jax.numpy as jnp
import numpy as np

import lagjax as lj

RADIUS = {"R": 0.75}


def central(t, q, v, params):
    """A particle in a central field, with coordinates in an array of three."""
    return 0.5 * params["m"] * v @ v + params["k"] / jnp.sqrt(q @ q)


def falling(t, q, v, params):
    """A falling stone."""
    return 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) - params["m"] * params["g"] * q["y"]


def rolling_disk():
    """An upright disk that rolls on a plane and is pulled along x, as on a slope."""
    lagrangian = lambda t, q, v, p: (
        0.5 * (v["x"] ** 2 + v["y"] ** 2) + 0.25 * v["phi"] ** 2 + 0.125 * v["theta"] ** 2 + 0.5 * q["x"]
    )
    along = lj.Nonholonomic(lambda t, q, v, p: v["x"] - p["R"] * v["phi"] * jnp.cos(q["theta"]))
    across = lj.Nonholonomic(lambda t, q, v, p: v["y"] - p["R"] * v["phi"] * jnp.sin(q["theta"]))
    return lj.System(lagrangian, {"along": along, "across": across})


STONE, KEPLER, DISK = lj.System(falling), lj.System(central), rolling_disk()
OF_STONE = {"m": 1.5, "g": 9.8125}
OF_KEPLER = {"m": 1.25, "k": 2.0}
IN_SPACE = np.array([1.0, 0.25, 0.5]), np.array([0.125, 1.0, -0.25])
ON_PLANE = {"phi": 0.25, "theta": 0.75, "x": 0.0, "y": 0.5}


def rolling(start=ON_PLANE):
    """A velocity with which the disk rolls."""
    phi = 2.0
    x, y = RADIUS["R"] * phi * np.cos(start["theta"]), RADIUS["R"] * phi * np.sin(start["theta"])
    return {"phi": phi, "theta": 0.5, "x": x, "y": y}
