"""Laplace's approximation: the normal distribution that has the peak of a fit's density, and its curvature there.

With residuals r(u) in units of their errors, priors among them, -log density = ½ r·r + const has the second derivatives

    H = JᵀJ + S,        J = ∂r/∂u,        S = Σ rᵢ ∂²rᵢ/∂u∂u.

Gauss and Newton leave out S, which is small where residuals are, or where the motion is nearly linear in u. In
coordinates z in which JᵀJ is the identity, u = û + W z, the eigenvalues of 1 + Wᵀ S W say by how much H differs along
each direction: of an eigenvalue λ the standard deviation is 1/√λ of Gauss and Newton's; where λ ≤ 0 there is no peak.
J is never squared, so that ill-conditioned fits keep their digits. With n unknowns the evidence is

    ∫ density du ≈ density(û) (2π)^(n/2) / √det H.

Source: MacKay, *Information Theory, Inference, and Learning Algorithms*, ch. 27; Hamilton, Watts & Bates, *Ann. Stat.*
10 (1982) 386 (S in the coordinates of J).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax.fitting.candidates import NO_PART, seen_directions, units_of
from lagjax.fitting.equations import WHOLE, Problem, of_window, over_windows
from lagjax.fitting.search import UNSEEN
from lagjax.mechanics import coordinates
from lagjax.mechanics.compiled import compiled
from lagjax.numerics.chained import Unknowns

# Standard deviations that differ by more than this part are worth a word.
DIFFERS = 0.1
# An eigenvalue below this is one of no peak, or of none that derivatives of a motion can tell.
LEAST = 1e-6
# The peak of a parabola with this curvature may be so many standard deviations away.
OFF_PEAK = 0.1
# Of a direction the unknowns that have no less than this part of its largest.
TAKES_PART = 0.3


class Curved(NamedTuple):
    """Residuals, slopes J and the term S of each window, by the shared unknowns and its own."""

    rows: Float[Array, "W m"]
    slopes: Float[Array, "W m p+k"]
    term: Float[Array, "W p+k p+k"]


@partial(compiled, in_numpy=True)
def curved(problem: Problem, u: Unknowns) -> Curved:
    """The curvature of the sum of squares at `u`, forward over forward; windows have nothing else in common."""
    p = u.shared.size

    def at(w, s):
        def rows(both):
            return of_window(problem, both[:p], both[p:], w, WHOLE, diffrax.ForwardMode())[0].rows

        both = jnp.concatenate([u.shared, s])
        here = rows(both)

        def slopes(both):
            of = jax.jacfwd(rows)(both)
            return of.T @ here, of

        term, of = jax.jacfwd(slopes, has_aux=True)(both)
        return Curved(here, of, term)

    return over_windows(at, problem, u)


@dataclass(frozen=True, eq=False, repr=False)
class Laplace:
    """A normal distribution in place of a fit's density, with the true second derivatives at the estimate.

    - `names` (n,): of the unknowns: parameters, then what of the starts is not held, `theta(0)`, `v.theta(0)`.
    - `mean`, `sd` (n,), `covariance` (n, n); NaN of what has no peak. `gauss_newton` (n, n): the covariance without the
      second derivatives of the motion, as `Fit.covariance` has it.
    - `log_evidence`: the logarithm of the integral of likelihood and priors by all unknowns. What has no prior, a start
      for example, counts with the density one in its unit: only differences between fits that share those mean
      something. NaN without `sigma` in the records, with a loss that is not of squares, or where there is no peak.
    - `eigenvalues` (r,): of the Hessian in units of Gauss and Newton's, the smallest first; `directions` (r, n) of
      them, in standard deviations of Gauss and Newton. `unseen` (n - r, n): directions that the data do not see.
    - `off`: how many standard deviations the peak of the parabola is away from the estimate.
    - `caveats`: what is to be known of it, in words.
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
    # Of the unknowns by z, and their places in a row of all numbers that `starts` has room for.
    _by_z: Float[np.ndarray, "n n"]
    _places: np.ndarray

    @property
    def sd(self) -> Float[np.ndarray, " n"]:
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.diag(self.covariance))

    @property
    def positive_definite(self) -> bool:
        """Whether there is a peak in all directions."""
        return len(self.unseen) == 0 and bool(np.all(self.eigenvalues > LEAST))

    def unknowns(self, z: Float[Array, "... n"]) -> dict[str, Array]:
        """Unknowns as `Fit.log_likelihood` takes them from standardised ones: of a normal z they are normal."""
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

        z is 0 at the estimate, and each of its numbers has nearly the standard deviation 1, with no correlations.
        """
        self._check()
        return lambda z: density(self.unknowns(z))

    def sample(self, key: Array, count: int) -> dict[str, Array]:
        """So many draws, as `Fit.log_likelihood` takes unknowns, each with a leading axis."""
        self._check()
        return self.unknowns(jax.random.normal(key, (count, len(self.names)), self._at["starts"].dtype))

    def _check(self):
        if not self.positive_definite:
            raise ValueError(
                f"there is no normal distribution here: {self.caveats[0]}\n"
                "Fix: priors={...} for it, fewer numbers in free=, or a fit that has converged."
            )

    def __repr__(self):
        evidence = f", log evidence {self.log_evidence:.6g}" if np.isfinite(self.log_evidence) else ""
        lines = [f"Laplace: {len(self.names)} unknowns{evidence}"]
        width = max(map(len, self.names), default=0)
        gauss_newton = np.sqrt(np.diag(self.gauss_newton))
        for name, mean, sd, other in list(zip(self.names, self.mean, self.sd, gauss_newton))[:40]:
            lines.append(f"  {name:<{width}}  {mean:.6g} ± {sd:.3g}, by Gauss and Newton ± {other:.3g}")
        return "\n".join([*lines, *(f"  {words}" for words in self.caveats)])


def laplace(problem: Problem, u: Unknowns, variance: float) -> Laplace:
    """Laplace's approximation at `u`, where an error in sigmas has a variance."""
    at, found, p = curved(problem, u), problem.found, len(u.shared)
    if not all(np.all(np.isfinite(x)) for x in at):
        astray = ", ".join(f"{name} = {x:.4g}" for name, x in zip(found.names, u.shared))
        raise ValueError(
            f"the second derivatives of the motion are not finite at the estimate, {astray}.\n"
            "Usual cause: a number that the data do not see and that went astray, or a motion that fails.\n"
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
    peak = eigenvalues > LEAST
    safe = np.where(peak, eigenvalues, 1.0)
    by_z = np.sqrt(variance) * along / np.sqrt(safe)
    step = np.where(peak, (along.T @ gradient) / safe, 0.0)
    off = float(np.sqrt(np.sum(step**2 * safe) / variance))
    size = np.sqrt(np.sum(whitened**2, axis=1))
    # A number that has a part in a direction without a peak has no standard deviation.
    level = along[:, ~peak] * lengths[:, None]
    level = level / np.linalg.norm(level, axis=0)
    seen_part = np.sum(right[~seen] ** 2, axis=0) < NO_PART
    known = seen_part & (np.sum(level**2, axis=1) < NO_PART)
    of_known = lambda known, covariance: np.where(known[:, None] & known[None, :], covariance, np.nan)
    directions = along.T / np.where(size > 0, size, 1.0)
    evidence = np.nan
    if problem.absolute and problem.loss == "squares" and peak.all() and seen.all():
        evidence = _log_density(problem, u, at) + 0.5 * len(names) * np.log(2 * np.pi)
        evidence -= 0.5 * np.sum(np.log(eigenvalues)) + np.sum(np.log(lengths)) + np.sum(np.log(sizes))
    return Laplace(
        names,
        mean,
        of_known(known, by_z[:, peak] @ by_z[:, peak].T),
        of_known(seen_part, variance * whitened @ whitened.T),
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


def _together(problem, u, at, places):
    """Slopes (r, n) of all equations, priors among them, the gradient (n,) and the term S (n, n)."""
    (windows, _, size), p = at.slopes.shape, len(u.shared)
    k = size - p
    total = p + windows * k
    blocks, gradient, term = [], np.zeros(total), np.zeros((total, total))
    for w in range(windows):
        of = np.append(np.arange(p), p + k * w + np.arange(k)).astype(int)
        rows = at.slopes[w]
        block = np.zeros((min(len(rows), size), total))
        block[:, of] = rows if len(rows) <= size else np.linalg.qr(rows, mode="r")
        blocks.append(block)
        gradient[of] += rows.T @ at.rows[w]
        term[np.ix_(of, of)] += at.term[w]
    prior = np.zeros((p, total))
    prior[:, :p] = np.diag(1 / np.asarray(problem.found.sd))
    gradient[:p] += _of_priors(problem, u) / np.asarray(problem.found.sd)
    slopes = np.concatenate([*blocks, prior[np.isfinite(problem.found.sd)]])[:, places]
    term = term[np.ix_(places, places)]
    return slopes, gradient[places], 0.5 * (term + term.T)


def _of_priors(problem, u):
    """The residuals of what is known before, zero where nothing is."""
    return (np.asarray(u.shared) - np.asarray(problem.found.mean)) / np.asarray(problem.found.sd)


def _log_density(problem, u, at):
    """The logarithm of the normalised density of the measurements, times that of the priors."""
    prior = np.asarray(problem.found.sd)
    prior = prior[np.isfinite(prior)]
    known = []
    for x, s in zip(*map(jax.tree.leaves, problem.data)):
        known.append(np.asarray(s)[np.isfinite(x) & np.isfinite(s)])
    errors = np.concatenate([*known, prior])
    squares = np.sum(at.rows**2) + np.sum(_of_priors(problem, u) ** 2)
    return -0.5 * squares - np.sum(np.log(errors)) - 0.5 * len(errors) * np.log(2 * np.pi)


def _labels(problem):
    """The names (W k,) of the starts' unknowns, "" of those that a window has not, and what they are deviations of."""
    windows, k = problem.windows.count, problem.starts.unknowns
    labels, values = np.full((windows, k), "", object), np.zeros((windows, k))
    several = windows > 1
    by_record = windows == len(problem.windows.first)
    for w in range(windows):
        q, v = (jax.tree.map(lambda x, w=w: np.asarray(x[w]), chart) for chart in problem.starts)
        told = coordinates.names(problem.unflatten(q.guess))
        suffix = f" of {'record' if by_record else 'window'} {w}" if several else ""
        for i in range(k):
            for chart, kind in ((q, ""), (v, "v.")):
                column = chart.along[:, i]
                if not column.any():
                    continue
                alone = np.count_nonzero(column) == 1 and column.max() == 1 and chart.across.shape[-1] == 0
                j = int(np.argmax(column))
                labels[w, i] = f"{kind}{told[j]}(0){suffix}" if alone else f"starts[{w}, {i}]"
                values[w, i] = chart.guess[j] if alone else 0.0
    return labels.ravel(), values


def _caveats(names, eigenvalues, directions, unseen, off):
    """What there is to know, in words, the gravest first."""
    words = [f"the data do not see {_direction(names, row)}: no peak there." for row in unseen[:3]]
    for value, row in list(zip(eigenvalues, directions))[:3]:
        if value <= LEAST:
            words.append(f"no peak but a saddle or a flat: the density does not fall along {_direction(names, row)}.")
    if off > OFF_PEAK:
        words.append(f"the estimate is no peak: that of the parabola is {off:.2g} standard deviations away.")
    peaks = [i for i, value in enumerate(eigenvalues) if value > LEAST and abs(1 / np.sqrt(value) - 1) > DIFFERS]
    for i in sorted(peaks, key=lambda i: -abs(np.log(eigenvalues[i])))[:3]:
        times = 1 / np.sqrt(eigenvalues[i])
        words.append(f"along {_direction(names, directions[i])} the ± is {times:.2g} times that of Gauss and Newton.")
    return words


def _direction(names, row):
    """The unknowns that take part in a direction."""
    if len(names) == 1:
        return f"'{names[0]}'"
    row = row * np.sign(row[np.argmax(np.abs(row))]) / np.max(np.abs(row))
    order = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) > TAKES_PART][:4]
    if len(order) == 1:
        return f"'{names[order[0]]}'"
    return "(" + ", ".join(f"{row[i]:+.2g} '{names[i]}'" for i in order) + ")"
