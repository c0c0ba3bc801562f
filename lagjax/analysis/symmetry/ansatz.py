"""The motions among which symmetries are searched: translations, rotations, shifts, time, boosts, scalings.

All motions are affine, ξ = a + B x + t c and τ = α + β t, so a few arrays hold them. Motions of all points together
come before those of a single point, because the first of several dependent ones is kept. Boosts and other motions that
contain t come last. L may change by the total derivative of a gauge function; polynomials are tried for it.
"""

from itertools import combinations_with_replacement
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.symmetry.charge_rates import Affine
from lagjax.mechanics import AXES, points, turned
from lagjax.system import coordinates

# Largest numbers of points rotated one by one, of coordinates boosted and scaled one by one, and of coordinates whose
# products are tried as gauge functions.
EACH_POINT_UP_TO, EACH_UP_TO, PRODUCTS_UP_TO = 8, 24, 6
TIME = "Jacobi integral"


class BasisMotion(NamedTuple):
    """One motion of the basis; `kind` is "space", "time", "boost" or "scaling"."""

    name: str
    kind: str
    shift: np.ndarray
    matrix: np.ndarray
    drift: np.ndarray
    clock: float
    clock_rate: float


class Basis(NamedTuple):
    """The motions of the search: affine maps, their names and kinds."""

    affine: Affine
    names: tuple[str, ...]
    kinds: tuple[str, ...]


def motions(q: PyTree) -> Basis:
    """The motions that are tried for coordinates with the structure of q."""
    all_points, n = points(q), len(coordinates.names(q))
    elements = [*_shifts(q, all_points, n), _element(TIME, "time", n, clock=-1.0), *_rotations(all_points, n)]
    elements += [
        _element(f"t {e.name}", "boost", n, drift=e.shift) for e in elements if e.kind == "space" and e.shift.any()
    ]
    if n > EACH_UP_TO:
        elements = [e for e in elements if e.kind != "boost" or e.name.startswith("t P_")]
    elements += _scalings(q, n)
    stacked = [np.stack([np.asarray(getattr(e, field), float) for e in elements]) for field in Affine.__annotations__]
    return Basis(Affine(*stacked), tuple(e.name for e in elements), tuple(e.kind for e in elements))


def _shifts(q: PyTree, all_points, n):
    elements = []
    for k, axis in enumerate(AXES):
        moved = [point.places[k] for point in all_points if point.places[k] is not None]
        if len(moved) > 1:
            elements.append(_element(f"P_{axis}", "space", n, shift=_ones_at(moved, n)))
    return elements + [
        _element(f"p_{x}", "space", n, shift=_ones_at([i], n)) for i, x in enumerate(coordinates.names(q))
    ]


def _rotations(all_points, n):
    elements = []
    for axis in AXES:
        pairs = [(point.label, pair) for point in all_points if (pair := turned(point, axis))]
        if pairs:
            elements.append(_element(f"L_{axis}", "space", n, matrix=_rotation([pair for _, pair in pairs], n)))
    if 1 < len(all_points) <= EACH_POINT_UP_TO:
        for axis in AXES:
            for point in all_points:
                if pair := turned(point, axis):
                    name = f"L_{axis}({point.label})"
                    elements.append(_element(name, "space", n, matrix=_rotation([pair], n)))
    return elements


def _scalings(q: PyTree, n):
    elements = [_element("q·p", "scaling", n, matrix=np.eye(n))]
    if 1 < n <= EACH_UP_TO:
        for i, name in enumerate(coordinates.names(q)):
            elements.append(_element(f"{name} p_{name}", "scaling", n, matrix=np.diag(_ones_at([i], n))))
    return [*elements, _element(f"t ({TIME})", "scaling", n, clock_rate=-1.0)]


def _element(name: str, kind, n, shift=None, matrix=None, drift=None, clock=0.0, clock_rate=0.0):
    zero = np.zeros(n)
    matrix = np.zeros((n, n)) if matrix is None else matrix
    shift, drift = (zero if x is None else x for x in (shift, drift))
    return BasisMotion(name, kind, shift, matrix, drift, clock, clock_rate)


def _ones_at(places, n):
    vector = np.zeros(n)
    vector[places] = 1.0
    return vector


def _rotation(pairs, n):
    matrix = np.zeros((n, n))
    for first, second in pairs:
        matrix[first, second], matrix[second, first] = -1.0, 1.0
    return matrix


class Gauge(NamedTuple):
    """Gauge functions: t^power times a product of up to two coordinates; their names, and which of them contain t."""

    powers: tuple[int, ...]
    factors: tuple[tuple[int, ...], ...]
    names: tuple[str, ...]
    timed: np.ndarray

    def rates(self, t, x, u) -> np.ndarray:
        """dF/dt of each gauge function at states (N,), (N, n), (N, n): (N, G)."""
        columns = []
        for power, factors in zip(self.powers, self.factors):
            product = np.prod(x[:, list(factors)], axis=1)
            slope = sum((u[:, i] * np.prod(np.delete(x[:, list(factors)], k, axis=1), axis=1)
                         for k, i in enumerate(factors)), np.zeros(len(t)))  # fmt: skip
            columns.append(power * t ** max(power - 1, 0) * product + t**power * slope)
        return np.stack(columns, axis=1)

    def combined(self, weights) -> "Polynomial":
        """The weighted sum of the gauge functions."""
        kept = np.flatnonzero(weights)
        return Polynomial(tuple(self.powers[k] for k in kept), tuple(self.factors[k] for k in kept), weights[kept])


def gauges(q: PyTree) -> Gauge:
    """The gauge functions that are tried for coordinates with the structure of q."""
    names = coordinates.names(q)
    n, monomials = len(names), []
    monomials += [(0, (i,)) for i in range(n)]
    if n <= PRODUCTS_UP_TO:
        monomials += [(0, pair) for pair in combinations_with_replacement(range(n), 2)]
    monomials += [(1, ()), (2, ()), *((1, (i,)) for i in range(n))]
    powers, factors = zip(*monomials)
    return Gauge(powers, factors, tuple(_named(p, f, names) for p, f in monomials), np.asarray(powers) > 0)


def _named(power, factors, names):
    by_count = {i: factors.count(i) for i in factors}
    parts = ["t" if power == 1 else f"t^{power}"] if power else []
    parts += [names[i] if count == 1 else f"{names[i]}^2" for i, count in by_count.items()]
    return " ".join(parts)


class Polynomial(NamedTuple):
    """A gauge function: a linear combination of monomials."""

    powers: tuple[int, ...]
    factors: tuple[tuple[int, ...], ...]
    weights: np.ndarray

    def __call__(self, t, q: PyTree, params: PyTree):
        """The value of F."""
        x, _ = coordinates.flatten(q)
        total = jnp.zeros_like(x[0])
        for weight, power, factors in zip(self.weights, self.powers, self.factors):
            total = total + weight * t**power * jnp.prod(x[np.asarray(factors, int)])
        return total


class Combination(NamedTuple):
    """The displacement ξ = a + B x + t c of a combination of affine motions."""

    shift: np.ndarray
    matrix: np.ndarray
    drift: np.ndarray

    def __call__(self, t, q: PyTree, params: PyTree):
        """ξ, with the structure of q."""
        x, unflatten = coordinates.flatten(q)
        shift, matrix, drift = (jnp.asarray(y, x.dtype) for y in (self.shift, self.matrix, self.drift))
        return unflatten(shift + matrix @ x + t * drift)


class Clock(NamedTuple):
    """The change τ = α + β t of the clock."""

    start: float
    rate: float

    def __call__(self, t, q: PyTree, params: PyTree):
        """The value of τ."""
        return self.start + self.rate * t
