"""What test problems are made of: a `Mechanism`, and slender rods in natural coordinates, the positions of their ends.

A uniform rod of mass m from P to Q has the velocity (1 - s) Ṗ + s Q̇ at the fraction s of its length, so

    T = ½ m ∫ |(1 - s) Ṗ + s Q̇|² ds = m (|Ṗ|² + Ṗ·Q̇ + |Q̇|²) / 6

The mass matrix is constant, so it is never recomputed, and constraints are at most quadratic.

Source: García de Jalón & Bayo, *Kinematic and Dynamic Simulation of Multibody Systems* (1994).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array

from lagjax.system import System


def rod_kinetic_energy(mass, start, end):
    """T of a uniform rod from the velocities of its ends, (..., dimension) -> (...)."""

    def squares(x: Array, y: Array):
        return jnp.sum(x * y, axis=-1)

    return mass * (squares(start, start) + squares(start, end) + squares(end, end)) / 6


def squared_distance(start, end):
    """|Q - P|², (..., dimension) -> (...)."""
    return jnp.sum((end - start) ** 2, axis=-1)


@dataclass(frozen=True)
class Mechanism:
    """A mechanism with a known motion: what to integrate, and where it must end.

    - `name`, `title`, `source`: its names and its origin.
    - `system`, `params`, `q0`, `v0`, `end`: the motion from (q0, v0) at t = 0 to t = `end`.
    - `reference`: (q, v) at `end`, with the structure of (q0, v0), or None; `origin`: who computed it, and how;
      `digits`: how many of its digits are reliable, relative to the largest coordinate and the largest velocity.
    - `freedom`: degrees of freedom away from singular positions. Constraints beyond the number of coordinates minus
      this are redundant.
    """

    name: str
    title: str
    source: str
    system: System
    params: Mapping[str, Any]
    q0: Any
    v0: Any
    end: float
    freedom: int
    reference: tuple[Any, Any] | None = None
    origin: str = ""
    digits: int = 0
