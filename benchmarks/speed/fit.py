"""What does a fit cost, against SciPy's least squares over `solve_ivp` with numerical derivatives?

A pendulum with friction, 100 samples of its angle with errors of 0.01: four unknowns (the length, the friction and the
state at the first sample) with guesses 10 to 60 % off. Both must end at the same optimum, which is checked ("apart" is
the largest difference in standard deviations). Compilation is timed in a separate process, where nothing has been
compiled before: the first call minus a later one.

    python -m benchmarks.speed.fit [--json FILE] [--only TEXT]
"""

import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

import lagjax as lj
from benchmarks.measure import ROOT, in_turn, main, row

jax.config.update("jax_enable_x64", True)

PARAMS = {"m": 1.0, "l": 1.25, "g": 9.81, "c": 0.05}
GUESS, START = PARAMS | {"l": 1.4, "c": 0.08}, (0.9, 0.1)
TS, SIGMA = np.linspace(0.0, 5.0, 100), 0.01
# SciPy's derivatives are differences: the residuals must be ten times as accurate as the difference steps.
TOLERANCE = 1e-9
LANES = 200


def lagrangian(t, q, v, params):
    """A pendulum in its angle."""
    return 0.5 * params["m"] * params["l"] ** 2 * v**2 + params["m"] * params["g"] * params["l"] * jnp.cos(q)


pendulum = lj.System(lagrangian, dissipation=lambda t, q, v, params: 0.5 * params["c"] * v**2)


def measured(seed=0):
    """Angles with errors."""
    clean = lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS).q
    return np.asarray(clean) + SIGMA * np.random.default_rng(seed).normal(size=TS.size)


def by_lagjax(data):
    """A `Fit`."""
    q0, v0 = START
    record = lj.Record(TS, q=data, q0=q0, v0=v0, sigma=SIGMA)
    return lj.fit(pendulum, record, GUESS, free=["c", "l"], rtol=TOLERANCE, atol=TOLERANCE)


def by_scipy(data):
    """Unknowns in the order c, l, q0, v0."""
    m, g = PARAMS["m"], PARAMS["g"]

    def residuals(x):
        c, l, q0, v0 = x
        field = lambda t, y: [y[1], -g / l * np.sin(y[0]) - c / (m * l**2) * y[1]]
        solved = solve_ivp(field, (TS[0], TS[-1]), [q0, v0], "DOP853", TS, rtol=TOLERANCE, atol=TOLERANCE)
        return (solved.y[0] - data) / SIGMA

    guess = [GUESS["c"], GUESS["l"], *START]
    return least_squares(residuals, guess, method="lm", x_scale=np.maximum(np.abs(guess), 0.1)).x


def first_and_second():
    """Seconds of the first and of the second fit in this process."""
    data = measured()
    seconds = []
    for _ in range(2):
        started = time.perf_counter()
        jax.block_until_ready(by_lagjax(data).values)
        seconds.append(time.perf_counter() - started)
    return seconds


def rows(wanted):
    """Yield the requested rows."""
    data = measured()
    if wanted("one fit"):
        found, theirs = by_lagjax(data), by_scipy(data)
        ours = np.array([*found.values, found.q0[0], found.v0[0]])
        sd = np.array([*found.sd, found.start_sd[0][0], found.start_sd[1][0]])
        apart = float(np.max(np.abs(ours - theirs) / sd))
        times = in_turn(lambda: by_lagjax(data).values, lambda: by_scipy(data), repeats=9)
        ratio, of_minima = times.ratio(1, 0)
        ms, scipy_ms = (1e3 * x for x in times.medians)
        yield row(
            "one fit: SciPy / lagjax", ratio, 10.0, "more", minima=of_minima, ms=ms, scipy_ms=scipy_ms, apart=apart
        )
        yield row("one fit: seconds after compiling", times.medians[0], 0.5)
    if wanted("compiling"):
        pairs = [
            subprocess.run([sys.executable, "-m", __spec__.name, "--first"], capture_output=True, text=True, cwd=ROOT)
            for _ in range(3)
        ]
        first, second = np.median([[float(x) for x in pair.stdout.split()] for pair in pairs], axis=0)
        yield row("compiling: seconds of a first fit less a second", first - second, 5.0)
    if wanted("many"):
        many = jnp.asarray(np.stack([measured(seed) for seed in range(LANES)]))
        together = jax.jit(jax.vmap(lambda data: by_lagjax(data).values))
        times = in_turn(lambda: together(many), repeats=5)
        yield row(f"many: fits a second, {LANES} in one program", LANES / times.medians[0])


if __name__ == "__main__":
    if "--first" in sys.argv:
        print(*first_and_second())
    else:
        main(rows, __doc__)
