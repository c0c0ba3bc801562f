"""A sweep in its own process, for tests that kill it: `worker.py STORE K N POINTS [PORT]` prints the points it ran.

It sleeps after each chunk, so that there is time to kill it.
With a port the processes are connected by `jax.distributed`, which assigns their parts.
"""

import signal
import sys
import time
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.display.terminal import Silent

jax.config.update("jax_enable_x64", True)

pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))


def run(point):
    """The angle at t = 60; from large initial angles the steps run out."""
    steps = {"max_steps": 400}
    return lj.integrate(pendulum, point["angle"], 0.0, {"g": point["g"]}, ts=jnp.array([0.0, 60.0]), **steps).q[-1]


def quick(point):
    """A function in closed form, without an integration."""
    return jnp.sqrt(point["g"]) * jnp.cos(point["angle"])


def axes(points):
    """Ten values of g, and as many angles as needed."""
    # NumPy arrays: XLA may round differently between processes, and a store compares its axes bit for bit.
    return {"g": np.linspace(0.5, 20.0, 10), "angle": np.linspace(0.1, 3.0, points // 10)}


class Resting(Silent):
    """A meter that sleeps at each update."""

    def update(self, count):
        """Sleep after a chunk."""
        time.sleep(0.05)


if __name__ == "__main__":
    # A shell makes background processes ignore Ctrl-C, and Python inherits that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    setattr(import_module("lagjax.sweep.sweep"), "_meter", lambda total, progress: Resting())
    store, k, n, points, *port = sys.argv[1], *map(int, sys.argv[2:])
    if port:
        jax.distributed.initialize(f"127.0.0.1:{port[0]}", num_processes=n, process_id=k)
    part = None if port else (k, n)
    print(lj.sweep(run, axes(points), store=store, part=part, chunk=32, workers=1, progress=False).ran)
