"""The search: Levenberg-Marquardt by optimistix, on a growing part of the records, then with joined windows.

One program serves all stages: the part of the records that counts and the weight of jumps between windows are numbers
in it. The slopes of all equations are computed together with their values, in forward mode, in one pass over the
motions.

The first part of a record does not determine all unknowns. Without a hold, measurement errors would move the others far
away, and the next stage would start there. So every part but the last is fitted with a hold, a square that makes a
change by `HOLD_REACH` (see `engine`) cost as much as a measurement error: it is negligible for unknowns that the part
determines, and keeps the others in place. The hold of the last stage only exceeds round-off.

If the residuals at the end contradict the fit (`misfit`), the search tries the whole record from the guess itself, then
other starts. These are further turns of the same compiled loop, and the best end counts.

Whether the residuals of a fit can be measurement errors: as large as `sigma` says, and uncorrelated.

Of n independent errors r of size one, x = Σr²/n has a cube root that is nearly normal, with the mean 1 - 2/9n and the
variance 2/9n. The correlations ρ_k of white residuals with the k-th next are normal, with the variance 1/n, so that
n Σρ_k² over some lags has a chi-squared distribution. Both are computed with the search, so that each of hundreds of
fits in one program reports its misfit, as a single fit does.

Source: Wilson & Hilferty, *Proc. Natl. Acad. Sci.* 17 (1931) 684; Box & Pierce, *J. Am. Stat. Assoc.* 65 (1970) 1509.
"""

from collections.abc import Callable
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.fit.residuals import (
    LOSSES,
    WHOLE,
    FitProblem,
    Stage,
    assemble,
    assemble_slopes,
    check_predicted,
    equations,
    hold_weights,
    over_windows,
    prior_and_hold,
    window_part,
)
from lagjax.integrate import in_turn
from lagjax.jaxtools import compiled, jitted
from lagjax.numerics import (
    ByWindows,
    Covariance,
    Slopes,
    Unknowns,
    WindowedEquations,
    covariance,
    eliminate,
    filled,
    slopes_of,
)

# Deviations that chance does not explain, in standard deviations; and those that are a reason to search further.
CHANCE, DOUBT = 5.0, 3.0
# White residuals this many times larger than sigma cannot be explained by a sigma that was merely guessed; the second
# number is a further factor for a robust loss, since outliers make the median larger.
TOO_LARGE, OUTLIER_FACTOR = 1.5, 2.0
# A good model, too, leaves a curve of up to this fraction of the data's spread; and the limit for searching further.
CURVE, TRACE = 0.05, 0.01
# How many of the following residuals each one is compared with.
LAGS = 10
# The standard deviation of normal errors over the median of their absolute values. Its square is as certain as the
# variance of this fraction of the measurements.
OF_NORMAL, EFFICIENCY = 1.4826, 0.37


class Misfit(NamedTuple):
    """What the residuals say about a fit, by channel: each leaf of the measurements.

    - `times` (c,): how many times larger than sigma they are; NaN if no sigma was given.
    - `large` (c,): whether they are larger than chance explains. `curved` (c,): whether they follow a curve.
    - `doubtful`: whether any of this, by weaker criteria, makes a further search worthwhile.
    """

    times: Float[Array, " c"]
    large: Bool[Array, " c"]
    curved: Bool[Array, " c"]
    doubtful: Bool[Array, ""]

    @property
    def any(self) -> Bool[Array, ""]:
        """Whether the residuals contradict the fit."""
        return (self.large | self.curved).any()


def misfit(problem: FitProblem, values: WindowedEquations) -> Misfit:
    """Judge the residuals at the end of a search, given as dampened by the problem's loss."""
    channels, at = [], 0
    for kind, tree in problem.measured.items():
        for x, sigma in zip(jax.tree.leaves(tree), jax.tree.leaves(problem.sigma[kind])):
            size = int(np.prod(x.shape[1:]))
            known = jnp.isfinite(x) & jnp.isfinite(sigma)
            r = jnp.where(known, values.rows[:, at : at + size].reshape(x.shape), 0.0)
            channels.append((kind != "end", r, known, sigma))
            at += size
    measured = sum(jnp.sum(known) for _, _, known, _ in channels)
    seams = jnp.sum(problem.windows.seam) * values.seams.shape[-1]
    unknowns = problem.found.start.size + problem.windows.count * problem.starts.unknowns - seams
    left = jnp.maximum((measured - unknowns) / jnp.maximum(measured, 1), 0.0)
    spreads = jax.tree.leaves(problem.spread)
    judged = [_channel(problem, left, *channel, spread) for channel, spread in zip(channels, spreads)]
    times, large, curved, doubtful = (jnp.stack(parts) for parts in zip(*judged))
    return Misfit(times, large, curved, jnp.any(doubtful))


def _channel(problem: FitProblem, left: Array, ordered: bool, r: Array, known: Array, sigma: Array, spread: Array):
    """For one channel: times, whether too large, whether on a curve, whether doubtful."""
    count = jnp.sum(known)
    count = jnp.where(count > 0, count, 1).astype(r.dtype)
    if problem.loss == "squares":
        x, free = jnp.sum(r**2) / (count * jnp.where(left > 0, left, 1.0)), count * left
        largest = TOO_LARGE**2
    else:
        half = jnp.nanmedian(jnp.where(known, jnp.abs(r), jnp.nan))
        x, free = (OF_NORMAL * _undampened(half, problem.loss)) ** 2, EFFICIENCY * count * left
        largest = (OUTLIER_FACTOR * TOO_LARGE) ** 2

    def above(z: float):
        return (left > 0) & (x > _exceeded_by_chance(jnp.maximum(free, 1e-3), z))

    lags, alike, squares = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    if ordered:
        # (W, lag, T, ...): the residuals that follow each one.
        most = min(LAGS, r.shape[1] - 1)
        following = np.arange(1, most + 1)[:, None] + np.arange(r.shape[1])

        def later(x: Array):
            return jnp.concatenate([x, jnp.zeros_like(x[:, :most])], axis=1)[:, following]

        each = (0, *range(2, r.ndim + 1))
        pairs = jnp.sum(known[:, None] & later(known), axis=each).astype(r.dtype)
        lags = jnp.sum(pairs > 0).astype(r.dtype)
        one = jnp.maximum(jnp.sum(r**2) / count, jnp.finfo(r.dtype).tiny)
        correlations = jnp.sum(r[:, None] * later(r), axis=each) / jnp.where(pairs > 0, pairs, 1) / one
        squares = jnp.sum(pairs * correlations**2)
        alike = jnp.max(jnp.where(pairs > count / 2, jnp.abs(correlations), 0.0))

    def follows(z: float):
        return (lags > 0) & (squares > lags * _exceeded_by_chance(jnp.maximum(lags, 1), z))

    # The size of the curve, as a fraction of the data's spread.
    of_data = jnp.sqrt(alike * jnp.sum((r * jnp.where(known, sigma, 0.0)) ** 2) / count) / spread
    if not problem.absolute:
        no = jnp.asarray(False)
        doubtful = follows(DOUBT) & (of_data > TRACE)
        return jnp.full((), jnp.nan), no, follows(CHANCE) & (of_data > CURVE), doubtful
    large = above(CHANCE) & (x > largest)
    curved = follows(CHANCE) & (above(CHANCE) | (of_data > CURVE))
    return jnp.sqrt(x), large, curved, above(DOUBT) | (follows(DOUBT) & (of_data > TRACE))


def _exceeded_by_chance(n: ArrayLike, z: float):
    """The value that Σr²/n exceeds as rarely as a standard normal number exceeds `z`."""
    return jnp.maximum(1 - 2 / (9 * n) + z * jnp.sqrt(2 / (9 * n)), 0.0) ** 3


def _undampened(r: Array, loss: str):
    """The residual that `dampened` maps to `r`, which must not be negative."""
    constant, _ = LOSSES[loss]
    z = r / constant
    inverse = {
        "soft_l1": lambda z: z * jnp.sqrt(1 + z**2 / 4),
        "huber": lambda z: jnp.where(z > 1, (1 + z**2) / 2, z),
        "cauchy": lambda z: jnp.sqrt(jnp.expm1(jnp.minimum(z**2, 100.0))),
    }
    return constant * inverse[loss](z)


# Relative to the slopes: a regularisation of undetermined directions, too small to affect the others.
FLOOR = 1e-10
# Costs that differ by less than this fraction count as equal.
SAME_COST = 1e-6
# An unknown is undetermined if its uncertainty is this many times (over √eps) larger than with all others known.
UNSEEN = 0.15
# The slopes of a parameter are round-off, and only the hold fixes it, unless they are this many times its hold.
BESIDE_HOLD = 2.0
# A parameter has no trace in the data if a change by its own size, or back to its guess, changes the residuals by less
# than this many √eps sigmas: about what the round-off in its slopes makes of it.
NO_TRACE = 100.0
# A parameter is determined if no larger share (squared) of it than this lies in undetermined directions.
NEGLIGIBLE_SHARE = 1e-8


class Course(NamedTuple):
    """The course of a search: its stages, with a leading axis S, and its starts.

    - `tolerances` (S,): the tolerance of each stage, in units of a residual.
    - `starts` (A, p): values of the shared unknowns. `first` (A,): the stage with which the search from each begins.
    - `count`: the number of starts; further entries only fill the arrays. `must`: how many of them are always tried;
      the others are tried while the best end is doubtful.
    """

    stages: Stage
    tolerances: Float[Array, " S"]
    starts: Float[Array, "A p"]
    first: Int[Array, " A"]
    count: Int[Array, ""]
    must: Int[Array, ""]


class Searched(NamedTuple):
    """Where a search ended: its cost (half the sum of squares), the number of steps, whether it came to rest, what the
    residuals say, and the costs from all starts (A,), NaN for those that were not tried.
    """

    unknowns: Unknowns
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    rested: Bool[Array, ""]
    misfit: Misfit
    costs: Float[Array, " A"]


class LinearisedResiduals(NamedTuple):
    """Values and slopes of all equations at one point, and which windows' motions ended well."""

    values: WindowedEquations
    slopes: Slopes
    well: Bool[Array, " W"]


class Evaluation(NamedTuple):
    """What the data determine at one point, with errors of size one.

    - `rows` (W, m): residuals in sigmas. `well` (W,): which motions ended well.
    - `covariance` of the unknowns; `determined`: which of them the data determine.
    - `singular_values` (p,), `combinations` (p, p): of relative changes of the shared unknowns.
    - `chi2`, `freedom`: the sum of squares, and the number of measurements minus that of determined unknowns.
    """

    rows: Float[Array, "W m"]
    well: Bool[Array, " W"]
    covariance: Covariance
    determined: Unknowns
    singular_values: Float[Array, " p"]
    combinations: Float[Array, "p p"]
    chi2: Float[Array, ""]
    freedom: Float[Array, ""]


@jitted
def linearised(problem: FitProblem, u: Unknowns, stage: Stage, loss: str) -> LinearisedResiduals:
    """All equations and their slopes, in natural numbers, from one pass over the motions."""
    p = u.shared.size

    def at(w: Array, s: Array):
        def of(both: Array):
            return window_part(problem, both[:p], both[p:], w, stage, diffrax.ForwardMode(), loss)

        both = jnp.concatenate([u.shared, s])
        # The values do not depend on the direction, so vmap computes them once and repeats the result.
        along = partial(jax.jvp, of, (both,), has_aux=True)
        values, pushed, well = jax.vmap(lambda d: along((d,)))(jnp.eye(both.size, dtype=both.dtype))
        return jax.tree.map(lambda x: x[0], (values, well)), jax.tree.map(lambda x: x.T, pushed)

    (values, well), pushed = over_windows(at, problem, u)
    by_shared, by_local = (jax.tree.map(lambda x: x[..., part], pushed) for part in (slice(p), slice(p, None)))
    return LinearisedResiduals(
        assemble(problem, u, values, stage), assemble_slopes(problem, by_shared, by_local, stage), well
    )


def evaluation_from(problem: FitProblem, u: Unknowns, linear: LinearisedResiduals, stage: Stage) -> Evaluation:
    """What the data determine at `u`, from the undampened residuals and their slopes."""
    sizes = linear.slopes.sizes()
    # A tiny regularisation for what the equations do not determine.
    floor = jax.tree.map(lambda size: FLOOR * size, filled(sizes))
    triangular = eliminate(linear.slopes, linear.values, floor)
    # In units of the slopes: undetermined directions have singular values of about FLOOR.
    size = filled(sizes).shared
    visible = (size > BESIDE_HOLD * hold_weights(problem, stage)) & ~_without_trace(problem, u.shared, sizes.shared)
    size = jnp.where(visible, size, jnp.inf)
    left, singular, right = jnp.linalg.svd(triangular.shared / size[None])
    unseen = UNSEEN / np.sqrt(np.finfo(size.dtype).eps)
    seen = singular > 1 / unseen
    inverse = (right.T / size[:, None]) @ (jnp.where(seen, 1 / jnp.where(seen, singular, 1.0), 0.0)[:, None] * left.T)
    cov = covariance(triangular, inverse)
    known_alone = jnp.sum(jnp.where(seen[:, None], 0.0, right) ** 2, axis=0) < NEGLIGIBLE_SHARE
    sd = jnp.sqrt(jax.vmap(jnp.diag)(cov.local))
    determined = Unknowns(known_alone, (sizes.local > 0) & (sizes.local * sd < unseen))
    relative = jnp.where(u.shared != 0, jnp.abs(u.shared), 1.0)
    _, singular_values, combinations = jnp.linalg.svd(triangular.shared * relative[None])
    chi2 = jnp.sum(linear.values.rows**2)
    known = [jnp.sum(jnp.isfinite(x) & jnp.isfinite(s)) for x, s in zip(*map(jax.tree.leaves, problem.data))]
    # Joining a window removes the unknowns that its own start adds.
    joined = jnp.where(stage.joined > 0, jnp.sum(problem.windows.seam) * problem.unit.size, 0)
    unknowns = sum(jnp.sum(d) for d in determined) - joined
    freedom = sum(known) + jnp.sum(jnp.isfinite(problem.found.sd)) - unknowns
    return Evaluation(
        linear.values.rows, linear.well, cov, determined, singular_values, combinations, chi2,
        freedom.astype(chi2.dtype),
    )  # fmt: skip


def _without_trace(problem: FitProblem, x: Float[Array, " p"], sizes: Float[Array, " p"]) -> Bool[Array, " p"]:
    """Which shared unknowns neither the data nor a prior see, from the sizes of their slopes."""
    change = jnp.maximum(jnp.abs(x), jnp.abs(x - problem.found.start))
    return sizes * change < NO_TRACE * np.sqrt(np.finfo(x.dtype).eps)


@partial(compiled, in_numpy=True)
def evaluate(problem: FitProblem, u: Unknowns, stage: Stage) -> Evaluation:
    """What the data determine at `u`."""
    check_predicted(problem)

    def at(problem: FitProblem, u: Unknowns, stage: Stage):
        return evaluation_from(problem, u, linearised(problem, u, stage, "squares"), stage)

    return in_turn(at, problem, u, stage)


def _natural(problem: FitProblem, y: Unknowns) -> Unknowns:
    return Unknowns(problem.found.natural(y.shared), y.local)


@eqx.filter_custom_jvp
def _equations(y: Unknowns, problem: FitProblem, stage: Stage):
    # Only so that JAX finds the cached trace again: it keeps one for no mesh and another for an empty mesh.
    with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
        linear = linearised(problem, _natural(problem, y), stage, problem.loss)
    return linear.values, linear.well


@_equations.def_jvp
def _equations_jvp(primals: tuple, tangents: tuple):
    (y, problem, stage), (dy, *_) = primals, tangents
    u, du = jax.jvp(lambda y: _natural(problem, y), (y,), (dy,))
    linear = linearised(problem, u, stage, problem.loss)
    return (linear.values, linear.well), (linear.slopes.along(du), None)


def _least_squares(solver: Any, problem: FitProblem, y: Unknowns, stage: Stage, limit: int, report: Callable):
    def with_cost(y: Unknowns, args: tuple):
        values, well = _equations(y, *args)
        report(_cost(values))
        return values, (values, well)

    return optx.least_squares(with_cost, solver, y, (problem, stage), has_aux=True, max_steps=limit, throw=False)


def _minimise(solver: Any, problem: FitProblem, y: Unknowns, stage: Stage, limit: int, report: Callable):
    def cost(y: Unknowns, args: tuple):
        problem, stage = args
        values = equations(problem, _natural(problem, y), stage)
        report(_cost(values))
        return _cost(values), (values, jnp.ones(problem.windows.count, bool))

    solver = optx.BestSoFarMinimiser(solver)
    return optx.minimise(cost, solver, y, (problem, stage), has_aux=True, max_steps=limit, throw=False)


def _ordinary(problem: FitProblem, u: Unknowns, stage: Stage):
    """The size of an ordinary error at `u`, in sigmas, from the median residual; at least one sigma."""
    rows = equations(problem, u, stage._replace(ordinary=jnp.asarray(jnp.inf))).rows
    # Residuals are zero where nothing was measured or the sample does not count yet.
    half = jnp.nanmedian(jnp.where(rows == 0, jnp.nan, jnp.abs(rows)))
    return jnp.maximum(OF_NORMAL * jnp.where(jnp.isfinite(half), half, 0.0), 1.0)


def _cost(values: WindowedEquations):
    return 0.5 * sum(jnp.sum(x**2) for x in values)


def _largest_change(tree: PyTree):
    """How far an iteration changed the predictions; unknowns that the data do not determine may drift."""
    return jnp.asarray(0.0) if isinstance(tree, Unknowns) else optx.max_norm(tree)


@partial(compiled, in_numpy=True)
def search(problem: FitProblem, course: Course, optimiser: Any, limit: int, tell: bool):
    """Search from the starts of a course through all its stages; `tell` says whether to call the listeners.

    Returns a `Searched` and, if the search keeps its slopes, what the data determine at its end.
    """
    # Checked while tracing only: the same functions and shapes need no second check.
    check_predicted(problem)
    return in_turn(lambda *args: _search(*args, limit, tell), problem, course, optimiser)


# Called after each step; kept outside of the program, which later searches reuse.
_LISTENERS = []


@contextmanager
def listening(listener: Callable[[int, float], None]):
    """A context in which `listener(stage, cost)` is called after each step of a search with `tell`."""
    _LISTENERS.append(listener)
    try:
        yield
        jax.effects_barrier()
    finally:
        _LISTENERS.remove(listener)


def _call_listeners(stage: Array, cost: Array):
    for listener in _LISTENERS:
        listener(int(stage), float(cost))


class _Best(NamedTuple):
    """The best end so far, in unbounded numbers; with `slopes` if the search keeps them."""

    y: Unknowns
    cost: Float[Array, ""]
    values: WindowedEquations
    slopes: Slopes | None
    well: Bool[Array, " W"]
    rested: Bool[Array, ""]
    misfit: Misfit


def _search(problem: FitProblem, course: Course, optimiser: Any, limit: int, tell: bool):
    last = len(course.tolerances) - 1
    tries = course.count
    local = jnp.asarray(problem.start.local)

    def one_stage(y: Unknowns, stage: Stage, tolerance: Array, number: Array):
        report = partial(jax.debug.callback, _call_listeners, number) if tell else lambda cost: None
        if problem.loss != "squares":
            # Far from the truth every residual would look like an outlier, for which a robust loss has no slope.
            estimated = _ordinary(problem, _natural(problem, y), stage)
            stage = stage._replace(ordinary=jnp.where(number == last, stage.ordinary, estimated))
        solver = optimiser
        if optimiser is None:
            solver = optx.LevenbergMarquardt(tolerance, tolerance, norm=_largest_change, linear_solver=ByWindows())
        by = _minimise if isinstance(solver, optx.AbstractMinimiser) else _least_squares
        solution = by(solver, problem, y, stage, limit, report)
        slopes = None
        if _keeps_slopes(problem, optimiser):
            # The last slopes of the search, by unbounded numbers, as passed to its linear solver.
            slopes = slopes_of(solution.state.f_info.jac.mv, y)
        values, well = solution.aux
        rested = (solution.result == optx.RESULTS.successful) & jnp.all(well)
        end = _Best(solution.value, _cost(values), values, slopes, well, rested, misfit(problem, values))
        return end, solution.stats["num_steps"]

    def begin(number: Array):
        x = course.starts[jnp.minimum(number, tries - 1)]
        return Unknowns(problem.found.free(x), local), course.first[jnp.minimum(number, tries - 1)]

    def go_on(state: tuple):
        turn, *_, best = state
        doubtful = best.misfit.doubtful | ~best.rested
        return (turn < tries) & ((turn < course.must) | doubtful)

    def step(state: tuple):
        turn, number, y, taken, costs, best = state
        stage = jax.tree.map(lambda x: x[number], course.stages)
        stage = stage._replace(around=course.starts[turn])
        end, steps = one_stage(y, stage, course.tolerances[number], number)
        done = number == last
        # In chaotic windows round-off keeps a search moving; two searches with the same end have converged.
        again = jnp.any(jnp.abs(costs - end.cost) < SAME_COST * end.cost) & jnp.all(end.well)
        end = end._replace(rested=end.rested | again)
        below = (end.cost < best.cost) | (again & ~best.rested & (end.cost < (1 + SAME_COST) * best.cost))
        better = done & (below | ~jnp.isfinite(best.cost))
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), end, best)
        costs = costs.at[turn].set(jnp.where(done, end.cost, costs[turn]))
        next_y, first = begin(turn + 1)
        y = jax.tree.map(lambda new, old: jnp.where(done, new, old), next_y, end.y)
        return turn + done.astype(turn.dtype), jnp.where(done, first, number + 1), y, taken + steps, costs, best

    y, number = begin(0)
    no_end = _no_end(problem, y, _keeps_slopes(problem, optimiser))
    start = jnp.asarray(0), number, y, jnp.asarray(0), jnp.full(len(course.starts), jnp.nan, y.shared.dtype), no_end
    *_, steps, costs, best = lax.while_loop(go_on, step, start)
    u, evaluation = _natural(problem, best.y), None
    if best.slopes is not None:
        _, rate = jax.jvp(problem.found.natural, (best.y.shared,), (jnp.ones_like(best.y.shared),))
        slopes = best.slopes.scaled(jnp.where(rate != 0, 1 / rate, 0.0))
        # What nothing sees returns from where round-off, or another start, has left it. At a bound the rate vanishes.
        returns = _without_trace(problem, u.shared, slopes.sizes().shared) & (rate != 0)
        u = u._replace(shared=jnp.where(returns, problem.found.start, u.shared))
        # The priors alone, without the hold of the search.
        mean, weight = prior_and_hold(problem, WHOLE)
        values = best.values._replace(shared=weight * (u.shared - mean))
        linear = LinearisedResiduals(values, slopes._replace(shared=jnp.diag(weight)), best.well)
        evaluation = evaluation_from(problem, u, linear, jax.tree.map(lambda x: x[-1], course.stages))
    return Searched(u, best.cost, steps, best.rested, best.misfit, costs), evaluation


def _keeps_slopes(problem: FitProblem, optimiser: Any):
    return optimiser is None and problem.loss == "squares"


def _no_end(problem: FitProblem, y: Unknowns, with_slopes: bool):
    """A placeholder for the best end before there is one."""
    (p,), (windows, k), dtype = y.shared.shape, y.local.shape, y.shared.dtype
    m = sum(int(np.prod(x.shape[1:])) for x in jax.tree.leaves(problem.measured))
    j = 0 if windows == 1 else problem.unit.size
    w = windows
    values = WindowedEquations(*(jnp.zeros(shape, dtype) for shape in ((w, m), (w, j), (p,))))
    shapes = (w, m, p), (w, m, k), (w, j, p), (w, j, k), (w, j, k), (p, p)
    slopes = Slopes(*(jnp.zeros(shape, dtype) for shape in shapes))
    no, each = jnp.zeros((), bool), jnp.zeros(len(jax.tree.leaves(problem.measured)), bool)
    unjudged = Misfit(jnp.zeros(each.shape, dtype), each, each, no)
    cost = jnp.full((), jnp.inf, dtype)
    return _Best(y, cost, values, slopes if with_slopes else None, jnp.zeros(w, bool), no, unjudged)
