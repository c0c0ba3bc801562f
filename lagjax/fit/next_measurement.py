"""The slopes of candidate measurements at given parameters, which `candidates` assesses.

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

from lagjax.fit.problem.checks import check_predicted
from lagjax.fit.problem.records import Record, Windows, channel_name, closest, padded
from lagjax.fit.problem.residuals import WHOLE, FitProblem
from lagjax.fit.search.search import UNSEEN, Evaluation, LinearisedResiduals, evaluation_from, linearised
from lagjax.fit.uncertainty.candidates import Candidate, NextMeasurements, assess, eliminate_unknowns, sd_of, units_of
from lagjax.integrate import integrate
from lagjax.jaxtools import compiled, filled_up
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns


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

        shape = jax.eval_shape(number, x).shape
        if shape != ():
            raise ValueError(
                f"shrink(params) must be a single number, not an array of shape {shape}.\n"
                'Fix: shrink=lambda params: params["g"] / params["l"].'
            )
        name = getattr(shrink, "__name__", "shrink")
        direction = np.asarray(jax.grad(number)(x))
        if not np.all(np.isfinite(direction)) or not np.any(direction):
            what = "has no finite slope" if np.any(direction) else "does not depend on the fitted parameters"
            raise ValueError(f"shrink(params) {what} here: {listed(list(names))}.\nFix: free=[...], other params.")
        return "shrink(params)" if name == "<lambda>" else name, direction
    if not names:
        raise ValueError(f"shrink names {shrink!r}, but no parameter is fitted.\nFix: free=[{shrink!r}].")
    if shrink not in names:
        raise ValueError(
            f"shrink names {shrink!r}, which is not among the fitted parameters: {listed(list(names))}.\n"
            "Fix: one of these names, or a function of params; parameters left out of free= count as known."
        )
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
    if not candidates:
        raise ValueError("candidates is empty.\nFix: leave it out, or {'a longer run': lj.Record(...)}.")
    wrong = [name for name, record in candidates.items() if not isinstance(record, Record)]
    if wrong:
        raise TypeError(f"candidate '{wrong[0]}' must be a lj.Record.\nFix: lj.Record(t, q=np.zeros(len(t)), q0=...).")
    forms: dict[Any, list[str]] = {}
    for name, record in candidates.items():
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
