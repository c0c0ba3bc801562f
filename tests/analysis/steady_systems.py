"""Systems whose equilibria and critical parameters are known in closed form."""

import jax.numpy as jnp
import numpy as np

import lagjax as lj


def column_lagrangian(t, q, v, params):
    """Two links with springs at their joints, compressed by P; q are their angles from the vertical."""
    bending = 0.5 * params["c"] * (q[0] ** 2 + (q[1] - q[0]) ** 2)
    return 0.5 * jnp.sum(v**2) - bending - params["P"] * params["l"] * jnp.sum(jnp.cos(q))


# The values of P l / c at which the column buckles, the roots of 1 - 3 x + x² = 0.
BUCKLING = (3 - np.sqrt(5)) / 2, (3 + np.sqrt(5)) / 2


def forms_lagrangian(t, q, v, params):
    """A unit mass with the force b μ + e + (a μ - c) q - d q² - h q³ + 3/2 s √(1 - q): branches of all simple kinds."""
    mu, a, b, c, d, e, h, s = (params[name] for name in ("mu", *"abcdehs"))
    potential = (b * mu + e) * q + (a * mu - c) * q**2 / 2 - d * q**3 / 3 - h * q**4 / 4
    return 0.5 * v**2 + potential - s * jnp.sqrt(1.0 - q) ** 3


def top_lagrangian(t, q, v, params):
    """A symmetric top by two tilts, about x and then about the new y, and its spin; regular in the upright position."""
    a, b = q["a"], q["b"]
    across = 0.5 * params["I1"] * ((v["a"] * jnp.cos(b)) ** 2 + v["b"] ** 2)
    about = 0.5 * params["I3"] * (v["spin"] + v["a"] * jnp.sin(b)) ** 2
    return across + about - params["Mgl"] * jnp.cos(a) * jnp.cos(b)


def slowest_sleeping_spin(params):
    """ω_c = 2 √(M g l I1) / I3."""
    return 2 * jnp.sqrt(params["Mgl"] * params["I1"]) / params["I3"]


def ziegler_lagrangian(t, q, v, params):
    """Ziegler's column: two links of length l with 2 m at the joint and m at the tip, and springs c."""
    m, l = params["m"], params["l"]
    tip = v[0] ** 2 + v[1] ** 2 + 2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return m * (l * v[0]) ** 2 + 0.5 * m * l**2 * tip - 0.5 * params["c"] * (q[0] ** 2 + (q[1] - q[0]) ** 2)


def follower_force(t, q, v, params):
    """The force P at the tip, which always points along the outer link."""
    return params["P"] * params["l"] * jnp.stack([jnp.sin(q[0] - q[1]), 0.0 * q[1]])


def joint_friction(t, q, v, params):
    """The same damping in both joints."""
    return 0.5 * params["b"] * (v[0] ** 2 + (v[1] - v[0]) ** 2)


def flutter_load(params):
    """The flutter load without damping, P l / c = 7/2 - √2."""
    return (3.5 - jnp.sqrt(2.0)) * params["c"] / params["l"]


def damped_flutter_load(params):
    """The flutter load with damping, P l / c = 41/28 + b²/(2 m l² c), much smaller even for b → 0."""
    share = params["b"] ** 2 / (params["m"] * params["l"] ** 2 * params["c"])
    return (41 / 28 + 0.5 * share) * params["c"] / params["l"]


def conical_lagrangian(t, q, v, params):
    """A mass on a rod in three dimensions."""
    return 0.5 * v["r"] @ v["r"] - params["g"] * q["r"][2]


def rod_3d(t, q, params):
    """The squared length of the rod."""
    return q["r"] @ q["r"] - params["l"] ** 2


def about_z(q, params):
    """A rotation about the vertical at one radian per unit of time."""
    x, y, z = q["r"]
    return {"r": jnp.stack([-y, x, 0 * z])}


def rail_pendulum_lagrangian(t, q, v, params):
    """A spherical pendulum in a rotating frame, in Cartesian coordinates of the horizontal plane."""
    x, y = q
    u = jnp.stack([v[0] - params["omega"] * y, v[1] + params["omega"] * x])
    depth = jnp.sqrt(1 - x**2 - y**2)
    fall = -(x * v[0] + y * v[1]) / depth
    return 0.5 * (u @ u + fall**2) + params["g"] * depth


column = lj.System(column_lagrangian)
forms = lj.System(forms_lagrangian)
top = lj.System(top_lagrangian)
ziegler = lj.System(ziegler_lagrangian, force=follower_force)
damped_ziegler = lj.System(ziegler_lagrangian, force=follower_force, dissipation=joint_friction)
conical = lj.System(conical_lagrangian, {"rod": lj.Holonomic(rod_3d)})
turning_pendulum = lj.System(rail_pendulum_lagrangian)

COLUMN = {"c": 3.0, "l": 2.0, "P": 0.1}
# At μ = c/a: ±√((a μ - c)/h) branch off from 0, and (a μ - c)/d crosses it.
FORMS = {"mu": -1.0} | dict.fromkeys("abcdehs", 0.0)
PITCHFORK, EXCHANGE = FORMS | {"a": 1.25, "c": 0.5, "h": 2.0}, FORMS | {"a": 1.25, "c": 0.5, "d": 1.75}
# It folds where c + 3 h q² = 0; and it is lost at q = 1.
FOLDS, ENDS = FORMS | {"b": 1.25, "c": -0.5, "e": 0.0625, "h": 2.0}, FORMS | {"mu": 0.0, "b": 1.0, "c": 1.0, "s": 0.1}
TOP = {"I1": 2.0, "I3": 0.7, "Mgl": 3.0}
UPRIGHT = {"a": 0.0, "b": 0.0, "spin": 0.0}
ZIEGLER = {"m": 1.3, "l": 0.7, "c": 2.0, "b": 0.2, "P": 0.1}


def disk_lagrangian(t, q, v, params):
    """A thin uniform disk on a plane, by its centre, heading, lean and spin."""
    m, r, lean = params["m"], params["r"], q["lean"]
    across = v["lean"] ** 2 + (v["heading"] * jnp.cos(lean)) ** 2
    about = (v["spin"] + v["heading"] * jnp.sin(lean)) ** 2
    moving = v["x"] ** 2 + v["y"] ** 2 + (r * jnp.sin(lean) * v["lean"]) ** 2
    return m * r**2 * (across / 8 + about / 4) + 0.5 * m * moving - m * params["g"] * r * jnp.cos(lean)


def rolling(t, q, v, params):
    """The point of contact slides neither forward nor sideways."""
    r, cos, sin = params["r"], jnp.cos(q["heading"]), jnp.sin(q["heading"])
    forward = v["x"] * cos + v["y"] * sin - r * (v["spin"] + v["heading"] * jnp.sin(q["lean"]))
    sideways = v["y"] * cos - v["x"] * sin + r * jnp.cos(q["lean"]) * v["lean"]
    return jnp.stack([forward, sideways])


disk = lj.System(disk_lagrangian, {"rolling": lj.Nonholonomic(rolling)})
DISK = {"m": 2.0, "r": 0.6, "g": 9.8125}
UPRIGHT_DISK = {"x": 0.0, "y": 0.0, "heading": 0.0, "lean": 0.0, "spin": 0.0}


def straight_on(q, params):
    """Rolling along x at one radian per unit of time."""
    return UPRIGHT_DISK | {"spin": 1.0, "x": params["r"]}


def slowest_rolling(params):
    """The upright disk is stable if its spin is above √(g/(3 r))."""
    return jnp.sqrt(params["g"] / (3 * params["r"]))
