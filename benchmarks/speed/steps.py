"""Steps of a fixed length beside a Runge-Kutta loop by hand: environments for training, and long motions.

Question: does a training loop lose time by writing L in place of the accelerations? By hand is Kutta's method in a
`lax.scan` on the accelerations of a double pendulum from a textbook; a torque acts on the first rod in each step. One
long motion by hand keeps a checkpoint for each of √N pieces of N steps (`jax.checkpoint`). Both run in turn in one
process; a speed is the time by hand divided by ours.

    python -m benchmarks.speed.steps --processor-time
"""

import argparse
import time
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import lagjax as lj
from benchmarks import measure

DT, ENVIRONMENTS, STEPS = 0.02, 1024, 64
PARAMS = {"m": 1.0, "l": 1.0, "g": 9.81}


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


def main():
    """Print one line for each comparison."""
    parser = argparse.ArgumentParser(description="Steps beside a Runge-Kutta loop by hand.")
    parser.add_argument("--processor-time", action="store_true")
    parser.add_argument("--repeats", type=int, default=7)
    options = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if options.processor_time:
        measure.CLOCK["seconds"] = time.process_time
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
