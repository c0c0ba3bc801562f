"""How long does a user wait for the first answer of a fresh process and for the next call, compared with bare diffrax?

Each figure is from a new process and includes everything after `import`: tracing, compiling, running. A bare program
solves the same problem with robust accelerations derived by hand and diffrax's Dopri8 in `jax.jit`, with the same
tolerance and outputs. Both are measured alternately in the same run; values are medians of three.

    first answer / bare     for the same problem, wall clock; for a sweep: over one of its motions by lagjax
    again                   the same call with other numbers, eager, in seconds, compared with the jitted solve
    programs, traced        what the second call still compiles and traces: nothing
    a step                  a call's time divided by its number of steps
    kept programs           the the first answer of a new process beyond imports, where an earlier one had the same question
    instructions            of the largest program before XLA optimises it: the amount to compile
    import                  `import lagjax` after `import jax, diffrax`

All but the kept programs are with `LAGJAX_CACHE=off`.

    python -m benchmarks.speed.first_answer [--json FILE] [--only TEXT] [--processor-time]
"""

import statistics
import tempfile
import time
from typing import NamedTuple

from benchmarks.measure import CLOCK, in_new_process, main, row

REPEATS = 3
START = """
import json, os, time
os.environ["LAGJAX_CACHE"] = CACHE
import jax, diffrax
import jax.numpy as jnp
import numpy as np
jax.config.update("jax_enable_x64", True)
import lagjax as lj
if CACHE != "off":
    # Beyond imports: rooms are imported where they are first used.
    [getattr(lj, name) for name in lj.__all__]
# The first operation of a process starts JAX's backend, so that it counts for neither.
jax.block_until_ready(jnp.arange(3.0) + 1.0)
clock = getattr(time, CLOCK)
compiled, traced = [], []

def listen(name, seconds, **more):
    if name.endswith("backend_compile_duration"):
        compiled.append(seconds)
    if "jaxpr_trace" in name:
        traced.append(seconds)

jax.monitoring.register_event_duration_secs_listener(listen)
done = lambda tree: jax.block_until_ready([x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array)])
ts = np.linspace(0.0, 1.0, 5)

def bare(field, q0, v0, params, ts=ts, event=None):
    def run(q0, v0, params):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, p: (y[1], field(t, *y, p))), diffrax.Dopri8(), ts[0], ts[-1], None, (q0, v0),
            params, saveat=diffrax.SaveAt(ts=ts), stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-9),
            event=event, max_steps=2**20, throw=False,
        )
        return solution.ys
    return run
"""
END = """
started = clock()
done(answer(1.0))
first = clock() - started
compiled.clear(); traced.clear()
done(answer(1.001))
result = {"first": first, "programs": len(compiled), "traced": len(traced)}
if AGAIN:
    times = []
    while len(times) < 200 and sum(times) < 5.0:
        started = time.perf_counter()
        done(answer(1.0 + 1e-6 * len(times)))
        times.append(time.perf_counter() - started)
    result["again"] = float(np.median(times))
    steps = getattr(answer(1.0), "stats", {}).get("num_steps")
    result["a step"] = None if steps is None else result["again"] / int(steps)
print(json.dumps(result))
"""
IMPORT = """
import json, time
import jax, diffrax
started = time.perf_counter()
import lagjax
print(json.dumps(time.perf_counter() - started))
"""
# XLA itself dumps its input.
DUMPED = """
import os
os.environ["XLA_FLAGS"] = f"--xla_dump_to={FOLDER} --xla_dump_hlo_as_text"
"""
COUNT = """
done(answer(1.0))
from pathlib import Path
print(json.dumps(max(p.read_text().count(" = ") for p in Path(FOLDER).glob("*before_optimizations.txt"))))
"""


class Question(NamedTuple):
    """A definition; `answer(x)` by lagjax, and by the comparison (None if there is none); targets, in seconds.

    The targets are for the first answer, or its ratio to the comparison; for another call; for one step of it; for the
    first answer with kept programs; and for the number of instructions of the program. None: not measured.
    """

    definition: str
    ours: str
    beside: str | None
    target: float
    again: float | None = None
    step: float | None = None
    kept: float | None = 0.5
    instructions: int | None = None
    what: str = "bare diffrax"


PENDULUM = """
system = lj.System(lambda t, q, v, p: 0.5 * v**2 + p["g"] * jnp.cos(q))
by_hand = lambda t, q, v, p: -p["g"] * jnp.sin(q)
start, params = (1.0, 0.0), {"g": 9.81}
"""
DOUBLE = """
def lagrangian(t, q, v, p):
    kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + p["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))

def by_hand(t, q, v, p):
    c, s = jnp.cos(q[0] - q[1]), jnp.sin(q[0] - q[1])
    f = -s * v[1] ** 2 - 2 * p["g"] * jnp.sin(q[0])
    h = s * v[0] ** 2 - p["g"] * jnp.sin(q[1])
    return jnp.stack([f - c * h, 2 * h - c * f]) / (2 - c * c)

system, start, params = lj.System(lagrangian), (np.array([0.4, 0.5]), np.zeros(2)), {"g": 9.81}
"""
ROD = """
def lagrangian(t, q, v, p):
    return 0.5 * p["m"] * (v["x"] ** 2 + v["y"] ** 2) - p["m"] * p["g"] * q["y"]

def by_hand(t, q, v, p):
    rate = (p["g"] * q["y"] - v["x"] ** 2 - v["y"] ** 2) / (q["x"] ** 2 + q["y"] ** 2)
    return {"x": rate * q["x"], "y": rate * q["y"] - p["g"]}

system = lj.System(lagrangian, {"rod": lj.Holonomic(lambda t, q, p: q["x"] ** 2 + q["y"] ** 2 - p["l"] ** 2)})
start, params = ({"x": 2.0, "y": 0.0}, {"x": 0.0, "y": 0.0}), {"m": 1.5, "g": 9.81, "l": 2.0}
"""
HOOP = """
from lagjax.scenes import rolling_hoop
system, params = rolling_hoop.system, rolling_hoop.PARAMS
start, ts = rolling_hoop.start(params, 1.3), np.linspace(0.0, 10.0, 5)

def by_hand(t, q, v, p):
    l, r = p["R"] + p["a"], q["r"]
    theta = -r * (p["g"] * jnp.cos(q["theta"]) + 2 * v["r"] * v["theta"]) / (r**2 + p["beta"] * l**2)
    return {"r": jnp.zeros_like(r), "theta": theta, "phi": -(l / p["a"]) * theta}

normal = lambda t, y, args, **kw: args["g"] * jnp.sin(y[0]["theta"]) - y[0]["r"] * y[1]["theta"] ** 2
left = diffrax.Event(normal, __import__("optimistix").Newton(1e-9, 1e-9))
options = {"events": rolling_hoop.DEPARTURE}
"""
# A ball that is dropped, and comes back with three quarters of its speed.
BALL = """
floor = {"floor": lj.Contact(lambda t, q, p: q, restitution=0.75)}
system = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q, elements=floor)
start, params = (1.0, 0.0), {"g": 9.81}
"""
SLIDER_CRANK = """
from lagjax.mechanisms import slider_crank as MECHANISM
system, params, start, ts = MECHANISM.system, MECHANISM.params, (MECHANISM.q0, MECHANISM.v0), np.linspace(0.0, 0.1, 5)
"""
# Nine coordinates, two wheels on the ground and four no-slip equations; pushed, so that it sways as it runs.
VEHICLE = """
from benchmarks.speed import bicycle
system, params, ts = bicycle.system, bicycle.PARAMS, np.linspace(0.0, 2.0, 5)
start = bicycle.straight(4.6, roll_rate=0.5)
"""
# A bead on a rotating hoop, for the questions of `lagjax.analysis`.
BEAD = """
hoop = lj.System(lambda t, q, v, p: 0.5 * (v**2 + (p["w"] * jnp.sin(q)) ** 2) + p["g"] * jnp.cos(q))
at_rest = {"x": 0.0, "y": -2.0}, {"x": 0.0, "y": 0.0}
"""
HELIX = """
from lagjax.scenes import mass_distributions as scene
helix, (q, v, _), params = scene.SYSTEMS["helix"], scene.ORBITS["helix"], scene.PARAMS["helix"]
"""
GOVERNOR = """
from lagjax.mechanisms import governor as MECHANISM
"""
SOLVED = """
options = globals().get("options", {})
answer = lambda x: lj.integrate(system, *start, params | {'g': 9.81 * x}, ts=ts, **options)
"""
BARE = """
run = jax.jit(bare(by_hand, *start, params, ts))
answer = lambda x: run(*jax.tree.map(jnp.asarray, start), params | {'g': 9.81 * x})
"""
GRADIENT = "loss = lambda g: {of}\nanswer = {jit}(jax.grad(lambda x: loss(9.81 * x)))"
ACCELERATIONS = "answer = lambda x: lj.accelerations(system, 0.0, *start, params | {'g': 9.81 * x})"
QUESTIONS = {
    "pendulum": Question(PENDULUM, SOLVED, BARE, 1.3, again=0.3e-3, kept=0.25),
    "double pendulum": Question(DOUBLE, SOLVED, BARE, 1.6, again=0.3e-3),
    "pendulum on a rod": Question(ROD, SOLVED, BARE, 2.0, again=0.5e-3, kept=0.25),
    "hoop until it leaves": Question(
        HOOP, SOLVED, BARE.replace("params, ts", "params, ts, left"), 3.0, instructions=8_000
    ),
    "pendulum on a rod by Radau5": Question(ROD + "options = {'method': lj.Radau5()}\n", SOLVED, None, 6.0),
    "slider-crank": Question(SLIDER_CRANK, SOLVED, None, 6.0),
    "accelerations of a vehicle": Question(VEHICLE, ACCELERATIONS, None, 4.0),
    "motion of a vehicle": Question(VEHICLE, SOLVED, None, 15.0, step=0.2e-3),
    "gradient on the rod": Question(
        ROD, GRADIENT.format(
            of="lj.integrate(system, *start, params | {'g': g}, ts=ts).q['x'][-1]", jit="",
        ), GRADIENT.format(
            of="bare(by_hand, *start, params)(*jax.tree.map(jnp.asarray, start), params | {'g': g})[0]['x'][-1]",
            jit="jax.jit",
        ), 2.0,
    ),
    "ball with a contact": Question(BALL, SOLVED, None, 6.0),
    "gradient through a contact": Question(
        BALL, GRADIENT.format(of="lj.integrate(system, *start, params | {'g': g}, ts=ts).q[-1]", jit=""), None, 20.0,
    ),
    "gradient through a contact in 64 lanes": Question(
        BALL, "end = lambda h, g: lj.integrate(system, h, 0.0, {'g': g}, ts=ts).q[-1]\n"
        "lanes = jax.vmap(jax.grad(end, argnums=1), (0, None))\n"
        "answer = lambda x: lanes(jnp.linspace(1.0, 1.2, 64), 9.81 * x)", None, 24.0,
    ),
    "gradient of a mean of lanes through a contact": Question(
        BALL, "end = lambda h, g: lj.integrate(system, h, 0.0, {'g': g}, ts=ts).q[-1]\n"
        "mean = lambda g: jnp.mean(jax.vmap(end, (0, None))(jnp.linspace(1.0, 1.2, 64), g))\n"
        "answer = lambda x: jax.grad(mean)(9.81 * x)", None, 29.0,
    ),
    "accelerations on the rod": Question(ROD, ACCELERATIONS, None, 0.6),
    "sweep of 1,000 pendulums": Question(
        PENDULUM, "run = lambda point: lj.integrate(system, point['angle'], 0.0, {'g': 9.81}, ts=ts).q[-1]\n"
        "answer = lambda x: lj.sweep(run, {'angle': x * np.linspace(0.1, 2.0, 1000)}, progress=False).values",
        SOLVED, 1.5, what="one of its motions",
    ),
    "symmetries of a helix": Question(
        HELIX, "answer = lambda x: lj.symmetries(helix, q, v, params | {'h': 2.0 * x}).gap", None, 2.0,
    ),
    "equilibria on the rod": Question(
        ROD, "answer = lambda x: lj.equilibria(system, params | {'m': x}, starts=[{'x': 0.3, 'y': -1.9}]).q", None, 2.0,
    ),
    "equilibria of a governor": Question(
        GOVERNOR, "answer = lambda x: lj.equilibria(MECHANISM.system, MECHANISM.params | {'g': 9.81 * x}, "
        "starts=[MECHANISM.q0]).q", None, 2.0,
    ),
    "branches of a bead on a hoop": Question(
        BEAD, "answer = lambda x: lj.continue_equilibria(hoop, {'w': x, 'g': 9.0}, 0.0, along='w', to=5.0).critical",
        None, 2.0,
    ),
    "normal modes on the rod": Question(
        ROD + BEAD, "answer = lambda x: lj.normal_modes(system, 0.0, *at_rest, params | {'m': x}).roots", None, 2.0,
    ),
    "periodic orbit of a pendulum": Question(
        PENDULUM, "answer = lambda x: lj.periodic_orbit(system, start, 2.0, {'g': 9.81 * x}).period", None, 2.0,
    ),
    "periodic orbit on the rod": Question(
        ROD, "answer = lambda x: lj.periodic_orbit(system, start, 3.0, params | {'m': x}).period", None, 2.0,
    ),
    "cycles of a pendulum by amplitude": Question(
        PENDULUM, "orbit = lj.periodic_orbit(system, start, 2.0, params)\n"
        "answer = lambda x: lj.continue_orbits(orbit, along='q', to=2.0 * x).period", None, 2.0,
    ),
    "Floquet multipliers on the rod": Question(
        ROD + BEAD, "answer = lambda x: lj.floquet(system, 0.0, *at_rest, params | {'m': x}, 2.0).multipliers", None,
        2.0,
    ),
    "Lyapunov exponent of a double pendulum": Question(
        DOUBLE, "answer = lambda x: lj.lyapunov_exponents(system, *start, {'g': 9.81 * x}, ts=np.linspace(0, 20, 201))"
        ".exponents", None, 2.0,
    ),
    "fit of one number": Question(
        PENDULUM + "record = lambda x: lj.Record(np.linspace(0.0, 1.0, 21), q=x * np.cos(3.0 * np.linspace(0, 1, 21)), "
        "q0=1.0, v0=0.0)\n",
        "import warnings; warnings.simplefilter('ignore')\n"
        "answer = lambda x: lj.fit(system, record(x), {'g': 8.0}).params", None, 3.0,
    ),
}  # fmt: skip


def measured(definition, answer, again=False, cache="off"):
    """Run the question in a new process and return what it prints."""
    clock = "process_time" if CLOCK["seconds"] is time.process_time else "perf_counter"
    return in_new_process(f"CLOCK, AGAIN, CACHE = {clock!r}, {again!r}, {cache!r}\n{START}{definition}{answer}\n{END}")


def rows(wanted):
    """The import, then the requested rows of each question."""
    if wanted("import lagjax"):
        yield row("import lagjax", statistics.median(in_new_process(IMPORT) for _ in range(REPEATS)), 0.3)
    for name, question in QUESTIONS.items():
        if wanted(f"{name}: first answer") or wanted(f"{name}: compiled and traced, again, a step"):
            yield from first_and_next(name, question)
        if question.kept is not None and wanted(f"{name}: kept programs"):
            with tempfile.TemporaryDirectory() as folder:
                found = [measured(question.definition, question.ours, cache=folder) for _ in range(REPEATS + 1)]
            before, *kept = (result["first"] for result in found)
            yield row(f"{name}: first answer from kept programs", statistics.median(kept), question.kept, before=before)
        if question.instructions is not None and wanted(f"{name}: instructions"):
            with tempfile.TemporaryDirectory() as folder:
                begin = f"FOLDER, CLOCK, AGAIN, CACHE = {folder!r}, 'perf_counter', False, 'off'\n{DUMPED}{START}"
                count = in_new_process(f"{begin}{question.definition}{question.ours}{COUNT}")
            yield row(f"{name}: instructions before optimisation", count, question.instructions)


def first_and_next(name, question):
    """The first answer and another call, of lagjax and of the comparison alternately."""
    again = question.again is not None or question.step is not None
    ours, beside = [], []
    for _ in range(REPEATS):
        ours.append(measured(question.definition, question.ours, again))
        if question.beside is not None:
            beside.append(measured(question.definition, question.beside, again))
    middle = lambda results, key: statistics.median(result[key] for result in results)
    first, counts = middle(ours, "first"), {key: middle(ours, key) for key in ("programs", "traced")}
    if beside:
        ratio = statistics.median(a["first"] / b["first"] for a, b in zip(ours, beside))
        more = {"first": first, question.what: middle(beside, "first")}
        yield row(f"{name}: first answer / {question.what}", ratio, question.target, **more)
    else:
        yield row(f"{name}: first answer", first, question.target)
    yield row(f"{name}: compiled and traced by another call", sum(counts.values()), 0, **counts)
    if question.again is not None:
        yield row(f"{name}: again", middle(ours, "again"), question.again, jitted=middle(beside, "again"))
    if question.step is not None:
        yield row(f"{name}: a step", middle(ours, "a step"), question.step, again=middle(ours, "again"))


if __name__ == "__main__":
    main(rows, __doc__)
