"""The symmetries that were found, as a mapping of names to charges; and the motions among which they are searched.

*The motions*: translations, rotations, shifts, time, boosts, scalings. All motions are affine, ξ = a + B x + t c and τ
= α + β t, so a few arrays hold them. Motions of all points together come before those of a single point, because the
first of several dependent ones is kept. Boosts and other motions that contain t come last. L may change by the total
derivative of a gauge function; polynomials are tried for it.

*The printed summary.* A ratio of two coefficients is written as a whole number, a parameter of the user's, or a pitch
over 2π where it is one: `h p_z + 2π L_z with h = 0.5` says more than `0.0795774715 p_z + L_z`. A number is recognised
if it agrees to round-off, also where the parameters have other values: 3 is not the mass because the mass is 3. The
recognised form is only a guess, so it is displayed but never used in computations.
"""

from collections.abc import Iterator
from fractions import Fraction
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.symmetry_test import Affine
from lagjax.mechanics import AXES, NoetherCharge, points, turned
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


# Parameters are recognised among at most so many, and at most so many terms of a combination are written.
MOST_PARAMETERS, MOST_TERMS = 30, 8
# How well a form must agree where the parameters have other values: null vectors there are found to less.
PERSISTS = 1e-6
WHOLE = [Fraction(n) for n in (1, 2, 3, 4)] + [Fraction(1, 2)]
FRACTIONS = [Fraction(n, d) for d in range(1, 13) for n in range(1, 13)]


class RecognisedNumber(NamedTuple):
    """A fraction times a power of π times powers of parameters."""

    fraction: Fraction
    pi: int = 0
    params: tuple[tuple[str, int], ...] = ()

    def times(self, other: "RecognisedNumber") -> "RecognisedNumber":
        """The product of two numbers."""
        powers = dict(self.params)
        for name, power in other.params:
            powers[name] = powers.get(name, 0) + power
        params = tuple((name, power) for name, power in powers.items() if power)
        return RecognisedNumber(self.fraction * other.fraction, self.pi + other.pi, params)

    def __str__(self):
        above, below = self.fraction.numerator, self.fraction.denominator
        up = ([str(above)] if above != 1 else []) + ["π"] * max(self.pi, 0)
        up = ["".join(up)] if up else []
        up += [name if power == 1 else f"{name}^{power}" for name, power in self.params if power > 0]
        down = ([str(below)] if below != 1 else []) + ["π"] * max(-self.pi, 0)
        down = ["".join(down)] if down else []
        down += [name if power == -1 else f"{name}^{-power}" for name, power in self.params if power < 0]
        return (" ".join(up) or "1") + (f"/({' '.join(down)})" if len(down) > 1 else f"/{down[0]}" if down else "")


class Ratios(NamedTuple):
    """The coefficients of a combination relative to the first, (k,), where the parameters have these values."""

    values: np.ndarray
    params: dict[str, float]


class Words(NamedTuple):
    """A combination in words, and the factor by which the original coefficients are multiplied there."""

    text: str
    factor: float


def named_parameters(params: PyTree) -> dict[str, float]:
    """The numeric parameters, by name."""

    def number_or_none(x: Any) -> np.ndarray | None:
        is_number = isinstance(x, float | int | np.number) or np.issubdtype(getattr(x, "dtype", bool), np.number)
        return np.asarray(x) if is_number else None

    leaves = jax.tree.map(number_or_none, params)
    values = [float(x) for leaf in jax.tree.leaves(leaves) for x in np.ravel(leaf)]
    alone = jtu.treedef_is_leaf(jtu.tree_structure(leaves)) and len(values) == 1
    names = ["params"] if alone else coordinates.names(leaves)
    return dict(zip(names, values)) if len(values) <= MOST_PARAMETERS else {}


def in_words(
    coefficients, names, params: dict[str, float], agrees: float, first=(), elsewhere: Ratios | None = None
) -> Words:
    """A combination in words; `first`: the names whose coefficients are tried as parameters before whole numbers;
    `elsewhere`: what they are where the parameters have other values, None if that is not known."""
    coefficients = np.asarray(coefficients, float)
    leading = coefficients[0]
    others = [None] * len(coefficients) if elsewhere is None else [(x, elsewhere.params) for x in elsewhere.values]
    found = [
        _recognised(c / leading, params, agrees, name in first, other)
        for c, name, other in zip(coefficients, names, others)
    ]
    known = [number for number in found if number is not None]
    # The combination is multiplied by its common denominator.
    below = {}
    for number in known:
        for name, power in number.params:
            below[name] = max(below.get(name, 0), -power)
    common = int(np.lcm.reduce([number.fraction.denominator for number in known]))
    pi = max(-number.pi for number in known)
    factor = RecognisedNumber(
        Fraction(common), max(pi, 0), tuple((name, power) for name, power in below.items() if power > 0)
    )
    size = _value(factor, params)
    text, used = "", []
    for i, (c, name, number) in enumerate(zip(coefficients, names, found)):
        if i == MOST_TERMS and len(names) > MOST_TERMS + 2:
            text += f" ... ({len(names)} terms)"
            break
        value = c / leading * size
        number = None if number is None else number.times(factor)
        word = f"{abs(value):.9g}" if number is None else str(number._replace(fraction=abs(number.fraction)))
        # The sign shown is that of the fraction, because a parameter may be negative.
        negative = value < 0 if number is None else number.fraction < 0
        used += [] if number is None else [p for p, _ in number.params]
        sign = (" - " if negative else " + ") if text else ("-" if negative else "")
        text += sign + (f"{word} " if word != "1" else "") + name
    values = ", ".join(f"{name} = {params[name]:.6g}" for name in dict.fromkeys(used))
    return Words(text + (f" with {values}" if values else ""), size / leading)


def _value(number: RecognisedNumber, params: PyTree) -> float:
    return float(number.fraction) * np.pi**number.pi * float(np.prod([params[p] ** e for p, e in number.params]))


def _recognised(value: float, params: PyTree, agrees, parameters_first, other) -> RecognisedNumber | None:
    """The form in which a number is recognised; None if there is none. `other`: its value for other parameters."""
    if abs(value - 1.0) <= agrees:
        return RecognisedNumber(Fraction(1))
    plain = [RecognisedNumber(fraction) for fraction in WHOLE]
    single = [RecognisedNumber(f, 0, ((name, e),)) for f in WHOLE for name in params for e in (1, -1)]
    pitch = [
        n
        for name in params
        for n in (RecognisedNumber(Fraction(2), 1, ((name, -1),)), RecognisedNumber(Fraction(1, 2), -1, ((name, 1),)))
    ]
    rest = [RecognisedNumber(f) for f in FRACTIONS] + [RecognisedNumber(f, pi) for pi in (1, -1) for f in FRACTIONS]
    pairs = [
        RecognisedNumber(f, 0, ((a, 1), (b, e)))
        for f in WHOLE for a in params for b in params if a != b for e in (1, -1)
    ]  # fmt: skip
    if parameters_first:
        order = [*plain[:1], *single, *pairs, *plain, *pitch, *rest]
    else:
        order = [*plain, *single, *pitch, *pairs, *rest]
    alike = [found for number in order if (found := _agreeing(value, number, params, agrees)) is not None]
    if other is not None:
        # Its sign is that of the first form, so it is compared, too.
        alike = [number for number in alike if abs(_value(number, other[1]) - other[0]) <= PERSISTS * abs(other[0])]
    # If two parameters have the same value, it is ambiguous which one is meant.
    clear = [found for found in alike[:1] if not found.params or _only(found, alike)]
    return (clear or [found for found in alike if not found.params] or [None])[0]


def _agreeing(value, number: RecognisedNumber, params: PyTree, agrees):
    recognised = _value(number, params) if all(params[p] for p, _ in number.params) else 0.0
    if not recognised or abs(abs(value) - abs(recognised)) > agrees * abs(value):
        return None
    return number._replace(fraction=number.fraction * int(np.sign(value * recognised)))


def _only(found: RecognisedNumber, alike):
    same = [other for other in alike if [power for _, power in other.params] == [power for _, power in found.params]
            and abs(other.fraction) == abs(found.fraction) and other.pi == found.pi]  # fmt: skip
    return len({frozenset(other.params) for other in same}) == 1


# With a smaller gap it is unclear which singular values are zero.
CLEAR_GAP = 1e3


class Found(NamedTuple):
    """A symmetry: its charge, the residual of its conservation relative to its terms, and whether it contains t.

    `coefficients`: those of the motions of the basis. `cyclic`: the charge is the momentum of a coordinate that L does
    not contain.
    """

    charge: NoetherCharge
    residual: float
    timed: bool
    coefficients: np.ndarray
    cyclic: bool


class Scaling(NamedTuple):
    """x → s^a x and t → s^b t multiply L by s^factor; exponents by name, without zeros."""

    exponents: dict[str, float]
    factor: float
    residual: float

    def __str__(self):
        of_q = {name: exponent for name, exponent in self.exponents.items() if name != "t"}
        if len(of_q) > 3 and len(set(of_q.values())) == 1:
            of_q = {f"{len(of_q)} coordinates x": next(iter(of_q.values()))}
        shown = of_q | {name: x for name, x in self.exponents.items() if name == "t"}
        moved = [f"{name} → {_power(exponent)} {name[-1] if ' ' in name else name}" for name, exponent in shown.items()]
        return f"{', '.join(moved)}: L → {_power(self.factor)} L" if self.factor else f"{', '.join(moved)}: L stays"


class Symmetries(eqx.Module):
    """The symmetries of a system within a basis: a mapping of names to charges; print it for a summary.

    `found["L_z"]` is a function of (t, q, v, params); `traj.plot(charges=found)` draws them all.

    - `details`: a `Found` for each name; those whose charge contains t (boosts, uniform forces) are `timed`.
    - `scalings`: motions that multiply L by a factor; they conserve nothing.
    - `basis`: the names of the motions of the search; `states`: the number of states at which they were tried.
    - `singular_values`: those of the motions without t, and those of all motions; `gap`: the ratio of the smallest
      nonzero one to the largest that counts as zero. Below 1000 it is unclear which are zero, and the symmetries are
      unreliable; 0 where too few states were found for so many motions.
    """

    details: dict[str, Found]
    scalings: tuple[Scaling, ...] = eqx.field(static=True)
    basis: tuple[str, ...] = eqx.field(static=True)
    states: int = eqx.field(static=True)
    singular_values: tuple[np.ndarray, np.ndarray]
    gap: float
    at: str = eqx.field(static=True)
    of: str = eqx.field(static=True)

    def __getitem__(self, name: str) -> NoetherCharge:
        if name not in self.details:
            raise KeyError(f"no symmetry '{name}' was found; there are {', '.join(map(repr, self.details)) or 'none'}")
        return self.details[name].charge

    def __iter__(self) -> Iterator[str]:
        return iter(self.details)

    def __len__(self) -> int:
        return len(self.details)

    def __contains__(self, name: str) -> bool:
        return name in self.details

    def keys(self):
        """The names of the charges."""
        return self.details.keys()

    def items(self):
        """Names and charges."""
        return {name: found.charge for name, found in self.details.items()}.items()

    @property
    def steady(self) -> tuple[str, ...]:
        """The names of the charges without t."""
        return tuple(name for name, found in self.details.items() if not found.timed)

    @property
    def timed(self) -> tuple[str, ...]:
        """The names of the charges that contain t."""
        return tuple(name for name, found in self.details.items() if found.timed)

    def __repr__(self):
        width = max([len(name) for name in self.details], default=0)
        lines = [f"Symmetries of {self.of} at {self.at}"]
        for title, names in (("conserved", self.steady), ("conserved, with t in it", self.timed)):
            if names or title == "conserved":
                lines.append(f"  {title}" + ("" if names else ": nothing"))
            for name in names:
                found = self.details[name]
                words = "exactly: cyclic" if found.cyclic else f"to {found.residual:.0e}"
                lines.append(f"    {name:<{width}}  {words}")
        if self.scalings:
            lines.append("  scalings, which conserve nothing")
            lines += [f"    {scaling}" for scaling in self.scalings]
        looked = f"looked among {len(self.basis)} motions at {self.states} states; "
        gap = "nothing is near zero" if not np.isfinite(self.gap) else f"singular values apart by {self.gap:.0e}"
        doubt = "" if self.gap > CLEAR_GAP else ": TOO LITTLE to tell what is zero"
        return "\n".join([*lines, f"  {looked}{gap}{doubt}"])


def _power(exponent):
    if exponent == 1:
        return "s"
    plain = Fraction(exponent).limit_denominator(12)
    if abs(plain - exponent) > 1e-12:
        return f"s^{exponent:.6g}"
    return f"s^{plain}" if plain.denominator == 1 else f"s^({plain})"
