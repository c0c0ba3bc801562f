"""Systems whose small motions are known in closed form, shared by several tests."""

import jax.numpy as jnp

import lagjax as lj


def bead_lagrangian(t, q, v, params):
    """A bead on a hoop that turns about its vertical diameter, by the angle from the bottom."""
    a, g, omega = params["a"], params["g"], params["omega"]
    return 0.5 * a**2 * (v**2 + (omega * jnp.sin(q)) ** 2) + g * a * jnp.cos(q)


def chain_lagrangian(t, q, v, params):
    """Equal masses in a row, connected by springs to each other and to two walls."""
    ends = jnp.concatenate([jnp.zeros(1, q.dtype), q, jnp.zeros(1, q.dtype)])
    return 0.5 * params["m"] * jnp.sum(v**2) - 0.5 * params["k"] * jnp.sum(jnp.diff(ends) ** 2)


def free_chain_lagrangian(t, q, v, params):
    """The chain without walls."""
    return 0.5 * params["m"] * jnp.sum(v**2) - 0.5 * params["k"] * jnp.sum(jnp.diff(q) ** 2)


def spherical_lagrangian(t, q, v, params):
    """A spherical pendulum of unit mass, by the angle from the bottom and the azimuth."""
    length, g = params["l"], params["g"]
    kinetic = 0.5 * length**2 * (v["theta"] ** 2 + (jnp.sin(q["theta"]) * v["phi"]) ** 2)
    return kinetic + g * length * jnp.cos(q["theta"])


def plane_lagrangian(t, q, v, params):
    """A unit mass on two springs in a plane; circulatory force and dissipation are added below."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * (params["k1"] * q["x"] ** 2 + params["k2"] * q["y"] ** 2)


def follower(t, q, v, params):
    """A circulatory force."""
    return {"x": params["n"] * q["y"], "y": -params["n"] * q["x"]}


bead = lj.System(bead_lagrangian)
chain = lj.System(chain_lagrangian)
free_chain = lj.System(free_chain_lagrangian)
spherical = lj.System(spherical_lagrangian)
circulating = lj.System(
    plane_lagrangian,
    force=follower,
    dissipation=lambda t, q, v, params: 0.5 * params["c"] * (v["x"] ** 2 + v["y"] ** 2),
)
