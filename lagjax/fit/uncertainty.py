"""What the data say, and do not: the combinations of parameters that they determine, and Laplace's approximation.

**Identifiable combinations**: the singular values of the motion's sensitivity.

In relative changes δx/x the equations at a point are `R δx/x`, with the starts of the runs eliminated. A right singular
vector n whose singular value vanishes is a change of the parameters without effect on the data: if m and M can grow by
one factor and the motion stays the same, the data determine only m/M. A singular value s means that the combination is
known to the relative error 1/s, in units of the measurement error.

Source: Brun, Reichert & Künsch, *Water Resources Research* 37 (2001) 1015, Eqs. (6)-(9); Belsley, *Regression
Diagnostics*, §3.2.

**Laplace's approximation**: the normal distribution with the peak of a fit's density and its curvature there.

With residuals r(u) in units of their errors, including priors, -log density = ½ r·r + const has the second derivatives

    H = JᵀJ + S,        J = ∂r/∂u,        S = Σ rᵢ ∂²rᵢ/∂u∂u.

The Gauss-Newton approximation leaves out S, which is small if the residuals are small or the motion is nearly linear in
u. In coordinates z in which JᵀJ is the identity, u = û + W z, the eigenvalues of 1 + Wᵀ S W say by how much H differs
along each direction: for an eigenvalue λ the standard deviation is 1/√λ times that of Gauss-Newton; if λ ≤ 0 there is
no peak. J is never squared, so ill-conditioned fits keep their digits. With n unknowns the evidence is

    ∫ density du ≈ density(û) (2π)^(n/2) / √det H.

Source: MacKay, *Information Theory, Inference, and Learning Algorithms*, ch. 27; Hamilton, Watts & Bates, *Ann. Stat.*
10 (1982) 386 (S in the coordinates of J).
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import combinations
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.display import by_line, labelled, printable
from lagjax.fit.arguments import problem_of
from lagjax.fit.next_measurement import (
    NEGLIGIBLE_SHARE,
    NextMeasurements,
    next_measurements,
    seen_directions,
    survey,
    units_of,
)
from lagjax.fit.records import Record
from lagjax.fit.residuals import WHOLE, FitProblem, check_motion, over_windows, window_part
from lagjax.fit.search import UNSEEN, evaluate
from lagjax.jaxtools import compiled
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns, null_space
from lagjax.refusals import must_have_values
from lagjax.system import Hybrid, System, coordinates

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


# Standard deviations that differ by more than this fraction from Gauss-Newton's get a caveat.
DIFFERS = 0.1
# With an eigenvalue below this there is no peak, as far as the derivatives of a motion can tell.
FLAT_BELOW = 1e-6
# An estimate counts as the peak if that of the parabola is at most this many standard deviations away.
OFF_PEAK = 0.1
# A direction is described by its entries above this fraction of the largest one.
TAKES_PART = 0.3


class Curvature(NamedTuple):
    """Residuals, slopes J and the term S of each window, by the shared unknowns and its local ones."""

    rows: Float[Array, "W m"]
    slopes: Float[Array, "W m p+k"]
    term: Float[Array, "W p+k p+k"]


@partial(compiled, in_numpy=True)
def curvature(problem: FitProblem, u: Unknowns) -> Curvature:
    """The curvature of the sum of squares at `u`, window by window, by forward mode over forward mode."""
    p = u.shared.size

    def at(w: Array, s: Array):
        def rows(both: Array):
            return window_part(problem, both[:p], both[p:], w, WHOLE, diffrax.ForwardMode())[0].rows

        both = jnp.concatenate([u.shared, s])
        here = rows(both)

        def slopes(both: Array):
            jacobian = jax.jacfwd(rows)(both)
            return jacobian.T @ here, jacobian

        term, jacobian = jax.jacfwd(slopes, has_aux=True)(both)
        return Curvature(here, jacobian, term)

    return over_windows(at, problem, u)


@dataclass(frozen=True, eq=False, repr=False)
class Laplace:
    """A normal distribution that approximates a fit's density, with the true second derivatives at the estimate.

    - `names` (n,): the unknowns: parameters, then the coordinates and velocities of the starts that are not held,
      `theta(0)`, `v.theta(0)`.
    - `mean`, `sd` (n,), `covariance` (n, n); NaN for unknowns without a peak. `gauss_newton` (n, n): the covariance
      without the second derivatives of the motion, as in `Fit.covariance`.
    - `log_evidence`: the logarithm of the integral of likelihood times priors over all unknowns. An unknown without a
      prior, such as a start, counts with the density one in its unit, so only differences between fits that share these
      unknowns mean something. NaN without `sigma` in the records, with a loss other than squares, or without a peak.
    - `eigenvalues` (r,): of the Hessian in units of the Gauss-Newton one, the smallest first; `directions` (r, n) of
      them, in Gauss-Newton standard deviations. `unseen` (n - r, n): directions that the data do not determine.
    - `off`: how many standard deviations the peak of the parabola is away from the estimate.
    - `caveats`: the reservations about it, in words.
    """

    names: tuple[str, ...]
    mean: Float[np.ndarray, " n"]
    covariance: Float[np.ndarray, "n n"]
    gauss_newton: Float[np.ndarray, "n n"]
    log_evidence: float
    eigenvalues: Float[np.ndarray, " r"]
    directions: Float[np.ndarray, "r n"]
    unseen: Float[np.ndarray, "u n"]
    off: float
    caveats: tuple[str, ...]
    _at: dict[str, np.ndarray]
    # The slopes of the unknowns by z, and the indices of the unknowns in a row of all parameters and `starts`.
    _by_z: Float[np.ndarray, "n n"]
    _places: np.ndarray

    @property
    def sd(self) -> Float[np.ndarray, " n"]:
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.diag(self.covariance))

    @property
    def positive_definite(self) -> bool:
        """Whether there is a peak in all directions."""
        return len(self.unseen) == 0 and bool(np.all(self.eigenvalues > FLAT_BELOW))

    def unknowns(self, z: Float[Array, "... n"]) -> dict[str, Array]:
        """The unknowns that belong to standardised ones z, as `Fit.log_likelihood` takes them."""
        self._check()
        z = jnp.asarray(z)
        moved = z @ jnp.asarray(self._by_z.T, z.dtype)
        shared = [name for name in self._at if name != "starts"]
        starts = jnp.asarray(self._at["starts"], z.dtype)
        row = jnp.zeros((*z.shape[:-1], len(shared) + starts.size), z.dtype).at[..., self._places].set(moved)
        found = {name: jnp.asarray(self._at[name], z.dtype) + row[..., i] for i, name in enumerate(shared)}
        of_starts = row[..., len(shared) :].reshape(*z.shape[:-1], *starts.shape)
        return found | {"starts": jnp.broadcast_to(starts, of_starts.shape) + of_starts}

    def standardised(self, density: Callable) -> Callable[[Float[Array, " n"]], Float[Array, ""]]:
        """A density of unknowns by name, such as `Fit.log_posterior`, as one of a vector z (n,) for a sampler.

        z is 0 at the estimate; its entries are nearly uncorrelated, with standard deviations of nearly 1.
        """
        self._check()
        return lambda z: density(self.unknowns(z))

    def sample(self, key: Array, count: int) -> dict[str, Array]:
        """`count` random draws of the unknowns, as `Fit.log_likelihood` takes them, each with a leading axis."""
        self._check()
        return self.unknowns(jax.random.normal(key, (count, len(self.names)), self._at["starts"].dtype))

    def _check(self):
        if not self.positive_definite:
            raise ValueError(
                f"there is no normal distribution here: {self.caveats[0]}\n"
                "Fix: priors={...}, fewer numbers in free=, or a fit that has converged."
            )

    def __repr__(self):
        evidence = f", log evidence {self.log_evidence:.6g}" if np.isfinite(self.log_evidence) else ""
        numbers = zip(self.names, self.mean, self.sd, np.sqrt(np.diag(self.gauss_newton)))
        rows = [
            (name, f"{mean:.6g} ± {sd:.3g}, by Gauss and Newton ± {other:.3g}") for name, mean, sd, other in numbers
        ]
        found = labelled(f"Laplace: {len(self.names)} unknowns{evidence}", rows[:40])
        return "\n".join([found, *(printable(f"  {words}") for words in self.caveats)])


def laplace(problem: FitProblem, u: Unknowns, variance: float) -> Laplace:
    """Laplace's approximation at `u`; `variance` is that of an error in sigmas."""
    at, found, p = curvature(problem, u), problem.found, len(u.shared)
    if not all(np.all(np.isfinite(x)) for x in at):
        values = ", ".join(f"{name} = {x:.4g}" for name, x in zip(found.names, u.shared))
        raise ValueError(
            f"the second derivatives of the motion are not finite at the estimate, {values}.\n"
            "Usual cause: a number that the data do not determine and that went astray, or a motion that fails.\n"
            "Fix: fewer numbers in free=, priors={...}, or a fit that has converged."
        )
    labels, starts_at = _labels(problem)
    places = np.append(np.arange(p), p + np.flatnonzero(labels != "")).astype(int)
    names = (*found.names, *labels[labels != ""])
    mean = np.concatenate([np.asarray(u.shared), (starts_at + np.asarray(u.local)).ravel()])[places]
    slopes, gradient, term = _together(problem, u, at, places)
    least = float(np.sqrt(np.finfo(problem.windows.ts.dtype).eps) / UNSEEN)
    units = units_of(slopes, np.append(np.asarray(u.shared), np.zeros(len(names) - p)), least)
    lengths = 1 / np.where(units > 0, units, 1.0)
    sizes, right, seen = seen_directions(slopes * units, least)
    whitened = right[seen].T / sizes[seen] / lengths[:, None]
    eigenvalues, turned = np.linalg.eigh(np.eye(int(seen.sum())) + whitened.T @ term @ whitened)
    along = whitened @ turned
    peak = eigenvalues > FLAT_BELOW
    safe = np.where(peak, eigenvalues, 1.0)
    by_z = np.sqrt(variance) * along / np.sqrt(safe)
    step = np.where(peak, (along.T @ gradient) / safe, 0.0)
    off = float(np.sqrt(np.sum(step**2 * safe) / variance))
    size = np.sqrt(np.sum(whitened**2, axis=1))
    # A number that takes part in a direction without a peak has no standard deviation.
    level = along[:, ~peak] * lengths[:, None]
    level = level / np.linalg.norm(level, axis=0)
    seen_part = np.sum(right[~seen] ** 2, axis=0) < NEGLIGIBLE_SHARE
    known = seen_part & (np.sum(level**2, axis=1) < NEGLIGIBLE_SHARE)
    directions = along.T / np.where(size > 0, size, 1.0)
    evidence = np.nan
    if problem.absolute and problem.loss == "squares" and peak.all() and seen.all():
        evidence = _log_density(problem, u, at) + 0.5 * len(names) * np.log(2 * np.pi)
        evidence -= 0.5 * np.sum(np.log(eigenvalues)) + np.sum(np.log(lengths)) + np.sum(np.log(sizes))
    return Laplace(
        names,
        mean,
        np.where(np.outer(known, known), by_z[:, peak] @ by_z[:, peak].T, np.nan),
        np.where(np.outer(seen_part, seen_part), variance * whitened @ whitened.T, np.nan),
        float(evidence),
        eigenvalues,
        directions,
        right[~seen],
        off,
        tuple(_caveats(names, eigenvalues, directions, right[~seen], off)),
        {name: np.asarray(x) for name, x in zip(found.names, u.shared)} | {"starts": np.asarray(u.local)},
        by_z,
        places,
    )


def _together(problem: FitProblem, u: Unknowns, at: Curvature, places: Sequence):
    """Slopes (r, n) of all equations, including priors, the gradient (n,) and the term S (n, n)."""
    (windows, _, size), p = at.slopes.shape, len(u.shared)
    k = size - p
    total = p + windows * k
    blocks, gradient, term = [], np.zeros(total), np.zeros((total, total))
    for w in range(windows):
        columns = np.append(np.arange(p), p + k * w + np.arange(k)).astype(int)
        rows = at.slopes[w]
        block = np.zeros((min(len(rows), size), total))
        block[:, columns] = rows if len(rows) <= size else np.linalg.qr(rows, mode="r")
        blocks.append(block)
        gradient[columns] += rows.T @ at.rows[w]
        term[np.ix_(columns, columns)] += at.term[w]
    prior = np.zeros((p, total))
    prior[:, :p] = np.diag(1 / np.asarray(problem.found.sd))
    gradient[:p] += _prior_residuals(problem, u) / np.asarray(problem.found.sd)
    slopes = np.concatenate([*blocks, prior[np.isfinite(problem.found.sd)]])[:, places]
    term = term[np.ix_(places, places)]
    return slopes, gradient[places], 0.5 * (term + term.T)


def _prior_residuals(problem: FitProblem, u: Unknowns):
    """The residuals of the priors; zero for parameters without one."""
    return (np.asarray(u.shared) - np.asarray(problem.found.mean)) / np.asarray(problem.found.sd)


def _log_density(problem: FitProblem, u: Unknowns, at):
    """The logarithm of the normalised density of the measurements and the priors."""
    prior = np.asarray(problem.found.sd)
    prior = prior[np.isfinite(prior)]
    known = []
    for x, s in zip(*map(jax.tree.leaves, problem.data)):
        known.append(np.asarray(s)[np.isfinite(x) & np.isfinite(s)])
    errors = np.concatenate([*known, prior])
    squares = np.sum(at.rows**2) + np.sum(_prior_residuals(problem, u) ** 2)
    return -0.5 * squares - np.sum(np.log(errors)) - 0.5 * len(errors) * np.log(2 * np.pi)


def _labels(problem: FitProblem):
    """The names (W k,) of the starts' unknowns, "" where a window has none, and the values that they deviate from."""
    windows, k = problem.windows.count, problem.starts.unknowns
    labels, values = np.full((windows, k), "", object), np.zeros((windows, k))
    several = windows > 1
    by_record = windows == len(problem.windows.first)
    for w in range(windows):
        q, v = (jax.tree.map(lambda x, w=w: np.asarray(x[w]), chart) for chart in problem.starts)
        names = coordinates.names(problem.unflatten(q.guess))
        suffix = f" of {'record' if by_record else 'window'} {w}" if several else ""
        for i in range(k):
            for chart, kind in ((q, ""), (v, "v.")):
                column = chart.along[:, i]
                if not column.any():
                    continue
                alone = np.count_nonzero(column) == 1 and column.max() == 1 and chart.across.shape[-1] == 0
                j = int(np.argmax(column))
                labels[w, i] = f"{kind}{names[j]}(0){suffix}" if alone else f"starts[{w}, {i}]"
                values[w, i] = chart.guess[j] if alone else 0.0
    return labels.ravel(), values


def _caveats(names: Sequence[str], eigenvalues: np.ndarray, directions: np.ndarray, unseen: np.ndarray, off: float):
    """The reservations about the approximation, in words, the most serious first."""
    words = [f"the data do not determine {_direction(names, row)}: no peak there." for row in unseen[:3]]
    for value, row in list(zip(eigenvalues, directions))[:3]:
        if value <= FLAT_BELOW:
            words.append(f"no peak, but a saddle or plateau: the density does not fall along {_direction(names, row)}.")
    if off > OFF_PEAK:
        words.append(f"the estimate is not the peak: that of the parabola is {off:.2g} standard deviations away.")
    peaks = [i for i, value in enumerate(eigenvalues) if value > FLAT_BELOW and abs(1 / np.sqrt(value) - 1) > DIFFERS]
    for i in sorted(peaks, key=lambda i: -abs(np.log(eigenvalues[i])))[:3]:
        times = 1 / np.sqrt(eigenvalues[i])
        words.append(f"along {_direction(names, directions[i])} the ± is {times:.2g} times that of Gauss and Newton.")
    return words


def _direction(names: Sequence[str], row):
    """The unknowns that take part in a direction, in words."""
    if len(names) == 1:
        return f"'{names[0]}'"
    row = row * np.sign(row[np.argmax(np.abs(row))]) / np.max(np.abs(row))
    order = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) > TAKES_PART][:4]
    if len(order) == 1:
        return f"'{names[order[0]]}'"
    return "(" + ", ".join(f"{row[i]:+.2g} '{names[i]}'" for i in order) + ")"


def identifiability(
    system: System | Hybrid,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    window: float | None = None,
    shrink: str | Callable | None = None,
    candidates: Mapping[str, Record] | None = None,
    **options,
) -> Identifiability:
    """Say which combinations of parameters measurements like these determine, before anything is fitted.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2)
    >>> t = jnp.linspace(0.0, 10.0, 60)
    >>> print(identifiability(spring, lj.Record(t, q=jnp.cos(t)), {"m": 1.0, "k": 1.0}))
    Identifiability: of 'k' and 'm' the data see only
      k/m

    What to measure next to know k better (`next.candidates` lists all candidates, `next.best` the best with its times):

    >>> record = lj.Record(t, q=jnp.cos(t), sigma=0.01)
    >>> asked = identifiability(spring, record, {"m": 1.0, "k": 1.0}, free="k", shrink="k")
    >>> print(asked.next.best.name, asked.next.best.times.round(1), asked.next.best.sd < asked.next.now)
    q [20.2] True

    **Arguments:** as for `lj.fit`. Only the times, the measured quantities and `sigma` count, not the measured values;
    the answer holds at `params` and at the guessed starts.

    - `shrink`: the name of the parameter whose uncertainty should shrink, `"k"`; or a function of `params` that returns
      such a number.
    - `candidates`: by name, a `lj.Record` of each run that could be measured next: its times, what would be measured
      (any numbers, such as `np.zeros(50)`; NaN where nothing is measured), `sigma`, the start `q0` and `v0`, and its
      own `params`. The start is an unknown, as in a fit, unless `hold_q` and `hold_v` say that it is known. By default
      the candidates are one further measurement of each coordinate and velocity in the existing runs, during the run or
      within the same length of time after it. A quantity that the records do not measure is assumed to have the error
      that `sigma` gives, if `sigma` is one number or has an entry for its kind; else it is left out.

    **Returns:** an `Identifiability`; with `shrink` its `next` says how certain the number is now and would be after
    each candidate, to first order in the errors (from the slopes at `params`).

    **Raises:** as `lj.fit`; `ValueError` if `shrink` is not among the fitted parameters, or the motion of a candidate
    fails.

    Source: Pukelsheim, *Optimal Design of Experiments*, ch. 2.
    """

    def problem_for(records: Sequence[Record], observe: Callable | None):
        return problem_of(
            system, records, params, free, observe, None, priors, "squares", window, dict(options), weak=False
        )

    problem = problem_for(records, observe)
    if shrink is None and candidates is not None:
        raise ValueError('candidates= needs shrink=, the number that they are compared by.\nFix: shrink="g".')
    at = None if shrink is None else survey(problem, problem.start)
    evaluation = evaluate(problem, problem.start, WHOLE) if at is None else at.evaluation
    fix = "call it in a Python loop, not in jit, vmap or lj.sweep: it is compiled only once"
    must_have_values(evaluation, "identifiability needs the values of its arguments", fix)
    check_motion(problem, evaluation.well, problem.start)
    following = None
    if at is not None:
        runs = [records] if isinstance(records, Record) else list(records)

        def of_candidates(runs: Sequence[Record]):
            # Only candidates with `observed` measurements take `observe`.
            return problem_for(runs, observe if "observed" in runs[0].measured else None)

        following = next_measurements(problem, runs, at, shrink, candidates, of_candidates)
    noise = np.asarray(1.0) if problem.absolute else None
    return Identifiability(
        problem.found.names, problem.found.start, evaluation.singular_values, evaluation.combinations, noise, following
    )
