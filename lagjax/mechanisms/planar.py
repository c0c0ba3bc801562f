"""Mechanisms in a plane: Andrews', slider-cranks, four-bar linkages, a car axis, a double pendulum.

The Lagrangian of each is derived in its docstring, in the symbols of the source.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism, rod_kinetic_energy, squared_distance
from lagjax.system import Holonomic, System


class Angles(NamedTuple):
    """The seven angles, or their rates, in the order of the source."""

    beta: Float[Array, ""] | float
    theta: Float[Array, ""] | float
    gamma: Float[Array, ""] | float
    phi: Float[Array, ""] | float
    delta: Float[Array, ""] | float
    omega: Float[Array, ""] | float
    epsilon: Float[Array, ""] | float


# Hairer & Wanner, §VII.7, in SI units.
ANDREWS_PARAMS = {
    "m": (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498),
    "I": (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5),
    "xa": -0.06934, "ya": -0.00227, "xb": -0.03635, "yb": 0.03273, "xc": 0.014, "yc": 0.072,
    "d": 0.028, "da": 0.0115, "e": 0.02, "ea": 0.01421, "rr": 0.007, "ra": 0.00092,
    "ss": 0.035, "sa": 0.01874, "sb": 0.01043, "sc": 0.018, "sd": 0.02, "ta": 0.02308, "tb": 0.00916,
    "u": 0.04, "ua": 0.01228, "ub": 0.00449, "zf": 0.02, "zt": 0.04, "fa": 0.01421,
    "c0": 4530.0, "l0": 0.07785, "mom": 0.033,
}  # fmt: skip


def andrews_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Seven kinetic energies, one spring, one motor.

    Andrews' squeezing mechanism: seven rigid bodies in a plane, driven by a motor of constant torque.

    Seven angles β, Θ, γ, Φ, δ, Ω, ε, all bodies coupled in three loops that meet in one point P:

        K1  crank     turns by β about O = (0, 0)
        K2  rod       turns by β + Θ, hinged to the crank's end rr (cos β, sin β); P is its far end
        K3  lever     turns by γ about B; a spring pulls its point D towards the fixed C
        K4, K5        links by Φ + δ and by δ about A
        K6, K7        links by Ω + ε and by ε about A

        P = rr (cos β, sin β) - d (cos(β + Θ), sin(β + Θ))
          = B + ss (sin γ, -cos γ)
          = A + zt (cos δ, sin δ) + e (sin(Φ + δ), -cos(Φ + δ))
          = A + u (sin ε, -cos ε) + zf (cos(Ω + ε), sin(Ω + ε))

        L = Σ (½ m_i |ṙ_i|² + ½ I_i ω_i²) - ½ c0 (|D - C| - l0)² + mom β

    r_i are the centres of mass. The motor's constant torque `mom` does the work `mom β`, so it stands in L as a
    potential and the Jacobi integral is conserved. Three closed loops in a plane: six equations, one degree of freedom.

    The multipliers of the sources have the other sign (they write M q̈ = f - Gᵀ λ).

    Source: Hairer & Wanner, *Solving ODEs II*, §VII.7; Schiehlen (ed.), *Multibody Systems Handbook* (1990);
    Mazzia & Magherini, *Test Set for Initial Value Problem Solvers* (Bari), problem "andrews".
    """
    p, (m1, m2, m3, m4, m5, m6, m7), (I1, I2, I3, I4, I5, I6, I7) = params, params["m"], params["I"]
    tail, pull = p["e"] - p["ea"], p["zf"] - p["fa"]
    # Angular velocities of the bodies that do not turn with one angle.
    rod, link4, link6 = v.beta + v.theta, v.phi + v.delta, v.omega + v.epsilon
    speed2 = (p["rr"] * v.beta) ** 2 + (p["da"] * rod) ** 2 - 2 * p["rr"] * p["da"] * v.beta * rod * jnp.cos(q.theta)
    speed4 = (p["zt"] * v.delta) ** 2 + (tail * link4) ** 2 + 2 * p["zt"] * tail * v.delta * link4 * jnp.sin(q.phi)
    speed6 = (p["u"] * v.epsilon) ** 2 + (pull * link6) ** 2 - 2 * p["u"] * pull * v.epsilon * link6 * jnp.sin(q.omega)
    kinetic = 0.5 * (
        (m1 * p["ra"] ** 2 + I1) * v.beta**2
        + (m2 * speed2 + I2 * rod**2)
        + (m3 * (p["sa"] ** 2 + p["sb"] ** 2) + I3) * v.gamma**2
        + (m4 * speed4 + I4 * link4**2)
        + (m5 * (p["ta"] ** 2 + p["tb"] ** 2) + I5) * v.delta**2
        + (m6 * speed6 + I6 * link6**2)
        + (m7 * (p["ua"] ** 2 + p["ub"] ** 2) + I7) * v.epsilon**2
    )
    spring_x = p["sd"] * jnp.cos(q.gamma) + p["sc"] * jnp.sin(q.gamma) + p["xb"] - p["xc"]
    spring_y = p["sd"] * jnp.sin(q.gamma) - p["sc"] * jnp.cos(q.gamma) + p["yb"] - p["yc"]
    stretch = jnp.sqrt(spring_x**2 + spring_y**2) - p["l0"]
    return kinetic - 0.5 * p["c0"] * stretch**2 + p["mom"] * q.beta


def loops(t, q: PyTree, params: PyTree):
    """The point P from crank and rod, minus P from each of the three other chains: six equations."""
    p = params
    rod, link4, link6 = q.beta + q.theta, q.phi + q.delta, q.omega + q.epsilon
    x = p["rr"] * jnp.cos(q.beta) - p["d"] * jnp.cos(rod)
    y = p["rr"] * jnp.sin(q.beta) - p["d"] * jnp.sin(rod)
    return jnp.stack(
        [
            x - p["ss"] * jnp.sin(q.gamma) - p["xb"],
            y + p["ss"] * jnp.cos(q.gamma) - p["yb"],
            x - p["e"] * jnp.sin(link4) - p["zt"] * jnp.cos(q.delta) - p["xa"],
            y + p["e"] * jnp.cos(link4) - p["zt"] * jnp.sin(q.delta) - p["ya"],
            x - p["zf"] * jnp.cos(link6) - p["u"] * jnp.sin(q.epsilon) - p["xa"],
            y - p["zf"] * jnp.sin(link6) + p["u"] * jnp.cos(q.epsilon) - p["ya"],
        ]
    )


andrews = Mechanism(
    name="andrews",
    title="Andrews' squeezing mechanism",
    source="Hairer & Wanner, Solving ODEs II, §VII.7; Bari test set for IVP solvers, problem 'andrews'",
    system=System(andrews_lagrangian, {"loops": Holonomic(loops)}),
    params=ANDREWS_PARAMS,
    q0=Angles(
        beta=-0.0617138900142764496358948458001,
        theta=0.0,
        gamma=0.455279819163070380255912382449,
        phi=0.222668390165885884674473185609,
        delta=0.487364979543842550225598953530,
        omega=-0.222668390165885884674473185609,
        epsilon=1.23054744454982119249735015568,
    ),
    v0=Angles(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    end=0.03,
    freedom=1,
    reference=(
        Angles(
            15.81077119629904,
            -15.75637105984298,
            0.04082224013073101,
            -0.5347301163226948,
            0.5244099658805304,
            0.5347301163226948,
            1.048080741042263,
        ),
        Angles(
            1139.920302151208,
            -1424.379294994111,
            11.03291221937134,
            19.29337464421385,
            0.5735699284790808,
            -19.29337464421385,
            0.3231791658026955,
        ),
    ),
    origin="PSIDE at tolerance 1e-14 (Bari test set); DOP853 on the printed equations differs by 4e-10",
    digits=9,
    # Against DOP853 at 1e-13 on the printed equations.
)
# λ(0) and λ(end) of the source, which writes -Gᵀ λ where lagjax writes +Aᵀ λ.
ANDREWS_MULTIPLIERS = (
    (98.5668703962410896057654982170, -6.12268834425566265503114393122, 0.0, 0.0, 0.0, 0.0),
    (199.1753333731910, -29.75531228015052, 23.06654119098399, 31.45271365475927, 22.64249232082739, 11.61740700019673),
)


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


SLIDER_CRANK_PARAMS = {
    "m1": 0.36, "m2": 0.151104, "m3": 0.075552, "J1": 0.002727, "J2": 0.0045339259, "l1": 0.15, "l2": 0.30, "g": 9.81,
}  # fmt: skip


def slider_crank_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Two plane rigid bodies and a block, with gravity along -y.

    The slider-crank: two rigid bodies and a block in a plane, each described by all of its own coordinates.

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

    This equation gives the reference. Masses and lengths are those of Simeon's slider-crank (with an elastic rod, a
    driven crank and no gravity); here it starts at the same speed and then moves freely.

    Source: Simeon, *Math. Modelling of Systems* 2 (1996) 1; Bari test set, problem "crank" (the numbers).
    """
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


slider_crank = Mechanism(
    name="slider_crank",
    title="Slider-crank",
    source="Simeon, Math. Modelling of Systems 2 (1996) 1; Bari test set, problem 'crank' (masses and lengths)",
    system=System(
        slider_crank_lagrangian,
        {
            "crank_at_origin": Holonomic(crank_at_origin),
            "rod_on_crank": Holonomic(rod_on_crank),
            "block_on_rod": Holonomic(block_on_rod),
        },
    ),
    params=SLIDER_CRANK_PARAMS,
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


DRIVEN_CRANK_PARAMS = SLIDER_CRANK_PARAMS | {"rate": 150.0}


def motor(t, q: PyTree, params: PyTree):
    """The crank's angle is Ω t.

    The slider-crank with a prescribed crank angle: driven by a time-dependent constraint, without any degree of
    freedom.

    The bodies and hinges are those of the slider-crank, and a motor turns the crank at the constant rate Ω:

        θ1 = Ω t

    Seven equations for seven coordinates: the motion is kinematics. With θ = Ω t, sin θ2 = -ρ sin θ, ρ = l1/l2,

        x3 = l1 cos θ + l2 cos θ2,        ẋ3 = -Ω (l1 sin θ + l2 w sin θ2),     w = dθ2/dθ = -ρ cos θ / cos θ2

    Only the motor's torque is unknown. It is the multiplier λ of the drive, and its power is

        λ Ω = d/dt (½ J Ω² + V)   so that   λ = ½ J'(Ω t) Ω² + V'(Ω t)

    with J and V of the slider-crank. The energy changes by this work, not by any dissipation.

    Source: Simeon, *Math. Modelling of Systems* 2 (1996) 1, with a rigid rod: Ω = 150 rad/s, 0.1 s, no gravity there.
    """
    return q.crank.angle - params["rate"] * t


def driven_crank_exact(t, params: PyTree):
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


driven_crank = Mechanism(
    name="driven_crank",
    title="Slider-crank with a prescribed crank angle",
    source="Simeon, Math. Modelling of Systems 2 (1996) 1; Bari test set, problem 'crank' (masses and lengths)",
    system=System(slider_crank.system.lagrangian, {**slider_crank.system.constraints, "motor": Holonomic(motor)}),
    params=DRIVEN_CRANK_PARAMS,
    q0=slider_crank.q0,
    v0=slider_crank.v0,
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


N_FOUR_BAR_PARAMS = {"m": 1.0, "l": 1.0, "g": 9.81}


def n_four_bar_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Legs and couplers, from the velocities of the heads B (N + 1, 2).

    N four-bar linkages in a row: uniform rods as a ladder of parallelograms that passes through singular positions.

    N + 1 legs of length l stand side by side on A_i = (i l, 0); N couplers join their heads B_i:

        |B_i - A_i|² = l²  (i = 0 ... N),      |B_i - B_(i-1)|² = l²  (i = 1 ... N)

    These are 2 (N + 1) coordinates and 2N + 1 equations: one degree of freedom. With uniform rods of mass m
    (`mechanism.py`)

        L = Σ_legs (m |Ḃ_i|²/6 - ½ m g y_i)
          + Σ_couplers (m (|Ḃ_(i-1)|² + Ḃ_(i-1)·Ḃ_i + |Ḃ_i|²)/6 - ½ m g (y_(i-1) + y_i))

    As long as it stays a ladder, all legs have the same angle φ, all B_i the velocity l φ̇, and

        (N + (N + 1)/3) l φ̈ = -(N + (N + 1)/2) g cos φ

    which is a pendulum. When the legs are horizontal (φ = 0 or π) all rods are in one line: the rows of A are
    dependent, and each four-bar could continue as an antiparallelogram, so there are N + 1 degrees of freedom at that
    instant.

    Source: González, Dopico, Lugrís & Cuadrado, *Multibody System Dynamics* 16 (2006) 179, and the IFToMM library of
    computational benchmark problems, A02 (N = 40 there; N = 2, as here, in OpenSim's collection of them).
    """
    m = params["m"]
    legs = jnp.sum(rod_kinetic_energy(m, jnp.zeros_like(v), v))
    couplers = jnp.sum(rod_kinetic_energy(m, v[:-1], v[1:]))
    height = 0.5 * jnp.sum(q[:, 1]) + 0.5 * jnp.sum(q[:-1, 1] + q[1:, 1])
    return legs + couplers - m * params["g"] * height


def legs(t, q: PyTree, params: PyTree):
    """Each head is one length from its foot, (N + 1,)."""
    feet = params["l"] * np.stack([np.arange(q.shape[0]), np.zeros(q.shape[0])], axis=1)
    return squared_distance(feet, q) - params["l"] ** 2


def couplers(t, q: PyTree, params: PyTree):
    """Neighbouring heads are one length apart, (N,)."""
    return squared_distance(q[:-1], q[1:]) - params["l"] ** 2


ladders = System(n_four_bar_lagrangian, {"legs": Holonomic(legs), "couplers": Holonomic(couplers)})


def four_bars(windows: int, end: float = 10.0, head=None, velocity=None) -> Mechanism:
    """The benchmark with N = `windows`: legs upright, all heads at 1 m/s to the right.

    `head` and `velocity` are those of B_0 at `end`, if known; every other B_i is i lengths to the right of it.
    """
    heads = np.stack([np.arange(windows + 1.0), np.ones(windows + 1)], axis=1)
    return Mechanism(
        name="n_four_bar",
        title=f"{windows} four-bar linkages in a row",
        source="González et al., Multibody Syst. Dyn. 16 (2006) 179; IFToMM benchmark library, A02",
        system=ladders,
        params=N_FOUR_BAR_PARAMS,
        q0=heads,
        v0=np.tile([1.0, 0.0], (windows + 1, 1)),
        end=end,
        freedom=1,
        reference=None if head is None else (heads + head - heads[0], np.tile(velocity, (windows + 1, 1))),
        origin="the pendulum's elliptic functions in mpmath; the tests recompute them",
        digits=15,
    )


n_four_bar = four_bars(
    2,
    head=(0.3284581115408156, 0.9445185381786009),
    velocity=(1.4230514702069446, -0.4948688454870435),
)


class AxleEnds(NamedTuple):
    """The two ends of the axle."""

    xl: Float[Array, ""] | float
    yl: Float[Array, ""] | float
    xr: Float[Array, ""] | float
    yr: Float[Array, ""] | float


CAR_AXIS_PARAMS = {"M": 10.0, "epsilon": 0.01, "L": 1.0, "L0": 0.5, "r": 0.1, "omega": 10.0, "g": 1.0}


def road(t, params: PyTree):
    """The right wheel, (x_b, y_b) at time t."""
    height = params["r"] * jnp.sin(params["omega"] * t)
    return jnp.sqrt(params["L"] ** 2 - height**2), height


def car_axis_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Two half-masses on two springs; the right one stands on the moving wheel.

    The car axis: a rigid axle on two stiff springs, driven over a bumpy road. Stiff, and driven by its constraint.

    The left wheel stands at (0, 0); the right one, at (x_b, y_b)(t), rolls over waves of height r:

        y_b = r sin ω t,    x_b = √(L² - y_b²)

    Above each wheel a spring of stiffness 1/ε² and rest length L0 carries half of the car's mass M, at (xl, yl) and
    (xr, yr). Two equations: the axle has length L, and the left spring stands at right angles to the road:

        (xl - xr)² + (yl - yr)² = L²,     xl x_b + yl y_b = 0

    The source multiplies the equations by ε², and so do we (so its multipliers equal ours, including the sign):

        L = ½ k (ẋl² + ẏl² + ẋr² + ẏr²) - ½ (|l| - L0)² - ½ (|r| - L0)² - k g (yl + yr),    k = ½ M ε²

    Source: Mazzia & Magherini, *Test Set for Initial Value Problem Solvers* (Bari), problem "caraxis".
    """
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


car_axis = Mechanism(
    name="car_axis",
    title="Car axis",
    source="Bari test set for IVP solvers, problem 'caraxis'",
    system=System(car_axis_lagrangian, {"upright": Holonomic(upright), "axle": Holonomic(axle)}),
    params=CAR_AXIS_PARAMS,
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
CAR_AXIS_MULTIPLIERS = (-0.00473688659084893324729, -0.00110468033125734368808)


class Masses(NamedTuple):
    """The two masses, (2,) each."""

    r1: Float[Array, "2"]
    r2: Float[Array, "2"]


DOUBLE_PENDULUM_PARAMS = {"m1": 1.0, "m2": 1.0, "l1": 1.0, "l2": 1.0, "g": 9.81}


def double_pendulum_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Two masses in a vertical plane.

    The plane double pendulum in Cartesian coordinates of its masses: two constant lengths, two degrees of freedom.

        L = ½ m1 |ṙ1|² + ½ m2 |ṙ2|² - g (m1 y1 + m2 y2),      |r1|² = l1²,    |r2 - r1|² = l2²

    In the angles from the vertical, Δ = θ1 - θ2, the equations that give the reference are

        (m1 + m2) l1 θ̈1 + m2 l2 θ̈2 cos Δ + m2 l2 θ̇2² sin Δ + (m1 + m2) g sin θ1 = 0
        l2 θ̈2 + l1 θ̈1 cos Δ - l1 θ̇1² sin Δ + g sin θ2 = 0

    It is released at rest with both rods horizontal.

    Source: Landau & Lifshitz, *Mechanics*, §5, Problem 1.
    """
    m1, m2, g = params["m1"], params["m2"], params["g"]
    return 0.5 * m1 * v.r1 @ v.r1 + 0.5 * m2 * v.r2 @ v.r2 - g * (m1 * q.r1[1] + m2 * q.r2[1])


def inner(t, q: PyTree, params: PyTree):
    """The first mass is l1 from the pivot."""
    return q.r1 @ q.r1 - params["l1"] ** 2


def outer(t, q: PyTree, params: PyTree):
    """The second mass is l2 from the first."""
    return squared_distance(q.r1, q.r2) - params["l2"] ** 2


double_pendulum = Mechanism(
    name="double_pendulum",
    title="Double pendulum in Cartesian coordinates",
    source="Landau & Lifshitz, Mechanics, §5, Problem 1",
    system=System(double_pendulum_lagrangian, {"inner": Holonomic(inner), "outer": Holonomic(outer)}),
    params=DOUBLE_PENDULUM_PARAMS,
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
