"""Pseudo-arclength continuation of branches of solutions: through folds, past critical points, onto crossing branches.

The solutions are steady motions (`critical_points.py`) or cycles (`cycle_equations.py`): solutions z = (y, μ) of
equations E(z) = 0 with the Jacobian `J = (E_y, E_μ)`. The next point is predicted one step along the tangent τ,
`J τ = 0`, and corrected in the plane across it,

    E(z) = 0,      τ·(z - z_i - h τ) = 0

There may be more equations than unknowns, some of them redundant; they are then solved by least squares. Lengths are
measured in the positions and the parameter.

A `BranchProblem` has the equations, the frame in which their points are read, and monitors: functions of the points,
each of which changes where something happens in between, and knows how that point is refined. A `BranchFollower` takes
the steps, looks at the monitors after each, and decides where a branch ends and which others are followed.

Source: Keller, in *Applications of Bifurcation Theory* (1977) 359; Allgower & Georg, *Introduction to Numerical
Continuation Methods*, ch. 6 (steps).
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

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


NUMBER = "number"


class Along(eqx.Module):
    """The parameter of a branch: a number in `params`, or, by its `kind` and `entry`, something else that is held."""

    name: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    number: Number | None = None
    entry: int = eqx.field(static=True, default=0)


def range_from(first: float, to: float, along: str, where: str) -> float:
    """The last value of the parameter; raises unless it differs from the first, which is given in `where`."""
    if not np.isfinite(last := float(to)) or first == last:
        raise ValueError(
            f"to={to} leaves the parameter {along!r} no range: it starts at {first:.6g}.\n"
            f"Fix: to={2 * first or 1.0:.6g}, and the first value in {where}."
        )
    return last


ITERATIONS = 10
# The number of values from which a zero is interpolated.
INTERPOLATED = 6
LOST = "equations that are redundant at the start of the branch are no longer redundant"


@dataclass
class BranchPoint:
    """A point of a branch: z, the Jacobian and the tangent there, and the outputs for the user.

    `sign`: of a function that changes sign where another branch crosses. `growing`: the number of small departures that
    grow, None if unknown. `negative`: the number of negative factors in the product of which `sign` is the sign.
    `critical`: the number of the critical point that it is.
    """

    z: np.ndarray
    jacobian: np.ndarray
    tangent: np.ndarray
    sign: float
    outputs: Any
    growing: int | None
    negative: int = 0
    critical: int | None = None


@dataclass
class CriticalPoint:
    """A critical point: its kind, z, and how far off its parameter may be, in the unit of z.

    `located`: False where it only lies somewhere between two points. `directions`: the tangents of both branches of a
    crossing; `used`: those that are followed. `derivative`: of the parameter. `point`: the point of the branch, None if
    it is not known yet, or has no outputs.
    """

    kind: str
    z: np.ndarray
    accuracy: float
    directions: list[np.ndarray] = field(default_factory=list)
    frequency: float = 0.0
    derivative: Any = None
    located: bool = True
    point: BranchPoint | None = None
    used: list[np.ndarray] = field(default_factory=list)


class Monitor(NamedTuple):
    """A function of the points of a branch that shows what happens between two of them.

    - `value(point)`, and `changes(before, after)`: whether a change of this value means something.
    - `refine(problem, before, after)`: the critical point in between, to round-off; None if there is none after all.
    - `alone`: only where none of the monitors before has found anything. `smooth`: so smooth that values at three
      points show two zeros between them.
    """

    value: Callable[[BranchPoint], Any]
    changes: Callable[[Any, Any], bool]
    refine: Callable[[Any, BranchPoint, BranchPoint], CriticalPoint | None]
    alone: bool = True
    smooth: bool = False


def sign_changes(before: float, after: float) -> bool:
    """Whether a number changes its sign."""
    return before * after < 0


def count_changes(before: int | None, after: int | None) -> bool:
    """Whether a number of things changes, where both are known."""
    return before is not None and after is not None and before != after


class BranchProblem(abc.ABC):
    """Equations E(z) = 0 that have branches of solutions, how a point is read, and what is watched along a branch.

    Abstract: `residual` has the equations, `described` reads a point in the `frame`, `monitors` find critical points.

    - `along`: the parameter, in units of `unit`, between `low` and `high`.
    - `weights` (N + 1,): of the entries of z in a length. A branch ends at infinity if one of the first `positions`
      entries of z is large.
    - `crossings`: whether `monitors` solve for the branches that cross, which are then followed too.
    """

    frame: Any
    along: Along
    weights: np.ndarray
    positions: int
    dtype: np.dtype
    unit: float
    monitors: tuple[Monitor, ...]
    crossings = False

    def __init__(self, low: float, high: float):
        self.low, self.high = low, high
        # The ratio of Newton's second step to its first in the last correction.
        self.contraction = 0.0

    @abc.abstractmethod
    def residual(self, z) -> tuple[np.ndarray, np.ndarray, float]:
        """E, J and the largest residual of all equations."""

    @abc.abstractmethod
    def described(self, z, jacobian, tangent) -> BranchPoint | str:
        """A point with its outputs; or a message that says what is wrong with it."""

    def moved_to(self, point: BranchPoint):
        """Called when the branch has reached a point, to which the equations may refer from then on."""

    def ends(self, points: list[BranchPoint], after: BranchPoint, origin: CriticalPoint | None) -> str | None:
        """Why a branch ends before this point, if it does; `origin`: the critical point at which it began."""

    def escape(self, point: BranchPoint) -> CriticalPoint | None:
        """The critical point at which a branch goes to infinity, from a point far out, if it can be solved for."""

    @property
    def eps(self) -> float:
        return float(np.finfo(self.dtype).eps)

    @property
    def noise(self) -> float:
        """The round-off of a Newton step, relative to z."""
        return self.eps

    def cast(self, *vectors) -> tuple[np.ndarray, ...]:
        """Vectors in the dtype of the equations."""
        return tuple(np.asarray(x, self.dtype) for x in vectors)

    def size(self, z):
        return max(1.0, float(np.max(np.abs(z))))

    def length(self, step) -> float:
        """The length of a step of z."""
        return float(np.sqrt(self.weights @ step**2))

    def value_of(self, z, digits=6) -> str:
        """The parameter in words."""
        return f"{self.along.name} = {z[-1] * self.unit:.{digits}g}"

    def tangent(self, jacobian, along):
        """The unit tangent in the direction of `along`."""
        direction = np.linalg.svd(jacobian)[2][-1].astype(float)
        direction /= np.sqrt(max(self.weights @ direction**2, 1e-300))
        return direction if (self.weights * direction) @ along >= 0 else -direction

    def corrected(self, z, row, known=None):
        """Newton's method from z with `row @ z` held at `known` (by default its value at z); None if it fails."""
        known = row @ z if known is None else known

        def step(z):
            value, jacobian, _ = self.residual(z)
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

    def point(self, z, along) -> BranchPoint | str:
        """The point of a branch at z; or a message that says what is wrong with it."""
        _, jacobian, off = self.residual(z)
        # The residual of all equations, also redundant ones; equations are scaled to order one.
        if off > self.noise**0.5 * self.size(z):
            return LOST
        return self.described(z, jacobian, self.tangent(jacobian, along))

    def point_near(self, z, along, row, known=None) -> BranchPoint | None:
        """The point of a branch to which `corrected` leads; None if there is none."""
        z = self.corrected(z, row, known)
        candidate = self.point(z, along) if z is not None else None
        return candidate if isinstance(candidate, BranchPoint) else None

    def begin(self, z, towards) -> BranchPoint | str:
        """The point of a branch with the parameter of z, from which it is followed `towards` (±1) larger ones."""
        row = np.eye(z.size)[-1]
        corrected = self.corrected(z, row)
        return self.point(z if corrected is None else corrected, towards * row)

    def between(self, a: BranchPoint, b: BranchPoint, share: float) -> BranchPoint | None:
        """A point of the branch between two others."""
        return self.point_near(a.z + share * (b.z - a.z), a.tangent, self.weights * a.tangent)

    def at_edge(self, a: BranchPoint, b: BranchPoint) -> BranchPoint | None:
        """The point of the branch at the end of the parameter's range."""
        edge = self.low if b.z[-1] < self.low else self.high
        share = np.clip((edge - a.z[-1]) / (b.z[-1] - a.z[-1]), 0.0, 1.0) if b.z[-1] != a.z[-1] else 0.0
        return self.point_near(a.z + share * (b.z - a.z), a.tangent, np.eye(a.z.size)[-1], edge)

    def halved(self, a: BranchPoint, b: BranchPoint, value: Callable[[BranchPoint], Any], times: int):
        """Bisect a branch where a count changes: two points much nearer to the change."""
        low, high, left, right = 0.0, 1.0, a, b
        for _ in range(times):
            share = 0.5 * (low + high)
            middle = self.between(a, b, share) if low < share < high else None
            if middle is None or value(middle) is None:
                break
            if value(middle) == value(left):
                low, left = share, middle
            else:
                high, right = share, middle
        return left, right

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


def _at_zero(tried):
    """z where the function is zero, by Neville's interpolation of z as a polynomial of the function's value."""
    values, zs = [value for value, _ in tried], [z for _, z in tried]
    for gap in range(1, len(zs)):
        zs = [
            (values[i] * zs[i + 1] - values[i + gap] * zs[i]) / (values[i] - values[i + gap])
            for i in range(len(zs) - 1)
        ]
    return zs[0]


def zero(kind: str, of: Callable[[BranchPoint], float], problem: BranchProblem, a: BranchPoint, b: BranchPoint):
    """The `CriticalPoint` between two points where a smooth function changes its sign; None if it does not."""
    found = problem.zero_between(a, b, of)
    if found is None:
        return None
    point, off = found
    if np.isfinite(off):
        return CriticalPoint(kind, point.z, off, point=point)
    # Somewhere between the two points: by a straight line, and how far the parameter changes on the way.
    share = of(a) / (of(a) - of(b))
    point = problem.between(a, b, share) or (a if share < 0.5 else b)
    steepest = max(abs(a.tangent[-1]), abs(b.tangent[-1]))
    off = max(abs(float((b.z - a.z)[-1])), problem.length(b.z - a.z) * steepest)
    return CriticalPoint(kind, point.z, float(off), point=point, located=False)
