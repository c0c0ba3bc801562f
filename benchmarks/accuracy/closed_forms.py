"""Motions with a closed form: the six scenes, Kepler orbits, rods and disks, stiff springs."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import mpmath
import numpy as np

import lagjax as lj
from benchmarks.accuracy import work_precision
from benchmarks.accuracy.long_double import LONG, exactly, reference
from benchmarks.accuracy.motion import Motion
from lagjax.mechanisms import slider_crank
from lagjax.mechanisms.planar import driven_crank_exact
from lagjax.scenes import bead_on_hoop, mass_distributions, rolling_hoop


def kepler_lagrangian(t, q, v, params):
    """Cartesian coordinates."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) + 1 / jnp.sqrt(q["x"] ** 2 + q["y"] ** 2)


def polar_lagrangian(t, q, v, params):
    """Polar coordinates."""
    return 0.5 * (v["r"] ** 2 + (q["r"] * v["phi"]) ** 2) + 1 / q["r"]


def spring_lagrangian(t, q, v, params):
    """A spring, driven by a force cos t."""
    return 0.5 * v**2 - 0.5 * params["k"] * q**2 + params["push"] * q * jnp.cos(t)


def drag(t, q, v, params):
    """R = ½ c v²."""
    return 0.5 * params["c"] * v**2


def two_springs_lagrangian(t, q, v, params):
    """A soft and a stiff spring in series."""
    stretch = q["b"] - q["a"]
    return 0.5 * (v["a"] ** 2 + v["b"] ** 2) - 0.5 * q["a"] ** 2 - 0.5 * params["k"] * stretch**2


def relative_drag(t, q, v, params):
    """Damping of the stiff spring."""
    return 0.5 * params["c"] * (v["b"] - v["a"]) ** 2


def disk_lagrangian(t, q, v, params):
    """A vertical disk on an incline: angle, heading, x, y."""
    sliding = 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) + params["m"] * params["g"] * q["x"]
    return sliding + 0.5 * params["I"] * v["angle"] ** 2 + 0.5 * params["J"] * v["heading"] ** 2


def disk_rolls(t, q, v, params):
    """The point of contact is at rest."""
    along = jnp.stack([jnp.cos(q["heading"]), jnp.sin(q["heading"])])
    return jnp.stack([v["x"], v["y"]]) - params["R"] * v["angle"] * along


def throw_lagrangian(t, q, v, params):
    """Free fall."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]


kepler = lj.System(kepler_lagrangian)
kepler_polar = lj.System(polar_lagrangian)
spring = lj.System(spring_lagrangian, dissipation=drag)
two_springs = lj.System(two_springs_lagrangian, dissipation=relative_drag)
disk = lj.System(disk_lagrangian, {"rolling": lj.Nonholonomic(disk_rolls)})
stone = lj.System(throw_lagrangian)


def ellipse(x0, v0, ts):
    """Positions and velocities (T, 2) from (x0, 0), (0, v0), and the angle: Kepler's equation to 50 digits."""
    with mpmath.workdps(50):
        x0, v0 = mpmath.mpf(float(x0)), mpmath.mpf(float(v0))
        a = 1 / (2 / x0 - v0**2)
        e = 1 - x0 / a
        # Angles are counted from the nearer apsis; a start at the farther one has e < 0.
        rate, b = a ** mpmath.mpf(-1.5), a * mpmath.sqrt(1 - e**2)
        rows = []
        for t in ts:
            mean = rate * mpmath.mpf(float(t))
            E = mpmath.findroot(lambda E: E - e * mpmath.sin(E) - mean, _between(e, mean), solver="anderson")
            c, s = mpmath.cos(E), mpmath.sin(E)
            E_rate = rate / (1 - e * c)
            turns = mpmath.floor(E / (2 * mpmath.pi) + 0.5)
            rest = E - 2 * mpmath.pi * turns
            phi = 2 * mpmath.atan2(mpmath.sqrt(1 + e) * mpmath.sin(rest / 2), mpmath.sqrt(1 - e) * mpmath.cos(rest / 2))
            r, r_rate = a * (1 - e * c), a * e * s * E_rate
            phi_rate = x0 * v0 / r**2
            rows.append([a * (c - e), b * s, -a * s * E_rate, b * c * E_rate,
                         r, phi + 2 * mpmath.pi * turns, r_rate, phi_rate])  # fmt: skip
        return np.array([[float(x) for x in row] for row in rows])


def _between(e, mean):
    return mean - abs(e) - mpmath.mpf(1) / 10, mean + abs(e) + mpmath.mpf(1) / 10


def orbit(name, e, turns, outputs, polar=False, far=False, **how):
    """An ellipse with a semi-axis of about one, starting at its nearer or farther apsis."""
    x0, v0 = (1 + e, np.sqrt((1 - e) / (1 + e))) if far else (1 - e, np.sqrt((1 + e) / (1 - e)))
    ts = np.linspace(0.0, 2 * np.pi * turns, outputs)
    names, columns = (("r", "phi"), slice(4, 8)) if polar else (("x", "y"), slice(0, 4))

    def exact(ts):
        rows = ellipse(x0, v0, ts)[:, columns].T
        return dict(zip(names, rows[:2])), dict(zip(names, rows[2:]))

    state = ({"r": x0, "phi": 0.0}, {"r": 0.0, "phi": v0 / x0}) if polar else ({"x": x0, "y": 0.0}, {"x": 0.0, "y": v0})
    if polar:
        # The transverse speed is the rounded rate times the distance, not the number before the division.
        with mpmath.workdps(50):
            v0 = mpmath.mpf(float(v0 / x0)) * mpmath.mpf(float(x0))
    system = kepler_polar if polar else kepler
    how = {"order": 8 if polar else 12} | how
    return Motion(name, system, *state, {}, ts, exact, "Kepler's equation, 50 digits", **how)


def borrowed(name, motion, outputs, end=None, **how):
    """A motion of `work_precision.py` at more times."""
    ts = np.linspace(motion.ts[0], motion.ts[1] if end is None else end, outputs)
    start = motion.q0, motion.v0
    return Motion(name, motion.system, *start, motion.params, ts, motion.exact, "closed form", **how)


def bead(name, psi, periods, outputs, change=None, **how):
    """The bead on the hoop, from rest."""
    params = bead_on_hoop.PARAMS | (change or {})
    ts = np.linspace(0.0, periods * float(bead_on_hoop.exact_period(params, psi)), outputs)
    exact = lambda t: bead_on_hoop.exact_motion(params, psi, t)
    return Motion(name, bead_on_hoop.system, psi, 0.0, params, ts, exact, "elliptic functions", **({"order": 12} | how))


def leaving():
    """The hoop until it leaves the cylinder, at a time known from Carlson's integral."""
    params, tilt = rolling_hoop.PARAMS, 0.25
    theta, ts = np.pi / 2 - tilt, np.linspace(0.0, 4.0, 9)
    exact, start = lambda t: rolling_hoop.exact_motion(params, theta, t), rolling_hoop.start(params, theta)
    name = "rolling_hoop, leaving the cylinder"
    found = Motion(name, rolling_hoop.system, *start, params, ts, exact, "elliptic functions")
    when = {name: lambda times: np.full(len(times), rolling_hoop.departure_time(params, tilt))
            for name in rolling_hoop.DEPARTURE}  # fmt: skip
    return found._replace(events=rolling_hoop.DEPARTURE, when=when)


def crank():
    """The slider-crank; the reference solves the equation of its crank's angle in long double."""
    p = exactly(slider_crank.params)
    ratio = p["l1"] / p["l2"]

    def inertia(angle):
        """J, J' and V'."""
        s, c = np.sin(angle), np.cos(angle)
        s2, c2 = -ratio * s, np.sqrt(1 - (ratio * s) ** 2)
        w = -ratio * c / c2
        dw = ratio * s / c2 + w**2 * s2 / c2
        centre, block = p["l1"] * s + p["l2"] * w * s2 / 2, p["l1"] * s + p["l2"] * w * s2
        bend = p["l2"] * (dw * s2 + w**2 * c2)
        J = p["J1"] + p["m1"] * p["l1"] ** 2 / 4 + p["J2"] * w**2 + p["m2"] * (centre**2 + p["l1"] ** 2 * c**2 / 4)
        slope = p["J2"] * w * dw + p["m2"] * (centre * (p["l1"] * c + bend / 2) - p["l1"] ** 2 * c * s / 4)
        slope += p["m3"] * block * (p["l1"] * c + bend)
        return J + p["m3"] * block**2, 2 * slope, (p["m1"] + p["m2"]) * p["g"] * p["l1"] * c / 2

    def field(t, y):
        J, slope, weight = inertia(y[0])
        return np.array([y[1], -(slope * y[1] ** 2 / 2 + weight) / J])

    def to_qv(y):
        angle, rate = y.T
        q, unit, _ = driven_crank_exact(angle.astype(float), slider_crank.params | {"rate": 1.0})
        return q, jax.tree.map(lambda x: x * rate.astype(float), unit)

    m = slider_crank
    found = reference(field, [0, LONG(150)], to_qv)
    return Motion("slider-crank", m.system, m.q0, m.v0, m.params, np.linspace(0.0, m.end, 11), found.exact,
                  "long double", found.known, tolerances=(1e-5, 1e-8))  # fmt: skip


def linear(name, system, names, matrix, start, ts, params, **how):
    """A linear motion y' = A y, by the eigenvectors of A to 50 digits; the last entries of `start` are the drive."""
    count = len(names)

    def exact(ts):
        with mpmath.workdps(50):
            rates, vectors = mpmath.eig(mpmath.matrix(matrix))
            parts = mpmath.lu_solve(vectors, mpmath.matrix(start))
            rows = []
            for t in ts:
                grown = [part * mpmath.exp(rate * mpmath.mpf(float(t))) for part, rate in zip(parts, rates)]
                rows.append([float(mpmath.re(x)) for x in vectors * mpmath.matrix(grown)])
        rows = np.array(rows).T
        q, v = rows[:count], rows[count : 2 * count]
        return (q[0], v[0]) if count == 1 else tuple(dict(zip(names, part)) for part in (q, v))

    state = [dict(zip(names, part)) for part in (start[:count], start[count : 2 * count])]
    q0, v0 = state if count > 1 else (start[0], start[1])
    return Motion(name, system, q0, v0, params, ts, exact, "eigenvectors, 50 digits", **how)


def pushed_spring(name, k, c, push, ts, q0=1.0, **how):
    """One spring, driven by cos t."""
    matrix = [[0, 1, 0, 0], [-k, -c, push, 0], [0, 0, 0, -1], [0, 0, 1, 0]]
    params = {"k": k, "c": c, "push": push}
    return linear(name, spring, ("q",), matrix, [q0, 0.0, 1.0, 0.0], ts, params, **how)


def springs_in_a_row(name, k, c, ts, start, **how):
    """A soft spring and a stiff one in series."""
    matrix = [[0, 0, 1, 0], [0, 0, 0, 1], [-1 - k, k, -c, c], [k, -k, c, -c]]
    return linear(name, two_springs, ("a", "b"), matrix, [1.0, start, 0.0, 0.0], ts, {"k": k, "c": c}, **how)


def slow_start(k):
    """The b for a = 1 at which the stiff spring does not oscillate: k / (k - w²), with w the lower frequency."""
    k = LONG(k)
    return float(k / (k - 2 * k / (2 * k + 1 + np.sqrt(4 * k**2 + 1))))


def rolling_disk(g, **how):
    """A disk that rolls on an incline: cycloids."""
    p, turn, spin, first = {"m": 1.5, "R": 0.75, "I": 0.5, "J": 0.25, "g": g}, 1.75, 4.0, 0.375
    radius = p["R"]
    k = p["m"] * g * radius / ((p["m"] * radius**2 + p["I"]) * turn)
    c = spin - k * np.sin(first)

    def exact(t):
        heading = first + turn * t
        rate = c + k * np.sin(heading)
        x = lambda a: radius / turn * (c * np.sin(a) + 0.5 * k * np.sin(a) ** 2)
        y = lambda a: radius / turn * (-c * np.cos(a) + k * (0.5 * a - 0.25 * np.sin(2 * a)))
        q = {"angle": c * t - k / turn * (np.cos(heading) - np.cos(first)), "heading": heading,
             "x": x(heading) - x(first), "y": y(heading) - y(first)}  # fmt: skip
        v = {"angle": rate, "heading": turn + 0 * t, "x": radius * np.cos(heading) * rate,
             "y": radius * np.sin(heading) * rate}  # fmt: skip
        return q, v

    start = jax.tree.map(float, exact(0.0))
    ts = np.linspace(0.0, 6.0, 13)
    return Motion(f"rolling disk, g = {g:g}", disk, *start, p, ts, exact, "closed form", **how)


def through_plane():
    """A particle that falls through a plane of mass: three parabolas, with a jump of the force in between."""
    params, start = mass_distributions.PARAMS["plane"], mass_distributions.ORBITS["plane"][:2]
    pull = 2 * np.pi * params["G"] * params["sigma"]
    z, v = start[0]["z"], start[1]["z"]
    first = (v + np.sqrt(v**2 + 2 * pull * z)) / pull
    fast = np.sqrt(v**2 + 2 * pull * z)
    second = first + 2 * fast / pull

    def exact(t):
        t = np.asarray(t)
        below, above = t - first, t - second
        height = np.where(t < first, z + v * t - 0.5 * pull * t**2,
                          np.where(t < second, -fast * below + 0.5 * pull * below**2,
                                   fast * above - 0.5 * pull * above**2))  # fmt: skip
        rate = np.where(t < first, v - pull * t, np.where(t < second, -fast + pull * below, fast - pull * above))
        return ({k: q0[k] + v0[k] * t for k in "xy"} | {"z": height}, {k: v0[k] + 0 * t for k in "xy"} | {"z": rate})

    q0, v0 = start
    return Motion("mass_distributions, through the plane", mass_distributions.SYSTEMS["plane"], q0, v0, params,
                  np.linspace(0.0, 4.0, 17), exact, "closed form", order=12)  # fmt: skip


def thrown():
    """A stone: its apex, and where it lands."""
    params, start = {"g": 10.0}, ({"x": 0.0, "y": 0.0}, {"x": 1.0, "y": 5.0})
    exact = lambda t: ({"x": 1.0 * t, "y": 5.0 * t - 5.0 * t**2}, {"x": 1.0 + 0 * t, "y": 5.0 - 10.0 * t})
    found = Motion("stone, apex and floor", stone, *start, params, np.linspace(0.0, 2.0, 5), exact, "closed form")
    apex = lj.Crossing(lambda t, q, v, params: v["y"], terminal=False)
    return found.crossing(apex=apex, floor=lj.Crossing(lambda t, q, v, params: q["y"], direction=-1))


def radial(t, q, v, params):
    """r·v, which is zero at the apsides of an ellipse."""
    return q["x"] * v["x"] + q["y"] * v["y"]


def motions():
    """All of them."""
    ends, tight = lj.Crossing(radial, terminal=False), {"tolerances": (1e-7, 1e-10, 1e-11)}
    upto, loose = partial(np.linspace, 0.0), {"tolerances": (1e-5, 1e-8)}
    stiff = {"method": lj.Radau5(), "order": 5, "tolerances": (1e-4, 1e-6, 1e-8)}
    springs = stiff | {"method": lj.Radau5(step_powers=(0, 1))}
    tsit = {"method": lj.Tsit5(), "order": 5, **loose}
    fixed = {"dt0": 1 / 16, "stepsize_controller": diffrax.ConstantStepSize()}
    return [
        borrowed("sphere_geodesic, over the azimuth", work_precision.geodesic(), 21),
        borrowed("sphere_geodesic, embedded", work_precision.embedded_geodesic(), 21, **loose),
        borrowed("rolling_hoop, 20 swings", work_precision.hoop(), 41, **loose),
        leaving(),
        bead("bead_on_hoop, 3.7 periods", 1.0, 3.7, 6),
        bead("bead_on_hoop, 100 periods", 1.0, 100, 21),
        bead("bead_on_hoop, through the bottom, 400 outputs", 2.0, 5.3, 400, {"omega": 2.5}),
        bead("bead_on_hoop, Dopri8", 1.0, 10, 21, method=lj.Dopri8(), order=8),
        bead("bead_on_hoop, Tsit5", 1.0, 10, 21, **tsit),
        borrowed("bead_on_hoop, driven", work_precision.driven_bead(), 21, **loose),
        borrowed("mass_distributions, inside an ellipse", work_precision.inside_ellipse(), 21, order=12),
        through_plane(),
        borrowed("sliding_wedge", work_precision.wedge(), 5, **loose),
        borrowed("cross_rails, rotating", work_precision.rails(False), 21),
        borrowed("cross_rails, rotating, diffrax.Dopri5", work_precision.rails(False), 21, end=20.0,
                 method=diffrax.Dopri5(), order=5, tolerances=(1e-5, 1e-8)),
        borrowed("cross_rails, lab", work_precision.rails(True), 21, order=12),
        borrowed("pendulum on a rod", work_precision.cartesian_pendulum(), 41, **loose),
        crank(),
        rolling_disk(0.0, **loose),
        rolling_disk(6.25, **loose),
        thrown(),
        orbit("Kepler, e = 0.9, 10 turns", 0.9, 10, 21),
        orbit("Kepler, e = 0.99, 3 turns", 0.99, 3, 13, **tight),
        orbit("Kepler, e = 0.999, 3 turns", 0.999, 3, 13, **tight),
        orbit("Kepler, e = 0.9, from afar, 10.25 turns", 0.9, 10.25, 42, far=True),
        orbit("Kepler, e = 0.99, from afar, 3.3 turns", 0.99, 3.3, 12, far=True, **tight),
        orbit("Kepler, e = 0.999, from afar, 3.3 turns", 0.999, 3.3, 12, far=True, **tight),
        orbit("Kepler, e = 0.9, polar, 10 turns", 0.9, 10, 21, polar=True),
        orbit("Kepler, e = 0.99, polar, from afar, 3.3 turns", 0.99, 3.3, 12, polar=True, far=True, **tight),
        orbit("Kepler, e = 0.9, 1000 outputs", 0.9, 3, 1001, tolerances=(1e-5, 1e-9)),
        orbit("Kepler, e = 0.9, Nystrom8", 0.9, 10.25, 42, method=lj.Nystrom8(), order=8),
        orbit("Kepler, e = 0.9, Tsit5", 0.9, 3.3, 12, **tsit),
        orbit("Kepler, e = 0.3, Tsit5, steps of 1/16", 0.3, 3.3, 12, options=fixed, **tsit | {"tolerances": (1e-6,)}),
        orbit("Kepler, e = 0.7, its ends", 0.7, 5.2, 3).crossing(ends=ends),
        orbit("Kepler, e = 0.9, backward", 0.9, -3, 13),
        pushed_spring("oscillator, outputs on its zeros", 1.0, 0.0, 0.0, np.arange(0, 41) * np.pi / 2),
        pushed_spring("stiff damping, Radau5", 1e3, 1e4, 1e3, upto(10, 11), 1.0, **stiff),
        pushed_spring("stiff spring, Radau5", 1e6, 10.0, 1e6, upto(10, 11), **stiff),
        springs_in_a_row("soft and stiff spring, Radau5", 1e4, 1e3, upto(10, 11), 1.0, **stiff),
        # This method does not resolve oscillations of the stiff spring (as documented), and no estimate detects them.
        springs_in_a_row("soft and stiff spring, undamped, Radau5", 1e6, 0.0, upto(10, 11), slow_start(1e6), **springs),
    ]  # fmt: skip
