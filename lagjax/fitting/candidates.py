"""What to measure next: how certain a number would be after each of some further measurements.

In units of their errors the equations of the data at a point are `A z` with errors of size one, where z holds the
parameters and the start of a run. A number that changes by c·z then has the variance

    var = cᵀ (AᵀA)⁻¹ c,        A = [A_now; H]        after measurements with the slopes H,

so that H is judged before anything of it is measured. The start of another run is unknown, and H has columns for it
that `A_now` has not. Where c has a part in what `A` takes to zero, the number is not determined: var is infinite.

Which times of a run carry its information is a c-optimal design: one time of a set after the other is exchanged for a
better one, until none is better.

Source: Pukelsheim, *Optimal Design of Experiments*, ch. 2 (c-optimality, Elfving's theorem); Fedorov, *Theory of
Optimal Experiments* (exchange).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

# A number with no larger part (squared, of its own) in what is not seen is determined.
NO_PART = 1e-8
# Rounds of exchanges; few are needed.
ROUNDS = 30
# The times that carry a run are not looked for among more unknowns, where a table is printed.
TOLD_UP_TO = 40
# So many rows are printed.
LINES = 6


class Candidate(NamedTuple):
    """A further measurement, and how certain the number would be after it.

    - `name`: of the run; or of the coordinate, of a further measurement in a run that there is.
    - `t` (T,): when something of it could be measured. `times`: at which of these it is, for `sd`: of a run all, of a
      coordinate the one best time.
    - `sd`: the standard deviation after it; infinite where the number is still not determined.
    - `alone` (T,): after a measurement at that one time.
    - `sigma`: the error that a measurement is taken to have, of each quantity.
    - `rows` (T, m, n): slopes in units of the errors. `known` (r, n): what is known without it. `direction` (n,): the
      number's own slopes. `least`: singular values below it are of round-off.
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
            raise ValueError(f"'{self.name}' has {len(self.t)} times, and the best {count} of them are asked for.")
        chosen, sd = _exchanged(self, count)
        return self.t[chosen], sd


class NextMeasurements(NamedTuple):
    """How certain a number is now, and would be after each of some further measurements, the best first.

    - `of`: the number. `now`: its standard deviation; infinite where the data do not determine it.
    - `candidates`: see `Candidate`. `best`: the first of them.
    - `absolute`: whether standard deviations are such; else, without `sigma` in the records, they are multiples of the
      error of a measurement.
    """

    of: str
    now: float
    candidates: tuple[Candidate, ...]
    absolute: bool

    @property
    def best(self) -> Candidate:
        return self.candidates[0]

    def __getitem__(self, name):
        """The candidate of this name."""
        if not isinstance(name, str):
            return tuple.__getitem__(self, name)
        for candidate in self.candidates:
            if candidate.name == name:
                return candidate
        raise KeyError(f"no candidate is called '{name}': {', '.join(c.name for c in self.candidates)}")

    def __repr__(self):
        return "\n".join(_lines(self))


def judged(name, t, rows, known, direction, values, sigma, least, one_time=False) -> Candidate:
    """A candidate with what it would do: of all its times, or of the best one; `values` (n,) are where it is judged."""
    units = units_of(np.concatenate([known, *rows]), values, least)
    rows, known, direction = rows * units, known * units, direction * np.where(units > 0, units, 1.0)
    candidate = Candidate(name, t, t, np.inf, np.full(len(t), np.inf), sigma, rows, known, direction, least)
    alone = sd_after_each(direction, known, rows, least)
    if one_time:
        first = int(np.argmin(alone))
        return candidate._replace(times=t[first : first + 1], sd=float(alone[first]), alone=alone)
    sd = sd_of(direction, np.concatenate([known, *rows]), least)
    return candidate._replace(sd=sd, alone=alone)


def sd_of(direction, rows, least) -> float:
    """The standard deviation of a number from equations (r, n) with errors of size one; infinite where it has none."""
    sizes, right, seen = seen_directions(rows, least)
    along = right @ direction
    if np.sum(along[~seen] ** 2) > NO_PART * np.sum(direction**2):
        return np.inf
    return float(np.sqrt(np.sum((along[seen] / sizes[seen]) ** 2)))


def sd_after_each(direction, known, rows, least):
    """The standard deviations (T,) after the equations of one time each, (T, m, n), beside what is known (r, n).

    In coordinates z of what is known, with errors of size one, and u of what is not, a time adds `H z + G u`. Of its
    combinations those along the range of G say what u is, and only the others say more of z.
    """
    sizes, right, seen = seen_directions(known, least)
    of_z, of_u = right[seen].T / sizes[seen], right[~seen].T
    by_z, by_u = rows @ of_z, rows @ of_u
    left, spread, across = np.linalg.svd(by_u, full_matrices=False)
    left = np.where((spread > least)[:, None], left, 0.0)
    inverse = np.where(spread > least, 1 / np.where(spread > least, spread, 1.0), 0.0)
    # c·u = y·(G u), where it can be written so.
    y = np.einsum("tmi,ti,tij,j->tm", left, inverse, across, of_u.T @ direction)
    unseen = np.sum((of_u.T @ direction - np.einsum("tm,tmi->ti", y, by_u)) ** 2, axis=1)
    rest = of_z.T @ direction - np.einsum("tm,tmi->ti", y, by_z)
    more = by_z - left @ (np.swapaxes(left, 1, 2) @ by_z)
    told = np.einsum("tmi,ti->tm", more, rest)
    inner = np.eye(rows.shape[1]) + more @ np.swapaxes(more, 1, 2)
    less = np.einsum("tm,tm->t", told, np.linalg.solve(inner, told[..., None])[..., 0])
    variance = np.sum(rest**2, axis=1) - less + np.sum(y**2, axis=1)
    return np.where(unseen > NO_PART * np.sum(direction**2), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def seen_directions(rows, least):
    """Singular values (n,), directions by row (n, n), and which of them are seen, of equations (r, n)."""
    _, sizes, right = np.linalg.svd(_triangle(rows), full_matrices=True)
    sizes = np.append(sizes, np.zeros(rows.shape[1] - len(sizes)))
    return sizes, right, sizes > least


def without(by_unknown, by_others):
    """Slopes (m, p) of equations after the unknowns with the slopes (m, k) are eliminated: what they cannot imitate."""
    lengths = np.sqrt(np.sum(by_others**2, axis=0))
    taken = by_others[:, lengths > 0] / lengths[lengths > 0]
    left, sizes, _ = np.linalg.svd(taken, full_matrices=False)
    # Directions that are taken for seen cost information: rather too many than too few.
    left = left[:, sizes > 10 * max(by_others.shape) * np.finfo(sizes.dtype).eps]
    return _triangle(by_unknown - left @ (left.T @ by_unknown))


def _triangle(rows):
    """No more rows than columns that say the same."""
    return rows if len(rows) <= rows.shape[1] else np.linalg.qr(rows, mode="r")


def units_of(rows, values, least) -> Float[np.ndarray, " n"]:
    """Units of the unknowns in which their slopes (r, n) have the size one; 0 of those that leave no trace.

    A relative change of a value that shows less than round-off of the largest one does is none.
    """
    sizes = np.sqrt(np.sum(rows**2, axis=0))
    seen = (sizes > 0) & (
        (values == 0) | (sizes * np.abs(values) > least * np.max(sizes * np.abs(values), initial=0.0))
    )
    return np.where(seen, 1 / np.where(seen, sizes, 1.0), 0.0)


def _exchanged(candidate: Candidate, count):
    """The places of the best times that exchanges find, and the standard deviation after them."""
    rows, known = candidate.rows, _triangle(candidate.known)
    after = lambda places: sd_of(candidate.direction, np.concatenate([known, *rows[places]]), candidate.least)
    found = []
    for chosen in _beginnings(candidate, count):
        best = after(chosen)
        for _ in range(ROUNDS):
            before = best
            for i in range(count):
                others = np.delete(chosen, i)
                left = _triangle(np.concatenate([known, *rows[others]]))
                sds = sd_after_each(candidate.direction, left, rows, candidate.least)
                sds[others] = np.inf
                if sds.min() < best:
                    chosen[i], best = np.argmin(sds), sds.min()
            # Also where both are infinite.
            if not best < before * (1 - 1e-9):
                break
        found.append((float(best), tuple(int(i) for i in np.sort(chosen))))
    best, chosen = min(found)
    return list(chosen), best


def _beginnings(candidate, count):
    """Sets of times from which exchanges begin: evenly spread, and those that weigh most when all are measured."""
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
    shown = found.candidates[:LINES]
    labels = [c.name if len(c.times) == len(c.t) else f"{c.name} at t = {c.times[0]:.4g}" for c in shown]
    width = max(map(len, labels), default=0)
    for label, c in zip(labels, shown):
        after = f"± {c.sd:.2g}" if np.isfinite(c.sd) else "not determined"
        errors = (
            ", ".join(f"{name} to {s:.2g}" for name, s in c.sigma.items() if np.isfinite(s)) if found.absolute else ""
        )
        lines.append(f"  {label:<{width}}  {after:<9}" + (f"  (measured: {errors})" if errors else ""))
    if len(found.candidates) > LINES:
        lines.append(f"  ... and {len(found.candidates) - LINES} more")
    lines += _of_times(found.best, unit) if shown else []
    return [line.rstrip() for line in lines]


def _of_times(best, unit):
    """The few times that carry the best run: one for each unknown of its start, and one for the number."""
    of_start = np.any(best.rows != 0, axis=(0, 1)) & ~np.any(best.known != 0, axis=0)
    few = max(int(np.sum(of_start)) + 1, 2)
    of_some = len(best.times) < len(best.t) or len(best.t) <= few
    if of_some or not np.isfinite(best.sd) or len(best.direction) > TOLD_UP_TO:
        return []
    times, sd = best.at_best(few)
    if not np.isfinite(sd):
        return []
    when = ", ".join(f"{t:.4g}" for t in times)
    return [f"  of {best.name}, {few} of its {len(best.t)} times come to ± {sd:.2g}{unit}: t = {when}"]
