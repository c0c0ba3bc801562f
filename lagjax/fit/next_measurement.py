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

A candidate is another run, with its own unknown start, or a further measurement in an existing run: of each coordinate,
at the times of its record and for the same length of time after it. The slopes depend on which quantities are measured
and when, not on the measured values.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from lagjax.display import by_line, columns
from lagjax.fit.records import Record, Windows, channel_name, closest, padded
from lagjax.fit.residuals import WHOLE, FitProblem, check_predicted
from lagjax.fit.search import UNSEEN, Evaluation, LinearisedResiduals, evaluation_from, linearised
from lagjax.integrate import integrate
from lagjax.jaxtools import compiled, filled_up
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns
from lagjax.refusals import must, must_be, must_be_whole, must_name, must_return

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
        must_be_whole(count, f"the number of best times of '{self.name}'", most=len(self.t), fix="at_best(1)")
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
    rows = []
    for label, c in zip(labels, shown):
        after = f"± {c.sd:.2g}" if np.isfinite(c.sd) else "not determined"
        errors = (
            ", ".join(f"{name} to {s:.2g}" for name, s in c.sigma.items() if np.isfinite(s)) if found.absolute else ""
        )
        rows.append((label, after, f"(measured: {errors})" if errors else ""))
    lines += [f"  {line}" for line in columns(rows, "<")]
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


class Survey(NamedTuple):
    """What the data determine at one point, with the slopes of all equations there."""

    linear: LinearisedResiduals
    evaluation: Evaluation


@partial(compiled, in_numpy=True)
def survey(problem: FitProblem, u: Unknowns) -> Survey:
    """The result of `evaluate`, and the slopes behind it. All runs of the same form share one program."""
    check_predicted(problem)
    linear = linearised(problem, u, WHOLE, "squares")
    return Survey(linear, evaluation_from(problem, u, linear, WHOLE))


class KnownMotion(NamedTuple):
    """The equations of the records, with errors of size one and the starts eliminated.

    `shared` (r, p): those of all windows and of the priors. `each` (q, p): those of each window, in a list. `prior`
    (h, p): those of the priors.
    """

    shared: Float[np.ndarray, "r p"]
    each: list[Float[np.ndarray, "q p"]]
    prior: Float[np.ndarray, "h p"]

    def without_window(self, w: int) -> Float[np.ndarray, "r p"]:
        """The equations of all windows but w, and of the priors."""
        return np.concatenate([self.prior, *(rows for i, rows in enumerate(self.each) if i != w)])


def next_measurements(
    problem: FitProblem,
    records: list[Record],
    at: Survey,
    shrink: str | Callable,
    candidates: Mapping[str, Record] | None,
    problem_for: Callable[[list[Record]], FitProblem],
) -> NextMeasurements:
    """How certain a number would be after each candidate; `problem_for(records)` makes the problem of some runs."""
    name, direction = _direction(problem, shrink)
    slopes = at.linear.slopes
    each = [eliminate_unknowns(*blocks) for blocks in zip(slopes.rows_by_shared, slopes.rows_by_local)]
    prior = np.asarray(slopes.shared)
    known = KnownMotion(np.concatenate([prior, *each]), each, prior)
    # The same threshold as in `evaluation_from`.
    least = float(np.sqrt(np.finfo(problem.windows.ts.dtype).eps) / UNSEEN)
    units = units_of(known.shared, np.asarray(problem.found.start), least)
    # Without sigmas the rows are in units of one common size, so standard deviations are multiples of the error.
    error = 1.0 if problem.absolute else float(jax.tree.leaves(problem.sigma)[0].ravel()[0])
    now = sd_of(direction * np.where(units > 0, units, 1.0), known.shared * units, least) / error
    if candidates is None:
        assessed = _further_measurements(problem, records, at, known, direction, least)
    else:
        assessed = _candidate_runs(problem, candidates, known, direction, least, problem_for)
    scaled = [c._replace(sd=c.sd / error, alone=c.alone / error, direction=c.direction / error) for c in assessed]
    return NextMeasurements(name, now, tuple(sorted(scaled, key=lambda c: c.sd)), problem.absolute)


def _direction(problem: FitProblem, shrink: str | Callable):
    """The name of a number, and its slopes by the fitted parameters."""
    names, x = problem.found.names, jnp.asarray(problem.found.start)
    if callable(shrink):

        def number(x: Array):
            return jnp.asarray(shrink(problem.found.into(x)))

        shape, fix = jax.eval_shape(number, x), 'shrink=lambda params: params["g"] / params["l"]'
        must_return(shape.shape == (), "shrink(params)", "a single number", shape, fix)
        name = getattr(shrink, "__name__", "shrink")
        direction = np.asarray(jax.grad(number)(x))
        if not np.all(np.isfinite(direction)) or not np.any(direction):
            what = "has no finite slope" if np.any(direction) else "does not depend on the fitted parameters"
            raise ValueError(f"shrink(params) {what} here: {listed(list(names))}.\nFix: free=[...], other params.")
        return "shrink(params)" if name == "<lambda>" else name, direction
    if not names:
        raise ValueError(f"shrink names {shrink!r}, but no parameter is fitted.\nFix: free=[{shrink!r}].")
    fix = "shrink='{}', or a function of params; parameters left out of free= count as known"
    must_name(shrink, names, "shrink names", "fitted parameter", fix)
    return f"'{shrink}'", np.eye(len(names))[names.index(shrink)]


def _candidate_runs(
    problem: FitProblem,
    candidates: Mapping[str, Record],
    known: KnownMotion,
    direction: np.ndarray,
    least: float,
    problem_for: Callable,
):
    """Candidates that are other runs, each with its own unknown start."""
    must(candidates, "candidates must hold a record", candidates, "leave it out, or {'a longer run': lj.Record(...)}")
    forms: dict[Any, list[str]] = {}
    for name, record in candidates.items():
        must_be(Record, record, f"candidate '{name}' must be a lj.Record", "lj.Record(t, q=np.zeros(len(t)), q0=...)")
        if (record.sigma is not None) != problem.absolute:
            have = "no sigma, and the records have one" if problem.absolute else "a sigma, and the records have none"
            raise ValueError(f"candidate '{name}' has {have}.\nFix: give it to all, or none.")
        if not problem.absolute and set(record.measured) != set(problem.measured):
            raise ValueError(
                f"candidate '{name}' measures {listed(list(record.measured))}, the records "
                f"{listed(list(problem.measured))}, and without sigma there are no weights to compare them by.\n"
                "Fix: sigma= for the records and the candidates."
            )
        forms.setdefault(jax.tree.structure(record.measured), []).append(name)
    assessed = []
    for names in forms.values():
        records = [candidates[name] for name in names]
        of_runs = problem_for(records)
        if not problem.absolute:
            common = jax.tree.leaves(problem.sigma)[0].ravel()[0]
            of_runs = replace(of_runs, sigma=jax.tree.map(lambda s: np.full(s.shape, common), of_runs.sigma))
        windows = np.asarray(of_runs.windows.record)
        for r, name in enumerate(names):
            parts = [_one_window(of_runs, int(w)) for w in np.flatnonzero(windows == r)]
            assessed.append(_candidate_run(name, records[r], parts, known, direction, least))
    return assessed


def _one_window(problem: FitProblem, w: int) -> FitProblem:
    """The problem of one window alone, so that all windows of one form share one program."""
    names = ("windows", "starts", "measured", "sigma", "overrides")
    parts = jax.tree.map(lambda x: x[w : w + 1], {name: getattr(problem, name) for name in names})
    parts["windows"] = parts["windows"]._replace(record=np.zeros(1, int), seam=np.zeros(1, bool))
    return replace(problem, **parts)


def _candidate_run(
    name: str, record: Record, parts: list[FitProblem], known: KnownMotion, direction: np.ndarray, least: float
):
    """The candidate of one run, from its windows; quantities that are not measured have zero slopes."""
    slopes = []
    for part in parts:
        at = survey(part, part.start)
        if not at.linear.well[0]:
            raise ValueError(f"the motion of candidate '{name}' fails: {_failure_reason(part)}")
        slopes.append(at.linear.slopes)
    p, k, times = len(direction), slopes[0].rows_by_local.shape[-1], len(record.t)
    n = p + k * len(parts)
    rows: list[list] = [[] for _ in range(times)]
    for i, (part, of_part) in enumerate(zip(parts, slopes)):
        both = np.zeros((of_part.rows_by_shared.shape[1], n))
        both[:, :p], both[:, p + k * i : p + k * (i + 1)] = of_part.rows_by_shared[0], of_part.rows_by_local[0]
        for at_time, block in zip(*_by_time(part, both)):
            rows[at_time].append(block)
    held = np.concatenate([known.shared, np.zeros((len(known.shared), n - p))], axis=1)
    along, values = np.zeros((2, n))
    along[:p], values[:p] = direction, parts[0].found.start
    stacked = np.stack([np.concatenate(blocks) for blocks in rows])
    return assess(name, record.t, stacked, held, along, values, _errors(parts), least)


def _by_time(part: FitProblem, both: np.ndarray):
    """The indices of a window's times in its record, and the rows (m, n) of each; the last has those of `end`, too."""
    length, at, blocks, last = part.windows.ts.shape[1], 0, [], []
    for kind, tree in part.measured.items():
        for x in jax.tree.leaves(tree):
            size = int(np.prod(x.shape[1:]))
            rows = both[at : at + size]
            at += size
            if kind == "end":
                last.append(rows)
            else:
                blocks.append(rows.reshape(length, -1, both.shape[1]))
    real = part.windows.real[0]
    each = np.concatenate([*blocks, np.zeros((length, sum(map(len, last)), both.shape[1]))], axis=1)[real]
    if last:
        each[-1, -sum(map(len, last)) :] = np.concatenate(last)
    return part.windows.sample[0][real], each


def _errors(parts: list[FitProblem]):
    """The typical error of each quantity."""
    errors = {}
    for kind, tree in parts[0].sigma.items():
        for path, s in jtu.tree_leaves_with_path(tree):
            errors[channel_name(kind, path)] = float(np.median(s[np.isfinite(s)])) if np.any(np.isfinite(s)) else np.inf
    return errors


def _failure_reason(part: FitProblem):
    """Why a motion fails, in the message of `integrate`."""
    ts, params, (q, v), options = part.setting(part.start.shared, part.start.local[0], 0, WHOLE)
    try:
        integrate(part.system, q, v, params, ts=ts, **(options | {"throw": True}))
    except (ValueError, RuntimeError) as error:
        return str(error)
    return "it stops early.\nFix: run it alone with lj.integrate."


def _further_measurements(
    problem: FitProblem, records: Sequence[Record], at: Survey, known: KnownMotion, direction: np.ndarray, least: float
) -> list[Candidate]:
    """Candidates in the existing runs: one further measurement of each quantity, at its best time."""
    longer = _extended(problem, records)
    further, slopes = survey(longer, problem.start).linear.slopes, at.linear.slopes
    k = slopes.rows_by_local.shape[-1]
    along = np.concatenate([direction, np.zeros(k)])
    # Zeros for the starts: `units_of` then asks for no relative change of them.
    values = np.concatenate([problem.found.start, np.zeros(k)])
    best: dict[str, Candidate] = {}
    for w, r in enumerate(longer.windows.record):
        others = known.without_window(w)
        of_window = np.concatenate([slopes.rows_by_shared[w], slopes.rows_by_local[w]], axis=1)
        here = np.concatenate([np.concatenate([others, np.zeros((len(others), k))], axis=1), of_window])
        both = np.concatenate([further.rows_by_shared[w], further.rows_by_local[w]], axis=1)
        part = _one_window(longer, w)
        _, rows = _by_time(part, both)
        ts = part.windows.ts[0][part.windows.real[0]]
        for i, (name, sigma) in enumerate(_entries(part)):
            if not np.isfinite(sigma):
                continue
            label = f"{name} of record {r}" if len(records) > 1 else name
            new = assess(label, ts, rows[:, i : i + 1], here, along, values, {name: sigma}, least, one_time=True)
            # Of the windows of a record, keep the one with the best time.
            if label not in best or new.sd < best[label].sd:
                best[label] = new
    return list(best.values())


def _entries(part: FitProblem):
    """The name and the error of each entry that is measured at a time."""
    entries = []
    for kind, tree in part.sigma.items():
        for path, s in jtu.tree_leaves_with_path(tree):
            name = channel_name(kind, path)
            for index in np.ndindex(s.shape[2:]):
                suffix = f"[{', '.join(map(str, index))}]" if index else ""
                entries.append((name + suffix, float(s[(0, 0, *index)])))
    return entries


def _extended(problem: FitProblem, records: list[Record]) -> FitProblem:
    """The same runs with their last windows doubled, and with all quantities measured whose error is known."""
    windows = problem.windows
    ends = np.append(windows.record[1:] != windows.record[:-1], True)
    pieces = []
    for w in range(windows.count):
        ts = windows.ts[w, : windows.last[w] + 1]
        real = windows.real[w, : len(ts)]
        if ends[w]:
            after = ts[-1] + np.median(np.diff(ts)) * np.arange(1, len(ts) + 1)
            ts, real = np.append(ts, after), np.append(real, np.ones(len(ts), bool))
        pieces.append((ts, real))
    length = filled_up(max(len(ts) for ts, _ in pieces))
    filled = [padded(ts, length, closest(ts, ts.dtype)) for ts, _ in pieces]
    real = np.stack([np.append(real, np.zeros(length - len(real), bool)) for _, real in pieces])
    longer = Windows(
        np.stack(filled), real, np.tile(np.arange(length), (windows.count, 1)),
        np.array([len(ts) - 1 for ts, _ in pieces]), windows.seam, windows.record,
    )  # fmt: skip
    sigma = _sigmas(problem, records, length)
    measured = jax.tree.map(np.zeros_like, sigma)
    ones = jax.tree.map(lambda s: np.ones((), s.dtype), sigma)
    return replace(problem, windows=longer, measured=measured, sigma=sigma, spread=ones)


def _sigmas(problem: FitProblem, records: list[Record], length: int):
    """Errors (W, T, ...) of all coordinates, velocities and measured quantities; infinite where none is known."""
    state = jax.eval_shape(problem.unflatten, problem.starts.q.guess[0])
    parts = {kind: jax.tree.map(lambda x: x[0, 0], tree) for kind, tree in problem.measured.items() if kind != "end"}
    parts |= {"q": state, "v": state}
    sigmas = {}
    for kind in sorted(parts):

        def of_leaf(path: tuple[Any, ...], x: Any, kind: str = kind):
            each = [_error(problem, records[r], w, kind, path, x.shape) for w, r in enumerate(problem.windows.record)]
            return np.stack([np.broadcast_to(s, (length, *x.shape)) for s in each]).astype(problem.windows.ts.dtype)

        tree = jtu.tree_map_with_path(of_leaf, parts[kind])
        if any(np.any(np.isfinite(x)) for x in jax.tree.leaves(tree)):
            sigmas[kind] = tree
    return sigmas


def _error(problem: FitProblem, record: Record, w: int, kind: str, path: tuple[Any, ...], shape: tuple[int, ...]):
    """The error of a quantity: the median error of its measurements, else what `sigma` says for its whole kind."""
    measured = {p: (x, s) for (p, x), s in zip(
        jtu.tree_leaves_with_path(problem.measured.get(kind, {})), jax.tree.leaves(problem.sigma.get(kind, {}))
    )}  # fmt: skip
    stated = np.full(shape, _stated_error(problem, record, kind, path))
    if path not in measured:
        return stated
    x, s = (a[w] for a in measured[path])
    known = np.isfinite(x) & np.isfinite(s)
    each = np.ma.median(np.ma.masked_array(s, ~known), axis=0)
    return np.where(np.any(known, axis=0), np.ma.filled(each, np.inf), stated)


def _stated_error(problem: FitProblem, record: Record, kind: str, path: tuple[Any, ...]):
    if not problem.absolute:
        return jax.tree.leaves(problem.sigma)[0].ravel()[0] if kind in problem.measured else np.inf
    sigma = record.sigma
    for key in (kind, *(getattr(key, "key", None) for key in path)):
        sigma = sigma.get(key, np.inf) if isinstance(sigma, Mapping) else sigma
    return sigma if np.ndim(sigma) == 0 and not isinstance(sigma, Mapping) else np.inf
