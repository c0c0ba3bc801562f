"""What does lagjax cost on top of diffrax?

Two comparisons: the bead on a rotating hoop, 100 periods at 1e-9, where diffrax uses an acceleration derived by hand
and lagjax automatic derivatives, its checks and its outputs; and the Cartesian pendulum, where lagjax projects onto the
rod after every step and diffrax, with the hand-derived tension, drifts. Both run alternately in one process; times are
medians after warm-up, and compile time is separate.

    python -m benchmarks.speed.against_diffrax [--json FILE]
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
from lagjax.scenes import bead_on_hoop

jax.config.update("jax_enable_x64", True)

TOLERANCE = 1e-9
REPEATS = 15


def bead_by_hand(method, end):
    """diffrax with psi'' = sin psi (omega² cos psi - g/a)."""
    g, a, omega = (bead_on_hoop.PARAMS[name] for name in ("g", "a", "omega"))

    def field(t, y, args):
        psi, rate = y
        return rate, jnp.sin(psi) * (omega**2 * jnp.cos(psi) - g / a)

    return _diffrax(field, method, end, (jnp.asarray(1.0), jnp.asarray(0.0)))


def bead_by_lagjax(method, end):
    """The same from its Lagrangian."""
    return _lagjax(bead_on_hoop.system, 1.0, 0.0, bead_on_hoop.PARAMS, method, end)


def pendulum_by_hand(method, end):
    """diffrax with the tension of the rod derived by hand, without projection onto the rod."""

    def field(t, y, args):
        q, v = y
        multiplier = (9.8125 * q[1] - v @ v) / (q @ q)
        return v, multiplier * q + jnp.array([0.0, -9.8125])

    return _diffrax(field, method, end, (jnp.array([1.25, 0.0]), jnp.zeros(2)))


def pendulum_by_lagjax(method, end):
    """The same from its Lagrangian and constraint."""
    system = lj.System(
        lambda t, q, v, params: 0.5 * jnp.dot(v, v) - params["g"] * q[1],
        {"rod": lj.Holonomic(lambda t, q, params: jnp.dot(q, q) - params["l"] ** 2)},
    )
    return _lagjax(system, np.array([1.25, 0.0]), np.zeros(2), {"g": 9.8125, "l": 1.25}, method, end)


def _diffrax(field, method, end, y0):
    def solve(tolerance):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            method,
            0.0,
            end,
            None,
            y0,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=2**20,
        )
        return jax.tree.map(lambda x: x[-1], solution.ys), solution.stats["num_steps"]

    return solve


def _lagjax(system, q0, v0, params, method, end):
    def solve(tolerance):
        traj = lj.integrate(
            system, q0, v0, params, ts=np.array([0.0, end]), method=method, rtol=tolerance, atol=tolerance, throw=False
        )
        return (traj.end.q, traj.end.v), traj.stats["num_steps"]

    return solve


def energy(state):
    """The pendulum's energy: zero for a release at the height of the pivot."""
    q, v = state
    return float(0.5 * v @ v + 9.8125 * q[1]) / (9.8125 * 1.25)


def main():
    """Time each pair in turn."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", help="also write the rows there")
    options = parser.parse_args()
    bead_end, pendulum_end = 230.0, 266.0  # about 100 periods each
    bead_exact = float(bead_on_hoop.exact_motion(bead_on_hoop.PARAMS, 1.0, bead_end)[0])
    rows = []
    for method in (diffrax.Tsit5(), diffrax.Dopri8()):
        for scene, by_hand, by_lagjax, error in (
            ("bead", bead_by_hand(method, bead_end), bead_by_lagjax(method, bead_end),
             lambda state: abs(float(state[0]) - bead_exact)),
            ("pendulum", pendulum_by_hand(method, pendulum_end), pendulum_by_lagjax(method, pendulum_end),
             lambda state: abs(energy(state))),
        ):  # fmt: skip
            rows += _pair(scene, type(method).__name__, {"diffrax": by_hand, "lagjax": by_lagjax}, error)
    machine = f"{platform.processor() or platform.machine()}, JAX {jax.__version__}, diffrax {diffrax.__version__}"
    print(f"{machine}, float64, tolerance {TOLERANCE:g}; error: of psi after 100 periods; of the energy")
    for row in rows:
        print(
            "{scene:9s} {method:7s} {by:8s} {ms:8.2f} ms  {steps:6d} steps  {us:6.2f} us a step  "
            "error {error:.1e}  compile {compile:.1f} s  time / diffrax's {ratio:.2f}".format(**row)
        )
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"machine": machine, "rows": rows}, file, indent=1)


def _pair(scene, method, solves, error):
    tolerance = jnp.asarray(TOLERANCE)
    compiled, compile_seconds, outcomes, times = {}, {}, {}, {name: [] for name in solves}
    for name, solve in solves.items():
        started = time.perf_counter()
        compiled[name] = jax.jit(solve)
        outcomes[name] = jax.block_until_ready(compiled[name](tolerance))
        compile_seconds[name] = time.perf_counter() - started
    for _ in range(REPEATS):
        for name in solves:
            started = time.perf_counter()
            jax.block_until_ready(compiled[name](tolerance))
            times[name].append(time.perf_counter() - started)
    medians = {name: float(np.median(seconds)) for name, seconds in times.items()}
    return [
        {
            "scene": scene,
            "method": method,
            "by": name,
            "ms": 1e3 * medians[name],
            "steps": int(outcomes[name][1]),
            "us": 1e6 * medians[name] / int(outcomes[name][1]),
            "error": error(outcomes[name][0]),
            "compile": compile_seconds[name],
            "ratio": medians[name] / medians["diffrax"],
        }
        for name in solves
    ]


if __name__ == "__main__":
    main()
