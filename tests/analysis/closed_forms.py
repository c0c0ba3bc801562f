"""Motions that are known, and systems that several tests of orbits share."""

import jax.numpy as jnp
import numpy as np
from scipy import special

import lagjax as lj
from tests.systems import PARAMS


def swinging(amplitude, params=PARAMS):
    """The pendulum's period, 4 √(l/g) K(sin²(amplitude/2))."""
    return 4 * np.sqrt(params["l"] / params["g"]) * special.ellipk(np.sin(amplitude / 2) ** 2)


def slope_of_swinging(amplitude, params=PARAMS):
    """Its derivative by the amplitude: dK/dm = (E - (1 - m) K) / (2 m (1 - m))."""
    m = np.sin(amplitude / 2) ** 2
    slope = (special.ellipe(m) - (1 - m) * special.ellipk(m)) / (2 * m * (1 - m))
    return 4 * np.sqrt(params["l"] / params["g"]) * slope * np.sin(amplitude) / 2


def kepler_lagrangian(t, q, v, p):
    """A unit mass attracted by -μ/r."""
    return 0.5 * v @ v + p["mu"] / jnp.sqrt(q @ q)


def duffing_lagrangian(t, q, v, p):
    """A hardening spring with a driving force."""
    return 0.5 * v**2 - 0.5 * q**2 - p["b"] * q**4 / 4 + p["f"] * q * jnp.cos(p["omega"] * t)


def spring_lagrangian(t, q, v, p):
    """A unit mass on a unit spring."""
    return 0.5 * v**2 - 0.5 * q**2


def mathieu_lagrangian(t, q, v, p):
    """x'' + (a - 2 q cos 2t) x = 0, a pendulum on a moving pivot near rest; and with large swings."""
    return 0.5 * v**2 + (p["a"] - 2 * p["q"] * jnp.cos(2 * t)) * jnp.cos(q)


kepler, mathieu = lj.System(kepler_lagrangian), lj.System(mathieu_lagrangian)
duffing = lj.System(duffing_lagrangian, dissipation=lambda t, q, v, p: 0.5 * p["c"] * v**2)
DUFFING = {"b": 0.75, "f": 0.3125, "omega": 1.25, "c": 0.125}
van_der_pol = lj.System(spring_lagrangian, force=lambda t, q, v, p: p["mu"] * (1 - q**2) * v)
# Its periods at μ = 1 and 2, to 16 digits in Andersen & Geer, SIAM J. Appl. Math. 42 (1982) 678, and Amore et al.,
# 2018; at 10: Urabe, *IRE Trans. Circuit Theory* 7 (1960) 382.
VAN_DER_POL = {1.0: 6.663286859323130, 2.0: 7.629874479674862, 10.0: 19.07836957}


def duffing_rate(p):
    """The driven spring's equation for SciPy."""
    return lambda t, y: [
        y[1], -y[0] - p["b"] * y[0] ** 3 - p["c"] * y[1] + p["f"] * np.cos(p["omega"] * t),
    ]  # fmt: skip
