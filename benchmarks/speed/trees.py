"""Do trees in joint coordinates cost as their number of bodies, and as much as engines written for them?

Chains of N rods on hinges, one metre and one kilogram in all, released at rest, as a `lj.bodies.Tree`: accelerations by
the articulated-body recursion. Measured are

- an evaluation of the accelerations inside a compiled loop, beside MuJoCo's `mj_forward` (without contacts) and
  Pinocchio's `aba` on the same chain, and the exponent p of its cost N^p from 64 to 1,000 links;
- a whole step, of RK4 in `lj.rollout`, beside MuJoCo's `mj_step` with its RK4 (four evaluations each; its Euler, one);
- `lj.integrate` at 1e-9: in a new process the first answer and the memory, then a step, by two motions of which one is
  twice as long, without the time before the first step, in which M_ii is found for each coordinate, and its exponent;
- a motion of 60 rods, 0.1 s at 1e-9, beside SciPy's DOP853 with the equations in absolute angles by hand in NumPy, a
  full mass matrix, at the same tolerances, with the difference at the end;
- the time to trace and compile an evaluation.

    python -m benchmarks.speed.trees [--json FILE] [--only TEXT] [--processor-time]
"""

import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

import lagjax as lj  # noqa: E402
from benchmarks.measure import compiled, in_new_process, in_turn, main, row, skipped  # noqa: E402
from lagjax.jaxtools import one_function  # noqa: E402

try:
    import mujoco
except ImportError:
    mujoco = None
try:
    import pinocchio
except ImportError:
    pinocchio = None

jax.config.update("jax_enable_x64", True)

COUNTS, FITTED = (8, 64, 256, 1000), (64, 1000)
EVALUATIONS, REPEATS = 20, 25
# Steps of so many seconds; motions that take some fifty steps.
STEP, SPANS = 1e-5, {64: 0.2, 256: 0.05, 1000: 0.005}
G, RODS, TIME, TOLERANCE = 9.81, 60, 0.1, 1e-9


def moments(count):
    """The moments of inertia of one of so many rods, a tenth as thick as long in the one that does not matter."""
    across = 1 / (12 * count**3)
    return across, across, across / 10


def chain(count):
    """A chain of rods along -z, on hinges about y: the system, and its first coordinates."""
    rods = [lj.bodies.Body(f"rod {i}", 1 / count, moments(count)) for i in range(count)]
    y, half = (0.0, 1.0, 0.0), 0.5 / count
    above = [lj.bodies.ground.at(axis=y), *(rod.at((0.0, 0.0, -half), y) for rod in rods)]
    tree = lj.bodies.Tree(
        rods, {"angles": [lj.bodies.revolute(a, rod.at((0.0, 0.0, half), y)) for a, rod in zip(above, rods)]}
    )
    return tree.system([lj.bodies.weight(rods)]), {"angles": jnp.asarray(relative_angles(count))}


def relative_angles(count):
    """The absolute angles grow from 0.3 to 1.2 along the chain."""
    return np.diff(np.linspace(0.3, 1.2, count), prepend=0.0)


def evaluations(count):
    """A compiled loop of evaluations, each at a state that depends on the one before; and the seconds of compiling."""
    system, q = chain(count)

    def loop(q, v):
        def once(state, _):
            q, v = state
            a = system.forward_dynamics(0.0, q, v, jax.tree.map(jnp.zeros_like, q), None)
            step = lambda x, y: jax.tree.map(lambda x, y: x + 1e-9 * y, x, y)
            return (step(q, v), step(v, a)), None

        return jax.lax.scan(once, (q, v), length=EVALUATIONS)[0]

    arguments = q, {"angles": 0.5 * jnp.cos(jnp.arange(float(count)))}
    program, seconds = compiled(lambda *x: one_function(loop, *x), *arguments)
    return (lambda: program(*arguments)), seconds


def rollouts(count):
    """The same number of steps of RK4."""
    system, q = chain(count)
    v = {"angles": 0.5 * jnp.cos(jnp.arange(float(count)))}
    program = jax.jit(lambda q, v: lj.rollout(system, q, v, None, EVALUATIONS, STEP))
    return lambda: program(q, v)


def integrated(count, motions=2):
    """Seconds and steps of motions over T, 2 T, ..., each a first and a second time, and the megabytes then."""
    system, q = chain(count)
    v, found = jax.tree.map(jnp.zeros_like, q), []
    for i in range(1, motions + 1):
        for _ in range(3):
            ts, started = jnp.array([0.0, i * SPANS[count]]), time.process_time()
            traj = lj.integrate(system, q, v, ts=ts, rtol=TOLERANCE, atol=TOLERANCE, estimate_error=False)
            jax.block_until_ready(traj.q)
            found.append((time.process_time() - started, int(traj.stats["num_steps"])))
    # The peak of this process alone; that of `resource` is inherited.
    (peak,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return {"motions": found, "megabytes": int(peak.split()[1]) / 1024}


def in_mujoco(count, step=None):
    """`mj_forward` on the same chain, or steps of a method."""
    xx, yy, zz = moments(count)
    joint = '<joint type="hinge" axis="0 1 0"/>'
    body = '<body pos="0 0 {at}">' + joint + '<inertial pos="0 0 {half}" mass="{mass}" diaginertia="{I}"/>'
    parts = dict(half=-0.5 / count, mass=1 / count, I=f"{xx} {yy} {zz}")
    inside = "".join(body.format(at=0.0 if i == 0 else -1 / count, **parts) for i in range(count)) + "</body>" * count
    flags = f'<option integrator="{step or "Euler"}" timestep="{STEP}"><flag contact="disable" constraint="disable"/>'
    flags += "</option>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{flags}<worldbody>{inside}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = relative_angles(count), 0.5 * np.cos(np.arange(count))

    def evaluate():
        for _ in range(EVALUATIONS):
            (mujoco.mj_step if step else mujoco.mj_forward)(model, data)

    return evaluate


def in_pinocchio(count):
    """`aba` on the same chain."""
    model, joint = pinocchio.Model(), 0
    inertia = pinocchio.Inertia(1 / count, np.array([0.0, 0.0, -0.5 / count]), np.diag(moments(count)))
    for i in range(count):
        place = pinocchio.SE3(np.eye(3), np.array([0.0, 0.0, 0.0 if i == 0 else -1 / count]))
        joint = model.addJoint(joint, pinocchio.JointModelRY(), place, f"{i}")
        model.appendBodyToJoint(joint, inertia, pinocchio.SE3.Identity())
    data, zero = model.createData(), np.zeros(count)
    q, v = relative_angles(count), 0.5 * np.cos(np.arange(count))

    def evaluate():
        for _ in range(EVALUATIONS):
            pinocchio.aba(model, data, q, v, zero)

    return evaluate


def by_hand(count):
    """The same motion in absolute angles, with NumPy and SciPy."""
    mass, length, inertia = 1 / count, 1 / count, moments(count)[1]
    i = np.arange(count)
    beyond = count - 1 - np.maximum(i[:, None], i[None, :])
    # Each pair moves all rods beyond the outer one by whole lengths, and that one by a half, if they differ, or by 1/4.
    couples = mass * length**2 * (beyond + np.where(i[:, None] == i, 0.25, 0.5))
    hangs = mass * G * length * (count - 1 - i + 0.5)

    def rates(t, y):
        angle, rate = np.split(y, 2)
        between = angle[:, None] - angle[None, :]
        matrix = couples * np.cos(between) + inertia * np.eye(count)
        forces = -couples * np.sin(between) @ rate**2 - hangs * np.sin(angle)
        return np.concatenate([rate, np.linalg.solve(matrix, forces)])

    start = np.concatenate([np.linspace(0.3, 1.2, count), np.zeros(count)])
    return lambda: solve_ivp(rates, (0.0, TIME), start, method="DOP853", rtol=TOLERANCE, atol=TOLERANCE)


def rows(wanted):
    """Evaluations and their growth, the motion beside SciPy."""
    found = {}
    for count in COUNTS:
        if not wanted(f"evaluation, N = {count}"):
            continue
        evaluate, seconds = evaluations(count)
        others = {"mj_forward": mujoco and in_mujoco, "aba": pinocchio and in_pinocchio}
        # MuJoCo reads no XML that is nested deeper.
        named = {name: make(count) for name, make in others.items() if make and count <= 256}
        times = in_turn(evaluate, *named.values(), repeats=REPEATS, shortest=5e-3)
        found[count] = times.minima[0]
        per = 1e6 / EVALUATIONS
        yield row(f"evaluation, N = {count}, us", times.medians[0] * per, least=times.minima[0] * per)
        yield row(f"evaluation, N = {count}: trace and compile, s", seconds)
        for place, name in enumerate(named, start=1):
            ratio, least = times.ratio(0, place)
            target = 2.0 if (name, count) == ("mj_forward", 64) else None
            yield row(f"evaluation / {name}, N = {count}", ratio, target, least=least, theirs=times.minima[place] * per)
    if not mujoco:
        yield skipped("evaluation / mj_forward", "MuJoCo is not installed")
    if all(count in found for count in FITTED):
        few = [count for count in COUNTS if FITTED[0] <= count <= FITTED[1]]
        slope = np.polyfit(np.log(few), np.log([found[count] for count in few]), 1)[0]
        yield row("exponent of an evaluation, N = 64 to 1000", slope, 1.1)
    if mujoco and wanted("step of RK4 / mj_step with RK4, N = 64"):
        others = [in_mujoco(64, method) for method in ("RK4", "Euler")]
        times = in_turn(rollouts(64), *others, repeats=REPEATS, shortest=5e-3)
        ratio, least = times.ratio(0, 1)
        per = 1e6 / EVALUATIONS
        yield row(
            "step of RK4 / mj_step with RK4, N = 64", ratio, least=least, ours=times.minima[0] * per,
            theirs=times.minima[1] * per, with_euler=times.minima[2] * per,
        )  # fmt: skip
    per_step = {}
    for count in SPANS:
        if not wanted(f"integrate, N = {count}"):
            continue
        source = f"import json; from benchmarks.speed.trees import integrated as i; print(json.dumps(i({count})))"
        found = in_new_process(source)
        (first, _), *_ = found["motions"]
        (short, few), (long, many) = (min(map(tuple, found["motions"][i : i + 3])) for i in (0, 3))
        per_step[count] = (long - short) / (many - few)
        yield row(f"integrate, N = {count}: first answer, s", first, megabytes=found["megabytes"])
        yield row(f"integrate, N = {count}: a step, ms", 1e3 * per_step[count], steps=many)
    if len(per_step) == len(SPANS):
        slope = np.polyfit(np.log(list(per_step)), np.log(list(per_step.values())), 1)[0]
        yield row("exponent of a step of integrate, N = 64 to 1000", slope)
    if wanted("motion / SciPy, 60 rods"):
        system, q = chain(RODS)
        ts, zero = jnp.array([0.0, TIME]), jax.tree.map(jnp.zeros_like, q)
        solve = jax.jit(lambda q, v: lj.integrate(system, q, v, ts=ts, rtol=TOLERANCE, atol=TOLERANCE, throw=False))
        ours, theirs = (lambda: solve(q, zero)), by_hand(RODS)
        times = in_turn(ours, theirs, repeats=5)
        ratio, least = times.ratio(0, 1)
        motion, reference = ours(), theirs()
        apart = np.max(np.abs(np.cumsum(motion.q["angles"][-1]) - reference.y[:RODS, -1]))
        yield row(
            "motion / SciPy, 60 rods", ratio, 1.0, least=least, apart=float(apart), ours=times.minima[0],
            theirs=times.minima[1], steps=int(motion.stats["num_steps"]), evaluations_of_theirs=int(reference.nfev),
        )  # fmt: skip


if __name__ == "__main__":
    main(rows, __doc__)
