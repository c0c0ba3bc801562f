"""Where the search for a path begins: the straight line, waves on it, what is given, and ways down from saddles.

**Ways down**: from a saddle, or from a start where Newton's method fails, to a path of less action.

Newton's method finds stationary paths of every kind, and keeps to the one that it is near. The discrete action of the
same elements (`elements.py`) is followed down instead: in its eigenvectors relative to the kinetic energy of
displacements, P, which knows no units,

    H v = w P v,    step = -Σ (v·g) / (|w| + μ) v,    μ so that the step stays within a radius of trust

On holonomic constraints all is taken on displacements that these allow, with the multipliers in H, and nodes are
returned to them after each step. What it ends at is a start for Newton's method, which alone says what is an answer.

Source: Conn, Gould & Toint, *Trust Region Methods*, ch. 7; Milnor, *Morse Theory*, §3 (below a saddle lies another
critical point, where the action has a lower bound).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.interpolate import CubicHermiteSpline
from scipy.linalg import eigh

from lagjax.integrate import Trajectory
from lagjax.jaxtools import compiled, numpy_of
from lagjax.refusals import must_be, must_be_whole
from lagjax.system import Model, coordinates
from lagjax.two_points import mesh
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import FIXED, Ends, Path, PathEquations, equations, path_through

# The degree of elements.
DEGREE = 8
# Random waves on a straight start, in units of each coordinate's size.
WAVES, AMPLITUDES = 3, (1.0, 0.5, 0.25)
# Where along the straight line masses and forces are looked at; a change by which L shows what it depends on.
PLACES, ELSEWHERE = np.array([0.1, 0.37, 0.61, 0.93]), 1.3
TURN = 2 * np.pi


class Nodes(NamedTuple):
    """The nodes (K, s, n) of elements of equal length."""

    x: np.ndarray


class PathGuess(NamedTuple):
    """A start by name: a path q(t), a motion, nodes, or the waves (w, n) on the straight line; None for the line."""

    name: str
    path: Any = None


# How many starts, or which ones.
Starts = int | Callable | Trajectory | Sequence[Callable | Trajectory | PathGuess]


def guesses_of(model: Model, starts: Starts) -> list[PathGuess]:
    """The starts that are asked for."""
    if callable(starts) or isinstance(starts, Trajectory):
        return [PathGuess("the given path", starts)]
    claim = "starts must be a number of starts, a path q(t), a motion of integrate, or a list of these"
    must_be(int | np.integer | Sequence, starts, claim, "starts=8")
    if not isinstance(starts, int | np.integer):
        named = enumerate(starts, start=1)
        return [start if isinstance(start, PathGuess) else PathGuess(f"given path {i}", start) for i, start in named]
    must_be_whole(starts, "starts", fix="starts=1, the straight line")
    random = np.random.default_rng(0)
    waves = [waves_of(random, AMPLITUDES[i % 3], np.ones(model.n)) for i in range(starts - 1)]
    return [PathGuess("straight line"), *(PathGuess(f"random start {i + 1}", wave) for i, wave in enumerate(waves))]


def waves_of(random: np.random.Generator, amplitude: float, sizes: np.ndarray) -> np.ndarray:
    """Random amplitudes (w, n) of waves, the shorter the smaller, in units of these sizes."""
    falling = 1 / np.arange(1, WAVES + 1)[:, None]
    return amplitude * falling * random.normal(size=(WAVES, sizes.size)) * sizes


def course_of(motion: Trajectory) -> Callable:
    """The positions of a motion as a function of time, between its outputs by their velocities."""
    return CubicHermiteSpline(motion.t, mesh.stacked(motion.q), mesh.stacked(motion.v))


def nodes_of(model: Model, ends: Ends, guess: PathGuess, count: int, degree: int):
    """The nodes (K, s, n) of a start, and where its elements meet."""
    xp, dtype = numpy_of((ends.x_a, ends.x_b, ends.duration)), ends.x_a.dtype
    at, parts = mesh.after_first(mesh.even(count), degree), mesh.even(count).astype(dtype)
    if isinstance(guess.path, Nodes):
        return guess.path.x.astype(dtype), parts
    if isinstance(guess.path, Trajectory):
        return course_of(guess.path)(np.asarray(ends.t_a + ends.duration * at)).astype(dtype), parts
    if callable(guess.path):
        t = ends.t_a + ends.duration * at.astype(dtype)
        return jax.vmap(jax.vmap(lambda t: model.vector(coordinates.as_floats(guess.path(t)))))(t), parts
    x_a, x_b = xp.asarray(ends.x_a), xp.asarray(ends.x_b)
    x = x_a[None, None] + at.astype(dtype)[..., None] * (x_b - x_a)[None, None]
    if guess.path is None:
        return x, parts
    shape = np.sin(np.pi * at[..., None] * np.arange(1, WAVES + 1))
    return x + (sizes_of(model, ends).sizes * (shape @ guess.path)).astype(dtype), parts


class Sizes(NamedTuple):
    """How far each coordinate may go (n,), and the mass matrix (n, n) that makes them comparable."""

    sizes: np.ndarray
    mass: np.ndarray


def sizes_of(model: Model, ends: Ends) -> Sizes:
    """The sizes of waves: that of the straight line in kinetic energy, D = √(Δᵀ M Δ), is D / √M_ii in each coordinate.

    Where forces lead farther in the time, D is the length that they lead, but no more than that of the coordinates
    themselves. An angle on whose turns by 2π L depends, and not on whole ones, has the size π.
    """
    masses, forces, steps = (np.asarray(x, float) for x in _probed(model, ends))
    x_a, x_b, time = (np.asarray(x, float) for x in (ends.x_a, ends.x_b, ends.duration))
    finite = np.all(np.isfinite(masses), axis=(1, 2))
    mass = np.mean(masses[finite], axis=0) if finite.any() else np.eye(len(x_a))
    diagonal = np.diag(mass)
    diagonal = np.where(diagonal > 0, diagonal, max(np.max(diagonal), 0.0) or 1.0)
    roots = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh((mass + mass.T) / 2 / roots[:, None] / roots[None])
    # A massless coordinate is moved like the others.
    mass = (vectors * np.maximum(values, 1e-3)) @ vectors.T * roots[:, None] * roots[None]
    length = np.linalg.norm(roots * (x_b - x_a))
    with np.errstate(all="ignore"):
        forced = np.nanmax(np.where(np.isfinite(forces), np.abs(forces), 0.0) / roots, axis=0) * time**2 / 8
    largest = np.maximum(np.abs(x_a), np.abs(x_b)) * roots
    length = max(length, np.max(np.minimum(forced, largest)))
    length = length or np.max(largest) or float(np.max(roots))
    whole, elsewhere = np.max(np.abs(steps), axis=1)
    turns = np.isfinite(elsewhere) & (elsewhere > 0) & (whole <= 1e-6 * elsewhere)
    return Sizes(np.where(turns, TURN / 2, length / roots), mass)


@compiled
def _probed(model: Model, ends: Ends):
    """Masses and forces on the straight line; by how much L changes with a turn of each coordinate, and elsewhere."""
    u = (ends.x_b - ends.x_a) / ends.duration
    more = jnp.asarray([TURN, ELSEWHERE], u.dtype)[:, None, None] * jnp.eye(len(u), dtype=u.dtype)[None]

    def at(share: Array):
        t, x = ends.t_a + share * ends.duration, ends.x_a + share * (ends.x_b - ends.x_a)
        mass = jax.jacfwd(jax.grad(model.lagrangian, argnums=2), argnums=2)(t, x, u)
        # A speed that no coordinate lacks, so that an angle on which inertias depend counts.
        fast = u + 1.0 / ends.duration
        value = jax.vmap(jax.vmap(lambda d: model.lagrangian(t, x + d, fast)))(more)
        return mass, jax.grad(model.lagrangian, argnums=1)(t, x, u), value - model.lagrangian(t, x, fast)

    masses, forces, steps = jax.vmap(at)(jnp.asarray(PLACES, u.dtype))
    return masses, forces, jnp.moveaxis(steps, 0, 1)


# The first radius of trust and the first step from a saddle, in units of a half wave as large as the coordinates; the
# shortest radius, and the distance at which the action is taken to fall without limit.
RADIUS, OFF_SADDLE, SHORTEST, FAR = 0.3, 0.2, 1e-6, 1e2
# Steps at most; a predicted gain, relative, that ends the search; the most unknowns.
STEPS, GAIN, MOST = 60, 1e-5, 800


class _Nodes(NamedTuple):
    """Nodes (K, s, n) on the constraints, their action, and its derivatives in displacements that these allow."""

    x: np.ndarray
    action: float
    slope: np.ndarray
    curvature: np.ndarray
    metric: np.ndarray
    allowed: np.ndarray | None
    multipliers: np.ndarray


def can_descend(model: Model, ends: Ends, count: int) -> bool:
    """Whether there is a discrete action of fixed ends, with few enough unknowns."""
    return ends.kind == FIXED and not ends.free_time and count * DEGREE * (model.n + model.m) <= MOST


def ways_down(model: Model, ends: Ends, path: Path, sizes: Sizes, count: int) -> list[np.ndarray]:
    """The nodes (K, s, n) that lie below a saddle, on either side of it, on elements of equal length."""
    parts = mesh.even(count)
    t = np.asarray(ends.t_a) + np.asarray(ends.duration) * mesh.after_first(parts, DEGREE).ravel()
    x = path.at(ends, t).reshape(count, DEGREE, model.n)
    ground = _Ground(model, ends, parts, sizes)
    saddle = ground.at(x, None)
    if saddle is None:
        return []
    values, vectors = eigh(saddle.curvature, saddle.metric)
    if not values[0] < 0:
        return []
    step, found = OFF_SADDLE * ground.unit * vectors[:, 0], []
    for sign in (1.0, -1.0):
        place = ground.at(_moved(saddle, sign * step), saddle.multipliers)
        if place is not None and (lower := ground.descended(place)) is not None:
            found.append(lower)
    return found


def down_from(model: Model, ends: Ends, x: np.ndarray, parts: np.ndarray, sizes: Sizes) -> np.ndarray | None:
    """The nodes below those of a start, on its elements."""
    ground = _Ground(model, ends, np.asarray(parts), sizes)
    place = ground.at(np.asarray(x), None)
    return None if place is None else ground.descended(place)


def _moved(place: _Nodes, step: np.ndarray) -> np.ndarray:
    free = step if place.allowed is None else place.allowed @ step
    shape = place.x.shape
    return place.x + np.append(free, np.zeros(shape[2])).reshape(shape)


class _Ground:
    """The discrete action over the inner nodes of given elements."""

    def __init__(self, model: Model, ends: Ends, parts: np.ndarray, sizes: Sizes):
        self.model, self.ends, self.parts, self.sizes = model, ends, parts.astype(float), sizes
        s, duration = DEGREE, float(ends.duration)
        self.kinetic = _kinetic(self.parts * duration, s, sizes.mass)
        shares = mesh.after_first(self.parts, s).ravel()[:-1]
        wave = (np.sin(np.pi * shares)[:, None] * sizes.sizes[None]).ravel()
        self.unit = float(np.sqrt(wave @ self.kinetic @ wave))

    def at(self, x: np.ndarray, multipliers: np.ndarray | None) -> _Nodes | None:
        """The place of these nodes; None where the action is not finite."""
        model, (count, s, n) = self.model, x.shape
        m = int(model.holonomic.sum())
        known = np.zeros((count, s, m)) if multipliers is None else multipliers
        again = bool(m) and multipliers is None
        while True:
            dtype = self.ends.x_a.dtype
            x, action, found = _second_order(
                model, self.ends, np.asarray(x, dtype), np.asarray(self.parts, dtype), np.asarray(known, dtype)
            )
            slope, matrix = _whole(found)
            if not (np.isfinite(action) and np.all(np.isfinite(slope)) and np.all(np.isfinite(matrix))):
                return None
            if not m:
                return _Nodes(np.asarray(x, float), float(action), slope, matrix, self.kinetic, None, known)
            of_x = np.tile(np.arange(n + m) < n, count * s - 1)
            rows = matrix[~of_x][:, of_x]
            # What is left of the slope along the constraints' rows is taken up by their multipliers.
            more = np.linalg.lstsq(rows.T, -slope[of_x], rcond=None)[0].reshape(-1, m)
            known = known + np.concatenate([more, np.zeros((1, m))]).reshape(count, s, m)
            if not again:
                break
            # Once more, with the multipliers in the curvature.
            again = False
        q = np.linalg.qr(rows.T, mode="complete")[0][:, len(rows) :]
        curvature, metric = q.T @ matrix[of_x][:, of_x] @ q, q.T @ self.kinetic @ q
        return _Nodes(np.asarray(x, float), float(action), q.T @ slope[of_x], curvature, metric, q, known)

    def descended(self, place: _Nodes) -> np.ndarray | None:
        """The nodes at which the action is least nearby; None where it falls without limit."""
        radius, start = RADIUS * self.unit, place.x
        size = np.max(np.abs(start), axis=(0, 1)) + self.sizes.sizes
        for _ in range(STEPS):
            values, vectors = eigh(place.curvature, place.metric)
            slope = vectors.T @ place.slope
            while True:
                step = -slope / (np.abs(values) + _shift(slope, np.abs(values), radius))
                gain = -(slope @ step + 0.5 * values @ step**2)
                if gain <= GAIN * max(abs(place.action), self.unit**2 * GAIN) or radius < SHORTEST * self.unit:
                    return place.x
                trial = self.at(_moved(place, vectors @ step), place.multipliers)
                ratio = -np.inf if trial is None else (place.action - trial.action) / gain
                radius *= 2.0 if ratio > 0.75 else 1.0 if ratio > 0.25 else 1 / 3
                if trial is not None and ratio > 0.05:
                    place = trial
                    break
            if np.max(np.abs(place.x - start) / size) > FAR:
                return None
        return place.x


def _shift(slope: np.ndarray, values: np.ndarray, radius: float) -> float:
    """μ by which the step is no longer than the radius."""

    def length(shift: float) -> float:
        return float(np.linalg.norm(slope / np.maximum(values + shift, np.finfo(float).tiny)))

    if length(0.0) <= radius:
        return 0.0
    low, high = 0.0, float(np.linalg.norm(slope)) / radius
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if length(middle) > radius else (low, middle)
    return high


def _kinetic(times: np.ndarray, s: int, mass: np.ndarray) -> np.ndarray:
    """The kinetic energy of displacements of the inner nodes, twice, with one mass matrix."""
    rule, count = rule_of_degree(s), len(times) - 1
    whole = np.zeros((count * s + 1,) * 2)
    for e, h in enumerate(np.diff(times)):
        at = slice(e * s, (e + 1) * s + 1)
        whole[at, at] += rule.derivative.T @ (rule.weights[:, None] * rule.derivative) / h
    return np.kron(whole[1:-1, 1:-1], mass)


def _whole(found: PathEquations) -> tuple[np.ndarray, np.ndarray]:
    """Slope and curvature in the inner nodes, from groups."""
    diagonal, before, after = (np.asarray(x, float) for x in (found.diagonal, found.before, found.after))
    count, flat = diagonal.shape[:2]
    size = before.shape[2]
    whole = np.zeros((count * flat,) * 2)
    for e in range(count):
        own = slice(e * flat, (e + 1) * flat)
        whole[own, own] = diagonal[e]
        if e:
            last = slice(e * flat - size, e * flat)
            whole[own, last], whole[last, own] = before[e - 1], after[e - 1]
    inner = count * flat - size
    matrix = whole[:inner, :inner]
    return np.asarray(found.r, float).ravel()[:inner], (matrix + matrix.T) / 2


@compiled
def _second_order(
    model: Model, ends: Ends, x: Float[Array, "K s n"], parts: Float[Array, " K+1"], multipliers: Float[Array, "K s m"]
) -> tuple[Array, Array, PathEquations]:
    """The nodes on the constraints, the discrete action, its slope and its curvature."""
    path, n = path_through(model, ends, x, parts), model.n
    path = path._replace(y=path.y.at[..., n:].set(multipliers))
    return path.y[..., :n], path.action(model, ends), equations(model, ends, path)
