"""N four-bar linkages in a row: uniform rods as a ladder of parallelograms that passes through singular positions.

N + 1 legs of length l stand side by side on A_i = (i l, 0); N couplers join their heads B_i:

    |B_i - A_i|² = l²  (i = 0 ... N),      |B_i - B_(i-1)|² = l²  (i = 1 ... N)

These are 2 (N + 1) coordinates and 2N + 1 equations: one degree of freedom. With uniform rods of mass m
(`mechanism.py`)

    L = Σ_legs (m |Ḃ_i|²/6 - ½ m g y_i)
      + Σ_couplers (m (|Ḃ_(i-1)|² + Ḃ_(i-1)·Ḃ_i + |Ḃ_i|²)/6 - ½ m g (y_(i-1) + y_i))

As long as it stays a ladder, all legs have the same angle φ, all B_i the velocity l φ̇, and

    (N + (N + 1)/3) l φ̈ = -(N + (N + 1)/2) g cos φ

which is a pendulum. When the legs are horizontal (φ = 0 or π) all rods are in one line: the rows of A are dependent,
and each four-bar could continue as an antiparallelogram, so there are N + 1 degrees of freedom at that instant.

Source: González, Dopico, Lugrís & Cuadrado, *Multibody System Dynamics* 16 (2006) 179, and the IFToMM library of
computational benchmark problems, A02 (N = 40 there; N = 2, as here, in OpenSim's collection of them).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.mechanisms.mechanism import Mechanism, rod_kinetic_energy, squared_distance
from lagjax.system import Holonomic, System

PARAMS = {"m": 1.0, "l": 1.0, "g": 9.81}


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """Legs and couplers, from the velocities of the heads B (N + 1, 2)."""
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


system = System(lagrangian, {"legs": Holonomic(legs), "couplers": Holonomic(couplers)})


def n_four_bar(windows: int, end: float = 10.0, head=None, velocity=None) -> Mechanism:
    """The benchmark with N = `windows`: legs upright, all heads at 1 m/s to the right.

    `head` and `velocity` are those of B_0 at `end`, if known; every other B_i is i lengths to the right of it.
    """
    heads = np.stack([np.arange(windows + 1.0), np.ones(windows + 1)], axis=1)
    return Mechanism(
        name="n_four_bar",
        title=f"{windows} four-bar linkages in a row",
        source="González et al., Multibody Syst. Dyn. 16 (2006) 179; IFToMM benchmark library, A02",
        system=system,
        params=PARAMS,
        q0=heads,
        v0=np.tile([1.0, 0.0], (windows + 1, 1)),
        end=end,
        freedom=1,
        reference=None if head is None else (heads + head - heads[0], np.tile(velocity, (windows + 1, 1))),
        origin="the pendulum's elliptic functions in mpmath; the tests recompute them",
        digits=15,
    )


MECHANISM = n_four_bar(
    2,
    head=(0.3284581115408156, 0.9445185381786009),
    velocity=(1.4230514702069446, -0.4948688454870435),
)
