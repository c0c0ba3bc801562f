"""Every system of the scenes with its equations written by hand and a state: the reference of
`against_hand_written.py`.

The equations are in `lagjax/scenes/by_hand.py`; the main job compares with them too.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.scenes import (
    bead_on_hoop,
    by_hand,
    cross_rails,
    mass_distributions,
    rolling_hoop,
    sliding_wedge,
    sphere_geodesic,
)


class Case(NamedTuple):
    """A system, its parameters, its right-hand side by hand, and the state near which it is evaluated."""

    name: str
    system: Any
    params: dict
    by_hand: Any
    q0: Any
    v0: Any


def wedge(t, q, v, params):
    """Constant accelerations: the scene's closed form."""
    exact = sliding_wedge.exact_accelerations(params)
    return {"X": exact.X, "x": exact.x, "y": exact.y}, {"incline": exact.incline}


def double_pendulum_lagrangian(t, q, v, params):
    """Two masses on two rods, angles from the vertical."""
    m1, m2, l1, l2, g = (params[name] for name in ("m1", "m2", "l1", "l2", "g"))
    kinetic = 0.5 * (m1 + m2) * (l1 * v["one"]) ** 2 + 0.5 * m2 * (l2 * v["two"]) ** 2
    kinetic += m2 * l1 * l2 * v["one"] * v["two"] * jnp.cos(q["one"] - q["two"])
    return kinetic + (m1 + m2) * g * l1 * jnp.cos(q["one"]) + m2 * g * l2 * jnp.cos(q["two"])


def double_pendulum(t, q, v, params):
    """The 2 x 2 system solved: its determinant is m2 (l1 l2)² (m1 + m2 sin²Δ), Δ = θ1 - θ2."""
    m1, m2, l1, l2, g = (params[name] for name in ("m1", "m2", "l1", "l2", "g"))
    s, c = jnp.sin(q["one"] - q["two"]), jnp.cos(q["one"] - q["two"])
    s1, s2 = g * jnp.sin(q["one"]), g * jnp.sin(q["two"])
    first, second, total = l1 * v["one"] ** 2, l2 * v["two"] ** 2, m1 + m2
    share = 1 / (m1 + m2 * s**2)
    one = (m2 * (s2 * c - s * (first * c + second)) - total * s1) * share / l1
    two = (total * (first * s + s1 * c - s2) + m2 * second * s * c) * share / l2
    return {"one": one, "two": two}, {}


CASES = (
    Case(
        "sphere_geodesic, over azimuth", sphere_geodesic.over_azimuth, sphere_geodesic.PARAMS,
        by_hand.geodesic, 1.25, 0.5,
    ),
    Case(
        "sphere_geodesic, embedded", sphere_geodesic.embedded, sphere_geodesic.PARAMS, by_hand.on_sphere,
        np.array([1.5, 0.0, 2.0]), np.array([0.0, 1.0, 0.0]),
    ),
    Case(
        "rolling_hoop", rolling_hoop.system, rolling_hoop.PARAMS, by_hand.rolling,
        *rolling_hoop.start(rolling_hoop.PARAMS, 1.25, -0.5),
    ),
    Case("bead_on_hoop", bead_on_hoop.system, bead_on_hoop.PARAMS, by_hand.bead, 1.0, 0.5),
    Case(
        "bead_on_hoop, driven", bead_on_hoop.driven_system, bead_on_hoop.PARAMS, by_hand.driven_bead,
        *bead_on_hoop.driven_start(bead_on_hoop.PARAMS, 1.0),
    ),
    *(
        Case(
            f"mass_distributions, {name}", mass_distributions.SYSTEMS[name], mass_distributions.PARAMS[name],
            by_hand.attracted(field), *mass_distributions.ORBITS[name][:2],
        )
        for name, field in by_hand.FIELDS.items()
    ),
    Case("sliding_wedge", sliding_wedge.system, sliding_wedge.PARAMS, wedge, sliding_wedge.Q0, sliding_wedge.V0),
    Case("cross_rails, lab", cross_rails.lab_system, cross_rails.PARAMS, by_hand.rails_in_the_lab,
         {"x": 1.0, "y": 0.125}, {"x": 0.25, "y": -0.5}),
    Case("cross_rails, rotating", cross_rails.rotating_system, cross_rails.PARAMS, by_hand.rails_rotating,
         cross_rails.Q0, cross_rails.V0),
)  # fmt: skip

DOUBLE_PENDULUM = Case(
    "double pendulum", lj.System(double_pendulum_lagrangian), {"m1": 1.0, "m2": 1.5, "l1": 1.0, "l2": 0.75, "g": 9.81},
    double_pendulum, {"one": 1.0, "two": 2.0}, {"one": 0.5, "two": -1.0},
)  # fmt: skip
