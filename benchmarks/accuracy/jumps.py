"""Forces that jump or have a kink: is the motion right, and at what cost, with jumps found and without, and in diffrax?

Ten forces, each written the way one writes it first. The reference is a closed form, or else the motion by diffrax
at rtol 1e-13, which knows nothing of jumps. All runs at rtol 1e-9, atol as lagjax chooses it and 1e-12 in diffrax
(`Dopri8`, the same accelerations). Printed: error of the last position relative to its largest size, steps (accepted
and rejected), the time of a repeated call, and that of the first.

    python -m benchmarks.accuracy.jumps [--case WORDS]

The exit status is 1 if an error with jumps found is above 1e-6 and worse than without, or if steps are fewer in less
than eight of ten.
"""

import argparse
import platform
import sys
import time
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

import lagjax as lj

jax.config.update("jax_enable_x64", True)

RTOL, LOOSE = 1e-9, 1e-6
KNOTS, HEIGHTS = np.array([-1.0, -0.3, 0.0, 0.4, 1.0]), np.array([2.0, 0.5, 0.0, -0.8, -1.5])

# name: (force of (t, q, v), stiffness of the spring that L contains, start, end, closed form or None)
CASES = {
    "brake": (lambda t, q, v: jnp.where(q > 1.0, -3.0, 0.0), 0.0, (0.0, 3.0), 1.0, 3.0 * 1 - 1.5 * (2 / 3) ** 2),
    "dry friction": (lambda t, q, v: -2.943 * jnp.sign(v), 100.0, (0.5, 0.0), 4.0, 0.02912),
    "pulse": (lambda t, q, v: jnp.where((t > 4.0) & (t < 4.05), 1.0, 0.0), 0.0, (0.0, 0.0), 10.0, 0.05 * 5.975),
    "bump stop": (lambda t, q, v: -1e3 * jnp.maximum(q - 0.5, 0.0), 1.0, (-1.0, 0.0), 20.0, None),
    "dead zone": (lambda t, q, v: -5.0 * jnp.sign(q) * jnp.maximum(jnp.abs(q) - 0.2, 0.0), 0.0, (1.0, 0.0), 20.0, None),
    "bang-bang control": (lambda t, q, v: -jnp.sign(q + 0.5 * v), 0.0, (1.0, 0.0), 4.0, None),
    "saturated motor": (lambda t, q, v: jnp.clip(-6.0 * q - 0.3 * v, -1.0, 1.0), 0.0, (1.0, 0.0), 15.0, None),
    "relay in t": (lambda t, q, v: jnp.sign(jnp.sin(5.0 * t)), 1.0, (1.0, 0.0), 20.0, None),
    "table": (lambda t, q, v: jnp.interp(q, KNOTS, HEIGHTS), 0.0, (0.9, 0.0), 20.0, None),
    "contact with damper": (
        lambda t, q, v: jnp.where(q > 0, -jnp.maximum(800.0 * q + 8.0 * v, 0.0), 0.0) + 9.81, 0.0, (-0.5, 0.0), 3.0,
        None),
}  # fmt: skip


def lagjax_run(force, spring, start, end, how):
    """The last position, steps, first and repeated time."""
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * spring * q**2, force=lambda t, q, v, p: force(t, q, v))
    run = lambda: jax.block_until_ready(
        lj.integrate(system, *start, ts=np.array([0.0, end]), jumps=how, estimate_error=False, throw=False,
                     max_steps=200_000)
    )  # fmt: skip
    traj, first, again = timed(run)
    return float(traj.q[-1]), int(traj.stats["num_steps"]), first, again


def diffrax_run(force, spring, start, end, rtol=RTOL, atol=1e-12, max_steps=200_000):
    """The same with diffrax alone."""
    field = lambda t, y, args: jnp.stack([y[1], -spring * y[0] + force(t, y[0], y[1])])

    @jax.jit
    def solve(y0):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Dopri8(), 0.0, end, None, y0, max_steps=max_steps, throw=False,
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=atol),
        )  # fmt: skip

    found, first, again = timed(lambda: jax.block_until_ready(solve(jnp.array(start))))
    ended = found.result == diffrax.RESULTS.successful
    return float(found.ys[-1, 0]) if ended else np.nan, int(found.stats["num_steps"]), first, again


def timed(run):
    """The result, the time of the first call, and the median of five more."""
    begin = time.perf_counter()
    found = run()
    first, times = time.perf_counter() - begin, []
    for _ in range(5):
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return found, first, float(np.median(times))


def servo():
    """Bang-bang control: a = -1 until q + v/2 = 0, then +1 until it is zero again, ..., at last q decays by e in 1/2.

    With the force bounded by one the motion slides where |4 q| < 1.
    """
    q, v, t, sign = 1.0, 0.0, 0.0, -1.0
    while True:
        line = lambda s, q=q, v=v, sign=sign: q + v * s + sign * s * s / 2 + 0.5 * (v + sign * s)
        begin = 1e-9 if t else 0.0
        grid = np.linspace(begin, 4.0, 4001)
        i = int(np.flatnonzero(np.sign(line(grid[1:])) != np.sign(line(grid[:-1])))[0])
        s = brentq(line, grid[i], grid[i + 1], xtol=1e-15)
        q, v, t = q + v * s + sign * s * s / 2, v + sign * s, t + s
        if abs(4 * q) < 1:
            return q * np.exp(-2 * (4.0 - t))
        sign = -sign


def reference(name, force, spring, start, end, closed):
    """The last position: a closed form, or by diffrax at 1e-13."""
    if closed is not None:
        return closed
    if name == "bang-bang control":
        return servo()
    by_diffrax, *_ = diffrax_run(force, spring, start, end, rtol=1e-13, atol=1e-15, max_steps=2_000_000)
    return by_diffrax


def main():
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--case", default="", help="only cases with these words in their names")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    print(f"{platform.machine()}, jax {jax.__version__}, lagjax {lj.__version__}, rtol {RTOL}")
    print(f"{'force':<22}{'':<10}{'error':>10}{'steps':>9}{'again':>11}{'first':>9}")
    # The first program of a process takes longer.
    lagjax_run(lambda t, q, v: -v, 1.0, (1.0, 0.0), 1.0, "found")
    fewer, bad, count = 0, [], 0
    for name, case in CASES.items():
        if asked.case not in name:
            continue
        right, rows = reference(name, *case), {}
        for how in ("found", "ignored"):
            rows[how] = lagjax_run(*case[:4], how)
        rows["diffrax"] = diffrax_run(*case[:4])
        size = max(abs(case[2][0]), abs(right))
        errors = {}
        for how, (value, steps, first, again) in rows.items():
            errors[how] = abs(value - right) / size if np.isfinite(value) else np.inf
            print(f"{name:<22}{how:<10}{errors[how]:>10.1e}{steps:>9}{1e3 * again:>8.2f} ms{first:>7.2f} s", flush=True)
        count += 1
        fewer += rows["found"][1] < rows["ignored"][1]
        if errors["found"] > LOOSE and errors["found"] > errors["ignored"]:
            bad.append(name)
    print(f"fewer steps in {fewer} of {count}; worse: {', '.join(bad) or 'none'}")
    sys.exit(bool(bad) or fewer < 0.8 * count)


if __name__ == "__main__":
    main()
