"""Motions between two points: how long `lj.connect` takes beside SciPy's `solve_bvp`, and how near both come.

A double pendulum goes from one pair of angles to another in a second. `solve_bvp` is given the accelerations, compiled
by JAX for all its nodes at once, and the same straight start, at a tolerance of 1e-9: how near both come to the end is
measured by integrating from their start velocities. A thousand pairs of points on a
torus are one call of a compiled program; its first call includes compiling.

Source: Kierzenka & Shampine, *ACM Trans. Math. Softw.* 27 (2001) 299 (solve_bvp); Dormand & Prince (the integration).

    python -m benchmarks.accuracy.two_points [--json FILE] [--only TEXT] [--processor-time]
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_bvp

import lagjax as lj
from benchmarks.measure import CLOCK, in_turn, main, row

G, TIME = 9.81, 1.0
A, B = np.array([0.5, 0.2]), np.array([-1.0, 1.0])


def double_pendulum(t, q, v, params):
    """Two equal rods, masses at their ends."""
    kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


system = lj.System(double_pendulum)


def by_scipy(tolerance):
    """The start velocity of SciPy's collocation."""

    @jax.jit
    @jax.vmap
    def accelerations(q, v):
        return lj.accelerations(system, 0.0, q, v, {"g": G})[0]

    def rates(t, y):
        padded = np.zeros((4, 4096))
        padded[:, : y.shape[1]] = y
        a = np.asarray(accelerations(padded[:2].T, padded[2:].T)).T
        return np.vstack([y[2:], a[:, : y.shape[1]]])

    def ends(a, b):
        return np.concatenate([a[:2] - A, b[:2] - B])

    t = np.linspace(0.0, TIME, 17)
    straight = A[:, None] + (B - A)[:, None] * t / TIME
    start = np.vstack([straight, np.repeat((B - A)[:, None] / TIME, len(t), axis=1)])

    def solve():
        return solve_bvp(rates, ends, t, start, tol=tolerance, max_nodes=4096)

    return solve


def missed(v):
    """How far from the end a motion with this start velocity ends."""
    end = lj.integrate(system, A, np.asarray(v), {"g": G}, ts=np.array([0.0, TIME]), rtol=1e-13, atol=1e-13)
    return float(np.max(np.abs(np.asarray(end.q[-1]) - B)))


def pendulum():
    """First and next answer, and the time beside SciPy's at an error of at most the same."""

    def connected(g=G):
        return lj.connect(system, A, B, 0.0, TIME, {"g": g}, outputs=2)

    clock = CLOCK["seconds"]
    started = clock()
    found = connected()
    yield row("double pendulum: connect, first answer, s", clock() - started, 3.0)
    error = missed(found.start_velocity)
    yield row("double pendulum: connect misses the end by", error, 1e-10)
    solve = by_scipy(1e-9)
    yield row("double pendulum: solve_bvp, tolerance 1e-9, misses the end by", missed(solve().sol(0.0)[2:]))
    times = in_turn(lambda: connected().start_velocity, lambda: solve().y, repeats=7)
    yield row("double pendulum: connect, next answer, s", times.medians[0], 5e-3)
    yield row("double pendulum: connect / solve_bvp, tolerance 1e-9", times.ratio()[0], 1 / 3)


def torus():
    """A thousand pairs of points, with compilation."""

    def metric(q, v, params):
        return (params["R"] + params["r"] * jnp.cos(q[1])) ** 2 * v[0] ** 2 + params["r"] ** 2 * v[1] ** 2

    def length(b):
        found = lj.geodesic(metric, jnp.zeros(2), b, {"R": 2.0, "r": 0.7}, outputs=2)
        return found.length, found.connection.converged

    ends = np.random.default_rng(1).uniform([-2.0, -1.5], [2.0, 1.5], (1000, 2))
    clock = CLOCK["seconds"]
    started = clock()
    many = jax.jit(jax.vmap(length))
    _, converged = jax.block_until_ready(many(ends))
    yield row("torus: 1,000 pairs, first answer, s", clock() - started, 10.0, found=int(np.sum(converged)))
    started = clock()
    jax.block_until_ready(many(ends))
    yield row("torus: 1,000 pairs, next answer, s", clock() - started)


def rows(wanted):
    """All rows that are wanted."""
    jax.config.update("jax_enable_x64", True)
    if wanted("double pendulum"):
        yield from pendulum()
    if wanted("torus"):
        yield from torus()


if __name__ == "__main__":
    main(rows, __doc__)
