"""Long runs in equal steps: what is kept, how the phase runs away, and what a step costs.

Question: over a million periods, are energy and momenta kept to what round-off allows (Brouwer's law: errors as the
square root of the number of steps), from how many periods on does a method that keeps them win over one that adapts its
steps, and does a step cost what a loop by hand costs? The motions:

- an ellipse of Kepler's problem, e = 0.6, where the state after whole turns is the first one;
- a bead on a rotating hoop, whose period is an integral;
- the outer Solar System over a million years, from Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §I.2.4
  (initial values of 5 September 1994, after Ahnerts Kalender für Sternfreunde, 1994);
- a stiff spring pendulum, a pendulum on a rod, the double pendulum.

Compared are a loop of the same splitting in numba, lagjax's adaptive methods, SciPy's DOP853, heyoka, and REBOUND, each
where it is installed. Published of REBOUND: IAS15 follows Brouwer's law over 1e9 orbits (Rein & Spiegel, MNRAS 446
(2015) 1424, abstract), WHFast does for small steps (Rein & Tamayo, MNRAS 452 (2015) 376, abstract).

    python -m benchmarks.accuracy.long_runs --processor-time --json benchmarks/results/long_runs.json \\
        --plot docs/long_runs.png
"""

import importlib.util
from functools import partial
from itertools import count as counted

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import lagjax as lj
from benchmarks import measure
from lagjax.display import plots
from lagjax.numerics import sequence

EPS, TURN, PHASE = float(np.finfo(float).eps), 2 * np.pi, 1e-3
ECCENTRICITY = 0.6
START = np.array([1 - ECCENTRICITY, 0.0]), np.array([0.0, np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))])
PENDULUMS = {"m": 1.0, "l": 1.0, "g": 9.81}
# The bead's g/R and ω², and where it is let go.
BEAD, RELEASE = {"g": 1.0, "w2": 0.5}, 1.0
# Sun with the inner planets, Jupiter, Saturn, Uranus, Neptune, Pluto: masses in that of the sun, astronomical units,
# days.
GRAVITY, YEAR = 2.95912208286e-4, 365.25
MASSES = np.array([1.00000597682, 0.000954786104043, 0.000285583733151, 0.0000437273164546, 0.0000517759138449,
                   1 / 1.3e8])  # fmt: skip
PLACES = np.array([
    [0.0, 0.0, 0.0], [-3.5023653, -3.8169847, -1.5507963], [9.0755314, -3.0458353, -1.6483708],
    [8.3101420, -16.2901086, -7.2521278], [11.4707666, -25.7294829, -10.8169456], [-15.5387357, -25.2225594, -3.1902382],
])  # fmt: skip
SPEEDS = np.array([
    [0.0, 0.0, 0.0], [0.00565429, -0.00412490, -0.00190589], [0.00168318, 0.00483525, 0.00192462],
    [0.00354178, 0.00137102, 0.00055029], [0.00288930, 0.00114527, 0.00039677], [0.00276725, -0.00170702, -0.00136504],
])  # fmt: skip


def lagrangian(t, q, v, p):
    """Two equal masses on two equal rods, by the angles of the rods."""
    kinetic = v[0] ** 2 + 0.5 * v[1] ** 2 + v[0] * v[1] * jnp.cos(q[0] - q[1])
    return p["m"] * p["l"] ** 2 * kinetic + p["m"] * p["g"] * p["l"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


def attraction(t, q, v, masses):
    """Bodies that attract each other."""
    apart = jnp.sum((q[:, None] - q[None]) ** 2, axis=2)
    pairs = masses[:, None] * masses[None] * (1 - np.eye(len(MASSES)))
    return 0.5 * jnp.sum(masses[:, None] * v**2) + 0.5 * GRAVITY * jnp.sum(pairs / jnp.sqrt(apart + np.eye(len(MASSES))))


def spring_pendulum(t, q, v, stiffness):
    """A unit mass on a spring of unit length."""
    return 0.5 * jnp.sum(v**2) - 9.81 * q[1] - 0.5 * stiffness * (jnp.sqrt(q @ q) - 1) ** 2


kepler = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) + params / jnp.sqrt(jnp.sum(q**2)))
bead = lj.System(lambda t, q, v, p: 0.5 * v**2 + 0.5 * p["w2"] * jnp.sin(q) ** 2 + p["g"] * jnp.cos(q))
double_pendulum, planets, spring = lj.System(lagrangian), lj.System(attraction), lj.System(spring_pendulum)
rod = lj.System(
    lambda t, q, v, g: 0.5 * jnp.sum(v**2) - g * q[1],
    constraints={"rod": lj.Holonomic(lambda t, q, g: jnp.sum(q**2) - 1.0)},
)


def seconds(function):
    """The result, and the seconds of a call; the program must have been compiled."""
    started = measure.CLOCK["seconds"]()
    found = jax.block_until_ready(function())
    return found, measure.CLOCK["seconds"]() - started


def motion(system, start, ts, **options):
    """A motion without estimates of its errors."""
    return lj.integrate(system, *start, ts=np.asarray(ts), estimate_error=False, throw=False, max_steps=None, **options)


def of_energy(traj):
    """The largest change of the Jacobi integral in round-offs of it times √steps (Brouwer's law), and its slope, with
    that of a random walk of the same size beside it."""
    h, t = np.asarray(traj.jacobi_integral()), np.asarray(traj.t)
    walk = np.sqrt(float(traj.stats["num_steps"])) * EPS * abs(h[0])
    slope = np.polyfit(t, h, 1)[0]
    # The standard deviation of the slope of a line through a random walk that ends at its own standard deviation.
    size = np.std(np.diff(h)) * np.sqrt(len(h) - 1)
    return np.max(np.abs(h - h[0])) / walk, {
        "relative": float(np.max(np.abs(h / h[0] - 1))), "slope": float(slope),
        "slope_of_a_walk": float(1.1 * size / (t[-1] - t[0])), "steps": int(traj.stats["num_steps"]),
    }  # fmt: skip


def orbit(method, steps, turns, outputs=11, **options):
    """Turns of the ellipse, with so many steps in each."""
    ts = TURN * turns * np.linspace(0.0, 1.0, outputs)
    return motion(kepler, (*START, 1.0), ts, method=method, dt0=TURN / steps, **options)


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


def costs(wanted):
    """What a step costs."""
    if wanted("a step of order 4 / numba"):
        if importlib.util.find_spec("numba") is None:
            yield measure.skipped("ellipse, a step of order 4 / numba", "numba is not installed")
        else:
            steps, turns = 300, 1000
            times = measure.in_turn(lambda: orbit(lj.Splitting(4), steps, turns).q, in_numba(steps, turns), repeats=5)
            yield measure.row(
                "ellipse, a step of order 4 / numba", times.ratio()[0], 1.2, nanoseconds=times.medians[0] / 3e5 * 1e9
            )
    if wanted("a step of Gauss(2) / accelerations"):
        start = np.array([1.0, 0.5]), np.zeros(2), PENDULUMS
        gauss = partial(motion, double_pendulum, start, [0.0, 200.0], method=lj.Gauss(2), dt0=0.01)
        loop = partial(lj.rollout, double_pendulum, *start, 20_000, 0.01)
        times = measure.in_turn(lambda: gauss().q, lambda: loop()[1], repeats=5)
        # RK4's step has four accelerations.
        yield measure.row("double pendulum, a step of Gauss(2) / accelerations", 4 * times.ratio()[0], 4.0)


def ellipses(wanted):
    """Energy, angular momentum and phase after up to a million turns."""
    for method, steps, turns in (
        (lj.Splitting(8), 300, 100_000), (lj.Gauss(3), 200, 100_000), (lj.Gauss(8), 60, 100_000),
        (lj.Gauss(8), 60, 1_000_000),
    ):  # fmt: skip
        what = f"ellipse, {turns} turns by {method.label}: energy's error / sqrt(steps) round-offs"
        if not wanted(what):
            continue
        jax.block_until_ready(orbit(method, steps, 1, 101))
        traj, taken = seconds(partial(orbit, method, steps, turns, 101))
        error, more = of_energy(traj)
        momentum = np.asarray(traj.q[:, 0] * traj.v[:, 1] - traj.q[:, 1] * traj.v[:, 0])
        # At the pericentre the way off the first place is the speed times the time.
        late = np.linalg.norm(np.asarray(traj.q) - START[0], axis=1) / START[1][1]
        yield measure.row(
            what, error, 10.0, **more, seconds=taken, momentum=float(np.max(np.abs(momentum / momentum[0] - 1))),
            phase=float(late[-1]), phase_at_a_tenth=float(late[len(late) // 10]),
        )  # fmt: skip
    what = "ellipse, 100000 turns by Gauss(8), begun anew each 1000: energy's error / sqrt(steps) round-offs"
    if wanted(what):
        state, energies = START, []
        for _ in range(100):
            part = orbit(lj.Gauss(8), 60, 1000) if not energies else motion(
                kepler, (*state, 1.0), TURN * 1000 * np.linspace(0.0, 1.0, 11), method=lj.Gauss(8), dt0=TURN / 60
            )  # fmt: skip
            state = part.end.q, part.end.v
            energies.append(float(part.jacobi_integral()[-1]))
        yield measure.row(what, np.max(np.abs(np.array(energies) + 0.5)) / (np.sqrt(6e6) * EPS * 0.5), 10.0)


def bead_period():
    """Twice the time from one turning point to the other, by Gauss-Legendre in the angle of a substitution."""
    x, w = np.polynomial.legendre.leggauss(200)
    s = np.pi / 2 * x
    q = RELEASE * np.sin(s)

    def energy(q):
        return -0.5 * BEAD["w2"] * np.sin(q) ** 2 - BEAD["g"] * np.cos(q)

    speed = np.sqrt(2 * (energy(RELEASE) - energy(q)))
    return float(2 * np.sum(np.pi / 2 * w * RELEASE * np.cos(s) / speed))


def beads(wanted):
    """The least time for a phase error of 1e-3, over more and more periods, and energy over a million."""
    period = bead_period()
    start = RELEASE, 0.0, BEAD
    quarter = motion(bead, start, [0.0, period / 4], rtol=1e-13)

    def late(traj):
        """How late the bead is, a quarter after whole turns, in radians."""
        return abs(float((traj.q[-1] - quarter.q[-1]) / quarter.v[-1])) * TURN / period

    def run(turns, **options):
        return motion(bead, start, [0.0, (turns + 0.25) * period], **options)

    def first(turns, kind, ladder):
        """The first setting with the phase wanted, its error, and the seconds of a call."""
        for options in ladder:
            jax.block_until_ready(run(1, **options))
            found, taken = seconds(partial(run, turns, **options))
            if late(found) < PHASE:
                return taken, options, f"{kind}: {late(found):.1e} rad, {int(found.stats['num_steps'])} steps"
        return np.inf, None, f"{kind}: not reached"

    adapting = [{"rtol": 10.0 ** (-k / 2)} for k in range(5, 28)]
    steps = {m: [{"method": m, "dt0": period / (2.5 * 2.0 ** (k / 4))} for k in range(40)]
             for m in (lj.Splitting(6), lj.Splitting(8), lj.Gauss(6))}  # fmt: skip
    winner = lj.Splitting(6)
    for turns in (100, 1000, 10_000, 1_000_000):
        what = f"bead, {turns} periods to 1e-3 rad: equal steps / lj.Nystrom12"
        if not wanted(what):
            continue
        # A longer motion needs more: begin where the last one ended. Over a million periods only the winner is measured.
        theirs, setting, how = first(turns, "Nystrom12", adapting)
        adapting = adapting[adapting.index(setting) :] if setting in adapting else adapting
        found = {m: first(turns, m.label, steps[m]) for m in ([winner] if turns > 10_000 else steps)}
        steps |= {m: steps[m][steps[m].index(row[1]) :] for m, row in found.items() if row[1] in steps[m]}
        winner = min(found, key=lambda m: found[m][0])
        ours = found[winner]
        yield measure.row(
            what, ours[0] / theirs, 1 / 3 if turns > 10_000 else None, ours=ours[2], theirs=how, seconds=ours[0]
        )
    what = "bead, 1000000 periods by Splitting(8): energy's error / sqrt(steps) round-offs"
    if wanted(what):
        ts = period * 1e6 * np.linspace(0.0, 1.0, 101)
        run = partial(motion, bead, start, method=lj.Splitting(8), dt0=period / 40)
        jax.block_until_ready(run(ts / 1e6))
        traj, taken = seconds(partial(run, ts))
        error, more = of_energy(traj)
        yield measure.row(what, error, 10.0, **more, seconds=taken)


def barycentric():
    """The bodies' places and velocities, the centre of mass at rest."""
    shares = MASSES / MASSES.sum()
    return PLACES - shares @ PLACES, SPEEDS - shares @ SPEEDS


def solar_system(wanted):
    """Energy and momenta over a million years, the phase over ten thousand, and the peers."""
    start = *barycentric(), MASSES
    run = partial(motion, planets, start)
    what = "outer Solar System, 1e6 years by Splitting(8): energy's error / sqrt(steps) round-offs"
    if wanted(what):
        ts, options = 1e6 * YEAR * np.linspace(0.0, 1.0, 101), {"method": lj.Splitting(8), "dt0": 150.0}
        jax.block_until_ready(run(ts / 1e5, **options))
        traj, taken = seconds(partial(run, ts, **options))
        error, more = of_energy(traj)
        angular = np.sum(MASSES[:, None] * np.cross(traj.q, traj.v), axis=1)
        linear = np.abs(np.einsum("i,tij->tj", MASSES, traj.v)) / np.sum(MASSES[:, None] * np.abs(traj.v[0]))
        yield measure.row(
            what, error, None, **more, seconds=taken, linear_momentum=float(np.max(linear)),
            angular_momentum=float(np.max(np.abs(angular - angular[0])) / np.linalg.norm(angular[0])),
        )  # fmt: skip
    what = "outer Solar System, 10000 years by Splitting(8): Jupiter's way off that by half the steps, rad"
    if wanted(what):
        ts = 1e4 * YEAR * np.linspace(0.0, 1.0, 101)
        jax.block_until_ready(run(ts / 1e4, method=lj.Splitting(8), dt0=150.0))
        rough, taken = seconds(partial(run, ts, method=lj.Splitting(8), dt0=150.0))
        fine = run(ts, method=lj.Splitting(8), dt0=75.0)
        off = np.linalg.norm(rough.q[:, 1] - fine.q[:, 1], axis=1) / np.linalg.norm(fine.q[:, 1], axis=1)
        yield measure.row(what, off[-1], None, seconds=taken, at_a_tenth=float(off[10]))
        for name, peer in {"heyoka": by_heyoka, "rebound": by_rebound}.items():
            what = f"outer Solar System, 10000 years: Splitting(8) / {name}"
            if importlib.util.find_spec(name) is None:
                yield measure.skipped(what, f"{name} is not installed")
                continue
            for kind, solve in peer(start, ts[-1]).items():
                place, theirs = seconds(solve)
                away = np.linalg.norm(place[1] - fine.q[-1, 1]) / np.linalg.norm(fine.q[-1, 1])
                yield measure.row(f"{what} {kind}".strip(), taken / theirs, None, theirs=float(away), ours=float(off[-1]),
                                  seconds=theirs)  # fmt: skip


def by_heyoka(start, end):
    """Taylor's method at round-off."""
    import heyoka

    program = heyoka.model.nbody(len(MASSES), masses=list(MASSES), Gconst=GRAVITY)
    taylor = heyoka.taylor_adaptive(program, np.concatenate(start[:2], axis=1).ravel())

    def solve():
        taylor.propagate_until(end)
        return taylor.state.reshape(len(MASSES), 6)[:, :3]

    return {"": solve}


def by_rebound(start, end):
    """IAS15, and WHFast with its corrector of order 11 and steps of 40 days, as in its example of these planets."""
    import rebound

    def solve(integrator):
        simulation = rebound.Simulation()
        simulation.G, simulation.integrator = GRAVITY, integrator
        if integrator == "whfast":
            simulation.dt = 40.0
            simulation.integrator.corrector, simulation.integrator.safe_mode = 11, 0
        for mass, place, speed in zip(MASSES, *start[:2]):
            simulation.add(m=mass, x=place[0], y=place[1], z=place[2], vx=speed[0], vy=speed[1], vz=speed[2])
        simulation.integrate(end)
        return np.array([[body.x, body.y, body.z] for body in simulation.particles])

    return {"IAS15": partial(solve, "ias15"), "WHFast": partial(solve, "whfast")}


def ellipse_peers(wanted):
    """Splitting(8) beside SciPy and heyoka, at an error no larger than theirs."""

    def field(t, y):
        r3 = (y[0] ** 2 + y[1] ** 2) ** 1.5
        return np.array([y[2], y[3], -y[0] / r3, -y[1] / r3])

    def scipy(turns):
        return solve_ivp(field, (0, turns * TURN), np.concatenate(START), "DOP853", rtol=1e-10, atol=1e-10).y[:2, -1]

    def heyoka(turns):
        import heyoka

        x, y, u, w = heyoka.make_vars("x", "y", "u", "w")
        r3 = (x**2 + y**2) ** 1.5
        taylor = heyoka.taylor_adaptive([(x, u), (y, w), (u, -x / r3), (w, -y / r3)], np.concatenate(START))

        def solve():
            taylor.propagate_until(turns * TURN)
            return taylor.state[:2]

        return solve

    for name, turns, solve in (("scipy", 100, None), ("heyoka", 10_000, heyoka)):
        what = f"ellipse, {turns} turns: Splitting(8) / {'DOP853' if solve is None else name}"
        if not wanted(what):
            continue
        if importlib.util.find_spec(name) is None:
            yield measure.skipped(what, f"{name} is not installed")
            continue
        end, theirs = seconds(partial(scipy, turns) if solve is None else solve(turns))
        asked = float(np.linalg.norm(end - START[0]))
        for k in counted():
            steps = int(80 * 2.0 ** (k / 4))
            jax.block_until_ready(orbit(lj.Splitting(8), steps, 1))
            found, ours = seconds(partial(orbit, lj.Splitting(8), steps, turns))
            reached = float(np.linalg.norm(np.asarray(found.q[-1]) - START[0]))
            if reached < asked or steps > 1000:
                break
        yield measure.row(what, ours / theirs, None, ours=reached, theirs=asked, seconds=ours, steps=steps)


def stiff(wanted):
    """Gauss(3) and Radau5 at equal error on a stiff spring pendulum, whose oscillation need not be followed."""
    what = "stiff spring pendulum to 1e-3: Gauss(3, newton=True) / lj.Radau5"
    if not wanted(what):
        return
    start, ts = (np.array([np.sin(1.0), -np.cos(1.0)]), np.zeros(2), 1e6), np.linspace(0.0, 10.0, 11)
    exact = motion(spring, start, ts, rtol=1e-11).q

    def first(ladder):
        for options in ladder:
            run = partial(motion, spring, start, ts, **options)
            found = run()
            error = float(np.max(np.abs(found.q - exact)))
            if error < 1e-3:
                return run, error, int(found.stats["num_steps"])
        raise RuntimeError("not reached")

    gauss = first([{"method": lj.Gauss(3, newton=True), "dt0": 0.4 * 2.0 ** (-k / 2)} for k in range(16)])
    radau = first([{"method": lj.Radau5(step_powers=(0, 1)), "rtol": 10.0 ** (-k / 2)} for k in range(4, 24)])
    times = measure.in_turn(lambda: gauss[0]().q, lambda: radau[0]().q, repeats=7)
    yield measure.row(what, times.ratio()[0], 1.0, ours=gauss[1], theirs=radau[1], seconds=times.medians[0],
                      steps=gauss[2], their_steps=radau[2])  # fmt: skip


def residuals(wanted):
    """The constraint of a pendulum on a rod at the end of each tenth of ten million steps."""
    what = "pendulum on a rod, 10,000,000 steps of Gauss(3): largest residual, at each tenth"
    if not wanted(what):
        return
    state, largest, ts = (np.array([np.sin(1.5), -np.cos(1.5)]), np.zeros(2)), 0.0, 0.1 * np.arange(100_001)
    first = None
    for _ in range(10):
        part = motion(rod, (*state, 9.81), ts, method=lj.Gauss(3), dt0=0.01)
        largest = max(largest, float(np.max(np.abs(np.sum(np.asarray(part.q) ** 2, axis=1) - 1.0))))
        state = part.end.q, part.end.v
        first = part.jacobi_integral()[0] if first is None else first
    yield measure.row(what, largest, 1e-13, energy=float(part.jacobi_integral()[-1] - first))


def derivatives(wanted):
    """The derivative through a hundred thousand steps in both modes, and the memory of the reverse one.

    The sun is in thirty parts: with up to 24 numbers reverse mode pushes tangents forward, and takes no memory.
    """
    what = "ellipse, derivative through 100,000 steps: forward - reverse, relative"
    if not wanted(what):
        return

    def end(k, steps):
        ts = np.linspace(0.0, steps * TURN / 200, 11)
        return motion(parts, (*START, k), ts, method=lj.Gauss(2), dt0=TURN / 200).q[-1, 0]

    parts = lj.System(lambda t, q, v, k: 0.5 * jnp.sum(v**2) + jnp.sum(k) / jnp.sqrt(jnp.sum(q**2)))
    sun, more, sizes = jnp.full(30, 1 / 30), jnp.arange(30.0), []
    for steps in (1000, 100_000):
        reverse = jax.jit(jax.grad(partial(end, steps=steps))).lower(sun).compile()
        sizes.append(reverse.memory_analysis().temp_size_in_bytes)
    found, taken = seconds(lambda: reverse(sun))
    value = float(found @ more)
    forward = float(jax.jit(lambda k: jax.jvp(partial(end, steps=100_000), (k,), (more,))[1])(sun))
    yield measure.row(what, abs(value / forward - 1), 1e-8, derivative=value, megabytes=sizes[1] / 2**20,
                      megabytes_of_1000_steps=sizes[0] / 2**20, seconds=taken)  # fmt: skip


def rows(wanted):
    """All rows."""
    jax.config.update("jax_enable_x64", True)
    for part in (costs, beads, stiff, derivatives, residuals, ellipse_peers, ellipses, solar_system):
        yield from part(wanted)


def draw(path):
    """The energy's error over ten thousand turns of the ellipse, by three methods."""
    ts = np.append(0.0, TURN * np.geomspace(1.0, 1e4, 121))
    start = *START, 1.0
    runs = {
        "lj.Dopri8(), rtol=1e-9": motion(kepler, start, ts, method=lj.Dopri8(), rtol=1e-9),
        "lj.Splitting(4), 200 steps a turn": motion(kepler, start, ts, method=lj.Splitting(4), dt0=TURN / 200),
        "lj.Gauss(8), 60 steps a turn": motion(kepler, start, ts, method=lj.Gauss(8), dt0=TURN / 60),
    }
    fig, ((axis,),) = plots.figure(size=(5.6, 3.6))
    for i, (name, traj) in enumerate(runs.items()):
        h = np.asarray(traj.jacobi_integral())
        axis.plot(ts[1:] / TURN, np.maximum(np.abs(h[1:] / h[0] - 1), EPS / 2), label=name, **plots.style(i))
    walk = EPS * np.sqrt(60 * ts[1:] / TURN)
    axis.plot(ts[1:] / TURN, walk, color="0.5", linewidth=0.8, label="√steps round-offs")
    axis.set(xscale="log", yscale="log", xlabel="turns", ylabel="relative error of the energy", ylim=(1e-16, 1e-2))
    axis.legend(fontsize=8, frameon=False)
    fig.savefig(path)


if __name__ == "__main__":
    measure.main(rows, __doc__, draw)
