"""What does it cost to satisfy constraints, and to have redundant ones?

1. The projection onto the constraints after every step: the Cartesian pendulum with `drift="project"` and with
   `"none"`, 20 s at 1e-8; the projection's share of the run time, and how much it reduces the change of the Jacobi
   integral.
2. Redundant constraints: a pendulum on two rods instead of one, and a door with 18 equations instead of the 11
   independent ones; the ratio of the run times.

Both of a pair run alternately in one process; times are medians (and minima) of the compiled program after warm-up.

    python -m benchmarks.speed.constraints [--json FILE]
"""

import argparse
import json
import platform
import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj

jax.config.update("jax_enable_x64", True)

TOLERANCE = 1e-8
REPEATS = 31
LENGTH = 1.25


def falling(t, q, v, params):
    """A unit mass in a vertical plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 9.8125 * q["y"]


def rod(t, q, params):
    """The squared length."""
    return q["x"] ** 2 + q["y"] ** 2 - LENGTH**2


one_rod = lj.System(falling, {"rod": lj.Holonomic(rod)})
two_rods = lj.System(falling, {"rod": lj.Holonomic(rod), "again": lj.Holonomic(lambda t, q, p: 3 * rod(t, q, p))})
HORIZONTAL = ({"x": LENGTH, "y": 0.0}, {"x": 0.0, "y": 0.0})


def plate(t, q, v, params):
    """Four corners of a door, a unit mass each, in a field that is not along the hinge line."""
    return 0.5 * jnp.sum(v**2) + jnp.sum(q @ jnp.array([0.25, -0.5, -1.0]))


def hinges(t, q, params):
    """The inner corners are fixed, and the corners form a rectangle."""
    return jnp.concatenate([q[0], q[1] - jnp.array([0.0, 0.0, 2.0]), q[3] - q[1] - q[2] + q[0]])


def distances(pairs):
    """Squared distances of pairs of corners, minus their values."""
    lengths = {(0, 1): 4.0, (0, 2): 1.0, (0, 3): 5.0, (1, 2): 5.0, (1, 3): 1.0, (2, 3): 4.0}
    return lambda t, q, p: jnp.stack([jnp.sum((q[i] - q[j]) ** 2) - lengths[i, j] for i, j in pairs])


def third_hinge(t, q, params):
    """The point halfway up the hinge line is held in all three directions."""
    return 0.5 * (q[0] + q[1]) - jnp.array([0.0, 0.0, 1.0])


just_enough = {"hinges": lj.Holonomic(hinges), "width": lj.Holonomic(distances([(0, 2), (1, 2)]))}
surplus = {"third": lj.Holonomic(third_hinge), "rest": lj.Holonomic(distances([(0, 1), (0, 3), (1, 3), (2, 3)]))}
door, redundant_door = lj.System(plate, just_enough), lj.System(plate, just_enough | surplus)
OPEN = (
    np.array([[0, 0, 0], [0, 0, 2], [0.6, 0.8, 0], [0.6, 0.8, 2]], float),
    np.array([[0, 0, 0], [0, 0, 0], [-1.2, 0.9, 0], [-1.2, 0.9, 0]], float),
)


def solve(system, start, method, end, drift=None):
    """The compiled integration, taking its tolerance."""
    return jax.jit(
        lambda tolerance: lj.integrate(
            system, *start, ts=np.array([0.0, end]), method=method, rtol=tolerance, atol=tolerance, drift=drift,
            throw=False,
        )
    )  # fmt: skip


def timed(first, second):
    """Run both alternately; return median and least seconds of each, and their results."""
    tolerance, times = jnp.asarray(TOLERANCE), ([], [])
    found = [jax.block_until_ready(f(tolerance)) for f in (first, second)]
    for _ in range(REPEATS):
        for f, seconds in zip((first, second), times):
            started = time.perf_counter()
            jax.block_until_ready(f(tolerance))
            seconds.append(time.perf_counter() - started)
    return [np.median(seconds) for seconds in times], [np.min(seconds) for seconds in times], found


def row(what, value, target, met, note):
    """One line of the result."""
    return {"what": what, "value": float(value), "target": target, "met": bool(met), "note": note}


def main():
    """Time each pair."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", help="also write the rows there")
    options = parser.parse_args()
    rows = []
    for method in (diffrax.Dopri8(), diffrax.Tsit5()):
        name = type(method).__name__
        pair = (solve(one_rod, HORIZONTAL, method, 20.0, drift) for drift in ("project", "none"))
        (with_it, without), least, (kept, drifted) = timed(*pair)
        share, of_minima = 1 - without / with_it, 1 - least[1] / least[0]
        rows.append(
            row(f"projection, share of the time, {name}", share, 0.25, share <= 0.25, f"minima {of_minima:.2f}")
        )
        gain = float(drifted.drift() / kept.drift())
        rows.append(row(f"drift without projection / with, {name}", gain, 10, gain >= 10, f"{float(kept.drift()):.0e}"))
        for what, one, more, start in (
            ("two rods / one", one_rod, two_rods, HORIZONTAL),
            ("door, 18 equations / 11", door, redundant_door, OPEN),
        ):
            (plain, redundant), least, found = timed(*(solve(s, start, method, 10.0) for s in (one, more)))
            assert all(bool(traj.result == lj.RESULTS.successful) for traj in found)
            ratio = redundant / plain
            rows.append(row(f"{what}, {name}", ratio, 1.5, ratio <= 1.5, f"minima {least[1] / least[0]:.2f}"))
    machine = f"{platform.processor() or platform.machine()}, JAX {jax.__version__}, diffrax {diffrax.__version__}"
    print(f"{machine}, float64, tolerance {TOLERANCE:g}; medians of {REPEATS}")
    for line in rows:
        met = "ok" if line["met"] else "MISSED"
        print(f"{line['what']:42s} {line['value']:8.2f}  target {line['target']:5g}  {met:6s}  {line['note']}")
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"machine": machine, "rows": rows}, file, indent=1)


if __name__ == "__main__":
    main()
