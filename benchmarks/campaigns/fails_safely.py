"""Does lagjax fail safely: is every failure reported as one?

About four hundred systems are broken at random, in families: singular, contradictory, an inconsistent start, NaN, an
unreachable tolerance, too few steps, and some that tempt an integrator to continue silently. Each is integrated alone,
where an exception or `lj.AccuracyWarning` reports it, and as a lane of a `vmap`, where its result must not be
`successful`, or its `scaled_error` above 1. Each has a healthy twin from the same generator, which must not be reported
and must be right: within 100 tolerances of a closed form or a first integral.

A result called successful counts as unreported if the broken equations have no solution (`error` is None), or if the
answer is wrong by more than 10,000 tolerances (`WRONG`). lagjax itself warns if a Jacobi integral changes by 1000; an
error of the motion is easily several times that of one integral.

    python -m benchmarks.campaigns.fails_safely [--seed N] [--count N] [--family WORDS] [--json FILE] [--messages]

The exit status is 1 if any broken system goes unreported in either way, or any healthy twin is reported or wrong.
"""

import argparse
import functools
import json
import multiprocessing
import platform
import re
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import quad
from scipy.special import sici

import lagjax as lj

jax.config.update("jax_enable_x64", True)

COUNT = 15
TOLERANCE = 1e-9
RIGHT, WRONG = 100, 10_000
SLOW = 5.0
OUTPUTS = 5


@dataclass(frozen=True, eq=False)
class Program:
    """A program that is compiled once: a system, and the options that are not arrays."""

    system: lj.System
    options: dict[str, Any] = field(default_factory=dict)


@dataclass
class Case:
    """One system with its numbers. `error(traj)` is the error of a trajectory, None if none can be right.

    `named`: a pattern of the names that the report should contain.
    """

    q0: Any
    v0: Any
    params: Any
    end: float
    error: Callable | None = None
    named: str | None = None
    tolerance: float = TOLERANCE
    dt0: float | None = None
    dtype: Any = np.float64

    def arrays(self):
        """The numbers that a compiled program takes."""
        cast = lambda x: np.asarray(x) if np.asarray(x).dtype.kind in "iu" else np.asarray(x, self.dtype)
        ts = np.linspace(0.0, self.end, OUTPUTS)
        numbers = {"q0": self.q0, "v0": self.v0, "params": self.params, "ts": ts, "tolerance": self.tolerance}
        return jax.tree.map(cast, numbers if self.dt0 is None else numbers | {"dt0": self.dt0})


@dataclass(frozen=True)
class Family:
    """Systems that break in one way: `draw(rng, broken)` gives one of them, or its healthy twin."""

    name: str
    program: Program
    draw: Callable[[np.random.Generator, bool], Case]


def log_uniform(rng, low, high):
    """A random number whose logarithm is uniform."""
    return 10.0 ** rng.uniform(np.log10(low), np.log10(high))


def direction(rng, n):
    """A random unit vector."""
    x = rng.normal(size=n)
    return x / np.linalg.norm(x)


def rotation(rng, n):
    """A random orthogonal matrix."""
    return np.linalg.qr(rng.normal(size=(n, n)))[0]


# --- Singular: a mass matrix without inertia in one direction.


def inertia_lagrangian(t, q, v, params):
    """Springs in all directions, masses along the rotated axes."""
    u, x = (params["axes"].T @ jnp.stack([y[name] for name in "abcd"]) for y in (v, q))
    return 0.5 * jnp.sum(params["masses"] * u**2) - 0.5 * jnp.sum(x**2)


inertia = Program(lj.System(inertia_lagrangian))


def massless(rng, broken):
    """A mass that is zero or 1e-15 of the others, along a coordinate or a random direction."""
    masses, j = rng.uniform(0.5, 2.0, 4), rng.integers(4)
    along = rng.integers(2)
    axes = np.eye(4)[rng.permutation(4)] if along else rotation(rng, 4)
    if broken:
        masses[j] = 0.0 if along else rng.choice([0.0, log_uniform(rng, 1e-18, 1e-15)])
    x, u, end = rng.normal(size=4), rng.normal(size=4), rng.uniform(0.5, 3.0)

    def error(traj):
        rate = 1 / np.sqrt(masses)
        y0, u0 = axes.T @ x, axes.T @ u
        t = np.asarray(traj.t)[:, None]
        exact = (y0 * np.cos(rate * t) + u0 / rate * np.sin(rate * t)) @ axes.T
        return np.max(np.abs(np.stack([traj.q[name] for name in "abcd"], axis=-1) - exact)) / np.max(np.abs(exact))

    # It is right to name any coordinate with a share in the massless direction.
    named = "|".join(f"'{name}'" for name, share in zip("abcd", np.abs(axes[:, j])) if share > 0.1)
    by_name = lambda values: dict(zip("abcd", values))
    params = {"masses": masses, "axes": axes}
    return Case(by_name(x), by_name(u), params, end, None if broken else error, named)


# --- A particle on a random quadric in five dimensions: cylinders over ellipsoids, spheres and planes in 2 to 5.


def quadric(t, q, params):
    """qᵀ A q + b·q - c, or with `squared` its square."""
    g = q @ params["A"] @ q + params["b"] @ q - params["c"]
    return jnp.where(params["squared"] > 0, g**2, g)


free_lagrangian = lambda t, q, v, params: 0.5 * jnp.sum(v**2)
on_quadric = Program(lj.System(free_lagrangian, {"surface": lj.Holonomic(quadric)}))


def start_on_quadric(rng):
    """A point and a tangent on a random quadric, its normal there, and the error of a motion on it."""
    n, shape = rng.integers(2, 6), rng.choice(["ellipsoid", "sphere", "plane"])
    A, b, c = np.zeros((5, 5)), np.zeros(5), 1.0
    if shape == "plane":
        b[:n] = direction(rng, n)
        c = rng.normal()
        q = np.concatenate([rng.normal(size=n), rng.normal(size=5 - n)])
        q += (c - b @ q) * b
    else:
        axes, sizes = rotation(rng, n), rng.uniform(0.5, 2.0, n) if shape == "ellipsoid" else np.ones(n)
        A[:n, :n] = axes @ np.diag(sizes**-2) @ axes.T
        q = np.concatenate([direction(rng, n), rng.normal(size=5 - n)])
        q[:n] /= np.sqrt(q @ A @ q)
    normal = 2 * A @ q + b
    v = rng.normal(size=5)
    v -= (v @ normal) / (normal @ normal) * normal
    params = {"A": A, "b": b, "c": c, "squared": 0.0}

    def error(traj):
        q, v = np.asarray(traj.q), np.asarray(traj.v)
        gradient = 2 * q @ A + b
        surface = np.einsum("ti,ij,tj->t", q, A, q) + q @ b - c
        # Joachimsthal's integral of geodesics on a central quadric: |A q|² (vᵀ A v).
        joachimsthal = np.sum((q @ A) ** 2, axis=1) * np.einsum("ti,ij,tj->t", v, A, v)
        defects = [surface, np.sum(gradient * v, axis=1), np.sum(v**2, axis=1) / np.sum(v[0] ** 2) - 1]
        defects.append(joachimsthal / max(joachimsthal[0], 1e-3) - joachimsthal[0] / max(joachimsthal[0], 1e-3))
        return np.max(np.abs(np.stack(defects)))

    return q, v, params, normal / np.linalg.norm(normal), error


def without_a_derivative(rng, broken):
    """The surface given as a square, whose derivative vanishes on it: nothing determines its multiplier."""
    q, v, params, _, error = start_on_quadric(rng)
    params["squared"] = float(broken)
    return Case(q, v, params, rng.uniform(0.5, 2.0), None if broken else error, "'surface'")


def off_in_position(rng, broken):
    """A start off the surface by 1e-6 to 1."""
    q, v, params, normal, error = start_on_quadric(rng)
    q = q + broken * log_uniform(rng, 2e-6, 1.0) * rng.choice([-1, 1]) * normal
    return Case(q, v, params, rng.uniform(0.5, 2.0), None if broken else error, "'surface'")


def off_in_velocity(rng, broken):
    """A start whose velocity leaves the surface by 1e-6 to 1."""
    q, v, params, normal, error = start_on_quadric(rng)
    v = v + broken * log_uniform(rng, 5e-6, 1.0) * rng.choice([-1, 1]) * normal
    return Case(q, v, params, rng.uniform(0.5, 2.0), None if broken else error, "d/dt 'surface'")


def nan_in_a_constraint(rng, broken):
    """A surface with NaN or infinity among its coefficients."""
    q, v, params, _, error = start_on_quadric(rng)
    if broken:
        params[rng.choice(["A", "b"])][rng.integers(5), ...] = rng.choice([np.nan, np.inf])
    return Case(q, v, params, rng.uniform(0.5, 2.0), None if broken else error, "'surface'")


# --- One coordinate next to a harmonic one, in potentials that end somewhere. Each entry: V(b), and its end.

POTENTIALS = (
    ("square root, attracting", lambda n, b, c: c * n.sqrt(1 - b), 1.0),
    ("square root, repelling", lambda n, b, c: -c * n.sqrt(1 - b), 1.0),
    ("arc cosine", lambda n, b, c: c * n.arccos(b), 1.0),
    ("logarithm", lambda n, b, c: c * n.log(b), 0.0),
    ("root behind a where", lambda n, b, c: n.where(b > 0, c * b * n.sqrt(b), 0.0), 0.0),
    ("collision", lambda n, b, c: -c / b, 0.0),
    ("quartic", lambda n, b, c: -c * b**4 / 4, np.inf),
    ("exponential", lambda n, b, c: -c * n.exp(b), np.inf),
)
VANISHING_MASS = len(POTENTIALS)


def potential_lagrangian(t, q, v, params):
    """A harmonic a, and b in one of the potentials or with the mass b."""
    in_potential = [
        lambda b, u, c, potential=potential: 0.5 * u**2 - potential(jnp, b, c) for _, potential, _ in POTENTIALS
    ]
    branches = [*in_potential, lambda b, u, c: 0.5 * b * u**2]
    of_b = jax.lax.switch(params["kind"], branches, q["b"], v["b"], params["c"])
    return 0.5 * v["a"] ** 2 - 0.5 * params["k"] * q["a"] ** 2 + of_b


potentials = Program(lj.System(potential_lagrangian))


def in_potential(rng, broken, kinds):
    """A motion towards the end of its potential: beyond it, or for 0.4 of the time to it."""
    kind = rng.choice(kinds)
    c, k, a0, u0, b0 = rng.uniform(0.5, 2.0), rng.uniform(0.5, 4.0), *rng.normal(size=2), rng.uniform(0.3, 0.7)
    if kind == VANISHING_MASS:
        w0 = -rng.uniform(0.3, 1.0)
        end = -2 * b0 / (3 * w0)
        energy = lambda b, w: 0.5 * b * w**2
    else:
        _, potential, there = POTENTIALS[kind]
        w0 = (1 if there else -1) * (rng.uniform(0.3, 1.0) + (np.sqrt(2 * c) if there else 0.0))
        energy = lambda b, w: 0.5 * w**2 + potential(np, b, c)
        # The time to the end: ∫ db / |b'|, from the energy integral.
        h = energy(b0, w0)
        end = abs(quad(lambda b: 1 / np.sqrt(2 * (h - potential(np, b, c))), b0, min(there, 60.0), limit=200)[0])

    def error(traj):
        t, a = np.asarray(traj.t), np.asarray(traj.q["a"])
        exact = a0 * np.cos(np.sqrt(k) * t) + u0 / np.sqrt(k) * np.sin(np.sqrt(k) * t)
        h = energy(np.asarray(traj.q["b"]), np.asarray(traj.v["b"]))
        return max(np.max(np.abs(a - exact)) / np.hypot(a0, u0), np.max(np.abs(h - h[0])) / (w0**2 + abs(h[0])))

    params = {"kind": int(kind), "c": c, "k": k}
    span = 1.5 * end if broken else 0.4 * end
    return Case({"a": a0, "b": b0}, {"a": u0, "b": w0}, params, span, None if broken else error, "'b'")


def not_finite(rng, broken, where):
    """NaN or infinity in q0, v0 or params."""
    case = in_potential(rng, False, range(VANISHING_MASS + 1))
    if broken:
        tree = getattr(case, where)
        name = rng.choice(["c", "k"] if where == "params" else ["a", "b"])
        if case.params["kind"] == VANISHING_MASS and where == "params":
            name = "k"
        tree[name] = rng.choice([np.nan, np.inf])
        case.error, case.named = None, f"'{name}'" if where != "params" else None
    return case


# --- Singular during the motion: a massless crank's dead centre, the pole of a sphere.


def crank_lagrangian(t, q, v, params):
    """A slider on a spring, and a crank without mass on another."""
    slider = 0.5 * v["x"] ** 2 - 0.5 * params["k"] * q["x"] ** 2
    return slider + 0.5 * params["kappa"] * (params["l"] * jnp.sin(q["crank"])) ** 2


crank = Program(
    lj.System(crank_lagrangian, {"rod": lj.Holonomic(lambda t, q, params: q["x"] - params["l"] * jnp.cos(q["crank"]))})
)


def dead_centre(rng, broken):
    """x = reach cos(w t - phase), w² = k + kappa, with the reach beyond the crank's length or not."""
    length, k, kappa = rng.uniform(0.5, 2.0, 3)
    w, x = np.sqrt(k + kappa), length * rng.uniform(-0.4, 0.4)
    reach = length * (rng.uniform(1.02, 2.0) if broken else rng.uniform(0.5, 0.9))
    phase = np.arccos(x / reach)
    u, angle = w * reach * np.sin(phase), np.arccos(x / length)

    def error(traj):
        return np.max(np.abs(np.asarray(traj.q["x"]) - reach * np.cos(w * np.asarray(traj.t) - phase))) / length

    q0, v0 = {"crank": angle, "x": x}, {"crank": -u / (length * np.sin(angle)), "x": u}
    params = {"k": k, "kappa": kappa, "l": length}
    return Case(q0, v0, params, 1.3 * phase / w if broken else 4 / w, None if broken else error, "'crank'|'rod'")


polar = Program(
    lj.System(lambda t, q, v, params: 0.5 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2), None)
)


def pole(rng, broken):
    """A great circle through the pole, or past it by less than 1e-6; a right answer may continue beyond it."""
    miss = rng.choice([0.0, log_uniform(rng, 1e-17, 1e-6)]) if broken else rng.uniform(0.2, 0.6)
    first, theta = -rng.uniform(0.5, 1.3), rng.uniform(-3.0, 3.0)
    c, s = np.cos(first), np.sin(first)
    distance = np.hypot(np.sin(miss) * c, s)
    q = {"psi": np.arctan2(distance, np.cos(miss) * c), "theta": theta + np.arctan2(s, np.sin(miss) * c)}
    v = {"psi": np.cos(miss) * s / distance, "theta": np.sin(miss) / distance**2}

    def error(traj):
        psi, angle, arc = np.asarray(traj.q["psi"]), np.asarray(traj.q["theta"]) - theta, first + np.asarray(traj.t)
        path = np.stack([np.sin(psi) * np.cos(angle), np.sin(psi) * np.sin(angle), np.cos(psi)])
        exact = np.stack([np.sin(miss) * np.cos(arc), np.sin(arc), np.cos(miss) * np.cos(arc)])
        return np.max(np.abs(path - exact))

    return Case(q, v, {}, rng.uniform(1.6, 2.5), error, "'theta'")


# --- Contradictory: two drives, two velocities, a loop that cannot close, constraints that come apart.


def drive(t, params):
    """The motion that both drives prescribe."""
    return jnp.sin(params["rate"] * t + params["phase"])


def departure(t, params):
    """The difference of the drives: from the start, or from `later` on."""
    after = jnp.maximum(t - params["later"], 0.0)
    powers = jnp.stack([jnp.ones_like(t), t, t**2, after, after**2, after**3])
    return jnp.dot(params["departs"], powers)


two_drives = Program(
    lj.System(
        lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * q["y"] ** 2,
        {
            "left": lj.Holonomic(lambda t, q, params: q["x"] - drive(t, params)),
            "right": lj.Holonomic(lambda t, q, params: q["x"] - drive(t, params) - departure(t, params)),
        },
    )
)


def differing_drives(rng, broken, power):
    """Drives that differ in position, velocity, acceleration, or from a later time on."""
    rate, phase, y, u, end = rng.uniform(0.5, 3.0), rng.uniform(0.0, 6.0), *rng.normal(size=2), rng.uniform(1.0, 3.0)
    departs = np.zeros(6)
    departs[rng.choice(power)] = broken * log_uniform(rng, 1e-4, 1.0)
    params = {"rate": rate, "phase": phase, "departs": departs, "later": end * rng.uniform(0.2, 0.6)}

    def error(traj):
        t = np.asarray(traj.t)
        x = np.abs(np.asarray(traj.q["x"]) - np.sin(rate * t + phase))
        return np.max(np.maximum(x, np.abs(np.asarray(traj.q["y"]) - y * np.cos(t) - u * np.sin(t))))

    q0, v0 = {"x": np.sin(phase), "y": y}, {"x": rate * np.cos(phase), "y": u}
    return Case(q0, v0, params, end, None if broken else error, "'left'|'right'")


two_velocities = Program(
    lj.System(
        lambda t, q, v, params: 0.5 * jnp.dot(v, v) + jnp.dot(params["g"], q),
        {
            "first": lj.Nonholonomic(lambda t, q, v, params: params["n"] @ v - params["a"]),
            "second": lj.Nonholonomic(
                lambda t, q, v, params: params["scale"] * (params["n"] @ v - params["a"] - departure(t, params))
            ),
        },
    )
)


def differing_velocities(rng, broken, power):
    """v·n = a and v·n = b, from the start or from a later time on."""
    n, g, q, v, end = direction(rng, 3), *rng.normal(size=(3, 3)), rng.uniform(1.0, 3.0)
    a, departs = n @ v, np.zeros(6)
    departs[rng.choice(power)] = broken * log_uniform(rng, 1e-4, 1.0)
    params = {"n": n, "g": g, "a": a, "scale": rng.uniform(0.5, 2.0), "departs": departs, "later": 0.5 * end}

    def error(traj):
        t = np.asarray(traj.t)[:, None]
        return np.max(np.abs(np.asarray(traj.q) - q - v * t - 0.5 * (g - (n @ g) * n) * t**2))

    return Case(q, v, params, end, None if broken else error, "'first'|'second'")


def closure(t, q, params):
    """The coupler's squared length."""
    a, b, c, d = (params[name] for name in "abcd")
    along = d + c * jnp.cos(q["output"]) - a * jnp.cos(q["input"])
    across = c * jnp.sin(q["output"]) - a * jnp.sin(q["input"])
    return along**2 + across**2 - b**2


four_bar = Program(
    lj.System(
        lambda t, q, v, params: 0.5 * (v["input"] ** 2 + v["output"] ** 2),
        {
            "coupler": lj.Holonomic(closure),
            "motor": lj.Holonomic(lambda t, q, params: q["input"] - params["start"] - t),
        },
    )
)


def past_its_reach(rng, broken):
    """A driven four-bar whose coupler and output are stretched at the input angle `last`; driven past it or not."""
    a, d, last, share = 1.0, rng.uniform(1.5, 2.0), rng.uniform(1.0, 2.4), rng.uniform(0.46, 0.54)
    reach = lambda angle: np.sqrt(a**2 + d**2 - 2 * a * d * np.cos(angle))
    b, c, start = share * reach(last), (1 - share) * reach(last), 0.4 * last

    def output(angle):
        along, across = a * np.cos(angle) - d, a * np.sin(angle)
        e = np.hypot(along, across)
        return np.arctan2(across, along) - np.arccos((c**2 + e**2 - b**2) / (2 * c * e))

    def error(traj):
        return np.max(np.abs(np.exp(1j * np.asarray(traj.q["output"])) - np.exp(1j * output(start + traj.t))))

    first = output(start)
    link = np.array([d + c * np.cos(first) - a * np.cos(start), c * np.sin(first) - a * np.sin(start)])
    ahead = lambda angle: np.array([-np.sin(angle), np.cos(angle)])
    rate = a * (link @ ahead(start)) / (c * (link @ ahead(first)))
    q0, v0 = {"input": start, "output": first}, {"input": 1.0, "output": rate}
    params = {"a": a, "b": b, "c": c, "d": d, "start": start}
    return Case(q0, v0, params, last + 0.5 - start if broken else 0.7 * last - start, None if broken else error,
                "'coupler'|'motor'|'output'")  # fmt: skip


coming_apart = Program(
    lj.System(
        free_lagrangian,
        {
            "line": lj.Holonomic(lambda t, q, params: params["n"] @ q),
            "curve": lj.Holonomic(
                lambda t, q, params: params["n"] @ q - params["bend"] * jnp.maximum(params["s"] @ q, 0.0) ** 3
            ),
        },
    )
)


def no_longer_redundant(rng, broken):
    """A line and a curve that agree for x < 0: beyond, the two meet nowhere."""
    s = direction(rng, 2)
    n, x, u = np.array([-s[1], s[0]]), -rng.uniform(0.3, 1.0), rng.uniform(0.5, 1.5)
    params = {"n": n, "s": s, "bend": broken * log_uniform(rng, 1e-2, 1.0)}

    def error(traj):
        return np.max(np.abs(np.asarray(traj.q) - (x + u * np.asarray(traj.t))[:, None] * s))

    return Case(x * s, u * s, params, -3 * x / u, None if broken else error, "'line'|'curve'")


def coupler(t, q, params):
    """The coupler of a parallelogram of cranks r, as long as the ground link."""
    r = params["r"]
    along = 1 + r * jnp.cos(q["right"]) - r * jnp.cos(q["left"])
    return along**2 + (r * (jnp.sin(q["right"]) - jnp.sin(q["left"]))) ** 2 - 1


parallelogram = Program(
    lj.System(
        lambda t, q, v, params: (
            0.5 * (v["left"] ** 2 + params["inertia"] * v["right"] ** 2) + params["torque"] * q["left"]
        ),
        {"coupler": lj.Holonomic(coupler)},
    )
)


def flat_position(rng, broken):
    """A parallelogram, driven by a torque, through its flat position, where it could also fold: both cranks turn alike.

    The coupler's force passes through infinity there, without effect on the motion.
    """
    r, angle, rate = rng.uniform(0.3, 0.9), rng.uniform(0.5, 2.5), rng.uniform(0.5, 2.0)
    inertia_of_right, torque = rng.uniform(0.5, 2.0), rng.choice([0.0, rng.uniform(0.1, 1.0)])
    if broken and not torque:
        angle = np.pi * rng.choice([0.25, 0.5, 0.75])  # Steps may then end on the flat position to the last digit.
    to_flat = (np.pi - angle) / rate
    acceleration = torque / (1 + inertia_of_right)
    end = rng.uniform(1.5, 4.0) * to_flat if broken else 0.8 * to_flat / (1 + acceleration * to_flat / rate)

    def error(traj):
        t = np.asarray(traj.t)
        exact = angle + rate * t + 0.5 * acceleration * t**2
        return max(np.max(np.abs(np.asarray(traj.q[name]) - exact)) for name in ("left", "right"))

    params = {"r": r, "inertia": inertia_of_right, "torque": torque}
    return Case({"left": angle, "right": angle}, {"left": rate, "right": rate}, params, end, error, "'coupler'")


# --- Unreachable: forces that no step resolves, tolerances below round-off, steps too long or too few, long spans.

# Each: the force at s = t1 - t, its integral over s, and whether the motion exists beyond t1.
FORCES = (
    ("inverse root", lambda n, s: 1 / n.sqrt(n.abs(s)), lambda s: 2 * np.sign(s) * np.sqrt(np.abs(s)), True),
    ("logarithm", lambda n, s: n.log(n.abs(s)), lambda s: s * np.log(np.abs(s)) - s, True),
    ("ever faster", lambda n, s: n.sin(1 / s), lambda s: s * np.sin(1 / s) - sici(1 / np.abs(s))[1], True),
    ("jump", lambda n, s: n.sign(s), np.abs, True),
    ("pole", lambda n, s: 1 / s, lambda s: np.log(np.abs(s)), False),
    ("double pole", lambda n, s: 1 / s**2, lambda s: -1 / s, False),
)


def timed_force(t, q, v, params):
    """One of the forces."""
    branches = [lambda s, force=force: force(jnp, s) for _, force, _, _ in FORCES]
    return {"x": params["c"] * jax.lax.switch(params["kind"], branches, params["t1"] - t)}


timed = Program(lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2, force=timed_force))


def force_in_time(rng, broken, kinds):
    """A force that is singular at t1, integrated past t1 or until 0.7 of it. The velocity is an integral."""
    kind, c, t1, x, u = rng.choice(kinds), rng.uniform(0.5, 2.0), rng.uniform(0.5, 2.0), *rng.normal(size=2)
    _, _, integral, goes_on = FORCES[kind]

    def error(traj):
        exact = u + c * (integral(t1) - integral(t1 - np.asarray(traj.t)))
        return np.max(np.abs(np.asarray(traj.v["x"]) - exact)) / (1 + np.max(np.abs(exact)))

    params = {"kind": int(kind), "c": c, "t1": t1}
    return Case({"x": x}, {"x": u}, params, rng.uniform(1.2, 3.0) * t1 if broken else 0.7 * t1,
                error if goes_on or not broken else None, "'x'")  # fmt: skip


def oscillator_lagrangian(t, q, v, params):
    """Two oscillators."""
    return 0.5 * (v["a"] ** 2 + v["b"] ** 2) - 0.5 * (params["k"] * q["a"] ** 2 + q["b"] ** 2)


oscillator_system = lj.System(oscillator_lagrangian)
# Without this limit an unreachable tolerance would be tried a million times.
oscillator = Program(oscillator_system, {"max_steps": 2**16})
few_steps = Program(oscillator_system, {"max_steps": 16})
fixed_explicit = Program(
    oscillator_system, {"method": diffrax.Tsit5(), "stepsize_controller": diffrax.ConstantStepSize()}
)


def oscillation(rng, end):
    """Two oscillators of random amplitude; `k` is that of the faster one."""
    k, (a, b, u, w) = rng.uniform(1.0, 9.0), rng.normal(size=4)

    def error(traj):
        t = np.asarray(traj.t, np.float64)
        faster = a * np.cos(np.sqrt(k) * t) + u / np.sqrt(k) * np.sin(np.sqrt(k) * t)
        slower = b * np.cos(t) + w * np.sin(t)
        defects = np.stack([np.asarray(traj.q["a"]) - faster, np.asarray(traj.q["b"]) - slower])
        return np.max(np.abs(defects)) / np.max(np.abs([a, b, u, w]))

    return Case({"a": a, "b": b}, {"a": u, "b": w}, {"k": k}, end, error)


def below_round_off(rng, broken):
    """A tolerance below float64's round-off."""
    case = oscillation(rng, rng.uniform(1.0, 3.0))
    if broken:
        case.tolerance, case.error, case.named = log_uniform(rng, 1e-30, 1e-15), None, "rtol"
    return case


def below_round_off_in_float32(rng, broken):
    """A tolerance below float32's round-off."""
    case = oscillation(rng, rng.uniform(1.0, 3.0))
    case.dtype, case.tolerance = np.float32, 1e-5
    if broken:
        case.tolerance, case.error, case.named = log_uniform(rng, 1e-20, 5e-7), None, "rtol"
    return case


def many_periods_in_float32(rng, broken):
    """500 to 1500 periods in float32."""
    case = oscillation(rng, 2 * np.pi * (rng.uniform(500, 1500) if broken else rng.uniform(0.2, 0.5)))
    case.dtype, case.tolerance = np.float32, 1e-5
    return case


def too_few_steps(rng, broken):
    """16 steps for 20 to 200 periods, or for a tenth of one."""
    case = oscillation(rng, 2 * np.pi * (log_uniform(rng, 20, 200) if broken else 0.1))
    case.named = "max_steps"
    return case


def unstable_steps(rng, broken):
    """Forty explicit steps of 2 to 20 radians, beyond Tsit5's stability limit, or of 0.02."""
    case = oscillation(rng, 1.0)
    case.dt0 = (rng.uniform(4.0, 20.0) if broken else 0.02) / np.sqrt(case.params["k"])
    case.end = 40 * case.dt0
    return case


damped = Program(
    lj.System(
        lambda t, q, v, params: 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2,
        dissipation=lambda t, q, v, params: 0.5 * params["c"] * v["x"] ** 2,
    ),
    {"method": diffrax.Tsit5(), "stepsize_controller": diffrax.ConstantStepSize()},
)


def unstable_damped_steps(rng, broken):
    """Forty steps of 4 to 20 decay times: damping beyond Tsit5's stability limit, without a conserved energy."""
    c, (x, u) = rng.uniform(5.0, 50.0), rng.normal(size=2)
    dt = (rng.uniform(4.0, 20.0) if broken else 0.01) / c

    def error(traj):
        t, root = np.asarray(traj.t), np.sqrt(c**2 / 4 - 1)
        slow, fast = -c / 2 + root, -c / 2 - root
        first = (u - fast * x) / (slow - fast)
        return np.max(np.abs(np.asarray(traj.q["x"]) - first * np.exp(slow * t) - (x - first) * np.exp(fast * t)))

    return Case({"x": x}, {"x": u}, {"c": c}, 40 * dt, error, dt0=dt)


implicit_pendulum = Program(
    lj.System(lambda t, q, v, params: 0.5 * v["angle"] ** 2 + params["k"] * jnp.cos(q["angle"])),
    {
        "method": diffrax.Kvaerno5(root_finder=diffrax.VeryChord(rtol=1e-9, atol=1e-9, norm=optx.max_norm)),
        "stepsize_controller": diffrax.ConstantStepSize(),
    },
)


def long_implicit_steps(rng, broken):
    """A pendulum in forty implicit steps of 0.3 to 30 radians, or of 0.01."""
    k, angle = rng.uniform(1.0, 100.0), rng.uniform(0.5, 3.0)
    dt = (log_uniform(rng, 0.3, 30.0) if broken else 0.01) / np.sqrt(k)

    def error(traj):
        energy = 0.5 * np.asarray(traj.v["angle"]) ** 2 - k * np.cos(np.asarray(traj.q["angle"]))
        return np.max(np.abs(energy + k * np.cos(angle))) / k

    return Case({"angle": angle}, {"angle": 0.0}, {"k": k}, 40 * dt, error, dt0=dt)


drifting = Program(
    lj.System(
        lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"],
        {"rod": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2)},
    ),
    {"drift": "none"},
)


def long_without_projection(rng, broken):
    """A Cartesian pendulum over 1000 to 10,000 radians without projection: is it still on its rod?"""
    g, length, angle = rng.uniform(5.0, 10.0), rng.uniform(0.5, 2.0), rng.uniform(-1.5, 1.5)
    end = (log_uniform(rng, 1000, 10_000) if broken else 1.0) / np.sqrt(g / length)

    def error(traj):
        return np.max(np.abs(np.asarray(traj.q["x"]) ** 2 + np.asarray(traj.q["y"]) ** 2 - length**2)) / length**2

    q0 = {"x": length * np.sin(angle), "y": -length * np.cos(angle)}
    return Case(q0, {"x": 0.0, "y": 0.0}, {"g": g, "l": length}, end, error, tolerance=1e-6)


def _family(name, program, draw, **keywords):
    return Family(name, program, functools.partial(draw, **keywords))


FAMILIES = (
    _family("singular: a massless direction", inertia, massless),
    _family("singular: a constraint without a derivative", on_quadric, without_a_derivative),
    _family("singular later: a mass that vanishes", potentials, in_potential, kinds=(VANISHING_MASS,)),
    _family("singular later: a massless crank's dead centre", crank, dead_centre),
    _family("singular later: the pole of a sphere", polar, pole),
    _family("contradictory: drives, from the start", two_drives, differing_drives, power=(0, 1, 2)),
    _family("contradictory: drives, later", two_drives, differing_drives, power=(3, 4, 5)),
    _family("contradictory: velocities, from the start", two_velocities, differing_velocities, power=(0, 1)),
    _family("contradictory: velocities, later", two_velocities, differing_velocities, power=(3, 4)),
    _family("contradictory: a four-bar past its reach", four_bar, past_its_reach),
    _family("contradictory: no longer redundant", coming_apart, no_longer_redundant),
    _family("inconsistent start: position", on_quadric, off_in_position),
    _family("inconsistent start: velocity", on_quadric, off_in_velocity),
    _family("NaN: roots, logarithms, arc cosines", potentials, in_potential, kinds=(0, 1, 2, 3, 4)),
    _family("NaN: head-on collisions", potentials, in_potential, kinds=(5,)),
    _family("NaN: in q0", potentials, not_finite, where="q0"),
    _family("NaN: in v0", potentials, not_finite, where="v0"),
    _family("NaN: in params", potentials, not_finite, where="params"),
    _family("NaN: in a constraint's params", on_quadric, nan_in_a_constraint),
    _family("unreachable: tolerance below float64", oscillator, below_round_off),
    _family("unreachable: tolerance below float32", oscillator, below_round_off_in_float32),
    _family("unreachable: infinity in finite time", potentials, in_potential, kinds=(6, 7)),
    _family("unreachable: a pole in the force", timed, force_in_time, kinds=(4, 5)),
    _family("unreachable: an unresolved force", timed, force_in_time, kinds=(0, 1, 2, 3)),
    _family("unreachable: long implicit steps", implicit_pendulum, long_implicit_steps),
    _family("too few steps", few_steps, too_few_steps),
    _family("tempting: a parallelogram lies flat", parallelogram, flat_position),
    _family("tempting: unstable explicit steps", fixed_explicit, unstable_steps),
    _family("tempting: unstable steps, damped", damped, unstable_damped_steps),
    _family("tempting: long without projection", drifting, long_without_projection),
    _family("tempting: many periods in float32", oscillator, many_periods_in_float32),
)


@dataclass
class Verdict:
    """The result of one case, alone or as a lane: what was reported, and whether that was right."""

    case: Case
    way: str
    report: str | None
    error: float
    named: bool
    seconds: float
    crashed: bool = False

    @property
    def wrong(self):
        """Whether the answer is wrong, or there should be none."""
        return self.case.error is None or not self.error <= WRONG * self.case.tolerance

    @property
    def unreported(self):
        """Whether a wrong answer was presented as right, or the report crashed."""
        return self.crashed or (self.report is None and self.wrong)

    @property
    def false_alarm(self):
        """Whether a healthy case was reported, or is wrong."""
        return self.report is not None or not self.error <= RIGHT * self.case.tolerance


def integrate(program, numbers, throw):
    """The call that is judged."""
    given = {name: numbers[name] for name in ("ts", "dt0") if name in numbers}
    tolerance = numbers["tolerance"]
    return lj.integrate(program.system, numbers["q0"], numbers["v0"], numbers["params"], **given,
                        rtol=tolerance, atol=tolerance, throw=throw, **program.options)  # fmt: skip


@functools.cache
def in_lanes(program):
    """The same, compiled for a batch."""
    return jax.jit(jax.vmap(lambda numbers: integrate(program, numbers, throw=False)))


def alone(program, case) -> Verdict:
    """Integrate one case by itself."""
    report, error, crashed = None, np.nan, False
    started = time.perf_counter()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            traj = integrate(program, case.arrays(), throw=True)
        except (ValueError, RuntimeError) as failure:
            report = f"{type(failure).__name__}: {failure}"
        except Exception as failure:  # Any other kind is not a report but a finding.
            report, crashed = f"{type(failure).__name__}: {failure}", True
    seconds = time.perf_counter() - started
    if report is None:
        error = _error(case, traj)
        messages = [str(w.message) for w in caught if issubclass(w.category, lj.AccuracyWarning)]
        report = f"AccuracyWarning: {messages[0]}" if messages else None
    return Verdict(case, "alone", report, error, _named(case, report), seconds, crashed)


def side_by_side(program, cases) -> list[Verdict]:
    """Integrate cases as lanes of one batch; `seconds` is the time of the batch."""
    numbers = jax.tree.map(lambda *leaves: np.stack(leaves), *(case.arrays() for case in cases))
    started = time.perf_counter()
    batch = jax.tree.map(np.asarray, in_lanes(program)(numbers))
    seconds = time.perf_counter() - started
    verdicts = []
    for i, case in enumerate(cases):
        lane = jax.tree.map(lambda x: np.asarray(x[i]), batch)
        report = None if lane.result == lj.RESULTS.successful else lj.RESULTS[lane.result]
        if report is None and lane.scaled_error > 1:
            report = f"scaled error {float(lane.scaled_error):.2g}"
        verdicts.append(Verdict(case, "lane", report, _error(case, lane) if report is None else np.nan, False, seconds))
    return verdicts


def _error(case, traj):
    return np.nan if case.error is None else float(case.error(traj))


def _named(case, report):
    return bool(report and case.named and re.search(case.named, report))


def judge(family, rng, count) -> tuple[list[Verdict], list[Verdict]]:
    """Draw broken cases and as many healthy twins, and integrate all of them alone and as lanes."""
    broken = [family.draw(rng, True) for _ in range(count)]
    healthy = [family.draw(rng, False) for _ in range(count)]
    lanes = side_by_side(family.program, broken + healthy)
    singly = [alone(family.program, case) for case in broken + healthy]
    return singly[:count] + lanes[:count], singly[count:] + lanes[count:]


def reproduction(family, verdict) -> str:
    """The call that reproduces a finding."""
    case = verdict.case
    plain = jax.tree.map(lambda x: np.asarray(x).tolist(), {"q0": case.q0, "v0": case.v0, "params": case.params})
    program = next(name for name, value in globals().items() if value is family.program)
    parts = [f"{name}={value!r}" for name, value in plain.items()]
    parts += [f"end={float(case.end)!r}", f"tolerance={float(case.tolerance)!r}"]
    parts += [f"dt0={float(case.dt0)!r}"] if case.dt0 is not None else []
    parts += ["dtype=np.float32"] if case.dtype == np.float32 else []
    outcome = "successful" if verdict.report is None else verdict.report.splitlines()[0]
    heading = f"  {family.name}, {verdict.way}: {outcome}; error {verdict.error:.2g}"
    return f"{heading}\n    alone({program}, Case({', '.join(parts)}))"


def rates(family, broken, healthy) -> dict:
    """The row of a family."""
    of = lambda verdicts, way: [v for v in verdicts if v.way == way]
    reported = lambda way: sum(not v.unreported for v in of(broken, way)) / len(of(broken, way))
    nameable = [v for v in of(broken, "alone") if v.case.named and v.report]
    return {
        "family": family.name,
        "cases": len(of(broken, "alone")),
        "right": sum(v.report is None and not v.wrong for v in of(broken, "alone")),
        "alone": reported("alone"),
        "lanes": reported("lane"),
        "named": f"{sum(v.named for v in nameable)}/{len(nameable)}" if nameable else "-",
        "false": sum(v.false_alarm for v in healthy),
        "worst": max((v.error / v.case.tolerance for v in healthy if v.report is None), default=np.nan),
    }


def outcomes_of(task):
    """The rows, findings, slow cases and different reports of families, in a separate process."""
    outcomes = []
    indices, seed, count = task
    for index in indices:
        family, began = FAMILIES[index], time.perf_counter()
        broken, healthy = judge(family, np.random.default_rng([seed, index]), count)
        row = rates(family, broken, healthy) | {"seconds": time.perf_counter() - began}
        findings = [v for v in broken if v.unreported] + [v for v in healthy if v.false_alarm]
        # The first case of each outcome includes compilation: only a case that is slow again counts as slow.
        slow = [v for v in broken + healthy if v.way == "alone" and v.seconds > SLOW]
        slow = [v for v in slow if alone(family.program, v.case).seconds > SLOW]
        reports = sorted({_anonymous(v.report) for v in broken if v.report})
        outcomes.append((row, *([reproduction(family, v) for v in group] for group in (findings, slow)), reports))
    return outcomes


def main():
    """Judge every family and print the table, then the findings."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=COUNT, help="broken systems per family, and as many healthy ones")
    parser.add_argument("--family", default="", help="only families with these words in their name")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--json", help="also write the rows there")
    parser.add_argument("--messages", action="store_true", help="print each family's different reports")
    options = parser.parse_args()
    machine = f"{platform.processor() or platform.machine()}, JAX {jax.__version__}, diffrax {diffrax.__version__}"
    print(f"{machine}; seed {options.seed}. right: went on, and rightly so; named: of the reports that could name;")
    print("false: alarms among the healthy twins, or wrong ones; error: the healthy twins' worst, in tolerances")
    print(f"{'family':48s} cases  right  alone  lanes   named  false    error   time")
    chosen = [index for index, family in enumerate(FAMILIES) if options.family in family.name]
    programs = {}
    for index in chosen:
        programs.setdefault(FAMILIES[index].program, []).append(index)
    started, table, findings, slow = time.perf_counter(), [], [], []
    # Nearly all of the time is compilation on one core, so families that share a program stay together.
    with multiprocessing.get_context("spawn").Pool(options.workers) as pool:
        tasks = [(indices, options.seed, options.count) for indices in programs.values()]
        for outcomes in pool.imap_unordered(outcomes_of, tasks):
            for row, found, late, reports in outcomes:
                table.append(row)
                findings += found
                slow += late
                print("{family:48s} {cases:5d}  {right:5d}  {alone:5.0%}  {lanes:5.0%} {named:>7s}  {false:5d}  "
                      "{worst:7.1g} {seconds:4.1f} s".format(**row), flush=True)  # fmt: skip
                for report in reports if options.messages else []:
                    print("      " + report.replace("\n", "\n      "))
    cases, seconds = sum(row["cases"] for row in table), time.perf_counter() - started
    score = {way: sum(row[way] * row["cases"] for row in table) / cases for way in ("alone", "lanes")}
    false = sum(row["false"] for row in table)
    print(f"{cases} broken systems: {score['alone']:.2%} reported alone, {score['lanes']:.2%} in lanes; "
          f"{false} false alarms among {2 * cases}; {seconds:.0f} s")  # fmt: skip
    for title, found in (("Findings:", findings), ("Slow:", slow)):
        if found:
            print(
                title,
                "    from numpy import inf, nan; from benchmarks.campaigns.fails_safely import *",
                *found,
                sep="\n",
            )
    rows = [{"what": f"{row['family']}, reported {way}", "value": row[way], "target": 1.0, "met": row[way] == 1}
            for row in table for way in ("alone", "lanes")]  # fmt: skip
    rows += [{"what": f"all, reported {way}", "value": value, "target": 1.0, "met": value == 1}
             for way, value in score.items()]  # fmt: skip
    rows.append({"what": "false alarms", "value": false, "target": 0, "met": false == 0})
    if options.json:
        with open(options.json, "w") as file:
            json.dump({"machine": machine, "rows": rows}, file, indent=1)
    sys.exit(0 if all(row["met"] for row in rows) else 1)


def _anonymous(report):
    return re.sub(r"-?\d+\.?\d*(e[-+]?\d+)?", "#", report)


if __name__ == "__main__":
    main()
