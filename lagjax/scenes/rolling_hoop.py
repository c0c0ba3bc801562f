"""A hoop rolling on a cylinder until it falls off (Goldstein, Exercise 2-14; source §2).

Polar coordinates r, θ of the hoop's centre (θ from the horizontal, the axis of the cylinder is the origin)
and the hoop's own angle φ; moment of inertia I = β m a², β = 1 for the hoop (disk 1/2, ball 2/5, shell 2/3):

    L = ½ m (ṙ² + r² θ̇²) + ½ β m a² φ̇² - m g r sin θ
    f₁ = r - (R + a) = 0                         contact, multiplier λ: the normal force       (1)
    f₂ = (R + a) θ̇ + a φ̇ = 0                     rolling, multiplier μ: the friction force     (2)

With l = R + a and w² = g / ((1 + β) l), and after eliminating r and φ as the source does for β = 1:

    θ̈ = -w² cos θ,    θ̇² = θ̇₀² + 2 w² (sin θ₀ - sin θ)                                         (10), (11)
    λ = m g [(3 + β) sin θ - 2 sin θ₀] / (1 + β) - m l θ̇₀²,    μ = β m g cos θ / (1 + β)       (12)

The cylinder can push, not pull: the hoop leaves where λ = 0, a simple zero, at
sin θ_d = [2 sin θ₀ + (1 + β) l θ̇₀² / g] / (3 + β), that is 30° for the hoop from the top. The gap opens only
as t³ afterwards, so it is λ, not the distance, that shows the departure. Then the centre flies on a parabola.

θ̈ = -w² cos θ is a pendulum about the bottom. Released from rest at the tilt χ₀ = π/2 - θ₀ from the top, with
k = cos(χ₀/2), k' = sin(χ₀/2) and Jacobi's functions of w t and parameter k² (both arguments keep their digits):

    θ + π/2 = 2 atan2(k cn, k'),    θ̇ = -2 w k k' sn / dn

and with y = sin²(χ/2) the time to the tilt χ is a symmetric integral of Carlson's,

    t = (1/2w) ∫ dy / √(y (1 - y) (y - y₀))
      = (√(y - y₀) / w) R_F(y₀ (1 - y₀), y (1 - y₀), y₀ (1 - y))

which stays accurate for starts very close to the top, where the Legendre form cancels.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from scipy import special

from lagjax.display import plots
from lagjax.integrate import RESULTS, Crossing, integrate
from lagjax.mechanics import accelerations
from lagjax.report import FULL, QUICK, Case, Run, Scene, relative_error
from lagjax.scenes import by_hand
from lagjax.system import Holonomic, Nonholonomic, System

PARAMS = {"m": 1.25, "R": 1.0, "a": 0.25, "g": 9.8125, "beta": 1.0}
TOP = np.pi / 2
BOTTOM = -np.pi / 2
# I / (m a²) of the rolling bodies; the point slides without friction.
SHAPES = {"hoop": 1.0, "disk": 0.5, "sphere": 0.4, "shell": 2.0 / 3.0, "point": 0.0}

MISPRINTS = (
    "§2 says 'at the bottom, when θ = 0, a negative value': θ = 0 is the side, λ = -m g; the bottom is θ = -π/2, "
    "λ = -3 m g.",
    "§2 says that the hoop falls at θ = 30°: that is so for unlimited friction only. |μ|/λ grows beyond every "
    "coefficient of friction before λ = 0, so a real hoop slips first and leaves between 30° and 41.81°.",
    "§2 says 'starts from rest at the top': there it stays. (11) is the limit of starts ever nearer to the top.",
    "§2's 30° is measured from the horizontal, on the right side; on the left the hoop leaves at 150°, and from rest "
    "at θ₀ at sin θ_d = ½ sin θ₀.",
    "§2 writes Lagrange's equations with ∂f₁/∂q_j for the coordinate q_i: one index, i.",
)


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ m (ṙ² + r² θ̇²) + ½ β m a² φ̇² - m g r sin θ."""
    m, a, g = params["m"], params["a"], params["g"]
    centre = 0.5 * m * (v["r"] ** 2 + q["r"] ** 2 * v["theta"] ** 2)
    spin = 0.5 * params["beta"] * m * a**2 * v["phi"] ** 2
    return centre + spin - m * g * q["r"] * jnp.sin(q["theta"])


def contact(t, q: PyTree, params: PyTree):
    """f₁ = r - (R + a), Eq. (1)."""
    return q["r"] - (params["R"] + params["a"])


def rolling(t, q: PyTree, v: PyTree, params: PyTree):
    """f₂ = (R + a) θ̇ + a φ̇, Eq. (2)."""
    return (params["R"] + params["a"]) * v["theta"] + params["a"] * v["phi"]


system = System(lagrangian, constraints={"contact": Holonomic(contact), "rolling": Nonholonomic(rolling)})
in_flight = System(lagrangian)


# The hoop leaves when the normal force falls through zero.
DEPARTURE = {"departure": Crossing(lambda t, q, v, multipliers, params: multipliers["contact"], direction=-1)}


def start(params: PyTree, theta, theta_rate=0.0):
    """A rolling state at the angle `theta`, as (q, v)."""
    l, zero = params["R"] + params["a"], 0.0 * theta
    q = {"r": l + zero, "theta": theta, "phi": zero}
    v = {"r": zero, "theta": theta_rate + zero, "phi": -l / params["a"] * theta_rate + zero}
    return q, v


def roll(params: PyTree, theta, theta_rate, ts, **options):
    """Roll from `theta` until the normal force vanishes, or to the end of `ts`; return a `Trajectory`.

    **Raises:** `ValueError` if the hoop is not pressed against the cylinder at the start (the event finds zeros of λ,
    and would find none if λ is negative from the beginning).
    """
    q, v = start(params, theta, theta_rate)
    force = float(accelerations(system, ts[0], q, v, params)[1]["contact"])
    if force <= 0:
        raise ValueError(
            f"the hoop is not held by the cylinder at theta = {theta:.6g}, theta_rate = {theta_rate:.6g}: "
            f"the normal force is {force + 0.0:.6g}, so it is in flight from the start.\n"
            "Fix: start higher or slower, or integrate rolling_hoop.in_flight."
        )
    return integrate(system, q, v, params, ts=ts, events=DEPARTURE, **options)


class Multipliers(NamedTuple):
    """Normal force λ and friction force μ."""

    contact: jax.Array
    rolling: jax.Array


def rate(params: PyTree):
    """w = √(g / ((1 + β) (R + a))), the small-swing frequency about the bottom."""
    return jnp.sqrt(params["g"] / ((1 + params["beta"]) * (params["R"] + params["a"])))


def exact_rate(params: PyTree, theta, theta0, theta_rate0=0.0):
    """θ̇ of a hoop on its way down the right side, Eq. (11)."""
    return -jnp.sqrt(theta_rate0**2 + 2 * rate(params) ** 2 * (jnp.sin(theta0) - jnp.sin(theta)))


def exact_multipliers(params: PyTree, theta, theta0, theta_rate0=0.0) -> Multipliers:
    """λ and μ at θ, for a start at (θ₀, θ̇₀); Eq. (12) is the hoop from rest at the top."""
    m, g, beta = params["m"], params["g"], params["beta"]
    l = params["R"] + params["a"]
    normal = m * g * ((3 + beta) * jnp.sin(theta) - 2 * jnp.sin(theta0)) / (1 + beta) - m * l * theta_rate0**2
    return Multipliers(normal, beta * m * g * jnp.cos(theta) / (1 + beta))


def departure_sine(params: PyTree, theta0, theta_rate0=0.0):
    """sin θ_d; if it is not below sin θ₀, the hoop is in flight from the start."""
    beta, l = params["beta"], params["R"] + params["a"]
    return (2 * jnp.sin(theta0) + (1 + beta) * l * theta_rate0**2 / params["g"]) / (3 + beta)


def departure_time(params: PyTree, tilt):
    """The time from rest at `tilt` = π/2 - θ₀ > 0 to the departure, by Carlson's R_F."""
    y0 = np.sin(tilt / 2) ** 2
    y = (1 - 2 * np.cos(tilt) / (3 + np.asarray(params["beta"]))) / 2
    carlson = special.elliprf(y0 * (1 - y0), y * (1 - y0), y0 * (1 - y))
    return np.sqrt(y - y0) * carlson / np.asarray(rate(params))


def exact_motion(params: PyTree, theta0, t):
    """q(t) and v(t) of the hoop held to the cylinder, released from rest at θ₀ within (-π/2, π/2)."""
    w, ratio = float(rate(params)), (params["R"] + params["a"]) / params["a"]
    t = np.asarray(t)
    k, k_prime = np.sin((theta0 + TOP) / 2), np.cos((theta0 + TOP) / 2)
    sn, cn, dn, _ = special.ellipj(w * t, k**2)
    theta = 2 * np.arctan2(k * cn, k_prime) - TOP
    theta_rate = -2 * w * k * k_prime * sn / dn
    q = {"r": params["R"] + params["a"] + 0 * t, "theta": theta, "phi": -ratio * (theta - theta0)}
    return q, {"r": 0 * t, "theta": theta_rate, "phi": -ratio * theta_rate}


def period(params: PyTree, theta0):
    """The period of the hoop swinging about the bottom, released from rest at θ₀: 4 K(k²) / w."""
    return 4 * special.elliprf(0.0, np.cos((theta0 + TOP) / 2) ** 2, 1.0) / float(rate(params))


class Flight(NamedTuple):
    """The centre's position and velocity, and the spin φ̇, which is constant."""

    x: jax.Array
    y: jax.Array
    vx: jax.Array
    vy: jax.Array
    spin: jax.Array


def leaving(params: PyTree, theta0, theta_rate0=0.0) -> Flight:
    """The state at the departure on the right side, where (R + a) θ̇² = g sin θ."""
    l, sine = params["R"] + params["a"], departure_sine(params, theta0, theta_rate0)
    cosine, speed = jnp.sqrt(1 - sine**2), jnp.sqrt(params["g"] * l * sine)
    return Flight(l * cosine, l * sine, speed * sine, -speed * cosine, speed / params["a"])


def flight(params: PyTree, left: Flight, t) -> Flight:
    """The parabola, a time t after the departure."""
    g = params["g"]
    return left._replace(
        x=left.x + left.vx * t, y=left.y + left.vy * t - 0.5 * g * t**2, vx=left.vx + 0 * t, vy=left.vy - g * t
    )


def time_to_floor(params: PyTree, left: Flight):
    """How long the hoop flies before it lands on the floor on which the cylinder lies, y = -R + a."""
    drop = left.y + params["R"] - params["a"]
    return (left.vy + jnp.sqrt(left.vy**2 + 2 * params["g"] * drop)) / params["g"]


def flight_in_polar(left: Flight, params: PyTree):
    """A state of the flight in the coordinates of the Lagrangian, as (q, v)."""
    r = jnp.hypot(left.x, left.y)
    q = {"r": r, "theta": jnp.arctan2(left.y, left.x), "phi": 0.0}
    v = {
        "r": (left.x * left.vx + left.y * left.vy) / r,
        "theta": (left.x * left.vy - left.y * left.vx) / r**2,
        "phi": left.spin,
    }
    return q, v


def runs():
    """A hoop held to the cylinder, about the bottom; a hoop down to its departure; and the flight after it."""
    return [_about_the_bottom(BOTTOM + 1.0, periods=20, outputs=8), _down(1.25), _in_the_air()]


def _down(theta0):
    ts = np.array([0.0, 0.25, 0.5, 0.75, 1.5])
    until = departure_time(PARAMS, TOP - theta0)
    angle = np.arcsin(departure_sine(PARAMS, theta0))

    def error(trajectory):
        end = (trajectory.end.t, trajectory.end.q["theta"])
        attached = jax.tree.map(lambda x: x[:4], (trajectory.q, trajectory.v))
        return max(relative_error(attached, exact_motion(PARAMS, theta0, ts[:4])), relative_error(end, (until, angle)))

    q0, v0 = start(PARAMS, theta0)
    measured = "q, v, and the time and angle of the departure"
    return Run("until it leaves", system, PARAMS, q0, v0, ts, error, measured, events=DEPARTURE, drawn=False, tier=FULL)


def _in_the_air():
    left = leaving(PARAMS, TOP)
    ts = np.linspace(0.0, 0.25, 3)

    def error(trajectory):
        exact = flight_in_polar(flight(PARAMS, left, ts), PARAMS)
        exact[0]["phi"], exact[1]["phi"] = left.spin * ts, left.spin + 0 * ts
        return relative_error((trajectory.q, trajectory.v), exact)

    q0, v0 = flight_in_polar(left, PARAMS)
    words = "q and v against the parabola"
    return Run("in flight", in_flight, PARAMS, q0, v0, ts, error, words, drawn=False, tier=FULL)


def _about_the_bottom(theta0, periods, outputs):
    ts = np.linspace(0.0, periods * period(PARAMS, theta0), outputs)

    def error(trajectory):
        return relative_error((trajectory.q, trajectory.v), exact_motion(PARAMS, theta0, ts))

    q0, v0 = start(PARAMS, theta0)
    words = "q and v against Jacobi's functions"
    return Run(f"{periods} swings", system, PARAMS, q0, v0, ts, error, words, 1e-7, by_hand=by_hand.rolling)


def departure(start_of: tuple, until=10.0):
    """Roll from a start (β, θ₀, θ̇₀, tolerance) until departure or `until`: (t, θ, left?, θ on the way)."""
    beta, theta, theta_rate, tolerance = start_of
    params = PARAMS | {"beta": beta}
    rolled = integrate(
        system, *start(params, theta, theta_rate), params, ts=np.linspace(0.0, until, 41), rtol=tolerance,
        atol=tolerance, events=DEPARTURE, estimate_error=False,
    )  # fmt: skip
    left = rolled.result == RESULTS.event_occurred
    return float(rolled.end.t), float(rolled.end.q["theta"]), bool(left), np.asarray(rolled.q["theta"])


def cases(tier=FULL):
    """Starts near and on the top, on the other side, uphill, too fast; other bodies; a hundred swings."""
    if tier == QUICK:
        return [_no_inertia(), *_refusals()]
    starts = {
        # Projection onto the constraints needs some inertia in φ: 2^-40 replaces the point's 0.
        **{f"{name}, from rest at 1.25": (beta or 2.0**-40, 1.25, 0.0, 1e-10) for name, beta in SHAPES.items()},
        "on the left, from rest at pi - 1.25": (1.0, np.pi - 1.25, 0.0, 1e-10),
        "pushed downhill, rate -1.5": (1.0, 1.25, -1.5, 1e-10),
        "pushed uphill, over the top": (1.0, 1.25, 0.75, 1e-10),
        "from rest 2^-10 off the top": (1.0, TOP - 2.0**-10, 0.0, 1e-12),
        "from rest 2^-20 off the top": (1.0, TOP - 2.0**-20, 0.0, 1e-13),
    }
    rows = []
    for name, (beta, theta0, theta_rate0, tolerance) in starts.items():
        # One after another, by one short program: one of lanes would compile for three times as long.
        t, theta, left, _ = departure((beta, theta0, theta_rate0, tolerance))
        params = PARAMS | {"beta": beta}
        angle = float(np.arcsin(departure_sine(params, theta0, theta_rate0)))
        if theta0 > TOP or theta_rate0 > 0:
            angle = np.pi - angle
        error = abs(theta - angle) / angle
        if theta_rate0 == 0:
            time = departure_time(params, abs(TOP - theta0))
            error = max(error, abs(t - time) / time)
        happened = f"leaves at {np.degrees(angle):.4f} deg, t = {t:.6f}" if left else "DOES NOT LEAVE"
        rows.append(Case(name, happened, error, 1e-9))
    rows.append(_top())
    rows += [*_refusals(), _no_inertia()]
    return [*rows, _hundred_swings()] if tier == FULL else rows


def _top():
    """An equilibrium. The double nearest to π/2 is 6e-17 below it; this error grows like cosh(w t), to 1e-8 in 10 s."""
    _, theta, left, _ = departure((1.0, TOP, 0.0, 1e-10))
    off = np.inf if left else abs(theta - TOP)
    return Case("at rest on the top for 10 s", "stays; pi/2 is rounded, and that grows", off, 1e-7)


def _refusals():
    return [
        _refusal("too fast at the start, rate -3", 1.25, -3.0),
        _refusal("at rest on the side, theta = 0", 0.0, 0.0),
    ]


def _refusal(name: str, theta, theta_rate):
    try:
        roll(PARAMS, theta, theta_rate, np.array([0.0, 1.0]))
    except ValueError as error:
        return Case(name, "refused: " + str(error).split(": ", 1)[1].split("\n")[0], 0.0, 0.0)
    return Case(name, "NOT REFUSED", np.inf, 0.0)


def _no_inertia():
    """β = 0: the mass matrix is singular in φ, the equations are not."""
    params = PARAMS | {"beta": 0.0}
    a, multipliers = accelerations(system, 0.0, *start(params, 1.25), params)
    exact = exact_multipliers(params, 1.25, 1.25)
    got = (a["theta"], multipliers["contact"], multipliers["rolling"] / exact.contact)
    error = relative_error(got, (-(rate(params) ** 2) * np.cos(1.25), exact.contact, 0.0))
    return Case("beta = 0, no moment of inertia", "no friction force; forces as in closed form", error, 1e-12)


def _hundred_swings():
    run = _about_the_bottom(BOTTOM + 1.0, periods=100, outputs=801)
    swings = integrate(system, run.q0, run.v0, PARAMS, ts=run.ts, rtol=1e-10, atol=1e-10)
    off, drift = run.error(swings), float(swings.drift())
    happened = f"worst residual (the error here); q and v off by {off:.0e}, energy by {drift:.0e}"
    return Case("100 swings about the bottom", happened, float(swings.residual()), 1e-12)


def picture(tier=FULL):
    """The path of the hoop, and why it leaves: the normal force of five bodies, and the friction that rolling needs."""
    fig, axes = plots.figure(1, 2, size=(4.9, 4.0))
    _draw_path(axes[0, 0])
    axis, weight = axes[0, 1], PARAMS["m"] * PARAMS["g"]
    theta = np.linspace(TOP, np.radians(15.0), 151)
    for i, (name, beta) in enumerate(SHAPES.items()):
        params = PARAMS | {"beta": beta}
        leaves = np.degrees(np.arcsin(departure_sine(params, TOP)))
        force = exact_multipliers(params, theta, TOP).contact / weight
        axis.plot(np.degrees(theta), force, label=f"{name}, leaves at {leaves:.1f}°", **plots.style(i))
    friction = exact_multipliers(PARAMS, theta, TOP).rolling / weight
    axis.plot(np.degrees(theta), friction, label="friction on the hoop", **plots.style(5))
    axis.axhline(0.0, color="black", linewidth=0.8)
    axis.set(xlabel="θ / degrees", ylabel="force / (m g)", title="The multipliers, from rest at the top")
    axis.invert_xaxis()
    axis.legend(fontsize=8, frameon=False)
    return fig


def _draw_path(axis):
    theta0 = TOP - 2.0**-3
    time, last, _, theta = departure((1.0, theta0, 0.0, 1e-9), until=2.0)
    theta = np.append(theta[np.isfinite(theta)], last)
    l, a = PARAMS["R"] + PARAMS["a"], PARAMS["a"]
    around = np.linspace(0.0, 2 * np.pi, 181)
    axis.fill(np.cos(around), np.sin(around), facecolor="0.85", edgecolor="0.4")
    left = leaving(PARAMS, theta0)
    fall = flight(PARAMS, left, np.linspace(0.0, float(time_to_floor(PARAMS, left)), 31))
    axis.plot(l * np.cos(theta), l * np.sin(theta), label="rolling", **plots.style(0))
    axis.plot(fall.x, fall.y, label="flight", **plots.style(1))
    hoops = [(l * np.cos(x), l * np.sin(x), 0) for x in theta[:-1:7]]
    hoops += [(fall.x[i], fall.y[i], 1) for i in (0, 15, 30)]
    for x, y, i in hoops:
        axis.plot(x + a * np.cos(around), y + a * np.sin(around), color=plots.COLOURS[i], linewidth=0.9)
    axis.axhline(-1.0, color="0.4")
    axis.set(xlabel="x", ylabel="y", title=f"Leaves at t = {time:.4f}", aspect="equal", xlim=(-1.1, 2.1))
    axis.legend(fontsize=8, frameon=False)


SCENE = Scene(
    name="rolling_hoop",
    title="A hoop rolling on a cylinder",
    source="Goldstein, Classical Mechanics, Exercise 2-14; source document §2, Eq. (1)-(12)",
    misprints=MISPRINTS,
    runs=runs,
    cases=cases,
    picture=picture,
)
