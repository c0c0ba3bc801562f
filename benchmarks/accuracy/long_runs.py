"""Long runs in equal steps: what is kept, and what a step costs.

Question: from how many turns on does a method that keeps energy and momenta win over one that adapts its steps, and
does a step of it cost what a loop by hand costs? The motions are an ellipse of Kepler's problem, where a state after
whole turns is the first one, and a bead on a rotating hoop, whose period is an integral. Compared are a loop of the
same splitting in numba, the default method, and SciPy's DOP853.

    python -m benchmarks.accuracy.long_runs --processor-time --json benchmarks/results/long_runs.json
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax as lj
from benchmarks import measure
from lagjax.numerics import sequence

TURN = 2 * np.pi
ECCENTRICITY = 0.6
START = np.array([1 - ECCENTRICITY, 0.0]), np.array([0.0, np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))])
kepler = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) + params / jnp.sqrt(jnp.sum(q**2)))
PENDULUMS = {"m": 1.0, "l": 1.0, "g": 9.81}
# The bead's g/R and ω², and where it is let go.
BEAD, RELEASE = {"g": 1.0, "w2": 0.5}, 1.0
PHASE = 1e-3


def lagrangian(t, q, v, p):
    """Two equal masses on two equal rods, by the angles of the rods."""
    kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return p["m"] * p["l"] ** 2 * kinetic + p["m"] * p["g"] * p["l"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


double_pendulum = lj.System(lagrangian)
bead = lj.System(lambda t, q, v, p: 0.5 * v**2 + 0.5 * p["w2"] * jnp.sin(q) ** 2 + p["g"] * jnp.cos(q))


def seconds(function):
    """The result, and the seconds of a call after a first one."""
    jax.block_until_ready(function())
    started = measure.CLOCK["seconds"]()
    found = jax.block_until_ready(function())
    return found, measure.CLOCK["seconds"]() - started


def orbit(method, steps, turns, outputs=11):
    """Turns of the ellipse, with so many steps in each."""
    ts = TURN * turns * np.linspace(0.0, 1.0, outputs)
    return lj.integrate(
        kepler, *START, 1.0, ts=ts, method=method, dt0=TURN / steps, estimate_error=False, throw=False
    )


def in_numba(steps, turns):
    """A loop of the splitting of order 4 by hand."""
    import numba

    kicks, drifts = sequence(4)

    @numba.njit(fastmath=False)
    def run(x, y, u, w, h, count):
        for _ in range(count):
            r3 = (x * x + y * y) ** 1.5
            u -= h * kicks[0] * x / r3
            w -= h * kicks[0] * y / r3
            for i in range(len(drifts)):
                x += h * drifts[i] * u
                y += h * drifts[i] * w
                r3 = (x * x + y * y) * np.sqrt(x * x + y * y)
                u -= h * kicks[i + 1] * x / r3
                w -= h * kicks[i + 1] * y / r3
        return x, y, u, w

    return lambda: run(START[0][0], START[0][1], START[1][0], START[1][1], TURN / steps, steps * turns)


def bead_period():
    """Twice the time from one turning point to the other, by Gauss-Legendre in the angle of a substitution."""
    x, w = np.polynomial.legendre.leggauss(200)
    s = np.pi / 2 * x
    q = RELEASE * np.sin(s)

    def energy(q):
        return -0.5 * BEAD["w2"] * np.sin(q) ** 2 - BEAD["g"] * np.cos(q)

    speed = np.sqrt(2 * (energy(RELEASE) - energy(q)))
    return float(2 * np.sum(np.pi / 2 * w * RELEASE * np.cos(s) / speed))


def bead_phase(traj, period):
    """How late the bead is at the last output, which is a quarter after whole turns, as a share of a radian."""
    exact = lj.integrate(bead, RELEASE, 0.0, BEAD, ts=[0.0, period / 4], rtol=1e-13, estimate_error=False)
    late = (traj.q[-1] - exact.q[-1]) / exact.v[-1]
    return abs(float(late)) * TURN / period


def bead_by(turns, period, **options):
    """The bead after so many turns and a quarter."""
    ts = np.array([0.0, (turns + 0.25) * period])
    return lj.integrate(bead, RELEASE, 0.0, BEAD, ts=ts, estimate_error=False, throw=False, max_steps=None, **options)


def fastest(turns, period, kind, ladder):
    """The least time with the phase wanted, of a ladder from rough to fine, and the options."""
    for options in ladder:
        # One call, after a short one that compiles the same program.
        jax.block_until_ready(bead_by(1, period, **options))
        started = measure.CLOCK["seconds"]()
        found = jax.block_until_ready(bead_by(turns, period, **options))
        time_taken = measure.CLOCK["seconds"]() - started
        error = bead_phase(found, period)
        if error < PHASE:
            return time_taken, f"{kind}: {error:.1e} rad, {int(found.stats['num_steps'])} steps"
    return np.inf, f"{kind}: never"


def rows(wanted):
    """All rows."""
    jax.config.update("jax_enable_x64", True)
    if wanted("a step of order 4 / numba"):
        steps, turns = 300, 1000
        times = measure.in_turn(lambda: orbit(lj.Splitting(4), steps, turns).q, in_numba(steps, turns), repeats=5)
        yield measure.row(
            "ellipse, a step of order 4 / numba", times.ratio(0, 1)[0], 1.2, nanoseconds=times.medians[0] / 3e5 * 1e9
        )
    if wanted("a step of Gauss(2) / accelerations"):
        start = np.array([1.0, 0.5]), np.zeros(2), PENDULUMS
        ts, count = np.array([0.0, 200.0]), 20_000
        gauss = partial(
            lj.integrate, double_pendulum, *start, ts=ts, method=lj.Gauss(2), dt0=0.01, estimate_error=False,
            throw=False,
        )  # fmt: skip
        loop = partial(lj.rollout, double_pendulum, *start, count, 0.01)
        times = measure.in_turn(lambda: gauss().q, lambda: loop()[1], repeats=5)
        yield measure.row("double pendulum, a step of Gauss(2) / accelerations", 4 * times.ratio(0, 1)[0], 4.0)
    for method, steps in ((lj.Splitting(8), 300), (lj.Gauss(8), 60), (lj.Gauss(3), 200)):
        what = f"ellipse, 100,000 turns by {method.label}: energy's error, round-offs"
        if wanted(what):
            traj, time_taken = seconds(partial(orbit, method, steps, 100_000, 101))
            h = np.asarray(traj.jacobi_integral())
            slope = np.polyfit(np.asarray(traj.t), h, 1)[0]
            walk = np.sqrt(float(traj.stats["num_steps"])) * np.finfo(float).eps * 0.5
            momentum = np.asarray(traj.q[:, 0] * traj.v[:, 1] - traj.q[:, 1] * traj.v[:, 0])
            yield measure.row(
                what, np.max(np.abs(h - h[0])) / walk, 10.0, seconds=time_taken, slope=float(slope),
                momentum=float(np.max(np.abs(momentum / momentum[0] - 1))),
                phase=float(np.linalg.norm(np.asarray(traj.q[-1]) - START[0]) / START[1][1] / 100_000),
            )  # fmt: skip
    period = bead_period()
    for turns in (100, 10_000, 1_000_000):
        what = f"bead, {turns} turns to 1e-3 rad: equal steps / lj.Nystrom12"
        if not wanted(what):
            continue
        halves = [2.0 ** (-k / 2) for k in range(14)]
        adapting, how = fastest(turns, period, "Nystrom12", [{"rtol": 10.0 ** (-k / 2)} for k in range(6, 28)])
        best = min(
            fastest(turns, period, m.label, [{"method": m, "dt0": period / 3 * half} for half in halves])
            for m in (lj.Splitting(6), lj.Splitting(8), lj.Gauss(4), lj.Gauss(6))
        )
        yield measure.row(what, best[0] / adapting, 1 / 3 if turns == 1_000_000 else None, ours=best[1], theirs=how,
                          seconds=best[0])  # fmt: skip
    if wanted("ellipse, 1,000 turns: Splitting(8) / DOP853"):
        ours, time_taken = seconds(partial(orbit, lj.Splitting(8), 150, 1000))
        reached = float(np.linalg.norm(np.asarray(ours.q[-1]) - START[0]))

        def field(t, y):
            r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
            return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])

        for rtol in (1e-8, 1e-9, 1e-10, 1e-11, 1e-12, 1e-13):
            started = measure.CLOCK["seconds"]()
            end = solve_ivp(field, (0, 1000 * TURN), np.concatenate(START), "DOP853", rtol=rtol, atol=rtol).y[:2, -1]
            theirs = measure.CLOCK["seconds"]() - started
            if np.linalg.norm(end - START[0]) < reached:
                break
        yield measure.row("ellipse, 1,000 turns: Splitting(8) / DOP853", time_taken / theirs, error=reached, rtol=rtol)


if __name__ == "__main__":
    measure.main(rows, __doc__)
