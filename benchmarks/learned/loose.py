"""Gradients through motions of networks at loose tolerances, in batches, beside diffrax's Tsit5 by hand.

A double pendulum whose mass matrix and potential are networks of two hidden layers, in float32 at rtol 1e-5. "Known":
the networks are small corrections to the pendulum; "untrained": they are all there is, and the motion is slow. diffrax
takes the same L by `jax.grad`, `jax.jvp` and `jnp.linalg.solve`, as one writes it, and its own adjoint. Both run in one
process, in turn, up to seven times and for about a minute; errors are relative to a float64 gradient at 1e-8. Compiling
is timed apart, once, by processor time. With "adam" a row says what 200 steps of Adam take, and where both end.

    python -m benchmarks.learned.loose [known|untrained] [width] [lanes] [outputs] [way ... | adam]
"""

import sys
import time
from functools import partial
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optax

import lagjax as lj
from benchmarks.learned.models import layers, network

WAYS = {"default": {}, "exact outputs": {"outputs": "exact"}, "Dopri8": {"method": lj.Dopri8()}}
RTOL, EXACT, END, REPEATS, MINUTE = 1e-5, 1e-8, 2.0, 7, 60.0
# Steps and rate of a training; the networks are to follow the motions of other weights.
STEPS, RATE = 200, 1e-2


def kinetic(q):
    """The mass matrix of a double pendulum of unit masses and lengths."""
    across = jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([2.0 + 0 * across, across]), jnp.stack([across, 1.0 + 0 * across])])


def lagrangian(known: bool, t, q, v, p):
    """½ v·M v - V with M and V of one network of four numbers."""
    found = network(p, jnp.concatenate([jnp.sin(q), jnp.cos(q)]))
    mass, potential = lj.learned.positive_definite(found[:3]), found[3]
    if known:
        mass, potential = kinetic(q) + 0.1 * mass, 0.1 * potential - 9.81 * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))
    return 0.5 * v @ mass @ v - potential


def by_diffrax(known: bool, p, q0, v0, ts, rtol):
    """The motion as written by hand."""

    def field(t, y, p):
        q, v = y
        of = partial(lagrangian, known, t)

        def momentum(q, v):
            return jax.grad(of, 1)(q, v, p)

        mass = jax.jacfwd(momentum, 1)(q, v)
        force = jax.grad(of, 0)(q, v, p) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
        return v, jnp.linalg.solve(mass, force)

    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), diffrax.Tsit5(), ts[0], ts[-1], None, (q0, v0), args=p, saveat=diffrax.SaveAt(ts=ts),
        stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol), max_steps=512,
    ).ys  # fmt: skip


def by_lagjax(options: dict, known: bool, p, q0, v0, ts, rtol):
    """The motion by lagjax."""
    system = lj.System(partial(lagrangian, known))
    traj = lj.integrate(system, q0, v0, p, ts=ts, rtol=rtol, atol=rtol, throw=False, **options)
    return traj.q, traj.v


def programs(motion: Any, dtype: Any, kind: str, width: int, lanes: int, outputs: int, rtol: float):
    """A gradient and a loss, compiled, of no arguments."""
    random = np.random.default_rng(0)

    def cast(tree: Any):
        return jax.tree.map(lambda x: jnp.asarray(x, dtype), tree)

    p = cast(layers(random, 4, width, width, 4))
    q0, v0 = cast(0.5 * random.normal(size=(2, lanes, 2)))
    ts = np.linspace(0.0, END, outputs).astype(dtype)

    def loss(p, q0, v0):
        found = jax.vmap(lambda q0, v0: motion(kind == "known", p, q0, v0, ts, rtol))(q0, v0)
        return sum(jnp.mean((x - 0.1) ** 2) for x in found)

    gradient, forward = jax.jit(jax.value_and_grad(loss)), jax.jit(loss)
    return lambda: gradient(p, q0, v0), lambda: forward(p, q0, v0)


def trained(kind: str, width: int, lanes: int, outputs: int):
    """Print the time of a training by both, and the losses at its end; the first call, with its compilation, apart."""
    random, ts = np.random.default_rng(0), np.linspace(0.0, END, outputs).astype(np.float32)
    true, guess = (
        jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layers(random, 4, width, width, 4)) for _ in range(2)
    )
    q0, v0 = jnp.asarray(0.5 * random.normal(size=(2, lanes, 2)), jnp.float32)
    adam = optax.adam(RATE)

    def over_lanes(motion: Any, p):
        return jax.vmap(lambda q0, v0: motion(kind == "known", p, q0, v0, ts, RTOL))(q0, v0)

    data = jax.jit(partial(over_lanes, by_diffrax))(true)

    def training(motion: Any):
        def loss(p):
            return sum(jnp.mean((x - y) ** 2) for x, y in zip(over_lanes(motion, p), data))

        def step(carry, _):
            p, state = carry
            value, slopes = jax.value_and_grad(loss)(p)
            changes, state = adam.update(slopes, state)
            return (optax.apply_updates(p, changes), state), value

        return jax.jit(lambda p: jax.lax.scan(step, (p, adam.init(p)), None, STEPS)[1])

    seconds = {}
    for name, motion in {"diffrax": by_diffrax, "lagjax": partial(by_lagjax, {})}.items():
        train = training(motion)
        started = time.process_time()
        program = train.lower(guess).compile()
        compiled = time.process_time()
        losses = jax.block_until_ready(program(guess))
        seconds[name] = time.process_time() - compiled
        print(
            f"{kind} 2 x {width}, {lanes} lanes, {outputs} outputs: {STEPS} steps of Adam by {name}: "
            f"{seconds[name]:.1f} s, {seconds[name] / seconds['diffrax']:.2f} x diffrax, "
            f"compile {compiled - started:.1f} s; loss {losses[0]:.3e} to {losses[-1]:.3e}",
            flush=True,
        )


def flat(found: Any):
    """A gradient as one vector."""
    return np.concatenate([np.ravel(np.asarray(x, float)) for x in jax.tree.leaves(found[1])])


def measured(kind: str, width: int, lanes: int, outputs: int, ways: list[str]):
    """Print a row for each way: times over those of diffrax, and the error of its gradient."""
    motions = {"diffrax": by_diffrax} | {name: partial(by_lagjax, WAYS[name]) for name in ways}
    calls = {name: programs(of, jnp.float32, kind, width, lanes, outputs, RTOL) for name, of in motions.items()}
    found = {}
    for i, what in enumerate(("gradient", "forward")):
        firsts, times = {}, {name: [] for name in calls}
        for name, pair in calls.items():
            started = time.process_time()
            found[what, name] = jax.block_until_ready(pair[i]())
            firsts[name] = time.process_time() - started
        for _ in range(REPEATS):
            if sum(map(sum, times.values())) > MINUTE and len(times["diffrax"]) > 1:
                break
            for name, pair in calls.items():
                started = time.process_time()
                jax.block_until_ready(pair[i]())
                times[name].append(time.process_time() - started)
        for name, of_name in times.items():
            next_one, first = float(np.median(of_name)), firsts[name]
            ratio, of_first = next_one / float(np.median(times["diffrax"])), first / firsts["diffrax"]
            print(
                f"{kind} 2 x {width}, {lanes} lanes, {outputs} outputs: {what:8} {name:13} {1e3 * next_one:8.1f} ms, "
                f"{ratio:5.2f} x diffrax; first {first:6.1f} s, {of_first:5.2f} x",
                flush=True,
            )
    exact = flat(programs(by_diffrax, jnp.float64, kind, width, lanes, outputs, EXACT)[0]())
    for name in calls:
        error = np.linalg.norm(flat(found["gradient", name]) - exact) / np.linalg.norm(exact)
        print(f"error of the gradient: {name:13} {error:.1e}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    of_command = sys.argv[1:] or ["known", "64", "64", "21"]
    sizes = [int(x) for x in of_command[1:4]]
    if of_command[4:] == ["adam"]:
        trained(of_command[0], *sizes)
    else:
        measured(of_command[0], *sizes, of_command[4:] or list(WAYS))
