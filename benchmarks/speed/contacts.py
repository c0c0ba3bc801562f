"""Contacts and dry friction from elements: error over time, beside MuJoCo and a time-stepping scheme in NumPy.

    cradle   a ball strikes four others, 0.01 apart; the last one goes on with its speed, the others rest
    stack    a block is thrown onto four that lie on each other, slides, and stops; the four stay
    spring   a block on a spring and a rough floor stops after four swings

Each has a closed form, and the error is that of the final positions. lagjax is called with rtol 1e-10, MuJoCo and the
time-stepping scheme with several steps; contacts of MuJoCo are stiffer for shorter steps, so that they converge. The
scheme is that of Moreau and Jean, with projected Gauss-Seidel; most of its time is that of Python, so it says what its
steps reach, and not how fast they could be.

Slow sliding is that of a block on a slope of tan α = μ, pushed across it: with the speeds s and w downhill, |s| + w stays,
so that w ends at half of the push. Fast sliding is a block thrown on a slope a little flatter.

First answers are processor time in a new process, without importing. Lanes are blocks on springs that stop, each with
another start, beside as many without friction.

Source: Todorov, ICRA 2014 (MuJoCo); Jean, Comput. Methods Appl. Mech. Eng. 177 (1999) 235; Acary & Brogliato, §10.

    python -m benchmarks.speed.contacts [--json FILE] [--only TEXT] [--processor-time]
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.measure import CLOCK, in_new_process, in_turn, main, row, skipped

try:
    import mujoco
except ImportError:
    mujoco = None

jax.config.update("jax_enable_x64", True)
G, MU, K, D, APART = 9.81, 0.3, 100.0, 0.1, 0.01
LANES, STEPS, COARSE = 1000, (1e-3, 1e-4, 1e-5), (1e-2, 1e-3)
# A contact of MuJoCo lasts so many steps.
LASTS = 20


class Example(NamedTuple):
    """A motion until `until`, its final positions, and how each tool is told of it.

    `rows` (k, n): ∂gap/∂q, then ∂sliding velocity/∂v; `gaps` at q = 0; `pairs`: for each sliding velocity its gap, or
    None where the normal force is constant.
    """

    system: lj.System
    q0: np.ndarray
    v0: np.ndarray
    until: float
    exact: np.ndarray
    xml: Callable
    rows: np.ndarray
    gaps: np.ndarray
    pairs: tuple
    restitution: float
    force: Callable


def cradle() -> Example:
    """Five balls of diameter D."""
    gaps = lj.Contact(lambda t, q, p: q[1:] - q[:-1] - D, restitution=1.0)
    system = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2), elements={"balls": gaps})
    q0, v0 = (D + APART) * np.arange(5.0), np.eye(5)[0]
    # The ball that moves covers four gaps, and goes on in the place of the next.
    exact = q0 + APART
    exact[-1] = q0[-1] + (1.0 - 4 * APART)

    def xml(step):
        balls = [f'<body pos="{x} 0 0"><joint type="slide" axis="1 0 0"/><geom size="{D / 2}" mass="1"/></body>' for x in q0]
        stiff = (np.pi / (LASTS * step)) ** 2
        return f'<geom condim="1" solref="{-stiff} 0" solimp="0.9999 0.9999 1"/>', 0.0, "".join(balls)

    rows, zero = np.diff(np.eye(5), axis=0), lambda q: 0 * q
    return Example(system, q0, v0, 1.0, exact, xml, rows, np.full(4, -D), (), 1.0, zero)


def stack() -> Example:
    """Five blocks of height 1; coordinates are the places, then the heights. The highest one is thrown."""

    def lagrangian(t, q, v, p):
        return 0.5 * jnp.sum(v**2) - G * jnp.sum(q[5:])

    under = lambda x, ground: x - jnp.concatenate([jnp.array([ground]), x[:-1]])
    blocks = lj.Contact(
        lambda t, q, p: under(q[5:], -0.5) - 1.0, friction=MU, sliding=lambda t, q, v, p: under(v[:5], 0.0)
    )
    q0, v0, drop, speed = np.append(np.zeros(5), np.arange(5) + 0.5), np.zeros(10), 0.2, 2.0
    q0[-1], v0[4] = q0[-1] + drop, speed
    fall = np.sqrt(2 * drop / G)
    exact = np.append(np.zeros(5), np.arange(5) + 0.5)
    exact[4] = speed * fall + (speed - MU * G * fall) ** 2 / (2 * MU * G)
    body = (
        '<body pos="0 0 {}"><joint type="slide" axis="1 0 0"/><joint type="slide" axis="0 0 1"/>'
        '<geom type="box" size="0.5 0.5 0.5" mass="1"/></body>'
    )

    def xml(step):
        ground = '<geom type="plane" size="9 9 1"/>'
        return (
            f'<geom condim="3" friction="{MU} 0 0" solref="{2 * step} 1" solimp="0.99 0.99 1"/>',
            G,
            ground + "".join(body.format(z) for z in q0[5:]),
        )

    differences = np.eye(5) - np.eye(5, k=-1)
    rows = np.kron(np.eye(2)[::-1], differences)
    system, gaps = lj.System(lagrangian, elements={"blocks": blocks}), np.append(-0.5, -np.ones(4))
    weight = -G * np.append(np.zeros(5), np.ones(5))
    return Example(system, q0, v0, 1.5, exact, xml, rows, gaps, tuple(range(5)), 0.0, lambda q: weight)


def spring() -> Example:
    """The block is let go at 0.5, swings with ω = 10, and loses 2 μ g / K in each half swing."""
    floor = lj.Friction(lambda t, q, v, p: v, MU, normal=G)
    system = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 0.5 * K * jnp.sum(q**2), elements={"floor": floor})

    def xml(step):
        joint = f'<joint type="slide" stiffness="{K}" frictionloss="{MU * G}" solreffriction="{2 * step} 1"/>'
        return "<geom/>", 0.0, f'<body>{joint}<geom size="0.1" mass="1"/></body>'

    rests, q0 = np.array([0.5 - 16 * MU * G / K]), np.array([0.5])
    return Example(system, q0, 0 * q0, 3.0, rests, xml, np.eye(1), np.zeros(0), (None,), 0.0, lambda q: -K * q)


def by_lagjax(of: Example):
    """The final positions as a function without arguments."""
    ts = jnp.array([0.0, of.until])
    return lambda: lj.integrate(of.system, of.q0, of.v0, ts=ts, rtol=1e-10, estimate_error=False).q[-1]


def by_mujoco(of: Example, step: float):
    """The same from MuJoCo; its coordinates are measured from the start, body by body."""
    defaults, gravity, bodies = of.xml(step)
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{step}" gravity="0 0 {-gravity}" integrator="implicitfast" cone="elliptic"/>'
        f"<default>{defaults}</default><worldbody>{bodies}</worldbody></mujoco>"
    )
    data, count = mujoco.MjData(model), round(of.until / step)
    start = np.zeros_like(of.q0) if model.ngeom > 1 else of.q0

    def order(x):
        """Ours to MuJoCo's."""
        return x.reshape(2, -1).T.ravel() if x.size == 10 else x

    def solve():
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = order(start), order(of.v0)
        for _ in range(count):
            mujoco.mj_step(model, data)
        moved = data.qpos.reshape(-1, 2).T.ravel() if of.q0.size == 10 else data.qpos
        return of.q0 - start + moved

    return solve


def by_time_stepping(of: Example, step: float, sweeps: int = 50):
    """The same from the scheme of Moreau and Jean, θ = 1/2, unit masses."""
    normals, rows = len(of.gaps), of.rows
    own, count = np.sum(rows**2, axis=1), round(of.until / step)

    def solve():
        q, v = of.q0.copy(), of.v0.copy()
        for _ in range(count):
            middle = q + 0.5 * step * v
            closed = rows[:normals] @ middle + of.gaps <= 0
            before, v = rows @ v, v + step * of.force(middle)
            impulses = np.zeros(len(rows))
            for _ in range(sweeps if np.any(closed) or normals < len(rows) else 0):
                last = impulses.copy()
                for i in np.flatnonzero(closed):
                    wanted = rows[i] @ v + of.restitution * min(before[i], 0.0)
                    new = max(0.0, impulses[i] - wanted / own[i])
                    v, impulses[i] = v + rows[i] * (new - impulses[i]), new
                for j, pair in enumerate(of.pairs):
                    i = normals + j
                    most = MU * (step * G if pair is None else impulses[pair])
                    new = np.clip(impulses[i] - rows[i] @ v / own[i], -most, most)
                    v, impulses[i] = v + rows[i] * (new - impulses[i]), new
                if np.max(np.abs(impulses - last)) <= 1e-14:
                    break
            q = middle + 0.5 * step * v
        return q

    return solve


def compared(name: str, of: Example, wanted):
    """Rows of one example."""

    def error(q) -> float:
        return float(np.max(np.abs(np.asarray(q) - of.exact)))

    if not wanted(name):
        return
    ours = by_lagjax(of)
    started = CLOCK["seconds"]()
    off = error(ours())
    first, ours_s = CLOCK["seconds"]() - started, in_turn(ours).medians[0]
    yield row(f"{name}: lagjax, s a call", ours_s, error=off, first_answer_s=first)
    for tool, prepare, steps in (("MuJoCo", by_mujoco, STEPS), ("time-stepping", by_time_stepping, COARSE)):
        if tool == "MuJoCo" and mujoco is None:
            yield skipped(f"{name}: {tool}", "mujoco is not installed")
            continue
        for step in steps:
            theirs = prepare(of, step)
            reached = error(theirs())
            times = in_turn(ours, theirs, repeats=3)
            target = 1.0 if tool == "MuJoCo" and step == steps[-1] and name != "spring" else None
            what = f"{name}: lagjax / {tool}, step {step:g}"
            yield row(what, times.ratio()[0], target, seconds=times.medians[1], error=reached)


def lanes(wanted):
    """1,000 blocks that stop, beside 1,000 without friction, and 1,000 with a damper."""
    what = f"{LANES} lanes of the block on a spring: with dry friction / "
    if not wanted(f"{what}without, with a damper"):
        return
    until, c = 4.0, 0.7

    def lagrangian(t, q, v, p):
        return 0.5 * v**2 - 0.5 * K * q**2

    def batch(system):
        ts, settings = jnp.array([0.0, until]), {"estimate_error": False, "throw": False}

        def last(q):
            found = lj.integrate(system, q, 0.0, ts=ts, **settings)
            return found.q[-1], found.stats["num_steps"]

        return jax.jit(jax.vmap(last))

    rough = lj.System(lagrangian, elements={"floor": lj.Friction(lambda t, q, v, p: v, MU, normal=G)})
    damped = lj.System(lagrangian, dissipation=lambda t, q, v, p: 0.5 * c * v**2)
    starts = jnp.linspace(0.4, 0.6, LANES)
    programs = [batch(system) for system in (rough, lj.System(lagrangian), damped)]
    times = in_turn(*[lambda program=program: program(starts) for program in programs], repeats=7)
    # Each half swing ends nearer by 2 μ g / K, until the spring holds less than friction can.
    lost, q0 = MU * G / K, np.asarray(starts)
    swings = np.ceil((q0 / lost - 1) / 2)
    omega = np.sqrt(K - c**2 / 4)
    of_damper = np.exp(-c * until / 2) * (np.cos(omega * until) + c / (2 * omega) * np.sin(omega * until))
    exact = (-1.0) ** swings * (q0 - swings * 2 * lost), q0 * np.cos(np.sqrt(K) * until), q0 * of_damper
    found = [program(starts) for program in programs]
    off = [float(np.max(np.abs(np.asarray(q) - wanted))) for (q, _), wanted in zip(found, exact)]
    steps = [int(jnp.max(count)) for _, count in found]
    for i, other in ((1, "without"), (2, "with a damper")):
        yield row(what + other, times.ratio(0, i)[0], 2, seconds=times.medians[0], error=off[0], steps=steps[0],
                  other_s=times.medians[i], other_error=off[i], other_steps=steps[i])  # fmt: skip


def sliding(wanted):
    """Steps of an explicit and of an implicit method where a block slides slowly for long, and where it is fast."""
    floor = lj.Friction(lambda t, q, v, p: v, MU, normal=G)
    slope = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - p * G * q[1], elements={"floor": floor})
    ts, push = jnp.array([0.0, 30.0]), 0.02
    for name, tan, v0 in (("slow", MU, np.array([push, 0.0])), ("fast", 0.99 * MU, np.array([2.0, 1.5]))):
        what = f"{name} sliding in a plane: steps by default / by Radau5"
        if wanted(what):
            runs = [lj.integrate(slope, np.zeros(2), v0, tan, ts=ts, estimate_error=False, **how)
                    for how in ({}, {"method": lj.Radau5()})]  # fmt: skip
            steps = [int(run.stats["num_steps"]) for run in runs]
            ends = [float(np.hypot(*run.v[-1])) for run in runs]
            off = max(abs(end - (push / 2 if name == "slow" else 0.0)) for end in ends)
            yield row(what, steps[0] / steps[1], default=steps[0], radau5=steps[1], error_of_last_speed=off)


START = """
import json, time
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import lagjax as lj
from lagjax.scenes import rolling_hoop, slipping_hoop
two, ts = lambda t, q, v, p: 0.5 * jnp.sum(v**2) - 9.81 * q[1], np.array([0.0, 1.0, 2.0])
floor, wall = lj.Contact(lambda t, q, p: q[1], 0.5), lj.Contact(lambda t, q, p: 1.0 - q[0], 0.5)
rough = lj.Contact(lambda t, q, p: q[1], 0.5, 0.1, lambda t, q, v, p: v[0])
hoop = lj.Contact(rolling_hoop.contact, friction=lambda p: p["mu"], sliding=rolling_hoop.rolling)
swing, still = lambda t, q, v, p: 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2, {"x": 0.0}
one, one_each = lambda t, q, v, p: 0.5 * v**2, lambda t, q, v, p: 0.5 * jnp.sum(v**2)
mat = lj.CompliantContact(lambda t, q, p: q, stiffness=1000.0, damping=8.0)
servo = lj.SampledControl(lambda t, q, v, p: 4.0 * (1.0 - q["x"]) - 3.0 * v["x"], every=0.1)
driven = lambda t, q, v, p: 0.5 * v["x"] ** 2 + q["u"] * q["x"]
balls = lj.Contact(lambda t, q, p: q[1:] - q[:-1] - 0.1, restitution=1.0)
sphere = lambda t, q, v, p: 0.5 * jnp.sum(v["x"] ** 2) + 0.2 * jnp.sum(v["spin"] ** 2)
slips = lambda t, q, v, p: jnp.stack([v["x"][0] - v["spin"][1], v["x"][1] + v["spin"][0]])
table, thrown = lj.Friction(slips, 0.1, normal=9.81), {"x": np.array([1.0, 0.5]), "spin": np.zeros(3)}
# A box of edge 1, by its centre and its angle; its lower corners.
box = lambda t, q, v, p: 0.5 * (v[0] ** 2 + v[1] ** 2 + v[2] ** 2 / 6) - 9.81 * q[1]
push = lambda t, q, v, p: jnp.stack([3.0 * t, 0.0 * t, 0.0 * t])
arms = np.array([-0.5, 0.5])
low = lambda t, q, p: q[1] + arms * jnp.sin(q[2]) - 0.5 * jnp.cos(q[2])
along = lambda t, q, v, p: v[0] - v[2] * (arms * jnp.sin(q[2]) - 0.5 * jnp.cos(q[2]))
corners = lj.Contact(low, friction=0.5, sliding=along)
q0, v0, params = np.array([0.0, 1.0]), np.array([0.7, 0.0]), slipping_hoop.PARAMS
"""
HOOP = "rolling_hoop.start(params, 1.5, rolling_hoop.exact_rate(params, 1.5, rolling_hoop.TOP))"
ANSWERS = {
    "a ball": ("lj.System(two, elements={'floor': floor})", "(q0, v0)"),
    "a block with friction": ("lj.System(two, elements={'floor': rough})", "(q0, v0)"),
    "two contacts": ("lj.System(two, elements={'floor': floor, 'wall': wall})", "(q0, v0)"),
    "a state beside": ("lj.System(swing, states={'z': lambda t, q, v, p: v['x'] ** 2})", "({'x': 1.0, 'z': 0.0}, still)"),
    "the hoop": ("lj.System(rolling_hoop.lagrangian, elements={'cylinder': hoop, "
                 "'ground': lj.Contact(slipping_hoop.height)})", HOOP),
    "a rough floor and a wall": ("lj.System(two, elements={'floor': rough, 'wall': wall})", "(q0, v0)"),
    "a spring and a damper": ("lj.System(one, elements={'mat': mat})", "(1.0, -1.0)"),
    "a sampled control": ("lj.System(driven, elements={'u': servo})", "({'x': 0.0, 'u': 0.0}, still)"),
    "three balls in a row": ("lj.System(one_each, elements={'balls': balls})", "(np.array([-1.0, 0.1, 0.2]), np.eye(3)[0])"),
    "a sphere that rolls": ("lj.System(sphere, elements={'table': table})", "({'x': np.zeros(2), 'spin': np.zeros(3)}, thrown)"),
    "a box on two corners": ("lj.System(box, force=push, elements={'corners': corners})", "(np.array([0.0, 0.5, 0.0]), np.zeros(3))"),
}  # fmt: skip
# The same program with other numbers: at the wall, where contacts hold more than there are coordinates.
OTHERS = {"a rough floor and a wall": "np.array([1.0, 1.0]), np.array([0.0, 0.0])"}


def first_answers(wanted):
    """Processor time until the first answer, in a new process."""
    for name, (system, start) in ANSWERS.items():
        what = f"first answer, {name}, s"
        if not wanted(what):
            continue
        source = (
            f"{START}\nsystem, (q0, v0) = {system}, {start}\nstarted = time.process_time()\n"
            "lj.integrate(system, q0, v0, params, ts=ts)\nprint(json.dumps(time.process_time() - started))"
        )
        if name not in OTHERS:
            yield row(what, in_new_process(source), 6.0 if name == "the hoop" else None)
            continue
        source += (
            f"\nfirst, started = time.process_time() - started, time.process_time()\nlj.integrate(system, {OTHERS[name]}, params, "
            "ts=ts)\nprint(json.dumps([first, time.process_time() - started]))"
        )
        first, again = in_new_process(source)
        yield row(what, first)
        yield row(f"other numbers, {name}, s", again, 1.0)


def rows(wanted):
    """Examples, sliding, lanes, first answers."""
    for name, example in (("cradle", cradle), ("stack", stack), ("spring", spring)):
        yield from compared(name, example(), wanted)
    yield from sliding(wanted)
    yield from lanes(wanted)
    yield from first_answers(wanted)


if __name__ == "__main__":
    main(rows, __doc__)
