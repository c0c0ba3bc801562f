"""The systems of `learned.py`: the truth, its measurements, and how a record is cut into windows.

    published    the double pendulum of Cranmer et al. (2020): unit masses and lengths, g = 9.8. States and their
                 accelerations, angles in one turn and rates of ±10, as many as a model uses in its time
    stars        V = ½ (x² + y²) + x² y - y³/3, a star's motion across a galaxy (Hénon & Heiles 1964), at energies
                 up to 1/6.05, just below 1/6, above which it escapes: chaotic nearly everywhere
    damped       the double pendulum with g = 1 and viscous friction in both joints

The last two have 16 records of positions, four natural times (2π) long, with errors of 0.002, cut into windows of 2.
The initial state of a window comes from a polynomial through the positions near it, and is trained with the weights.
The measured pendulum is in `pendulum.py`.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

import lagjax as lj
from benchmarks.learned.models import Setting

NATURAL, STEP, RECORDS, LENGTH, SIGMA = 2 * np.pi, 0.1, 16, 4, 0.002
WINDOW = 21


class Truth(NamedTuple):
    """A system with its L; `starts(random, count)` -> q0, v0, (count, n) draws initial states of its motions."""

    setting: Setting
    system: lj.System
    params: Any
    starts: Any


class Windows(NamedTuple):
    """Positions `q` (W, K, n) at times `ts` (K,); a smoother's `start` (W, 2, n) and its errors `spread` (2, 1).

    `states` are the smoother's q, v and a, (N, n) each, at all measurements except those at the ends of a record.
    """

    ts: np.ndarray
    q: np.ndarray
    start: np.ndarray
    spread: np.ndarray
    states: tuple


def double_lagrangian(t, q, v, params):
    """Unit masses and lengths, angles from the vertical; V = 0 if both rods are horizontal."""
    across = v[0] * v[1] * jnp.cos(q[0] - q[1])
    return v[0] ** 2 + 0.5 * v[1] ** 2 + across + params["g"] * (2 * jnp.cos(q[0]) + jnp.cos(q[1]))


def double_mass(q):
    """M of it."""
    across = jnp.cos(q[0] - q[1])
    return jnp.stack([jnp.stack([jnp.full_like(across, 2.0), across]), jnp.stack([across, jnp.ones_like(across)])])


def joints(t, q, v, params):
    """R of viscous friction in both joints."""
    return 0.5 * params["c"] * (v[0] ** 2 + (v[1] - v[0]) ** 2)


def star_lagrangian(t, q, v, params):
    """A unit mass in the plane."""
    x, y = q
    return 0.5 * jnp.sum(v**2) - 0.5 * (x**2 + y**2) - params["depth"] * (x**2 * y - y**3 / 3)


def star_starts(random, count):
    """Initial states on the line x = 0, at one energy, in all directions."""
    y, direction = random.uniform(-0.3, 0.3, count), random.uniform(0.2, 1.2, count)
    speed = np.sqrt(2 * (1 / 6.05 - 0.5 * y**2 + y**3 / 3))
    return np.stack([0 * y, y], 1), np.stack([speed * np.cos(direction), speed * np.sin(direction)], 1)


def turned(q):
    """Sines and cosines of angles."""
    return jnp.concatenate([jnp.sin(q), jnp.cos(q)])


def released(low, high):
    """A function that draws initial states at rest within a box."""
    return lambda random, count: (random.uniform(low, high, (count, 2)), np.zeros((count, 2)))


PUBLISHED = Truth(
    Setting("double pendulum", 2, turned, 5.0, 10.0, double_mass), lj.System(double_lagrangian), {"g": 9.8},
    # As in the authors' code: angles in one turn, rates up to 0.1.
    lambda random, count: (random.uniform(0, 2 * np.pi, (count, 2)), random.uniform(0, 0.1, (count, 2))),
)  # fmt: skip
STARS = Truth(
    Setting("Hénon-Heiles", 2, lambda q: jnp.asarray(q), 0.4, 1 / 6, lambda q: jnp.eye(2, dtype=q.dtype)),
    lj.System(star_lagrangian),
    {"depth": 1.0},
    star_starts,
)
DAMPED = Truth(
    Setting("damped double pendulum", 2, turned, 1.5, 1.0, double_mass, friction=True),
    lj.System(double_lagrangian, dissipation=joints), {"g": 1.0, "c": 0.05}, released(-2.2, 2.2),
)  # fmt: skip


def accelerations(truth, q, v):
    """Of many states."""
    params = jax.tree.map(lambda x: jnp.asarray(x, q.dtype), truth.params)
    return jax.vmap(lambda q, v: lj.accelerations(truth.system, jnp.zeros((), q.dtype), q, v, params)[0])(q, v)


def energy(truth, q, v):
    """The true energy of states (..., n), which for a natural system is its Jacobi integral."""
    n = np.shape(q)[-1]
    of = lambda q, v: lj.jacobi_integral(truth.system, jnp.zeros(()), q, v, truth.params)
    found = jax.jit(jax.vmap(of))(jnp.reshape(q, (-1, n)), jnp.reshape(v, (-1, n)))
    return np.asarray(found).reshape(np.shape(q)[:-1])


def motions(truth, q0, v0, ts, tolerance=1e-10):
    """The true motions from these initial states, (count, T, n)."""
    one = lambda q0, v0: lj.integrate(truth.system, q0, v0, truth.params, ts=ts, rtol=tolerance, atol=tolerance)
    found = jax.jit(jax.vmap(one))(q0, v0)
    return np.asarray(found.q), np.asarray(found.v)


def growth(truth, q0, v0, ts, nudge=1e-8):
    """How far motions separate whose initial states differ by `nudge`, (count, T): the limit of predictability."""
    one, two = motions(truth, q0, v0, ts)[0], motions(truth, q0 + nudge, v0, ts)[0]
    return np.abs(one - two).max(axis=2)


def published_states(key, count, dtype=jnp.float32):
    """Angles in one turn, rates of ±10, and their accelerations."""
    one, two = jax.random.split(key)
    q = jax.random.uniform(one, (count, 2), dtype) * 2 * jnp.pi
    v = (jax.random.uniform(two, (count, 2), dtype) - 0.5) * 20
    return q, v, accelerations(PUBLISHED, q, v)


def measured(truth, seed):
    """Windows cut from records of positions."""
    random = np.random.default_rng(seed)
    ts = np.arange(0.0, LENGTH * NATURAL, STEP)
    q, _ = motions(truth, *truth.starts(random, RECORDS), ts)
    return windows(q + SIGMA * random.standard_normal(q.shape), STEP, WINDOW, SIGMA)


def windows(records, step, length, sigma, across=11, degree=5, every=None):
    """Cut records (R, T, n) of equal steps; windows start at each `every`-th sample, by default at the last's end."""
    smooth = [
        savgol_filter(records, across, degree, deriv=order, delta=step, axis=1) for order in range(3)
    ]  # fmt: skip
    edge = across // 2
    begin = np.arange(edge, records.shape[1] - length - edge, every or length - 1)
    cut = np.stack([records[:, i : i + length] for i in begin], axis=1).reshape(-1, length, records.shape[-1])
    start = np.stack([np.stack([x[:, i] for x in smooth[:2]], axis=1) for i in begin], axis=1)
    inside = [x[:, edge : records.shape[1] - edge].reshape(-1, records.shape[-1]) for x in smooth]
    # A smoother scales white errors by the norm of its weights.
    spike = np.zeros(2 * across + 1)
    spike[across] = 1.0
    spread = [
        [sigma * np.linalg.norm(savgol_filter(spike, across, degree, deriv=order, delta=step))] for order in range(2)
    ]  # fmt: skip
    return Windows(
        np.arange(length) * step, cut, start.reshape(-1, 2, records.shape[-1]), np.array(spread), tuple(inside)
    )
