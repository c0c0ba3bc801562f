"""A bead on a hoop that a motor turns about its vertical diameter (Goldstein, Exercise 2-18; source §3).

The angle ψ is counted from the bottom and signed, so that it passes through the bottom without a kink; θ is the
azimuth of the hoop. With ω0² = g/a and the hoop's angle prescribed, θ = ω t,

    L = ½ m a² ψ̇² + ½ m a² ω² sin²ψ + m g a cos ψ,    ψ̈ = sin ψ (ω² cos ψ - ω0²)              (13)

With θ kept as a coordinate and θ - ω t = 0 as its constraint, the multiplier is the motor's torque about the axis:

    τ = dL_z/dt = 2 m a² ω sin ψ cos ψ ψ̇,    ω τ = dE/dt,    h = E - ω L_z = constant,    L_z = m a² ω sin²ψ

Equilibria: the bottom (stable up to ω = ω0), the top (never), and above ω0 the tilt cos α = ω0²/ω²: a pitchfork.

Released from rest at ψ_m, x = tan(ψ/2) is elliptic. With s = sin(ψ_m/2), c = cos(ψ_m/2), G = ω0² - ω² c²:

    G > 0  through the bottom:  x = tan(ψ_m/2) cn(√D t | M/D),  m1 = c² G / D,       T = 4 K / √D
    G < 0  about α:             x = tan(ψ_m/2) dn(√M t | D/M),  m1 = -c² G / M,      T = 2 K / √M
    G = 0  homoclinic:          x = tan(ψ_m/2) sech(√(ω² - ω0²) t)

where D = G + ω² s² = ω0² - ω² cos ψ_m, M = s² (ω0² + ω² s²) and m1 = 1 - m. m1 is computed without cancellation, and
the arithmetic-geometric mean needs nothing else: K = π / (2 agm(1, √m1)). The second form holds for the inner turning
point (m < 0) and for the outer one.
"""

import functools
import warnings
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.branches import continue_equilibria
from lagjax.display import plots
from lagjax.integrate import EventWarning, integrate
from lagjax.mechanics import accelerations
from lagjax.report import FULL, QUICK, Case, Run, Scene, relative_error
from lagjax.scenes import by_hand
from lagjax.scenes.potentials import agm, jacobi_elliptic
from lagjax.sweep import sweep
from lagjax.system import Holonomic, System

PARAMS = {"m": 0.5, "a": 0.75, "g": 9.8125, "omega": 6.0}
# Exactly at the critical speed: g/a = 16 = omega².
CRITICAL = {"m": 0.5, "a": 0.75, "g": 12.0, "omega": 4.0}

MISPRINTS = (
    "§3 concludes from ∂L/∂ψ̇ ≠ 0 that p_ψ is not conserved: the reason is ∂L/∂ψ ≠ 0.",
    "§3 calls p_ψ proportional to L_z: p_ψ = m a² ψ̇ is the component along the horizontal normal of the hoop; "
    "L_z = m a² ω sin²ψ, and the motor's torque changes it.",
    "§3 asks that ω be not larger than ω0² = g/a for harmonic oscillation: it needs ω < ω0; at ω = ω0 the "
    "restoring force is cubic and the period grows as 10.488 / (ω0 ψ_m).",
    "§3 says that for a ω²/g < 1 the bead oscillates about the bottom unless it starts there at rest: it also stays "
    "at the top, circulates for h > m g a, and creeps to the top for h = m g a.",
    "§3 takes ω² >> a/g for fast rotation: it is ω² >> g/a (a/g has the unit s²).",
    "§3 says that the mass then stays in the center of the hoop: it stays at the center's height, on the rim, "
    "at the distance a from the axis.",
    "§3 rotates the hoop along a vertical diameter and refers three times to 'Eq. ??': about it, and to Eq. (13).",
)


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ m a² (ψ̇² + ω² sin²ψ) + m g a cos ψ, with q = ψ."""
    m, a, g, omega = params["m"], params["a"], params["g"], params["omega"]
    return 0.5 * m * a**2 * (v**2 + omega**2 * jnp.sin(q) ** 2) + m * g * a * jnp.cos(q)


def driven_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ m a² (ψ̇² + sin²ψ θ̇²) + m g a cos ψ."""
    m, a, g = params["m"], params["a"], params["g"]
    rate_squared = v["psi"] ** 2 + (jnp.sin(q["psi"]) * v["theta"]) ** 2
    return 0.5 * m * a**2 * rate_squared + m * g * a * jnp.cos(q["psi"])


def motor(t, q: PyTree, params: PyTree):
    """θ - ω t: the hoop's angle is prescribed. Its multiplier is the motor's torque."""
    return q["theta"] - params["omega"] * t


def friction(t, q: PyTree, v: PyTree, params: PyTree):
    """R = ½ b a² ψ̇²: the hoop drags the bead with the force -b a ψ̇ along it."""
    return 0.5 * params["b"] * (params["a"] * v) ** 2


system = System(lagrangian)
driven_system = System(driven_lagrangian, constraints={"motor": Holonomic(motor)})
damped_system = System(lagrangian, dissipation=friction)


class Balance(NamedTuple):
    """One state: energy, Jacobi integral, angular momenta, the motor's torque and power, normal forces."""

    E: jax.Array
    h: jax.Array
    L_z: jax.Array
    p_psi: jax.Array
    torque: jax.Array
    power: jax.Array
    radial: jax.Array
    sideways: jax.Array


def balance(params: PyTree, psi, psi_rate) -> Balance:
    """E, h, L_z, p_ψ, τ, ω τ, and the hoop's force on the bead outward and along increasing θ.

    The sideways force 2 m a ω cos ψ ψ̇ is τ / (a sin ψ), finite at the bottom, where τ vanishes.
    """
    m, a, g, omega = params["m"], params["a"], params["g"], params["omega"]
    s, c = jnp.sin(psi), jnp.cos(psi)
    L_z = m * a**2 * omega * s**2
    E = 0.5 * m * a**2 * (psi_rate**2 + (omega * s) ** 2) - m * g * a * c
    torque = 2 * m * a**2 * omega * s * c * psi_rate
    return Balance(
        E=E, h=E - omega * L_z, L_z=L_z, p_psi=m * a**2 * psi_rate, torque=torque, power=omega * torque,
        radial=-m * (a * psi_rate**2 + a * (omega * s) ** 2 + g * c), sideways=2 * m * a * omega * c * psi_rate,
    )  # fmt: skip


def natural_rate(params: PyTree):
    """ω0 = √(g/a): the pendulum's frequency, and the critical speed."""
    return jnp.sqrt(params["g"] / params["a"])


def tilt(excess):
    """α for (ω/ω0)² = 1 + excess >= 1: 2 asin √((1 - cos α)/2), exact where arccos(1/(1 + excess)) loses its digits."""
    return 2 * jnp.arcsin(jnp.sqrt(0.5 * excess / (1 + excess)))


def equilibrium_angle(params: PyTree):
    """α = arccos(ω0²/ω²) above ω0, and 0, the bottom, up to it; π/2 for g = 0."""
    g, reached = params["g"], params["a"] * params["omega"] ** 2
    above = reached > g
    half_versine = jnp.where(above, 0.5 * (reached - g) / jnp.where(above, reached, 1.0), 1.0)
    return jnp.where(above, 2 * jnp.arcsin(jnp.sqrt(half_versine)), 0.0)


def short_of_horizontal(params: PyTree):
    """π/2 - α = arcsin(ω0²/ω²): how far below the horizontal the bead rests, accurate for fast rotation."""
    return jnp.arcsin(params["g"] / (params["a"] * params["omega"] ** 2))


class BeadSquares(NamedTuple):
    """Squared frequencies of small motions; a negative one is minus a squared growth rate."""

    bottom: jax.Array
    alpha: jax.Array
    top: jax.Array


def small_motion(params: PyTree) -> BeadSquares:
    """ω0² - ω² at the bottom, ω² sin²α = ω² - ω0⁴/ω² about α (meaningful above ω0), -(ω0² + ω²) at the top."""
    below, squared = params["g"] / params["a"], params["omega"] ** 2
    return BeadSquares(below - squared, (squared - below) * (squared + below) / squared, -(below + squared))


def frequency(square):
    """Ω = √square where the motion is stable, 0 where it is not: never NaN from a tiny negative square."""
    return jnp.sqrt(jnp.maximum(square, 0.0))


def growth(square):
    """The growth rate √(-square) where the motion is unstable, else 0."""
    return frequency(-square)


def lag_behind_hoop(params: PyTree):
    """ω - Ω about α, computed as ω0⁴ / (ω² (ω + Ω)): at ω = 1e6 round-off would swamp the difference itself."""
    below, omega = params["g"] / params["a"], params["omega"]
    return below**2 / (omega**2 * (omega + frequency(small_motion(params).alpha)))


def libration(params: PyTree, psi):
    """Does a bead released from rest at ψ go through the bottom? Also rate, m and m1 of its elliptic functions."""
    below, squared = params["g"] / params["a"], params["omega"] ** 2
    s2, c2 = jnp.sin(0.5 * psi) ** 2, jnp.cos(0.5 * psi) ** 2
    # ω0² - ω² c², written so that it does not cancel at ω = ω0.
    gap = (below - squared) + squared * s2
    D, M = gap + squared * s2, s2 * (below + squared * s2)
    through = gap > 0
    first, second = jnp.where(through, D, M), jnp.where(through, M, D)
    return through, jnp.sqrt(first), second / first, c2 * jnp.abs(gap) / first


@jax.jit
def exact_period(params: PyTree, psi):
    """The period after a release from rest at ψ: through the bottom and back, or about α and back."""
    through_bottom, rate, _, m1 = libration(params, psi)
    return jnp.where(through_bottom, 2.0, 1.0) * jnp.pi / (rate * agm(1.0, jnp.sqrt(m1)))


@jax.jit
def exact_motion(params: PyTree, psi, t):
    """ψ(t) and ψ̇(t) after a release from rest at ψ (not exactly at an equilibrium or on the homoclinic orbit)."""
    through_bottom, rate, m, m1 = libration(params, psi)
    sn, cn, dn = jacobi_elliptic(rate * t, m, m1)
    start = jnp.tan(0.5 * psi)
    x = start * jnp.where(through_bottom, cn, dn)
    x_rate = -start * rate * sn * jnp.where(through_bottom, dn, m * cn)
    return 2 * jnp.arctan(x), 2 * x_rate / (1 + x**2)


def other_turning_point(params: PyTree, psi):
    """Where a bead released at ψ comes to rest beyond α; from ψ = 0 the outer end of the homoclinic orbit."""
    below, squared = params["g"] / params["a"], params["omega"] ** 2
    s2 = jnp.sin(0.5 * psi) ** 2
    return 2 * jnp.arctan2(jnp.sqrt((squared - below) - squared * s2), jnp.sqrt(below + squared * s2))


def homoclinic_motion(params: PyTree, t):
    """ψ and ψ̇ on the orbit that leaves the bottom and returns to it, at its outer end at t = 0; ω > ω0."""
    growing = growth(small_motion(params).bottom)
    x = growing / natural_rate(params) / jnp.cosh(growing * t)
    return 2 * jnp.arctan(x), -2 * x * growing * jnp.tanh(growing * t) / (1 + x**2)


@jax.jit
def rotation_period(params: PyTree, H):
    """The time of one turn over the top, H = 2 h / (m a²) > 2 ω0².

    T = 2π / (√A agm(p, q)) with the roots p², q² of A y² - B y + C never formed: one step of the mean gives
    √A agm(p, q) = agm(½ √(B + 2 √(A C)), (A C)^¼).
    """
    below, squared = params["g"] / params["a"], params["omega"] ** 2
    A, B, C = H - 2 * below, 2 * H + 4 * squared, H + 2 * below
    root = jnp.sqrt(A * C)
    return 2 * jnp.pi / agm(0.5 * jnp.sqrt(B + 2 * root), jnp.sqrt(root))


# A start with positive acceleration comes to rest again half a period later.
HALF_PERIOD = diffrax.Event(lambda t, y, params, **kwargs: y[1], direction=False)


def swing(params: PyTree, psi, longest, tolerance=1e-10):
    """Release the bead at rest at ψ and stop where it comes to rest again, half a period later.

    It starts on the side (+ψ or -ψ) from which it moves towards larger angles, and moves for `longest` at most.
    """
    start = jnp.where(params["omega"] ** 2 * jnp.cos(psi) > params["g"] / params["a"], psi, -psi)
    ts = jnp.stack([jnp.zeros_like(start), jnp.asarray(longest, start.dtype)])
    how = {"ts": ts, "event": HALF_PERIOD, "rtol": tolerance, "atol": tolerance}
    return integrate(system, start, jnp.zeros_like(start), params, **how)


def settled(params: PyTree, psi, time, tolerance=1e-9):
    """Where a bead with friction (params["b"]), released at rest at ψ, ends up."""
    ts = jnp.stack([jnp.zeros_like(time), time])
    return integrate(damped_system, psi, jnp.zeros_like(psi), params, ts=ts, rtol=tolerance, atol=tolerance).end.q


def pitchfork(speeds, starts, **settings):
    """Where beads with friction settle: a sweep over ω, each released at rest at its own ψ (paired)."""

    def settles(point):
        return settled(PARAMS | {"omega": point["omega"], "b": 2.0}, point["psi"], jnp.asarray(40.0), 1e-6)

    return sweep(settles, {"omega": speeds, "psi": starts}, paired=True, progress=False, **settings)


def driven_start(params: PyTree, psi):
    """The state of `driven_system` at rest on the hoop."""
    return {"psi": psi, "theta": 0.0}, {"psi": 0.0, "theta": params["omega"]}


def runs():
    """Released at rest below the critical speed, and driven above it."""
    slow = PARAMS | {"omega": 2.5}
    ends = 100 * exact_period(slow, 2.0), 20 * exact_period(PARAMS, 1.0)
    ts, driven_ts = (np.linspace(0.0, float(end), 7) for end in ends)

    def swing_error(trajectory):
        return relative_error((trajectory.q, trajectory.v), exact_motion(slow, 2.0, ts))

    def driven_error(trajectory):
        psi, psi_rate = exact_motion(PARAMS, 1.0, driven_ts)
        got = (trajectory.q["psi"], trajectory.v["psi"], trajectory.multipliers["motor"])
        return relative_error(got, (psi, psi_rate, balance(PARAMS, psi, psi_rate).torque))

    return [
        Run(
            "through the bottom, omega = 2.5", system, slow, 2.0, 0.0, ts, swing_error,
            "psi and its rate against Jacobi's elliptic functions", required=1e-6, by_hand=by_hand.bead,
        ), Run(
            "driven about the tilt, omega = 6", driven_system, PARAMS, *driven_start(PARAMS, 1.0), driven_ts,
            driven_error, "psi, its rate and the motor's torque against Jacobi's elliptic functions", required=1e-8,
            invariant=lambda trajectory: balance(PARAMS, trajectory.q["psi"], trajectory.v["psi"]).h, tier=FULL,
        ),
    ]  # fmt: skip


def cases(tier=FULL):
    """Speeds, starts and lengths at the ends of their ranges."""
    if tier == QUICK:
        return [_tilt_case(), _reversed_case()]
    rows = [
        _period_case("omega = omega0 exactly, psi_m = 2^-10", CRITICAL, 2.0**-10, 1e-12),
        _period_case("from 2^-10 off the unstable bottom", PARAMS, 2.0**-10, 1e-12),
        _period_case("omega = 1e6", PARAMS | {"omega": 1e6}, 1.0, 1e-10),
        _period_case("g = 0, no weight", PARAMS | {"g": 0.0}, 1.0, 1e-10),
        _period_case("a = 1e-12, a tiny hoop", PARAMS | {"a": 1e-12}, 1.0, 1e-10),
    ]
    params = PARAMS | {"omega": 2.5}
    quarter = exact_period(params, np.pi - 2.0**-16) / 4
    fall = swing(params, np.pi - 2.0**-16, quarter, 1e-12).end
    # π - 2^-16 gives eleven digits of the distance from the top; the time to the bottom depends on its logarithm.
    error = abs(float(fall.q / fall.v / quarter))
    rows.append(Case("from 2^-16 off the top", f"at the bottom after T/4 = {float(quarter):.6g} s", error, 1e-9))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EventWarning)  # The event function is zero all the time, which gives a warning.
        still = swing(PARAMS, 0.0, 1000.0)
    error = abs(float(still.end.q)) + (0.0 if float(still.end.t) == 1000.0 else np.inf)
    rows.append(Case("at rest on the unstable bottom", "stays for 1000 s: no spurious departure", error, 0.0))
    return [*rows, _tilt_case(), _reversed_case(), _pitchfork_case(), _critical_case()]


def _tilt_case():
    alpha, exact = float(tilt(1e-15)), np.arctan(np.sqrt(1e-15 * (2 + 1e-15)))
    lost = np.arccos(1 / (1 + 1e-15)) / exact - 1
    happened = f"alpha = {alpha:.6e}; arccos(1 / (1 + 1e-15)) is off by {100 * lost:.0f} %"
    return Case("(omega/omega0)² = 1 + 1e-15", happened, abs(alpha / exact - 1), 1e-15)


def _period_case(name: str, params: PyTree, psi, tolerance):
    exact = exact_period(params, psi)
    motion = swing(params, psi, 0.75 * exact, tolerance)
    happened = f"period {float(exact):.6g} s by an event, {int(motion.stats['num_steps'])} steps at {tolerance:g}"
    return Case(name, happened, abs(float(2 * motion.end.t / exact) - 1), 1e-9)


def _reversed_case():
    """The motor's torque changes sign with omega; at the bottom, where the mass matrix is singular, it is 0."""
    errors = []
    for psi, omega in ((1.25, -6.0), (0.0, 6.0), (np.pi, 6.0)):
        params = PARAMS | {"omega": omega}
        q, v = {"psi": psi, "theta": 0.0}, {"psi": -2.0, "theta": omega}
        torque = accelerations(driven_system, 0.0, q, v, params)[1]["motor"]
        errors.append(abs(float(torque - balance(params, psi, -2.0).torque)))
    return Case("omega < 0, and psi = 0, pi", "torque as in closed form, where M is singular too", max(errors), 1e-14)


def _pitchfork_case():
    """Below ω0 the bottom is stable, above it the two tilted positions."""
    speeds, starts, swept = _settling()
    exact = np.sign(starts) * np.where(speeds < 1, 0.0, tilt(np.maximum(speeds, 1.0) ** 2 - 1))
    error = float(np.max(np.abs(swept.values - exact)))
    return Case("23 speeds, with friction", f"{swept.ok.sum()} of {speeds.size} settled on the pitchfork", error, 1e-4)


@functools.cache
def _branches():  # for the case and the picture
    return continue_equilibria(system, PARAMS | {"omega": 0.5}, 0.0, along="omega", to=9.0)


def _critical_case():
    """ω_c = √(g/a), and its derivative by a: -½ √(g/a³)."""
    (found,), speed = _branches().critical, natural_rate(PARAMS)
    error = abs(found.parameter / speed - 1), abs(found.derivative["a"] / (-0.5 * speed / PARAMS["a"]) - 1)
    return Case(f"a {found.kind}, by continuation", "omega_c, and its derivative by a", float(max(error)), 1e-10)


@functools.cache
def _settling():  # for the case and the picture; not too near ω0, where settling takes infinitely long
    speeds = np.append(np.linspace(0.1, 0.92, 9), np.linspace(1.12, 2.45, 14))
    starts = np.where(np.arange(speeds.size) % 2, 0.5, -0.5)
    return speeds, starts, pitchfork(natural_rate(PARAMS) * speeds, starts)


def picture(tier=FULL):
    """The pitchfork, with beads that settled on it; and the period, which diverges at the homoclinic orbit."""
    fig, axes = plots.figure(1, 2, size=(4.6, 3.4))
    _draw_pitchfork(axes[0, 0])
    _draw_periods(axes[0, 1], float(natural_rate(PARAMS)))
    return fig


def _draw_pitchfork(axis):
    _branches().draw(axis)
    speeds, _, swept = _settling()
    axis.plot(natural_rate(PARAMS) * speeds, swept.values, "o", color="black", markersize=4, label="with friction")
    axis.set(xlabel=r"$\omega$", ylabel=r"angle $\psi$", title="The pitchfork, by continuation")
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(0.0, 0.72))


def _draw_periods(axis, unit):
    # No point of the grid falls on a divergence, where the period is infinite.
    speeds, measured = np.linspace(0.003, 2.5, 700), np.linspace(0.1, 2.4, 9)
    for i, psi in enumerate((0.125, 1.0, 2.0)):
        period = exact_period(PARAMS | {"omega": unit * speeds}, psi)
        axis.plot(speeds, unit * period / (2 * np.pi), label=rf"$\psi_m$ = {psi:g}", **plots.style(i))
        params = [PARAMS | {"omega": unit * speed} for speed in measured]
        halves = [swing(p, psi, 0.75 * exact_period(p, psi), 1e-8).end.t for p in params]
        axis.plot(measured, unit * np.array(halves) / np.pi, plots.MARKERS[i], color=plots.COLOURS[i], markersize=4)
    axis.set(xlabel=r"$\omega/\omega_0$", ylabel=r"period $\times\,\omega_0/2\pi$", title="Released at rest")
    axis.set_ylim(0.0, 4.0)
    axis.legend(fontsize=8, frameon=False, title="curves: exact; marks: measured", title_fontsize=8)


SCENE = Scene(
    name="bead_on_hoop", title="A bead on a rotating hoop",
    source="Goldstein, Classical Mechanics, Exercise 2-18; source document §3, Eq. (13)",
    misprints=MISPRINTS, runs=runs, cases=cases, picture=picture,
)  # fmt: skip
