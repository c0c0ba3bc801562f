"""Which explicit method reaches an error soonest, and is the default the one?

One or two motions of each of the six scenes, the bead over 100 periods, and the pendulum in Cartesian coordinates:
every method at half decades of tolerance, from 1e-4 on, until its error stays below the smallest asked for. Of each
method the fastest solve within an error counts. Errors are those of coordinates and velocities (and of multipliers,
where the scene compares them) at the outputs, against closed forms; where there is none, against SciPy's DOP853 at
3e-14 on equations derived by hand (`by_hand.py`).

The default wins where it is at most a tenth slower than the fastest. All methods run through `lj.integrate`, at one
tolerance in turn; times are of compiled solves, medians.

    python benchmarks/work_precision.py [--json FILE] [--only TEXT] [--plot FILE]
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import by_hand
import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax.flatten_util import ravel_pytree
from measure import in_turn, main, row, skipped
from peers import scipy_dop853
from scipy import special

import lagjax as lj
from lagjax.scenes import SCENES, bead_on_hoop

jax.config.update("jax_enable_x64", True)

LADDER = tuple(10.0 ** (-k / 2) for k in range(8, 26))
LEVELS = (1e-4, 1e-6, 1e-8, 1e-10)
WINS_WITHIN = 1.1
REPEATS = 11
PERIODS, PENDULUM_END = 100, 20.0
# Runs of the scenes, by the beginning of their names; those of mass_distributions without a closed form stand below.
RUNS = {
    "sphere_geodesic": ("over the azimuth", "embedded"),
    "rolling_hoop": ("10 swings",),
    "bead_on_hoop": ("through the bottom", "driven"),
    "mass_distributions": ("inside the ellipse",),
    "sliding_wedge": ("thrown uphill",),
    "cross_rails": ("rotating frame", "lab frame"),
}


class Motion(NamedTuple):
    """A motion with a known answer; `error` is that of a trajectory, relative."""

    name: str
    system: lj.System
    params: Any
    q0: Any
    v0: Any
    ts: np.ndarray
    error: Callable


class Point(NamedTuple):
    """One method at one tolerance."""

    tolerance: float
    error: float
    median: float
    least: float


def methods():
    """The default; diffrax's explicit methods, and our own as far as there are any; by name."""
    own = [getattr(lj, name, None) for name in ("Tsit5", "Dopri5", "Dopri8")]
    theirs = (diffrax.Tsit5, diffrax.Dopri5, diffrax.Dopri8)
    found = {"default": None} | {f"{kind.__name__} (diffrax)": kind() for kind in theirs}
    return found | {kind.__name__: kind() for kind in own if kind is not None}


def motions(wanted):
    """The motions whose name is asked for."""
    built = [
        (f"{scene}, {run}", lambda scene=scene, run=run: of_scene(scene, run))
        for scene, runs in RUNS.items()
        for run in runs
    ]
    built += [(f"mass_distributions, {name}", lambda name=name: in_field(name)) for name in ("helix", "dumbbell")]
    built += [(f"bead_on_hoop, {PERIODS} periods", long_bead), ("Cartesian pendulum", cartesian_pendulum)]
    return [build()._replace(name=name) for name, build in built if wanted(name)]


def of_scene(scene, beginning):
    """A run that `python -m lagjax` checks."""
    run = next(run for run in SCENES[scene].runs() if run.name.startswith(beginning))
    return Motion(run.name, run.system, run.params, run.q0, run.v0, run.ts, run.error)


def in_field(name):
    """An orbit about a mass distribution, against SciPy and the field derived by hand."""
    case = next(case for case in by_hand.CASES if case.name == f"mass_distributions, {name}")
    start, as_state = ravel_pytree((case.q0, case.v0))
    field = jax.jit(lambda t, y: ravel_pytree((as_state(y)[1], case.by_hand(t, *as_state(y), case.params)[0]))[0])
    q0, v0, end = by_hand.mass_distributions.ORBITS[name]
    right = scipy_dop853(lambda t, y: np.asarray(field(t, y)), np.asarray(start), end)(3e-14)()

    def error(trajectory):
        found = ravel_pytree(jax.tree.map(lambda x: x[-1], (trajectory.q, trajectory.v)))[0]
        return float(np.max(np.abs(found - right)) / np.max(np.abs(right)))

    return Motion(name, case.system, case.params, q0, v0, np.array([0.0, end]), error)


def long_bead():
    """The bead over many periods; its state at the end, rates by the mean one."""
    params, start = bead_on_hoop.PARAMS, 1.0
    period = float(bead_on_hoop.exact_period(params, start))
    ts = np.array([0.0, PERIODS * period])
    right = np.array(bead_on_hoop.exact_motion(params, start, ts[-1]))

    def error(trajectory):
        found = np.array([trajectory.q[-1], trajectory.v[-1]])
        return float(np.max(np.abs(found - right) * [1.0, period / (2 * np.pi)]))

    return Motion("", bead_on_hoop.system, params, start, 0.0, ts, error)


def cartesian_pendulum():
    """A mass on a rod, released from the horizontal; against Jacobi's elliptic functions."""
    params, l, k = {"g": 9.8125, "l": 1.25}, 1.25, np.sqrt(0.5)
    swing = np.sqrt(params["g"] / l)
    sn, cn, dn, _ = special.ellipj(swing * PENDULUM_END, k**2)
    angle, rate = 2 * np.arcsin(k * cn / dn), -2 * k * np.sqrt(1 - k**2) * swing * sn / dn
    s, c = np.sin(angle), np.cos(angle)
    right = np.array([l * s, -l * c, l * rate * c, l * rate * s])

    def lagrangian(t, q, v, params):
        return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]

    def rod(t, q, params):
        return q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2

    def error(trajectory):
        found = np.array([x[-1] for x in (*trajectory.q.values(), *trajectory.v.values())])
        return float(np.max(np.abs(found - right) / [l, l, l * swing, l * swing]))

    system = lj.System(lagrangian, {"rod": lj.Holonomic(rod)})
    start = {"x": l, "y": 0.0}, {"x": 0.0, "y": 0.0}
    return Motion("", system, params, *start, np.array([0.0, PENDULUM_END]), error)


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
    """The points of each method, down the ladder until two in a row are below the smallest error asked for."""
    found = {name: [] for name in solves}
    for tolerance in LADDER:
        active = [name for name, points in found.items() if not finished(points)]
        if not active:
            break
        errors = [motion.error(solves[name](tolerance)) for name in active]
        times = in_turn(*(lambda name=name: solves[name](tolerance) for name in active), repeats=REPEATS)
        for name, error, *seconds in zip(active, errors, times.medians, times.minima):
            found[name].append(Point(tolerance, error, *seconds))
    return found


def finished(points):
    """Whether a method need not go on."""
    return len(points) > 1 and all(point.error <= LEVELS[-1] for point in points[-2:])


def soonest(points, level):
    """The least of a method's medians and minima within an error; infinite where there is none."""
    return [min((getattr(p, kind) for p in points if p.error <= level), default=np.inf) for kind in ("median", "least")]


def rows(wanted, drawn):
    """Default over fastest, for each motion and error; the curves are kept in `drawn`."""
    for motion in motions(wanted):
        found = drawn[motion.name] = curves(motion, {name: program(motion, kind) for name, kind in methods().items()})
        for level in LEVELS:
            seconds = {name: soonest(points, level) for name, points in found.items()}
            default, what = seconds.pop("default"), f"{motion.name}, error {level:.0e}"
            fastest = min(seconds, key=seconds.get)
            if not np.isfinite(seconds[fastest][0]):
                yield skipped(what, "no method reaches it")
                continue
            value, of_minima = (ours / theirs for ours, theirs in zip(default, seconds[fastest]))
            ms = {f"{name} ms": 1e3 * value for name, (value, _) in seconds.items()}
            yield row(
                what, value, WINS_WITHIN, minima=of_minima, fastest=fastest, **{"default ms": 1e3 * default[0]}, **ms
            )


def draw(path, drawn):
    """Error over run time, one panel a motion."""
    columns = min(4, len(drawn))
    figure, axes = plt.subplots(-(-len(drawn) // columns), columns, figsize=(4 * columns, 11), squeeze=False)
    for panel in axes.flat[len(drawn) :]:
        panel.set_visible(False)
    for panel, (name, found) in zip(axes.flat, drawn.items()):
        for method, points in found.items():
            style = {"color": "black", "linewidth": 2.5, "alpha": 0.4} if method == "default" else {"marker": "."}
            panel.loglog([1e3 * p.median for p in points], [p.error for p in points], label=method, **style)
        panel.set(title=name, xlabel="ms", ylabel="error", ylim=(1e-14, 1))
    axes[0, 0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    curves_by_motion = {}
    main(partial(rows, drawn=curves_by_motion), __doc__, draw=partial(draw, drawn=curves_by_motion))
