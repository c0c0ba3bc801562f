"""Do motions with contacts and dry friction come out right: what rests until it gives, what strikes, what slides?

At rest: rows of one to four blocks with friction on a floor, with contacts between them and walls that touch or do not;
a stack of two; a block in a corner, both of whose faces rub; a capsule between two pads. Each is pulled by
a + b t + c sin(w t), with a draw of masses, forces and friction in which all of it holds at t = 0, statically
determinate or not. Forces are possible until t*: the root of the margin of a linear programme (SciPy's HiGHS), or a
closed form. Right is a motion in which nothing moves before, a mode ends within 1e-9 of the span at t*, and positions
after it are those of the accelerations that follow by Gauss's principle (a quadratic programme with bounds, SciPy's
BVLS, integrated by its quad_vec), where normal forces are given. What moves by no more than the round-off of the forces
that hold it, 8 ε a t², rests.

Others, each against its closed form, with masses and lengths of many sizes: a ball that bounces, two balls that strike
each other, Newton's cradle, a block on a spring with dry friction, a block on a slope, a puck on a plane; and a block
that rocks from corner to corner, against SciPy's DOP853.

"wrong" is an answer that is off; "refused" ends in an error, or in a warning.

    python -m benchmarks.campaigns.contacts [--json FILE] [--only TEXT] [--seed N]
"""

import argparse
import sys
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import quad_vec, solve_ivp
from scipy.optimize import brentq, linprog, lsq_linear

import lagjax as lj
from benchmarks.measure import main, row

jax.config.update("jax_enable_x64", True)

OPTIONS = {"seed": 0}
G = 9.81
# How near a time must be, in parts of the span, and positions, in parts of the way that was gone.
IN_TIME, IN_PLACE, STILL = 1e-9, 1e-7, 1e-12
GRID, NODES = 401, 24


class Problem(NamedTuple):
    """A motion, and `judge(trajectory)` -> what is wrong with it, in words; nothing where it is right."""

    system: Any
    start: tuple
    ts: np.ndarray
    judge: Callable
    words: str = ""


def pull(p, t):
    """a + b t + c sin(w t)."""
    return p["a"] + p["b"] * t + p["c"] * jnp.sin(p["w"] * t)


def pulled(p, t):
    """The same in NumPy."""
    return p["a"] + p["b"] * t + p["c"] * np.sin(p["w"] * t)


def first_below(margin, span):
    """The first time at which the margin falls below zero; None if it does not."""
    times = np.linspace(0.0, span, GRID)
    values = np.array([margin(t) for t in times])
    below = np.flatnonzero(values < 0)
    if not below.size or below[0] < 2:
        return None
    return brentq(margin, times[below[0] - 1], times[below[0]], xtol=1e-15, rtol=1e-14)


# Rows of blocks.


def row_of(n):
    """Blocks on a floor between two walls; `rub`: friction of each, `d`: their width, `room`: up to the right wall."""

    def gaps(t, q, p):
        left = jnp.concatenate([jnp.full(1, -p["d"]), q])
        right = jnp.concatenate([q, jnp.reshape(n * p["d"] + p["room"], 1)])
        return right - left - p["d"]

    return lj.System(
        lambda t, q, v, p: 0.5 * jnp.sum(p["m"] * v**2), force=lambda t, q, v, p: pull(p, t),
        elements={
            "contact": lj.Contact(gaps),
            "floor": lj.Friction(lambda t, q, v, p: v, 1.0, normal=lambda t, q, v, p: p["rub"]),
        },
    )  # fmt: skip


def rows_of_contacts(n, walls):
    """∂gap/∂q of the contacts that touch."""
    every = np.eye(n + 1, n) - np.eye(n + 1, n, -1)
    return every[np.array([walls[0], *[True] * (n - 1), walls[1]])]


def margin_of_row(p, walls, t):
    """How far from impossible rest is: the least that friction has to spare, over where the row may break."""
    f, rub = pulled(p, t), p["rub"]
    # The forces between blocks, c[i] >= 0, lie between low and high, from the left to the right.
    low, high, spare = 0.0, np.inf if walls[0] else 0.0, np.inf
    for i in range(len(f)):
        low, high = max(low, 0.0) + f[i] - rub[i], high + f[i] + rub[i]
        spare = min(spare, high)
    return spare if walls[1] else min(spare, -low)


def accelerations_of_row(p, walls, t):
    """Those of Gauss's principle: the forces in their bounds that leave the least of M a²."""
    n, contacts = len(p["m"]), rows_of_contacts(len(p["m"]), walls)
    # Bounds of a width of zero are not what the programme is written for.
    rub, zero = p["rub"][p["rub"] > 0], np.zeros(len(contacts))
    by_root = np.concatenate([contacts, np.eye(n)[p["rub"] > 0]]).T / np.sqrt(p["m"])[:, None]
    bounds = np.concatenate([zero, -rub]), np.concatenate([zero + np.inf, rub])
    found = lsq_linear(by_root, -pulled(p, t) / np.sqrt(p["m"]), bounds, "bvls", tol=1e-15, max_iter=10_000)
    a = found.fun / np.sqrt(p["m"])
    return np.where(np.abs(a) > 1e-10 * np.max(np.abs(pulled(p, t)) / p["m"]), a, 0.0)


def draw_row(n, rng, scale=1.0):
    """Blocks, of which some rub, with forces that grow."""
    while True:
        m = scale * rng.choice([0.3, 1.0, 2.0, 5.0], n)
        rub = m * G * rng.choice([0.0, 0.2, 0.5, 0.5], n)
        kinds = rng.integers(0, 3, n)
        size = scale * G * rng.uniform(-1.0, 1.0, n)
        p = {
            "m": m,
            "rub": rub,
            "a": 0.5 * size * (kinds == 0),
            "b": size * (kinds == 1),
            "c": 2.0 * size * (kinds == 2),
        }
        p |= {"w": rng.uniform(0.3, 2.0), "d": rng.choice([0.0, 0.1]), "room": rng.choice([0.0, 10.0])}
        walls, span = (True, p["room"] == 0.0), rng.choice([1.0, 4.0])
        margin = partial(margin_of_row, p, walls)
        # Margins of exactly zero are those of frictionless blocks: rest is then a matter of round-off.
        if margin(0.0) < 0 or (when := first_below(margin, span)) is None or not 0.05 * span < when < 0.9 * span:
            continue
        slope = (margin(when) - margin(when - 1e-6 * span)) / (1e-6 * span)
        if abs(slope) > 1e-2 * scale:
            return p, walls, span, when


def rests_then(traj, when, span, size, right, moving, pulls=0.0):
    """What is wrong with a motion that is to rest until `when`, and then be at `right` at its end; `pulls`: the largest
    acceleration by a single force, whose round-off goes ε a t²."""
    before, last = np.asarray(traj.t) < when, np.concatenate([np.ravel(x[-1] - x[0]) for x in jax.tree.leaves(traj.q)])
    early = max(float(np.max(np.abs(np.asarray(x)[before] - np.asarray(x)[0]))) for x in jax.tree.leaves(traj.q))
    times = np.asarray(traj.switches.t)[: len(traj.switches)]
    if early > STILL * size + 8 * np.finfo(float).eps * pulls * when**2:
        return f"moved by {early:.1e} before t* = {when:.6g}"
    off = np.min(np.abs(times - when), initial=np.inf)
    if off > IN_TIME * span:
        return f"gives at {times}, for {when:.12g}"
    if right is not None and np.max(np.abs(last - right)) > IN_PLACE * np.max(np.abs(right)) + STILL * size:
        return f"at {last}, for {right}"
    if moving is not None:
        slides = [np.asarray(traj.modes)[-1, i] for i, k in enumerate(traj.switches.kinds) if k == "sliding velocity"]
        if np.any((np.abs(slides) == 1) & ~moving):
            return f"modes {slides}, for {moving}"
    return ""


def at_rest_in_a_row(n, count, rng):
    """Rows of n."""
    system, found = row_of(n), []
    while len(found) < count:
        p, walls, span, when = draw_row(n, rng, rng.choice([1.0, 1e-3, 1e6]))
        later = min(when + 0.02 * span, span)
        of = lambda t, p=p, walls=walls: accelerations_of_row(p, walls, t)
        # Others may give on the way: the accelerations have kinks.
        right, _ = quad_vec(lambda t, of=of, later=later: (later - t) * of(t), when, later, epsrel=1e-9, limit=500)
        a = np.array([of(t) for t in np.linspace(when, later, NODES + 1)[1:]])
        q0 = p["d"] * np.arange(n, dtype=float)
        ts = np.array([0.0, 0.5 * when, 0.999 * when, later])
        size = max(np.max(np.abs(right)), 1e-3 * np.max(q0))
        pulls = max(np.max(np.abs(pulled(p, t)) / p["m"]) for t in np.linspace(0.0, when, NODES))
        moving = np.any(a != 0, axis=0)
        judge = partial(
            rests_then, when=when, span=span, size=max(size, 1e-6), right=right, moving=moving, pulls=pulls
        )
        found.append(Problem(system, (q0, np.zeros(n), p), ts, judge, f"{p} until {when}"))
    return found


# A stack of two, a block in a corner, and a capsule between pads.


def stack():
    """Two blocks on each other and on a floor, pulled along it."""

    def energy(t, q, v, p):
        return 0.5 * jnp.sum(p["m"] * (v["x"] ** 2 + v["y"] ** 2) - 2 * p["m"] * G * q["y"])

    below = lambda z: z - jnp.concatenate([jnp.zeros(1), z[:1]])
    floor = lj.Contact(
        lambda t, q, p: below(q["y"]) - p["d"], friction=lambda p: p["mu"], sliding=lambda t, q, v, p: below(v["x"])
    )
    force = lambda t, q, v, p: {"x": pull(p, t), "y": jnp.zeros(2)}
    return lj.System(energy, force=force, elements={"on": floor})


def at_rest_in_a_stack(count, rng):
    """Stacks: the forces in each plane are those of all that lies on it."""
    system, found = stack(), []
    while len(found) < count:
        m, size = rng.uniform(0.5, 3.0, 2), G * rng.uniform(-1, 1, 2)
        kind = rng.integers(0, 2, 2)
        p = {"m": m, "mu": rng.uniform(0.1, 0.6), "a": 0 * size, "b": size * kind, "c": size * (1 - kind)}
        p |= {"w": rng.uniform(0.5, 2.0), "d": 0.1}
        carried = np.cumsum(m[::-1])[::-1] * G * p["mu"]
        margin = lambda t, p=p, carried=carried: np.min(carried - np.abs(np.cumsum(pulled(p, t)[::-1])[::-1]))
        when = first_below(margin, 2.0)
        if when is None or when > 1.8:
            continue
        q0 = {"x": np.zeros(2), "y": p["d"] * np.array([1.0, 2.0])}
        judge = partial(rests_then, when=when, span=2.0, size=0.1, right=None, moving=None)
        ts = np.array([0.0, 0.5 * when, 0.999 * when, when + 0.01])
        found.append(Problem(system, (q0, jax.tree.map(np.zeros_like, q0), p), ts, judge, f"{p} until {when}"))
    return found


def corner():
    """A block on a floor and at a wall, both of which rub."""
    slides = lambda i: lambda t, q, v, p: v[i]
    force = lambda t, q, v, p: pull(p, t) - jnp.array([0.0, 1.0]) * p["m"] * G
    return lj.System(
        lambda t, q, v, p: 0.5 * p["m"] * jnp.sum(v**2), force=force,
        elements={
            "floor": lj.Contact(lambda t, q, p: q[1], friction=lambda p: p["mu"], sliding=slides(0)),
            "wall": lj.Contact(lambda t, q, p: q[0], friction=lambda p: p["nu"], sliding=slides(1)),
        },
    )  # fmt: skip


def margin_of_corner(p, t):
    """The least that the laws have to spare, where friction and normal forces balance what pulls."""
    x, y = pulled(p, t) - np.array([0.0, p["m"] * G])
    # Unknowns: N and T of the floor, N and T of the wall, and the spare.
    mu, nu = p["mu"], p["nu"]
    laws = [
        [-mu, 1, 0, 0, 1],
        [-mu, -1, 0, 0, 1],
        [0, 0, -nu, 1, 1],
        [0, 0, -nu, -1, 1],
        [-1, 0, 0, 0, 1],
        [0, 0, -1, 0, 1],
    ]
    balance = [[0, 1, 1, 0, 0], [1, 0, 0, 1, 0]]
    tight = linprog([0, 0, 0, 0, -1], laws, np.zeros(6), balance, [-x, -y], [(None, None)] * 5)
    return tight.x[-1]


def at_rest_in_a_corner(count, rng):
    """Corners: pushed to the wall, and lifted along it; or pulled off."""
    system, found = corner(), []
    while len(found) < count:
        m, size = rng.uniform(0.5, 3.0), np.array([rng.uniform(-1.0, 1.0), rng.uniform(0.0, 2.0)])
        p = {
            "m": m,
            "mu": rng.uniform(0.2, 0.6),
            "nu": rng.uniform(0.1, 0.4),
            "a": np.array([min(size[0], 0.0), 0.0]) * m * G,
        }
        p |= {"b": size * m * G, "c": np.zeros(2), "w": 1.0}
        when = first_below(partial(margin_of_corner, p), 2.0) if margin_of_corner(p, 0.0) > 1e-9 else None
        if when is None or not 0.1 < when < 1.8:
            continue
        judge = partial(rests_then, when=when, span=2.0, size=1e-3, right=None, moving=None)
        ts = np.array([0.0, 0.5 * when, 0.999 * when, when + 0.01])
        found.append(Problem(system, (np.zeros(2), np.zeros(2), p), ts, judge, f"{p} until {when}"))
    return found


def grip():
    """A capsule between two pads that squeeze less and less."""
    rise = lambda t, q, v, p: v["z"]

    def energy(t, q, v, p):
        pads = 0.5 * p["pad"] * (v["left"] ** 2 + v["right"] ** 2)
        return pads + 0.5 * p["m"] * (v["x"] ** 2 + v["z"] ** 2) - p["m"] * G * q["z"]

    def squeeze(t, q, v, p):
        return {"left": pull(p, t), "right": -pull(p, t), "x": 0.0, "z": 0.0}

    pad = lambda gap: lj.Contact(gap, friction=lambda p: p["mu"], sliding=rise)
    pads = {
        "left pad": pad(lambda t, q, p: q["x"] - q["left"] - p["r"]),
        "right pad": pad(lambda t, q, p: q["right"] - q["x"] - p["r"]),
    }
    return lj.System(energy, force=squeeze, elements=pads)


def at_rest_in_a_grip(count, rng):
    """Capsules: until 2 μ F = m g."""
    system, found = grip(), []
    for _ in range(count):
        m, mu, r, scale = 0.045, rng.uniform(0.3, 0.8), 0.004, rng.choice([1e-6, 1.0, 1e6])
        p = {"m": scale * m, "pad": scale * rng.uniform(0.01, 1.0), "mu": mu, "r": r, "w": 1.0}
        p |= {"a": scale * 12.0, "b": -6.0 * scale, "c": scale * rng.uniform(-1.0, 1.0)}
        margin = lambda t, p=p: 2 * p["mu"] * pulled(p, t) - p["m"] * G
        when = first_below(margin, 4.0)
        later = when + 0.01
        x, w = np.polynomial.legendre.leggauss(NODES)
        s = when + (later - when) * (x + 1) / 2
        fallen = (later - when) / 2 * (w * (later - s)) @ (margin(s) / p["m"])
        right = np.array([0.0, 0.0, 0.0, fallen])
        q0 = {"left": -r, "right": r, "x": 0.0, "z": 0.0}
        pulls = pulled(p, 0.0) / p["pad"]
        judge = partial(rests_then, when=when, span=4.0, size=r, right=right, moving=None, pulls=pulls)
        ts = np.array([0.0, 0.5 * when, 0.999 * when, later])
        found.append(Problem(system, (q0, dict.fromkeys(q0, 0.0), p), ts, judge, f"{p} until {when}"))
    return found


# Impacts and sliding.


def near(found, right, what, size=None):
    """What is off, in words."""
    found, right = np.asarray(found, float), np.asarray(right, float)
    size = np.max(np.abs(right)) if size is None else size
    return "" if np.all(np.abs(found - right) <= IN_PLACE * size) else f"{what} {found}, for {right}"


def bouncing(count, rng):
    """A ball that falls from h with restitution e, of any mass, length and time."""
    ball = lj.System(
        lambda t, q, v, p: p["m"] * (0.5 * v**2 - p["g"] * q),
        elements={"floor": lj.Contact(lambda t, q, p: q, restitution=lambda p: p["e"], slower_than=0.0)},
    )
    found = []
    for _ in range(count):
        m, h, second = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.uniform(-9, 9), 10.0 ** rng.uniform(-6, 6)
        g, e, bounces = h / second**2, rng.choice([0.5, 0.9, 1.0]), rng.integers(1, 6)
        fall = np.sqrt(2 * h / g)
        times = fall * np.concatenate([[1.0], 1 + 2 * np.cumsum(e ** np.arange(1, bounces + 1))])
        end = times[-2] + 0.3 * (times[-1] - times[-2])
        speed, since = e**bounces * g * fall, end - times[-2]
        right = speed * since - 0.5 * g * since**2

        def judge(traj, times=times, right=right, h=h, bounces=bounces):
            return near(traj.q[-1], right, "at", h) or near(
                np.asarray(traj.switches.t)[: len(traj.switches)], times[:bounces], "strikes at"
            )

        p = {"m": m, "g": g, "e": e}
        found.append(Problem(ball, (h, 0.0, p), np.array([0.0, end]), judge, str(p)))
    return found


def two_balls(count, rng):
    """Two balls strike each other: momentum, and e times the speed of approach."""
    pair = lj.System(
        lambda t, q, v, p: 0.5 * jnp.sum(p["m"] * v**2),
        elements={"between": lj.Contact(lambda t, q, p: q[1] - q[0] - p["d"], restitution=lambda p: p["e"])},
    )
    found = []
    for _ in range(count):
        m, e = 10.0 ** rng.uniform(-12, 12, 2), rng.choice([0.3, 0.7, 1.0])
        v, d = np.array([1.0, rng.uniform(-1.0, 0.5)]), 0.1
        q = np.array([-1.0, 0.2])
        impulse = (1 + e) * (v[0] - v[1]) / (1 / m[0] + 1 / m[1])
        after = v + impulse / m * np.array([-1.0, 1.0])
        when = (q[1] - q[0] - d) / (v[0] - v[1])
        right = q + v * when + after * (3.0 - when)
        p = {"m": m, "e": e, "d": d}
        judge = lambda traj, right=right, after=after: (
            near(traj.v[-1], after, "velocities") or near(traj.q[-1], right, "at")
        )
        found.append(Problem(pair, (q, v, p), np.array([0.0, 3.0]), judge, str(p)))
    return found


def cradle(count, rng):
    """Five equal balls, of which k come: as many leave."""
    balls = lj.Contact(lambda t, q, p: q[1:] - q[:-1] - p["d"], restitution=1.0)
    system = lj.System(lambda t, q, v, p: 0.5 * p["m"] * jnp.sum(v**2), elements={"balls": balls})
    found = []
    for _ in range(count):
        k, d, apart = rng.integers(1, 5), 0.1, rng.choice([0.0, 1e-3])
        m, speed = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.uniform(-3, 3)
        q0 = (d + apart) * np.arange(5.0)
        q0[:k] -= 0.5
        v0 = np.where(np.arange(5) < k, speed, 0.0)
        after = np.where(np.arange(5) >= 5 - k, speed, 0.0)
        judge = lambda traj, after=after: near(traj.v[-1], after, "velocities")
        p = {"m": m, "d": d}
        found.append(Problem(system, (q0, v0, p), np.array([0.0, 2.0 / speed]), judge, f"{k} of 5, {p}"))
    return found


def on_a_spring(count, rng):
    """A block on a spring and a rough floor: each half swing takes 2 μ g/ω² of the amplitude."""
    system = lj.System(
        lambda t, q, v, p: 0.5 * p["m"] * (v**2 - p["w"] ** 2 * q**2),
        elements={
            "floor": lj.Friction(lambda t, q, v, p: v, lambda p: p["mu"], normal=lambda t, q, v, p: p["m"] * p["g"])
        },
    )
    found = []
    for _ in range(count):
        m, w, length = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.uniform(-3, 3), 10.0 ** rng.uniform(-6, 6)
        lost = rng.uniform(0.02, 0.2) * length
        p = {"m": m, "w": w, "mu": 0.3, "g": lost * w**2 / 0.3}
        swings = int(np.ceil((length / lost - 1) / 2))
        right = (-1) ** swings * (length - 2 * swings * lost)
        if min(abs(length - 2 * swings * lost - lost), abs(length - 2 * swings * lost + lost)) < 1e-3 * lost:
            continue
        judge = lambda traj, right=right, length=length: near(traj.q[-1], right, "at", length)
        found.append(Problem(system, (length, 0.0, p), np.array([0.0, (swings + 1) * np.pi / w]), judge, str(p)))
    return found


def on_a_slope(count, rng):
    """A block pushed up a slope stops, and stays or comes back."""
    slides = lambda t, q, v, p: v[0]
    system = lj.System(
        lambda t, q, v, p: p["m"] * (0.5 * jnp.sum(v**2) - p["g"] * (jnp.sin(p["s"]) * q[0] + jnp.cos(p["s"]) * q[1])),
        elements={"slope": lj.Contact(lambda t, q, p: q[1], friction=lambda p: p["mu"], sliding=slides)},
    )
    found = []
    for _ in range(count):
        m, g, s, mu = (
            10.0 ** rng.uniform(-12, 12),
            10.0 ** rng.uniform(-3, 3),
            rng.uniform(0.1, 1.2),
            rng.uniform(0.05, 1.0),
        )
        speed = 10.0 ** rng.uniform(-3, 3)
        up, down = g * (np.sin(s) + mu * np.cos(s)), g * max(np.sin(s) - mu * np.cos(s), 0.0)
        top, end = speed / up, 2.5 * speed / up
        right = speed**2 / (2 * up) - 0.5 * down * (end - top) ** 2
        p = {"m": m, "g": g, "s": s, "mu": mu}
        size = speed**2 / (2 * up)
        judge = lambda traj, right=right, size=size: near(traj.q[-1], [right, 0.0], "at", size)
        start = np.zeros(2), np.array([speed, 0.0])
        found.append(Problem(system, (*start, p), np.array([0.0, end]), judge, str(p)))
    return found


def on_a_plane(count, rng):
    """A puck thrown on a plane stops after v²/(2 μ g)."""
    rub = lj.Friction(lambda t, q, v, p: v, lambda p: p["mu"], normal=lambda t, q, v, p: p["m"] * p["g"])
    system = lj.System(lambda t, q, v, p: 0.5 * p["m"] * jnp.sum(v**2), elements={"plane": rub})
    found = []
    for _ in range(count):
        m, g, mu = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.uniform(-3, 3), rng.uniform(0.05, 1.0)
        v = 10.0 ** rng.uniform(-3, 3) * rng.normal(size=2)
        speed = np.linalg.norm(v)
        right, p = v * speed / (2 * mu * g), {"m": m, "g": g, "mu": mu}
        judge = lambda traj, right=right: near(traj.q[-1], right, "at")
        found.append(Problem(system, (np.zeros(2), v, p), np.array([0.0, 2 * speed / (mu * g)]), judge, str(p)))
    return found


def rocking(count, rng):
    """A slender block that is let go on one of its corners rocks from corner to corner (Housner, 1963).

    About a corner it is a pendulum with θ'' = -3 g/(4 R) sin(α - θ); each impact leaves 1 - 3/2 sin² α of the rate.
    """

    def height(side, q, p):
        return q["y"] + side * p["b"] * jnp.sin(q["phi"]) - p["h"] * jnp.cos(q["phi"])

    def corner(side):
        def along(t, q, v, p):
            return v["x"] + (p["h"] * jnp.cos(q["phi"]) - side * p["b"] * jnp.sin(q["phi"])) * v["phi"]

        return lj.Contact(lambda t, q, p: height(side, q, p), friction=2.0, sliding=along)

    def energy(t, q, v, p):
        inertia = p["m"] * (p["b"] ** 2 + p["h"] ** 2) / 3
        kinetic = 0.5 * p["m"] * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * inertia * v["phi"] ** 2
        return kinetic - p["m"] * p["g"] * q["y"]

    system = lj.System(energy, elements={"left": corner(-1), "right": corner(1)})
    found = []
    for _ in range(count):
        m, h, g = 10.0 ** rng.uniform(-12, 12), 10.0 ** rng.uniform(-3, 3), 10.0 ** rng.uniform(-3, 3)
        b, impacts = h / rng.uniform(2.0, 5.0), rng.integers(1, 4)
        alpha, radius = np.arctan2(b, h), np.hypot(b, h)
        rate2, left, angle = 0.75 * g / radius, 1 - 1.5 * np.sin(alpha) ** 2, rng.uniform(0.2, 0.7) * alpha

        def swing(t, y, rate2=rate2, alpha=alpha):
            return [y[1], -rate2 * np.sin(alpha - y[0])]

        lands = lambda t, y: y[0]
        lands.terminal, lands.direction = True, -1
        accurate = {"method": "DOP853", "rtol": 1e-13, "atol": [1e-14 * angle, 1e-14 * angle * np.sqrt(rate2)]}
        y, t, side, far = np.array([angle, 0.0]), 0.0, 1.0, 20 / np.sqrt(rate2)
        for _ in range(impacts):
            fall = solve_ivp(swing, (0.0, far), y, events=lands, **accurate)
            t, y, side = t + fall.t[-1], np.array([0.0, -left * fall.y[1, -1]]), -side
        last = solve_ivp(swing, (0.0, far), y, events=lands, **accurate).t[-1] * rng.uniform(0.2, 0.8)
        right = side * solve_ivp(swing, (0.0, last), y, **accurate).y[0, -1]
        q0 = {"x": b * np.cos(angle) - h * np.sin(angle), "y": b * np.sin(angle) + h * np.cos(angle), "phi": angle}
        p = {"m": m, "b": b, "h": h, "g": g}
        judge = lambda traj, right=right, angle=angle: near(traj.q["phi"][-1], right, "at", angle)
        start = q0, dict.fromkeys(q0, 0.0), p
        found.append(Problem(system, start, np.array([0.0, t + last]), judge, f"{p}, {angle}, {impacts} impacts"))
    return found


FAMILIES = {
    "at rest: a block at a wall": (partial(at_rest_in_a_row, 1), 6),
    "at rest: two blocks": (partial(at_rest_in_a_row, 2), 8),
    "at rest: three blocks": (partial(at_rest_in_a_row, 3), 7),
    "at rest: four blocks": (partial(at_rest_in_a_row, 4), 7),
    "at rest: a stack of two": (at_rest_in_a_stack, 4),
    "at rest: a block in a corner": (at_rest_in_a_corner, 4),
    "at rest: a capsule between pads": (at_rest_in_a_grip, 4),
    "a bouncing ball": (bouncing, 20),
    "two balls": (two_balls, 20),
    "Newton's cradle": (cradle, 15),
    "a block on a spring": (on_a_spring, 15),
    "a block on a slope": (on_a_slope, 15),
    "a puck on a plane": (on_a_plane, 15),
    "a rocking block": (rocking, 10),
}


def outcome(problem: Problem) -> tuple[str, str]:
    """ "right", "wrong" or "refused", and why."""
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            traj = lj.integrate(problem.system, *problem.start, ts=problem.ts)
    except (ValueError, RuntimeError) as error:
        return "refused", str(error)
    if why := problem.judge(traj):
        return "wrong", why
    return ("refused", str(said[0].message)) if said else ("right", "")


def results(wanted):
    """The rows of all families that are asked for."""
    for name, (of, count) in FAMILIES.items():
        if not wanted(name):
            continue
        problems = of(count, np.random.default_rng([OPTIONS["seed"], *name.encode()]))
        found = [outcome(problem) for problem in problems]
        for problem, (kind, why) in zip(problems, found):
            if kind != "right":
                print(f"  {kind}: {why.splitlines()[0]}  [{problem.words}]", flush=True)
        counts = {kind: sum(x == kind for x, _ in found) for kind in ("right", "wrong", "refused")}
        yield row(name, counts["right"] / len(found), 1.0, "more", **counts)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--seed", type=int, default=OPTIONS["seed"])
    given, sys.argv[1:] = parser.parse_known_args()
    OPTIONS |= vars(given)
    main(results, __doc__)
