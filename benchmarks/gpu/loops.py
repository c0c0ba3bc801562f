"""Fixed steps and a large sweep on a GPU or a CPU: what training and parameter studies do, beside the same by hand.

rollout   double pendulums, 64 steps of Kutta's method with a torque in each, and the gradient with respect to the
          torques and the masses, beside `lax.scan` on accelerations from a textbook (`benchmarks/speed/steps.py`)
sweep     `lj.sweep` over 1e6 speeds of a rotating hoop, its blocks as it chooses them and all points in one,
          beside one `jax.vmap` of all; every point against elliptic functions
host      operations of these programs that need the host (`host_operations.py`)

python -m benchmarks.gpu.loops [--small] [--json FILE] [--only TEXT]
"""

import functools
import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import lagjax as lj  # noqa: E402
from benchmarks.gpu import on_gpu  # noqa: E402
from benchmarks.gpu.host_operations import host_operations  # noqa: E402
from benchmarks.measure import compiled, in_turn, main, row, small  # noqa: E402
from benchmarks.speed import steps  # noqa: E402

jax.config.update("jax_enable_x64", True)

DTYPES = ("float32", "float64")
ENVIRONMENTS, POINTS = (1_024, 65_536), 1_000_000
SMALL = {"environments": (64,), "points": 4_096}
OPTIONS = {"small": False}
# Each number of a gradient relative to the largest of its kind; a rollout's errors grow with its length.
AGREE = {"float32": 1e-3, "float64": 1e-9}
TOLERANCE = {"float32": 1e-5, "float64": 1e-8}


def rollouts(lanes, dtype):
    """The rows of one number of environments."""
    random = np.random.default_rng(0)
    q, v, torques = (jnp.asarray(random.normal(size=(lanes, n)), dtype) for n in (2, 2, steps.STEPS))
    p = jax.tree.map(lambda x: jnp.asarray(x, dtype), steps.PARAMS)
    arguments = q, v, p, torques, jnp.asarray(steps.DT, dtype)
    both = [jax.vmap(function, (0, 0, None, 0, None)) for function in (steps.by_hand, steps.ours)]
    gradients = [jax.grad(functools.partial(size, function), (2, 3)) for function in both]
    for what, functions in (("steps", both), ("gradient", gradients)):
        title = f"{lanes:,} environments, {steps.STEPS} steps, {dtype}, {what}"
        programs, first = zip(*(compiled(function, *arguments) for function in functions))
        by_hand, ours = (jax.tree.leaves(program(*arguments)) for program in programs)
        differ = max(float(jnp.max(jnp.abs(a - b)) / jnp.max(jnp.abs(a))) for a, b in zip(by_hand, ours))
        times = in_turn(*(functools.partial(program, *arguments) for program in programs))
        yield row(f"{title}: ours / by hand", times.ratio(1, 0)[0], 1.0, ms=1e3 * times.medians[1],
                  by_hand_ms=1e3 * times.medians[0], compile_s=first[1], by_hand_compile_s=first[0],
                  steps_per_s=lanes * steps.STEPS / times.medians[1])  # fmt: skip
        yield row(f"{title}: differ by", differ, AGREE[dtype])
        yield row(f"{title}: operations on the host", len(host_operations(programs[1].as_text())), 0)


def size(function, *arguments):
    """The mean square of all states."""
    return sum(jnp.mean(x**2) for x in function(*arguments))


def swept(points, dtype):
    """The rows of the sweep: its rate, beside one program of all points; the largest error in radians."""
    case = on_gpu.problem("beads", points)
    p, omegas = on_gpu.in_dtype((case.p, case.x), dtype)
    tolerance = TOLERANCE[dtype]

    def run(point):
        return on_gpu.end_of_ours(case, tolerance, p, point["omega"])

    at_once, compile_s = compiled(jax.vmap(lambda omega: run({"omega": omega})), omegas)
    by_blocks = functools.partial(lj.sweep, run, {"omega": omegas}, progress=False)
    found = by_blocks()
    functions = (
        lambda: at_once(omegas), lambda: by_blocks().values, lambda: by_blocks(chunk=points).values,
    )  # fmt: skip
    times = in_turn(*functions, repeats=3)
    title = f"{points:,} beads, {dtype}"
    for place, name in ((1, "sweep"), (2, "sweep in one block")):
        yield row(f"{title}: {name} / one vmap", times.ratio(place, 0)[0], 1.25, s=times.medians[place],
                  vmap_s=times.medians[0], motions_per_s=points / times.medians[place],
                  compile_s=compile_s)  # fmt: skip
    right = on_gpu.reference(case, "motions")
    yield row(f"{title}: error in radians", on_gpu.error(case, "motions", found.values, right),
              on_gpu.ERROR[dtype]["motions"])  # fmt: skip


def rows(wanted):
    """Rollouts, then sweeps."""
    for dtype in DTYPES:
        for lanes in SMALL["environments"] if OPTIONS["small"] else ENVIRONMENTS:
            if wanted(f"{lanes:,} environments, {dtype}"):
                yield from rollouts(lanes, dtype)
        points = SMALL["points"] if OPTIONS["small"] else POINTS
        if wanted(f"{points:,} beads, {dtype}"):
            yield from swept(points, dtype)


if __name__ == "__main__":
    OPTIONS["small"] = small()
    main(rows, __doc__)
