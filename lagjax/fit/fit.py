"""`fit`: check the arguments, search for the parameters, evaluate the result and warn about what is doubtful."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.display import meter, waiting
from lagjax.fit.problem.arguments import FitWarning, problem_of
from lagjax.fit.problem.checks import check_motion
from lagjax.fit.problem.parameters import FreeNumbers
from lagjax.fit.problem.records import Record, Windows
from lagjax.fit.problem.residuals import JOINING, FitProblem, Stage
from lagjax.fit.result.result import Fit
from lagjax.fit.result.warnings import caveats
from lagjax.fit.search.search import Course, evaluate, listening, search
from lagjax.integrate import reported
from lagjax.jaxtools import is_traced, numpy_of, once
from lagjax.mechanics import listed
from lagjax.system import Hybrid, System

# Measurements per unknown in the first part of a record, which doubles stage by stage; the largest number of stages.
FIRST_PART, STAGES = 4, 7
# A robust loss takes this many more stages, which estimate the size of an ordinary error.
SETTLING_STAGES = 2
# While only a part of a record counts, a change of a number by this fraction costs as much as a measurement error;
# without sigma, that error is assumed to be this fraction of the data's spread.
HOLD_REACH, ASSUMED_ERROR = 0.3, 0.03
# The hold on the whole record, as a fraction of that on a part, for few numbers: one that only round-off sees keeps its
# guess. Of many numbers, as in a network, no single one is determined.
FINAL_HOLD = 1e-7
# Further starts if the end is doubtful, for at most this many numbers.
RESTARTS, RESTARTS_UP_TO = 8, 20
# Arguments of trainings with optax, which `fit` does no longer do.
TRAINING = {"batch", "held_back", "patience"}
# Uncertainties of more numbers than this are not computed.
COVARIANCE_UP_TO = 1000
# Tolerances of a stage and of the last stage, in units of the data's spread; the last is at least this many times the
# integration's rtol, and this many round-offs.
STAGE_TOLERANCE, LAST_TOLERANCE, RTOL_FACTOR, ROUND_OFFS = 1e-4, 1e-9, 10.0, 100.0


def fit(
    system: System | Hybrid,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
    priors: Mapping[str, tuple[float, float] | None] | None = None,
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
    progress: bool | None = None,
    **options,
) -> Fit:
    """Find the parameters and initial states whose motion is nearest to the measurements.

    >>> import numpy as np
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t = np.linspace(0.0, 1.0, 6)
    >>> found = fit(fall, lj.Record(t, q=3.0 * t - 5.0 * t**2, sigma=1e-3), {"g": 9.0})
    >>> print(f"{found.params['g']:.6f}", f"{found.v0[0]:.6f}", found.converged)
    10.000000 3.000000 True

    **Main arguments:**

    - `system`: also a `Hybrid`, whose records start in one phase (`start=`, the first by default), or a system with
      elements, whose modes fit each start; both without windows.
    - `records`: one `Record` or several, each with its own initial state. Angles must be continuous, not wrapped to one
      turn.
    - `params`: what the Lagrangian takes, with guesses of the numbers to be found; all records share it.
    - `free`: the names of the numbers to be found, `"g"`, `["m[1]", "arm.length"]`, or of a part, such as a network,
      `"potential"`. By default every floating-point number in `params`.
    - `observe(t, q, v, params)`: the quantities that `observed` in the records measures: positions, for example.
    - `bounds`: by name, `{"m": (0.0, None)}`. The search takes the logarithm of a positive number.
    - `priors`: by name (mean, standard deviation) of what is known already; needs `sigma` in the records. Weights of
      networks beside other numbers have weak ones; `{"net": None}` leaves these out ([how](/learned.md)).
    - `loss`: `"squares"`; or `"huber"`, `"soft_l1"`, `"cauchy"`, against outliers, which need `sigma`. Until the last
      stage the median residual counts as an ordinary error, since far from the truth all residuals are large.
    - `units`: by name, for the table.

    **The search:**

    - `window`: cut records into windows of this length, `[t]`, each with its own initial state: for chaotic motion and
      long records. With `joined` (multiple shooting) the jumps between windows are weighted more and more in a few
      stages until each window continues where the last one ended; else windows stay independent, which tolerates
      effects that the system leaves out.
    - `grow`: start with the first part of each record or window and double it, stage by stage: a long record has many
      wrong minima, whole periods off. Parameters that a part does not determine stay near their guess. If the end is
      doubtful, the search starts again from the guess: joined windows grow along their record, then the whole record
      counts at once.
    - `restarts`: further starts of the search, with parameters `spread` (relative) away from their guess, or anywhere
      between two bounds, drawn with `seed`. The best end counts. By default 8, for up to 20 numbers, and only while the
      best end is doubtful: not converged, or with residuals that are unlikely to be measurement errors.
    - `optimiser`: by default `optimistix.LevenbergMarquardt`, with forward-mode derivatives. Any other least-squares
      solver of optimistix; or one of its minimisers, with reverse-mode derivatives, such as
      `optimistix.BFGS(rtol, atol)`.
    - `iterations`: the largest number in each stage, 100 by default.

    Networks with thousands of weights are trained by gradient steps on `lj.fit_loss`, by optax for example.

    **Further:**

    - `progress`: show stage, steps and cost (tqdm); by default if the output is interactive.
    - `options` go to `lj.integrate`: `rtol`, `atol`, `method`, `event`, `max_steps`, ...

    **Returns:** a `Fit`: estimates with their uncertainties, residuals, and what the data do not determine. It is the
    best point found, even if the fit is not a success (`converged` is false, with a `FitWarning`): the search did not
    come to rest, or the residuals contradict `sigma` or follow a curve. Inside `jax.vmap`, `jit` or `lj.sweep`
    measurements and guesses may be traced, but not times; a sweep's `status` says which fits failed.

    **Raises:**

    - `ValueError` for names, shapes and kinds that do not match; for a guess from which the motion fails at once.
    - Warns (`lj.FitWarning`) if the search did not converge, a motion stops early, residuals are larger than `sigma`
      says or follow a curve, an estimate is at its bound, or the data do not determine a parameter.

    Source: Nocedal & Wright, *Numerical Optimization*, §10.3; Bock, in *Modelling of Chemical Reaction Systems* (1981)
    (multiple shooting); Huber, *Robust Statistics*, §7.8 (scale by the median); Bierman, *Factorization Methods for
    Discrete Sequential Estimation* (covariance); Box & Pierce, *J. Am. Stat. Assoc.* 65 (1970) 1509 (residuals).
    """
    _check_optimiser(optimiser, options)
    problem = problem_of(system, records, params, free, observe, bounds, priors, loss, window, dict(options))
    further = restarts
    if restarts is None:
        further = RESTARTS if optimiser is None and 0 < problem.found.start.size <= RESTARTS_UP_TO else 0
    scattered = _scattered_starts(problem.found, further, spread, seed)
    course = _course(problem, grow, joined and window is not None, scattered, bool(restarts))
    last = jax.tree.map(lambda x: x[-1], course.stages)
    with _step_meter(problem, course, progress) as tell:
        searched, evaluation = search(problem, course, optimiser, 100 if iterations is None else iterations, tell)
    costs = numpy_of(searched.costs).asarray(searched.costs)[: int(course.count)]
    searched = searched._replace(costs=costs)
    if evaluation is None and problem.found.start.size <= COVARIANCE_UP_TO:
        evaluation = evaluate(problem, searched.unknowns, last)
    if evaluation is not None and not is_traced(evaluation) and not np.any(np.asarray(evaluation.well)):
        check_motion(problem, evaluation.well, problem.start)
    found = Fit(problem, *searched, evaluation, _sorted(units))
    if evaluation is not None and not is_traced(found.cost) and found.at_bounds():
        # At a bound the slopes that the search keeps vanish.
        found = eqx.tree_at(lambda f: f.evaluation, found, evaluate(problem, searched.unknowns, last))
    return _reported(found)


def _reported(found: Fit) -> Fit:
    """Report the fit to a surrounding sweep, warn of its caveats, and return it."""
    found = reported(found, Fit.report)
    if not is_traced(found.cost):
        for words in caveats(found):
            warnings.warn(words, FitWarning, stacklevel=3)
    return found


def _sorted(units: Mapping[str, str] | None):
    return tuple(sorted((units or {}).items()))


def _check_optimiser(optimiser: Any, options: dict[str, Any]):
    trains = isinstance(optimiser, tuple) and all(callable(getattr(optimiser, x, None)) for x in ("init", "update"))
    if trains or TRAINING & set(options):
        what = "an optimiser of optax" if trains else f"{listed(sorted(TRAINING & set(options)))}, of a training,"
        raise TypeError(
            f"{what} was given to lj.fit, which searches for the minimum with least squares and does not train.\n"
            "Usual cause: a network with many weights, or code for an earlier lagjax.\n"
            "Fix: loss = lj.fit_loss(system, records, params, window=1.0, joined=False), a function whose slope "
            "jax.grad(loss)(unknowns) any optimiser takes: the recipe in docs/learned.md, 'Training'."
        )
    if optimiser is not None and not isinstance(optimiser, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise TypeError(
            "optimiser must be one of optimistix's least-squares solvers or minimisers, not "
            f"{optimiser!r:.60}.\nFix: leave it out; or optimistix.BFGS(1e-6, 1e-6); lj.fit_loss for all others."
        )


def _course(problem: FitProblem, grow: bool, joined: bool, scattered: Array, try_all: bool) -> Course:
    """The stages of a search, and the starts from which it runs through them."""
    windows = problem.windows
    unknowns = sum(x.shape[-1] for x in jax.tree.leaves(problem.start))
    measured = sum(
        int(np.prod(x.shape[1:])) if kind == "end" else windows.longest * int(np.prod(x.shape[2:]))
        for kind, tree in problem.measured.items()
        for x in jax.tree.leaves(tree)
    )

    def growing(measured: float):
        return _doubled(measured / max(FIRST_PART * unknowns, 1)) if grow else np.zeros(0)

    def alike(parts: ArrayLike):
        return np.repeat(np.asarray(parts)[:, None], windows.count, axis=1)

    of_windows = alike(growing(measured))
    # Joined windows form one record, which may grow as a whole.
    of_records = np.zeros((0, windows.count))
    if joined and windows.count > 1:
        of_records = _parts_of_windows(windows, growing(measured * int(np.max(np.bincount(windows.record)))))
    settling, joining = (0 if problem.loss == "squares" else SETTLING_STAGES), (JOINING if joined else ())
    each = np.concatenate([of_records, of_windows, alike(np.ones(1 + settling + len(joining)))])
    # Unused stages in front fill the array up to a fixed length, so that one program serves any number of stages.
    kinds = 0 if not grow else 2 if joined and windows.count > 1 else 1
    filled = kinds * (STAGES - 1) - len(of_records) - len(of_windows)
    each = np.concatenate([alike(np.ones(filled)), each])
    partly = np.any(each < 1, axis=1)
    weights = np.append(np.zeros(len(each) - len(joining)), joining)
    ratio = problem.spread_in_sigmas
    rtol = problem.options.get("rtol")
    tolerance = max(LAST_TOLERANCE, ROUND_OFFS * np.finfo(windows.ts.dtype).eps)
    if rtol is not None:
        xp = numpy_of(rtol)
        tolerance = xp.maximum(tolerance, RTOL_FACTOR * xp.max(xp.asarray(rtol)))
    last = np.arange(len(each)) == len(each) - 1
    xp = numpy_of((ratio, tolerance, scattered, problem.found.start))
    at_the_end = FINAL_HOLD if problem.found.start.size <= RESTARTS_UP_TO else 0.0
    held = np.where(partly, 1.0, at_the_end) * (1.0 if problem.absolute else ASSUMED_ERROR) / HOLD_REACH
    stages = Stage(each, weights * ratio, np.ones(len(each)), held)
    # Round-off in the jumps between windows weighs as much as the jumps do.
    tolerances = xp.where(last, tolerance * (JOINING[-1] if joined else 1.0), STAGE_TOLERANCE) * ratio
    # From the guess: growing windows, growing records, and the whole record at once, if these differ.
    begin = np.unique([len(of_records), 0, len(of_records) + len(of_windows)])
    begin = np.append(len(of_records), begin[begin != len(of_records)])
    # From the other starts: the first two of these, alternately.
    first = np.append(begin, np.resize(begin[:2] if len(of_records) else begin[:1], len(scattered))) + filled
    count, more = len(first), 1 + kinds - len(begin)
    guess = xp.asarray(problem.found.start)[None]
    starts = xp.concatenate([guess] * len(begin) + [scattered] + [guess] * more)
    first = np.append(first, np.full(more, filled))
    return Course(stages, tolerances, starts, first, np.asarray(count), np.asarray(count if try_all else 1))


@contextmanager
def _step_meter(problem: FitProblem, course: Course, progress: bool | None):
    """Show a meter of the search's steps; yields whether there is one."""
    if is_traced(problem):
        yield False
        return
    unused = int(np.min(course.first))
    stages = len(course.tolerances) - unused
    with meter(progress, unit=" steps", desc="fit") as shown:
        if shown.disable:
            yield False
            return
        with waiting(progress, "compiling") as started:

            def step(stage: int, cost: float):
                started.set()
                shown.set_postfix_str(f"stage {stage - unused + 1} of {stages}, cost {cost:.4g}", refresh=False)
                shown.update(1)

            with listening(step):
                yield True


def _doubled(times: float):
    """Fractions that double up to the whole, which is not among them; the first is about 1/`times`."""
    return 2.0 ** -np.arange(np.clip(np.floor(np.log2(max(times, 1))), 0, STAGES - 1), 0, -1)


def _parts_of_windows(windows: Windows, parts: Array):
    """The fraction of each window's time (S, W) that lies in the first `parts` (S,) of its record."""
    begin, end = windows.ts[:, 0], np.take_along_axis(windows.ts, windows.last[:, None], axis=1)[:, 0]
    first, record = begin[windows.first][windows.record], windows.record
    whole = np.array([end[record == r].max() for r in record]) - first
    return np.clip((first + parts[:, None] * whole - begin) / (end - begin), 0.0, 1.0)


def _scattered_starts(found: FreeNumbers, count: int, spread: float, seed: int):
    """Random starts (count, p) around the guess, or between two bounds."""
    xp = numpy_of(found.start)
    start, low, high = (x[None] for x in (found.start, found.low, found.high))
    normal, share = _random_numbers(seed, (count, start.size))
    x = start + xp.where(start != 0, start, 1.0) * np.expm1(spread * normal)
    inside = (x > low) & (x < high)
    bounded = np.isfinite(low) & np.isfinite(high)
    anywhere = np.where(bounded, low, 0.0) + share * np.where(bounded, high, 1.0) - share * np.where(bounded, low, 0.0)
    return xp.where(bounded, anywhere, xp.where(inside, x, start))


@once
def _random_numbers(seed: int, shape: tuple[int, ...]):
    """Normal numbers, and uniform ones between 0 and 1 without the ends."""
    random = np.random.default_rng(seed)
    return random.normal(size=shape), random.uniform(0.01, 0.99, shape)
