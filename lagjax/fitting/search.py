"""The search: Levenberg-Marquardt by optimistix, over a growing part of the records, then over joined windows.

One program serves all stages: how far the records count, and how tightly windows are joined, are numbers in it. The
slopes of all equations are computed together with their values, forward, in one pass over the motions.

The first part of a record cannot see everything. What it does not see would go wherever its errors send it, and the
next part begins there. So every part but the last is fitted with a hold, a square that costs a change by `REACH` (of
the engine) as much as an error of measurement: beside the data it is nothing where the part sees, and all where it does
not. The last has one that is beside nothing but round-off.

An end that its residuals contradict (`misfit`) is not the last word: the whole record from the guess itself comes next,
then other starts. They are further turns of the same compiled loop, and the best end counts.
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
from jaxtyping import Array, Bool, Float, Int

from lagjax.fitting.equations import (
    WHOLE,
    Problem,
    Stage,
    assemble,
    assemble_slopes,
    equations,
    hold_weights,
    over_windows,
    prior_and_hold,
    window_part,
)
from lagjax.fitting.misfit import OF_NORMAL, Misfit, misfit
from lagjax.fitting.predicted import check_predicted
from lagjax.jax_internals.tracing import WATCHED
from lagjax.mechanics.compiled import compiled
from lagjax.motion.reported import PATIENCE
from lagjax.numerics.chained import (
    ByWindows,
    Covariance,
    Equations,
    Slopes,
    Unknowns,
    covariance,
    eliminate,
    filled,
    slopes_of,
)

# Of the slopes, enough to make what the data cannot see regular, and too little to be seen itself.
FLOOR = 1e-10
# Costs that differ by this part are the same.
SAME = 1e-6
# An uncertainty so many times (over √eps) larger than with all else known is none: the data do not see it.
UNSEEN = 0.15
# A parameter whose slopes are not so many times its hold is held by that alone: what they are is round-off.
BESIDE_HOLD = 2.0
# A parameter with no larger part (squared) in what is not seen is determined.
NO_PART = 1e-8


class Course(NamedTuple):
    """The course of a search: its stages, their numbers with a leading axis S, and where it may begin.

    - `tolerances` (S,): when a stage is done, in units of a residual.
    - `starts` (A, p): of shared unknowns. `first` (A,): the stage with which a search from there begins.
    - `count`: how many of them there are, and no more than fill the array up. `must`: how many of them are tried in any
      case; the others while the best end is doubtful.
    """

    stages: Stage
    tolerances: Float[Array, " S"]
    starts: Float[Array, "A p"]
    first: Int[Array, " A"]
    count: Int[Array, ""]
    must: Int[Array, ""]


class Searched(NamedTuple):
    """Where a search ended, its cost (half the sum of squares), the steps it took, whether it came to rest there, what
    the residuals say, and the costs from all starts (A,), NaN from those that were not tried.
    """

    unknowns: Unknowns
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    rested: Bool[Array, ""]
    misfit: Misfit
    costs: Float[Array, " A"]


class Linear(NamedTuple):
    """Values and slopes of all equations at one point, and which windows' motions ended well."""

    values: Equations
    slopes: Slopes
    well: Bool[Array, " W"]


class Evaluation(NamedTuple):
    """What the data say at one point, where errors are of size one.

    - `rows` (W, m): residuals in sigmas. `well` (W,): which motions ended well.
    - `covariance` of the unknowns; `determined`: which of them the data see.
    - `singular_values` (p,), `combinations` (p, p): of relative changes of the shared unknowns.
    - `chi2`, `freedom`: the sum of squares, and the number of measurements less that of what they determine.
    """

    rows: Float[Array, "W m"]
    well: Bool[Array, " W"]
    covariance: Covariance
    determined: Unknowns
    singular_values: Float[Array, " p"]
    combinations: Float[Array, "p p"]
    chi2: Float[Array, ""]
    freedom: Float[Array, ""]


@eqx.filter_jit
def linearised(problem: Problem, u: Unknowns, stage: Stage, loss: str) -> Linear:
    """All equations and their slopes, in natural numbers, from one pass over the motions."""
    p = u.shared.size

    def at(w, s):
        of = lambda both: window_part(problem, both[:p], both[p:], w, stage, diffrax.ForwardMode(), loss)
        both = jnp.concatenate([u.shared, s])
        # The values are the same along all directions, and computed once; the machine function repeats them.
        along = lambda d: jax.jvp(of, (both,), (d,), has_aux=True)
        values, pushed, well = jax.vmap(along)(jnp.eye(both.size, dtype=both.dtype))
        return jax.tree.map(lambda x: x[0], (values, well)), jax.tree.map(lambda x: x.T, pushed)

    (values, well), pushed = over_windows(at, problem, u)
    by_shared, by_local = (jax.tree.map(lambda x: x[..., part], pushed) for part in (slice(p), slice(p, None)))
    return Linear(assemble(problem, u, values, stage), assemble_slopes(problem, by_shared, by_local, stage), well)


def evaluation_from(problem: Problem, u: Unknowns, linear: Linear, stage: Stage) -> Evaluation:
    """What the data say at `u`, from the plain residuals and their slopes."""
    sizes = linear.slopes.sizes()
    # What the equations do not determine is held by next to nothing.
    floor = jax.tree.map(lambda size: FLOOR * size, filled(sizes))
    triangular = eliminate(linear.slopes, linear.values, floor)
    # In units of the slopes: what the data do not see has a singular value of about FLOOR.
    size = filled(sizes).shared
    size = jnp.where(size > BESIDE_HOLD * hold_weights(problem, stage), size, jnp.inf)
    left, singular, right = jnp.linalg.svd(triangular.shared / size[None])
    unseen = UNSEEN / np.sqrt(np.finfo(size.dtype).eps)
    seen = singular > 1 / unseen
    inverse = (right.T / size[:, None]) @ (jnp.where(seen, 1 / jnp.where(seen, singular, 1.0), 0.0)[:, None] * left.T)
    of = covariance(triangular, inverse)
    known_alone = jnp.sum(jnp.where(seen[:, None], 0.0, right) ** 2, axis=0) < NO_PART
    own = jnp.sqrt(jax.vmap(jnp.diag)(of.local))
    determined = Unknowns(known_alone, (sizes.local > 0) & (sizes.local * own < unseen))
    relative = jnp.where(u.shared != 0, jnp.abs(u.shared), 1.0)
    _, singular_values, combinations = jnp.linalg.svd(triangular.shared * relative[None])
    chi2 = jnp.sum(linear.values.rows**2)
    known = [jnp.sum(jnp.isfinite(x) & jnp.isfinite(s)) for x, s in zip(*map(jax.tree.leaves, problem.data))]
    # A seam takes away what a start of its own adds.
    joined = jnp.where(stage.joined > 0, jnp.sum(problem.windows.seam) * problem.unit.size, 0)
    unknowns = sum(jnp.sum(d) for d in determined) - joined
    freedom = sum(known) + jnp.sum(jnp.isfinite(problem.found.sd)) - unknowns
    return Evaluation(
        linear.values.rows, linear.well, of, determined, singular_values, combinations, chi2,
        freedom.astype(chi2.dtype),
    )  # fmt: skip


@partial(compiled, in_numpy=True)
def evaluate(problem: Problem, u: Unknowns, stage: Stage) -> Evaluation:
    """What the data say at `u`."""
    check_predicted(problem)
    at = lambda problem, u, stage: evaluation_from(problem, u, linearised(problem, u, stage, "squares"), stage)
    return in_turn(at, problem, u, stage)


def _natural(problem, y: Unknowns) -> Unknowns:
    return Unknowns(problem.found.natural(y.shared), y.local)


@eqx.filter_custom_jvp
def _equations(y, problem, stage):
    # Changes nothing but that the trace is found again: JAX keeps one for no mesh and one for an empty mesh.
    with jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh()):
        linear = linearised(problem, _natural(problem, y), stage, problem.loss)
    return linear.values, linear.well


@_equations.def_jvp
def _equations_jvp(primals, tangents):
    (y, problem, stage), (dy, *_) = primals, tangents
    u, du = jax.jvp(lambda y: _natural(problem, y), (y,), (dy,))
    linear = linearised(problem, u, stage, problem.loss)
    return (linear.values, linear.well), (linear.slopes.along(du), None)


def _least_squares(solver, problem, y, stage, limit, told):
    def with_cost(y, args):
        values, well = _equations(y, *args)
        told(_cost(values))
        return values, (values, well)

    return optx.least_squares(with_cost, solver, y, (problem, stage), has_aux=True, max_steps=limit, throw=False)


def _minimise(solver, problem, y, stage, limit, told):
    def cost(y, args):
        problem, stage = args
        values = equations(problem, _natural(problem, y), stage)
        told(_cost(values))
        return _cost(values), (values, jnp.ones(problem.windows.count, bool))

    solver = optx.BestSoFarMinimiser(solver)
    return optx.minimise(cost, solver, y, (problem, stage), has_aux=True, max_steps=limit, throw=False)


def _ordinary(problem, u, stage):
    """The size of an ordinary error at `u`, in sigmas: what half of the residuals do not exceed; not below a sigma."""
    rows = equations(problem, u, stage._replace(ordinary=jnp.asarray(jnp.inf))).rows
    # What was not measured, or does not count yet, is zero.
    half = jnp.nanmedian(jnp.where(rows == 0, jnp.nan, jnp.abs(rows)))
    return jnp.maximum(OF_NORMAL * jnp.where(jnp.isfinite(half), half, 0.0), 1.0)


def _cost(values: Equations):
    return 0.5 * sum(jnp.sum(x**2) for x in values)


def _largest_change(tree):
    """How far an iteration changed what is predicted; what the data do not see may drift."""
    return jnp.asarray(0.0) if isinstance(tree, Unknowns) else optx.max_norm(tree)


@partial(compiled, in_numpy=True)
def search(problem: Problem, course: Course, optimiser: Any, limit: int, tell: bool):
    """Search from the starts of a course through all its stages; `tell` those who are `listening`.

    Returns a `Searched` and, where the search has its slopes, what the data say at its end.
    """
    # Here while it is traced: of the same functions and shapes it need not be asked again.
    check_predicted(problem)
    return in_turn(lambda *args: _search(*args, limit, tell), problem, course, optimiser)


# Who hears of each step; outside of the program, which is kept for the next search.
_LISTENERS = []


@contextmanager
def listening(listener: Callable[[int, float], None]):
    """While it lasts, `listener(stage, cost)` is called after each step of a search that tells."""
    _LISTENERS.append(listener)
    try:
        yield
        jax.effects_barrier()
    finally:
        _LISTENERS.remove(listener)


def _heard(stage, cost):
    for listener in _LISTENERS:
        listener(int(stage), float(cost))


def in_turn(function: Callable, *args):
    """`function(*args)`; on a CPU lanes of a `vmap` run one after the other, which compiles once and wastes no steps.

    A sweep of fits does not hear of the motions that a search tries.
    """
    live, static = eqx.partition(args, eqx.is_array)

    def run(live):
        with WATCHED(False), PATIENCE(None):
            return function(*eqx.combine(live, static))

    if jax.default_backend() == "cpu":
        run = jax.custom_batching.sequential_vmap(run)
    return run(jax.tree.map(jnp.asarray, live))


class _Best(NamedTuple):
    """The best end so far, in free numbers; `slopes` where the search has them."""

    y: Unknowns
    cost: Float[Array, ""]
    values: Equations
    slopes: Slopes | None
    well: Bool[Array, " W"]
    rested: Bool[Array, ""]
    misfit: Misfit


def _search(problem, course, optimiser, limit, tell):
    last = len(course.tolerances) - 1
    tries = course.count
    own = jnp.asarray(problem.start.local)

    def one_stage(y, stage, tolerance, number):
        told = partial(jax.debug.callback, _heard, number) if tell else lambda cost: None
        if problem.loss != "squares":
            # Far from the truth every residual would look like an outlier, and such a loss has no slope there.
            estimated = _ordinary(problem, _natural(problem, y), stage)
            stage = stage._replace(ordinary=jnp.where(number == last, stage.ordinary, estimated))
        solver = optimiser
        if optimiser is None:
            solver = optx.LevenbergMarquardt(tolerance, tolerance, norm=_largest_change, linear_solver=ByWindows())
        by = _minimise if isinstance(solver, optx.AbstractMinimiser) else _least_squares
        solution = by(solver, problem, y, stage, limit, told)
        slopes = None
        if _keeps_slopes(problem, optimiser):
            # The slopes that the search has last, by free numbers, as its linear solver sees them.
            slopes = slopes_of(solution.state.f_info.jac.mv, y)
        values, well = solution.aux
        rested = (solution.result == optx.RESULTS.successful) & jnp.all(well)
        end = _Best(solution.value, _cost(values), values, slopes, well, rested, misfit(problem, values))
        return end, solution.stats["num_steps"]

    def begin(number):
        x = course.starts[jnp.minimum(number, tries - 1)]
        return Unknowns(problem.found.free(x), own), course.first[jnp.minimum(number, tries - 1)]

    def go_on(state):
        turn, *_, best = state
        doubtful = best.misfit.doubtful | ~best.rested
        return (turn < tries) & ((turn < course.must) | doubtful)

    def step(state):
        turn, number, y, taken, costs, best = state
        stage = jax.tree.map(lambda x: x[number], course.stages)
        stage = stage._replace(around=course.starts[turn])
        end, steps = one_stage(y, stage, course.tolerances[number], number)
        done = number == last
        # Of chaotic windows round-off keeps a search moving; two that end in one place have found it.
        again = jnp.any(jnp.abs(costs - end.cost) < SAME * end.cost) & jnp.all(end.well)
        end = end._replace(rested=end.rested | again)
        below = (end.cost < best.cost) | (again & ~best.rested & (end.cost < (1 + SAME) * best.cost))
        better = done & (below | ~jnp.isfinite(best.cost))
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), end, best)
        costs = costs.at[turn].set(jnp.where(done, end.cost, costs[turn]))
        next_y, first = begin(turn + 1)
        y = jax.tree.map(lambda new, old: jnp.where(done, new, old), next_y, end.y)
        return turn + done, jnp.where(done, first, number + 1), y, taken + steps, costs, best

    y, number = begin(0)
    nothing = _nothing(problem, y, _keeps_slopes(problem, optimiser))
    start = jnp.asarray(0), number, y, jnp.asarray(0), jnp.full(len(course.starts), jnp.nan, y.shared.dtype), nothing
    *_, steps, costs, best = lax.while_loop(go_on, step, start)
    u, evaluation = _natural(problem, best.y), None
    if best.slopes is not None:
        _, rate = jax.jvp(problem.found.natural, (best.y.shared,), (jnp.ones_like(best.y.shared),))
        slopes = best.slopes.scaled(jnp.where(rate != 0, 1 / rate, 0.0))
        # What is known is not what the search held.
        mean, weight = prior_and_hold(problem, WHOLE)
        values = best.values._replace(shared=weight * (u.shared - mean))
        linear = Linear(values, slopes._replace(shared=jnp.diag(weight)), best.well)
        evaluation = evaluation_from(problem, u, linear, jax.tree.map(lambda x: x[-1], course.stages))
    return Searched(u, best.cost, steps, best.rested, best.misfit, costs), evaluation


def _keeps_slopes(problem, optimiser):
    return optimiser is None and problem.loss == "squares"


def _nothing(problem, y, with_slopes):
    """What stands for the best end before there is one."""
    (p,), (windows, k), dtype = y.shared.shape, y.local.shape, y.shared.dtype
    m = sum(int(np.prod(x.shape[1:])) for x in jax.tree.leaves(problem.measured))
    j = 0 if windows == 1 else problem.unit.size
    of = lambda *shape: jnp.zeros(shape, dtype)
    w = windows
    values = Equations(of(w, m), of(w, j), of(p))
    slopes = Slopes(of(w, m, p), of(w, m, k), of(w, j, p), of(w, j, k), of(w, j, k), of(p, p))
    no, each = jnp.zeros((), bool), jnp.zeros(len(jax.tree.leaves(problem.measured)), bool)
    judged = Misfit(jnp.zeros(each.shape, dtype), each, each, no)
    cost = jnp.full((), jnp.inf, dtype)
    return _Best(y, cost, values, slopes if with_slopes else None, jnp.zeros(w, bool), no, judged)
