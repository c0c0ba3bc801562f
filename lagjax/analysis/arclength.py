"""Pseudo-arclength continuation of a branch of solutions, which passes folds; its parameter, by name.

The solutions are steady motions (`critical_points.py`) or cycles (`cycle_equations.py`): solutions z = (y, μ) of
equations E(z) = 0 with the Jacobian `J = (E_y, E_μ)`. The next point is predicted one step along the tangent τ,
`J τ = 0`, and corrected in the plane across it,

    E(z) = 0,      τ·(z - z_i - h τ) = 0

There may be more equations than unknowns, some of them redundant; they are then solved by least squares. Lengths are
measured in the positions and the parameter.

Source: Keller, in *Applications of Bifurcation Theory* (1977) 359; Allgower & Georg, *Introduction to Numerical
Continuation Methods*, ch. 6 (steps).
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.jaxtools import is_traced, numpy_of
from lagjax.mechanics import listed
from lagjax.numerics import newton_in_python


class Number(eqx.Module):
    """One entry of one leaf of `params`."""

    name: str = eqx.field(static=True)
    leaf: int = eqx.field(static=True)
    entry: int = eqx.field(static=True)

    def put(self, params: PyTree, value) -> PyTree:
        """`params` with another value of this number."""
        leaves, structure = jtu.tree_flatten(params)
        if is_traced((leaves[self.leaf], value)):
            leaf = jnp.asarray(leaves[self.leaf])
            leaf = leaf.reshape(-1).at[self.entry].set(value).reshape(leaf.shape).astype(leaf.dtype)
        else:
            leaf = np.array(leaves[self.leaf])
            leaf.reshape(-1)[self.entry] = value
        leaves[self.leaf] = leaf
        return jtu.tree_unflatten(structure, leaves)

    def get(self, params: PyTree):
        """The value of this number."""
        leaf = jtu.tree_leaves(params)[self.leaf]
        return numpy_of(leaf).ravel(leaf)[self.entry]


def numbers_in(params: PyTree) -> dict[str, Number]:
    """All floating-point numbers in `params`, by name."""
    numbers = {}
    for i, (path, leaf) in enumerate(jtu.tree_flatten_with_path(params)[0]):
        name = jtu.keystr(path, simple=True, separator=".") or "params"
        if not eqx.is_array_like(leaf) or not jnp.issubdtype(jnp.result_type(leaf), jnp.floating):
            continue
        for entry, index in enumerate(np.ndindex(jnp.shape(leaf))):
            suffix = "[" + ", ".join(map(str, index)) + "]" if index else ""
            numbers[name + suffix] = Number(name + suffix, i, entry)
    return numbers


def no_such_number(along: str, params: PyTree, more: str) -> ValueError:
    """The error that no number has this name; `more`: what else `along` may be."""
    known = list(numbers_in(params))
    there = f"there {'are' if len(known) != 1 else 'is'} {listed(known) or 'none'}"
    return ValueError(
        f"along={along!r} is no number in params; {there}.\n"
        f'Fix: one of these; "spring.k" for params["spring"]["k"], {more}.'
    )


ITERATIONS = 10
# Step lengths: the first, the longest (relative to the distance from the origin) and the smallest.
FIRST, LONGEST, LEAST = 0.005, 0.03, 1e-7
# The largest turn of the tangent in a step, in radians, and the desired one.
MOST_TURN, TURN = 0.4, 0.12
# The largest and the desired contraction rate of Newton's method, which is large if the prediction was poor.
MOST_CONTRACTION, CONTRACTION = 0.3, 0.1
# Positions larger than this, in their units, count as infinite.
INFINITY = 1e4
CLOSED_WITHIN = 1e-3
# A spurious crossing means that a step jumped to another branch, and it is repeated (AGAIN) with a shorter one, unless
# it is shorter than SHORT already.
AGAIN, SHORT = "again", 1e-6
AT_EDGE = "the end of the range"
# The number of values from which a zero is interpolated.
INTERPOLATED = 6
LOST = "equations that are redundant at the start of the branch are no longer redundant"


@dataclass
class BranchPoint:
    """A point of a branch: z, the Jacobian and the tangent there, and the outputs for the user.

    `sign`: of a function that changes sign where another branch crosses. `growing`: the number of small departures that
    grow, None if unknown. `negative`: the number of negative factors in the product of which `sign` is the sign.
    """

    z: np.ndarray
    jacobian: np.ndarray
    tangent: np.ndarray
    sign: float
    outputs: Any
    growing: int | None
    negative: int
    critical: int | None = None


@dataclass
class BranchPath:
    """The points of a branch in order, and why it ends."""

    points: list[BranchPoint] = field(default_factory=list)
    status: str = ""
    others: list[str] = field(default_factory=list)


class Tracer(abc.ABC):
    """The data common to all branches of a run: the equations, the measure of length, the range of the parameter.

    Abstract: `at` and `described` define what is solved. `weights` (N + 1,): of the entries of z in a length. A branch
    ends at infinity if one of the first `positions` entries of z is large. `unit`: of the parameter.
    """

    weights: np.ndarray
    positions: int
    dtype: np.dtype
    unit: float

    def cast(self, *vectors: np.ndarray) -> tuple[np.ndarray, ...]:
        """Vectors in the dtype of the equations."""
        return tuple(np.asarray(x, self.dtype) for x in vectors)

    def __init__(self, low: float, high: float):
        self.low, self.high = low, high
        # The ratio of Newton's second step to its first in the last correction.
        self.contraction = 0.0

    @property
    def eps(self) -> float:
        return float(np.finfo(self.dtype).eps)

    @property
    def noise(self) -> float:
        """The round-off of a Newton step, relative to z."""
        return self.eps

    @abc.abstractmethod
    def at(self, z) -> tuple[np.ndarray, np.ndarray, float]:
        """E, J and the largest residual of all equations."""

    @abc.abstractmethod
    def described(self, z, jacobian, tangent) -> BranchPoint | str:
        """A point with its outputs; or a message that says what is wrong with it."""

    def moved_to(self, point: BranchPoint):
        """Called when the branch has reached a point, to which the equations may refer from then on."""

    def tangent(self, jacobian, along):
        """The unit tangent in the direction of `along`."""
        direction = np.linalg.svd(jacobian)[2][-1].astype(float)
        direction /= np.sqrt(max(self.weights @ direction**2, 1e-300))
        return direction if (self.weights * direction) @ along >= 0 else -direction

    def corrected(self, z, row, known=None):
        """Newton's method from z with `row @ z` held at `known` (by default its value at z); None if it fails."""
        known = row @ z if known is None else known

        def step(z):
            value, jacobian, _ = self.at(z)
            if not (np.all(np.isfinite(value)) and np.all(np.isfinite(jacobian))):
                return None
            matrix = np.concatenate([jacobian, row[None]])
            left = np.append(value, row @ z - known)
            try:
                square = matrix.shape[0] == matrix.shape[1]
                change = np.linalg.solve(matrix, left) if square else np.linalg.lstsq(matrix, left, rcond=None)[0]
            except np.linalg.LinAlgError:
                return None
            return change if np.all(np.isfinite(change)) else None

        limits = {"enough": 50 * self.noise, "noise": 1e3 * self.noise}
        found = newton_in_python(step, z, ITERATIONS, free=2, shrinks=0.7, **limits)
        if found is None or not found.converged:
            return None
        first, second = (*found.lengths, 0.0)[:2]
        self.contraction = second / first if first > 1e-6 else 0.0
        return found.y

    def size(self, z):
        return max(1.0, float(np.max(np.abs(z))))

    def point(self, z, along) -> BranchPoint | str:
        """The point of a branch at z; or a message that says what is wrong with it."""
        _, jacobian, off = self.at(z)
        # The residual of all equations, also redundant ones; equations are scaled to order one.
        if off > self.noise**0.5 * self.size(z):
            return LOST
        return self.described(z, jacobian, self.tangent(jacobian, along))

    def trace(self, start: BranchPoint, most: int, on_step: Callable, first: float = FIRST) -> BranchPath:
        """Follow a branch until it leaves the range of the parameter, ends or closes.

        `on_step(before, after, path)` finds critical points between two points. It may return why the path ends, or
        `AGAIN` to request a shorter step.
        """
        path, point, step = BranchPath([start]), start, first
        while len(path.points) < most:
            tried = step
            after, step, why = self.next_point(point, tried)
            if after is None:
                path.status = why
                return path
            outside = not self.low <= after.z[-1] <= self.high
            if outside:
                after = self.at_edge(point, after) or after
            ended = on_step(point, after, path)
            if ended == AGAIN:
                step = min(tried, float(np.sqrt(self.weights @ (after.z - point.z) ** 2))) / 4
                if step > SHORT * self.size(point.z):
                    continue
                ended = None
            if ended:
                path.status = ended
                return path
            path.points.append(after)
            if outside:
                path.status = AT_EDGE
                return path
            if np.max(np.abs(after.z[: self.positions])) > INFINITY:
                path.status = "infinity"
                return path
            if self.closes(path, step):
                path.status = "closed"
                return path
            point = after
            self.moved_to(point)
        path.status = f"the limit of {most} points"
        return path

    def next_point(self, point: BranchPoint, step: float):
        """The next point, the step to try after it, and, if there is no point, the reason."""
        longest = LONGEST * max(1.0, float(np.max(np.abs(point.z[: self.positions]))))
        why = "Newton's method does not converge, however short the step"
        while step > LEAST * self.size(point.z):
            step = min(step, longest)
            row = self.weights * point.tangent
            z = self.corrected(point.z + step * point.tangent, row)
            contraction = self.contraction
            candidate = self.point(z, point.tangent) if z is not None else None
            if isinstance(candidate, BranchPoint):
                turn = np.arccos(np.clip((self.weights * candidate.tangent) @ point.tangent, -1, 1))
                moved = np.sqrt(self.weights @ (candidate.z - point.z) ** 2)
                if turn < MOST_TURN and moved < 1.2 * step and contraction < MOST_CONTRACTION:
                    grow = min(TURN / max(turn, 1e-3), CONTRACTION / max(contraction, 1e-3))
                    return candidate, step * float(np.clip(grow, 0.5, 2.0)), ""
                why = "the branch turns more sharply than steps can follow: a corner of L, or a cusp"
            elif isinstance(candidate, str):
                why = candidate
            step /= 3
        return None, step, why

    def between(self, a: BranchPoint, b: BranchPoint, share: float) -> BranchPoint | None:
        """A point of the branch between two others."""
        row = self.weights * a.tangent
        guess = a.z + share * (b.z - a.z)
        z = self.corrected(guess, row)
        candidate = self.point(z, a.tangent) if z is not None else None
        return candidate if isinstance(candidate, BranchPoint) else None

    def zero_between(
        self, a: BranchPoint, b: BranchPoint, of: Callable[[BranchPoint], float]
    ) -> tuple[BranchPoint, float] | None:
        """The point between two others where a function of points changes sign, and the error of its parameter."""
        low, high, left, right = 0.0, 1.0, of(a), of(b)
        best, off, last, side = b, np.inf, np.inf, 0
        if not left * right < 0:
            return None
        tried = [(left, a.z), (right, b.z)]
        for _ in range(60):
            share = low + (high - low) * (left / (left - right))
            # If one end stays in place, its value is halved (the Illinois method).
            point = self.between(a, b, share) if low < share < high else None
            if point is None:
                return self._interpolated(a, tried) or (best, off)
            value = of(point)
            off, last, best = abs(float((point.z - best.z)[-1])), off, point
            if value == 0 or max(off, last) < 4 * self.noise * self.size(point.z):
                break
            tried.append((value, point.z))
            if value * left > 0:
                low, left, right, side = share, value, right / 2 if side < 0 else right, -1
            else:
                high, right, left, side = share, value, left / 2 if side > 0 else left, 1
        return best, off

    def _interpolated(self, a: BranchPoint, tried: list[tuple[float, np.ndarray]]) -> tuple[BranchPoint, float] | None:
        """The zero of a function, interpolated from values nearby: Newton's method fails very near a crossing."""
        tried = sorted(tried, key=lambda one: abs(one[0]))[:INTERPOLATED]
        zs = [_at_zero(tried[:count]) for count in (len(tried) - 1, len(tried))]
        point = self.point(zs[-1], a.tangent)
        off = abs(float((zs[1] - zs[0])[-1]))
        return (point, off) if isinstance(point, BranchPoint) else None

    def at_edge(self, a: BranchPoint, b: BranchPoint) -> BranchPoint | None:
        """The point of the branch at the end of the parameter's range."""
        edge = self.low if b.z[-1] < self.low else self.high
        share = np.clip((edge - a.z[-1]) / (b.z[-1] - a.z[-1]), 0.0, 1.0) if b.z[-1] != a.z[-1] else 0.0
        row = np.zeros_like(a.z)
        row[-1] = 1.0
        z = self.corrected(a.z + share * (b.z - a.z), row, edge)
        candidate = self.point(z, a.tangent) if z is not None else None
        return candidate if isinstance(candidate, BranchPoint) else None

    def closes(self, path: BranchPath, step: float) -> bool:
        """Whether a path has returned to its start."""
        if len(path.points) < 10:
            return False
        first, last = path.points[0], path.points[-1]
        off = np.sqrt(self.weights @ (last.z - first.z) ** 2)
        return bool(off < max(step, CLOSED_WITHIN) and (self.weights * first.tangent) @ last.tangent > 0.9)


def _at_zero(tried):
    """z where the function is zero, by Neville's interpolation of z as a polynomial of the function's value."""
    values, zs = [value for value, _ in tried], [z for _, z in tried]
    for gap in range(1, len(zs)):
        zs = [
            (values[i] * zs[i + 1] - values[i + gap] * zs[i]) / (values[i] - values[i + gap])
            for i in range(len(zs) - 1)
        ]
    return zs[0]
