"""Ways down: from a saddle, or from a start where Newton's method fails, to a path of less action.

Newton's method finds stationary paths of every kind, and keeps to the one that it is near. The discrete action of the
same elements (`elements.py`) is followed down instead: in its eigenvectors relative to the kinetic energy of
displacements, P, which knows no units,

    H v = w P v,    step = -Σ (v·g) / (|w| + μ) v,    μ so that the step stays within a radius of trust

On holonomic constraints all is taken on displacements that these allow, with the multipliers in H, and nodes are
returned to them after each step. What it ends at is a start for Newton's method, which alone says what is an answer.

Source: Conn, Gould & Toint, *Trust Region Methods*, ch. 7; Milnor, *Morse Theory*, §3 (below a saddle lies another
critical point, where the action has a lower bound).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import eigh

from lagjax.jaxtools import compiled
from lagjax.system import Model
from lagjax.two_points.elements import discrete_action, rule_of_degree
from lagjax.two_points.path import FIXED, Ends, Path, PathEquations, equations
from lagjax.two_points.path_mesh import path_through, positions
from lagjax.two_points.starts import DEGREE, Sizes

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
    parts = np.linspace(0.0, 1.0, count + 1)
    at = parts[:-1, None] + np.diff(parts)[:, None] * rule_of_degree(DEGREE).nodes[1:]
    t = np.asarray(ends.t_a) + np.asarray(ends.duration) * at.ravel()
    x = positions(ends, path, t).reshape(count, DEGREE, model.n)
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
        shares = self.parts[:-1, None] + np.diff(self.parts)[:, None] * rule_of_degree(s).nodes[1:]
        wave = (np.sin(np.pi * shares.ravel()[:-1])[:, None] * sizes.sizes[None]).ravel()
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
    rule, nodes, (t, h) = rule_of_degree(x.shape[1]), path.nodes(ends), path.times(ends)
    action = jax.vmap(lambda t, h, nodes: discrete_action(model, rule, t, h, nodes[:, :n]))(t, h, nodes)
    return path.y[..., :n], jnp.sum(action), equations(model, ends, path)
