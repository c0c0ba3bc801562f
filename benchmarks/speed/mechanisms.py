"""How long does a user wait for the first answer about a mechanism, and for the next one?

Each case runs in a fresh process; everything after `import` counts: tracing, compiling, running. Processor time is that
of all threads, which other load on the machine affects little.

    first answer    processor seconds; `wall`, of which `xla` in XLA's compiler; `memory`: the most resident, GB
    again           the same call with other numbers, ms: the least of several; most of it traces the user's functions
    steps           of the motion
    operations      of the accelerations (written out: and of the return to the constraints), as `lj.explain` says

`--ways written,arrays,plain` compares the representations, each in a process of its own: equations written out number
by number, in arrays (one matrix, or a band) within the same machine function, and plain JAX (`LAGJAX_PLAIN=1`).

    python -m benchmarks.speed.mechanisms [--json FILE] [--only TEXT] [--ways WAYS]
"""

import sys
from typing import NamedTuple

from benchmarks.measure import in_new_process, main, row

START = """
import os
if WAY == "plain":
    os.environ["LAGJAX_PLAIN"] = "1"
import json, resource, time
import jax
import jax.numpy as jnp
import numpy as np
jax.config.update("jax_enable_x64", True)
import lagjax as lj
from lagjax.mechanics import equations, scalar_equations
from lagjax.system.coordinates import state
from lagjax.system import traced_system
from lagjax.system.model import model_of
if WAY == "arrays":
    equations.is_small = lambda model: False
if WAY == "written":
    equations.is_small = lambda model: not scalar_equations.is_plain()
    scalar_equations.LONG = scalar_equations.CONSTRAINED_LONG = 1_000_000
# The first operation of a process starts JAX's backend.
jax.block_until_ready(jnp.arange(3.0) + 1.0)
xla = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **_: xla.append(seconds) if name.endswith("backend_compile_duration") else None
)
done = lambda tree: jax.block_until_ready([x for x in jax.tree.leaves(tree) if isinstance(x, jax.Array)])
ts = np.linspace(0.0, 1.0, 5)
"""
END = """
before = time.process_time(), time.perf_counter()
done(answer(1.0))
first, wall = time.process_time() - before[0], time.perf_counter() - before[1]
memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
in_xla = sum(xla)
times = []
while len(times) < 3 or len(times) < 50 and sum(times) < 1.0:
    before = time.perf_counter()
    found = answer(1.0 + 1e-6 * (1 + len(times)))
    done(found)
    times.append(time.perf_counter() - before)
s = state(0.0, *start, params)
found_equations = equations.equations_of(model_of(traced_system(system, s), *s), fast=True)
print(json.dumps({
    "first": first, "wall": wall, "xla": in_xla, "memory": memory, "again": 1e3 * min(times),
    "steps": int(getattr(found, "stats", {}).get("num_steps", 0)), "written": found_equations.are_written,
    "operations": found_equations.operations(s.t, found_equations.inside(s.q), found_equations.inside(s.v)),
}))
"""

RATTLEBACK = """
# An ellipsoid that rolls on a plane, its principal axes of inertia turned against those of its shape; Euler's angles.
half = jnp.array([0.2, 0.03, 0.02])

def turned(q):
    c, s = jnp.cos, jnp.sin
    yaw, roll, pitch = q["yaw"], q["roll"], q["pitch"]
    z = jnp.array([[c(yaw), -s(yaw), 0], [s(yaw), c(yaw), 0], [0, 0, 1]])
    x = jnp.array([[1, 0, 0], [0, c(roll), -s(roll)], [0, s(roll), c(roll)]])
    y = jnp.array([[c(pitch), 0, s(pitch)], [0, 1, 0], [-s(pitch), 0, c(pitch)]])
    return z @ x @ y

def spin(q, v):
    R, dR = jax.jvp(turned, (q,), (v,))
    W = R.T @ dR
    return jnp.array([W[2, 1], W[0, 2], W[1, 0]])

def lagrangian(t, q, v, p):
    w, u = spin(q, v), jnp.array([v["x"], v["y"], v["z"]])
    return 0.5 * p["m"] * u @ u + 0.5 * w @ p["I"] @ w - p["m"] * p["g"] * q["z"]

def contact(q):
    n = turned(q).T @ jnp.array([0.0, 0.0, 1.0])
    return -(half**2) * n / jnp.sqrt(n @ (half**2 * n))

def rolls(t, q, v, p):
    w, r = spin(q, v), contact(q)
    return jnp.array([v["x"], v["y"], v["z"]]) + turned(q) @ jnp.cross(w, r)

tilt = 0.03
axes = np.array([[np.cos(tilt), -np.sin(tilt), 0], [np.sin(tilt), np.cos(tilt), 0], [0, 0, 1]])
params = {"m": 1.0, "g": 9.81, "I": axes @ np.diag([2e-4, 1.6e-3, 1.7e-3]) @ axes.T}
system = lj.System(lagrangian, {"rolls": lj.Nonholonomic(rolls)})
q = {"x": 0.0, "y": 0.0, "z": 0.02, "yaw": 0.0, "roll": 0.01, "pitch": 0.0}
v = dict.fromkeys(q, 0.0) | {"yaw": -2.0}
start = lj.consistent_state(system, 0.0, q, v, params)
"""
CARDAN = """
# Input and output shaft turn about fixed axes, the middle one about a line between them: yaw, tilt and its own turn.
bend = 0.5
def about(axis, angle):
    x, y, z = axis
    K = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return jnp.eye(3) + jnp.sin(angle) * K + (1 - jnp.cos(angle)) * K @ K

line = np.array([np.cos(bend), np.sin(bend), 0.0]), np.array([np.cos(2 * bend), np.sin(2 * bend), 0.0])
def middle(q):
    return about((0, 0, 1), q["yaw"] + bend) @ about((0, 1, 0), q["tilt"]) @ about((1, 0, 0), q["turn"])

def lagrangian(t, q, v, p):
    R, dR = jax.jvp(middle, (q,), (v,))
    W = R.T @ dR
    w = jnp.array([W[2, 1], W[0, 2], W[1, 0]])
    return 0.5 * (p["in"] * v["in"] ** 2 + p["out"] * v["out"] ** 2) + 0.5 * w @ (p["I"] * w)

ey, ez = jnp.array([0.0, 1.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
yokes = {
    "first": lj.Holonomic(lambda t, q, p: (about((1, 0, 0), q["in"]) @ ey) @ (middle(q) @ ez)),
    "second": lj.Holonomic(
        lambda t, q, p: (about((0, 0, 1), 2 * bend) @ about((1, 0, 0), q["out"]) @ ey) @ (middle(q) @ ez)),
    "line": lj.Holonomic(lambda t, q, p: jnp.stack([q["yaw"], q["tilt"]])),
}
system = lj.System(lagrangian, yokes)
params = {"in": 0.1, "out": 0.2, "I": np.array([0.05, 0.02, 0.02])}
q = {"in": 0.0, "yaw": 0.0, "tilt": 0.0, "turn": 0.0, "out": 0.0}
start = lj.consistent_state(system, 0.0, q, dict.fromkeys(q, 0.0) | {"in": 3.0}, params)
"""
MASSLESS = """
# Three point masses on rods whose angles have no mass of their own.
def lagrangian(t, q, v, p):
    return 0.5 * p["m"] * jnp.sum(v["at"] ** 2) - p["m"] * p["g"] * jnp.sum(q["at"][:, 1])

def rods(t, q, p):
    along = jnp.stack([jnp.sin(q["angle"]), -jnp.cos(q["angle"])], 1)
    return (q["at"] - jnp.concatenate([jnp.zeros((1, 2)), q["at"][:-1]]) - p["l"] * along).ravel()

system, params = lj.System(lagrangian, {"rods": lj.Holonomic(rods)}), {"m": 1.0, "g": 9.81, "l": 0.5}
angle = np.array([0.5, 0.9, 1.3])
start = {"at": 0.5 * np.cumsum(np.stack([np.sin(angle), -np.cos(angle)], 1), 0), "angle": angle}
start = start, {"at": np.zeros((3, 2)), "angle": np.zeros(3)}
"""
FOUR_BAR = """
# Three moving bars, each with its place and angle, and four pins, each two equations.
bars, length = ("crank", "coupler", "rocker"), {"crank": 0.3, "coupler": 0.8, "rocker": 0.6}
def end(q, name, side):
    x, y, angle = q[name]
    return jnp.stack([x + side * length[name] / 2 * jnp.cos(angle), y + side * length[name] / 2 * jnp.sin(angle)])

def lagrangian(t, q, v, p):
    of_bar = lambda name: 0.5 * p["m"] * (v[name][0] ** 2 + v[name][1] ** 2 + length[name] ** 2 / 12 * v[name][2] ** 2)
    return sum(of_bar(name) - p["m"] * p["g"] * q[name][1] for name in bars)

ground = jnp.zeros(2), jnp.array([0.7, 0.0])
pins = {
    "A": lj.Holonomic(lambda t, q, p: end(q, "crank", -1) - ground[0]),
    "B": lj.Holonomic(lambda t, q, p: end(q, "coupler", -1) - end(q, "crank", 1)),
    "C": lj.Holonomic(lambda t, q, p: end(q, "rocker", 1) - end(q, "coupler", 1)),
    "D": lj.Holonomic(lambda t, q, p: end(q, "rocker", -1) - ground[1]),
}
system, params = lj.System(lagrangian, pins), {"m": 1.0, "g": 9.81}
q = {"crank": np.array([0.0, 0.15, 1.57]), "coupler": np.array([0.4, 0.45, 0.4]), "rocker": np.array([0.75, 0.3, 1.4])}
v = {name: np.zeros(3) for name in bars} | {"crank": np.array([-0.6, 0.0, 4.0])}
start = lj.consistent_state(system, 0.0, q, v, params)
"""
MECHANISM = """
from lagjax.mechanisms.{name} import MECHANISM
system, params, start = MECHANISM.system, dict(MECHANISM.params), (MECHANISM.q0, MECHANISM.v0)
ts = np.linspace(0.0, {end}, 5)
key = "{varied}"
"""
VEHICLE = """
from benchmarks.speed import bicycle
system, params, ts = bicycle.system, bicycle.PARAMS, np.linspace(0.0, 2.0, 5)
start = bicycle.straight(4.6, roll_rate=0.5)
"""
CHAIN = """
from benchmarks.speed.chain_scaling import open_chain
system, *start, params = open_chain({count})
"""
ANGLES = """
# Four links in absolute angles, as written in a book: a double sum.
def lagrangian(t, q, v, p):
    n = q.size
    weight = n - np.maximum.outer(np.arange(n), np.arange(n))
    return 0.5 * jnp.sum(weight * jnp.cos(q[:, None] - q) * v[:, None] * v) + p["g"] * (n - np.arange(n)) @ jnp.cos(q)
system, params, start = lj.System(lagrangian), {"g": 9.81}, (np.array([0.4, 0.5, 0.8, 1.1]), np.zeros(4))
"""
LOOPS = """
# Thirty-two links in absolute angles, in two loops of Python: 9,728 operations, of which 9,152 are repeats.
def lagrangian(t, q, v, p):
    found = 0.0
    for i in range(32):
        x = y = height = 0.0
        for j in range(i + 1):
            x, y = x + jnp.cos(q[j]) * v[j], y + jnp.sin(q[j]) * v[j]
            height = height - jnp.cos(q[j])
        found = found + 0.5 * (x**2 + y**2) - p["g"] * height
    return found
system, params, start = lj.System(lagrangian), {"g": 9.81}, (np.linspace(0.5, 0.7, 32), np.zeros(32))
"""
LINKS = """
# Four links as places and angles with pins written as constraints on single numbers.
def lagrangian(t, q, v, p):
    return 0.5 * p["m"] * jnp.sum(v**2) - p["m"] * p["g"] * jnp.sum(q[:, 1])
def rods(t, q, p):
    return jnp.sum(jnp.diff(q, axis=0, prepend=jnp.zeros((1, 2))) ** 2, axis=1) - p["l"] ** 2
system, params = lj.System(lagrangian, {"rods": lj.Holonomic(rods)}), {"m": 1.0, "g": 9.81, "l": 0.5}
angle = np.array([0.4, 0.5, 0.8, 1.1])
start = 0.5 * np.cumsum(np.stack([np.sin(angle), -np.cos(angle)], 1), 0), np.zeros((4, 2))
"""
BODY = """
body = lj.bodies.Body("body", mass=1.0, inertia=(0.1, 0.2, 0.3))
system, params = lj.bodies.multibody([body]), {"g": 9.81}
pose = lj.bodies.Pose.at((0.0, 0.0, 0.0))
start = {"body": pose}, {"body": pose.moving(spin=(0.1, 5.0, 0.1))}
"""
TOP = """
top = lj.bodies.Body("top", mass=1.0, inertia=(0.1, 0.1, 0.05))
tip = lj.bodies.spherical(lj.bodies.ground.at((0.0, 0.0, 0.0)), top.at((0.0, 0.0, -0.5)))
params = {"g": 9.81}
weight = lambda t, q, v, p: -p["g"] * top.point(q, (0.0, 0.0, 0.0))[2]
system = lj.bodies.multibody([top], {"tip": tip}, lagrangian=weight)
lying = lj.bodies.Pose.at((0.5, 0.0, 0.0), axis=(0.0, 1.0, 0.0), angle=jnp.pi / 2)
spin = jnp.array([80.0, 0.0, 0.0])
start = {"top": lying}, {"top": lying.moving(velocity=jnp.cross(spin, lying.position), spin=spin)}
"""
SHAFTS = """
# The double Cardan joint of three bodies.
bend = 0.5
places = [np.zeros(3), np.array([np.cos(bend), np.sin(bend), 0.0])]
places.append(places[1] + np.array([np.cos(2 * bend), np.sin(2 * bend), 0.0]))
shafts = [lj.bodies.Body(name, mass=1.0, inertia=(0.02, 0.1, 0.1)) for name in ("in", "middle", "out")]
ends = lambda body, side, axis: body.at((0.5 * side, 0.0, 0.0), axis)
y, z, x = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
axis = np.array([np.cos(2 * bend), np.sin(2 * bend), 0.0])
poses = [lj.bodies.Pose.at((-0.5, 0, 0)), lj.bodies.Pose.at(places[1] / 2, axis=z, angle=bend),
         lj.bodies.Pose.at(places[1] + axis / 2, axis=z, angle=2 * bend)]
joints = {
    "bearing": lj.bodies.revolute(lj.bodies.ground.at((-1.0, 0.0, 0.0), x), ends(shafts[0], -1, x)),
    "first": lj.bodies.universal(ends(shafts[0], 1, y), ends(shafts[1], -1, z)),
    "second": lj.bodies.universal(ends(shafts[1], 1, z), ends(shafts[2], -1, y)),
    "far": lj.bodies.cylindrical(lj.bodies.ground.at(places[1] + axis, axis), ends(shafts[2], 1, x)),
}
system, params = lj.bodies.multibody(shafts, joints), {"g": 1.0}
q = {b.name: pose for b, pose in zip(shafts, poses)}
v = {b.name: pose.moving() for b, pose in zip(shafts, poses)} | {"in": poses[0].moving(spin=(3.0, 0.0, 0.0))}
start = lj.consistent_state(system, 0.0, q, v, params)
"""
ARM = """
# Seven rods, each on the one before it by a hinge, about y and x by turns.
count, y, x = 7, (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)
rods = [lj.bodies.Body(f"rod {i}", mass=1.0, inertia=(0.02, 0.02, 0.001)) for i in range(count)]
low, high = (0.0, 0.0, -0.25), (0.0, 0.0, 0.25)
below = [lj.bodies.ground.at(axis=y), *(rod.at(high, (y, x)[(i + 1) % 2]) for i, rod in enumerate(rods[:-1]))]
hinge = lambda i, a, rod: lj.bodies.revolute(a, rod.at(low, (y, x)[i % 2]))
joints = {f"hinge {i}": hinge(i, a, rod) for i, (a, rod) in enumerate(zip(below, rods))}
pull = lj.bodies.weight(rods, lambda p: jnp.array([0.0, 0.0, -p["g"]]))
system, params = lj.bodies.multibody(rods, joints, [pull]), {"g": 9.81}
poses = [lj.bodies.Pose.at((0.0, 0.0, 0.25 + 0.5 * i)) for i in range(count)]
start = {rod.name: pose for rod, pose in zip(rods, poses)}, {rod.name: pose.moving() for rod, pose in zip(rods, poses)}
"""
MOVING = """
# All of it turns about the first hinge.
spin = jnp.array([0.0, 0.5, 0.0])
start = start[0], {name: pose.moving(jnp.cross(spin, pose.position), spin) for name, pose in start[0].items()}
"""
PIPE = """
# A ball that rolls in a standing pipe: f is the distance to the wall, or its square.
ball, radius = lj.bodies.Body("ball", mass=1.0, inertia=(0.004, 0.004, 0.004)), 0.1
across = lambda r: jnp.sqrt(r[0] ** 2 + r[1] ** 2)
pipe = lj.bodies.Surface({f}, is_distance={is_distance})
contact = lj.bodies.rolling_sphere(ball.at(), pipe, radius)
system, params = lj.bodies.multibody([ball], {{"wall": contact}}, [lj.bodies.weight([ball])]), {{"radius": 1.0}}
place = lj.bodies.Pose.at((0.9, 0.0, 0.0))
start = {{"ball": place}}, {{"ball": place.moving((0.0, 2.7, 0.5), spin=(0.0, 5.0, -27.0))}}
start, key = lj.consistent_state(system, 0.0, *start, params), "radius"
# The start is consistent for one radius alone.
answer = lambda x: lj.integrate(system, *start, params, ts=ts * x)
"""
SOLVED = """
key = globals().get("key", "g")
answer = lambda x: lj.integrate(system, *start, params | {key: params[key] * x}, ts=ts)
"""
ACCELERATIONS = """
answer = lambda x: lj.accelerations(system, 0.0, *start, {"g": 9.81 * x})
"""
LEDGER = """
answer = lambda x: lj.energy_ledger(lj.integrate(system, *start, params | {'g': x * 9.81}, ts=ts)).closure
"""


class Case(NamedTuple):
    """A definition; `answer(x)`; the target for its first answer, seconds (issue: 2 GB of memory each)."""

    definition: str
    target: float | None
    answer: str = SOLVED


CASES = {
    "rattleback": Case(RATTLEBACK, 6.0),
    "double Cardan": Case(CARDAN + "key = 'in'\n", 6.0),
    "double Cardan, bodies": Case(SHAFTS, None),
    "three massless links": Case(MASSLESS, 5.0),
    "four links": Case(LINKS, None),
    "four angles": Case(ANGLES, None),
    "32 angles in loops": Case(LOOPS, None),
    "four-bar with ledger": Case(FOUR_BAR, 12.0, LEDGER),
    "Bricard": Case(MECHANISM.format(name="bricard", end=0.5, varied="g"), 15.0),
    "Fekete": Case(MECHANISM.format(name="fekete", end=10.0, varied="alpha"), 20.0),
    "Andrews": Case(MECHANISM.format(name="andrews", end=0.003, varied="mom"), 10.0),
    "vehicle": Case(VEHICLE, 12.0),
    "chain of 32": Case(CHAIN.format(count=32), 12.0),
    "chain of 256": Case(CHAIN.format(count=256), 20.0),
    "free body": Case(BODY, None),
    "top": Case(TOP, None),
    "arm of seven bodies, accelerations": Case(ARM, None, ACCELERATIONS),
    "arm of seven bodies, a motion": Case(ARM + MOVING, 60.0),
    "ball in a pipe, by its distance": Case(
        PIPE.format(f='lambda r, p: p["radius"] - across(r)', is_distance=True), None, ""),
    "ball in a pipe, by its square": Case(
        PIPE.format(f='lambda r, p: p["radius"] ** 2 - across(r) ** 2', is_distance=False), None, ""),
}


def rows(wanted):
    """For each case and way: its first answer, with the rest in columns."""
    for name, case in CASES.items():
        for way in WAYS:
            what = name if way == "default" else f"{name}, {way}"
            if wanted(what):
                found = in_new_process(f"WAY = {way!r}\n{START}{case.definition}{case.answer}{END}")
                yield row(what, found.pop("first"), case.target, **found)


if __name__ == "__main__":
    WAYS = ["default"]
    if "--ways" in sys.argv:
        place = sys.argv.index("--ways")
        _, ways = sys.argv[place : place + 2]
        del sys.argv[place : place + 2]
        WAYS = ways.split(",")
    main(rows, __doc__)
