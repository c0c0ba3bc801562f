"""Which explicit method reaches an error soonest, and is it the default?

Motions of the six scenes and the pendulum in Cartesian coordinates, over tens of periods. Every method runs at half
decades of tolerance, from 1e-4 on, until its error stays below the smallest required one; its fastest solve within an
error counts. Errors are those of coordinates and velocities at the end, each relative to its largest value during the
motion. The reference is a closed form; if there is none, it is SciPy's DOP853 at 3e-14 on equations derived by hand
(`by_hand.py`), and errors are relative to the largest number of the state.

The default wins if it is at most a tenth slower than the fastest. All methods run through `lj.integrate`, alternately
at each tolerance; times are medians of compiled solves.

    python -m benchmarks.accuracy.work_precision [--json FILE] [--only TEXT] [--plot FILE]
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree
from scipy import special

import lagjax as lj
from benchmarks.accuracy import by_hand
from benchmarks.measure import in_turn, main, row, skipped
from benchmarks.speed.peers import scipy_dop853
from lagjax.scenes import bead_on_hoop, cross_rails, mass_distributions, rolling_hoop, sliding_wedge, sphere_geodesic

jax.config.update("jax_enable_x64", True)

LADDER = tuple(10.0 ** (-k / 2) for k in range(8, 26))
LEVELS = (1e-4, 1e-6, 1e-8, 1e-10)
WINS_WITHIN = 1.1
REPEATS, SLOWEST = 5, 0.03
DEFAULT = "default"


class Motion(NamedTuple):
    """A motion from `ts[0]` to `ts[1]`; `exact(t)` is (q, v) at the end and, if known, at other times."""

    system: lj.System
    params: Any
    q0: Any
    v0: Any
    ts: np.ndarray
    exact: Callable


class Point(NamedTuple):
    """One method at one tolerance."""

    tolerance: float
    error: float
    median: float
    least: float


def solves_of(motion):
    """Solves by name: the default, diffrax's explicit methods and our other ones."""
    default = program(motion, None)
    chosen = default(LADDER[0]).static.method
    found = {DEFAULT: default}
    for kind in (diffrax.Tsit5, diffrax.Dopri5, diffrax.Dopri8):
        found[f"diffrax.{kind.__name__}"] = program(motion, kind())
    ours = ["Tsit5", "Dopri8", *(["Nystrom8"] if chosen == "Nystrom12" else [])]
    return found | {f"lj.{name}": program(motion, getattr(lj, name)()) for name in ours if name != chosen}


def geodesic():
    """Twenty times around the sphere, over the azimuth."""
    circle = sphere_geodesic.great_circle(*sphere_geodesic.ENDS)
    exact = lambda theta: sphere_geodesic.exact_over_azimuth(circle.A, circle.B, theta)
    return Motion(sphere_geodesic.over_azimuth, sphere_geodesic.PARAMS, *exact(0.0), np.array([0.0, 40 * np.pi]), exact)


def embedded_geodesic():
    """Twenty times around, over both poles, constrained to the sphere."""
    params = sphere_geodesic.PARAMS
    start = sphere_geodesic.start_towards(params, 0.5, 0.0, 0.25, np.pi)
    exact = lambda s: sphere_geodesic.exact_embedded(*start, np.atleast_1d(s))
    return Motion(sphere_geodesic.embedded, params, *start, np.array([0.0, 40 * np.pi * params["R"]]), exact)


def hoop():
    """Twenty swings about the bottom of the cylinder, rolling."""
    params, theta = rolling_hoop.PARAMS, rolling_hoop.BOTTOM + 1.0
    end = 20 * rolling_hoop.period(params, theta)
    exact = lambda t: rolling_hoop.exact_motion(params, theta, t)
    return Motion(rolling_hoop.system, params, *rolling_hoop.start(params, theta), np.array([0.0, end]), exact)


def bead():
    """The bead released at rest, 100 periods."""
    params = bead_on_hoop.PARAMS
    end = 100 * float(bead_on_hoop.exact_period(params, 1.0))
    exact = lambda t: bead_on_hoop.exact_motion(params, 1.0, t)
    return Motion(bead_on_hoop.system, params, 1.0, 0.0, np.array([0.0, end]), exact)


def driven_bead():
    """The hoop's angle kept as a coordinate, 20 periods of the bead."""
    params = bead_on_hoop.PARAMS
    end = 20 * float(bead_on_hoop.exact_period(params, 1.0))

    def exact(t):
        psi, rate = bead_on_hoop.exact_motion(params, 1.0, t)
        return {"psi": psi, "theta": params["omega"] * t}, {"psi": rate, "theta": params["omega"] + 0 * t}

    start = bead_on_hoop.driven_start(params, 1.0)
    return Motion(bead_on_hoop.driven_system, params, *start, np.array([0.0, end]), exact)


def inside_ellipse():
    """Two oscillations and free flight within an elliptic cylinder."""
    params, start = mass_distributions.PARAMS["elliptic cylinder"], mass_distributions.INSIDE
    exact = lambda t: mass_distributions.exact_inside_ellipse(params, *start, t)
    return Motion(mass_distributions.SYSTEMS["elliptic cylinder"], params, *start, np.array([0.0, 80.0]), exact)


def in_field(name):
    """An orbit about a mass distribution, against SciPy and the field derived by hand."""
    case = next(case for case in by_hand.CASES if case.name == f"mass_distributions, {name}")
    q0, v0, end = mass_distributions.ORBITS[name]
    start, as_state = ravel_pytree((q0, v0))
    field = jax.jit(lambda t, y: ravel_pytree((as_state(y)[1], case.by_hand(t, *as_state(y), case.params)[0]))[0])
    right = scipy_dop853(lambda t, y: np.asarray(field(t, y)), np.asarray(start), end)(3e-14)()
    # The state is one vector, so it has one scale.
    return Motion(case.system, case.params, q0, v0, np.array([0.0, end]), lambda t: right)


def wedge():
    """Uniform acceleration, which every method integrates without error."""
    params, end = sliding_wedge.PARAMS, 0.75
    start = sliding_wedge.start_on_incline(params, X=0.25, X_rate=0.5, along=0.125, along_rate=-0.75)
    exact = lambda t: sliding_wedge.exact_motion(params, *start, t)
    return Motion(sliding_wedge.system, params, *start, np.array([0.0, end]), exact)


def rails(in_lab):
    """The carriage for 100 s, in the rotating frame or in the lab's."""
    params, start = cross_rails.PARAMS, (cross_rails.Q0, cross_rails.V0)

    def exact(t):
        state = cross_rails.exact_motion(params, *start, t)
        return cross_rails.to_lab(params, t, *state) if in_lab else state

    system = cross_rails.lab_system if in_lab else cross_rails.rotating_system
    return Motion(system, params, *(exact(0.0) if in_lab else start), np.array([0.0, 100.0]), exact)


def cartesian_pendulum():
    """A mass on a rod, released from the horizontal, for 20 s; against Jacobi's elliptic functions."""
    params, l, k = {"g": 9.8125, "l": 1.25}, 1.25, np.sqrt(0.5)
    swing = np.sqrt(params["g"] / l)

    def lagrangian(t, q, v, params):
        return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]

    def rod(t, q, params):
        return q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2

    def exact(t):
        sn, cn, dn, _ = special.ellipj(swing * t, k**2)
        angle, rate = 2 * np.arcsin(k * cn / dn), -2 * k * np.sqrt(1 - k**2) * swing * sn / dn
        s, c = l * np.sin(angle), l * np.cos(angle)
        return {"x": s, "y": -c}, {"x": rate * c, "y": rate * s}

    system = lj.System(lagrangian, {"rod": lj.Holonomic(rod)})
    return Motion(system, params, {"x": l, "y": 0.0}, {"x": 0.0, "y": 0.0}, np.array([0.0, 20.0]), exact)


MOTIONS = {
    "sphere_geodesic, over the azimuth": geodesic,
    "sphere_geodesic, embedded": embedded_geodesic,
    "rolling_hoop": hoop,
    "bead_on_hoop": bead,
    "bead_on_hoop, driven": driven_bead,
    "mass_distributions, ellipse": inside_ellipse,
    "mass_distributions, dumbbell": partial(in_field, "dumbbell"),
    "mass_distributions, helix": partial(in_field, "helix"),
    "sliding_wedge": wedge,
    "cross_rails, rotating": partial(rails, False),
    "cross_rails, lab": partial(rails, True),
    "Cartesian pendulum": cartesian_pendulum,
}


def error_of(motion):
    """The largest relative error of a trajectory's end."""
    right = jax.tree.leaves(motion.exact(motion.ts[1]))
    on_the_way = jax.tree.leaves(motion.exact(np.linspace(*motion.ts, 500)))
    scales = [float(np.max(np.abs(x))) or 1.0 for x in on_the_way]

    def error(trajectory):
        found = jax.tree.leaves(jax.tree.map(lambda x: np.asarray(x[-1]), (trajectory.q, trajectory.v)))
        if len(right) == 1:
            found = [np.stack(found)]
        # Unlike max, this keeps NaN.
        return float(np.max([np.max(np.abs(x - y)) / scale for x, y, scale in zip(found, right, scales, strict=True)]))

    return error


def program(motion, method):
    """A solve that takes its tolerance; initial state and parameters are arguments too."""
    run = jax.jit(
        lambda tolerance, q0, v0, params: lj.integrate(
            motion.system, q0, v0, params, ts=motion.ts, rtol=tolerance, atol=tolerance, method=method, throw=False
        )
    )
    arguments = jax.tree.map(jnp.asarray, (motion.q0, motion.v0, motion.params))
    return lambda tolerance: run(jnp.asarray(tolerance), *arguments)


def curves(motion, solves):
    """The points of each method, down the ladder until two in a row are below the smallest required error."""
    error, found = error_of(motion), {name: [] for name in solves}
    for tolerance in LADDER:
        active = [name for name, points in found.items() if not finished(points)]
        if not active:
            break
        errors = [error(solves[name](tolerance)) for name in active]
        times = in_turn(*(lambda name=name: solves[name](tolerance) for name in active), repeats=REPEATS)
        for name, *point in zip(active, errors, times.medians, times.minima):
            found[name].append(Point(tolerance, *point))
    return found


def finished(points):
    """Whether a method is done or takes too long."""
    within = len(points) > 1 and all(point.error <= LEVELS[-1] for point in points[-2:])
    return within or (points and points[-1].median > SLOWEST)


def soonest(points, level):
    """The smallest median and minimum of a method's times within an error; infinite if there is none."""
    return [min((getattr(p, kind) for p in points if p.error <= level), default=np.inf) for kind in ("median", "least")]


def rows(wanted, drawn):
    """The default's time over the fastest, for each motion and error; `drawn` collects the curves."""
    for name, build in MOTIONS.items():
        if not any(wanted(f"{name}, error {level:.0e}") for level in LEVELS):
            continue
        motion = build()
        found = drawn[name] = curves(motion, solves_of(motion))
        for level in LEVELS:
            seconds = {name: soonest(points, level) for name, points in found.items()}
            what, fastest = f"{name}, error {level:.0e}", min(seconds, key=seconds.get)
            if not wanted(what):
                continue
            if not np.isfinite(seconds[fastest][0]):
                yield skipped(what, "no method reaches it")
                continue
            value, of_minima = np.divide(seconds[DEFAULT], np.min(list(seconds.values()), axis=0))
            ms = {f"{method} ms": 1e3 * median for method, (median, _) in seconds.items()}
            yield row(what, value, WINS_WITHIN, minima=float(of_minima), fastest=fastest, **ms)


def draw(path, drawn):
    """Draw error over run time, one panel per motion."""
    columns = min(4, len(drawn))
    figure, axes = plt.subplots(-(-len(drawn) // columns), columns, figsize=(4 * columns, 11), squeeze=False)
    for panel in axes.flat[len(drawn) :]:
        panel.set_visible(False)
    for panel, (name, found) in zip(axes.flat, drawn.items()):
        for method, points in found.items():
            style = {"color": "black", "linewidth": 2.5, "alpha": 0.4} if method == DEFAULT else {"marker": "."}
            panel.loglog([1e3 * p.median for p in points], [p.error for p in points], label=method, **style)
        panel.set(title=name, xlabel="ms", ylabel="error", ylim=(1e-14, 1))
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    curves_by_motion = {}
    main(partial(rows, drawn=curves_by_motion), __doc__, draw=partial(draw, drawn=curves_by_motion))
