"""`fit`: check, search for the parameters, evaluate, warn of what is doubtful; its loss alone; fits from files.

The loss is half the sum of the squared residuals of `fit` in its last stage, with the same weights and masks.
In a batch of B of the W windows each stands for W/B windows, so that the mean over random batches is the loss of all:

    loss = W/B Σ_batch r² / 2 + Σ d² / 2 + Σ ((x - mean)/sd)² / 2,

with the jumps d between windows, where these are joined. A motion that fails contributes a large constant without a
slope: it moves nothing.
"""

import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from inspect import signature
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from lagjax.display import meter, printable, waiting
from lagjax.files import NotGiven, Reader, Table, npz
from lagjax.fit.arguments import FitWarning, problem_of
from lagjax.fit.records import Record, Windows
from lagjax.fit.residuals import (
    JOINING,
    WHOLE,
    FitProblem,
    Stage,
    assemble,
    check_motion,
    check_predicted,
    prior_and_hold,
    window_part,
)
from lagjax.fit.result import Fit, caveats
from lagjax.fit.search import Course, evaluate, listening, search
from lagjax.fit.unknowns import FreeNumbers, unflatten_of
from lagjax.integrate import described_system, integrate, reported, same_system
from lagjax.jaxtools import is_traced, jitted, kinds, numpy_of, once
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns
from lagjax.refusals import must_be
from lagjax.system import Hybrid, System, UnknownSystem

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
    claim = "optimiser must be one of optimistix's least-squares solvers or minimisers"
    fix = "leave it out; or optimistix.BFGS(1e-6, 1e-6); lj.fit_loss for all others"
    must_be(optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | None, optimiser, claim, fix)


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


@dataclass(frozen=True, eq=False, repr=False)
class FitFunction:
    """A pure function of the unknowns of a fit, as `lj.fit_residuals` and `lj.fit_loss` return it.

    `function(unknowns)` counts all windows, `function(unknowns, batch)` those with the indices `batch` (B,).

    - `guess`: the unknowns to start from, a dict. `"params"` has the structure of `params` with None in place of what
      is not free; some entries of an array form a vector, and numbers with bounds are replaced by unbounded ones.
      `"starts"` (W, k): how far the start of each window is from its guess, as `found.sampling["starts"]` has it.
    - `params(unknowns)`: `params` with these numbers inserted, within their bounds.
    - `windows`: the number of windows, W.
    - `with_failed(unknowns, batch)`: the same value, and the share of these windows whose motion fails, a number from 0
      to 1: for `jax.value_and_grad(loss.with_failed, has_aux=True)`.
    """

    problem: FitProblem
    stage: Stage
    joined: bool
    summed: bool

    @property
    def windows(self) -> int:
        return self.problem.windows.count

    @property
    def guess(self) -> dict[str, PyTree]:
        found, start = self.problem.found, self.problem.start
        return {"params": found.tree(found.free(jnp.asarray(start.shared))), "starts": jnp.asarray(start.local)}

    def params(self, unknowns: Mapping[str, PyTree]) -> PyTree:
        found = self.problem.found
        return found.into(found.natural(found.vector(unknowns["params"])))

    def __call__(self, unknowns: Mapping[str, PyTree], batch: Int[Array, " B"] | Sequence[int] | None = None) -> Array:
        return self.with_failed(unknowns, batch)[0]

    def with_failed(
        self, unknowns: Mapping[str, PyTree], batch: Int[Array, " B"] | Sequence[int] | None = None
    ) -> tuple[Array, Array]:
        if self.joined and batch is not None:
            raise ValueError("joined windows continue each other and make no batches.\nFix: joined=False.")
        batch = jnp.arange(self.windows) if batch is None else jnp.asarray(batch)
        rows, failed = _residuals(self.problem, self.stage, dict(unknowns), batch, self.joined)
        return (0.5 * jnp.sum(rows**2) if self.summed else rows), failed

    def __repr__(self):
        what = "loss" if self.summed else "residuals"
        return f"{what} as a function of {listed(list(self.problem.found.names))} and {self.windows} starts"


def fit_residuals(
    system: System | Hybrid,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
    priors: Mapping[str, tuple[float, float] | None] | None = None,
    loss: str = "squares",
    window: float | None = None,
    joined: bool = True,
    **options,
) -> FitFunction:
    """Return the residuals that `lj.fit` squares, as a function for any least-squares solver.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t = jnp.array([0.0, 1.0, 2.0])
    >>> record = lj.Record(t, q=-5.0 * t**2, q0=0.0, v0=0.0, hold_q=True, hold_v=True, sigma=0.5)
    >>> residuals = fit_residuals(fall, record, {"g": 9.0})
    >>> print(residuals(residuals.guess)[:3].round(6))
    [0. 1. 4.]

    At t = 2 it has fallen 18, not 20: a difference of 2, or four sigmas.

    **Arguments:** those of `lj.fit` that say what is fitted; how the search finds it is up to the solver.

    **Returns:** a function of unknowns, `residuals(residuals.guess)`, which can be compiled, differentiated in forward
    and reverse mode, and batched. It returns a vector, in sigmas (without these, in units of the data's spread): the
    samples of each window, with 0 where nothing was measured and after the end of shorter records; then the jumps
    between joined windows; then one entry for each free number, 0 without a prior. Half its sum of squares is the cost
    of `lj.fit`. After a motion has failed its residuals are ten spreads of the data, without slopes.

    - `residuals.guess`: where to start, `{"params": ..., "starts": ...}`. `residuals.params(unknowns)`: the parameters
      of unknowns. `residuals.windows`: the number W of windows. `residuals(unknowns, batch)`: the windows with the
      indices `batch` (B,) alone, each times √(W/B).

    **Raises:** the errors of `lj.fit` about its arguments; `ValueError` for a batch of joined windows.

    Source: Nocedal & Wright, *Numerical Optimization*, §10.1.
    """
    problem = problem_of(system, records, params, free, observe, bounds, priors, loss, window, dict(options))
    check_predicted(problem)
    joined = joined and window is not None
    stage = WHOLE._replace(joined=JOINING[-1] * problem.spread_in_sigmas) if joined else WHOLE
    return FitFunction(problem, stage, joined, False)


def fit_loss(system: System | Hybrid, records: Record | Sequence[Record], params: PyTree, **arguments) -> FitFunction:
    """Return the loss that `lj.fit` minimises, half the sum of squared residuals, as a function for any optimiser.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t = jnp.array([0.0, 1.0, 2.0])
    >>> record = lj.Record(t, q=-5.0 * t**2, q0=0.0, v0=0.0, hold_q=True, hold_v=True, sigma=0.5)
    >>> loss = fit_loss(fall, record, {"g": 9.0})
    >>> value, slope = jax.value_and_grad(loss)(loss.guess)
    >>> print(value.round(6), slope["params"]["g"].round(6))
    8.5 -17.0

    The residuals are (g - 10) t²/2 / 0.5: 0, 1 and 4 here, with the slopes 0, -1 and -4.

    **Arguments:** as for `lj.fit_residuals`.

    **Returns:** a function of unknowns like that of `lj.fit_residuals`, to a number. `loss(unknowns, batch)` takes W/B
    times the windows with the indices `batch` (B,), which estimates the loss of all; `loss.with_failed` also gives the
    share of motions that fail. Networks are trained with it, by
    an optimiser of optax: [a recipe](/learned.md#training).

    **Raises:** as `lj.fit_residuals`.
    """
    of = fit_residuals(system, records, params, **arguments)
    return FitFunction(of.problem, of.stage, of.joined, True)


@jitted
def _residuals(
    problem: FitProblem, stage: Stage, unknowns: Mapping[str, PyTree], batch: Int[Array, " B"], joined: bool
) -> tuple[Float[Array, " r"], Float[Array, ""]]:
    """All residuals in one vector, those of a batch scaled to the size of all; the share of windows that fail."""
    u = Unknowns(problem.found.natural(problem.found.vector(unknowns["params"])), unknowns["starts"])

    def part(w: Int[Array, ""], s: Array):
        found, well = window_part(problem, u.shared, s, w, stage)
        return jax.tree.map(lambda x: jnp.where(well, x, lax.stop_gradient(x)), found), well

    # All lanes share the parameters, so that products with the weights of a network are products of matrices.
    parts, well = jax.vmap(part)(batch, u.local[batch])
    mean, weight = prior_and_hold(problem, stage)
    seams = [jnp.ravel(assemble(problem, u, parts, stage).seams)] if joined else []
    scale = np.sqrt(problem.windows.count / batch.size)
    rows = jnp.concatenate([jnp.ravel(scale * parts.rows), *seams, weight * (u.shared - mean)])
    return rows, 1 - jnp.mean(well, dtype=rows.dtype)


def load_fit(
    path: str | os.PathLike,
    system: System | Hybrid | None = None,
    observe: Callable | None = None,
    *,
    classes: Iterable[type] = (),
    **options,
) -> Fit:
    """Read a fit that `found.save(path)` has written, bit for bit.

    A file is data: reading it imports nothing, runs nothing of it and writes nothing, whoever has written it.

    >>> import os
    >>> import tempfile
    >>> import numpy as np
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t = np.linspace(0.0, 1.0, 6)
    >>> found = lj.fit(fall, lj.Record(t, q=3.0 * t - 5.0 * t**2 + 1e-3 * np.cos(9.0 * t), sigma=1e-3), {"g": 9.0})
    >>> path = os.path.join(tempfile.mkdtemp(), "fall.npz")
    >>> found.save(path)
    >>> again = lj.load_fit(path, fall)
    >>> print(again.names, bool(again.sd == found.sd), again.motion().q.shape)
    ('g',) True (6,)

    **Arguments:**

    - `path`: the file.
    - `system`, `observe`: the fitted system and function, which are not in the file; `options`: those of `lj.fit` that
      contain functions, such as `events=`. `motion()`, `log_likelihood` and `laplace()` need them; without them these
      raise an error that names what is missing, and the estimates, their uncertainties and the residuals are available.
    - `classes`: your own classes of which it holds objects, as in `lj.load_trajectory`.

    **Returns:** the `Fit`.

    **Raises:**

    - `FileNotFoundError` if the file does not exist.
    - `ValueError` for a file that is damaged, holds something else, or was written by a newer lagjax or a version that
      stores fits in another form; for a `system` other than the fitted one; for a float64 file while JAX works in
      float32; for objects of a class that was not passed.
    - `TypeError` for functions that the fit did not have.
    """
    known = {"system": system, "observe": observe} | {f"options.{name}": x for name, x in options.items()}
    known = {role: x for role, x in known.items() if x is not None}
    table = Table(classes)
    with npz.opened(path, "fit") as (contents, array):
        reader, asked = Reader(array, table=table), contents["functions"]
        if not isinstance(asked, list) or not all(isinstance(role, str) for role in asked):
            raise ValueError("its list of functions is not one that lagjax writes.")
        said, unflatten = reader.up(contents["known"]), unflatten_of(kinds(reader.up(contents["q"])))
        described = described_system(said)
        given: dict[str, Any] = {"system": described, "first": described, "unflatten": unflatten}
        reader.given = lambda role: given[role] if role in given else NotGiven(_short(role))
        found = reader.up(contents["fit"])
        if described.starts is None:
            raise ValueError("it does not say where its motions start.")
        check_shapes(found, described)
    if unknown := sorted(set(known) - set(asked)):
        raise TypeError(
            f"this fit has no {', '.join(_short(role) for role in unknown)} to be passed again.\n"
            f"It has {', '.join(printable(_short(role)) for role in asked)}."
        )
    return _with(found, known, described, path)


def _with(found: Fit, known: dict[str, Any], described: UnknownSystem, path: Any) -> Fit:
    """A fit with the functions that the user passes again."""
    problem, fields = found.problem, {}
    if "observe" in known:
        fields["observe"] = known["observe"]
    if "system" in known:
        system: Any = same_system(known["system"], described, path)
        if described.phase is not None:
            if not system.in_phases or not 0 <= described.phase < len(system.phases):
                raise ValueError(f"{path} starts in phase {described.phase}, which this system does not have.")
            system = system.starting(described.phase)
        fields |= {"system": system, "first": system.first_phase}
    options = {name: known.get(f"options.{name}", x) for name, x in problem.options.items()}
    return replace(found, problem=replace(problem, options=options, **fields))


def check_shapes(found: Fit, described: UnknownSystem) -> None:
    """Raise `ValueError` if the numbers of a fit do not belong together."""
    problem = found.problem
    numbers, windows, starts = problem.found, problem.windows, problem.starts
    p, (count, times), n = len(numbers.names), windows.ts.shape, np.size(problem.unit) // 2
    k, searched = starts.unknowns, found.unknowns

    def check(name: str, kinds: str, *expected, lead: bool = False):
        for x, shape in expected:
            here = np.shape(x)[: len(shape)] if lead else np.shape(x)
            if not isinstance(x, (np.ndarray, np.generic, jax.Array)) or here != shape or x.dtype.kind not in kinds:
                raise ValueError(f"{name} of shape {np.shape(x)} does not belong to {p} numbers in {count} windows.")

    of_numbers = (numbers.start, numbers.low, numbers.high, numbers.mean, numbers.sd, searched.shared)
    check("found", "f", *((x, (p,)) for x in of_numbers), (searched.local, (count, k)))
    check("windows", "f", (windows.ts, (count, times)))
    check("windows", "b", (windows.real, (count, times)), (windows.seam, (count,)))
    check("windows", "iu", (windows.sample, (count, times)), (windows.last, (count,)), (windows.record, (count,)))
    check("starts", "f", *((chart.guess, (count, n)) for chart in starts), (problem.unit, (2 * n,)))
    check("starts", "f", *((chart.along, (count, n, k)) for chart in starts))
    check("starts", "f", *((chart.across, (count, n, chart.across.shape[-1])) for chart in starts))
    check("the search", "f", (found.cost, ()), (found.costs, (found.costs.size,)), (problem.spread_in_sigmas, ()))
    check("the search", "b", (found.rested, ()), (found.misfit.doubtful, ()))
    check("the search", "iu", (found.steps, ()))
    channels, columns = jax.tree.leaves(problem.measured), 0
    check("misfit", "f", (found.misfit.times, (len(channels),)))
    check("misfit", "b", *((x, (len(channels),)) for x in (found.misfit.large, found.misfit.curved)))
    for kind, tree in problem.measured.items():
        rows = (count,) if kind == "end" else (count, times)
        for x, sigma in zip(jax.tree.leaves(tree), jax.tree.leaves(problem.sigma[kind]), strict=True):
            check(kind, "f", (x, rows), (sigma, rows), lead=True)
            check(kind, "f", (sigma, x.shape))
            columns += math.prod(x.shape[1:])
    records = len(windows.first)
    if described.starts is not None:
        (q, v), (q_slopes, v_slopes) = described.starts
        for tree, slopes in ((q, q_slopes), (v, v_slopes)):
            leaves = jax.tree.leaves(tree)
            for x, slope in zip(leaves, jax.tree.leaves(slopes), strict=True):
                check("starts", "f", (x, (records,)), lead=True)
                check("starts", "f", (slope, (*x.shape, p + k)))
            if sum(x[0].size for x in leaves) != n or jax.tree.structure(tree) != jax.tree.structure(slopes):
                raise ValueError(f"its starts do not have {n} coordinates.")
    if not in_order(windows.record, windows.last, times):
        raise ValueError("its windows are not in the order of its records.")
    if (at := found.evaluation) is not None:
        of, determined = at.covariance, at.determined
        check("covariance", "f", (of.shared, (p, p)), (of.local, (count, k, k)), (of.local_shared, (count, k, p)))
        check("determined", "b", (determined.shared, (p,)), (determined.local, (count, k)))
        check("rows", "f", (at.rows, (count, columns)))
        check("combinations", "f", (at.combinations, (p, p)), (at.singular_values, (p,)))
        check("chi2", "f", (at.chi2, ()), (at.freedom, ()))
    leaves = jax.tree.leaves(numbers.params)
    sizes = [np.size(leaves[number]) if places is None else len(places) for number, places in numbers.leaves]
    inside = all(0 <= i < np.size(leaves[number]) for number, places in numbers.leaves for i in places or ())
    if unknown := set(problem.options) - set(signature(integrate).parameters):
        raise ValueError(f"its options are not those of lj.integrate: {listed(sorted(unknown))}.")
    if sum(sizes) != p or not inside:
        raise ValueError(f"its parameters do not hold {p} numbers.")


def _short(role: str):
    return role.removeprefix("options.")


def in_order(record: np.ndarray, last: np.ndarray, times: int) -> bool:
    """Whether windows (count,) belong to records one after the other, from the first on, and end at a sample of theirs.

    >>> print([in_order(np.array(record), np.array([3, 1]), 4) for record in ([0, 0], [0, 1], [1, 1], [0, 2], [1, 0])])
    [True, True, False, False, False]
    >>> print([in_order(np.array([0, 1]), np.array(last), 4) for last in ([0, 4], [-1, 4], [0, 5])])
    [True, False, False]
    """
    steps = np.diff(record, prepend=0)
    return bool(record[0] == 0 and steps.min() >= 0 and steps.max() <= 1 and last.min() >= 0 and last.max() <= times)
