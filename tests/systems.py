"""The reference systems: a fast test integrates only these, so that a worker compiles a program of each once.

lagjax shares a program between calls of the same meaning: the same equations, structure and shapes of `q`, `v` and
`params`, number of `ts`, method, names of options. Numbers (starts, parameters, times, tolerances) are its arguments.
So a test takes one of these systems with its own numbers and as many times as `TS`, or a motion that is here already.
"""

from functools import cache

import jax.numpy as jnp
import numpy as np

from lagjax import Contact, Holonomic, Nonholonomic, System, integrate


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


def driven_lagrangian(t, q, v, params):
    """A mass on a spring."""
    return 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2


driven = System(
    driven_lagrangian,
    force=lambda t, q, v, params: params["pull"] * jnp.cos(params["rate"] * t),
    dissipation=lambda t, q, v, params: 0.5 * params["c"] * v**2,
)
DRIVEN_PARAMS = {"m": 1.25, "k": 5.0, "c": 0.5, "pull": 2.0, "rate": 1.5}


def disk_lagrangian(t, q, v, params):
    """An upright disk on a plane, pulled along x."""
    moving = 0.5 * (v["x"] ** 2 + v["y"] ** 2) + 0.25 * (params["R"] * v["phi"]) ** 2
    return moving + 0.125 * (params["R"] * v["theta"]) ** 2 + params["pull"] * q["x"]


disk = System(
    disk_lagrangian,
    {
        "along": Nonholonomic(lambda t, q, v, p: v["x"] - p["R"] * v["phi"] * jnp.cos(q["theta"])),
        "across": Nonholonomic(lambda t, q, v, p: v["y"] - p["R"] * v["phi"] * jnp.sin(q["theta"])),
    },
)
DISK_PARAMS = {"R": 0.75, "pull": 0.5}
ROLLING = (
    {"phi": 0.25, "theta": 0.75, "x": 0.0, "y": 0.5},
    {"phi": 2.0, "theta": 0.5, "x": 1.5 * np.cos(0.75), "y": 1.5 * np.sin(0.75)},
)


def ball_lagrangian(t, q, v, params):
    """A ball above a level floor, by its height."""
    return 0.5 * params["m"] * v**2 - params["m"] * params["g"] * q


ball = System(ball_lagrangian, elements={"floor": Contact(lambda t, q, p: q, lambda p: p["e"])})
BALL_PARAMS = {"m": 1.5, "g": 9.8125, "e": 0.5}


@cache
def reference(name):
    """A reference system by name, with a start and parameters: (system, q0, v0, params)."""
    return {
        "pendulum": lambda: (pendulum, 1.0, 0.0, PARAMS),
        "rod pendulum": lambda: (rod_pendulum, *HORIZONTAL, PARAMS),
        "double pendulum": lambda: (double_pendulum, *DOUBLE_SWING, DOUBLE_PARAMS),
        "double rods": lambda: (double_rods, *rods_from_angles(*DOUBLE_SWING, DOUBLE_PARAMS), DOUBLE_PARAMS),
        "driven": lambda: (driven, 1.0, 0.0, DRIVEN_PARAMS),
        "disk": lambda: (disk, *ROLLING, DISK_PARAMS),
        "ball": lambda: (ball, 1.0, 0.0, BALL_PARAMS),
    }[name]()


@cache
def motion(name):
    """The motion of a reference system from its start, at `TS`; shared, not to be changed."""
    return integrate(*reference(name), ts=TS)
