"""Are all crossings found, in order and at the right times, and none invented? And what does an event cost?

1,000 random pairs of a motion and a guard, a x + b y + c x y - level in its coordinates (or velocities, or a
multiplier), at tolerances from 1e-4 to 1e-11. Levels lie anywhere, from 1e-9 to 0.1 of the guard's range below one of
its extrema, from 1e-12 to 1e-3 on either side of one (grazing), and on the guard's value at the start, exactly and
1e-15 on either side. The reference is a closed form, or SciPy's DOP853 at 1e-13 with steps of a fortieth of the span.

The crossings found are judged on the exact motion. The guard's value on it at the found time, divided by the guard's
range, is the error of that time in units of the time in which the guard changes by its range. Unlike the time itself it
is well conditioned even if the guard grazes zero. It may be

    10 rtol + 10 times the error of the motion's state at the end of the span (over its range),

since a crossing cannot be more accurate than the motion on which it lies; "late" counts the crossings beyond that, and
"worst" is the largest error over that bound. An extremum farther from zero than twice the bound and 1e-9 is sure:
between two sure extrema the crossings found must be the exact ones, no more ("invented") and no fewer ("missed").
Around nearer extrema, a number of crossings that differs from the exact one must be flagged by `uncertain` (otherwise
"unsaid"). "needless" is the share of pairs with `uncertain` although no extremum is nearer than a hundred times the
bound.

The twin looks only at the ends of steps: the same program without information in between.

Cost: the time of a solve of fifty periods with an event over that without, measured alternately in one process.

    python -m benchmarks.campaigns.events_found [--json FILE] [--only TEXT] [--pairs N] [--seed N]
"""

import argparse
import sys
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar

import lagjax as lj
from benchmarks.measure import in_turn, main, row
from lagjax.integrate.events import brackets as sampling
from lagjax.scenes import bead_on_hoop

jax.config.update("jax_enable_x64", True)

OPTIONS = {"pairs": 1000, "seed": 0}
MOST, SAMPLES, GUARDS_A_MOTION, LANES = 64, 3001, 5, 25
KINDS = ("anywhere", "below an extremum", "grazing", "on the start")
REPEATS = 15


class Family(NamedTuple):
    """Motions of one system, whose program depends only on numbers.

    `draw(rng)` -> (q0, v0, params, span); `exact(q0, v0, params, span)` -> a function that maps times to the two arrays
    that the guard reads; `guard_inputs(q, v, multipliers)` -> the same two numbers of a state.
    """

    system: Callable[[], lj.System]
    draw: Callable
    exact: Callable
    guard_inputs: Callable
    method: Callable = lambda: None
    tightest: float = -11.0
    multipliers: bool = False


def coupled(x, y, c):
    """The guard without its level."""
    return c["a"] * x + c["b"] * y + c["c"] * x * y


# Exact motions.


def by_scipy(field, start, span, guard_inputs):
    """The reference for a motion without a closed form."""
    solved = solve_ivp(
        field, (0.0, 1.001 * span), start, "DOP853", rtol=1e-13, atol=1e-14, max_step=span / 40, dense_output=True
    )
    return lambda t: guard_inputs(solved.sol(t))


def oscillation(q0, v0, p, span):
    """q'' = -w² q + A cos(W t) - 2 k q'."""
    w, k, A, W = (p[name] for name in ("w", "k", "A", "W"))
    # The steady part, then the free one.
    gain = A / (w**2 - W**2 + 2j * k * W)
    free = np.sqrt(w**2 - k**2)
    c = q0 - gain.real
    s = (v0 - (1j * W * gain).real + k * c) / free

    def at(t):
        steady, decay = gain * np.exp(1j * W * t), np.exp(-k * t)
        q = steady.real + decay * (c * np.cos(free * t) + s * np.sin(free * t))
        ahead = decay * free * (s * np.cos(free * t) - c * np.sin(free * t))
        return q, (1j * W * steady).real - k * (q - steady.real) + ahead

    return at


def fall(q0, v0, p, span):
    """q'' = -g."""
    return lambda t: (q0 + v0 * t - 0.5 * p["g"] * t**2, v0 - p["g"] * t)


def swing(q0, v0, p, span):
    """q'' = -w² sin q - 2 k q'."""
    field = lambda t, y: [y[1], -(p["w"] ** 2) * np.sin(y[0]) - 2 * p["k"] * y[1]]
    return by_scipy(field, [q0, v0], span, lambda y: (y[0], y[1]))


def rod_swing(q0, v0, p, span):
    """The same in x and y."""
    angle = np.arctan2(q0["x"], -q0["y"])
    rate = v0["x"] * np.cos(angle) + v0["y"] * np.sin(angle)
    field = lambda t, y: [y[1], -p["g"] * np.sin(y[0])]
    return by_scipy(field, [angle, rate], span, lambda y: (np.sin(y[0]), -np.cos(y[0])))


def rod_tension(q0, v0, p, span):
    """x, and the multiplier of (x² + y² - 1) / 2: minus the tension."""
    angle = np.arctan2(q0["x"], -q0["y"])
    rate = v0["x"] * np.cos(angle) + v0["y"] * np.sin(angle)
    field = lambda t, y: [y[1], -p["g"] * np.sin(y[0])]
    return by_scipy(field, [angle, rate], span, lambda y: (np.sin(y[0]), -(y[1] ** 2) - p["g"] * np.cos(y[0])))


def orbit(q0, v0, p, span):
    """Kepler's."""

    def field(t, y):
        cubed = (y[0] ** 2 + y[1] ** 2) ** 1.5
        return [y[2], y[3], -p["mu"] * y[0] / cubed, -p["mu"] * y[1] / cubed]

    return by_scipy(field, [*q0, *v0], span, lambda y: (y[0], y[1]))


def double_swing(q0, v0, p, span):
    """Two rods of length one."""
    g = p["g"]

    def field(t, y):
        a, b, u, w = y
        cosine, sine = np.cos(a - b), np.sin(a - b)
        f, h = -sine * w * w - 2 * g * np.sin(a), sine * u * u - g * np.sin(b)
        det = 2 - cosine * cosine
        return [u, w, (f - cosine * h) / det, (2 * h - cosine * f) / det]

    return by_scipy(field, [*q0, *v0], span, lambda y: (y[0], y[1]))


# Systems, created separately for each use, so that the twin has its own programs.


def oscillator():
    """A driven one."""
    drive = lambda t, q, v, p: p["A"] * jnp.cos(p["W"] * t)
    return lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["w"] ** 2 * q**2, force=drive)


def damped_oscillator():
    """The same with friction."""
    return lj.System(
        lambda t, q, v, p: 0.5 * v**2 - 0.5 * p["w"] ** 2 * q**2,
        force=lambda t, q, v, p: p["A"] * jnp.cos(p["W"] * t), dissipation=lambda t, q, v, p: p["k"] * v**2,
    )  # fmt: skip


def pendulum():
    """By its angle."""
    return lj.System(lambda t, q, v, p: 0.5 * v**2 + p["w"] ** 2 * jnp.cos(q))


def damped_pendulum():
    """With friction."""
    return lj.System(
        lambda t, q, v, p: 0.5 * v**2 + p["w"] ** 2 * jnp.cos(q), dissipation=lambda t, q, v, p: p["k"] * v**2
    )


def rod():
    """A pendulum in x and y."""
    length = lj.Holonomic(lambda t, q, p: 0.5 * (q["x"] ** 2 + q["y"] ** 2 - 1))
    return lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["g"] * q["y"], {"rod": length})


def kepler():
    """A planet."""
    return lj.System(lambda t, q, v, p: 0.5 * v @ v + p["mu"] / jnp.sqrt(q @ q))


def double_pendulum():
    """Two rods, by their angles."""

    def lagrangian(t, q, v, p):
        kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
        return kinetic + p["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

    return lj.System(lagrangian)


def ball():
    """In free fall."""
    return lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q)


def draws_oscillator(rng, k=0.0):
    """Slow and fast drives, far from resonance; two or three periods."""
    w = rng.uniform(0.5, 3.0)
    params = {"w": w, "k": k * w, "A": rng.choice([0.0, 1.0]) * w**2, "W": w * rng.choice([0.31, 2.7, 5.3])}
    return rng.normal(), w * rng.normal(), params, rng.uniform(1.5, 3.0) * 2 * np.pi / w


def draws_pendulum(rng, k=0.0):
    """Swings of up to 170 degrees."""
    w = rng.uniform(0.5, 3.0)
    return rng.uniform(0.3, 2.9), rng.normal() * 0.1, {"w": w, "k": k * w}, rng.uniform(1.5, 3.0) * 2 * np.pi / w


def draws_rod(rng):
    """Swings, and turns over the top, of a rod of length one."""
    angle, rate, g = rng.uniform(-2.5, 2.5), rng.choice([0.3, 3.0]) * rng.normal(), rng.uniform(1.0, 10.0)
    q0 = {"x": np.sin(angle), "y": -np.cos(angle)}
    v0 = {"x": rate * np.cos(angle), "y": rate * np.sin(angle)}
    return q0, v0, {"g": g}, rng.uniform(1.0, 2.5) * 2 * np.pi / np.sqrt(g)


def draws_kepler(rng):
    """Ellipses, starting at the far apsis."""
    e = rng.uniform(0.0, 0.7)
    return np.array([1 + e, 0.0]), np.array([0.0, np.sqrt((1 - e) / (1 + e))]), {"mu": 1.0}, rng.uniform(6.0, 14.0)


def draws_double(rng):
    """Near rest, where the motion is not chaotic."""
    return rng.uniform(-0.8, 0.8, 2), rng.normal(size=2) * 0.5, {"g": rng.uniform(1.0, 9.81)}, rng.uniform(2.0, 6.0)


def draws_ball(rng):
    """Up, and down again."""
    g, v0 = rng.uniform(1.0, 20.0), rng.uniform(0.5, 5.0)
    return rng.uniform(0.0, 2.0), v0, {"g": g}, 2.5 * v0 / g


of_number = lambda q, v, multipliers: (q, v)
of_plane = lambda q, v, multipliers: (q["x"], q["y"])
of_pair = lambda q, v, multipliers: (q[0], q[1])
of_tension = lambda q, v, multipliers: (q["x"], multipliers["rod"])
damped = lambda draw: lambda rng: draw(rng, rng.uniform(0.01, 0.2))
FAMILIES = {
    "oscillator, Nystrom12": Family(oscillator, draws_oscillator, oscillation, of_number),
    "ball, Nystrom12": Family(ball, draws_ball, fall, of_number),
    "pendulum, Nystrom12": Family(pendulum, draws_pendulum, swing, of_number),
    "orbit, Nystrom12": Family(kepler, draws_kepler, orbit, of_pair),
    "damped oscillator, Dopri8": Family(damped_oscillator, damped(draws_oscillator), oscillation, of_number),
    "damped pendulum, Dopri8": Family(damped_pendulum, damped(draws_pendulum), swing, of_number),
    "rod, Dopri8": Family(rod, draws_rod, rod_swing, of_plane),
    "rod's tension, Dopri8": Family(rod, draws_rod, rod_tension, of_tension, multipliers=True),
    "double pendulum, Dopri8": Family(double_pendulum, draws_double, double_swing, of_pair),
    "pendulum, Nystrom8": Family(pendulum, draws_pendulum, swing, of_number, lj.Nystrom8),
    "pendulum, Tsit5": Family(pendulum, draws_pendulum, swing, of_number, lj.Tsit5, -9.0),
    "pendulum, Radau5": Family(pendulum, draws_pendulum, swing, of_number, lj.Radau5, -8.0),
}
IN_LANES = ("oscillator, Nystrom12", "pendulum, Nystrom12", "rod, Dopri8", "damped pendulum, Dopri8")
TWINS = ("oscillator, Nystrom12", "pendulum, Nystrom12", "rod, Dopri8")


def program(family):
    """(q0, v0, params, span, rtol) -> crossing times, their number, `uncertain`, the end state, success."""
    height = lambda q, v, multipliers, c: coupled(*family.guard_inputs(q, v, multipliers), c) - c["level"]
    guard = lambda t, q, v, p: height(q, v, {}, p["guard"])
    if family.multipliers:
        guard = lambda t, q, v, multipliers, p: height(q, v, multipliers, p["guard"])
    system, events = family.system(), {"level": lj.Crossing(guard, terminal=False, most=MOST)}

    def run(q0, v0, params, span, rtol):
        traj = lj.integrate(
            system, q0, v0, params, ts=jnp.stack([jnp.zeros_like(span), span]), rtol=rtol, atol=rtol, events=events,
            method=family.method(), throw=False,
        )  # fmt: skip
        found, end = traj.events["level"], family.guard_inputs(traj.end.q, traj.end.v, traj.end.multipliers)
        return found.t, found.count, found.uncertain, end, traj.end.t

    return run


class Pair(NamedTuple):
    """A motion with a guard, its exact values, and the tolerance."""

    arguments: tuple
    kind: str
    scale: np.ndarray  # of the two numbers that the guard reads, and of the guard
    g: Callable
    end: tuple
    ticks: np.ndarray  # the start, all extrema, the end
    heights: np.ndarray  # the guard there


def pairs_of(family, count, rng):
    """Draw motions, and guards on each."""
    found = []
    while len(found) < count:
        q0, v0, params, span = family.draw(rng)
        motion = family.exact(q0, v0, params, span)
        grid = np.linspace(0.0, span, SAMPLES)
        x, y = (np.asarray(z) for z in motion(grid))
        for _ in range(min(GUARDS_A_MOTION, count - len(found))):
            found.append(_pair(motion, q0, v0, params, span, grid, x, y, rng))
    return found


def _pair(motion, q0, v0, params, span, grid, x, y, rng):
    sizes = np.ptp(x), np.ptp(y)
    weights = {"a": rng.normal() / sizes[0], "b": rng.normal() / sizes[1], "c": rng.normal() / (sizes[0] * sizes[1])}
    if rng.uniform() < 0.4:
        weights |= {"b": 0.0, "c": 0.0}
    elif rng.uniform() < 0.3:
        # This gives four crossings per period if x and y are in quadrature.
        weights |= {"a": 0.0, "b": 0.0}
    bare = lambda t: coupled(*motion(t), weights)
    values = coupled(x, y, weights)
    rises = np.diff(values)
    turns = [_extremum(bare, grid[i], grid[i + 2], rises[i]) for i in np.flatnonzero(rises[:-1] * rises[1:] <= 0)]
    ticks = np.array([0.0, *turns, span])
    heights, size = np.array([float(bare(t)) for t in ticks]), np.ptp(values)
    kind = KINDS[rng.integers(4)]
    if kind in ("below an extremum", "grazing") and not turns:
        kind = "anywhere"
    if kind == "anywhere":
        level = values.min() + size * rng.uniform(-0.05, 1.05)
    elif kind == "on the start":
        level = heights[0] * (1 + rng.choice([0.0, 1e-15, -1e-15]))
    else:
        i = rng.integers(1, len(ticks) - 1)
        inward = np.sign(heights[i - 1] + heights[i + 1] - 2 * heights[i])
        below = kind == "below an extremum"
        distance = 10.0 ** (rng.uniform(-9, -1) if below else rng.uniform(-12, -3))
        level = heights[i] + size * distance * inward * (1 if below else rng.choice([-1, 1]))
    if kind == "on the start":
        # A start on the guard is not a crossing: it counts as on the side to which the guard moves.
        heights[0] = level + size * np.sign(values[1] - values[0])
    guard = weights | {"level": level}
    return Pair(
        (q0, v0, params | {"guard": guard}, span), kind, np.array([*sizes, size]), lambda t: bare(t) - level,
        motion(span), ticks, heights - level,
    )  # fmt: skip


def _extremum(g, before, after, rises):
    sign = -1.0 if rises > 0 else 1.0
    return minimize_scalar(lambda t: sign * float(g(t)), bounds=(before, after), method="bounded",
                           options={"xatol": 1e-9 * (after - before)}).x  # fmt: skip


class Verdict(NamedTuple):
    """Numbers of crossings, except for `needless` and `worst`."""

    there: int
    missed: int
    invented: int
    late: int
    unsaid: int
    needless: bool
    worst: float


def judge(pair, rtol, outcome) -> Verdict:
    """Compare with the exact crossings."""
    t, count, uncertain, end, end_t = outcome
    span, t = pair.arguments[-1], np.asarray(t)[np.isfinite(t)]
    *_, size = pair.scale
    off = max(abs(float(x) - float(z)) / s for x, z, s in zip(end, pair.end, pair.scale))
    bound = size * 10 * (rtol + off)
    sure = np.abs(pair.heights) > max(2 * bound, 1e-9 * size)
    signs = np.sign(pair.heights)
    errors = [abs(float(pair.g(x))) / bound for x in t]
    disorder = int(np.sum(np.diff(t) <= 0)) + (int(count) != len(t)) + (float(end_t) != span)
    missed = invented = unsaid = there = 0
    edges = np.flatnonzero(sure)
    # From each sure extremum to the next one; crossings before the first and after the last one are not sure.
    stretches = list(zip(edges[:-1], edges[1:]))
    edge = [(0, edges[0]), (edges[-1], len(signs) - 1)] if len(edges) else [(0, len(signs) - 1)]
    for i, j in [*stretches, *[(i, j) for i, j in edge if i < j]]:
        exact = int(np.sum(signs[i:j] * signs[i + 1 : j + 1] < 0))
        # A crossing of the last stretch may be found exactly at its end.
        mine = int(np.sum((t > pair.ticks[i]) & (t <= pair.ticks[j]))) if i else int(np.sum(t <= pair.ticks[j]))
        there += exact
        if j == i + 1 and sure[i] and sure[j]:
            missed, invented = missed + max(exact - mine, 0), invented + max(mine - exact, 0)
        elif exact != mine and not uncertain:
            unsaid += 1
    late = sum(error > 1 for error in errors) + disorder
    clear = np.all(np.abs(pair.heights[1:-1]) > 100 * max(bound, 1e-9 * size))
    return Verdict(there, missed, invented, late, unsaid, bool(uncertain and clear), max(errors, default=0.0))


def of_family(name, family, count, seed, lanes=False):
    """Run all pairs, alone or in lanes, and give a `Verdict` for each."""
    rng = np.random.default_rng([seed, *name.encode()])
    pairs = pairs_of(family, count, rng)
    rtols = 10.0 ** rng.uniform(family.tightest, -4, count)
    run = jax.jit(jax.vmap(program(family)) if lanes else program(family))
    arguments = [jax.tree.map(jnp.asarray, (*pair.arguments, rtol)) for pair, rtol in zip(pairs, rtols)]
    if lanes:
        outcomes = []
        for i in range(0, count, LANES):
            some = arguments[i : i + LANES]
            some = some + [some[0]] * (LANES - len(some))
            found = run(*jax.tree.map(lambda *x: jnp.stack(x), *some))
            outcomes += [jax.tree.map(lambda x: np.asarray(x)[k], found) for k in range(LANES)]
    else:
        outcomes = [jax.tree.map(np.asarray, run(*x)) for x in arguments]
    return pairs, rtols, [judge(*x) for x in zip(pairs, rtols, outcomes)]


def at_ends_of_steps(begin, inner, off, end, h, touches, pieces=sampling.pieces_of):
    """The twin's pieces: no information and no doubt between the ends of a step."""
    found = pieces(begin, inner, off, end, h, touches)
    between = len(found.sign) - 1
    return found._replace(sign=[0.0 * h] * between + found.sign[-1:], doubt=[jnp.asarray(False)] * len(found.doubt))


def totals(verdicts):
    """The columns of a row."""
    counted = ("there", "missed", "invented", "late", "unsaid")
    added = {name: int(sum(getattr(v, name) for v in verdicts)) for name in counted}
    needless = sum(v.needless for v in verdicts) / len(verdicts)
    return {"pairs": len(verdicts)} | added | {"needless": needless, "worst": float(max(v.worst for v in verdicts))}


def rows(wanted):
    """Yield the requested rows."""
    groups = [(name, False) for name in FAMILIES] + [(name, True) for name in IN_LANES]
    each = -(-OPTIONS["pairs"] // len(groups))
    for name, lanes in groups:
        what = f"found: {name}{', in lanes' if lanes else ''}: missed, invented, late or unsaid"
        if wanted(what):
            *_, verdicts = of_family(name, FAMILIES[name], each, OPTIONS["seed"] + lanes, lanes)
            found = totals(verdicts)
            yield row(what, sum(found[k] for k in ("missed", "invented", "late", "unsaid")), 0, **found)
    for name in TWINS:
        what = f"twin, ends of steps only: {name}: share missed"
        if wanted(what):
            sampling.pieces_of, pieces = at_ends_of_steps, sampling.pieces_of
            try:
                *_, verdicts = of_family(name, FAMILIES[name], each, OPTIONS["seed"])
            finally:
                sampling.pieces_of = pieces
            found = totals(verdicts)
            yield row(what, found["missed"] / found["there"], 0.02, "more", **found)
    yield from costs(wanted)


COSTS = {
    "pendulum": (pendulum, 1.0, 0.0, {"w": 1.0}, 50 * 6.7, lambda q: q),
    "rod pendulum": (rod, {"x": 0.8, "y": -0.6}, {"x": 0.0, "y": 0.0}, {"g": 1.0}, 50 * 6.6, lambda q: q["x"]),
    "double pendulum": (double_pendulum, np.array([0.4, 0.5]), np.zeros(2), {"g": 1.0}, 50 * 8.2, lambda q: q[0]),
    "hoop": (lambda: bead_on_hoop.system, 1.0, 0.0, bead_on_hoop.PARAMS, None, lambda q: q),
}


def costs(wanted):
    """Time over that without events: a terminal event at an unreachable level, and one that records all crossings."""
    for name, (system, q0, v0, params, span, height) in COSTS.items():
        if not wanted(f"cost: {name}"):
            continue
        span = 50 * float(bead_on_hoop.exact_period(params, q0)) if span is None else span
        system, v0 = system(), jax.tree.map(jnp.asarray, v0)

        def solve(events, system=system, span=span, v0=v0):
            run = jax.jit(lambda q0, rtol: lj.integrate(
                system, q0, v0, params, ts=jnp.array([0.0, span]), rtol=rtol, atol=rtol, events=events, throw=False,
            ))  # fmt: skip
            return lambda: run(q0, 1e-9)

        far = {"far": lj.Crossing(lambda t, q, v, p: height(q) - 10.0)}
        level = {"level": lj.Crossing(lambda t, q, v, p: height(q), direction=1, terminal=False, most=64)}
        runs = solve(None), solve(far), solve(level)
        times = in_turn(*runs, repeats=REPEATS, shortest=0.02)
        for k, what in ((1, "terminal"), (2, "recorded")):
            ratio, minima = times.ratio(k, 0)
            steps = int(runs[k]().stats["num_steps"])
            crossings = sum(int(x.count) for x in runs[k]().events.values())
            yield row(
                f"cost: {name}, {what}: with an event / without", ratio, 1.3, minima=minima,
                ms=1e3 * times.medians[0], steps=steps, crossings=crossings,
            )  # fmt: skip


if __name__ == "__main__":
    own = argparse.ArgumentParser(add_help=False)
    for option, number in OPTIONS.items():
        own.add_argument(f"--{option}", type=int, default=number)
    asked, sys.argv[1:] = own.parse_known_args()
    OPTIONS.update(vars(asked))
    main(rows, __doc__)
