"""Steps of a fixed length beside a Runge-Kutta loop by hand: environments for training, and long motions.

Question: does a training loop lose time by writing L in place of the accelerations? By hand is Kutta's method in a
`lax.scan` on the accelerations of a double pendulum from a textbook; a torque acts on the first rod in each step. One
long motion by hand keeps a checkpoint for each of √N pieces of N steps (`jax.checkpoint`). Both run in turn in one
process; a speed is the time by hand divided by ours.

With `--networks` the force is a network (equinox's MLP of q and v, tanh), of a pendulum, of a double pendulum with a
vector and with a dict of coordinates, and of a mass in the plane on a rod, which by hand is returned to it by division.
Rows say the time of ours divided by that by hand: of the motion and of its gradient by the weights, in `jax.jit` and
called from Python, where the scan by hand is jitted, and the first answer of each, tracing and compiling.

    python -m benchmarks.speed.steps --processor-time
    python -m benchmarks.speed.steps --networks --processor-time
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import lagjax as lj
from benchmarks import measure

DT, ENVIRONMENTS, STEPS = 0.02, 1024, 64
PARAMS = {"m": 1.0, "l": 1.0, "g": 9.81}
# Steps and their length under networks of these widths and depths.
WITH_STEPS, WITH_NETWORK, NETWORKS = 400, 0.01, ((32, 2), (64, 3))


def lagrangian(t, q, v, p):
    """Two equal masses on two equal rods, by the angles of the rods."""
    kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return p["m"] * p["l"] ** 2 * kinetic + p["m"] * p["g"] * p["l"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


double_pendulum = lj.System(lagrangian, force=lambda t, q, v, p: jnp.stack([p["torque"], jnp.zeros_like(p["torque"])]))


def accelerations(q, v, p, torque):
    """Solved for by hand."""
    c, s = jnp.cos(q[0] - q[1]), jnp.sin(q[0] - q[1])
    first = torque / (p["m"] * p["l"] ** 2) - 2 * p["g"] / p["l"] * jnp.sin(q[0]) - s * v[1] ** 2
    second = -p["g"] / p["l"] * jnp.sin(q[1]) + s * v[0] ** 2
    return jnp.stack([first - c * second, 2 * second - c * first]) / (2 - c**2)


def by_hand(q, v, p, torques, dt, pieces=1):
    """The states after each step."""

    def step(y, torque):
        def f(q, v):
            return accelerations(q, v, p, torque)

        q, v = y
        k1, l1 = v, f(q, v)
        k2, l2 = v + dt / 2 * l1, f(q + dt / 2 * k1, v + dt / 2 * l1)
        k3, l3 = v + dt / 2 * l2, f(q + dt / 2 * k2, v + dt / 2 * l2)
        k4, l4 = v + dt * l3, f(q + dt * k3, v + dt * l3)
        y = q + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), v + dt / 6 * (l1 + 2 * l2 + 2 * l3 + l4)
        return y, y

    def piece(y, torques):
        return lax.scan(step, y, torques)

    if pieces == 1:
        return piece((q, v), torques)[1]
    found = lax.scan(jax.checkpoint(piece, prevent_cse=False), (q, v), torques.reshape(pieces, -1))[1]
    return jax.tree.map(lambda x: x.reshape(-1, 2), found)


def ours(q, v, p, torques, dt):
    """The same by `rollout`."""
    _, q, v = lj.rollout(double_pendulum, q, v, p, {"torque": torques}, dt)
    return q[1:], v[1:]


def last_by_hand(q, v, p, torques, dt, steps, pieces):
    """The last state, with a torque that is the same in all steps."""
    found = by_hand(q, v, p, jnp.broadcast_to(jnp.sum(torques), steps), dt, pieces)
    return jax.tree.map(lambda x: x[-1], found)


def last_of_fixed(q, v, p, torques, dt, steps):
    """The same by `integrate`."""
    fixed = {"method": lj.RK4(), "stepsize_controller": diffrax.ConstantStepSize(), "dt0": dt, "max_steps": None}
    ts, p = jnp.stack([jnp.zeros_like(dt), steps * dt]), p | {"torque": jnp.sum(torques)}
    end = lj.integrate(double_pendulum, q, v, p, ts=ts, estimate_error=False, **fixed).end
    return end.q, end.v


def compared(what, functions, arguments, repeats):
    """Print the speed of ours, the agreement, and the memory of both."""
    programs, seconds = [], []
    for function in functions:
        started = time.process_time()
        programs.append(jax.jit(function).lower(*arguments).compile())
        seconds.append(time.process_time() - started)
    theirs, mine = ([np.asarray(x) for x in jax.tree.leaves(program(*arguments))] for program in programs)
    error = max(float(np.max(np.abs(a - b)) / np.max(np.abs(a))) for a, b in zip(theirs, mine))
    times = measure.in_turn(*(partial(program, *arguments) for program in programs), repeats=repeats)
    memory = [program.memory_analysis().temp_size_in_bytes / 1e6 for program in programs]
    print(
        f"{what:42} speed {times.ratio(0, 1)[0]:.2f}, {1e3 * times.medians[1]:.1f} ms; compile {seconds[0]:.0f} s by "
        f"hand, {seconds[1]:.0f} s; memory {memory[0]:.1f} and {memory[1]:.1f} MB; differ by {error:.0e}",
        flush=True,
    )


def one_lane(options):
    """Print the first and the next call of one motion, by what a user writes and by diffrax with the formula."""
    torque = {"torque": 0.3}
    ts = np.linspace(0.0, 2.0, 21)

    def field(t, y, p):
        return y[1], accelerations(*y, p, p["torque"])

    @jax.jit
    def formula(q, v, p):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Tsit5(), ts[0], ts[-1], None, (q, v), args=p,
            saveat=diffrax.SaveAt(ts=ts), stepsize_controller=diffrax.PIDController(rtol=1e-6, atol=1e-6),
        ).ys  # fmt: skip

    def ours(q, v, p, **options):
        found = lj.integrate(double_pendulum, q, v, p, ts=ts, rtol=1e-6, atol=1e-6, **options)
        return found.q, found.v

    inside = jax.jit(partial(ours, estimate_error=False))
    given, firsts = (np.array([1.0, 0.5]), np.zeros(2), PARAMS | torque), []
    for function in (formula, ours):
        started = measure.CLOCK["seconds"]()
        jax.block_until_ready(function(*given))
        firsts.append(measure.CLOCK["seconds"]() - started)
    times = measure.in_turn(*(partial(f, *given) for f in (formula, ours, inside)), repeats=5 * options.repeats)
    print(
        f"one lane, first call {firsts[1]:.1f} s, {firsts[1] / firsts[0]:.2f} x diffrax with the formula; next "
        f"{1e3 * times.medians[1]:.2f} ms, {times.ratio(1, 0)[0]:.2f} x, with checks and errors; in jit without the "
        f"estimate of errors {1e3 * times.medians[2]:.2f} ms, {times.ratio(2, 0)[0]:.2f} x",
        flush=True,
    )


def by_network(t, q, v, p):
    """The force, a network of all coordinates and velocities."""
    return p["net"](jnp.concatenate([jnp.ravel(x) for x in jax.tree.leaves((q, v))]))


def by_name(y):
    """Two angles by name."""
    return {"one": y[0], "two": y[1]}


def together(q):
    """Two named angles in one vector."""
    return jnp.stack([q["one"], q["two"]])


def on_rod(q, v, force):
    """The accelerations of a unit mass with weight on a unit rod."""
    force = force - jnp.array([0.0, PARAMS["g"]])
    return force - (v @ v + q @ force) / (q @ q) * q


def of_two(q, v, force):
    """Those of the double pendulum under a torque on each rod."""
    only_first = accelerations(q, v, PARAMS, force[0])
    c = jnp.cos(q[0] - q[1])
    return only_first + force[1] * jnp.stack([-c, 2 * jnp.ones_like(c)]) / (2 - c**2)


def returned(q, v):
    """A state returned to the unit rod."""
    q = q / jnp.sqrt(q @ q)
    return q, v - (v @ q) * q


class UnderNetwork(NamedTuple):
    """A system, its accelerations by hand, a start, and the return to the constraint by hand."""

    system: lj.System
    by_hand: Callable
    start: tuple
    back: Callable = lambda q, v: (q, v)


UNIT_ROD = {"rod": lj.Holonomic(lambda t, q, p: 0.5 * (q @ q - 1.0))}
UNDER_NETWORKS = {
    "pendulum": UnderNetwork(
        lj.System(lambda t, q, v, p: 0.5 * v**2 + p["g"] * jnp.cos(q), force=by_network),
        lambda q, v, force: force - PARAMS["g"] * jnp.sin(q), (0.5, 0.3),
    ),
    "double pendulum": UnderNetwork(
        lj.System(lagrangian, force=by_network), of_two,
        (np.array([0.5, 0.8]), np.array([0.3, -0.2])),
    ),
    "double pendulum by names": UnderNetwork(
        lj.System(
            lambda t, q, v, p: lagrangian(t, together(q), together(v), p),
            force=lambda *state: by_name(by_network(*state)),
        ),
        lambda q, v, force: by_name(of_two(together(q), together(v), together(force))),
        ({"one": 0.5, "two": 0.8}, {"one": 0.3, "two": -0.2}),
    ),
    "rod": UnderNetwork(
        lj.System(lambda t, q, v, p: 0.5 * v @ v - p["g"] * q[1], UNIT_ROD, force=by_network), on_rod,
        (np.array([0.6, -0.8]), np.array([0.4, 0.3])), returned,
    ),
}  # fmt: skip


def rolled_by_hand(case, q, v, p, steps):
    """The states after each of so many steps of Kutta's method."""

    def f(q, v):
        return case.by_hand(q, v, case.system.force(0.0, q, v, p))

    def moved(y, h, k):
        return jax.tree.map(lambda x, k: x + h * k, y, k)

    def step(y, _):
        q, v = y
        k1, l1 = v, f(q, v)
        k2, l2 = moved(v, WITH_NETWORK / 2, l1), f(moved(q, WITH_NETWORK / 2, k1), moved(v, WITH_NETWORK / 2, l1))
        k3, l3 = moved(v, WITH_NETWORK / 2, l2), f(moved(q, WITH_NETWORK / 2, k2), moved(v, WITH_NETWORK / 2, l2))
        k4, l4 = moved(v, WITH_NETWORK, l3), f(moved(q, WITH_NETWORK, k3), moved(v, WITH_NETWORK, l3))
        sums = (
            jax.tree.map(lambda a, b, c, d: a + 2 * b + 2 * c + d, *k) for k in ((k1, k2, k3, k4), (l1, l2, l3, l4))
        )
        y = case.back(*(moved(x, WITH_NETWORK / 6, k) for x, k in zip(y, sums)))
        return y, y

    return lax.scan(step, (q, v), None, steps)[1]


def rolled(case, q, v, p, steps):
    """The same by `rollout`."""
    _, q, v = lj.rollout(case.system, q, v, p, steps, WITH_NETWORK)
    return jax.tree.map(lambda x: x[1:], (q, v))


def networks(options):
    """Print a line for each system, network, number of lanes and quantity."""
    for name, (width, depth), lanes in product(UNDER_NETWORKS, NETWORKS, (1, 64)):
        title = f"{name}, {width} x {depth}, {lanes} lanes"
        if options.only in title:
            under_network(title, UNDER_NETWORKS[name], width, depth, lanes, options.repeats)


def under_network(title, case, width, depth, lanes, repeats):
    """Print the lines of one system with one network."""
    inputs = sum(np.size(x) for x in jax.tree.leaves(case.start))
    outputs = "scalar" if inputs == 2 else inputs // 2
    net = eqx.nn.MLP(inputs, outputs, width, depth, activation=jnp.tanh, key=jax.random.key(0))
    weights, rest = eqx.partition({"net": net}, eqx.is_array)
    q, v = jax.tree.map(jnp.asarray, case.start)
    if lanes > 1:
        # The same start, seen in other mirrors and at other speeds, stays on a rod.
        speeds = jnp.linspace(0.5, 1.5, lanes)
        q = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes, *x.shape)), q)
        v = jax.tree.map(lambda x: jnp.multiply.outer(speeds, x), v)

    def motion(rolled, weights):
        def one(q, v):
            return rolled(case, q, v, PARAMS | eqx.combine(weights, rest), WITH_STEPS)

        return (jax.vmap(one) if lanes > 1 else one)(q, v)

    # From Python the scan by hand is jitted, and what is made of its results is not.
    scan, rollout = jax.jit(partial(motion, rolled_by_hand)), partial(motion, rolled)

    def slopes(motion):
        return jax.grad(lambda weights: sum(jnp.mean(x**2) for x in jax.tree.leaves(motion(weights))))

    for what, (hand, mine) in {"motion": (scan, rollout), "gradient": (slopes(scan), slopes(rollout))}.items():
        programs, firsts = [], []
        for function in (hand, mine):
            started = time.process_time()
            programs.append(jax.jit(function).lower(weights).compile())
            firsts.append(time.process_time() - started)
        found = [np.concatenate([np.ravel(x) for x in jax.tree.leaves(f(weights))]) for f in programs]
        inside = measure.in_turn(*(partial(f, weights) for f in programs), repeats=repeats)
        outside = measure.in_turn(partial(hand, weights), partial(mine, weights), repeats=repeats)
        print(
            f"{title}, {what:8}: {inside.ratio(1, 0)[0]:.2f} of the time by hand ({1e3 * inside.medians[0]:.1f} ms); "
            f"from Python {outside.ratio(1, 0)[0]:.2f} ({1e3 * outside.medians[0]:.1f} ms); first "
            f"{firsts[1] / firsts[0]:.1f} ({firsts[0]:.1f} s); differ by {np.max(np.abs(found[0] - found[1])):.0e}",
            flush=True,
        )


def main():
    """Print one line for each comparison."""
    parser = argparse.ArgumentParser(description="Steps beside a Runge-Kutta loop by hand.")
    parser.add_argument("--processor-time", action="store_true")
    parser.add_argument("--networks", action="store_true", help="with a network in the force, and nothing else")
    parser.add_argument("--only", default="", help="networks whose row contains it")
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.processor_time:
        measure.CLOCK["seconds"] = time.process_time
    if options.networks:
        networks(options)
        return
    one_lane(options)
    random = np.random.default_rng(0)

    def arguments(lanes, steps, dtype):
        shape = (lanes,) if lanes > 1 else ()
        q, v, torques = (random.normal(size=(*shape, n)).astype(dtype) for n in (2, 2, steps))
        p = jax.tree.map(lambda x: np.asarray(x, dtype), PARAMS)
        return q, v, p, torques, np.asarray(DT if lanes > 1 else 1e-3, dtype)

    def gradient(function):
        return jax.grad(lambda *a: sum(jnp.mean(x**2) for x in function(*a)), (2, 3))

    lanes = [jax.vmap(function, (0, 0, None, 0, None)) for function in (by_hand, ours)]
    for dtype in ("float32", "float64"):
        given = arguments(ENVIRONMENTS, STEPS, dtype)
        compared(f"{ENVIRONMENTS} environments, {STEPS} steps, {dtype}", lanes, given, options.repeats)
        compared(f"their gradient, {dtype}", [gradient(f) for f in lanes], given, options.repeats)
    for steps in (10_000, 100_000):
        given = arguments(1, steps, "float64")
        pieces = 100 if steps == 10_000 else 400
        both = [partial(by_hand, pieces=pieces), ours]
        compared(f"one motion, {steps} steps", both, given, options.repeats)
        compared("its gradient", [gradient(f) for f in both], given, options.repeats)
        given = *given[:3], given[3][:30] / 30, given[4]
        both = [partial(last_by_hand, steps=steps, pieces=pieces), partial(last_of_fixed, steps=steps)]
        compared(f"integrate, {steps} fixed steps", both, given, options.repeats)
        compared("its gradient", [gradient(f) for f in both], given, options.repeats)


if __name__ == "__main__":
    main()
