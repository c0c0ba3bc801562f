"""How fast is lagjax compared with the tools that people use for the same work?

    bead       on a rotating hoop, 100 periods; error of angle and rate at the outputs against elliptic functions
    pendulum   in Cartesian coordinates on a rod, 20 s from the horizontal; with its multiplier; against the same
    crank      the slider-crank of `lagjax.mechanisms`, 7 coordinates and 6 constraints; against its reference
    chain      of 64 links in absolute angles, one right-hand side; against MuJoCo's accelerations

Every tool solves at the loosest tolerance of a ladder below which it stays within the required error; only the solve is
timed, after compilation and preparation. A tool that is not installed is skipped and named (`peers.py`).

    python -m benchmarks.speed.against_peers [--json FILE] [--only TEXT]
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from scipy import special

import lagjax as lj
from benchmarks.measure import in_turn, main, row, skipped
from benchmarks.speed import peers
from benchmarks.speed.against_hand_written import evaluations_in, from_lagrangian, loop
from lagjax.mechanisms import slider_crank
from lagjax.scenes import bead_on_hoop

jax.config.update("jax_enable_x64", True)

# Seconds per turn: a solve of one millisecond right after another tool's of twenty would measure cold caches.
TURN = 1e-2
# Quarters of a decade.
LADDER = tuple(10.0 ** (-k / 4) for k in range(16, 53))
BEAD_ERROR, PENDULUM_ERROR, IDAS_ERROR = 1e-7, 1e-7, 1e-6
PERIODS, PENDULUM_END, LINKS = 100, 20.0, 64


def loosest(prepare, error, allowed, ladder=LADDER):
    """The solve at the loosest tolerance below which the error stays within `allowed`, as (solve, tolerance, error).

    Two consecutive tolerances must satisfy this, because an error may be small by chance.
    """
    before = None
    for tolerance in ladder:
        solve = prepare(tolerance)
        found = error(solve())
        if found <= allowed and before is not None:
            return before
        before = (solve, tolerance, found) if found <= allowed else None
    raise ArithmeticError(f"no tolerance down to {ladder[-1]:.0e} reaches an error of {allowed:g}")


def beside(what, ours, theirs, target=None, repeats=15):
    """The row of the time of one solve over that of another, each (solve, tolerance, error)."""
    times = in_turn(ours[0], theirs[0], repeats=repeats, shortest=TURN)
    ratio, of_minima = times.ratio()
    return row(
        what, ratio, target, minima=of_minima, ms=1e3 * times.medians[0], other_ms=1e3 * times.medians[1],
        error=ours[2], other_error=theirs[2], tolerance=ours[1], other_tolerance=theirs[1],
    )  # fmt: skip


def by_lagjax(system, q0, v0, params, ts):
    """`prepare(tolerance)` for our default method, compiled once with the tolerance as an argument."""
    program = jax.jit(
        lambda tolerance, params: lj.integrate(
            system, q0, v0, params, ts=ts, rtol=tolerance, atol=tolerance, throw=False
        )
    )
    params = jax.tree.map(jnp.asarray, params)
    return lambda tolerance: lambda: program(jnp.asarray(tolerance), params)


def bead_rows(wanted):
    """The bead on the hoop, one trajectory."""
    params, start = bead_on_hoop.PARAMS, 1.0
    period = float(bead_on_hoop.exact_period(params, start))
    end, omega2, below = PERIODS * period, params["omega"] ** 2, params["g"] / params["a"]

    def error(state, t=end):
        psi, rate = bead_on_hoop.exact_motion(params, start, t)
        in_radians = [np.abs(state[0] - psi), np.abs(state[1] - rate) * period / (2 * np.pi)]
        return float(np.max(in_radians))

    def of_trajectory(trajectory):
        return error((trajectory.q, trajectory.v), trajectory.t)

    def python_field(t, y):
        return y[1], math.sin(y[0]) * (omega2 * math.cos(y[0]) - below)

    def jax_field(t, y, args):
        return y[1], jnp.sin(y[0]) * (omega2 * jnp.cos(y[0]) - below)

    def by_numba():
        return peers.numba_dopri8(lambda q, v: math.sin(q) * (omega2 * math.cos(q) - below), start, 0.0, end)

    def by_heyoka():
        return peers.heyoka_taylor(lambda q, v, hy: hy.sin(q) * (omega2 * hy.cos(q) - below), start, 0.0, end)

    halves = LADDER[::2]
    tools = {
        "numba Dopri8": (by_numba, 1.3, LADDER),
        "diffrax as shipped": (lambda: peers.diffrax_as_shipped(jax_field, (start, 0.0), end), 1 / 6, LADDER),
        "heyoka": (by_heyoka, None, LADDER),
        "SciPy DOP853": (lambda: peers.scipy_dop853(python_field, (start, 0.0), end), None, halves),
        "SciPy LSODA": (lambda: peers.scipy_lsoda(python_field, (start, 0.0), end), None, halves),
    }

    def with_outputs(count):
        return by_lagjax(bead_on_hoop.system, start, 0.0, params, np.linspace(0.0, end, count))

    ours = Once(lambda: loosest(with_outputs(2), of_trajectory, BEAD_ERROR))
    outputs = "bead: 100 outputs / without"
    if wanted(outputs):
        solve = with_outputs(PERIODS + 1)(ours.it[1])
        yield beside(outputs, (solve, ours.it[1], of_trajectory(solve())), ours.it, 1.3)
    for name, (build, target, ladder) in tools.items():
        if wanted(f"bead: lagjax / {name}"):
            yield against(f"bead: lagjax / {name}", ours, build, error, BEAD_ERROR, target, ladder)


class Once:
    """A value computed at first use."""

    def __init__(self, compute):
        self.compute = compute

    @property
    def it(self):
        """The value."""
        if self.compute is not None:
            self.value, self.compute = self.compute(), None
        return self.value


def against(what, ours, build, error, allowed, target, ladder=LADDER):
    """The row of our time over that of a tool, or the reason why there is none."""
    try:
        theirs = loosest(build(), error, allowed, ladder)
    except (ImportError, ArithmeticError) as reason:
        return skipped(what, str(reason))
    return beside(what, ours.it, theirs, target, repeats=5 if "SciPy" in what else 15)


def cartesian_lagrangian(t, q, v, params):
    """A unit mass in a vertical plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]


def rod(t, q, params):
    """The squared length."""
    return q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2


def angle_lagrangian(t, q, v, params):
    """The same in the angle from the bottom."""
    return 0.5 * (params["l"] * v) ** 2 + params["g"] * params["l"] * jnp.cos(q)


def pendulum_rows(wanted):
    """The Cartesian pendulum compared with the angle form and with IDAS."""
    params, l = {"g": 9.8125, "l": 1.25}, 1.25
    swing = math.sqrt(params["g"] / l)
    k = math.sqrt(0.5)
    sn, cn, dn, _ = special.ellipj(swing * PENDULUM_END, k**2)
    angle, rate = 2 * np.arcsin(k * cn / dn), -2 * k * math.sqrt(1 - k**2) * swing * sn / dn
    right = np.array([l * np.sin(angle), -l * np.cos(angle), l * rate * np.cos(angle), l * rate * np.sin(angle)])

    def error(state):
        return float(np.max(np.abs((np.asarray(state) - right) / [l, l, l * swing, l * swing])))

    def of_cartesian(trajectory):
        return error([x[-1] for x in (*trajectory.q.values(), *trajectory.v.values())])

    def of_angle(trajectory):
        q, v = float(trajectory.q[-1]), float(trajectory.v[-1])
        return error([l * np.sin(q), -l * np.cos(q), l * v * np.cos(q), l * v * np.sin(q)])

    ts = np.array([0.0, PENDULUM_END])
    rod_system = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod)})
    cartesian = by_lagjax(rod_system, {"x": l, "y": 0.0}, {"x": 0.0, "y": 0.0}, params, ts)
    by_angle = by_lagjax(lj.System(angle_lagrangian), 0.5 * np.pi, 0.0, params, ts)

    def by_idas():
        return peers.idas(
            np.ones(2), lambda q: params["g"] * q[1], lambda q: [q[0] ** 2 + q[1] ** 2 - l**2], [l, 0.0], [0.0, 0.0],
            PENDULUM_END,
        )  # fmt: skip

    what = "pendulum: Cartesian with multiplier / angle"
    if wanted(what):
        both = loosest(cartesian, of_cartesian, PENDULUM_ERROR), loosest(by_angle, of_angle, PENDULUM_ERROR)
        yield beside(what, *both, 5)
    what = "pendulum: lagjax / IDAS"
    if wanted(what):
        ours = Once(lambda: loosest(cartesian, of_cartesian, IDAS_ERROR))
        yield against(what, ours, by_idas, error, IDAS_ERROR, 0.1)


def crank_rows(wanted):
    """The slider-crank compared with IDAS."""
    what, mechanism = "slider-crank: lagjax / IDAS", slider_crank
    if not wanted(what):
        return
    p = mechanism.params
    flat = lambda parts: np.array([*parts.crank, *parts.rod, parts.block], float)
    right = [flat(x) for x in mechanism.reference]

    def error(state):
        q, v = np.split(np.asarray(state, float), 2)
        return max(float(np.max(np.abs(x - y)) / np.max(np.abs(y))) for x, y in zip((q, v), right))

    def of_trajectory(trajectory):
        return error(np.concatenate([flat(jax.tree.map(lambda x: x[-1], y)) for y in (trajectory.q, trajectory.v)]))

    def constraints(q):
        x1, y1, one, x2, y2, two, x3 = q
        c1, s1 = (0.5 * p["l1"] * f(one) for f in (peers.casadi.cos, peers.casadi.sin))
        c2, s2 = (0.5 * p["l2"] * f(two) for f in (peers.casadi.cos, peers.casadi.sin))
        return [x1 - c1, y1 - s1, x2 - c2 - x1 - c1, y2 - s2 - y1 - s1, x2 + c2 - x3, y2 + s2]

    def by_idas():
        masses = np.array([p["m1"], p["m1"], p["J1"], p["m2"], p["m2"], p["J2"], p["m3"]])
        potential = lambda q: p["g"] * (p["m1"] * q[1] + p["m2"] * q[4])
        return peers.idas(masses, potential, constraints, flat(mechanism.q0), flat(mechanism.v0), mechanism.end)

    program = by_lagjax(mechanism.system, mechanism.q0, mechanism.v0, p, np.array([0.0, mechanism.end]))
    ours = Once(lambda: loosest(program, of_trajectory, IDAS_ERROR))
    yield against(what, ours, by_idas, error, IDAS_ERROR, 1 / 6)


def chain_lagrangian(t, q, v, params):
    """Unit masses on unit rods, described by their angles from the vertical."""
    across, along = jnp.cumsum(jnp.cos(q) * v), jnp.cumsum(jnp.sin(q) * v)
    return 0.5 * jnp.sum(across**2 + along**2) + params["g"] * jnp.sum(jnp.cumsum(jnp.cos(q)))


def chain_rows(wanted):
    """One right-hand side of the chain compared with one step of MuJoCo."""
    what, params = f"chain, {LINKS} links: right-hand side / MuJoCo's step", {"g": 9.81}
    if not wanted(what):
        return
    try:
        chain = peers.MuJoCoChain(LINKS, params["g"])
    except ImportError as reason:
        yield skipped(what, str(reason))
        return
    random = np.random.default_rng(0)
    angles, rates = 0.3 * random.standard_normal(LINKS), 0.5 * random.standard_normal(LINKS)
    right_hand_side = from_lagrangian(lj.System(chain_lagrangian))
    state = jnp.asarray(angles), jnp.asarray(rates), jax.tree.map(jnp.asarray, params)
    ours = jax.jit(loop(right_hand_side))
    chain.set(angles, rates)
    right = chain.accelerations()
    error = np.max(np.abs(jax.jit(right_hand_side)(0.0, *state)[0] - right)) / np.max(np.abs(right))
    count = evaluations_in(lambda count: ours(count, *state))

    def by_mujoco():
        chain.set(angles, rates)
        chain.steps(count)

    times = in_turn(lambda: ours(count, *state), by_mujoco)
    ratio, of_minima = times.ratio()
    us, other = (1e6 * x / count for x in times.medians)
    yield row(what, ratio, 2, minima=of_minima, us=us, other_us=other, error=float(error))


def rows(wanted):
    """Bead, pendulum, crank, chain."""
    for of_problem in (bead_rows, pendulum_rows, crank_rows, chain_rows):
        yield from of_problem(wanted)


if __name__ == "__main__":
    main(rows, __doc__)
