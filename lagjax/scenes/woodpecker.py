"""The woodpecker toy: a bird on a sleeve that jams on its pole, slips and falls, until the beak throws it back.

The bird hangs by a spring from a sleeve whose hole is a little wider than the pole. For small angles, with the height y
of the sleeve, its angle φ_M and that of the bird φ_S,

    T = ½ m_M y'² + ½ J_M φ_M'² + ½ m_S (y' + l_M φ_M' + l_G φ_S')² + ½ J_S φ_S'²
    V = m_M g y + m_S g (y + l_M φ_M + l_G φ_S) + ½ c (φ_M - φ_S)²

    beak      g = l_M + l_G - l_S - r_0 - h_S φ_S,    γ = y' + l_M φ_M' + (l_G - l_S) φ_S',    e = 0.5
    edges     g = r_M - r_0 ± h_M φ_M,                γ = y' + r_M φ_M',                       e = 0

The lower and the upper edge of the sleeve touch at opposite angles and slide in the same way, so they are one contact
here. Its gap is the product of their gaps divided by the width, which equals the gap of an edge where that gap closes.
The phases are

    falls    nothing touches
    slides   an edge slides down, and friction brakes it; rises: it slides up
    sticks   an edge is jammed

An edge that hits enters `slides`. If it does not slide down, this phase ends at once in `rises`, and from there in
`sticks`. The beak hits only while nothing else touches, as on the cycle. There is no phase for the beak hitting while
an edge touches, where both would share an impact; a negative `beak` reveals that case.

On the cycle the sleeve is jammed, slips (always at the same angle of the bird, since a jammed toy has one oscillation)
and falls; the upper edge hits and leaves, the beak hits, the upper edge hits again and rises for a while; the lower one
hits and leaves, hits again, slides for a third of the period, and jams. The angle at which the jammed bird turns
determines the next such angle: a one-dimensional map, whose fixed point is the cycle.

Source: Glocker, *Dynamik von Starrkörpersystemen mit Reibung und Stößen* (1995); Pfeiffer & Glocker, *Multibody
Dynamics with Unilateral Contacts* (1996); Leine, van Campen & Glocker, J. Vib. Control 9 (2003) 25.
"""

from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.guards import releases, slips, sticks, touches
from lagjax.integrate import HybridTrajectory, integrate
from lagjax.system import Holonomic, Hybrid, Nonholonomic, Switch, System

# From the source, in kg, m, s, N m/rad; the period on the cycle is 0.145976 s, and the sleeve falls by 19.445 mm.
PARAMS = {
    "m_M": 0.0003, "J_M": 5e-9, "m_S": 0.0045, "J_S": 7e-7, "c": 0.0056, "g": 9.81,
    "r_0": 0.0025, "r_M": 0.0031, "h_M": 0.0058, "l_M": 0.010, "l_G": 0.015, "h_S": 0.02, "l_S": 0.0201,
    "mu": 0.3,
}  # fmt: skip
RESTITUTION = 0.5
# The angle at which the bird of the jammed toy turns, on the cycle.
TURN = -0.5294719671108
# A cycle has thirteen switches, including those that end a phase at once.
MOST_SWITCHES = 24


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """The Lagrangian of the bird on its sleeve, for small angles."""
    bird = v["y"] + params["l_M"] * v["sleeve"] + params["l_G"] * v["bird"]
    height = q["y"] + params["l_M"] * q["sleeve"] + params["l_G"] * q["bird"]
    kinetic = params["m_M"] * v["y"] ** 2 + params["J_M"] * v["sleeve"] ** 2
    kinetic = 0.5 * (kinetic + params["m_S"] * bird**2 + params["J_S"] * v["bird"] ** 2)
    weight = params["g"] * (params["m_M"] * q["y"] + params["m_S"] * height)
    return kinetic - weight - 0.5 * params["c"] * (q["sleeve"] - q["bird"]) ** 2


def beak(t, q: PyTree, params: PyTree):
    """The distance of the beak from the pole."""
    return params["l_M"] + params["l_G"] - params["l_S"] - params["r_0"] - params["h_S"] * q["bird"]


def edges(t, q: PyTree, params: PyTree):
    """The distance of the nearer edge from the pole, valid if it is small."""
    width = params["r_M"] - params["r_0"]
    return (width**2 - (params["h_M"] * q["sleeve"]) ** 2) / (2 * width)


def sliding_beak(t, q: PyTree, v: PyTree, params: PyTree):
    """The upward velocity of the beak along the pole."""
    return v["y"] + params["l_M"] * v["sleeve"] + (params["l_G"] - params["l_S"]) * v["bird"]


def sliding(t, q: PyTree, v: PyTree, params: PyTree):
    """The upward velocity of an edge along the pole."""
    return v["y"] + params["r_M"] * v["sleeve"]


def coefficient(params: PyTree):
    """The coefficient of friction, the same for all contacts."""
    return params["mu"]


def friction(side, t, q: PyTree, v: PyTree, multipliers: PyTree, params: PyTree):
    """The friction on an edge that slides up (side 1) or down (side -1)."""
    force = -side * params["mu"] * multipliers["edges"]
    return {"y": force, "sleeve": params["r_M"] * force, "bird": 0.0}


falling = System(lagrangian)
sliding_down, sliding_up = (
    System(lagrangian, {"edges": Holonomic(edges)}, force=partial(friction, side)) for side in (-1, 1)
)
jammed = System(lagrangian, {"edges": Holonomic(edges), "grip": Nonholonomic(sliding)})
grip = partial(slips, "grip", on="edges", coefficient=coefficient)
hybrid = Hybrid(
    {"falls": falling, "slides": sliding_down, "rises": sliding_up, "sticks": jammed},
    [
        Switch("falls", to="falls", when=touches(beak, RESTITUTION, coefficient, sliding_beak)),
        Switch("falls", to="slides", when=touches(edges, 0.0, coefficient, sliding)),
        Switch("slides", to="falls", when=releases("edges")),
        Switch("slides", to="rises", when=sticks(lambda t, q, v, params: -sliding(t, q, v, params))),
        Switch("rises", to="falls", when=releases("edges")),
        Switch("rises", to="sticks", when=sticks(sliding)),
        Switch("sticks", to="falls", when=releases("edges")),
        Switch("sticks", to="slides", when=grip(side=1)),
        Switch("sticks", to="rises", when=grip(side=-1)),
    ],
    most_switches=MOST_SWITCHES,
)
# The number of the switch by which a jammed toy slips.
SLIPS = 7


def jammed_at(params: PyTree, bird):
    """A state at rest, jammed at the lower edge, with the bird at the angle `bird`."""
    q = {"y": 0.0, "sleeve": -(params["r_M"] - params["r_0"]) / params["h_M"], "bird": bird}
    return q, {"y": 0.0, "sleeve": 0.0, "bird": 0.0}


class Lap(NamedTuple):
    """From one slip of the jammed toy to the next: the time, and the change of the bird's speed and of the height."""

    period: Float[Array, ""]
    gained: Float[Array, ""]
    fallen: Float[Array, ""]


def motion(params: PyTree, ts, turn=TURN, **options) -> HybridTrajectory:
    """The motion of the jammed toy, starting where its bird turns."""
    traj = integrate(hybrid, *jammed_at(params, turn), params, ts=ts, start="sticks", **options)
    assert isinstance(traj, HybridTrajectory)
    return traj


def lap(traj: HybridTrajectory) -> Lap:
    """The lap of a motion with two slips, all zero if there are fewer; on the cycle the bird gains no speed."""
    switches = traj.switches
    of_slips = switches.way == SLIPS
    number = jnp.cumsum(of_slips)

    def between(x):
        first, second = (jnp.sum(jnp.where(of_slips & (number == k), x, 0.0)) for k in (1, 2))
        return second - first

    return Lap(between(switches.t), between(switches.v["bird"]), between(switches.q["y"]))
