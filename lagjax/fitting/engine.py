"""The front door of fits: check, evaluate, search, say what was found and how well."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jaxtyping import PyTree

from lagjax.fitting.caveats import caveats
from lagjax.fitting.equations import Problem, Stage
from lagjax.fitting.optimisers import is_of_optax
from lagjax.fitting.predicted import check_motion
from lagjax.fitting.problem import problem_of
from lagjax.fitting.records import Record
from lagjax.fitting.result import Fit, FitWarning
from lagjax.fitting.search import Course, evaluate, listening, search
from lagjax.fitting.trained import held_problem, parted_records, train
from lagjax.mechanics import coordinates
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.hybrid import Hybrid
from lagjax.mechanics.system import System
from lagjax.meter import meter, waiting
from lagjax.motion.reported import reported

# The first part of a record has so many measurements an unknown, and each next stage twice as many.
A_STAGE_HAS, STAGES = 4, 7
# What a jump between joined windows costs, stage by stage, in units of what missing the data by as much costs.
# (Farther up, the round-off of chaotic motions in the jumps keeps a search from coming to rest.)
JOINED = (0.1, 1.0, 10.0, 100.0, 1e3)
# With a loss that forgives outliers so many stages more, in which to learn the size of an ordinary error.
SETTLING = 2
# While only a part of a record counts, a change of a number by so much of it costs as much as an error of measurement;
# without sigma that is so much of the data's spread.
REACH, AN_ERROR = 0.3, 0.03
# How much of a hold the whole record has, for few numbers: what only round-off sees keeps its guess. Of many, as of a
# network, no single one is determined.
BARELY = 1e-7
# Further starts where the end is doubtful, for no more numbers than this.
AGAIN, AGAIN_UP_TO = 8, 20
# Uncertainties of more numbers than this are not computed.
COVARIANCE_UP_TO = 1000
# In units of the data's spread: when a stage is done, and when the last one is; not below what the motion is good for.
STAGE_DONE, DONE, OF_RTOL, ROUND_OFFS = 1e-4, 1e-9, 10.0, 100.0


def fit(
    system: System | Hybrid,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    loss: str = "squares",
    units: Mapping[str, str] | None = None,
    window: float | None = None,
    joined: bool = True,
    grow: bool = True,
    restarts: int | None = None,
    spread: float = 0.3,
    seed: int = 0,
    optimiser: Any = None,
    iterations: int | None = None,
    batch: int | None = None,
    held_back: float | Record | Sequence[Record] | None = None,
    patience: int | None = None,
    progress: bool | None = None,
    **options,
) -> Fit:
    """Find the parameters and initial states with which the motion is nearest to what was measured.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["w2"] * jnp.cos(q))
    >>> t = jnp.linspace(0.0, 10.0, 60)
    >>> measured = lj.integrate(swing, 1.0, 0.0, {"w2": 4.0}, ts=t).q
    >>> found = fit(swing, lj.Record(t, q=measured), {"w2": 3.0})
    >>> print(f"{found.params['w2']:.6f}", f"{found.q0[0]:.6f}", found.converged)
    4.000000 1.000000 True

    **Main arguments:**

    - `system`: also a `Hybrid`, whose records start in one phase (`start=`, the first by default); without windows.
    - `records`: one `Record` or several, each with its own initial state. Angles as they run on, not wrapped to a turn.
    - `params`: what the Lagrangian takes, with guesses of what is to be found; all records share it.
    - `free`: the names of what is found, `"g"`, `["m[1]", "arm.length"]`, or of a part, such as a network,
      `"potential"`. By default every floating number in `params`.
    - `observe(t, q, v, params)`: what `observed` in the records are measurements of: positions, for example.
    - `bounds`: by name, `{"m": (0.0, None)}`. A number that is positive is searched by its logarithm.
    - `priors`: by name (mean, standard deviation) of what is known already; needs `sigma` in the records.
    - `loss`: `"squares"`; or `"huber"`, `"soft_l1"`, `"cauchy"`, against outliers, which need `sigma`. Until the last
      stage an ordinary error is the median of what the motion is off, since far from the truth all are large.
    - `units`: by name, for the table.

    **The search:**

    - `window`: cut records into windows of this length, `[t]`, each from a state of its own: for chaotic motion and
      long records. With `joined` (multiple shooting) the windows are drawn together in a few stages until each goes on
      where the last one ended; else they stay on their own, which forgives what the system leaves out.
    - `grow`: begin with the first part of each record or window and double it, stage by stage: a long record has many
      wrong minima, whole periods off. What a part does not see stays near its guess. Where the end is doubtful, joined
      windows grow along their record, and the whole record is searched at once from the guess, too.
    - `restarts`: further starts of the search, with parameters `spread` (relative) away from their guess, or anywhere
      between two bounds; `seed` says which. The best end counts. By default 8, of up to 20 numbers, and these only as
      long as the best end is doubtful: not at rest, or with residuals that errors of measurement would hardly leave.
    - `optimiser`: by default `optimistix.LevenbergMarquardt`, with derivatives taken forward. Any other of optimistix's
      least-squares solvers; or a minimiser of it, with derivatives in reverse, such as `optimistix.BFGS(rtol, atol)`.
    - `iterations`: the largest number in each stage, 100 by default.

    **Training,** with an `optimiser` of optax, such as `optax.adam(1e-2)`, for thousands of parameters; its windows are
    whole and on their own (`joined=False`), and it searches once:

    - `iterations`: how many steps there may be, 1000 by default. `batch`: how many windows a step sees, drawn anew by
      `seed` in each round through all; by default all. Derivatives come in reverse, of all windows at once.
    - `held_back`: records, or which part of those given, that are only to judge by, every so many steps, with starts
      fitted to them. The best parameters count; without it those with the smallest residuals of all.
    - `patience`: after how many judgements without improvement training stops; 10 where records are held back.
    - Starts of windows are no matter of the optimiser: with each batch they go half of the way of Newton.

    **Further:**

    - `progress`: show stage, steps and cost (tqdm); by default where somebody may look.
    - `options` go to `lj.integrate`: `rtol`, `atol`, `method`, `event`, `max_steps`, ...

    **Returns:** a `Fit`: estimates with their uncertainties, residuals, what the data do not determine. It is the best
    point found also where it is no success (`converged`, and a `FitWarning`): where the search did not come to rest, or
    the residuals contradict `sigma` or follow a curve. Inside `jax.vmap`, `jit` or `lj.sweep` measurements and guesses
    may be traced, times not; a sweep's `status` says which fits are none.

    **Raises:**

    - `ValueError` for names, shapes and kinds that do not match; for a guess from which the motion fails at once.
    - Warns (`lj.FitWarning`) where the search did not converge, a motion stops early, residuals are larger than `sigma`
      says or follow a curve, an estimate is at its bound, or the data cannot see a parameter.

    Source: Nocedal & Wright, *Numerical Optimization*, §10.3; Bock, in *Modelling of Chemical Reaction Systems* (1981)
    (multiple shooting); Huber, *Robust Statistics*, §7.8 (scale by the median); Bierman, *Factorization Methods for
    Discrete Sequential Estimation* (covariance); Box & Pierce, *J. Am. Stat. Assoc.* 65 (1970) 1509 (residuals).
    """
    apart = None
    if is_of_optax(optimiser):
        _check_training(window is not None and joined, restarts)
        records, apart = parted_records(records, held_back, seed)
    else:
        _check_optimiser(optimiser, {"batch": batch, "held_back": held_back, "patience": patience})
    problem = problem_of(system, records, params, free, observe, bounds, priors, loss, window, dict(options))
    if is_of_optax(optimiser):
        check = lambda: check_motion(problem, np.zeros(problem.windows.count, bool), problem.start)
        held = held_problem(problem, apart, system, params, observe, loss, window, options)
        trained = train(problem, held, optimiser, batch, iterations, patience, seed, progress, check)
        return _told(Fit(problem, *trained.searched, trained.evaluation, _sorted(units), trained.course))
    further = restarts
    if restarts is None:
        further = AGAIN if optimiser is None and 0 < problem.found.start.size <= AGAIN_UP_TO else 0
    scattered = _scattered(problem.found, further, spread, seed)
    course = _course(problem, grow, joined and window is not None, scattered, bool(restarts))
    last = jax.tree.map(lambda x: x[-1], course.stages)
    with _shown(problem, course, progress) as tell:
        searched, evaluation = search(problem, course, optimiser, 100 if iterations is None else iterations, tell)
    costs = coordinates.numpy_of(searched.costs).asarray(searched.costs)[: int(course.count)]
    searched = searched._replace(costs=costs)
    if evaluation is None and problem.found.start.size <= COVARIANCE_UP_TO:
        evaluation = evaluate(problem, searched.unknowns, last)
    if evaluation is not None and not coordinates.is_traced(evaluation) and not np.any(np.asarray(evaluation.well)):
        check_motion(problem, evaluation.well, problem.start)
    found = Fit(problem, *searched, evaluation, _sorted(units))
    if evaluation is not None and not coordinates.is_traced(found.cost) and found.at_bounds():
        # There the search's own slopes vanish.
        found = eqx.tree_at(lambda f: f.evaluation, found, evaluate(problem, searched.unknowns, last))
    return _told(found)


def _told(found: Fit) -> Fit:
    """The fit, after it was reported to who runs it, and its caveats to who called."""
    found = reported(found, Fit.report)
    if not coordinates.is_traced(found.cost):
        for words in caveats(found):
            warnings.warn(words, FitWarning, stacklevel=3)
    return found


def _sorted(units):
    return tuple(sorted((units or {}).items()))


def _check_training(joined, restarts):
    if joined:
        raise ValueError(
            "an optimiser of optax sees a batch of windows at a time, and does not join them.\nFix: joined=False."
        )
    if restarts:
        raise ValueError("restarts= is for a search, and an optimiser of optax trains once.\nFix: leave it out.")


def _check_optimiser(optimiser, of_training):
    if optimiser is not None and not isinstance(optimiser, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise TypeError(
            "optimiser must be one of optimistix's least-squares solvers or minimisers, or a gradient transformation "
            f"of optax, not {optimiser!r:.60}.\nFix: leave it out; or optax.adam(1e-3), called with its learning rate."
        )
    if given := [name for name, value in of_training.items() if value is not None]:
        raise ValueError(
            f"{listed(given)} is for training by an optimiser of optax.\n"
            "Fix: optimiser=optax.adam(1e-2), or leave it out."
        )


def _course(problem: Problem, grow: bool, joined: bool, scattered, all_of_them: bool) -> Course:
    """The stages of a search, with the starts from which it goes through them."""
    windows = problem.windows
    unknowns = sum(x.shape[-1] for x in jax.tree.leaves(problem.start))
    measured = sum(
        int(np.prod(x.shape[1:])) if kind == "end" else windows.longest * int(np.prod(x.shape[2:]))
        for kind, tree in problem.measured.items()
        for x in jax.tree.leaves(tree)
    )
    growing = lambda measured: _doubled(measured / max(A_STAGE_HAS * unknowns, 1)) if grow else np.zeros(0)
    alike = lambda parts: np.repeat(np.asarray(parts)[:, None], windows.count, axis=1)
    of_windows = alike(growing(measured))
    # Windows that are joined are one record, which may grow as such.
    of_records = np.zeros((0, windows.count))
    if joined and windows.count > 1:
        of_records = _of_records(windows, growing(measured * int(np.max(np.bincount(windows.record)))))
    settling, joining = (0 if problem.loss == "squares" else SETTLING), (JOINED if joined else ())
    each = np.concatenate([of_records, of_windows, alike(np.ones(1 + settling + len(joining)))])
    # Filled up in front, by stages that none begins with: a program is one for all numbers of them.
    kinds = 0 if not grow else 2 if joined and windows.count > 1 else 1
    filled = kinds * (STAGES - 1) - len(of_records) - len(of_windows)
    each = np.concatenate([alike(np.ones(filled)), each])
    partly = np.any(each < 1, axis=1)
    weights = np.append(np.zeros(len(each) - len(joining)), joining)
    ratio = problem.spread_in_sigmas
    rtol = problem.options.get("rtol")
    done = max(DONE, ROUND_OFFS * np.finfo(windows.ts.dtype).eps)
    if rtol is not None:
        xp = coordinates.numpy_of(rtol)
        done = xp.maximum(done, OF_RTOL * xp.max(xp.asarray(rtol)))
    last = np.arange(len(each)) == len(each) - 1
    xp = coordinates.numpy_of((ratio, done, scattered, problem.found.start))
    barely = BARELY if problem.found.start.size <= AGAIN_UP_TO else 0.0
    held = np.where(partly, 1.0, barely) * (1.0 if problem.absolute else AN_ERROR) / REACH
    stages = Stage(each, weights * ratio, np.ones(len(each)), held)
    # Round-off in the jumps between windows weighs as much as the jumps do.
    tolerances = xp.where(last, done * (JOINED[-1] if joined else 1.0), STAGE_DONE) * ratio
    # From the guess: growing windows, growing records, and the whole record at once, where these are not the same.
    begin = np.unique([len(of_records), 0, len(of_records) + len(of_windows)])
    begin = np.append(len(of_records), begin[begin != len(of_records)])
    # From elsewhere the first two in turn.
    first = np.append(begin, np.resize(begin[:2] if len(of_records) else begin[:1], len(scattered))) + filled
    count, more = len(first), 1 + kinds - len(begin)
    guess = xp.asarray(problem.found.start)[None]
    starts = xp.concatenate([guess] * len(begin) + [scattered] + [guess] * more)
    first = np.append(first, np.full(more, filled))
    return Course(stages, tolerances, starts, first, np.asarray(count), np.asarray(count if all_of_them else 1))


@contextmanager
def _shown(problem, course, progress):
    """A meter of the search's steps; whether there is one."""
    if coordinates.is_traced(problem):
        yield False
        return
    before = int(np.min(course.first))
    stages = len(course.tolerances) - before
    with meter(progress, unit=" steps", desc="fit") as shown:
        if shown.disable:
            yield False
            return
        with waiting(progress, "compiling") as begun:

            def step(stage, cost):
                begun.set()
                shown.set_postfix_str(f"stage {stage - before + 1} of {stages}, cost {cost:.4g}", refresh=False)
                shown.update(1)

            with listening(step):
                yield True


def _doubled(times):
    """Parts that are doubled until the whole, which is not among them, where it has so many times the first part."""
    return 2.0 ** -np.arange(np.clip(np.floor(np.log2(max(times, 1))), 0, STAGES - 1), 0, -1)


def _of_records(windows, parts):
    """The part of each window's time (S, W) that lies in some first parts (S,) of its record."""
    begin, end = windows.ts[:, 0], np.take_along_axis(windows.ts, windows.last[:, None], axis=1)[:, 0]
    first, record = begin[windows.first][windows.record], windows.record
    whole = np.array([end[record == r].max() for r in record]) - first
    return np.clip((first + parts[:, None] * whole - begin) / (end - begin), 0.0, 1.0)


def _scattered(found, count, spread, seed):
    """Starts (count, p) around the guess, or between two bounds."""
    xp = coordinates.numpy_of(found.start)
    start, low, high = (x[None] for x in (found.start, found.low, found.high))
    here, share = _drawn(seed, (count, start.size))
    x = start + xp.where(start != 0, start, 1.0) * np.expm1(spread * here)
    inside = (x > low) & (x < high)
    bounded = np.isfinite(low) & np.isfinite(high)
    anywhere = np.where(bounded, low, 0.0) + share * np.where(bounded, high, 1.0) - share * np.where(bounded, low, 0.0)
    return xp.where(bounded, anywhere, xp.where(inside, x, start))


@lru_cache
def _drawn(seed, shape):
    """Normal numbers, and uniform ones between 0 and 1 but for the ends."""
    random = np.random.default_rng(seed)
    return random.normal(size=shape), random.uniform(0.01, 0.99, shape)
