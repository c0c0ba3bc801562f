"""Small systems that several tests share, so that JAX compiles each once."""

import jax.numpy as jnp
import numpy as np

from lagjax import Holonomic, System


def pendulum_lagrangian(t, q, v, params):
    """A plane pendulum by its angle from the vertical."""
    return 0.5 * v**2 + params["g"] / params["l"] * jnp.cos(q)


def cartesian_lagrangian(t, q, v, params):
    """A unit mass in a vertical plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]


def rod(t, q, params):
    """The squared length."""
    return q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2


pendulum = System(pendulum_lagrangian)
rod_pendulum = System(cartesian_lagrangian, {"rod": Holonomic(rod)})
PARAMS = {"g": 9.8125, "l": 1.25}
# Released at rest, horizontal: nonlinear, and the rod is loaded from 0 to 3 g.
HORIZONTAL = ({"x": 1.25, "y": 0.0}, {"x": 0.0, "y": 0.0})
TS = np.array([0.0, 0.25, 0.75, 1.0])
