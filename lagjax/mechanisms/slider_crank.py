"""The slider-crank: two rigid bodies and a block in a plane, each described by all of its own coordinates.

    crank   (x1, y1, θ1)   mass m1, inertia J1 about its centre, length l1, turns about O
    rod     (x2, y2, θ2)   mass m2, inertia J2, length l2, hinged to the crank's end and to the block
    block   x3             mass m3, slides along y = 0

    L = Σ ½ m_i (ẋ_i² + ẏ_i²) + ½ J_i θ̇_i² - m_i g y_i

Seven coordinates, six equations, two for each hinge (r(θ) is the unit vector at θ):

    crank at O:     (x1, y1) = ½ l1 r(θ1)
    rod on crank:   (x2, y2) - ½ l2 r(θ2) = (x1, y1) + ½ l1 r(θ1)
    block on rod:   (x3, 0) = (x2, y2) + ½ l2 r(θ2)

One degree of freedom is left. With sin θ2 = -ρ sin θ1, ρ = l1/l2, and w = dθ2/dθ1 = -ρ cos θ1 / cos θ2,

    ½ J(θ1) θ̇1² + V(θ1) = E,     J θ̈1 + ½ J' θ̇1² + V' = 0

    J = J1 + m1 l1²/4 + J2 w² + m2 [(l1 sin θ1 + ½ l2 w sin θ2)² + ¼ l1² cos² θ1] + m3 (l1 sin θ1 + l2 w sin θ2)²
    V = ½ (m1 + m2) g l1 sin θ1

This equation gives the reference. Masses and lengths are those of Simeon's slider-crank (with an elastic rod, a driven
crank and no gravity); here it starts at the same speed and then moves freely.

Source: Simeon, *Math. Modelling of Systems* 2 (1996) 1; Bari test set, problem "crank" (the numbers).
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism
from lagjax.system import Holonomic, System


class PlaneBody(NamedTuple):
    """Centre and angle of a body in a plane."""

    x: Float[Array, ""] | float
    y: Float[Array, ""] | float
    angle: Float[Array, ""] | float


class SliderCrankParts(NamedTuple):
    """The three bodies; the block has only x."""

    crank: PlaneBody
    rod: PlaneBody
    block: Float[Array, ""] | float


PARAMS = {
    "m1": 0.36, "m2": 0.151104, "m3": 0.075552, "J1": 0.002727, "J2": 0.0045339259, "l1": 0.15, "l2": 0.30, "g": 9.81,
}  # fmt: skip


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Two plane rigid bodies and a block, with gravity along -y."""
    m1, m2, m3, g = params["m1"], params["m2"], params["m3"], params["g"]
    crank = 0.5 * m1 * (v.crank.x**2 + v.crank.y**2) + 0.5 * params["J1"] * v.crank.angle**2
    rod = 0.5 * m2 * (v.rod.x**2 + v.rod.y**2) + 0.5 * params["J2"] * v.rod.angle**2
    return crank + rod + 0.5 * m3 * v.block**2 - g * (m1 * q.crank.y + m2 * q.rod.y)


def half(body, length):
    """The vector from the centre of a body to its far end."""
    return 0.5 * length * jnp.stack([jnp.cos(body.angle), jnp.sin(body.angle)])


def centre(body):
    """The centre of a body."""
    return jnp.stack([body.x, body.y])


def crank_at_origin(t, q: PyTree, params: PyTree):
    """The crank's near end stays at O."""
    return centre(q.crank) - half(q.crank, params["l1"])


def rod_on_crank(t, q: PyTree, params: PyTree):
    """The rod's near end is the crank's far end."""
    return centre(q.rod) - half(q.rod, params["l2"]) - centre(q.crank) - half(q.crank, params["l1"])


def block_on_rod(t, q: PyTree, params: PyTree):
    """The block is the rod's far end, and stays on y = 0."""
    return centre(q.rod) + half(q.rod, params["l2"]) - jnp.stack([q.block, jnp.zeros_like(q.block)])


system = System(
    lagrangian,
    {
        "crank_at_origin": Holonomic(crank_at_origin),
        "rod_on_crank": Holonomic(rod_on_crank),
        "block_on_rod": Holonomic(block_on_rod),
    },
)

MECHANISM = Mechanism(
    name="slider_crank",
    title="Slider-crank",
    source="Simeon, Math. Modelling of Systems 2 (1996) 1; Bari test set, problem 'crank' (masses and lengths)",
    system=system,
    params=PARAMS,
    # Crank and rod along the rail, the crank turning at 150 rad/s and so the rod at -ρ 150.
    q0=SliderCrankParts(crank=PlaneBody(0.075, 0.0, 0.0), rod=PlaneBody(0.3, 0.0, 0.0), block=0.45),
    v0=SliderCrankParts(crank=PlaneBody(0.0, 11.25, 150.0), rod=PlaneBody(0.0, 11.25, -75.0), block=0.0),
    end=0.1,
    freedom=1,
    reference=(
        SliderCrankParts(
            crank=PlaneBody(0.046498324604522266, 0.05884645961289837, 13.468452708896843),
            rod=PlaneBody(0.2309716258933242, 0.05884645961289837, -0.40314128439378855),
            block=0.3689466025776039,
        ),
        SliderCrankParts(
            crank=PlaneBody(-7.116416474761444, 5.62313256296388, 120.93193917823424),
            rod=PlaneBody(-16.63110436957618, 5.62313256296388, -40.7547274012662),
            block=-19.029375789629476,
        ),
    ),
    origin="SciPy's DOP853 at 3e-14 on the equation of θ1; the tests recompute it",
    digits=13,
)
