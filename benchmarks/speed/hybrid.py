"""What do switches cost in a batch, and before the first answer? The targets are 1.5 and 2.

    python -m benchmarks.speed.hybrid [--skip-first-answer]

The batch consists of 1,000 pendulums that swing against a wall, each with another amplitude, compared with the same
1,000 without the wall. The first answers are those of the hoop that rolls, slips and flies, each in a separate process,
compared with that of only the phase with most equations.
"""

import argparse
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.measure import in_turn

jax.config.update("jax_enable_x64", True)
WALL, E, TS = 0.25, 0.9, np.linspace(0.0, 8.0, 9)
FIRST_ANSWER = """
import time
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
import lagjax as lj
from lagjax.scenes import rolling_hoop, slipping_hoop as scene
system = {system}
rate = -np.sqrt(9.8125 * (1 - np.sin(1.5)) / 1.25)
start = time.perf_counter()
lj.integrate(system, *rolling_hoop.start(scene.PARAMS, 1.5, rate), scene.PARAMS, ts=np.linspace(0.0, 0.9, 31))
print(time.perf_counter() - start)
"""
THREE = "lj.Hybrid(dict(list(zip(scene.hybrid.names, scene.hybrid.systems))[:3]), scene.hybrid.switches[:3])"


def pendulum(t, q, v, params):
    """A pendulum of unit length and mass, in its angle."""
    return 0.5 * v**2 + 9.81 * jnp.cos(q)


def gap(t, q, params):
    """Of the wall."""
    return WALL - q


free = lj.System(pendulum)
walled = lj.Hybrid(
    {"swings": free}, [lj.Switch("swings", to="swings", when=lj.guards.touches(gap, E))], most_switches=20
)


def batch(system):
    """The final states of a batch of motions, as a compiled function of their initial states."""
    return jax.jit(jax.vmap(lambda q: lj.integrate(system, q, 0.0, ts=TS, estimate_error=False, throw=False).q[-1]))


def in_a_batch():
    """Print the time of the batch with the wall over that without, and its difference from single runs."""
    starts, without, having = jnp.linspace(-0.2, -1.5, 1000), batch(free), batch(walled)
    times = in_turn(lambda: having(starts), lambda: without(starts), repeats=9)
    some = np.array([0, 499, 999])
    alone = [lj.integrate(walled, starts[i], 0.0, ts=TS, estimate_error=False) for i in some]
    counts = [len(traj.switches) for traj in alone]
    off = np.max(np.abs(having(starts)[some] - np.array([traj.q[-1] for traj in alone])))
    print(
        f"1,000 pendulums, {min(counts)} to {max(counts)} impacts each: {1e3 * times.medians[0]:.1f} ms, without the "
        f"wall {1e3 * times.medians[1]:.1f} ms, ratio {times.ratio()[0]:.2f} (target 1.5); off single runs by {off:.0e}"
    )


def first_answers():
    """Print the seconds until the first answer of three phases, and of the largest phase alone."""

    def seconds(system):
        return float(subprocess.run([sys.executable, "-c", FIRST_ANSWER.format(system=system)], capture_output=True,
                                    text=True, check=True).stdout)  # fmt: skip

    largest, three = seconds("scene.hybrid.systems[0]"), seconds(THREE)
    print(
        f"first answer: three phases {three:.1f} s, the largest {largest:.1f} s, ratio {three / largest:.1f} (target 2)"
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--skip-first-answer", action="store_true")
    skip = parser.parse_args().skip_first_answer
    in_a_batch()
    if not skip:
        first_answers()
