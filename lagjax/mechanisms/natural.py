"""Natural coordinates: a slender rod described by its two ends.

A uniform rod of mass m from P to Q has the velocity (1 - s) Ṗ + s Q̇ at the fraction s of its length, so

    T = ½ m ∫ |(1 - s) Ṗ + s Q̇|² ds = m (|Ṗ|² + Ṗ·Q̇ + |Q̇|²) / 6

The mass matrix is constant, so it is never recomputed, and constraints are at most quadratic.

Source: García de Jalón & Bayo, *Kinematic and Dynamic Simulation of Multibody Systems* (1994).
"""

import jax.numpy as jnp


def rod_kinetic_energy(mass, start, end):
    """T of a uniform rod from the velocities of its ends, (..., dimension) -> (...)."""
    squares = lambda x, y: jnp.sum(x * y, axis=-1)
    return mass * (squares(start, start) + squares(start, end) + squares(end, end)) / 6


def squared_distance(start, end):
    """|Q - P|², (..., dimension) -> (...)."""
    return jnp.sum((end - start) ** 2, axis=-1)
