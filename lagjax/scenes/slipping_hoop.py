"""The hoop that slips before it leaves: `rolling_hoop` with limited friction (source §2).

Before the hoop leaves, the friction that rolling needs exceeds what any coefficient allows (`rolling_hoop.MISPRINTS`).
With Coulomb friction of the coefficient μ the motion has phases,

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
from jaxtyping import PyTree
from scipy import optimize

from lagjax.display import plots
from lagjax.guards import releases, slips, sticks, touches
from lagjax.integrate import HybridTrajectory, integrate
from lagjax.report import FULL, QUICK, Case, Scene, relative_error
from lagjax.scenes import rolling_hoop
from lagjax.scenes.rolling_hoop import contact, in_flight, lagrangian, rolling
from lagjax.system import Holonomic, Hybrid, Switch, System

PARAMS = rolling_hoop.PARAMS | {"mu": 0.25}
# The angle at which a motion from rest at the top is started: at the top itself it would stay.
FIRST = 1.5


def friction(t, q: PyTree, v: PyTree, multipliers: PyTree, params: PyTree):
    """Q = μ λ (l, a) for (θ, φ): against a contact that slides downhill, f₂ < 0."""
    force = params["mu"] * multipliers["contact"]
    return {"r": 0.0, "theta": (params["R"] + params["a"]) * force, "phi": params["a"] * force}


def height(t, q: PyTree, params: PyTree):
    """The height of the hoop above the ground on which the cylinder lies."""
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


def roll_and_slip(params: PyTree, ts, **options) -> HybridTrajectory:
    """The motion from rest at the top, started at `FIRST` with the speed that it has there."""
    rate = rolling_hoop.exact_rate(params, FIRST, rolling_hoop.TOP)
    return _in_phases(*rolling_hoop.start(params, FIRST, rate), params, ts=ts, **options)


def _in_phases(*motion, **options) -> HybridTrajectory:
    traj = integrate(hybrid, *motion, **options)
    assert isinstance(traj, HybridTrajectory)
    return traj


class WithFriction(NamedTuple):
    """The angles at which the hoop slips and leaves; its speed and spin as it leaves, and where it lands."""

    slips: float
    leaves: float
    speed: float
    spin: float
    lands: float


def exact(params: PyTree) -> WithFriction:
    """From rest at the top; φ̇ by a quadrature of φ̈ = μ λ / (β m a), the rest in closed form."""
    mu, beta, g, a = (params[name] for name in ("mu", "beta", "g", "a"))
    l = params["R"] + a
    at_slip = _root(
        lambda x: beta * np.cos(x) - mu * ((3 + beta) * np.sin(x) - 2), np.arcsin(2 / (3 + beta)), np.pi / 2
    )

    def particular(x: np.ndarray):
        return ((4 * mu**2 - 2) * np.sin(x) - 6 * mu * np.cos(x)) / (1 + 4 * mu**2)

    off = 2 * (1 - np.sin(at_slip)) / (1 + beta) - particular(at_slip)

    def u(x: np.ndarray):
        return off * np.exp(-2 * mu * (x - at_slip)) + particular(x)

    leaves = _root(lambda x: u(x) - np.sin(x), 0.4, at_slip)
    speed = np.sqrt(l * g * u(leaves))
    # dφ̇/dθ = (μ λ / (β m a)) / θ̇, with λ = m g (sin θ - u) and θ̇ = -√(g u / l).
    nodes, weights = np.polynomial.legendre.leggauss(60)
    x = leaves + (at_slip - leaves) * (nodes + 1) / 2
    gained = mu * np.sqrt(g * l) / (beta * a) * (np.sin(x) - u(x)) / np.sqrt(u(x)) @ weights * (at_slip - leaves) / 2
    spin = np.sqrt(l * g * 2 * (1 - np.sin(at_slip)) / (1 + beta)) / a + gained
    down, fall = speed * np.cos(leaves), l * np.sin(leaves) + params["R"] - a
    flight = (-down + np.sqrt(down**2 + 2 * g * fall)) / g
    return WithFriction(at_slip, leaves, speed, spin, l * np.cos(leaves) + speed * np.sin(leaves) * flight)


def _root(function, low, high) -> float:
    """The root between two angles."""
    return float(np.asarray(optimize.brentq(function, low, high, xtol=1e-15)))


def seen(params: PyTree) -> WithFriction:
    """The same as `exact`, but by integration with rtol 1e-11."""
    switches = roll_and_slip(params, np.array([0.0, 3.0]), rtol=1e-11, estimate_error=False).switches
    (slip, left, down), rate = switches.q["theta"][:3], switches.v["theta"][1]
    spin, l = switches.v["phi"][1], params["R"] + params["a"]
    return WithFriction(*map(float, (slip, left, -l * rate, spin, switches.q["r"][2] * np.cos(down))))


def cases(tier=FULL):
    """Friction from weak to strong; a disk, a sphere, a shell; no friction; and too little to start rolling."""
    if tier == QUICK:
        return []
    many = {f"mu = {mu:g}": {"mu": mu} for mu in (0.0625, 0.25, 1.0, 4.0, 16.0)}
    many |= {f"a {name}, mu = 0.25": {"beta": rolling_hoop.SHAPES[name]} for name in ("disk", "sphere", "shell")}
    rows = []
    for name, changed in many.items():
        params = PARAMS | changed
        found, expected = seen(params), exact(params)
        angles = " and ".join(f"{word} at {np.degrees(x):.4f} deg" for word, x in zip(("slips", "leaves"), found[:2]))
        rows.append(Case(name, f"{angles}, lands at x = {found.lands:.6f}", relative_error(found, expected), 1e-9))
    # Starts in another phase, and a refusal with its diagnosis, are programs of their own.
    return [*rows, _without_friction(), _too_little_to_roll()] if tier == FULL else rows


def _without_friction():
    """The hoop slides from the top on, does not turn, and leaves when its height has fallen by a third."""
    params = PARAMS | {"mu": 0.0}
    rate = rolling_hoop.exact_rate(params | {"beta": 0.0}, FIRST, rolling_hoop.TOP)
    q, v = rolling_hoop.start(params, FIRST, rate)
    settings = {"ts": np.array([0.0, 3.0]), "rtol": 1e-11, "estimate_error": False}
    switches = _in_phases(q, v | {"phi": 0.0 * rate}, params, start="slips", **settings).switches
    sine, spin = np.sin(switches.q["theta"][0]), abs(float(switches.v["phi"][0]))
    happened = f"leaves at {np.degrees(np.arcsin(sine)):.4f} deg, and has not turned"
    return Case("mu = 0, sliding from the start", happened, max(relative_error(sine, 2 / 3), spin), 1e-9)


def _too_little_to_roll():
    name = "mu = 2^-10, rolling at the start"
    try:
        seen(PARAMS | {"mu": 2.0**-10})
    except (RuntimeError, ValueError) as error:
        return Case(name, "refused: " + str(error).split("\n")[0], 0.0, 0.0)
    return Case(name, "NOT REFUSED", np.inf, 0.0)


def picture(tier=FULL):
    """The angles of slipping and leaving over the friction coefficient, and how near to rolling the hoop still is; in
    `QUICK` without the integrated ones."""
    fig, axes = plots.figure(1, 2, size=(4.9, 3.8))
    lines, marks = np.geomspace(0.05, 20.0, 121), 2.0 ** np.arange(-4.0, 4.1, 0.5)
    marks = marks[:0] if tier == QUICK else marks
    curves, points = (
        WithFriction(*np.array([function(PARAMS | {"mu": mu}) for mu in many]).reshape(-1, len(WithFriction._fields)).T)
        for function, many in ((exact, lines), (seen, marks))
    )
    left, right = axes[0]
    for i, name in enumerate(("slips", "leaves")):
        left.semilogx(lines, np.degrees(getattr(curves, name)), label=f"{name}, closed form", **plots.style(i))
        left.semilogx(marks, np.degrees(getattr(points, name)), "o", color="black", markersize=4)
    for level, x, y, words in ((30.0, 0.06, 28.0, "friction without bound: 30°"), (41.81, 3.0, 42.6, "none: 41.81°")):
        left.axhline(level, color="0.5", linewidth=0.8)
        left.text(x, y, words, fontsize=9)
    left.set(xlabel="coefficient of friction μ", ylabel="θ / degrees", title="It slips, and then leaves", ylim=(26, 88))
    left.legend(fontsize=8, frameon=False)
    a = PARAMS["a"]
    right.semilogx(lines, a * curves.spin / curves.speed, label="closed form", **plots.style(0))
    label = "integrated" if len(marks) else None
    right.semilogx(marks, a * points.spin / points.speed, "o", color="black", markersize=4, label=label)
    right.set(
        xlabel="coefficient of friction μ", ylabel="a φ' / speed", title="How it turns when it leaves: 1 is rolling"
    )
    right.legend(fontsize=8, frameon=False)
    return fig


SCENE = Scene(
    name="slipping_hoop",
    title="The same hoop with friction: it rolls, slips, flies and lands",
    source="source document §2, with Coulomb friction instead of unlimited friction",
    misprints=rolling_hoop.MISPRINTS[1:2],
    runs=tuple,
    cases=cases,
    picture=picture,
)
