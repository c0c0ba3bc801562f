"""Elliptic functions by the arithmetic-geometric mean: differentiable, no loss of digits near m = 0 or m = 1."""

import jax.numpy as jnp

# Enough for 1 - m down to 1e-150: the mean converges quadratically once the ratio is of order one.
AGM_STEPS = 12


def agm(a, b):
    """The arithmetic-geometric mean of two positive numbers."""
    for _ in range(AGM_STEPS):
        a, b = 0.5 * (a + b), jnp.sqrt(a * b)
    return a


def jacobi_elliptic(u, m, m1):
    """sn, cn and dn of u for m < 1, given with its complement m1 = 1 - m > 0 (Abramowitz & Stegun 16.4).

    Only m1 enters the recursion, so no digits are lost for m near 1; m may be negative.
    """
    a, b = jnp.ones_like(m1), jnp.sqrt(m1)
    ratios = []
    for _ in range(AGM_STEPS):
        a, b, c = 0.5 * (a + b), jnp.sqrt(a * b), 0.5 * (a - b)
        ratios.append(c / a)
    angle = 2.0**AGM_STEPS * a * u
    for ratio in reversed(ratios):
        angle = 0.5 * (angle + jnp.arcsin(ratio * jnp.sin(angle)))
    sn, cn = jnp.sin(angle), jnp.cos(angle)
    return sn, cn, jnp.sqrt(jnp.where(m < 0, 1 - m * sn**2, m1 + m * cn**2))
