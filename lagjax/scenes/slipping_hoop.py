"""The hoop that slips before it leaves: what friction makes of `rolling_hoop` (source §2).

The friction that rolling needs grows beyond every coefficient before the hoop leaves (`rolling_hoop.MISPRINTS`). With
Coulomb's friction, coefficient μ, it is a motion in phases,

    rolls  ->  slips  ->  flies  ->  lies        f₂ < 0 while it slips, and friction is μ λ forward

From rest at the top, with u = l θ̇² / g:

    rolls until   β cos θ = μ [(3 + β) sin θ - 2],            u = 2 (1 - sin θ) / (1 + β)
    slips with    u' = -2 cos θ + 2 μ (sin θ - u),    so    u = C e^(-2 μ θ) + [(4 μ² - 2) sin θ - 6 μ cos θ]/(1 + 4 μ²)
    leaves at     u = sin θ,    between 30° (μ without bound, the hoop) and 41.81° (μ = 0)

and then its centre flies on a parabola, until it reaches the ground on which the cylinder lies.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy import optimize

from lagjax.mechanics.constraints import Holonomic
from lagjax.mechanics.hybrid import Hybrid, Switch
from lagjax.mechanics.system import System
from lagjax.motion.contacts import releases, slips, sticks, touches
from lagjax.motion.hybrid_trajectory import HybridTrajectory
from lagjax.motion.integrate import integrate
from lagjax.scenes import rolling_hoop
from lagjax.scenes.rolling_hoop import contact, in_flight, lagrangian, rolling

PARAMS = rolling_hoop.PARAMS | {"mu": 0.25}
# Where a motion from rest at the top is taken up: at the top itself it stays.
FIRST = 1.5


def friction(t, q, v, multipliers, params):
    """Q = μ λ (l, a) for (θ, φ): against a contact that slides downhill, f₂ < 0."""
    force = params["mu"] * multipliers["contact"]
    return {"r": 0.0, "theta": (params["R"] + params["a"]) * force, "phi": params["a"] * force}


def height(t, q, params):
    """Of the hoop above the ground on which the cylinder lies."""
    return q["r"] * jnp.sin(q["theta"]) + params["R"] - params["a"]


slipping = System(lagrangian, {"contact": Holonomic(contact)}, force=friction)
lying = System(lagrangian, {"ground": Holonomic(height)})
hybrid = Hybrid(
    {"rolls": rolling_hoop.system, "slips": slipping, "flies": in_flight, "lies": lying},
    [
        Switch("rolls", to="slips", when=slips("rolling", on="contact", coefficient=lambda p: p["mu"], side=1)),
        Switch("slips", to="rolls", when=sticks(lambda t, q, v, params: -rolling(t, q, v, params))),
        Switch("slips", to="flies", when=releases("contact")),
        Switch("flies", to="lies", when=touches(height)),
    ],
    most_switches=4,
)


def roll_and_slip(params, ts, **options) -> HybridTrajectory:
    """The motion from rest at the top, taken up at `FIRST` with the speed that it has there."""
    l, beta = params["R"] + params["a"], params["beta"]
    rate = -jnp.sqrt(2 * params["g"] * (1 - jnp.sin(FIRST)) / ((1 + beta) * l))
    traj = integrate(hybrid, *rolling_hoop.start(params, FIRST, rate), params, ts=ts, **options)
    assert isinstance(traj, HybridTrajectory)
    return traj


class Friction(NamedTuple):
    """In closed form: the angles at which it slips and leaves; speed and spin there, and where it lands."""

    slips: float
    leaves: float
    speed: float
    spin: float
    lands: float


def exact(params) -> Friction:
    """From rest at the top; φ̇ by a quadrature of φ̈ = μ λ / (β m a), the rest in closed form."""
    mu, beta, g, a = (params[name] for name in ("mu", "beta", "g", "a"))
    l = params["R"] + a
    at_slip = _root(
        lambda x: beta * np.cos(x) - mu * ((3 + beta) * np.sin(x) - 2), np.arcsin(2 / (3 + beta)), np.pi / 2
    )
    particular = lambda x: ((4 * mu**2 - 2) * np.sin(x) - 6 * mu * np.cos(x)) / (1 + 4 * mu**2)
    off = 2 * (1 - np.sin(at_slip)) / (1 + beta) - particular(at_slip)
    u = lambda x: off * np.exp(-2 * mu * (x - at_slip)) + particular(x)
    leaves = _root(lambda x: u(x) - np.sin(x), 0.4, at_slip)
    speed = np.sqrt(l * g * u(leaves))
    # dφ̇/dθ = (μ λ / (β m a)) / θ̇, with λ = m g (sin θ - u) and θ̇ = -√(g u / l).
    nodes, weights = np.polynomial.legendre.leggauss(60)
    x = leaves + (at_slip - leaves) * (nodes + 1) / 2
    gained = mu * np.sqrt(g * l) / (beta * a) * (np.sin(x) - u(x)) / np.sqrt(u(x)) @ weights * (at_slip - leaves) / 2
    spin = np.sqrt(l * g * 2 * (1 - np.sin(at_slip)) / (1 + beta)) / a + gained
    down, fall = speed * np.cos(leaves), l * np.sin(leaves) + params["R"] - a
    flight = (-down + np.sqrt(down**2 + 2 * g * fall)) / g
    return Friction(at_slip, leaves, speed, spin, l * np.cos(leaves) + speed * np.sin(leaves) * flight)


def _root(function, low, high) -> float:
    """The root between two angles."""
    return float(np.asarray(optimize.brentq(function, low, high, xtol=1e-15)))
