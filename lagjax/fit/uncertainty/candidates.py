"""What to measure next: how certain a number would be after each of several candidate measurements.

In units of their errors, the linearised equations of the data are `A z` with errors of size one, where z holds the
parameters and the start of a run. A number that changes by c·z then has the variance

    var = cᵀ (AᵀA)⁻¹ c,        A = [A_now; H]        after measurements with the slopes H,

so that H can be assessed before anything is measured. The start of another run is unknown, and H has columns for it
that `A_now` lacks. If c has a component in the null space of `A`, the number is not determined: var is infinite.

The most informative times of a run are a c-optimal design: the times of a set are exchanged one after the other for
better ones until no exchange improves the design.

Source: Pukelsheim, *Optimal Design of Experiments*, ch. 2 (c-optimality, Elfving's theorem); Fedorov, *Theory of
Optimal Experiments* (exchange).
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from lagjax.display import by_line

# A number is determined if the undetermined directions hold no larger share than this of its squared slopes.
NEGLIGIBLE_SHARE = 1e-8
# The largest number of rounds of exchanges; few are needed.
EXCHANGE_ROUNDS = 30
# With more unknowns than this the printed table does not list the most informative times.
TIMES_SHOWN_UP_TO = 40
# The table shows this many candidates.
CANDIDATES_SHOWN = 6


class Candidate(NamedTuple):
    """A further measurement, and how certain the number would be after it.

    - `name`: of the run; or of the coordinate, for a further measurement in an existing run.
    - `t` (T,): the times at which it could be measured. `times`: those that `sd` assumes: all times of a run, the one
      best time of a coordinate.
    - `sd`: the standard deviation afterwards; infinite if the number is still not determined.
    - `alone` (T,): the standard deviation after a measurement at that one time alone.
    - `sigma`: the measurement error assumed for each quantity.
    - `rows` (T, m, n): slopes in units of the errors. `known` (r, n): the equations known without it. `direction` (n,):
      the slopes of the number itself. `least`: singular values below it are round-off.
    """

    name: str
    t: Float[np.ndarray, " T"]
    times: Float[np.ndarray, " k"]
    sd: float
    alone: Float[np.ndarray, " T"]
    sigma: dict[str, float]
    rows: Float[np.ndarray, "T m n"]
    known: Float[np.ndarray, "r n"]
    direction: Float[np.ndarray, " n"]
    least: float

    def at_best(self, count: int) -> tuple[Float[np.ndarray, " k"], float]:
        """The best `count` times to measure at, each once, and the standard deviation after these alone."""
        if not 1 <= count <= len(self.t):
            raise ValueError(f"'{self.name}' has {len(self.t)} times, and the best {count} of them were asked for.")
        chosen, sd = _exchange(self, count)
        return self.t[chosen], sd


class NextMeasurements(NamedTuple):
    """How certain a number is now, and would be after each candidate measurement, the best first.

    - `of`: the number. `now`: its standard deviation; infinite if the data do not determine it.
    - `candidates`: see `Candidate`. `best`: the first of them.
    - `absolute`: whether standard deviations are in the number's unit; else, without `sigma` in the records, they are
      multiples of the error of a measurement.
    """

    of: str
    now: float
    candidates: tuple[Candidate, ...]
    absolute: bool

    @property
    def best(self) -> Candidate:
        return self.candidates[0]

    def __getitem__(self, name: str):
        """The candidate of this name."""
        if not isinstance(name, str):
            return tuple.__getitem__(self, name)
        for candidate in self.candidates:
            if candidate.name == name:
                return candidate
        raise KeyError(f"no candidate is called '{name}': {', '.join(c.name for c in self.candidates)}")

    def __repr__(self):
        return by_line("\n".join(_lines(self)))


def assess(
    name: str,
    t: np.ndarray,
    rows: np.ndarray,
    known: np.ndarray,
    direction: np.ndarray,
    values: np.ndarray,
    sigma: Mapping[str, float],
    least: float,
    one_time: bool = False,
) -> Candidate:
    """A candidate with the standard deviations it would give, measured at all its times or at the best one.

    `values` (n,) are the unknowns at which the slopes were taken.
    """
    units = units_of(np.concatenate([known, *rows]), values, least)
    rows, known, direction = rows * units, known * units, direction * np.where(units > 0, units, 1.0)
    candidate = Candidate(name, t, t, np.inf, np.full(len(t), np.inf), sigma, rows, known, direction, least)
    alone = sd_after_each(direction, known, rows, least)
    if one_time:
        first = int(np.argmin(alone))
        return candidate._replace(times=t[first : first + 1], sd=float(alone[first]), alone=alone)
    sd = sd_of(direction, np.concatenate([known, *rows]), least)
    return candidate._replace(sd=sd, alone=alone)


def sd_of(direction: np.ndarray, rows: np.ndarray, least: float) -> float:
    """The standard deviation of a number from equations (r, n) with errors of size one; infinite if undetermined."""
    sizes, right, seen = seen_directions(rows, least)
    along = right @ direction
    if np.sum(along[~seen] ** 2) > NEGLIGIBLE_SHARE * np.sum(direction**2):
        return np.inf
    return float(np.sqrt(np.sum((along[seen] / sizes[seen]) ** 2)))


def sd_after_each(direction: np.ndarray, known: np.ndarray, rows: np.ndarray, least: float):
    """The standard deviations (T,) after adding the equations (T, m, n) of each time alone to the known ones (r, n).

    With coordinates z of the determined directions (errors of size one) and u of the undetermined ones, a time adds the
    equations `H z + G u`. Their combinations in the range of G determine u; only the others add information on z.
    """
    sizes, right, seen = seen_directions(known, least)
    of_z, of_u = right[seen].T / sizes[seen], right[~seen].T
    by_z, by_u = rows @ of_z, rows @ of_u
    left, spread, across = np.linalg.svd(by_u, full_matrices=False)
    left = np.where((spread > least)[:, None], left, 0.0)
    inverse = np.where(spread > least, 1 / np.where(spread > least, spread, 1.0), 0.0)
    # c·u = y·(G u), if c·u lies in the row space of G.
    y = np.einsum("tmi,ti,tij,j->tm", left, inverse, across, of_u.T @ direction)
    unseen = np.sum((of_u.T @ direction - np.einsum("tm,tmi->ti", y, by_u)) ** 2, axis=1)
    rest = of_z.T @ direction - np.einsum("tm,tmi->ti", y, by_z)
    more = by_z - left @ (np.swapaxes(left, 1, 2) @ by_z)
    along = np.einsum("tmi,ti->tm", more, rest)
    inner = np.eye(rows.shape[1]) + more @ np.swapaxes(more, 1, 2)
    gained = np.einsum("tm,tm->t", along, np.linalg.solve(inner, along[..., None])[..., 0])
    variance = np.sum(rest**2, axis=1) - gained + np.sum(y**2, axis=1)
    return np.where(unseen > NEGLIGIBLE_SHARE * np.sum(direction**2), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def seen_directions(rows: np.ndarray, least: float):
    """Of equations (r, n): singular values (n,), directions by row (n, n), and which of these are determined."""
    _, sizes, right = np.linalg.svd(_triangle(rows), full_matrices=True)
    sizes = np.append(sizes, np.zeros(rows.shape[1] - len(sizes)))
    return sizes, right, sizes > least


def eliminate_unknowns(by_unknown: np.ndarray, by_others: np.ndarray):
    """Slopes (m, p) after eliminating the unknowns with the slopes (m, k): the part that these cannot reproduce."""
    lengths = np.sqrt(np.sum(by_others**2, axis=0))
    taken = by_others[:, lengths > 0] / lengths[lengths > 0]
    left, sizes, _ = np.linalg.svd(taken, full_matrices=False)
    # Each eliminated direction costs information; if in doubt it is eliminated.
    left = left[:, sizes > 10 * max(by_others.shape) * np.finfo(sizes.dtype).eps]
    return _triangle(by_unknown - left @ (left.T @ by_unknown))


def _triangle(rows: np.ndarray):
    """Equivalent equations with at most as many rows as columns."""
    return rows if len(rows) <= rows.shape[1] else np.linalg.qr(rows, mode="r")


def units_of(rows: np.ndarray, values: np.ndarray, least: float) -> Float[np.ndarray, " n"]:
    """Units of the unknowns in which their slopes (r, n) have the size one; 0 for unknowns without effect on the data.

    An unknown has no effect if its relative change shows less than the round-off of the unknown that shows most.
    """
    sizes = np.sqrt(np.sum(rows**2, axis=0))
    seen = (sizes > 0) & (
        (values == 0) | (sizes * np.abs(values) > least * np.max(sizes * np.abs(values), initial=0.0))
    )
    return np.where(seen, 1 / np.where(seen, sizes, 1.0), 0.0)


def _exchange(candidate: Candidate, count: int):
    """The indices of the best times found by exchanges, and the standard deviation with them."""
    rows, known = candidate.rows, _triangle(candidate.known)
    sd_with = lambda places: sd_of(candidate.direction, np.concatenate([known, *rows[places]]), candidate.least)
    results = []
    for chosen in _initial_sets(candidate, count):
        best = sd_with(chosen)
        for _ in range(EXCHANGE_ROUNDS):
            before = best
            for i in range(count):
                others = np.delete(chosen, i)
                left = _triangle(np.concatenate([known, *rows[others]]))
                sds = sd_after_each(candidate.direction, left, rows, candidate.least)
                sds[others] = np.inf
                if sds.min() < best:
                    chosen[i], best = np.argmin(sds), sds.min()
            # `not <` also stops when both are infinite.
            if not best < before * (1 - 1e-9):
                break
        results.append((float(best), tuple(int(i) for i in np.sort(chosen))))
    best, chosen = min(results)
    return list(chosen), best


def _initial_sets(candidate: Candidate, count: int):
    """Sets of times from which exchanges start: evenly spaced, and those with the largest weights of all times."""
    total = len(candidate.t)
    yield np.round(np.linspace(0, total - 1, count)).astype(int)
    rows = np.concatenate([candidate.known, *candidate.rows])
    left, sizes, right = np.linalg.svd(rows, full_matrices=False)
    seen = sizes > candidate.least
    weights = left[:, seen] @ ((right[seen] @ candidate.direction) / sizes[seen])
    weights = np.sum(weights[len(candidate.known) :].reshape(total, -1) ** 2, axis=1)
    yield np.argsort(-weights, kind="stable")[:count].copy()


def _lines(found: NextMeasurements):
    unit = "" if found.absolute else " errors of a measurement"
    now = f"is known to ± {found.now:.2g}{unit}" if np.isfinite(found.now) else "is not determined by these data"
    lines = [f"{found.of} {now}; after one of the following:"]
    shown = found.candidates[:CANDIDATES_SHOWN]
    labels = [c.name if len(c.times) == len(c.t) else f"{c.name} at t = {c.times[0]:.4g}" for c in shown]
    width = max(map(len, labels), default=0)
    for label, c in zip(labels, shown):
        after = f"± {c.sd:.2g}" if np.isfinite(c.sd) else "not determined"
        errors = (
            ", ".join(f"{name} to {s:.2g}" for name, s in c.sigma.items() if np.isfinite(s)) if found.absolute else ""
        )
        lines.append(f"  {label:<{width}}  {after:<9}" + (f"  (measured: {errors})" if errors else ""))
    if len(found.candidates) > CANDIDATES_SHOWN:
        lines.append(f"  ... and {len(found.candidates) - CANDIDATES_SHOWN} more")
    lines += _line_of_times(found.best, unit) if shown else []
    return [line.rstrip() for line in lines]


def _line_of_times(best: Candidate, unit: str):
    """A line with the most informative times of the best run: one for each unknown of its start, one for the number."""
    of_start = np.any(best.rows != 0, axis=(0, 1)) & ~np.any(best.known != 0, axis=0)
    few = max(int(np.sum(of_start)) + 1, 2)
    of_some = len(best.times) < len(best.t) or len(best.t) <= few
    if of_some or not np.isfinite(best.sd) or len(best.direction) > TIMES_SHOWN_UP_TO:
        return []
    times, sd = best.at_best(few)
    if not np.isfinite(sd):
        return []
    when = ", ".join(f"{t:.4g}" for t in times)
    return [f"  of {best.name}, {few} of its {len(best.t)} times come to ± {sd:.2g}{unit}: t = {when}"]
