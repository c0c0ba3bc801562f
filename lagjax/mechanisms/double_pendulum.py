"""The plane double pendulum in Cartesian coordinates of its masses: two constant lengths, two degrees of freedom.

    L = ½ m1 |ṙ1|² + ½ m2 |ṙ2|² - g (m1 y1 + m2 y2),      |r1|² = l1²,    |r2 - r1|² = l2²

In the angles from the vertical, Δ = θ1 - θ2, the equations that give the reference are

    (m1 + m2) l1 θ̈1 + m2 l2 θ̈2 cos Δ + m2 l2 θ̇2² sin Δ + (m1 + m2) g sin θ1 = 0
    l2 θ̈2 + l1 θ̈1 cos Δ - l1 θ̇1² sin Δ + g sin θ2 = 0

It is released at rest with both rods horizontal.

Source: Landau & Lifshitz, *Mechanics*, §5, Problem 1.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism, squared_distance
from lagjax.system import Holonomic, System


class Masses(NamedTuple):
    """The two masses, (2,) each."""

    r1: Float[Array, "2"]
    r2: Float[Array, "2"]


PARAMS = {"m1": 1.0, "m2": 1.0, "l1": 1.0, "l2": 1.0, "g": 9.81}


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Two masses in a vertical plane."""
    m1, m2, g = params["m1"], params["m2"], params["g"]
    return 0.5 * m1 * v.r1 @ v.r1 + 0.5 * m2 * v.r2 @ v.r2 - g * (m1 * q.r1[1] + m2 * q.r2[1])


def inner(t, q: PyTree, params: PyTree):
    """The first mass is l1 from the pivot."""
    return q.r1 @ q.r1 - params["l1"] ** 2


def outer(t, q: PyTree, params: PyTree):
    """The second mass is l2 from the first."""
    return squared_distance(q.r1, q.r2) - params["l2"] ** 2


system = System(lagrangian, {"inner": Holonomic(inner), "outer": Holonomic(outer)})

MECHANISM = Mechanism(
    name="double_pendulum",
    title="Double pendulum in Cartesian coordinates",
    source="Landau & Lifshitz, Mechanics, §5, Problem 1",
    system=system,
    params=PARAMS,
    q0=Masses(np.array([1.0, 0.0]), np.array([2.0, 0.0])),
    v0=Masses(np.zeros(2), np.zeros(2)),
    end=2.0,
    freedom=2,
    reference=(
        Masses(
            np.array([-0.4644128686995239, -0.8856188160751096]), np.array([-1.4341248174642822, -1.1298701956471695])
        ),
        Masses(np.array([2.7146768995930852, -1.4235592826715995]), np.array([3.435040543820057, -4.283503142503647])),
    ),
    origin="SciPy's DOP853 at 3e-14 on the equations of the angles; the tests recompute it",
    digits=12,
)
