"""Watt's flyball governor with stiff links: a freely turning shaft, two hinged rods with balls, and a slider.

The shaft turns by ψ about z. Two rods of mass m and length l are hinged to its top at

    A = (b e, h),    B = (-b e, h),     e = (cos ψ, sin ψ, 0)

in the plane that turns with it, with a ball of mass M at their far ends C and D. A slider of mass m_s slides along the
shaft at the height z and turns with it. A spring-damper (stiffness k, damping c, rest length l0) joins each
rod's middle to the slider at ±b e:

    L = ½ I ψ̇² + ½ m_s ż² + Σ [½ M |Ċ|² + m (|Ȧ|² + Ȧ·Ċ + |Ċ|²)/6]
        - g [m_s z + Σ (M z_C + ½ m (h + z_C))] - ½ k Σ (s - l0)²,          R = ½ c Σ ṡ²

with s the length of a spring and I the inertia of shaft and slider about the axis. ψ, z, C, D are eight coordinates;
each rod keeps its length and stays in the plane (n = (-sin ψ, cos ψ, 0)):

    |C - A|² = l²,    C·n = 0,        |D - B|² = l²,    D·n = 0

There are four degrees of freedom, two of which are not excited, by symmetry: with both rods at the angle α below the
horizontal, p = ∂L/∂ψ̇ is constant and the reference integrates two equations for (α, z). The springs' relaxation rate
is about c/m_s, 10⁴ times that of the motion. The rods are slender here (their section would add 10⁻⁶ of the inertia).

Source: González et al., *Multibody System Dynamics* 16 (2006) 179, and the IFToMM library, A05
(the hinges' offset b and the rods below the horizontal: as in Exudyn's model of it).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.mechanisms.mechanism import Mechanism, rod_kinetic_energy, squared_distance
from lagjax.system import Holonomic, System


class GovernorParts(NamedTuple):
    """The shaft's angle, the slider's height, and the two balls, (3,) each."""

    psi: Float[Array, ""] | float
    z: Float[Array, ""] | float
    C: Float[Array, "3"]
    D: Float[Array, "3"]


# Density 3000 kg/m³: shaft and rods 1 x 0.01 x 0.01 m, slider a cube of 0.1 m; `I` includes shaft and slider.
PARAMS = {
    "I": 0.3 * 0.01**2 / 6 + 3.0 * 0.1**2 / 6, "slider": 3.0, "rod": 0.3, "ball": 5.0, "l": 1.0, "b": 0.05, "h": 1.0,
    "k": 8e5, "c": 4e4, "l0": 0.5, "g": 9.81,
}  # fmt: skip


def frame(psi):
    """The unit vectors e, along the plane of the rods, and n, across it."""
    cos, sin, zero = jnp.cos(psi), jnp.sin(psi), jnp.zeros_like(psi)
    return jnp.stack([cos, sin, zero]), jnp.stack([-sin, cos, zero])


def rods(q: PyTree, params: PyTree):
    """(start, end) of both rods, (2, 3) each."""
    e, _ = frame(q.psi)
    top = jnp.stack([0.0 * params["h"], 0.0 * params["h"], params["h"]])
    return jnp.stack([top + params["b"] * e, top - params["b"] * e]), jnp.stack([q.C, q.D])


def springs(q: PyTree, params: PyTree):
    """The lengths of both springs, (2,)."""
    start, end = rods(q, params)
    e, _ = frame(q.psi)
    slider = jnp.stack([jnp.zeros_like(q.z), jnp.zeros_like(q.z), q.z])
    feet = jnp.stack([slider + params["b"] * e, slider - params["b"] * e])
    return jnp.sqrt(squared_distance(feet, 0.5 * (start + end)))


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Shaft and slider, two rods, two balls, gravity along -z, two springs."""
    p = params
    (start, end), (start_velocity, end_velocity) = jax.jvp(lambda q: rods(q, params), (q,), (v,))
    kinetic = 0.5 * p["I"] * v.psi**2 + 0.5 * p["slider"] * v.z**2
    kinetic += 0.5 * p["ball"] * jnp.sum(end_velocity**2)
    kinetic += jnp.sum(rod_kinetic_energy(p["rod"], start_velocity, end_velocity))
    heights = p["slider"] * q.z + jnp.sum(p["ball"] * end[:, 2] + 0.5 * p["rod"] * (start[:, 2] + end[:, 2]))
    return kinetic - p["g"] * heights - 0.5 * p["k"] * jnp.sum((springs(q, p) - p["l0"]) ** 2)


def dissipation(t, q: PyTree, v: PyTree, params: PyTree):
    """Rayleigh's function of the two dampers."""
    _, rates = jax.jvp(lambda q: springs(q, params), (q,), (v,))
    return 0.5 * params["c"] * jnp.sum(rates**2)


def rod_lengths(t, q: PyTree, params: PyTree):
    """Each ball is one length from its hinge, (2,)."""
    return squared_distance(*rods(q, params)) - params["l"] ** 2


def rod_planes(t, q: PyTree, params: PyTree):
    """Each ball is in the plane that turns with the shaft, (2,)."""
    _, n = frame(q.psi)
    return jnp.stack([q.C @ n, q.D @ n])


system = System(
    lagrangian, {"rod_lengths": Holonomic(rod_lengths), "rod_planes": Holonomic(rod_planes)}, dissipation=dissipation
)

# Rods 30 degrees below the horizontal, springs at their rest length, everything turning with the shaft at 2 π rad/s.
REACH = 0.05 + 0.5 * 3.0**0.5
RATE = 2 * np.pi

MECHANISM = Mechanism(
    name="governor",
    title="Stiff flyball governor",
    source="González et al., Multibody Syst. Dyn. 16 (2006) 179; IFToMM benchmark library, A05",
    system=system,
    params=PARAMS,
    q0=GovernorParts(psi=0.0, z=0.5, C=np.array([REACH, 0.0, 0.5]), D=np.array([-REACH, 0.0, 0.5])),
    v0=GovernorParts(psi=RATE, z=0.0, C=np.array([0.0, RATE * REACH, 0.0]), D=np.array([0.0, -RATE * REACH, 0.0])),
    end=10.0,
    freedom=4,
    reference=(
        GovernorParts(
            psi=55.93539999404147,
            z=0.6196198224120089,
            C=np.array([0.7972290289444487, -0.5610850470625497, 0.6197403232129428]),
            D=np.array([-0.7972290289444487, 0.5610850470625497, 0.6197403232129428]),
        ),
        GovernorParts(
            psi=5.548217317680775,
            z=-0.7476045185405928,
            C=np.array([2.8616156116529217, 4.6001380663079114, -0.7477370057722393]),
            D=np.array([-2.8616156116529217, -4.6001380663079114, -0.7477370057722393]),
        ),
    ),
    origin="SciPy's Radau at 1e-13 on the equations of α and z, DOP853 agrees; the tests recompute it",
    digits=12,
)
