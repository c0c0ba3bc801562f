"""The slider-crank with a prescribed crank angle: driven by a time-dependent constraint, without any degree of freedom.

The bodies and hinges are those of `slider_crank.py`, and a motor turns the crank at the constant rate Ω:

    θ1 = Ω t

Seven equations for seven coordinates: the motion is kinematics. With θ = Ω t, sin θ2 = -ρ sin θ, ρ = l1/l2,

    x3 = l1 cos θ + l2 cos θ2,        ẋ3 = -Ω (l1 sin θ + l2 w sin θ2),     w = dθ2/dθ = -ρ cos θ / cos θ2

Only the motor's torque is unknown. It is the multiplier λ of the drive, and its power is

    λ Ω = d/dt (½ J Ω² + V)   so that   λ = ½ J'(Ω t) Ω² + V'(Ω t)

with J and V of `slider_crank.py`. The energy changes by this work, not by any dissipation.

Source: Simeon, *Math. Modelling of Systems* 2 (1996) 1, with a rigid rod: Ω = 150 rad/s, 0.1 s, no gravity there.
"""

import numpy as np
from jaxtyping import PyTree

from lagjax.mechanisms import slider_crank
from lagjax.mechanisms.mechanism import Mechanism
from lagjax.mechanisms.slider_crank import PlaneBody, SliderCrankParts
from lagjax.system import Holonomic, System

PARAMS = slider_crank.PARAMS | {"rate": 150.0}


def motor(t, q: PyTree, params: PyTree):
    """The crank's angle is Ω t."""
    return q.crank.angle - params["rate"] * t


system = System(slider_crank.lagrangian, {**slider_crank.system.constraints, "motor": Holonomic(motor)})


def exact(t, params: PyTree):
    """(q, v, torque) at times t, in NumPy."""
    m1, m2, m3, J2, l1, l2, g = (params[k] for k in ("m1", "m2", "m3", "J2", "l1", "l2", "g"))
    rate, angle = params["rate"], params["rate"] * np.asarray(t, float)
    s, c = np.sin(angle), np.cos(angle)
    s2 = -l1 / l2 * s
    c2 = np.sqrt(1 - s2**2)
    w = -l1 / l2 * c / c2
    dw = l1 / l2 * s / c2 + w**2 * s2 / c2
    # Velocities of the rod's centre and of the block along -x, per unit of rate, and their slopes in θ.
    centre, block = l1 * s + l2 * w * s2 / 2, l1 * s + l2 * w * s2
    d_centre, d_block = l1 * c + l2 * (dw * s2 + w**2 * c2) / 2, l1 * c + l2 * (dw * s2 + w**2 * c2)
    q = SliderCrankParts(
        crank=PlaneBody(l1 * c / 2, l1 * s / 2, angle),
        rod=PlaneBody(l1 * c + l2 * c2 / 2, l1 * s / 2, np.arcsin(s2)),
        block=l1 * c + l2 * c2,
    )
    v = SliderCrankParts(
        crank=PlaneBody(-rate * l1 * s / 2, rate * l1 * c / 2, rate * np.ones_like(angle)),
        rod=PlaneBody(-rate * centre, rate * l1 * c / 2, rate * w),
        block=-rate * block,
    )
    half_slope = J2 * w * dw + m2 * (centre * d_centre - l1**2 * c * s / 4) + m3 * block * d_block
    return q, v, half_slope * rate**2 + (m1 + m2) * g * l1 * c / 2


MECHANISM = Mechanism(
    name="driven_crank",
    title="Slider-crank with a prescribed crank angle",
    source="Simeon, Math. Modelling of Systems 2 (1996) 1; Bari test set, problem 'crank' (masses and lengths)",
    system=system,
    params=PARAMS,
    q0=slider_crank.MECHANISM.q0,
    v0=slider_crank.MECHANISM.v0,
    end=0.1,
    freedom=0,
    reference=(
        SliderCrankParts(
            crank=PlaneBody(-0.0569765934644116, 0.04877158801178376, 15.0),
            rod=PlaneBody(0.02789649478674791, 0.04877158801178376, -0.33116391346483814),
            block=0.16974617650231902,
        ),
        SliderCrankParts(
            crank=PlaneBody(-7.315738201767564, -8.54648901966174, 150.0),
            rod=PlaneBody(-11.692972514256255, -8.54648901966174, 60.25032214593665),
            block=-8.754468624977381,
        ),
    ),
    origin="closed form",
    digits=14,
)
