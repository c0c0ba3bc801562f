"""Motions with a network in L, and gradients with respect to its weights: ours and diffrax's, in separate processes.

The systems are a particle in the plane, a double pendulum in its angles, and a particle on a rod; their potentials
contain a network of two hidden layers. diffrax integrates with its Dopri8 as shipped and differentiates with its
default adjoint; its accelerations are written as a user would, from the same L by `jax.grad` and `jax.jvp`. The
tolerance is the loosest of a list at which a gradient is within `ERROR` of that at `EXACT`. Each is compared with its
own limit; the two limits agree to that accuracy. `gradient_cost.py` makes rows of the results.

    python -m benchmarks.learned.networks "987 numbers, a particle, 100 outputs" lagjax
"""

import json
import sys
import time
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj

ERROR, EXACT, TOLERANCES, REPEATS = 1e-5, 1e-11, np.geomspace(1e-3, 1e-9, 13), 9


class Problem(NamedTuple):
    """Width of the hidden layers, lanes (0: a single motion), outputs, and the time of the last one."""

    kind: str
    hidden: int
    lanes: int
    outputs: int
    end: float


PROBLEMS = {
    "751 numbers, 64 particles, 20 outputs": Problem("particle", 25, 64, 20, 5.0),
    "987 numbers, a particle, 100 outputs": Problem("particle", 29, 0, 100, 100.0),
    "981 numbers, a double pendulum, 100 outputs": Problem("double pendulum", 28, 0, 100, 100.0),
    "20,165 numbers, a particle, 100 outputs": Problem("particle", 140, 0, 100, 100.0),
    "20,308 numbers, a double pendulum, 100 outputs": Problem("double pendulum", 139, 0, 100, 100.0),
    "987 numbers, 64 particles, 100 outputs": Problem("particle", 29, 64, 100, 100.0),
    "987 numbers, a rod with its multiplier, 100 outputs": Problem("rod", 29, 0, 100, 20.0),
}


def network(layers, x):
    """A network of two hidden layers with one output."""
    for weights, shift in layers[:-1]:
        x = jnp.tanh(x @ weights + shift)
    weights, shift = layers[-1]
    return (x @ weights + shift)[0]


def layers(*sizes):
    """The initial weights of such a network."""
    random = np.random.default_rng(0)
    of = lambda n, m: (random.normal(size=(n, m)) / np.sqrt(n), 0.1 * random.normal(size=m))
    return [of(*pair) for pair in zip(sizes[:-1], sizes[1:])]


def particle(t, q, v, p):
    """In a bowl."""
    return 0.5 * jnp.sum(v**2) - 0.5 * jnp.sum(q**2) - network(p, q)


def double_pendulum(t, q, v, p):
    """A double pendulum of unit masses and lengths."""
    kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    inputs = jnp.concatenate([jnp.sin(q), jnp.cos(q)])
    return kinetic + 2 * jnp.cos(q[0]) + jnp.cos(q[1]) - 0.2 * network(p, inputs)


def on_rod(t, q, v, p):
    """A particle with weight on a unit circle."""
    return 0.5 * jnp.sum(v**2) - 9.81 * q[1] - network(p, q)


LAGRANGIANS = {"particle": particle, "double pendulum": double_pendulum, "rod": on_rod}


def field(problem):
    """The accelerations by hand."""

    def of_particle(t, y, p):
        return y[1], jax.grad(lambda q: particle(t, q, y[1], p))(y[0])

    def of_double_pendulum(t, y, p):
        q, v = y
        momentum = lambda q, v: jax.grad(double_pendulum, 2)(t, q, v, p)
        across = jnp.cos(q[0] - q[1])
        mass = jnp.array([[2.0, across], [across, 1.0]])
        force = jax.grad(double_pendulum, 1)(t, q, v, p) - jax.jvp(lambda q: momentum(q, v), (q,), (v,))[1]
        return v, jnp.linalg.solve(mass, force)

    return {"particle": of_particle, "double pendulum": of_double_pendulum}[problem.kind]


def motion(problem, who, method=""):
    """`motion(tolerance, p, q0, v0)` -> the outputs, by our default method or the method of that name."""
    ts = np.linspace(0.0, problem.end, problem.outputs)
    if who == "diffrax":
        terms = diffrax.ODETerm(field(problem))

        def by_diffrax(tolerance, p, q0, v0):
            controller = diffrax.PIDController(rtol=tolerance, atol=tolerance)
            return diffrax.diffeqsolve(
                terms, diffrax.Dopri8(), ts[0], ts[-1], None, (q0, v0), args=p, saveat=diffrax.SaveAt(ts=ts),
                stepsize_controller=controller, max_steps=4096,
            ).ys  # fmt: skip

        return by_diffrax
    rod = {"rod": lj.Holonomic(lambda t, q, p: jnp.sum(q**2) - 1.0)} if problem.kind == "rod" else {}
    system = lj.System(LAGRANGIANS[problem.kind], rod)

    def by_lagjax(tolerance, p, q0, v0):
        chosen = getattr(lj, method)() if method else None
        traj = lj.integrate(system, q0, v0, p, ts=ts, rtol=tolerance, atol=tolerance, method=chosen, throw=False)
        return traj.q, traj.v

    return by_lagjax


def measured(name, who, method="", clock="perf_counter"):
    """Seconds of the first gradient, of a later one and of a solve; the error and the tolerance."""
    now = getattr(time, clock)
    jax.config.update("jax_enable_x64", True)
    problem = PROBLEMS[name]
    inputs = 4 if problem.kind == "double pendulum" else 2
    p = jax.tree.map(jnp.asarray, layers(inputs, problem.hidden, problem.hidden, 1))
    random = np.random.default_rng(1)
    q0, v0 = random.normal(size=(2, max(problem.lanes, 1), 2))
    if problem.kind != "particle":
        v0 = 0.3 * v0
    if problem.kind == "rod":
        q0 = q0 / np.linalg.norm(q0, axis=1)[:, None]
        v0 = v0 - np.sum(v0 * q0, axis=1)[:, None] * q0
    if problem.kind == "double pendulum":
        # Small enough that the motion is regular and the gradient still meaningful after sixteen periods.
        q0 = 0.3 * q0
    one = motion(problem, who, method)
    of_lanes = jax.vmap(one, (None, None, 0, 0)) if problem.lanes else one
    state = (q0, v0) if problem.lanes else (q0[0], v0[0])
    loss = lambda tolerance, p: sum(jnp.mean((x - 0.1) ** 2) for x in of_lanes(tolerance, p, *state))
    gradient, solve = jax.jit(jax.value_and_grad(loss, 1)), jax.jit(loss)
    flat = lambda found: np.concatenate([np.ravel(x) for x in jax.tree.leaves(found[1])])
    started = now()
    jax.block_until_ready(gradient(jnp.asarray(1e-6), p))
    first, right = now() - started, flat(gradient(jnp.asarray(EXACT), p))
    for tolerance in map(jnp.asarray, TOLERANCES):
        error = float(np.linalg.norm(flat(gradient(tolerance, p)) - right) / np.linalg.norm(right))
        if error <= ERROR:
            break

    def median(function):
        times = []
        for _ in range(REPEATS + 1):
            started = now()
            jax.block_until_ready(function(tolerance, p))
            times.append(now() - started)
        return float(np.median(times[1:]))

    memory = gradient.lower(tolerance, p).compile().memory_analysis()
    return {
        "first": first, "next": median(gradient), "solve": median(solve), "error": error, "rtol": float(tolerance),
        "MB": memory.temp_size_in_bytes / 1e6, "size": float(np.linalg.norm(right)),
    }  # fmt: skip


if __name__ == "__main__":
    print(json.dumps(measured(*sys.argv[1:])))
