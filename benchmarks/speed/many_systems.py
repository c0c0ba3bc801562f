"""Do memory and memory maps stay bounded if one process works on very many systems, one after the other?

Each program that XLA compiles keeps 20 to 500 memory maps, of which Linux allows a process 65,530, and megabytes of
memory. Here one process creates one system after the other, each with a different Lagrangian and its numbers as
literals, so that no program can be reused. It computes accelerations, a short motion and the Jacobi integral of each,
and drops it.

    largest, last half / early      for memory maps and resident memory: the largest count in the last half, over the
                                    largest between system 200, after JAX's caches were first cleared, and the end of
                                    the first quarter (or system 300, if that is later)
    lost                            systems with wrong results, judged by the Jacobi integral along the motion

A system takes 1.2 s of processor time: 400 take eight minutes, 2,000 forty. Needs Linux.

    python -m benchmarks.speed.many_systems [--systems 2000] [--moving 1] [--json FILE]

With `--moving 10` only each tenth is integrated, which takes a third of the time.
"""

import argparse
import gc
import os
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.measure import main, row

jax.config.update("jax_enable_x64", True)

EVERY, SETTLED = 50, 200
SHAPES = (
    "jnp.cos({k} * q)",
    "-jnp.tanh(q) ** 2 * {k}",
    "-{k} * q**2",
    "-jnp.exp({k} * q)",
    "-{k} / (2 + q)",
    "jnp.sin(q + {k})",
)
ONE = "lambda t, q, v, params: {m} * v**2 * (1 + {a} * q**{power}) + {shape}"
TWO = """lambda t, q, v, params: {m} * v[0]**2 + v[1]**2 + {a} * v[0] * v[1] * jnp.cos(q[0] - q[1]) + sum(
    {shape} for q in q)"""


def system(number):
    """A system that differs from all others, and its start; every fourth has two coordinates."""
    random = np.random.default_rng(number)
    numbers = dict(zip(("m", "a", "k"), 1 + random.uniform(size=3).round(6)))
    shape = SHAPES[number % 6].format(**numbers)
    source = (TWO if number % 4 == 3 else ONE).format(shape=shape, power=2 * (1 + number // 6 % 3), **numbers)
    start = (0.4, 0.5) if number % 4 != 3 else (np.array([0.4, 0.5]), np.array([0.1, 0.0]))
    return lj.System(eval(source, {"jnp": jnp})), start


def one(number, moving):
    """Whether a system's results agree: the energy at the end of its motion, and acceleration with the slope of v."""
    made, (q0, v0) = system(number)
    a, _ = lj.accelerations(made, 0.0, q0, v0, None)
    if not moving:
        return bool(np.isfinite(lj.jacobi_integral(made, 0.0, q0, v0, None)) and np.all(np.isfinite(a)))
    motion = lj.integrate(made, q0, v0, None, ts=[0.0, 1e-3, 0.1])
    change = lj.jacobi_integral(made, *motion.end[:3], None) - lj.jacobi_integral(made, 0.0, q0, v0, None)
    slope = (np.asarray(motion.v[1]) - v0) / 1e-3
    return bool(abs(change) < 1e-7 and np.all(np.abs(slope - np.asarray(a)) < 0.05 * (1 + np.abs(slope))))


def in_use():
    """The number of memory maps of this process, and its resident megabytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Path("/proc/self/maps").read_bytes().count(b"\n"), pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def rows(count, moving):
    """A row for every fifty systems, then the verdict."""
    lost, counts = 0, []
    for number in range(1, count + 1):
        lost += not one(number, number % moving == 0)
        if number % EVERY == 0:
            gc.collect()
            counts.append((number, *in_use()))
            yield row(f"memory maps after {number} systems", counts[-1][1], megabytes=counts[-1][2])
    early = [c for c in counts if SETTLED <= c[0] <= max(count // 4, SETTLED + 2 * EVERY)]
    late = [c for c in counts if c[0] > count // 2]
    for what, i in (("memory maps", 1), ("megabytes", 2)):
        of = lambda some, i=i: max(c[i] for c in some)
        yield row(f"{what}: largest, last half / early", of(late) / of(early), 1.2, largest=of(counts))
    yield row("lost", lost, 0, systems=count)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--systems", type=int, default=2000)
    parser.add_argument("--moving", type=int, default=1)
    options, rest = parser.parse_known_args()
    sys.argv[1:] = rest
    main(lambda wanted: rows(options.systems, options.moving), __doc__)
