"""The slopes of further measurements at the point of a fit, for `candidates` to judge.

A candidate is another run, with an unknown start of its own, or a further measurement in a run that there is: of each
coordinate, at the times of its record and as long again after it. What is measured, and when, makes its slopes; what
will be measured does not matter.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace as changed
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Float

from lagjax.fitting.candidates import Candidate, NextMeasurements, judged, sd_of, units_of, without
from lagjax.fitting.equations import WHOLE, Problem
from lagjax.fitting.predicted import check_predicted
from lagjax.fitting.records import PADDING, Record, Windows, channel_name, padded
from lagjax.fitting.search import UNSEEN, Evaluation, Linear, evaluation_from, linearised
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.memory import filled_up
from lagjax.motion.integrate import integrate
from lagjax.numerics.chained import Unknowns


class Surveyed(NamedTuple):
    """What the data say at one point, with the slopes of all equations there."""

    linear: Linear
    evaluation: Evaluation


@partial(compiled, in_numpy=True)
def surveyed(problem: Problem, u: Unknowns) -> Surveyed:
    """What `evaluate` sees, and the slopes that it sees it by. One program serves all runs of one form."""
    check_predicted(problem)
    linear = linearised(problem, u, WHOLE, "squares")
    return Surveyed(linear, evaluation_from(problem, u, linear, WHOLE))


class Known(NamedTuple):
    """What the records say: equations with errors of size one.

    `shared` (r, p): of all windows without their starts, and of priors. `each` (p, p): of each window, in a list.
    """

    shared: Float[np.ndarray, "r p"]
    each: list[Float[np.ndarray, "q p"]]
    prior: Float[np.ndarray, "h p"]

    def but(self, w: int) -> Float[np.ndarray, "r p"]:
        """Without window w."""
        return np.concatenate([self.prior, *(rows for i, rows in enumerate(self.each) if i != w)])


def next_measurements(
    problem: Problem,
    records: list[Record],
    at: Surveyed,
    shrink: str | Callable,
    candidates: Mapping[str, Record] | None,
    problem_for: Callable[[list[Record]], Problem],
) -> NextMeasurements:
    """How certain a number would be after each candidate; `problem_for(records)` makes arrays of runs of one form."""
    name, direction = _direction(problem, shrink)
    slopes = at.linear.slopes
    each = [without(*blocks) for blocks in zip(slopes.rows_by_shared, slopes.rows_by_local)]
    prior = np.asarray(slopes.shared)
    known = Known(np.concatenate([prior, *each]), each, prior)
    # As `evaluation_from` decides what the data determine.
    least = float(np.sqrt(np.finfo(problem.windows.ts.dtype).eps) / UNSEEN)
    units = units_of(known.shared, np.asarray(problem.found.start), least)
    # Without sigmas the rows are in units of a common size: what they tell is a multiple of the error.
    error = 1.0 if problem.absolute else float(jax.tree.leaves(problem.sigma)[0].ravel()[0])
    now = sd_of(direction * np.where(units > 0, units, 1.0), known.shared * units, least) / error
    if candidates is None:
        found = _further(problem, records, at, known, direction, least)
    else:
        found = _runs(problem, candidates, known, direction, least, problem_for)
    told = [c._replace(sd=c.sd / error, alone=c.alone / error, direction=c.direction / error) for c in found]
    return NextMeasurements(name, now, tuple(sorted(told, key=lambda c: c.sd)), problem.absolute)


def _direction(problem, shrink):
    """The name of a number, and its slopes by what is found."""
    names, x = problem.found.names, jnp.asarray(problem.found.start)
    if callable(shrink):
        of = lambda x: jnp.asarray(shrink(problem.found.into(x)))
        shape = jax.eval_shape(of, x).shape
        if shape != ():
            raise ValueError(
                f"shrink(params) must be one number, and has the shape {shape}.\n"
                'Fix: shrink=lambda params: params["g"] / params["l"].'
            )
        name = getattr(shrink, "__name__", "shrink")
        direction = np.asarray(jax.grad(of)(x))
        if not np.all(np.isfinite(direction)) or not np.any(direction):
            what = "has no finite slope" if np.any(direction) else "does not depend on what is found"
            raise ValueError(f"shrink(params) {what} here, by {listed(list(names))}.\nFix: free=[...], other params.")
        return "shrink(params)" if name == "<lambda>" else name, direction
    if not names:
        raise ValueError(f"shrink names {shrink!r}, and no parameter is found.\nFix: free=[{shrink!r}].")
    if shrink not in names:
        raise ValueError(
            f"shrink names {shrink!r}, which is not among what is found: {listed(list(names))}.\n"
            "Fix: one of these names, or a function of params; what is left out of free= is known."
        )
    return f"'{shrink}'", np.eye(len(names))[names.index(shrink)]


def _runs(problem, candidates, known, direction, least, problem_for):
    """Candidates that are other runs, each with unknown starts."""
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
                f"{listed(list(problem.measured))}, and how these are to be weighed nobody knows.\n"
                "Fix: sigma= for the records and the candidates."
            )
        forms.setdefault(jax.tree.structure(record.measured), []).append(name)
    found = []
    for names in forms.values():
        together = [candidates[name] for name in names]
        of = problem_for(together)
        if not problem.absolute:
            common = jax.tree.leaves(problem.sigma)[0].ravel()[0]
            of = changed(of, sigma=jax.tree.map(lambda s: np.full(s.shape, common), of.sigma))
        windows = np.asarray(of.windows.record)
        for r, name in enumerate(names):
            parts = [_one_window(of, int(w)) for w in np.flatnonzero(windows == r)]
            found.append(_run(name, together[r], parts, known, direction, least))
    return found


def _one_window(problem: Problem, w: int) -> Problem:
    """The problem of one window: all of one form have one program."""
    part = lambda tree: jax.tree.map(lambda x: x[w : w + 1], tree)
    windows = Windows(*part(problem.windows))._replace(record=np.zeros(1, int), seam=np.zeros(1, bool))
    return changed(
        problem, windows=windows, starts=part(problem.starts), measured=part(problem.measured),
        sigma=part(problem.sigma), overrides=part(problem.overrides),
    )  # fmt: skip


def _run(name, record, parts, known, direction, least):
    """The candidate of one run, from its windows; slopes of what is not measured are zero."""
    slopes = []
    for part in parts:
        at = surveyed(part, part.start)
        if not at.linear.well[0]:
            raise ValueError(f"the motion of candidate '{name}' fails: {_why(part)}")
        slopes.append(at.linear.slopes)
    p, k, times = len(direction), slopes[0].rows_by_local.shape[-1], len(record.t)
    n = p + k * len(parts)
    rows: list[list] = [[] for _ in range(times)]
    for i, (part, of) in enumerate(zip(parts, slopes)):
        both = np.zeros((of.rows_by_shared.shape[1], n))
        both[:, :p], both[:, p + k * i : p + k * (i + 1)] = of.rows_by_shared[0], of.rows_by_local[0]
        for at_time, block in zip(*_by_time(part, both)):
            rows[at_time].append(block)
    held = np.concatenate([known.shared, np.zeros((len(known.shared), n - p))], axis=1)
    along, values = np.zeros((2, n))
    along[:p], values[:p] = direction, parts[0].found.start
    stacked = np.stack([np.concatenate(blocks) for blocks in rows])
    return judged(name, record.t, stacked, held, along, values, _errors(parts), least)


def _by_time(part, both):
    """The places of a window's times in its record, and the rows (m, n) of each; those of its end with the last."""
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


def _errors(parts):
    """The typical error of each quantity."""
    found = {}
    for kind, tree in parts[0].sigma.items():
        for path, s in jtu.tree_leaves_with_path(tree):
            found[channel_name(kind, path)] = float(np.median(s[np.isfinite(s)])) if np.any(np.isfinite(s)) else np.inf
    return found


def _why(part):
    """In the words of the integration, why a motion fails."""
    ts, params, (q, v), options = part.setting(part.start.shared, part.start.local[0], 0, WHOLE)
    try:
        integrate(part.system, q, v, params, ts=ts, **(options | {"throw": True}))
    except (ValueError, RuntimeError) as error:
        return str(error)
    return "it stops early.\nFix: look at it with lj.integrate."


def _further(problem, records, at, known, direction, least) -> list[Candidate]:
    """Further measurements in the runs that there are: of each quantity, at the one time that is best."""
    longer = _longer(problem, records)
    further, slopes = surveyed(longer, problem.start).linear.slopes, at.linear.slopes
    k = slopes.rows_by_local.shape[-1]
    along = np.concatenate([direction, np.zeros(k)])
    # A start at zero is as good as any: of these no relative change is asked.
    values = np.concatenate([problem.found.start, np.zeros(k)])
    best: dict[str, Candidate] = {}
    for w, r in enumerate(longer.windows.record):
        others = known.but(w)
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
            found = judged(label, ts, rows[:, i : i + 1], here, along, values, {name: sigma}, least, one_time=True)
            # Of a record in windows the one that has the best time.
            if label not in best or found.sd < best[label].sd:
                best[label] = found
    return list(best.values())


def _entries(part: Problem):
    """The name and the error of each entry of what is measured at a time."""
    found = []
    for kind, tree in part.sigma.items():
        for path, s in jtu.tree_leaves_with_path(tree):
            name = channel_name(kind, path)
            for index in np.ndindex(s.shape[2:]):
                suffix = f"[{', '.join(map(str, index))}]" if index else ""
                found.append((name + suffix, float(s[(0, 0, *index)])))
    return found


def _longer(problem: Problem, records: list[Record]) -> Problem:
    """The same runs, as long again, with all quantities measured that the records say an error of."""
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
    closest = lambda ts: max(PADDING * np.min(np.diff(ts)), 8 * np.finfo(ts.dtype).eps * np.max(np.abs(ts)))
    filled = [padded(ts, length, closest(ts)) for ts, _ in pieces]
    real = np.stack([np.append(real, np.zeros(length - len(real), bool)) for _, real in pieces])
    longer = Windows(
        np.stack(filled), real, np.tile(np.arange(length), (windows.count, 1)),
        np.array([len(ts) - 1 for ts, _ in pieces]), windows.seam, windows.record,
    )  # fmt: skip
    sigma = _sigmas(problem, records, length)
    measured = jax.tree.map(np.zeros_like, sigma)
    ones = jax.tree.map(lambda s: np.ones((), s.dtype), sigma)
    return changed(problem, windows=longer, measured=measured, sigma=sigma, spread=ones)


def _sigmas(problem: Problem, records: list[Record], length):
    """Errors (W, T, ...) of all coordinates and velocities and of what is measured; infinite where nobody says one."""
    state = jax.eval_shape(problem.unflatten, problem.starts.q.guess[0])
    among = {kind: jax.tree.map(lambda x: x[0, 0], tree) for kind, tree in problem.measured.items() if kind != "end"}
    among |= {"q": state, "v": state}
    found = {}
    for kind in sorted(among):
        of_leaf = lambda path, x, kind=kind: np.stack([
            np.broadcast_to(_error(problem, records[r], w, kind, path, x.shape), (length, *x.shape))
            for w, r in enumerate(problem.windows.record)
        ]).astype(problem.windows.ts.dtype)  # fmt: skip
        tree = jtu.tree_map_with_path(of_leaf, among[kind])
        if any(np.any(np.isfinite(x)) for x in jax.tree.leaves(tree)):
            found[kind] = tree
    return found


def _error(problem, record, w, kind, path, shape):
    """The error of a quantity: the median of what it was measured with, else what `sigma` says of all of its kind."""
    measured = {p: (x, s) for (p, x), s in zip(
        jtu.tree_leaves_with_path(problem.measured.get(kind, {})), jax.tree.leaves(problem.sigma.get(kind, {}))
    )}  # fmt: skip
    said = np.full(shape, _said(problem, record, kind, path))
    if path not in measured:
        return said
    x, s = (a[w] for a in measured[path])
    known = np.isfinite(x) & np.isfinite(s)
    each = np.ma.median(np.ma.masked_array(s, ~known), axis=0)
    return np.where(np.any(known, axis=0), np.ma.filled(each, np.inf), said)


def _said(problem, record, kind, path):
    if not problem.absolute:
        return jax.tree.leaves(problem.sigma)[0].ravel()[0] if kind in problem.measured else np.inf
    said = record.sigma
    for key in (kind, *(getattr(key, "key", None) for key in path)):
        said = said.get(key, np.inf) if isinstance(said, Mapping) else said
    return said if np.ndim(said) == 0 and not isinstance(said, Mapping) else np.inf
