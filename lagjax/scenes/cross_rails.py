"""A carriage on rotating cross-rails, on two springs (source §6).

The rails turn with ω. R and r are the carriage's coordinates along them, the first spring (K, rest length R0) along R,
the second (k, rest length zero) along r; x = R cos ωt - r sin ωt, y = R sin ωt + r cos ωt in the laboratory:

    L = ½ m (ẋ² + ẏ²) - ½ K (x cos ωt + y sin ωt - R0)² - ½ k (-x sin ωt + y cos ωt)²
      = ½ m ((Ṙ - ω r)² + (ṙ + ω R)²) - ½ K (R - R0)² - ½ k r²

The first form depends on time, so its energy function is E = T + V and not conserved; the second does not, and its
Jacobi integral is h' = E - ω L_z. The rails' torque τ makes the difference, and the Coriolis terms have a factor 2:

    R̈ = 2 ω ṙ + ω² R - (K/m) (R - R0),    r̈ = -2 ω Ṙ + ω² r - (k/m) r
    τ = dL_z/dt = r (K (R - R0) - k R),    dE/dt = ω τ                                        (15)

These are linear: z = (R, r, Ṙ, ṙ) obeys ż = B z + e. With κ = k/m and Κ = K/m the squared frequencies Ω² of B solve

    Ω⁴ - (κ + Κ + 2 ω²) Ω² + (κ - ω²) (Κ - ω²) = 0,    discriminant (κ - Κ)² + 8 ω² (κ + Κ) >= 0

so they are real: the motion is stable iff (1 - m ω²/K) (1 - m ω²/k) > 0, below both critical speeds or above
both. The even powers of B have only two eigenvalues, and Sylvester's formula gives the matrix exponential,

    z(t) = C(t) z0 + S(t) (B z0 + e) + V(t) B e,    C, S, V = cos Ωt, sin(Ωt)/Ω, (1 - cos Ωt)/Ω²  at  Ω² = -B²,

    f(-B²) = f(Ω1²) - (f(Ω1²) - f(Ω2²)) (B² + Ω1²) / (Ω1² - Ω2²)

for any time, through the critical speeds (where there is no equilibrium) and beyond them.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.normal_modes import normal_modes
from lagjax.display import plots
from lagjax.integrate import integrate
from lagjax.report import FULL, MAIN, QUICK, Case, Run, Scene, relative_error
from lagjax.scenes import by_hand
from lagjax.sweep import sweep
from lagjax.system import System

PARAMS = {"m": 0.5, "K": 20.0, "k": 8.0, "R0": 0.75, "omega": 2.5}
Q0 = {"R": 1.0, "r": 0.125}
V0 = {"R": 0.25, "r": -0.5}
# A carriage farther away than this is no longer held.
LEAVES = 1000.0

# Number of terms in the series in Ω²t², used below SERIES_BELOW: 0.1⁷/14! is below round-off.
SERIES_TERMS = 7
SERIES_BELOW = 0.1

MISPRINTS = (
    "§6 prints T = ½(ẋ² + ẏ²): the mass m is missing.",
    "§6 prints h' = T + V - mω(Rṙ - Ṙr) - ½mω²(r² + R²): the last term has the factor 1, so that h' = E - ω L_z.",
    "§6 prints (15) as dE/dt = mω(R r̈ - r R̈) + mω²(rṙ + RṘ), with h for h': the last term has the factor 2.",
    "§6 prints m r̈ = -mωṘ + mω²r - kr: the Coriolis term is -2mωṘ.",
    "§6 prints m R̈ = mωṙ + mω²R - K(R - R0): the Coriolis term is +2mωṙ.",
    "§6 prints m R̈ = -d/dt ∂U/∂Ṙ - ∂(U + V)/∂r: it is +d/dt ∂U/∂Ṙ - ∂(U + V)/∂R.",
    "§6 linearises with -mωξ̇ and +mωṙ: both terms have the factor 2.",
    "§6 calls the equilibrium length smaller than R0: it is larger for 0 < mω² < K, and negative for mω² > K.",
    "§6 has the carriage pushed against the axis for ω² >= K/m: the centrifugal force is outward; above both critical "
    "speeds the motion is stable again, about R = -R0/(mω²/K - 1).",
    "§6 calls the forces from U centrifugal and not conservative: they are Coriolis' force, which does no work, and "
    "the centrifugal one, which is conservative.",
    "§6 has the springs softened by the rotation: K - mω² and k - mω² are, but the fast mode stiffens.",
)


def lab_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L in x, y: depends on time explicitly, because the springs turn."""
    m, K, k, R0 = params["m"], params["K"], params["k"], params["R0"]
    c, s = jnp.cos(params["omega"] * t), jnp.sin(params["omega"] * t)
    stretch, across = q["x"] * c + q["y"] * s - R0, -q["x"] * s + q["y"] * c
    return 0.5 * m * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * K * stretch**2 - 0.5 * k * across**2


def rotating_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L in R, r: independent of time, but with terms linear in the velocities."""
    m, K, k, R0, omega = params["m"], params["K"], params["k"], params["R0"], params["omega"]
    speed_squared = (v["R"] - omega * q["r"]) ** 2 + (v["r"] + omega * q["R"]) ** 2
    return 0.5 * m * speed_squared - 0.5 * K * (q["R"] - R0) ** 2 - 0.5 * k * q["r"] ** 2


lab_system = System(lab_lagrangian)
rotating_system = System(rotating_lagrangian)


@jax.jit
def to_lab(params: PyTree, t, q: PyTree, v: PyTree):
    """(x, y) and their rates from (R, r) and their rates."""
    omega = params["omega"]
    c, s = jnp.cos(omega * t), jnp.sin(omega * t)
    along, across = v["R"] - omega * q["r"], v["r"] + omega * q["R"]
    return (
        {"x": q["R"] * c - q["r"] * s, "y": q["R"] * s + q["r"] * c},
        {"x": along * c - across * s, "y": along * s + across * c},
    )


def to_rotating(params: PyTree, t, q: PyTree, v: PyTree):
    """(R, r) and their rates from (x, y) and their rates."""
    omega = params["omega"]
    c, s = jnp.cos(omega * t), jnp.sin(omega * t)
    R, r = q["x"] * c + q["y"] * s, -q["x"] * s + q["y"] * c
    return {"R": R, "r": r}, {"R": v["x"] * c + v["y"] * s + omega * r, "r": -v["x"] * s + v["y"] * c - omega * R}


class RailBalance(NamedTuple):
    """Quantities of one state: energy, Jacobi integral, angular momentum, the rails' torque and its power."""

    E: jax.Array
    h: jax.Array
    L_z: jax.Array
    torque: jax.Array
    power: jax.Array


def balance(params: PyTree, q: PyTree, v: PyTree) -> RailBalance:
    """E, h' = E - ω L_z, L_z, τ = r (K (R - R0) - k R) and dE/dt = ω τ, from the rotating coordinates.

    h' is computed independently of E and L_z, as ½m(Ṙ² + ṙ²) + V - ½mω²(R² + r²).
    """
    m, K, k, R0, omega = params["m"], params["K"], params["k"], params["R0"], params["omega"]
    V = 0.5 * K * (q["R"] - R0) ** 2 + 0.5 * k * q["r"] ** 2
    along, across = v["R"] - omega * q["r"], v["r"] + omega * q["R"]
    torque = q["r"] * (K * (q["R"] - R0) - k * q["R"])
    return RailBalance(
        E=0.5 * m * (along**2 + across**2) + V,
        h=0.5 * m * (v["R"] ** 2 + v["r"] ** 2) + V - 0.5 * m * omega**2 * (q["R"] ** 2 + q["r"] ** 2),
        L_z=m * (q["R"] * across - q["r"] * along),
        torque=torque,
        power=omega * torque,
    )


def equilibrium_length(params: PyTree):
    """R_eq = R0 / (1 - m ω²/K), infinite at ω² = K/m; on the other side of the axis above it."""
    return params["K"] * params["R0"] / (params["K"] - params["m"] * params["omega"] ** 2)


class RailSquares(NamedTuple):
    """Squared frequencies of the two modes; a negative one is minus a squared growth rate."""

    fast: jax.Array
    slow: jax.Array


def mode_squares(params: PyTree) -> RailSquares:
    """Ω² of both modes: the slow one as c / Ω_fast², so that it does not cancel near a critical speed."""
    half_sum, root, product = _characteristic(params)
    fast = half_sum + 0.5 * root
    return RailSquares(fast=fast, slow=product / fast)


def _characteristic(params: PyTree):
    """Half the sum, the difference and the product of the squared frequencies."""
    kappa, Kappa = params["k"] / params["m"], params["K"] / params["m"]
    squared = params["omega"] ** 2
    root = jnp.sqrt((kappa - Kappa) ** 2 + 8 * squared * (kappa + Kappa))
    return 0.5 * (kappa + Kappa) + squared, root, (kappa - squared) * (Kappa - squared)


@jax.jit
def is_stable(params: PyTree):
    """(1 - m ω²/K) (1 - m ω²/k) > 0: below both critical speeds, or above both (gyroscopically)."""
    squared = params["m"] * params["omega"] ** 2
    return (1 - squared / params["K"]) * (1 - squared / params["k"]) > 0


def critical_speeds(params: PyTree):
    """√(k/m) and √(K/m), the lower first."""
    return tuple(jnp.sqrt(f(params["k"], params["K"]) / params["m"]) for f in (jnp.minimum, jnp.maximum))


def strongest_growth(params: PyTree):
    """The largest growth rate between the critical speeds, |Κ - κ| / √(8 (Κ + κ)), and its ω."""
    kappa, Kappa = params["k"] / params["m"], params["K"] / params["m"]
    total = Kappa + kappa
    speed = jnp.sqrt((0.75 * total**2 + kappa * Kappa) / (2 * total))
    return jnp.abs(Kappa - kappa) / jnp.sqrt(8 * total), speed


def escape(params: PyTree):
    """At ω = √(K/m), where no equilibrium exists: R ~ ½ a t² and r ~ b t; returns (a, b)."""
    kappa, Kappa = params["k"] / params["m"], params["K"] / params["m"]
    push = Kappa * params["R0"] / (kappa + 3 * Kappa)
    return push * (kappa - Kappa), -2 * jnp.sqrt(Kappa) * push


@jax.jit
def exact_motion(params: PyTree, q0: PyTree, v0: PyTree, t):
    """q(t) and v(t) in R, r: the matrix exponential by Sylvester's formula; t of any shape."""
    m, omega = params["m"], params["omega"]
    Kappa, kappa = params["K"] / m, params["k"] / m
    zero = jnp.zeros_like(Kappa * omega)

    def rate(z):
        R, r, R_rate, r_rate = z
        return jnp.stack(
            [R_rate, r_rate, 2 * omega * r_rate + (omega**2 - Kappa) * R, -2 * omega * R_rate + (omega**2 - kappa) * r]
        )

    start = jnp.stack([jnp.asarray(x) + zero for x in (q0["R"], q0["r"], v0["R"], v0["r"])])
    push = jnp.stack([zero, zero, Kappa * params["R0"], zero])
    fast, slow = mode_squares(params)
    difference = _characteristic(params)[1]
    difference = jnp.where(difference > 0, difference, 1.0)  # zero only if B² = -Ω², where its factor is zero too
    z = 0.0
    for vector, at_fast, at_slow in zip((start, rate(start) + push, rate(push)), _waves(fast, t), _waves(slow, t)):
        rest = (rate(rate(vector)) + fast * vector) / difference
        z += jnp.multiply.outer(at_fast, vector) - jnp.multiply.outer(at_fast - at_slow, rest)
    R, r, R_rate, r_rate = jnp.moveaxis(z, -1, 0)
    return {"R": R, "r": r}, {"R": R_rate, "r": r_rate}


def _waves(square, t):
    """cos Ωt, sin(Ωt)/Ω and (1 - cos Ωt)/Ω² for Ω² of either sign, by a series if Ωt is small."""
    y = square * t**2
    small = jnp.abs(y) < SERIES_BELOW
    series = [t**j * jnp.polyval(_coefficients(j), jnp.where(small, y, 0.0)) for j in range(3)]
    stable = jnp.maximum(jnp.where(small, 1.0, square), 0.0)
    turning = stable > 0
    rate = jnp.sqrt(jnp.where(turning, stable, 1.0))
    growth = jnp.sqrt(jnp.where(small | turning, 1.0, -square))
    grown = jnp.where(small | turning, 0.0, growth * t)
    forms = (
        (jnp.cos(rate * t), jnp.cosh(grown)),
        (jnp.sin(rate * t) / rate, jnp.sinh(grown) / growth),
        (2 * (jnp.sin(0.5 * rate * t) / rate) ** 2, 2 * (jnp.sinh(0.5 * grown) / growth) ** 2),
    )
    return [jnp.where(small, near, jnp.where(turning, *far)) for near, far in zip(series, forms)]


def _coefficients(j):
    """(-1)ⁿ / (2n + j)!, the highest power first."""
    return np.array([(-1.0) ** n / math.factorial(2 * n + j) for n in reversed(range(SERIES_TERMS))])


def runs():
    """The same motion in both frames, and a motion above both critical speeds."""
    ts, above = np.linspace(0.0, 100.0, 11), PARAMS | {"omega": 8.0}
    return [
        _run("rotating frame, omega = 2.5", rotating_system, PARAMS, ts, by_hand.rails_rotating),
        _run("above both critical speeds, omega = 8", rotating_system, above, ts),
        _run("lab frame, omega = 2.5", lab_system, PARAMS, ts, by_hand.rails_in_the_lab, FULL),
    ]


def _run(name: str, system, params: PyTree, ts, acceleration=None, tier=MAIN):
    """A run whose error is measured in the coordinates of its system; the invariant is h' in both frames."""
    in_lab = system is lab_system
    start = to_lab(params, 0.0, Q0, V0) if in_lab else (Q0, V0)

    def error(trajectory):
        exact = exact_motion(params, Q0, V0, ts)
        return relative_error((trajectory.q, trajectory.v), to_lab(params, ts, *exact) if in_lab else exact)

    def invariant(trajectory):
        state = trajectory.q, trajectory.v
        return balance(params, *(to_rotating(params, trajectory.t, *state) if in_lab else state)).h

    return Run(
        name, system, params, *start, ts, error, "coordinates and rates against the matrix exponential", 2e-8,
        invariant=invariant, by_hand=acceleration, drawn=acceleration is not None, tier=tier,
    )  # fmt: skip


# Outputs in the laboratory: as many for all, by one program.
DRAWN = 241


def cases(tier=FULL):
    """Speeds at and between the critical ones, stiff springs, late times."""
    rows = [
        _case("omega² = K/m: no equilibrium", {"omega": float(np.sqrt(PARAMS["K"] / PARAMS["m"]))}, 20.0),
        _case("omega² = k/m: a line of equilibria", {"omega": 4.0}, 100.0),
        _case("omega = 5, between: divergence", {"omega": 5.0}, 10.0),
        _case("omega = 8, above both: 200 s", {"omega": 8.0}, 200.0),
        _case("omega = 0", {"omega": 0.0}, 20.0),
        _case("omega = -2.5", {"omega": -2.5}, 20.0),
        _case("K/k = 2.5e6, stiff", {"K": 2e7}, 1.0),
        _case("K = k, R0 = 0, isotropic", {"K": 8.0, "R0": 0.0, "omega": 3.0}, 20.0),
    ]
    if tier == QUICK:
        return rows
    rows += [_late_case(), _map_case()]
    # Normal modes in lanes compile for as long as all motions.
    return [*rows, _modes_case()] if tier == FULL else rows


def _late_case():
    # At t = 1e6 the time itself has a resolution of only 1e-10 s, and so has the angle ω t.
    late = 1e6 + np.linspace(0.0, 5.0, DRAWN)
    end = integrate(lab_system, *to_lab(PARAMS, late[0], Q0, V0), PARAMS, ts=late, rtol=1e-12, atol=1e-12).end
    error = relative_error(to_rotating(PARAMS, late[-1], end.q, end.v), exact_motion(PARAMS, Q0, V0, 5.0))
    return Case("lab frame from t = 1e6 s on", "cos(omega t) with ten digits left in t", error, 1e-7)


def _case(name: str, change, time):
    params = PARAMS | change
    trajectory = integrate(rotating_system, Q0, V0, params, ts=jnp.array([0.0, time]), rtol=1e-12, atol=1e-12)
    end, exact = trajectory.end, exact_motion(params, Q0, V0, time)
    scale = max(abs(float(x)) for x in jax.tree.leaves(exact))
    error = max(float(abs(a - b)) for a, b in zip(jax.tree.leaves((end.q, end.v)), jax.tree.leaves(exact))) / scale
    happened = f"R({time:g} s) = {float(end.q['R']):.6g}, r = {float(end.q['r']):.6g}, {_verdict(params)}"
    return Case(name, f"{happened}, {int(trajectory.stats['num_steps'])} steps", error, 1e-9)


def _verdict(params: PyTree):
    slow = float(mode_squares(params).slow)
    # The rounding of √(K/m) alone would give a frequency of 1e-8 instead of zero.
    if abs(slow) < 1e-9:
        return "growth as a power of t"
    return f"slow mode {np.sqrt(slow):.4g} rad/s" if slow > 0 else f"growth rate {np.sqrt(-slow):.4g} per s"


def stability_map(over_K, over_k, **settings):
    """How far the carriage is after 40 s, over (m ω²/K, m ω²/k): a sweep at ω = 2.5."""
    squared, ts = PARAMS["m"] * PARAMS["omega"] ** 2, jnp.array([0.0, 40.0])

    def distance(point):
        params = PARAMS | {"K": squared / point["over_K"], "k": squared / point["over_k"]}
        end = integrate(rotating_system, Q0, V0, params, ts=ts, rtol=1e-6, atol=1e-6).end
        return jnp.hypot(end.q["R"], end.q["r"])

    return sweep(distance, {"over_K": over_K, "over_k": over_k}, progress=False, **settings)


@functools.cache
def _mapped():
    """144 pairs of springs and the final distance of each, for the case and the picture."""
    sides = np.geomspace(0.08, 12.5, 12)
    return *np.meshgrid(sides, sides, indexing="ij"), stability_map(sides, sides)


@jax.jit
@jnp.vectorize
def is_held(over_K, over_k):
    """Whether small motions stay small at (m ω²/K, m ω²/k), by their normal modes."""
    squared = PARAMS["m"] * PARAMS["omega"] ** 2
    params, zero = PARAMS | {"K": squared / over_K, "k": squared / over_k}, jnp.zeros_like(over_K)
    rest, still = {"R": equilibrium_length(params), "r": zero}, {"R": zero, "r": zero}
    return normal_modes(rotating_system, 0.0, rest, still, params).stable


def _modes_case():
    """Compare with the closed form at random points."""
    over_K, over_k = np.exp(np.random.default_rng(0).uniform(np.log(0.05), np.log(20.0), (2, 60, 60)))
    wrong = int(np.sum(is_held(over_K, over_k) != ((1 - over_K) * (1 - over_k) > 0)))
    return Case("3,600 pairs of springs", "stability by normal modes", float(wrong), 0.0)


def _map_case():
    """The whole plane, including above both critical speeds, where the rotation alone holds the carriage."""
    (over_K, over_k, swept), squared = _mapped(), PARAMS["m"] * PARAMS["omega"] ** 2
    stable = np.asarray(is_stable(PARAMS | {"K": squared / over_K, "k": squared / over_k}))
    # A failed motion is NaN and would be counted as one that leaves.
    wrong = int(np.sum(((swept.values < LEAVES) != stable) | ~swept.ok))
    return Case("144 pairs of springs", f"stability by integration of {swept.ok.sum()} motions", float(wrong), 0.0)


def picture(tier=FULL):
    """The carriage's path in the laboratory, and where the rails hold it."""
    fig, axes = plots.figure(1, 2, size=(4.6, 4.0))
    _draw_path(axes[0, 0])
    _draw_map(axes[0, 1])
    return fig


def _draw_path(axis):
    ts = np.linspace(0.0, 4 * np.pi / PARAMS["omega"], DRAWN)
    path = integrate(lab_system, *to_lab(PARAMS, 0.0, Q0, V0), PARAMS, ts=ts, rtol=1e-6, atol=1e-6)
    some = ts[::12]
    exact, _ = to_lab(PARAMS, some, *exact_motion(PARAMS, Q0, V0, some))
    around = np.linspace(0.0, 2 * np.pi, 181)
    length = float(equilibrium_length(PARAMS))
    axis.plot(length * np.cos(around), length * np.sin(around), label=r"$R_{eq}$", **plots.style(2))
    axis.plot(path.q["x"], path.q["y"], label="integrated", **plots.style(0))
    axis.plot(exact["x"], exact["y"], plots.MARKERS[0], color=plots.COLOURS[1], markersize=4, label="exact")
    axis.set(xlabel="x", ylabel="y", title=r"Two turns in the laboratory, $\omega$ = 2.5", aspect="equal")
    axis.set(xlim=(-1.35, 1.35), ylim=(-1.35, 1.75))
    axis.legend(fontsize=8, frameon=False, loc="upper center", ncols=3)


def _draw_map(axis):
    """Regions by the closed form, and the motions of 144 pairs of springs, integrated for 40 s."""
    low, high = 0.05, 20.0
    x, y = np.meshgrid(*2 * [np.geomspace(low, high, 60)])
    axis.contourf(x, y, (1 - x) * (1 - y) > 0, [0.5, 1.5], colors=[plots.COLOURS[2]], alpha=0.25)
    axis.axvline(1.0, color="black", linewidth=1)
    axis.axhline(1.0, color="black", linewidth=1)
    words = "stable", "stable,\ngyroscopic", "grows", "grows"
    for x, y, words in zip((0.11, 8.5, 0.11, 9.0), (0.5, 11.0, 9.0, 0.5), words):
        axis.text(x, y, words, ha="center", va="center", fontsize=9, bbox=plots.ON_MARKS)
    axis.text(1.0, 0.06, r"$\omega^2 = K/m$", fontsize=8, rotation=90, ha="center", va="bottom", bbox=plots.ON_MARKS)
    axis.text(0.052, 1.0, r"$\omega^2 = k/m$", fontsize=8, va="center", bbox=plots.ON_MARKS)
    p, q, swept = _mapped()
    far = ~(swept.values < LEAVES)
    axis.loglog(p[~far], q[~far], plots.MARKERS[0], color=plots.COLOURS[0], markersize=3, label="integrated: stays")
    axis.loglog(p[far], q[far], plots.MARKERS[6], color=plots.COLOURS[1], markersize=4, label="integrated: leaves")
    named = {"xlabel": r"$m\omega^2/K$", "ylabel": r"$m\omega^2/k$", "title": "Two critical speeds"}
    axis.set(xlim=(low, high), ylim=(low, high), **named)
    axis.legend(fontsize=8, framealpha=0.9, edgecolor="none", loc="lower right")


SCENE = Scene(
    name="cross_rails", title="A carriage on rotating cross-rails",
    source="source document §6, Eq. (15); a problem of Goldstein, Classical Mechanics, chapter 2",
    misprints=MISPRINTS, runs=runs, cases=cases, picture=picture,
)  # fmt: skip
