"""Geodesics on a sphere (Goldstein, Derivation 2-4; source §1).

ψ is the colatitude, θ the azimuth: r = R (sin ψ cos θ, sin ψ sin θ, cos ψ). There are two formulations.

As in the source, with θ as the independent variable (t = θ, q = ψ, v = ψ' = dψ/dθ):

    l = R ∫ f dθ,    f(ψ, ψ') = √(sin²ψ + ψ'²),    ∂²f/∂ψ'² = sin²ψ / f³

f does not contain θ, so f - ψ' ∂f/∂ψ' = sin²ψ / f = cos i is constant (Clairaut), i the inclination of the
plane. q = cot ψ obeys q'' = -q, so cot ψ = A cos θ + B sin θ, with tan²i = A² + B². Meridians have θ constant,
and the equation is singular at the poles.

Without singularities: L = ½ |ṙ|² on |r|² = R², t = s the arc length where |ṙ| = 1,

    r̈ = 2 λ r,    λ = -1 / (2 R²),    r(s) = R (e₁ cos(s/R) + e₂ sin(s/R))

The plane of two points has the normal n = p₁ × p₂. In the frame turned about the axis by the mean azimuth,
with δ = (ψ₂ - ψ₁)/2, σ = (ψ₁ + ψ₂)/2, d = (θ₂ - θ₁)/2,

    n = (-sin d sin 2σ, cos d sin 2δ, sin ψ₁ sin ψ₂ sin 2d)
    p₂ + p₁ = 2 (sin σ cos δ cos d, cos σ sin δ sin d, cos σ cos δ)
    p₂ - p₁ = 2 (cos σ sin δ cos d, sin σ cos δ sin d, -sin σ sin δ)
    l = R atan2(|p₁ × p₂|, p₁ · p₂) = 2 R atan2(|p₂ - p₁|, |p₂ + p₁|)

All are products: no digits are lost for points close together, near a pole or nearly antipodal, provided that the sums
of angles are carried with their round-off. (arccos(p₁ · p₂) loses all of them below 1e-8.)
"""

import warnings
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.display import plots
from lagjax.integrate import AccuracyWarning, integrate
from lagjax.mechanics import accelerations
from lagjax.report import FULL, QUICK, Case, Run, Scene, relative_error
from lagjax.scenes import by_hand
from lagjax.system import Holonomic, System
from lagjax.two_points import geodesic

PARAMS = {"R": 2.5}
# The end points of the generic arc: ψ₁, θ₁, ψ₂, θ₂.
ENDS = (0.875, 0.25, 1.75, 1.625)
# Number of turns in the runs.
TURNS = 20

MISPRINTS = (
    "§1 calls ψ the azimuth and θ the polar angle: z = R cos ψ makes ψ the polar angle (colatitude), θ the azimuth.",
    "§1 prints d/dθ ∂f/∂ψ' - ∂f/∂ψ' in the first line of Lagrange's equation: the second term is ∂f/∂ψ.",
    "§1 prints n·r = R (sin φ (a cos θ + b sin θ) + c cos ψ): it is sin ψ.",
    "§1 says A² + B² < 1: it may be any number, A² + B² = tan²i; below one only for inclinations below 45°.",
    "§1 prints d²q/d²θ: it is d²q/dθ².",
    "§1 has cot ψ = A cos θ + B sin θ as the general geodesic, and the shortest path: it leaves out the meridians, and "
    "an arc longer than π R is stationary but not shortest.",
)


def arc_length(t, q: PyTree, v: PyTree, params: PyTree):
    """f = √(sin²ψ + ψ'²), with t = θ, q = ψ, v = ψ'."""
    return jnp.sqrt(jnp.sin(q) ** 2 + v**2)


def free_particle(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ |ṙ|²."""
    return 0.5 * jnp.sum(v**2)


def sphere(t, q: PyTree, params: PyTree):
    """|r|² - R²."""
    return jnp.sum(q**2) - params["R"] ** 2


over_azimuth = System(arc_length)
embedded = System(free_particle, constraints={"sphere": Holonomic(sphere)})


class GreatCircle(NamedTuple):
    """The plane through two points, and their minor arc.

    `A`, `B`: cot ψ = A cos θ + B sin θ; infinite for a meridian. `normal`: p₁ × p₂, upwards if θ increases from the
    first to the second point; `angle`: the arc in radians. `vertex_*` is the point nearest to the pole, `mid_*` the
    middle of the arc; colatitude and azimuth each.
    """

    A: jax.Array
    B: jax.Array
    normal: jax.Array
    angle: jax.Array
    clairaut: jax.Array
    vertex_colatitude: jax.Array
    vertex_azimuth: jax.Array
    mid_colatitude: jax.Array
    mid_azimuth: jax.Array


def great_circle(psi1, theta1, psi2, theta2) -> GreatCircle:
    """The great circle through two points.

    **Raises:** `ValueError` if they coincide or are antipodal to round-off: every plane through one contains the other.
    Their distance is still determined: `distance`.
    """
    circle = plane_and_arc(psi1, theta1, psi2, theta2)
    angle, round_off = float(circle.angle), 4 * np.finfo(float).eps
    # π is rounded: beyond half a turn the points themselves are known only to round-off.
    blur = round_off if abs(theta2 - theta1) > np.pi else 0.0
    if angle <= blur or angle >= np.pi - round_off:
        how = "coincide" if angle < 1 else "are antipodal"
        raise ValueError(
            f"the points (psi, theta) = ({psi1:.6g}, {theta1:.6g}) and ({psi2:.6g}, {theta2:.6g}) {how}: the plane of "
            "the great circle is not determined.\n"
            "Fix: choose a third point on the way. The distance alone is given by sphere_geodesic.distance."
        )
    return circle


def distance(params: PyTree, psi1, theta1, psi2, theta2):
    """The length of the minor arc, with full accuracy at every separation."""
    return params["R"] * plane_and_arc(psi1, theta1, psi2, theta2).angle


@jax.jit
def plane_and_arc(psi1, theta1, psi2, theta2) -> GreatCircle:
    """Like `great_circle`, but without refusing any points."""
    sum_of_psi, difference_of_psi = _sum(psi1, psi2), _sum(psi2, -psi1)
    turn, twice_mean = _sum(theta2, -theta1), _sum(theta1, theta2)
    sin_sigma, cos_sigma = _half(sum_of_psi)
    sin_delta, cos_delta = _half(difference_of_psi)
    sin_d, cos_d = _half(turn)
    mean = _half(twice_mean)

    n = [
        -2 * sin_d * sin_sigma * cos_sigma,
        2 * cos_d * sin_delta * cos_delta,
        2 * jnp.sin(psi1) * jnp.sin(psi2) * sin_d * cos_d,
    ]
    middle = [sin_sigma * cos_delta * cos_d, cos_sigma * sin_delta * sin_d, cos_sigma * cos_delta]
    half_chord = [cos_sigma * sin_delta * cos_d, sin_sigma * cos_delta * sin_d, sin_sigma * sin_delta]
    nx, ny = _turned(n[0], n[1], mean)
    mx, my = _turned(middle[0], middle[1], mean)
    way = jnp.where(n[2] < 0, -1.0, 1.0)
    return GreatCircle(
        A=-nx / n[2],
        B=-ny / n[2],
        normal=jnp.stack([nx, ny, n[2]]),
        angle=2 * jnp.arctan2(_length(half_chord), _length(middle)),
        clairaut=jnp.abs(n[2]) / _length(n),
        vertex_colatitude=jnp.arctan2(jnp.abs(n[2]), jnp.hypot(nx, ny)),
        vertex_azimuth=jnp.arctan2(-way * ny, -way * nx),
        mid_colatitude=jnp.arctan2(jnp.hypot(mx, my), middle[2]),
        mid_azimuth=jnp.arctan2(my, mx),
    )


def _sum(a, b):
    """a + b and its round-off, exactly (Knuth's two-sum)."""
    s = a + b
    kept = s - a
    return s, (a - (s - kept)) + (b - kept)


def _half(angle):
    """Sine and cosine of half an angle that is given with its round-off."""
    x, rest = 0.5 * angle[0], 0.5 * angle[1]
    sine, cosine = jnp.sin(x), jnp.cos(x)
    return sine + rest * cosine, cosine - rest * sine


def _turned(x, y, sine_and_cosine):
    sine, cosine = sine_and_cosine
    return x * cosine - y * sine, x * sine + y * cosine


def _length(vector):
    return jnp.hypot(jnp.hypot(vector[0], vector[1]), vector[2])


@jax.jit
def cartesian(params: PyTree, psi, theta):
    """r of a point, (..., 3)."""
    return params["R"] * jnp.stack(
        [jnp.sin(psi) * jnp.cos(theta), jnp.sin(psi) * jnp.sin(theta), jnp.cos(psi) + 0 * theta], axis=-1
    )


@jax.jit
def exact_over_azimuth(A, B, theta):
    """ψ and ψ' where cot ψ = A cos θ + B sin θ."""
    q, slope = A * jnp.cos(theta) + B * jnp.sin(theta), B * jnp.cos(theta) - A * jnp.sin(theta)
    return jnp.arctan2(1.0, q), -slope / (1 + q**2)


@jax.jit
def exact_embedded(q0: PyTree, v0: PyTree, s):
    """r and dr/ds at (T,) arc lengths, from the start of a path of unit speed."""
    R = jnp.sqrt(jnp.sum(q0**2))
    cosine, sine = jnp.cos(s / R)[:, None], jnp.sin(s / R)[:, None]
    q0, v0 = q0[None, :], v0[None, :]
    return q0 * cosine + R * v0 * sine, v0 * cosine - q0 * sine / R


def exact_multiplier(params: PyTree):
    """λ = -1 / (2 R²) at unit speed."""
    return -0.5 / params["R"] ** 2


def start_towards(params: PyTree, psi1, theta1, psi2, theta2):
    """A start in r at the first point, of unit speed, along the minor arc to the second."""
    return _towards(params, psi1, theta1, great_circle(psi1, theta1, psi2, theta2).normal)


@jax.jit
def _towards(params: PyTree, psi, theta, normal):
    q = cartesian(params, psi, theta)
    v = jnp.cross(normal, q)
    return q, v / _length(v)


def varied_length(angle, amplitude):
    """The length, over R, of an arc of `angle` displaced sideways by `amplitude` sin(π s / angle)."""
    nodes, weights = np.polynomial.legendre.leggauss(40)
    s = 0.5 * angle * (nodes + 1)
    u, slope = amplitude * jnp.sin(np.pi * s / angle), amplitude * np.pi / angle * jnp.cos(np.pi * s / angle)
    return 0.5 * angle * jnp.sum(weights * jnp.sqrt(jnp.cos(u) ** 2 + slope**2))


def second_variation(angle):
    """The second derivative of `varied_length` at zero: ½ S ((π/S)² - 1), negative for more than half a turn."""
    return 0.5 * angle * ((np.pi / angle) ** 2 - 1)


def runs():
    """The source's form and the embedded one, the latter over both poles; twenty times around."""
    return [_generic(), _over_the_poles()]


def _generic():
    circle = great_circle(*ENDS)
    ts = np.array([ENDS[1], ENDS[3], ENDS[1] + 2 * np.pi * TURNS])
    q0, v0 = map(float, exact_over_azimuth(circle.A, circle.B, ts[0]))

    def error(trajectory):
        return relative_error((trajectory.q, trajectory.v), exact_over_azimuth(circle.A, circle.B, ts))

    words = "ψ and ψ' against cot ψ"
    return Run("over the azimuth", over_azimuth, PARAMS, q0, v0, ts, error, words, 1e-8, by_hand=by_hand.geodesic)


def _over_the_poles():
    q0, v0 = start_towards(PARAMS, 0.5, 0.0, 0.25, np.pi)
    # Outputs are 5/8 of a turn apart, so they visit every eighth of a turn.
    ts = np.linspace(0.0, 2 * np.pi * TURNS * PARAMS["R"], 33)

    def error(trajectory):
        return relative_error((trajectory.q, trajectory.v), exact_embedded(q0, v0, ts))

    words = "r and dr/ds against the circle"
    return Run(
        "embedded, over both poles", embedded, PARAMS, q0, v0, ts, error, words, 1e-7,
        by_hand=by_hand.on_sphere, tier=FULL,
    )  # fmt: skip


def arrivals(q0: PyTree, v0: PyTree, arc):
    """The end points (N, 3) of starts in r after their arc lengths."""
    # One after another, by one short program: one of lanes would compile for three times as long.
    return [_path(embedded, q, v, 0.0, s, OUTPUTS, 1e-10).end.q for q, v, s in zip(q0, v0, arc)]


def colatitudes(psi, slope, theta1, theta2, atol):
    """ψ(θ₂) for starts (ψ, ψ') at θ₁, over the azimuth."""
    starts = zip(psi, slope, theta1, theta2, atol)
    return [_path(over_azimuth, q, v, a, b, DRAWN, tolerance).end.q for q, v, a, b, tolerance in starts]


def _path(system, q0: PyTree, v0: PyTree, start, end, outputs, atol):
    ts = np.linspace(float(start), float(end), outputs)
    return integrate(system, q0, v0, PARAMS, ts=ts, rtol=1e-10, atol=atol)


# Name: ψ₁, θ₁, ψ₂, θ₂.
ARCS = {
    "generic": ENDS,
    "inclined by 77 deg, A² + B² = 18": (0.25, 0.5, 0.5, 2.0),
    "along a meridian": (0.75, 0.25, 1.875, 0.25),
    "over the pole": (0.5, 0.0, 0.25, np.pi),
    "from the pole": (0.0, 0.3, 1.0, 2.0),
    "1e-12 off the pole": (2.0**-40, 0.0, 2.0**-40, 1.0),
    "1e-9 apart": (1.0, 0.5, 1.0 + 2.0**-30, 0.5 + 2.0**-30),
    "antipodal but for 1e-8": (0.75, 0.25, np.pi - 0.75 + 1e-8, np.pi + 0.25 + 1e-8),
    "along the equator": (np.pi / 2, 0.5, np.pi / 2, 1.75),
}
WIDE = (1.0, 0.0, 1.25, 4.5)
# Outputs of embedded paths, and of those over the azimuth: as many for all, so that each form needs one program.
OUTPUTS, DRAWN = 101, 25


def cases(tier=FULL):
    """Poles, meridians, the equator, close and nearly antipodal points; both forms; refused inputs."""
    if tier == QUICK:
        return [*_over_azimuth_cases(), *_undetermined_cases()]
    starts = [start_towards(PARAMS, *ends) for ends in ARCS.values()]
    arcs = [distance(PARAMS, *ends) for ends in ARCS.values()]
    # Backwards along the great circle: the long way to the same point.
    q, v = start_towards(PARAMS, *WIDE)
    starts.append((q, -v))
    arcs.append(2 * np.pi * PARAMS["R"] - distance(PARAMS, *WIDE))
    got = arrivals(*zip(*starts), arcs)
    names = [*(f"{name}, embedded" for name in ARCS), "more than pi of azimuth, embedded"]
    rows = []
    for name, ends, q, arc in zip(names, [*ARCS.values(), WIDE], got, arcs):
        error = relative_error(q, cartesian(PARAMS, *ends[2:]))
        rows.append(Case(name, f"arrives after s = {float(arc):.6g}", error, 1e-9))
    rows += _over_azimuth_cases()
    # The search between two points compiles for longer than all others.
    found = ("generic", "along a meridian", "over the pole") if tier == FULL else ()
    rows += [_from_two_points(name) for name in found]
    return [*rows, *_undetermined_cases(), _at_the_pole(), _thousand_turns()]


def _undetermined_cases():
    ends = {"coincident points": (1.0, 0.5, 1.0, 0.5), "antipodal points": (0.0, 0.0, np.pi, 1.0)}
    return [_undetermined(name, points) for name, points in ends.items()]


def _from_two_points(name: str):
    """The shortest path between two points, as the source asks for it: its length and its first direction."""
    ends = ARCS[name]
    q, v = start_towards(PARAMS, *ends)
    found = geodesic(embedded, np.asarray(q), np.asarray(cartesian(PARAMS, *ends[2:])), PARAMS, outputs=2)
    error = relative_error((found.length, found.start_direction), (distance(PARAMS, *ends), v))
    return Case(f"{name}, from two points", f"length {float(found.length):.6g}, {found.kind}", error, 1e-12)


def _over_azimuth_cases():
    """θ as the independent variable, where this is possible: ψ at the second end."""
    arcs = {name: ARCS[name] for name in ARCS if name not in ("along a meridian", "over the pole", "from the pole")}
    arcs = arcs | {"more than pi of azimuth": WIDE}
    circles = [great_circle(*ends) for ends in arcs.values()]
    theta1, psi2, theta2 = (np.array(column) for column in list(zip(*arcs.values()))[1:])
    A, B = (jnp.stack(column) for column in list(zip(*circles))[:2])
    # Next to the pole ψ itself is small, so its absolute tolerance must be small too.
    got = colatitudes(*exact_over_azimuth(A, B, theta1), theta1, theta2, 1e-10 * np.minimum(1.0, psi2))
    happened = {"more than pi of azimuth": "the major arc: stationary, not the shortest"}
    return [
        Case(f"{name}, over azimuth", happened.get(name, "ψ(θ₂) as given"), abs(float(a) / b - 1), 1e-9)
        for name, a, b in zip(arcs, got, psi2)
    ]


def _undetermined(name: str, ends):
    try:
        great_circle(*ends)
    except ValueError as error:
        length, right = float(distance(PARAMS, *ends)), 0.0 if ends[0] == ends[2] else np.pi * PARAMS["R"]
        reason = str(error).split("\n")[0].split(": ")[-1].rstrip(".")
        return Case(name, f"refused, {reason}; length {length:.6g}", relative_error(length, right), 1e-15)
    return Case(name, "NOT REFUSED", np.inf, 0.0)


def _at_the_pole():
    """Over the azimuth the mass matrix sin²ψ / f³ is zero at the pole."""
    try:
        accelerations(over_azimuth, 0.0, 0.0, 1.0, PARAMS)
    except ValueError as error:
        return Case("from the pole, over azimuth", "refused: " + str(error).split(":")[0], 0.0, 0.0)
    return Case("from the pole, over azimuth", "NOT REFUSED", np.inf, 0.0)


def _thousand_turns():
    q0, v0 = start_towards(PARAMS, *ENDS)
    with warnings.catch_warnings():
        # Of the phase, which is printed; judged is how far the path leaves the sphere.
        warnings.simplefilter("ignore", AccuracyWarning)
        path = _path(embedded, q0, v0, 0.0, 2000 * np.pi * PARAMS["R"], OUTPUTS, 1e-10)
    off = relative_error(path.q, exact_embedded(q0, v0, path.t)[0])
    happened = f"worst residual (the error here); r off by {off:.0e}, speed by {float(path.drift()):.0e}"
    return Case("1000 turns, embedded", happened, float(path.residual()), 1e-12)


def picture(tier=FULL):
    """Integrated great circles over the azimuth, and the saddle of an arc longer than half a turn."""
    fig, axes = plots.figure(1, 2, size=(4.8, 3.6))
    axis, theta = axes[0, 0], np.linspace(-np.pi, np.pi, DRAWN)
    fine = np.linspace(-np.pi, np.pi, 361)
    for i, inclination in enumerate((20.0, 45.0, 60.0, 80.0)):
        A = float(np.tan(np.radians(inclination)))
        q0, v0 = map(float, exact_over_azimuth(A, 0.0, theta[0]))
        path = integrate(over_azimuth, q0, v0, PARAMS, ts=theta, rtol=1e-9, atol=1e-9)
        axis.plot(np.degrees(fine), np.degrees(exact_over_azimuth(A, 0.0, fine)[0]), **plots.style(i))
        marks = {"color": plots.COLOURS[i], "marker": plots.MARKERS[i], "markersize": 4, "linestyle": ""}
        axis.plot(np.degrees(theta), np.degrees(path.q), label=f"{inclination:.0f}°, A² + B² = {A**2:.2g}", **marks)
    axis.set(xlabel="azimuth θ / degrees", ylabel="colatitude ψ / degrees", title="Integrated, on cot ψ = A cos θ")
    axis.set_xticks(range(-180, 181, 90))
    axis.invert_yaxis()
    axis.legend(fontsize=8, frameon=False, title="inclination", title_fontsize=8)
    axis, amplitude = axes[0, 1], np.linspace(-0.5, 0.5, 41)
    minor = float(great_circle(*WIDE).angle)
    lengths = jax.jit(jax.vmap(varied_length, (None, 0)))
    for i, (name, angle) in enumerate((("minor", minor), ("half turn", np.pi), ("major", 2 * np.pi - minor))):
        change = np.asarray(lengths(angle, amplitude)) - angle
        axis.plot(amplitude, change, label=f"{name}, {np.degrees(angle):.0f}°", **plots.style(i))
    axis.set(xlabel="sideways displacement / R", ylabel="change of length / R", title="Stationary, not always shortest")
    axis.legend(fontsize=8, frameon=False)
    return fig


SCENE = Scene(
    name="sphere_geodesic",
    title="Geodesics on a sphere",
    source="Goldstein, Classical Mechanics, Derivation 2-4; source document §1",
    misprints=MISPRINTS,
    runs=runs,
    cases=cases,
    picture=picture,
)
