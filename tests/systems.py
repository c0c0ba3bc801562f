"""Small systems that several tests share, so that JAX compiles each once."""

import jax.numpy as jnp
import numpy as np

from lagjax import Holonomic, System


def pendulum_lagrangian(t, q, v, params):
    """A plane pendulum in terms of its angle from the vertical."""
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


def double_pendulum_lagrangian(t, q, v, params):
    """Two rods end to end in a vertical plane, by their angles from the vertical."""
    m1, m2, l1, l2, g = (params[name] for name in ("m1", "m2", "l1", "l2", "g"))
    kinetic = 0.5 * (m1 + m2) * (l1 * v[0]) ** 2 + 0.5 * m2 * (l2 * v[1]) ** 2
    coupling = m2 * l1 * l2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + coupling + (m1 + m2) * g * l1 * jnp.cos(q[0]) + m2 * g * l2 * jnp.cos(q[1])


def two_masses_lagrangian(t, q, v, params):
    """Two masses in a vertical plane."""
    m1, m2, g = params["m1"], params["m2"], params["g"]
    kinetic = 0.5 * m1 * v["first"] @ v["first"] + 0.5 * m2 * v["second"] @ v["second"]
    return kinetic - g * (m1 * q["first"][1] + m2 * q["second"][1])


def inner_rod(t, q, params):
    """The constraint from the pivot to the first mass."""
    return q["first"] @ q["first"] - params["l1"] ** 2


def outer_rod(t, q, params):
    """The constraint from the first mass to the second."""
    rod = q["second"] - q["first"]
    return rod @ rod - params["l2"] ** 2


double_pendulum = System(double_pendulum_lagrangian)
double_rods = System(two_masses_lagrangian, {"inner": Holonomic(inner_rod), "outer": Holonomic(outer_rod)})
DOUBLE_PARAMS = {"m1": 1.0, "m2": 0.625, "l1": 1.25, "l2": 0.875, "g": 9.8125}
# Both rods swing, neither at a turning point; small enough angles to be far from chaos.
DOUBLE_SWING = (np.array([0.7, 0.8]), np.array([-1.3, -0.4]))


def rods_from_angles(angles, rates, params):
    """The masses' positions and velocities, from both angles and their rates."""
    lengths = jnp.stack([params["l1"], params["l2"]])
    rods = jnp.stack([lengths * jnp.sin(angles), -lengths * jnp.cos(angles)], axis=1)
    moves = jnp.stack([lengths * jnp.cos(angles) * rates, lengths * jnp.sin(angles) * rates], axis=1)
    masses = lambda ends: {"first": ends[0], "second": ends[0] + ends[1]}
    return masses(rods), masses(moves)
