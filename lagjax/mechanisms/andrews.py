"""Andrews' squeezing mechanism: seven rigid bodies in a plane, driven by a motor of constant torque.

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

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism
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
PARAMS = {
    "m": (0.04325, 0.00365, 0.02373, 0.00706, 0.07050, 0.00706, 0.05498),
    "I": (2.194e-6, 4.410e-7, 5.255e-6, 5.667e-7, 1.169e-5, 5.667e-7, 1.912e-5),
    "xa": -0.06934, "ya": -0.00227, "xb": -0.03635, "yb": 0.03273, "xc": 0.014, "yc": 0.072,
    "d": 0.028, "da": 0.0115, "e": 0.02, "ea": 0.01421, "rr": 0.007, "ra": 0.00092,
    "ss": 0.035, "sa": 0.01874, "sb": 0.01043, "sc": 0.018, "sd": 0.02, "ta": 0.02308, "tb": 0.00916,
    "u": 0.04, "ua": 0.01228, "ub": 0.00449, "zf": 0.02, "zt": 0.04, "fa": 0.01421,
    "c0": 4530.0, "l0": 0.07785, "mom": 0.033,
}  # fmt: skip


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Seven kinetic energies, one spring, one motor."""
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


system = System(lagrangian, {"loops": Holonomic(loops)})

MECHANISM = Mechanism(
    name="andrews",
    title="Andrews' squeezing mechanism",
    source="Hairer & Wanner, Solving ODEs II, §VII.7; Bari test set for IVP solvers, problem 'andrews'",
    system=system,
    params=PARAMS,
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
SOURCE_MULTIPLIERS = (
    (98.5668703962410896057654982170, -6.12268834425566265503114393122, 0.0, 0.0, 0.0, 0.0),
    (199.1753333731910, -29.75531228015052, 23.06654119098399, 31.45271365475927, 22.64249232082739, 11.61740700019673),
)
