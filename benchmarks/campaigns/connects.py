"""How much of what `lj.connect` and `lj.geodesic` claim is true, and how often is the least answer found?

Thirty problems whose answers are known: pendulums and double wells, by all start speeds; Kepler's problem, by Lambert's
equation with revolutions either way; spheroids and tori, by all start directions, with Clairaut's integral. Of every
answer that is returned, SciPy integrates the motion from its start velocity: its end, its action or length, and its
index, the number of zeros of the field that measures how neighbours part (Jacobi's). All that is claimed must hold,
and with `starts=8` the least answer of all that are known must be among what is found.

    python -m benchmarks.campaigns.connects [--starts N] [--only TEXT] [--json FILE]
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import lagjax as lj
from benchmarks.measure import machine, row, versions, written

jax.config.update("jax_enable_x64", True)

CLAIMS, FOUND = 1.0, 0.9
# SciPy's tolerances; an end may be off by this and by what the motion makes of an error of the start; an action,
# relative to its size or to a unit of it.
EXACT = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
OFF, GROWN, OF_ACTION = 1e-6, 1e-12, 1e-7
# Zeros of Jacobi's field this near to the end, in parts of the time, are conjugate ends.
CONJUGATE = 1e-3


class Problem(NamedTuple):
    """Two ends and the equations between them, in NumPy.

    - `found(starts)` -> the answers of lagjax. `rates(y)` -> ẏ of a state and its action, `jacobi(y)` -> the matrix of
      δ̈ = -J δ (numbers for one direction across); `b`: the end, with turns.
    - `least`: the least action (or length) of all that are known. `measure(answer)`: the same of an answer.
    """

    found: Callable
    rates: Callable
    jacobi: Callable
    a: np.ndarray
    b: np.ndarray
    time: float
    least: float
    measure: Callable
    place: Callable = lambda y: y


# -- One coordinate: L = ½ v² - V(q). --


class OneCoordinate(NamedTuple):
    """V and its first two derivatives."""

    potential: Callable
    slope: Callable
    bend: Callable
    system: Any
    fastest: float

    def rates(self, y):
        """(q, v, S) of many motions."""
        q, v = y[0], y[1]
        return np.stack([v, -self.slope(q), 0.5 * v**2 - self.potential(q)])

    def ends(self, a, speeds, time):
        """q and S at the end of the motions that start with these speeds."""
        count = len(speeds)
        start = np.stack([np.full(count, a), speeds, np.zeros(count)]).ravel()
        found = solve_ivp(lambda t, y: self.rates(y.reshape(3, count)).ravel(), (0, time), start, **EXACT)
        return found.y[:, -1].reshape(3, count)[[0, 2]]

    def least(self, a, b, time, edges):
        """The least action over all start speeds; `edges` are those of separatrices, near which motions crowd."""
        near = np.concatenate([[-1.0], -np.geomspace(1e-1, 1e-12, 200), np.geomspace(1e-12, 1e-1, 200)])
        speeds = np.concatenate([np.linspace(-self.fastest, self.fastest, 4000), *(edge + near for edge in edges)])
        speeds, actions = np.unique(speeds), []
        off = np.concatenate([self.ends(a, part, time)[0] - b for part in np.array_split(speeds, 20)])
        for i in np.flatnonzero(off[:-1] * off[1:] <= 0):
            low, high = speeds[i : i + 2]
            speed = brentq(lambda v: self.ends(a, np.array([v]), time)[0][0] - b, low, high, xtol=1e-15, rtol=1e-14)
            end, action = self.ends(a, np.array([speed]), time)
            # Between two motions that part for good there is a change of sign and no motion.
            if abs(end[0] - b) < 1e-3:
                actions.append(action[0])
        return min(actions)

    def problem(self, a, b, time, edges):
        """From a to b."""
        return Problem(
            lambda starts: lj.connect(self.system, a, b, 0.0, time, None, starts=starts, outputs=9),
            self.rates, lambda y: np.atleast_2d(self.bend(y[0])), np.array([a]), np.array([b]), time,
            self.least(a, b, time, edges), lambda answer: float(answer.action),
        )  # fmt: skip


PENDULUM = OneCoordinate(
    lambda q: -np.cos(q), np.sin, np.cos, lj.System(lambda t, q, v, p: 0.5 * v**2 + jnp.cos(q)), 5.0
)
WELLS = OneCoordinate(
    lambda q: 0.25 * q**4 - 0.5 * q**2, lambda q: q**3 - q, lambda q: 3 * q**2 - 1,
    lj.System(lambda t, q, v, p: 0.5 * v**2 + 0.5 * q**2 - 0.25 * q**4), 8.0,
)  # fmt: skip


def edges_at(model, a, tops):
    """The start speeds that end on a maximum of V."""
    left = [2 * (model.potential(top) - model.potential(a)) for top in tops]
    return [sign * np.sqrt(e) for e in left if e >= 0 for sign in (1, -1)]


# -- Kepler's problem. --


def lambert(a, b, time, sense):
    """The start velocities of all orbits from a to b in a time, one way round, by the universal variable z.

    Curtis, *Orbital Mechanics*, §5.3; z beyond (2π N)² makes N revolutions."""
    r_a, r_b = np.linalg.norm(a), np.linalg.norm(b)
    angle = sense * np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b) % (2 * np.pi)
    reach = np.sin(angle) * np.sqrt(r_a * r_b / (1 - np.cos(angle)))

    def stumpff(z):
        root = np.sqrt(abs(z))
        if abs(z) < 1e-6:
            return 0.5 - z / 24, 1 / 6 - z / 120
        if z > 0:
            return (1 - np.cos(root)) / z, (root - np.sin(root)) / root**3
        return (np.cosh(root) - 1) / -z, (np.sinh(root) - root) / root**3

    def y(z):
        c, s = stumpff(z)
        return r_a + r_b + reach * (z * s - 1) / np.sqrt(c) if c > 0 else -1.0

    def off(z):
        c, s = stumpff(z)
        return (y(z) / c) ** 1.5 * s + reach * np.sqrt(y(z)) - time if y(z) > 0 else -time

    found, revolutions = [], 0
    while revolutions == 0 or 2 * np.pi * revolutions * (0.1 * min(r_a, r_b)) ** 1.5 < time and revolutions < 8:
        low, high = (2 * np.pi * revolutions) ** 2, (2 * np.pi * (revolutions + 1)) ** 2
        low = -60.0 if not revolutions else low + 1e-6
        zs = np.linspace(low, high - 1e-6, 4000) + 1e-7
        values = np.array([off(z) for z in zs])
        for i in np.flatnonzero(values[:-1] * values[1:] < 0):
            z = brentq(off, zs[i], zs[i + 1], xtol=1e-14, rtol=1e-14)
            if y(z) > 0:
                found.append((b - (1 - y(z) / r_a) * a) / (reach * np.sqrt(y(z))))
        revolutions += 1
    return found


def kepler_rates(y):
    """(x, y, vx, vy, S)."""
    r = np.linalg.norm(y[:2])
    return np.concatenate([y[2:4], -y[:2] / r**3, [0.5 * (y[2] ** 2 + y[3] ** 2) + 1 / r]])


def kepler_jacobi(y):
    """-∂a/∂q."""
    r = np.linalg.norm(y[:2])
    return np.eye(2) / r**3 - 3 * np.outer(y[:2], y[:2]) / r**5


ORBIT = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) + 1 / jnp.sqrt(jnp.sum(q**2)))


def kepler(b, time):
    """From (1, 0) to b."""
    a, b = np.array([1.0, 0.0]), np.array(b)
    actions = []
    for sense in (1, -1):
        for v in lambert(a, b, time, sense):
            end = solve_ivp(lambda t, y: kepler_rates(y), (0, time), [*a, *v, 0.0], **EXACT).y[:, -1]
            if np.max(np.abs(end[:2] - b)) < 1e-6:
                actions.append(end[4])
    return Problem(
        lambda starts: lj.connect(ORBIT, a, b, 0.0, time, None, starts=starts, outputs=9),
        kepler_rates, kepler_jacobi, a, b, time, min(actions), lambda answer: float(answer.action),
    )  # fmt: skip


# -- Surfaces of revolution: ds² = E(v) du² + G(v) dv². --


class Surface(NamedTuple):
    """E and G with their derivatives, and Gauss's curvature."""

    e: Callable
    de: Callable
    g: Callable
    dg: Callable
    curvature: Callable

    def rates(self, y):
        """(u, v, u', v', S) along a geodesic, S the energy."""
        u, v, du, dv = y[:4]
        ddu = -self.de(v) / self.e(v) * dv * du
        ddv = (0.5 * self.de(v) * du**2 - 0.5 * self.dg(v) * dv**2) / self.g(v)
        return np.stack([du, dv, ddu, ddv, 0.5 * (self.e(v) * du**2 + self.g(v) * dv**2)])

    def start(self, v, azimuths):
        """Unit velocities; azimuth zero is along v."""
        return np.sin(azimuths) / np.sqrt(self.e(v)), np.cos(azimuths) / np.sqrt(self.g(v))

    def least(self, a, b, longest, turns_of_v=False):
        """The least length of all geodesics from a to b, either way round, by the azimuths at which they arrive."""
        azimuths = np.linspace(1e-4, np.pi - 1e-4, 3000)
        lengths = []
        for turns in (0, -1, 1):
            to = b[0] - a[0] + 2 * np.pi * turns
            sides = azimuths if to > 0 else -azimuths
            count = len(sides)
            du, dv = self.start(a[1], sides)
            start = np.stack([np.zeros(count), np.full(count, a[1]), du, dv, np.zeros(count)])
            many = solve_ivp(
                lambda s, y, n=count: self.rates(y.reshape(5, n)).ravel(), (0, longest), start.ravel(), method="DOP853",
                rtol=1e-9, atol=1e-9, dense_output=False, t_eval=np.linspace(0, longest, 600),
            )  # fmt: skip
            y = many.y.reshape(5, count, -1)
            beyond = np.abs(y[0]) >= abs(to)
            reached, at = beyond.any(axis=1), np.argmax(beyond, axis=1)
            lane, before = np.arange(count), np.maximum(at - 1, 0)
            (u_0, u_1), (v_0, v_1) = ((y[k, lane, before], y[k, lane, at]) for k in (0, 1))
            part = (to - u_0) / np.where(u_1 == u_0, 1.0, u_1 - u_0)
            off = np.where(reached, v_0 + part * (v_1 - v_0) - b[1], np.nan)

            def arrival(azimuth, to=to):
                event = lambda s, y: y[0] - to  # noqa: E731
                event.terminal = True
                du, dv = self.start(a[1], azimuth)
                found = solve_ivp(
                    lambda s, y: self.rates(y), (0, 1.1 * longest), [0.0, a[1], du, dv, 0.0], events=event, **EXACT
                )
                return (found.y_events[0][0][1], found.t_events[0][0]) if len(found.t_events[0]) else (np.nan, np.nan)

            shifts = (-2 * np.pi, 0.0, 2 * np.pi) if turns_of_v else (0.0,)
            for shift in shifts:
                value = off - shift
                for i in np.flatnonzero(value[:-1] * value[1:] <= 0):
                    # The lanes are interpolated: the root may be in a cell beside.
                    wanted = b[1] + shift
                    cells = [(sides[max(j, 0)], sides[min(j + 1, count - 1)]) for j in (i, i - 1, i + 1)]
                    low, high = next(
                        (c for c in cells if (arrival(c[0])[0] - wanted) * (arrival(c[1])[0] - wanted) <= 0),
                        (None, None),
                    )
                    if low is None:
                        continue
                    azimuth = brentq(lambda x: arrival(x)[0] - wanted, low, high, xtol=1e-13, rtol=1e-13)
                    lengths.append(arrival(azimuth)[1])
        return min(lengths)


def torus(large, small):
    """u round the axis, v round the tube."""
    around = lambda v: large + small * np.cos(v)  # noqa: E731
    return Surface(
        lambda v: around(v) ** 2, lambda v: -2 * around(v) * small * np.sin(v),
        lambda v: small**2 + 0 * v, lambda v: 0 * v, lambda v: np.cos(v) / (small * around(v)),
    )  # fmt: skip


def spheroid(a, b):
    """u is the longitude, v the parametric latitude."""
    return Surface(
        lambda v: a**2 * np.cos(v) ** 2, lambda v: -2 * a**2 * np.cos(v) * np.sin(v),
        lambda v: a**2 * np.sin(v) ** 2 + b**2 * np.cos(v) ** 2, lambda v: 2 * (a**2 - b**2) * np.sin(v) * np.cos(v),
        lambda v: b**2 / (a**2 * np.sin(v) ** 2 + b**2 * np.cos(v) ** 2) ** 2,
    )  # fmt: skip


def ring(q, v, p):
    """The line element of a torus."""
    return (p["R"] + p["r"] * jnp.cos(q["v"])) ** 2 * v["u"] ** 2 + p["r"] ** 2 * v["v"] ** 2


SKIN = lj.System(
    lambda t, q, v, p: 0.5 * jnp.sum(v**2),
    {"skin": lj.Holonomic(lambda t, q, p: (q[0] ** 2 + q[1] ** 2) / p["a"] ** 2 + q[2] ** 2 / p["b"] ** 2 - 1)},
)


def on_torus(large, small, b):
    """From the outer equator."""
    surface, a, b = torus(large, small), np.zeros(2), np.array(b)
    ends = ({"u": 0.0, "v": 0.0}, {"u": b[0], "v": b[1]})
    params = {"R": large, "r": small}
    return Problem(
        lambda starts: lj.geodesic(ring, *ends, params, angles=("u", "v"), starts=starts, outputs=9),
        surface.rates, lambda y: np.atleast_2d(surface.curvature(y[1])), a, b, 1.0,
        surface.least(a, b, 2 * np.pi * (large + small), True), lambda answer: float(answer.length),
    )  # fmt: skip


def on_spheroid(a, b, start, end):
    """From one (longitude, parametric latitude) to another, in space."""
    surface, start, end = spheroid(a, b), np.array(start), np.array(end)

    def place(x):
        u, v = x[0], x[1]
        return np.array([a * np.cos(v) * np.cos(u), a * np.cos(v) * np.sin(u), b * np.sin(v)])

    def rates(y):
        x, v = y[:3], y[3:6]
        weights = np.array([1 / a**2, 1 / a**2, 1 / b**2])
        normal = weights * x
        return np.concatenate([v, -normal * (weights @ v**2) / (normal @ normal), [0.5 * v @ v]])

    def curvature(y):
        x = y[:3]
        return np.atleast_2d(1 / (a**4 * b**2 * ((x[0] ** 2 + x[1] ** 2) / a**4 + x[2] ** 2 / b**4) ** 2))

    params = {"a": a, "b": b}
    return Problem(
        lambda starts: lj.geodesic(SKIN, place(start), place(end), params, starts=starts, outputs=9),
        rates, curvature, place(start), place(end), 1.0, surface.least(start, end, 4 * max(a, b)),
        lambda answer: float(answer.length),
    )  # fmt: skip


# The problems, by name; each is made when its turn comes.
PROBLEMS: dict[str, Callable[[], Problem]] = {}
for _a, _b, _time in (
    (0.0, 1.0, 2.0), (0.0, 0.0, 9.0), (0.0, 0.0, 20.0), (0.5, -1.2, 8.0), (0.0, np.pi, 6.0), (-1.0, 7.0, 7.0),
    (0.3, 0.3 + 2 * np.pi, 12.0),
):  # fmt: skip
    PROBLEMS[f"pendulum from {_a:.4g} to {_b:.4g} in {_time:g}"] = lambda a=_a, b=_b, time=_time: PENDULUM.problem(
        a, b, time, edges_at(PENDULUM, a, [np.pi])
    )
for _a, _b, _time in ((-1.0, 1.0, 3.0), (-1.0, 1.0, 8.0), (0.0, 0.0, 9.0), (1.0, 1.0, 8.0), (0.5, 2.0, 5.0)):
    PROBLEMS[f"wells from {_a:g} to {_b:g} in {_time:g}"] = lambda a=_a, b=_b, time=_time: WELLS.problem(
        a, b, time, edges_at(WELLS, a, [0.0])
    )
for _b, _time in (
    ((0.0, 1.2), 1.5), ((-1.1, 0.3), 4.0), ((-0.5, -0.9), 3.0), ((0.2, 1.5), 12.0), ((1.3, 0.2), 7.0),
    ((-2.0, 1.0), 9.0),
):  # fmt: skip
    PROBLEMS[f"Kepler to {_b} in {_time:g}"] = lambda b=_b, time=_time: kepler(b, time)
for _axes, _start, _end in (
    ((1.0, 1 - 1 / 298.257223563), (0.0, 0.0), (np.radians(179.5), np.radians(0.5))),
    ((6378.137, 6378.137 * (1 - 1 / 298.257223563)), (0.0, 0.4), (2.2, -0.7)),
    ((1.0, 0.9), (0.0, 0.1), (3.0, -0.05)), ((1.0, 0.5), (0.0, 0.3), (2.9, -0.25)),
    ((1.0, 0.5), (0.0, 0.0), (2.0, 0.6)),
    ((1.0, 1.5), (0.0, 0.2), (2.8, -0.4)), ((1.0, 2.0), (0.0, -0.6), (3.0, 0.7)),
):  # fmt: skip
    PROBLEMS[f"spheroid {_axes[0]:g}, {_axes[1]:.5g} to {_end[0]:.4g}, {_end[1]:.4g}"] = (
        lambda axes=_axes, start=_start, end=_end: on_spheroid(*axes, start, end)
    )
for _radii, _b in (
    ((2.0, 0.7), (1.3, 0.4)), ((2.0, 0.7), (2.5, 0.0)), ((2.0, 1.0), (3.0, 2.5)), ((3.0, 0.5), (2.8, 3.0)),
    ((1.5, 1.2), (2.9, 0.2)),
):  # fmt: skip
    PROBLEMS[f"torus {_radii[0]:g}, {_radii[1]:g} to {_b[0]:g}, {_b[1]:g}"] = lambda radii=_radii, b=_b: on_torus(
        *radii, b
    )


# -- What is claimed, against SciPy. --


def wrong(problem: Problem, answer) -> list[str]:
    """What of an answer's claims does not hold, in words."""
    connection = getattr(answer, "connection", answer)
    value, said = problem.measure(answer), []
    if connection.kind == "not found":
        numbers = [value, *np.ravel(jax.tree.leaves(connection.start_velocity))]
        return [] if np.all(np.isnan(numbers)) else ["not found, and has numbers"]
    v = np.concatenate([np.ravel(x) for x in jax.tree.leaves(connection.start_velocity)]).astype(float)
    asked = np.concatenate([np.ravel(np.asarray(x)[-1]) for x in jax.tree.leaves(connection.q)])
    turns = (asked - problem.b) / (2 * np.pi)
    size = max(float(np.max(np.abs(problem.b - problem.a))), float(np.max(np.abs(problem.a))), 1.0)
    if not np.allclose(asked, problem.b, atol=OFF * size) and np.any(np.abs(turns - np.round(turns)) > OFF):
        said.append("its path ends elsewhere")
    if not bool(connection.converged):
        return said
    n = len(v)
    end, action, index, grown, near = followed(problem, v)
    own = np.concatenate([np.ravel(np.asarray(x)[-1]) for x in jax.tree.leaves(connection.trajectory.q)])
    allowed = OFF + GROWN * grown
    if np.max(np.abs(own - asked)) > OFF * size:
        said.append(f"its trajectory ends {np.max(np.abs(own - asked)):.1e} off")
    if np.max(np.abs(end[:n] - asked)) > allowed * size:
        said.append(f"by SciPy it ends {np.max(np.abs(end[:n] - asked)):.1e} off")
    exact = np.sqrt(2 * action) if hasattr(answer, "length") else action
    if not abs(value - exact) <= (OF_ACTION + GROWN * grown) * max(1.0, abs(exact)):
        said.append(f"{value:.9g} is claimed, and by SciPy it is {exact:.9g}")
    kinds = {"minimum" if i == 0 else f"saddle of index {i}" for i in {index, index + near, index - near}}
    if connection.kind not in kinds | {"degenerate: ends are conjugate"} and not connection.kind.startswith("not res"):
        said.append(f"{connection.kind} is claimed, and the index is {index}")
    if connection.kind.startswith("degenerate") and not near:
        said.append("conjugate ends are claimed")
    return said


def followed(problem: Problem, v: np.ndarray):
    """By SciPy from a start velocity: the end with the action, the index, the growth of errors, and whether the ends
    are conjugate, or nearly."""
    n = len(v)
    start = np.concatenate([problem.a, v])
    # On surfaces the field is one number across the path, and its matrix is curvature times speed².
    across = problem.jacobi(np.append(start, 0.0)).shape[0]
    size = 2 * n + 1

    def rates(t, y):
        state, field, slope = y[:size], y[size : size + across**2], y[size + across**2 :]
        known = problem.rates(state)
        matrix = problem.jacobi(state)
        if across < n or n == 2 and across == 1:
            matrix = matrix * 2 * known[-1]
        return np.concatenate([known, slope, -(matrix @ field.reshape(across, across)).ravel()])

    y0 = np.concatenate([start, [0.0], np.zeros(across**2), np.eye(across).ravel()])
    ts = np.linspace(0, problem.time, 4001)
    y = solve_ivp(rates, (0, problem.time), y0, t_eval=ts, **EXACT).y
    fields = y[size : size + across**2].T.reshape(-1, across, across)
    values = np.linalg.det(fields)
    # Round-off at the start, where the field vanishes.
    signs = np.sign(values[5:])
    last = int(len(signs) * (1 - CONJUGATE))
    index, near = int(np.sum(signs[:-1] * signs[1:] < 0)), int(np.any(signs[last:-1] * signs[last + 1 :] < 0))
    smallest = np.linalg.svd(fields[-1], compute_uv=False)[-1] / problem.time
    return y[: 2 * n, -1], y[2 * n, -1], index, float(np.max(np.abs(fields[-1]))), near or smallest < CONJUGATE


def main():
    """Print a row for each problem, and the shares over all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=8)
    parser.add_argument("--only", metavar="TEXT", default="", help="only problems whose name contains it")
    parser.add_argument("--json", metavar="FILE", help="also write the rows there")
    options = parser.parse_args()
    print(f"{machine()}; " + ", ".join(f"{name} {version}" for name, version in versions().items()))
    lines, true, least = [], [], []
    for name, make in PROBLEMS.items():
        if options.only.lower() not in name.lower():
            continue
        problem, started = make(), time.perf_counter()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", lj.ConnectWarning)
            found = problem.found(options.starts)
        seconds = time.perf_counter() - started
        answers = [found, *found.others]
        said = [words for answer in answers for words in wrong(problem, answer)]
        known = [problem.measure(answer) for answer in answers if getattr(answer, "connection", answer).converged]
        best = min(known, default=np.inf)
        true.append(not said)
        least.append(best <= problem.least + 1e-7 * max(1.0, abs(problem.least)))
        more = {"answers": len(answers), "least": best, "known": problem.least, "seconds": seconds}
        lines.append(row(name, len(said), 0, **more, **({"said": "; ".join(said)} if said else {})))
        if not least[-1]:
            lines[-1]["least"] = f"{best:.9g} MISSED"
        print(written(lines[-1]), flush=True)
    lines += [
        row("problems in which all that is claimed holds", np.mean(true), CLAIMS, "more", of=len(true)),
        row(f"least answer found with starts={options.starts}", np.mean(least), FOUND, "more", of=len(least)),
    ]
    print(*map(written, lines[-2:]), sep="\n")
    if options.json:
        result = {"machine": machine(), "versions": versions(), "rows": lines}
        Path(options.json).write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
