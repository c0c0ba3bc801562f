"""A sweep as its own process, for tests that kill it: `worker.py STORE K N POINTS [PORT]` prints what it computed.

It rests after each chunk, so that there is a while in which it can be killed.
With a port the processes know of each other by `jax.distributed`, which then says which part is whose.
"""

import signal
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.meter import Silent
from lagjax.sweeps import engine

jax.config.update("jax_enable_x64", True)

pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))


def run(point):
    """The angle after a while; where it starts too far out, the steps are used up."""
    steps = {"max_steps": 400}
    return lj.integrate(pendulum, point["angle"], 0.0, {"g": point["g"]}, ts=jnp.array([0.0, 60.0]), **steps).q[-1]


def quick(point):
    """A closed form."""
    return jnp.sqrt(point["g"]) * jnp.cos(point["angle"])


def axes(points):
    """Ten values of g, and as many angles as it takes."""
    # By NumPy: what XLA rounds may differ between processes, and a store knows its axes bit for bit.
    return {"g": np.linspace(0.5, 20.0, 10), "angle": np.linspace(0.1, 3.0, points // 10)}


class Resting(Silent):
    """A meter that takes its time."""

    def update(self, count):
        """After a chunk."""
        time.sleep(0.05)


if __name__ == "__main__":
    # A shell has what it starts in the background ignore Ctrl-C, and Python keeps to that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    engine._meter = lambda total, progress: Resting()
    store, k, n, points, *port = sys.argv[1], *map(int, sys.argv[2:])
    if port:
        jax.distributed.initialize(f"127.0.0.1:{port[0]}", num_processes=n, process_id=k)
    part = None if port else (k, n)
    print(lj.sweep(run, axes(points), store=store, part=part, chunk=32, workers=1, progress=False).ran)
