"""The car axis: a rigid axle on two stiff springs, driven over a bumpy road. Stiff, and driven by its constraint.

The left wheel stands at (0, 0); the right one, at (x_b, y_b)(t), rolls over waves of height r:

    y_b = r sin ω t,    x_b = √(L² - y_b²)

Above each wheel a spring of stiffness 1/ε² and rest length L0 carries half of the car's mass M, at (xl, yl) and
(xr, yr). Two equations: the axle has length L, and the left spring stands at right angles to the road:

    (xl - xr)² + (yl - yr)² = L²,     xl x_b + yl y_b = 0

The source multiplies the equations by ε², and so do we (so its multipliers equal ours, including the sign):

    L = ½ k (ẋl² + ẏl² + ẋr² + ẏr²) - ½ (|l| - L0)² - ½ (|r| - L0)² - k g (yl + yr),    k = ½ M ε²

Source: Mazzia & Magherini, *Test Set for Initial Value Problem Solvers* (Bari), problem "caraxis".
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism
from lagjax.system import Holonomic, System


class AxleEnds(NamedTuple):
    """The two ends of the axle."""

    xl: Float[Array, ""] | float
    yl: Float[Array, ""] | float
    xr: Float[Array, ""] | float
    yr: Float[Array, ""] | float


PARAMS = {"M": 10.0, "epsilon": 0.01, "L": 1.0, "L0": 0.5, "r": 0.1, "omega": 10.0, "g": 1.0}


def road(t, params: PyTree):
    """The right wheel, (x_b, y_b) at time t."""
    height = params["r"] * jnp.sin(params["omega"] * t)
    return jnp.sqrt(params["L"] ** 2 - height**2), height


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Two half-masses on two springs; the right one stands on the moving wheel."""
    xb, yb = road(t, params)
    k = 0.5 * params["M"] * params["epsilon"] ** 2
    left = jnp.sqrt(q.xl**2 + q.yl**2)
    right = jnp.sqrt((q.xr - xb) ** 2 + (q.yr - yb) ** 2)
    kinetic = 0.5 * k * (v.xl**2 + v.yl**2 + v.xr**2 + v.yr**2)
    springs = 0.5 * (left - params["L0"]) ** 2 + 0.5 * (right - params["L0"]) ** 2
    return kinetic - springs - k * params["g"] * (q.yl + q.yr)


def upright(t, q: PyTree, params: PyTree):
    """The left spring stands at right angles to the road."""
    xb, yb = road(t, params)
    return q.xl * xb + q.yl * yb


def axle(t, q: PyTree, params: PyTree):
    """The axle's squared length."""
    return (q.xl - q.xr) ** 2 + (q.yl - q.yr) ** 2 - params["L"] ** 2


system = System(lagrangian, {"upright": Holonomic(upright), "axle": Holonomic(axle)})

MECHANISM = Mechanism(
    name="car_axis",
    title="Car axis",
    source="Bari test set for IVP solvers, problem 'caraxis'",
    system=system,
    params=PARAMS,
    q0=AxleEnds(0.0, 0.5, 1.0, 0.5),
    v0=AxleEnds(-0.5, 0.0, -0.5, 0.0),
    end=3.0,
    freedom=2,
    reference=(
        AxleEnds(
            0.0493455784275402809122,
            0.496989460230171153861,
            1.04174252488542151681,
            0.373911027265361256927,
        ),
        AxleEnds(
            -0.0770583684040972357970,
            0.00744686658723778553466,
            0.0175568157537232222276,
            0.770341043779251976443,
        ),
    ),
    origin="GAMD in quadruple precision (Bari test set); an older one (PSIDE) agrees to 1e-11",
    digits=15,
)
# λ(end) of the source: upright, axle.
SOURCE_MULTIPLIERS = (-0.00473688659084893324729, -0.00110468033125734368808)
