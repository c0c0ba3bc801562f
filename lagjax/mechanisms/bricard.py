"""The rectangular Bricard mechanism: six links and six hinges, mobile although the count of freedoms says it is not.

Five rods of length l and the ground form a closed chain. The two hinges of a link are at right angles to it and to
each other, and the handedness alternates along the chain. The start is six edges of a cube: P_0 = (0, 0, 0),
P_1 = (1, 0, 0), P_2 = (1, -1, 0), P_3 = (1, -1, 1), P_4 = (0, -1, 1), P_5 = (0, 0, 1), with the hinges' axes
u_0 ... u_5 along y, z, x, y, z, x. The rod i goes from P_i to P_(i+1), the ground from P_5 to P_0.

Natural coordinates: the points P_1 ... P_4 and the unit vectors u_1 ... u_4, 24 in all (both ends of the ground are
fixed). A rod is rigid with its two hinges fixed in it if for i = 0 ... 4

    |r_i|² = l²,    r_i·u_i = 0,    r_i·u_(i+1) = 0,    u_i·u_(i+1) = 0,    |u_i|² = 1 (i = 1 ... 4)

with r_i = P_(i+1) - P_i: 24 equations for 24 coordinates. Only 23 are independent: one, no particular one, follows from
the others, and one degree of freedom remains. Grübler's count for a spatial chain of six hinges gives none.

A rod of square section has a width a, and so a second moment m a²/12, along each of its two hinges' axes,

    L = Σ_i m (|Ṗ_i|² + Ṗ_i·Ṗ_(i+1) + |Ṗ_(i+1)|²)/6 + m a² (|u̇_i|² + |u̇_(i+1)|²)/24 - ½ m g (y_i + y_(i+1))

constant in the coordinates, and regular for a > 0.

Hinge angles: α_0 = α_2 = α_4 = θ and α_1 = α_3 = α_5 = φ, which turn r_(i-1) into r_i about u_i, close the chain if

    cos θ + cos φ + cos θ cos φ = 0

(`chain` builds it). This is a closed curve; the motion has one coordinate along it, which the tests integrate.

Source: González et al., *Multibody System Dynamics* 16 (2006) 179, and the IFToMM library, A04 (section 0.1 m:
Simbody's and Exudyn's models); Chen, You & Tarnai, *Int. J. Solids Struct.* 42 (2005) 2287 (closure).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism, rod_kinetic_energy, squared_distance
from lagjax.system import Holonomic, System


class Chain(NamedTuple):
    """Points and axes of the moving hinges, each (4, 3)."""

    points: Float[Array, "4 3"]
    axes: Float[Array, "4 3"]


PARAMS = {"m": 1.0, "l": 1.0, "a": 0.1, "g": 9.81}
# Handedness: u_(i+1) = HANDS[i] r_i × u_i / l, for the rods; the ground is left-handed.
HANDS = (1, -1, 1, -1, 1)


def closed(q: PyTree, params: PyTree):
    """All six points and axes, (6, 3) each, including those of the ground."""
    length = params["l"]
    first, last = jnp.zeros((1, 3), q.points.dtype), jnp.stack([0.0 * length, 0.0 * length, length])[None]
    points = jnp.concatenate([first, q.points, last])
    axes = jnp.concatenate([np.array([[0.0, 1.0, 0.0]]), q.axes, np.array([[1.0, 0.0, 0.0]])])
    return points, axes


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Five rods of square section."""
    m, a = params["m"], params["a"]
    ground = np.zeros((1, 3))
    moves = jnp.concatenate([ground, v.points, ground])
    points, _ = closed(q, params)
    along = jnp.sum(rod_kinetic_energy(m, moves[:-1], moves[1:]))
    # Each moving axis belongs to two rods.
    across = m * a**2 / 24 * 2 * jnp.sum(v.axes**2)
    return along + across - 0.5 * m * params["g"] * jnp.sum(points[:-1, 1] + points[1:, 1])


def lengths(t, q: PyTree, params: PyTree):
    """|r_i|² = l², (5,)."""
    points, _ = closed(q, params)
    return squared_distance(points[:-1], points[1:]) - params["l"] ** 2


def hinges_across_rods(t, q: PyTree, params: PyTree):
    """r_i·u_i = 0 and r_i·u_(i+1) = 0, (10,)."""
    points, axes = closed(q, params)
    rods = points[1:] - points[:-1]
    return jnp.concatenate([jnp.sum(rods * axes[:-1], axis=1), jnp.sum(rods * axes[1:], axis=1)])


def hinges_crossed(t, q: PyTree, params: PyTree):
    """u_i·u_(i+1) = 0 on each rod, (5,)."""
    _, axes = closed(q, params)
    return jnp.sum(axes[:-1] * axes[1:], axis=1)


def unit_axes(t, q: PyTree, params: PyTree):
    """|u_i|² = 1, (4,)."""
    return jnp.sum(q.axes**2, axis=1) - 1.0


def closure(theta, phi):
    """Zero if the chain with these hinge angles closes."""
    return jnp.cos(theta) + jnp.cos(phi) + jnp.cos(theta) * jnp.cos(phi)


def chain(theta, phi, params: PyTree):
    """The chain built from its hinge angles, starting at the ground: a `Chain`, and the resulting P_5 and u_5."""
    rod, axis, point = jnp.array([0.0, 0.0, -1.0]), jnp.array([0.0, 1.0, 0.0]), jnp.zeros(3)
    points, axes = [], []
    for i, hand in enumerate(HANDS):
        angle = theta if i % 2 == 0 else phi
        rod = jnp.cos(angle) * rod + jnp.sin(angle) * jnp.cross(axis, rod)
        axis = hand * jnp.cross(rod, axis)
        point = point + params["l"] * rod
        points.append(point)
        axes.append(axis)
    return Chain(jnp.stack(points[:4]), jnp.stack(axes[:4])), points[4], axes[4]


system = System(
    lagrangian,
    {
        "lengths": Holonomic(lengths),
        "hinges_across_rods": Holonomic(hinges_across_rods),
        "hinges_crossed": Holonomic(hinges_crossed),
        "unit_axes": Holonomic(unit_axes),
    },
)

MECHANISM = Mechanism(
    name="bricard",
    title="Rectangular Bricard mechanism",
    source="González et al., Multibody Syst. Dyn. 16 (2006) 179; IFToMM benchmark library, A04",
    system=system,
    params=PARAMS,
    q0=Chain(
        points=np.array([[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, -1.0, 1.0], [0.0, -1.0, 1.0]]),
        axes=np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    ),
    v0=Chain(points=np.zeros((4, 3)), axes=np.zeros((4, 3))),
    # The library uses 10 s, when it is almost at rest at the cube and has no velocity to compare.
    end=9.0,
    freedom=1,
    reference=(
        Chain(
            points=np.array(
                [
                    [0.5390642884948138, 0.0, -0.8422646216419043],
                    [0.29260958613772714, -0.8893691432776416, -0.45718981505015427],
                    [0.5390642884948141, -1.638453308240369, 0.15773537835809542],
                    [0.0, -0.8893691432776419, 0.5428101849498461],
                ]
            ),
            axes=np.array(
                [
                    [0.8422646216419043, 0.0, 0.5390642884948138],
                    [0.479427144430204, -0.4571898150501539, -0.7490841649627273],
                    [0.8422646216419043, 0.47942714443020407, 0.2464547023570869],
                    [0.0, -0.4571898150501546, 0.8893691432776415],
                ]
            ),
        ),
        Chain(
            points=np.array(
                [
                    [1.6947447523121018, 0.0, 1.084666683855869],
                    [1.092203909327236, -0.16428834928202965, 0.31958933388625],
                    [1.6947447523121029, 0.6620064657324634, 1.08466668385587],
                    [0.0, -0.16428834928202918, 0.31958933388625155],
                ]
            ),
            axes=np.array(
                [
                    [-1.084666683855869, 0.0, 1.6947447523121018],
                    [1.5958156705517976, 0.31958933388624977, 0.826294815014493],
                    [-1.0846666838558687, 1.5958156705517983, 0.6025408429848664],
                    [0.0, 0.319589333886249, 0.16428834928203218],
                ]
            ),
        ),
    ),
    origin="SciPy's DOP853 at 3e-14 on the curve of closed chains; the tests recompute it",
    digits=12,
)
