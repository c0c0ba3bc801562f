"""Which combinations of parameters the data determine: the singular values of the motion's sensitivity.

In relative changes δx/x the equations at a point are `R δx/x`, with the starts of the runs eliminated. A right singular
vector n whose singular value vanishes is a change of the parameters without effect on the data: if m and M can grow by
one factor and the motion stays the same, the data determine only m/M. A singular value s means that the combination is
known to the relative error 1/s, in units of the measurement error.

Source: Brun, Reichert & Künsch, *Water Resources Research* 37 (2001) 1015, Eqs. (6)-(9); Belsley, *Regression
Diagnostics*, §3.2.
"""

from collections.abc import Sequence
from fractions import Fraction
from itertools import combinations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from lagjax.display import by_line
from lagjax.fit.uncertainty.candidates import NextMeasurements
from lagjax.mechanics import listed
from lagjax.numerics import null_space

# A combination is written as a product of powers (m/M, k/m², but not m^0.37 M^-1.2) if its scaled exponents are
# fractions with denominators up to the first number, to within the second.
LARGEST_DENOMINATOR, EXPONENT_ERROR = 4, 1e-3
# With more parameters than this the simplest combinations are not searched for.
ENUMERATE_UP_TO = 10


class Identifiability(eqx.Module):
    """Which combinations of the parameters the data determine. It prints itself in words.

    - `names`: the names of the parameters. `values` (p,): the point at which they were examined.
    - `singular_values` (p,): the largest first; the reciprocal of a relative error, in units of `noise`.
    - `combinations` (p, p): by row, the relative changes that belong to them.
    - `noise`: the size of an error in sigmas: 1 if sigmas were given; else estimated by a fit, and unknown before it.
    - `next`: what to measure next, if this was asked with `shrink=`: `next.best`, `next.candidates`, `next.now`.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[Array, " p"]
    singular_values: Float[Array, " p"]
    combinations: Float[Array, "p p"]
    noise: Float[Array, ""] | None
    next: NextMeasurements | None = None

    @property
    def rank(self) -> int:
        """How many independent combinations the data determine."""
        return rank_of(np.asarray(self.singular_values))

    def combined(self) -> list[str]:
        """The combinations that the data determine, as products of powers if possible."""
        return [_combination(self.names, row) for row in _simplest(np.asarray(self.combinations)[: self.rank])]

    def _common_factor(self) -> list[str]:
        """The parameters that can all grow by one factor, if that is the last combination; else an empty list."""
        row = np.asarray(self.combinations)[-1]
        members = _members(row)
        return [self.names[i] for i in members] if np.ptp(row[members]) < EXPONENT_ERROR else []

    def unseen(self) -> list[str]:
        """The names of the parameters without effect on the data, alone or together with others."""
        rows = np.asarray(self.combinations)[: self.rank]
        seen = np.sqrt(np.sum(rows**2, axis=0)) > EXPONENT_ERROR
        return [name for name, s in zip(self.names, seen) if not s]

    def __repr__(self):
        following = [] if self.next is None else [f"  {line}" for line in repr(self.next).splitlines()]
        return by_line("\n".join([self._own_lines(), *following]))

    def _own_lines(self):
        names, rank = listed(list(self.names)), self.rank
        if not self.names:
            return "Identifiability: no parameter is asked for, only starts"
        if len(self.names) > ENUMERATE_UP_TO:
            return f"Identifiability: of {len(self.names)} numbers the data see {rank} combinations"
        if rank == len(self.names):
            lines = [f"Identifiability: the data see {names}"]
        elif rank == len(self.names) - 1 and len(self._common_factor()) > 2:
            which = "all" if len(self._common_factor()) == len(self.names) else listed(self._common_factor())
            lines = [f"Identifiability: the data see {names} but for one common factor of {which}"]
        else:
            lines = [f"Identifiability: of {names} the data see only", *(f"  {words}" for words in self.combined())]
        if self.unseen():
            lines.append(f"  {listed(self.unseen())}: no trace in the data")
        if self.noise is not None and np.isfinite(self.noise) and rank:
            error = float(self.noise) / float(np.asarray(self.singular_values)[rank - 1])
            least = _mixture(self.names, np.asarray(self.combinations)[rank - 1])
            lines.append(f"  least certain: {least}, to {error:.2g}")
        return "\n".join(lines)


def rank_of(singular_values: np.ndarray) -> int:
    """How many of them are above round-off."""
    floor = np.sqrt(np.finfo(singular_values.dtype).eps)
    return int(np.sum(singular_values > floor * np.max(singular_values, initial=0.0)))


def _simplest(rows: np.ndarray):
    """A basis of the space of some orthonormal rows, each with as few entries as possible."""
    rank, p = rows.shape
    if rank in (0, p) or p > ENUMERATE_UP_TO:
        return np.eye(p) if rank == p else rows
    unseen = null_space(rows)
    basis = np.zeros((0, p))
    for size in range(1, p + 1):
        for support in combinations(range(p), size):
            # A vector with these entries alone that is orthogonal to the undetermined directions.
            _, s, vt = np.linalg.svd(unseen[list(support)].T)
            if len(s) == size and s[-1] > EXPONENT_ERROR:
                continue
            row = np.zeros(p)
            row[list(support)] = vt[-1]
            if np.linalg.matrix_rank(np.vstack([basis, row]), tol=EXPONENT_ERROR) > len(basis):
                basis = np.vstack([basis, row])
            if len(basis) == rank:
                return basis
    return rows


def _members(row: np.ndarray):
    return [int(i) for i in np.flatnonzero(np.abs(row) > 1e-3 * np.max(np.abs(row)))]


def _exponents(row: np.ndarray, members: np.ndarray):
    """The entries as small whole numbers, up to a common factor; None if there are none."""
    smallest = min((row[i] for i in members), key=abs)
    ratios = [Fraction(float(row[i] / smallest)).limit_denominator(LARGEST_DENOMINATOR) for i in members]
    if any(
        abs(float(f) - row[i] / smallest) > EXPONENT_ERROR * abs(row[i] / smallest) for f, i in zip(ratios, members)
    ):
        return None
    whole = np.lcm.reduce([f.denominator for f in ratios])
    return [int(f * whole) for f in ratios]


def _combination(names: Sequence[str], row: np.ndarray):
    members = _members(row)
    exponents = _exponents(row, members)
    if exponents is None:
        return _mixture(names, row)
    if exponents[0] < 0:
        exponents = [-e for e in exponents]
    up = [names[i] + _power(e) for i, e in zip(members, exponents) if e > 0]
    down = [names[i] + _power(-e) for i, e in zip(members, exponents) if e < 0]
    below = f"({' '.join(down)})" if len(down) > 1 else "".join(down)
    return " ".join(up) + (f"/{below}" if down else "")


def _power(e: float):
    return "" if e == 1 else f"^{e}"


def _mixture(names: Sequence[str], row: np.ndarray):
    """A relative change of several parameters, without those that hardly take part."""
    row = np.asarray(row)
    members = sorted(np.flatnonzero(np.abs(row) > 0.1 * np.max(np.abs(row))), key=lambda i: -abs(row[i]))[:4]
    if len(members) == 1:
        return names[members[0]]
    row = row * np.sign(row[members[0]])
    return " ".join(f"{row[i]:+.2g} δ{names[i]}/{names[i]}" for i in members).lstrip("+")
