"""A particle sliding down a wedge that slides on the floor (Goldstein, Exercise 2-20; source §5).

Coordinates X of the wedge's top corner, x and y of the particle, y pointing down. One constraint keeps
the particle on the incline of angle α; its multiplier is the normal force from wedge to particle:

    L = ½ m (ẋ² + ẏ²) + ½ M Ẋ² + m g y                       (14)
    f = (x - X) sin α - y cos α = 0

    m ẍ = λ sin α,    m ÿ = m g - λ cos α,    M Ẍ = -λ sin α

With D = M + m sin²α all accelerations are constant:

    ẍ = M g sin α cos α / D,    ÿ = (M + m) g sin²α / D,    Ẍ = -m g sin α cos α / D,    λ = m M g cos α / D
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.display import plots
from lagjax.integrate import integrate
from lagjax.mechanics import accelerations
from lagjax.report import FULL, QUICK, Case, Run, Scene, relative_error
from lagjax.sweep import sweep
from lagjax.system import Holonomic, System

PARAMS = {"m": 1.5, "M": 4.0, "alpha": 0.5, "g": 9.8125}
Q0 = {"X": 0.0, "x": 0.0, "y": 0.0}
V0 = {"X": 0.0, "x": 0.0, "y": 0.0}

MISPRINTS = (
    "§5 prints dW_m/dt = +λ g t sin²α cos α (m/M)/(1 + (m/M) sin²α): the sign is minus, the wedge recedes.",
    "§5 prints dW_M/dt = N·V = -...: the force on the wedge is -N, so dW_M/dt = +..., the wedge's gain in ½MẊ².",
    "§5 prints a_y = a_x (1 + m/M) / tan α: it is a_x (1 + m/M) · tan α, else p_x is not conserved.",
    "§5 says that a_s approximates g sin α for M >> m: in the lab frame a_s = g sin α for every M; "
    "what tends to it is the acceleration along the wedge, (M + m) g sin α / D.",
)


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ m (ẋ² + ẏ²) + ½ M Ẋ² + m g y, Eq. (14)."""
    m, M, g = params["m"], params["M"], params["g"]
    return 0.5 * m * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * M * v["X"] ** 2 + m * g * q["y"]


def incline(t, q: PyTree, params: PyTree):
    """f = (x - X) sin α - y cos α: the particle is on the incline."""
    return (q["x"] - q["X"]) * jnp.sin(params["alpha"]) - q["y"] * jnp.cos(params["alpha"])


system = System(lagrangian, constraints={"incline": Holonomic(incline)})


class Exact(NamedTuple):
    """The constant accelerations and the normal force."""

    X: jax.Array
    x: jax.Array
    y: jax.Array
    incline: jax.Array
    along: jax.Array


def exact_accelerations(params: PyTree) -> Exact:
    """Ẍ, ẍ, ÿ, λ and the acceleration along the wedge in closed form, valid for M = 0, α = 0, α = π/2 too."""
    m, M, g = params["m"], params["M"], params["g"]
    s, c = jnp.sin(params["alpha"]), jnp.cos(params["alpha"])
    D = M + m * s**2
    return Exact(
        X=-m * g * s * c / D, x=M * g * s * c / D, y=(M + m) * g * s**2 / D, incline=m * M * g * c / D,
        along=(M + m) * g * s / D,
    )  # fmt: skip


def exact_motion(params: PyTree, q0: PyTree, v0: PyTree, t):
    """q(t) and v(t) from a state on the incline: uniform acceleration."""
    a = exact_accelerations(params)
    q = {k: q0[k] + v0[k] * t + 0.5 * getattr(a, k) * t**2 for k in q0}
    v = {k: v0[k] + getattr(a, k) * t for k in q0}
    return q, v


def start_on_incline(params: PyTree, X=0.0, X_rate=0.0, along=0.0, along_rate=0.0):
    """The state with the particle at the distance `along` down the incline, with the relative speed `along_rate`."""
    s, c = np.sin(params["alpha"]), np.cos(params["alpha"])
    q = {"X": X, "x": X + along * c, "y": along * s}
    v = {"X": X_rate, "x": X_rate + along_rate * c, "y": along_rate * s}
    return q, v


def power_of_normal_force(params: PyTree, v: PyTree, multiplier):
    """The rate at which the constraint force does work on the particle and on the wedge, (P_m, P_M)."""
    s, c = jnp.sin(params["alpha"]), jnp.cos(params["alpha"])
    return multiplier * (v["x"] * s - v["y"] * c), -multiplier * v["X"] * s


def horizontal_momentum(params: PyTree, v: PyTree):
    """p_x = m ẋ + M Ẋ; with X eliminated, (m + M) ẋ - M ẏ / tan α."""
    return params["m"] * v["x"] + params["M"] * v["X"]


def runs():
    """From rest, and from a moving start."""
    ts = np.linspace(0.0, 0.75, 4)
    moving = start_on_incline(PARAMS, X=0.25, X_rate=0.5, along=0.125, along_rate=-0.75)
    return [_run("from rest", Q0, V0, ts), _run("thrown uphill", *moving, ts)]


def _run(name: str, q0: PyTree, v0: PyTree, ts):
    def error(trajectory):
        return relative_error((trajectory.q, trajectory.v), exact_motion(PARAMS, q0, v0, ts))

    words = "q and v against uniform acceleration"
    # Every method integrates uniform acceleration without error, so the run is not drawn.
    return Run(name, system, PARAMS, q0, v0, ts, error, words, drawn=False)


def cases(tier=FULL):
    """Mass ratios and angles at the ends of their ranges."""
    rows = []
    steep, flat = np.pi / 2 - 2.0**-30, 2.0**-30
    for name, change in (
        ("m/M = 2^-40", {"m": 2.0**-40, "M": 1.0}),
        ("m/M = 2^40", {"m": 2.0**40, "M": 1.0}),
        ("M = 0, massless wedge", {"M": 0.0}),
        ("alpha = 2^-30", {"alpha": flat}),
        ("alpha = pi/2 - 2^-30", {"alpha": steep}),
        ("alpha = 2^-20, m/M = 2^40", {"alpha": 2.0**-20, "m": 2.0**40, "M": 1.0}),
        ("alpha = pi/2", {"alpha": np.pi / 2}),
        ("alpha = 0", {"alpha": 0.0}),
    ):
        params = PARAMS | change
        a, multipliers = accelerations(system, 0.0, Q0, V0, params)
        exact = exact_accelerations(params)
        got = (a["X"], a["x"], a["y"], multipliers["incline"])
        rows.append(Case(name, "accelerations and normal force as in closed form", _worst(got, exact[:4]), 1e-12))
    rows += [_ratio_case()] if tier > QUICK else []
    return [*rows, _massless_case()] if tier == FULL else rows


def _massless_case():
    """A singular mass matrix, which compiles twice."""
    params, ts = PARAMS | {"M": 0.0}, np.linspace(0.0, 1000.0, 11)
    fall = integrate(system, Q0, V0, params, ts=ts, rtol=1e-10, atol=1e-10)
    error = relative_error((fall.q, fall.v), exact_motion(params, Q0, V0, ts))
    return Case("M = 0 for 1000 s", f"free fall; residual {float(fall.residual()):.0e}", error, 1e-9)


def _worst(got, exact):
    """The largest relative error of a single number: a tiny acceleration counts as much as a large one."""
    return max(abs(float(a) - float(b)) / (abs(float(b)) or 1.0) for a, b in zip(got, exact))


def over_mass_ratios(ratios, **settings):
    """Accelerations and normal force over m/M, as a sweep; m is that of `PARAMS`."""
    return sweep(_at_ratio, {"m_over_M": ratios}, progress=False, **settings)


def _at_ratio(point):
    a, multipliers = accelerations(system, 0.0, Q0, V0, PARAMS | {"M": PARAMS["m"] / point["m_over_M"]})
    return a | {"normal force": multipliers["incline"]}


def _ratio_case():
    # As many as in the picture: one program serves both.
    ratios = 2.0 ** np.linspace(-40, 40, 161)
    swept = over_mass_ratios(ratios)
    exact = exact_accelerations(PARAMS | {"M": PARAMS["m"] / ratios})
    got = [swept.values[name] for name in ("X", "x", "y", "normal force")]
    error = max(float(np.max(np.abs(a / b - 1))) for a, b in zip(got, exact))
    return Case("m/M = 2^-40 ... 2^40", f"a sweep, {swept.ok.sum()} of {ratios.size} as in closed form", error, 1e-12)


def picture(tier=FULL):
    """Accelerations over sixteen decades of the mass ratio: who moves, and how much."""
    ratios = np.logspace(-8, 8, 161)
    a = over_mass_ratios(ratios).values
    fig, axes = plots.figure(1, 2, size=(4.6, 3.4))
    g = PARAMS["g"]
    for i, (label, values) in enumerate({"particle, x": a["x"], "particle, y": a["y"], "wedge, X": a["X"]}.items()):
        axes[0, 0].semilogx(ratios, values / g, label=label, **plots.style(i))
    axes[0, 0].set(xlabel="m / M", ylabel="acceleration / g", title="Who moves")
    axes[0, 0].legend(fontsize=8, frameon=False)
    some, angles = (0.01, 0.375, 10.0, 1000.0), np.linspace(0.0, np.pi / 2, 91)
    for i, (ratio, force) in enumerate(zip(some, _normal_forces(np.array(some), angles))):
        axes[0, 1].plot(np.degrees(angles), force / (PARAMS["m"] * g), label=f"m/M = {ratio:g}", **plots.style(i))
    axes[0, 1].set(xlabel="angle of the incline / degrees", ylabel="normal force / (m g)", title="The multiplier")
    axes[0, 1].legend(fontsize=8, frameon=False)
    return fig


def _normal_forces(ratios, angles):
    def at(point):
        params = PARAMS | {"alpha": point["alpha"], "M": PARAMS["m"] / point["m_over_M"]}
        return accelerations(system, 0.0, Q0, V0, params)[1]["incline"]

    return sweep(at, {"m_over_M": ratios, "alpha": angles}, progress=False).values


SCENE = Scene(
    name="sliding_wedge",
    title="A particle on a sliding wedge",
    source="Goldstein, Classical Mechanics, Exercise 2-20; source document §5, Eq. (14)",
    misprints=MISPRINTS,
    runs=runs,
    cases=cases,
    picture=picture,
)
