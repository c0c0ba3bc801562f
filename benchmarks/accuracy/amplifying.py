"""Motions that amplify errors, chaotic and nearly singular ones, with equations written by hand for long double."""

from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.accuracy.by_hand import DOUBLE_PENDULUM
from benchmarks.accuracy.long_double import LONG, exactly
from benchmarks.accuracy.motion import by_long_double
from lagjax.mechanisms import double_pendulum
from lagjax.mechanisms.planar import Masses

GRAVITY = 9.8125


def pendulum_lagrangian(t, q, v, params):
    """The angle from the bottom."""
    return 0.5 * v**2 + params["k"] * jnp.cos(q)


def damped_pendulum_lagrangian(t, q, v, params):
    """The same with a push whose direction rotates with time."""
    return 0.5 * v**2 + params["k"] * jnp.cos(q) + params["push"] * q * jnp.cos(params["rate"] * t)


def drag(t, q, v, params):
    """R = ½ c v²."""
    return 0.5 * params["c"] * v**2


def duffing_lagrangian(t, q, v, params):
    """Two wells, driven."""
    return 0.5 * v**2 + 0.5 * q**2 - 0.25 * q**4 + params["push"] * q * jnp.cos(params["rate"] * t)


def henon_heiles_lagrangian(t, q, v, params):
    """Two coordinates, coupled by a cubic."""
    x, y = q["x"], q["y"]
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * (x**2 + y**2) - x**2 * y + y**3 / 3


def three_bodies_lagrangian(t, q, v, params):
    """Three masses in a plane, (3, 2), that attract each other."""
    m, pairs = params["m"], ((0, 1), (0, 2), (1, 2))
    potential = sum(m[i] * m[j] / jnp.sqrt(jnp.sum((q[i] - q[j]) ** 2)) for i, j in pairs)
    return 0.5 * jnp.sum(m[:, None] * v**2) + potential


def wall_lagrangian(t, q, v, params):
    """A ball that falls on a soft wall."""
    return 0.5 * v**2 - params["g"] * q - jnp.exp(-params["k"] * q)


def top_lagrangian(t, q, v, params):
    """A free rigid body in Euler angles z-x-z."""
    s, c = jnp.sin(q["theta"]), jnp.cos(q["theta"])
    one = v["phi"] * s * jnp.sin(q["psi"]) + v["theta"] * jnp.cos(q["psi"])
    two = v["phi"] * s * jnp.cos(q["psi"]) - v["theta"] * jnp.sin(q["psi"])
    three = v["phi"] * c + v["psi"]
    return 0.5 * (params["A"] * one**2 + params["B"] * two**2 + params["C"] * three**2)


def quaternion_lagrangian(t, q, v, params):
    """The same with a quaternion (scalar first): ω = 2 q* q̇."""
    one = 2 * (q[0] * v[1] - q[1] * v[0] - q[2] * v[3] + q[3] * v[2])
    two = 2 * (q[0] * v[2] + q[1] * v[3] - q[2] * v[0] - q[3] * v[1])
    three = 2 * (q[0] * v[3] - q[1] * v[2] + q[2] * v[1] - q[3] * v[0])
    return 0.5 * (params["A"] * one**2 + params["B"] * two**2 + params["C"] * three**2)


def unit(t, q, params):
    """|q|² = 1."""
    return q @ q - 1.0


pendulum = lj.System(pendulum_lagrangian)
driven_pendulum = lj.System(damped_pendulum_lagrangian, dissipation=drag)
duffing = lj.System(duffing_lagrangian, dissipation=drag)
henon_heiles = lj.System(henon_heiles_lagrangian)
three_bodies = lj.System(three_bodies_lagrangian)
wall = lj.System(wall_lagrangian)
rigid_body = lj.System(top_lagrangian)
by_quaternion = lj.System(quaternion_lagrangian, {"unit": lj.Holonomic(unit)})


def one(y):
    """(q, v) of one coordinate."""
    return y[:, 0].astype(float), y[:, 1].astype(float)


def named(*names):
    """(q, v) of several coordinates, each in a dictionary."""
    count = len(names)

    def to_qv(y):
        y = y.astype(float)
        return dict(zip(names, y.T[:count])), dict(zip(names, y.T[count:]))

    return to_qv


def swing(name, q0, v0, ts, **how):
    """The pendulum."""
    params = how.pop("params", {"k": 7.8125})
    k = LONG(params["k"])
    field = lambda t, y: np.array([y[1], -k * np.sin(y[0])])
    return by_long_double(name, pendulum, q0, v0, params, ts, field, [q0, v0], one, **how)


def two_rods(name, q0, v0, ts, **how):
    """The double pendulum in its angles."""
    m1, m2, l1, l2, g = exactly([DOUBLE_PENDULUM.params[key] for key in ("m1", "m2", "l1", "l2", "g")])
    total = m1 + m2

    def field(t, y):
        a, b, u, w = y
        s, c, s1, s2 = np.sin(a - b), np.cos(a - b), g * np.sin(a), g * np.sin(b)
        first, second, share = l1 * u**2, l2 * w**2, 1 / (m1 + m2 * s**2)
        one = (m2 * (s2 * c - s * (first * c + second)) - total * s1) * share / l1
        two = (total * (first * s + s1 * c - s2) + m2 * second * s * c) * share / l2
        return np.array([u, w, one, two])

    state = dict(zip(("one", "two"), q0)), dict(zip(("one", "two"), v0))
    system, params = DOUBLE_PENDULUM.system, DOUBLE_PENDULUM.params
    how = {"tolerances": (1e-5, 1e-8, 1e-11)} | how
    return by_long_double(name, system, *state, params, ts, field, [*q0, *v0], named("one", "two"), **how)


def masses_on_rods(ts):
    """The mechanism of two masses in Cartesian coordinates, rods horizontal at first; the reference uses angles."""
    g = LONG(double_pendulum.params["g"])

    def field(t, y):
        a, b, u, w = y
        s, c = np.sin(a - b), np.cos(a - b)
        one, two, share = -s * w**2 - 2 * g * np.sin(a), s * u**2 - g * np.sin(b), 1 / (1 + s**2)
        return np.array([u, w, (one - c * two) * share, (2 * two - c * one) * share])

    def to_qv(y):
        arm = lambda a: np.stack([np.sin(a), -np.cos(a)], axis=1)
        moved = lambda a, rate: np.stack([np.cos(a) * rate, np.sin(a) * rate], axis=1)
        a, b, u, w = y.T
        q, v = (arm(a), arm(a) + arm(b)), (moved(a, u), moved(a, u) + moved(b, w))
        return tuple(Masses(*(x.astype(float) for x in part)) for part in (q, v))

    m = double_pendulum
    # The angle whose sine is exactly one.
    quarter = 2 * np.arctan(LONG(1))
    return by_long_double(
        f"two masses on rods, {ts[-1]:g} s", m.system, m.q0, m.v0, m.params, ts, field, [quarter, quarter, 0, 0], to_qv,
        tolerances=(1e-5, 1e-8),
    )  # fmt: skip


def two_wells(name, ts, **how):
    """Driven, damped, chaotic."""
    params = {"c": 0.3, "push": 0.5, "rate": 1.2}
    c, push, rate = exactly(list(params.values()))
    field = lambda t, y: np.array([y[1], y[0] - y[0] ** 3 - c * y[1] + push * np.cos(rate * t)])
    return by_long_double(name, duffing, 0.5, 0.0, params, ts, field, [0.5, 0.0], one, **how)


def pushed(name, ts, **how):
    """A driven, damped pendulum."""
    params = {"k": 1.0, "c": 0.5, "push": 1.15, "rate": 2.0 / 3.0}
    k, c, push, rate = exactly(list(params.values()))
    field = lambda t, y: np.array([y[1], -k * np.sin(y[0]) - c * y[1] + push * np.cos(rate * t)])
    return by_long_double(name, driven_pendulum, 0.25, 0.0, params, ts, field, [0.25, 0.0], one, **how)


def cubic(name, start, ts, **how):
    """Hénon and Heiles's."""
    field = lambda t, y: np.array([y[2], y[3], -y[0] - 2 * y[0] * y[1], -y[1] - y[0] ** 2 + y[1] ** 2])
    state = [dict(zip("xy", part)) for part in (start[:2], start[2:])]
    return by_long_double(name, henon_heiles, *state, {}, ts, field, start, named("x", "y"), **how)


def bodies(name, m, q0, v0, ts, **how):
    """Three masses in a plane."""
    q0, v0, masses = np.asarray(q0, float), np.asarray(v0, float), np.asarray(m, LONG)[:, None, None]

    def field(t, y):
        r = y[:6].reshape(3, 2)
        apart = r[:, None] - r[None]
        square = np.sum(apart**2, axis=2, keepdims=True) + np.eye(3, dtype=LONG)[..., None]
        pull = np.sum(masses * apart / (square * np.sqrt(square)), axis=0)
        return np.concatenate([y[6:], pull.ravel()])

    to_qv = lambda y: tuple(part.astype(float).reshape(-1, 3, 2) for part in (y[:, :6], y[:, 6:]))
    start = np.concatenate([q0.ravel(), v0.ravel()])
    params = {"m": np.asarray(m, float)}
    return by_long_double(name, three_bodies, q0, v0, params, ts, field, start, to_qv, **how)


def bounces(name, ts, **how):
    """A ball on a soft wall."""
    params = {"g": 1.0, "k": 20.0}
    g, k = exactly(list(params.values()))
    field = lambda t, y: np.array([y[1], -g + k * np.exp(-k * y[0])])
    return by_long_double(name, wall, 2.0, 0.0, params, ts, field, [2.0, 0.0], one, **how)


INERTIA = {"A": 1.0, "B": 2.0, "C": 3.0}


def spin_rates(w):
    """Euler's equations."""
    A, B, C = exactly(list(INERTIA.values()))
    return [(B - C) / A * w[1] * w[2], (C - A) / B * w[2] * w[0], (A - B) / C * w[0] * w[1]]


def tumbling(name, spin, ts, **how):
    """Rotation near the intermediate axis, in Euler angles; `spin` is about the three axes."""
    theta, psi = 1.25, 0.5

    def angles(theta, psi, w):
        phi = (w[0] * np.sin(psi) + w[1] * np.cos(psi)) / np.sin(theta)
        return [phi, w[0] * np.cos(psi) - w[1] * np.sin(psi), w[2] - phi * np.cos(theta)]

    def spins(phi_rate, theta_rate, psi_rate):
        return [phi_rate * np.sin(theta) * np.sin(psi) + theta_rate * np.cos(psi),
                phi_rate * np.sin(theta) * np.cos(psi) - theta_rate * np.sin(psi),
                phi_rate * np.cos(theta) + psi_rate]  # fmt: skip

    def to_qv(y):
        rates = angles(y[:, 1], y[:, 2], y[:, 3:].T)
        names = ("phi", "theta", "psi")
        return tuple({k: np.asarray(x, float) for k, x in zip(names, part)} for part in (y[:, :3].T, rates))

    field = lambda t, y: np.array([*angles(y[1], y[2], y[3:]), *spin_rates(y[3:])])
    q0 = {"phi": 0.0, "theta": theta, "psi": psi}
    v0 = {k: float(x) for k, x in zip(q0, angles(theta, psi, spin))}
    theta, psi = LONG(theta), LONG(psi)
    start = [*q0.values(), *spins(*exactly(list(v0.values())))]
    return by_long_double(name, rigid_body, q0, v0, INERTIA, ts, field, start, to_qv, **how)


def turned(q, w):
    """q̇ = ½ q ω."""
    return [-q[1] * w[0] - q[2] * w[1] - q[3] * w[2], q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
            q[0] * w[1] - q[1] * w[2] + q[3] * w[0], q[0] * w[2] + q[1] * w[1] - q[2] * w[0]]  # fmt: skip


def tumbling_quaternion(name, spin, ts, **how):
    """The same with a quaternion constrained to unit length."""
    field = lambda t, y: np.array([*(x / 2 for x in turned(y[:4], y[4:])), *spin_rates(y[4:])])
    to_qv = lambda y: (y[:, :4].astype(float), np.stack(turned(y.T[:4], y.T[4:]), axis=1).astype(float) / 2)
    q0 = np.array([1.0, 0.0, 0.0, 0.0])
    v0 = np.array([0.0, *spin]) / 2
    return by_long_double(name, by_quaternion, q0, v0, INERTIA, ts, field, [*q0, *spin], to_qv, **how)


def single(motion):
    """The motion in single precision, with numbers that it represents exactly."""
    start = jax.tree.map(np.float32, (motion.q0, motion.v0, motion.params, motion.ts))
    return motion._replace(floor=1e-6, **dict(zip(("q0", "v0", "params", "ts"), start)))


PYTHAGOREAN = (3.0, 4.0, 5.0), [[1.0, 3.0], [-2.0, -1.0], [1.0, -1.0]], np.zeros((3, 2))
WIDE, FAST = ((2.5, 2.0), (0.0, 0.0)), ((1.0, 2.0), (0.5, -1.0))
CHAOTIC, REGULAR = [0.0, 0.0, 0.5, 0.28125], [0.25, 0.125, 0.125, 0.0]
SPIN = (0.0009765625, 2.0, 0.001953125)


def through_zero(t, q, v, params):
    """Zero when the pendulum, or the first rod, hangs down."""
    return q["one"] if isinstance(q, dict) else q


def motions():
    """All of them."""
    upto, few, tight = partial(np.linspace, 0.0), (1e-6, 1e-9), (1e-7, 1e-10, 1e-11)
    # Single precision represents all these output times exactly.
    binary = np.arange(0.0, 8.25, 0.5)
    fixed = lambda dt: {"dt0": dt, "stepsize_controller": diffrax.ConstantStepSize()}
    recorded = lambda most: lj.Crossing(through_zero, terminal=False, most=most)
    falling = lj.Crossing(through_zero, direction=-1)
    late = {"tolerances": (1e-5, 1e-8, 1e-11)}
    return [
        two_rods("double pendulum, gentle, 20 s", (0.5, 0.25), (0.0, 0.0), upto(20, 21)),
        two_rods("double pendulum, 10 s", *FAST, upto(10, 11)),
        two_rods("double pendulum, gentle, backward", (0.5, 0.25), (0.0, 0.0), upto(-10, 11), **late),
        two_rods("double pendulum, wide, 10 s", *WIDE, upto(10, 21)),
        two_rods("double pendulum, wide, 20 s", *WIDE, upto(20, 21)),
        two_rods("double pendulum, 50 s", *FAST, upto(50, 26)),
        two_rods("double pendulum, wide, uneven gaps", *WIDE, np.r_[0.0, np.geomspace(1e-3, 12.0, 15)]),
        two_rods("double pendulum, wide, 1000 outputs", *WIDE, upto(10, 1001), tolerances=(1e-5, 1e-9)),
        two_rods("double pendulum, its crossings", *FAST, upto(10, 3)).crossing(down=recorded(16)),
        two_rods("double pendulum, Tsit5", *WIDE, upto(10, 11), method=lj.Tsit5(), order=5, tolerances=(1e-5, 1e-8)),
        two_rods("double pendulum, steps of 1/64", *FAST, upto(4, 9), options=fixed(1 / 64), tolerances=(1e-6,)),
        masses_on_rods(upto(2, 5)),
        masses_on_rods(upto(8, 9)),
        swing("pendulum, 0.01 off the top", np.pi - 0.01, 0.0, upto(8, 17)),
        swing("pendulum, 1e-5 off the top", np.pi - 1e-5, 0.0, upto(12, 13), tolerances=tight),
        swing("pendulum, barely over the top", 0.0, 5.5902, upto(12, 13), tolerances=tight),
        swing("pendulum, 2000 outputs", 2.0, 0.0, upto(20, 2001)),
        swing("pendulum, its crossings", 2.0, 0.0, upto(20, 3)).crossing(down=recorded(32)),
        swing("pendulum, first time down", 3.0, 0.0, upto(20, 41)).crossing(down=falling),
        swing("pendulum, diffrax.Dopri5", 1.5, 0.5, upto(10, 11), method=diffrax.Dopri5(), order=5,
              tolerances=(1e-4, 1e-8)),
        swing("pendulum, steps of 1/16", 1.5, 0.5, upto(10, 6), options=fixed(1 / 16), tolerances=(1e-6,)),
        swing("pendulum, outputs closer than steps of 1/16", 1.5, 0.5, upto(10, 501), options=fixed(1 / 16),
              tolerances=(1e-6,)),
        single(swing("pendulum, float32", 1.5, 0.5, binary, tolerances=(1e-3, 1e-4, 1e-5))),
        single(swing("pendulum 0.0625 off the top, float32", 3.078125, 0.0, binary, tolerances=(1e-4, 1e-5))),
        pushed("driven pendulum, 30", upto(30, 16)),
        pushed("driven pendulum, max_step 0.25", upto(30, 16), options={"max_step": 0.25}, tolerances=(1e-4, 1e-8)),
        two_wells("Duffing, 40", upto(40, 21)),
        two_wells("Duffing, 150", upto(150, 31), tolerances=(1e-5, 1e-8, 1e-11)),
        two_wells("Duffing, Tsit5", upto(40, 11), method=lj.Tsit5(), order=5, tolerances=(1e-5, 1e-8)),
        cubic("Henon-Heiles, regular", REGULAR, upto(100, 21)),
        cubic("Henon-Heiles, chaotic", CHAOTIC, upto(100, 21)),
        cubic("Henon-Heiles, chaotic, 250", CHAOTIC, upto(250, 26), tolerances=(1e-6, 1e-9)),
        cubic("Henon-Heiles, Nystrom8", CHAOTIC, upto(100, 11), method=lj.Nystrom8()),
        cubic("Henon-Heiles, Nystrom12, 500 outputs", REGULAR, upto(50, 501), method=lj.Nystrom12(), order=12),
        cubic("Henon-Heiles, Nystrom8, steps of 1/4", REGULAR, upto(50, 11), method=lj.Nystrom8(), options=fixed(0.25),
              tolerances=(1e-6,)),
        bodies("three bodies, 10", *PYTHAGOREAN, upto(10, 11), tolerances=tight),
        bodies("three bodies, 16", *PYTHAGOREAN, upto(16, 9), tolerances=tight),
        bounces("ball on a soft wall", upto(40, 41)),
        tumbling("rigid body, Euler's angles", SPIN, upto(20, 21), tolerances=few),
        tumbling_quaternion("rigid body, quaternion", SPIN, upto(20, 21), tolerances=(1e-5, 1e-8)),
    ]  # fmt: skip
