"""The search: Levenberg-Marquardt by optimistix, over a growing part of the records, then over joined windows.

One program serves all stages: how far the records count, and how tightly windows are joined, are numbers in it. The
slopes of all equations are computed together with their values, forward, in one pass over the motions.
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

from lagjax.fitting.equations import Problem, Stage, equations, of_window, over_windows, slopes_together, together
from lagjax.motion.reported import PATIENCE, WATCHED
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

# A standard deviation over the median of the absolute value, of normal errors.
OF_NORMAL = 1.4826
# Of the slopes, enough to make what the data cannot see regular, and too little to be seen itself.
FLOOR = 1e-10
# An uncertainty so many times (over √eps) larger than with all else known is none: the data do not see it.
UNSEEN = 0.15
# A parameter with no larger part (squared) in what is not seen is determined.
NO_PART = 1e-8


class Searched(NamedTuple):
    """Where a search ended, its cost (half the sum of squares), the steps it took and how it ended."""

    unknowns: Unknowns
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class Linear(NamedTuple):
    """Values and slopes of all equations at one point, and which windows' motions ended well."""

    values: Equations
    slopes: Slopes
    well: Bool[Array, " W"]


class Seen(NamedTuple):
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
        of = lambda both: of_window(problem, both[:p], both[p:], w, stage, diffrax.ForwardMode(), loss)
        both = jnp.concatenate([u.shared, s])
        # The values are the same along all directions, and computed once; the machine function repeats them.
        along = lambda d: jax.jvp(of, (both,), (d,), has_aux=True)
        values, pushed, well = jax.vmap(along)(jnp.eye(both.size, dtype=both.dtype))
        return jax.tree.map(lambda x: x[0], (values, well)), jax.tree.map(lambda x: x.T, pushed)

    (values, well), pushed = over_windows(at, problem, u)
    by_shared, by_own = (jax.tree.map(lambda x: x[..., part], pushed) for part in (slice(p), slice(p, None)))
    return Linear(together(problem, u, values, stage), slopes_together(problem, by_shared, by_own, stage), well)


def seen_from(problem: Problem, u: Unknowns, linear: Linear, stage: Stage) -> Seen:
    """What the data say at `u`, from the plain residuals and their slopes."""
    sizes = linear.slopes.sizes()
    # What the equations do not determine is held by next to nothing.
    floor = jax.tree.map(lambda size: FLOOR * size, filled(sizes))
    triangular = eliminate(linear.slopes, linear.values, floor)
    # In units of the slopes: what the data do not see has a singular value of about FLOOR.
    size = filled(sizes).shared
    left, singular, right = jnp.linalg.svd(triangular.shared / size[None])
    unseen = UNSEEN / np.sqrt(np.finfo(size.dtype).eps)
    seen = singular > 1 / unseen
    inverse = (right.T / size[:, None]) @ (jnp.where(seen, 1 / jnp.where(seen, singular, 1.0), 0.0)[:, None] * left.T)
    of = covariance(triangular, inverse)
    known_alone = jnp.sum(jnp.where(seen[:, None], 0.0, right) ** 2, axis=0) < NO_PART
    own = jnp.sqrt(jax.vmap(jnp.diag)(of.own))
    determined = Unknowns(known_alone, (sizes.own > 0) & (sizes.own * own < unseen))
    relative = jnp.where(u.shared != 0, jnp.abs(u.shared), 1.0)
    _, singular_values, combinations = jnp.linalg.svd(triangular.shared * relative[None])
    chi2 = jnp.sum(linear.values.rows**2)
    known = [jnp.sum(jnp.isfinite(x) & jnp.isfinite(s)) for x, s in zip(*map(jax.tree.leaves, problem.data))]
    # A seam takes away what a start of its own adds.
    joined = jnp.where(stage.joined > 0, jnp.sum(problem.windows.seam) * problem.unit.size, 0)
    unknowns = sum(jnp.sum(d) for d in determined) - joined
    freedom = sum(known) + jnp.sum(jnp.isfinite(problem.found.sd)) - unknowns
    return Seen(
        linear.values.rows, linear.well, of, determined, singular_values, combinations, chi2,
        freedom.astype(chi2.dtype),
    )  # fmt: skip


@eqx.filter_jit
def look(problem: Problem, u: Unknowns, stage: Stage) -> Seen:
    """What the data say at `u`."""
    at = lambda problem, u, stage: seen_from(problem, u, linearised(problem, u, stage, "squares"), stage)
    return _in_turn(at, problem, u, stage)


def _natural(problem, y: Unknowns) -> Unknowns:
    return Unknowns(problem.found.natural(y.shared), y.own)


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
        return values, (_cost(values), well)

    return optx.least_squares(with_cost, solver, y, (problem, stage), has_aux=True, max_steps=limit, throw=False)


def _minimise(solver, problem, y, stage, limit, told):
    def cost(y, args):
        problem, stage = args
        value = _cost(equations(problem, _natural(problem, y), stage))
        told(value)
        return value, (value, jnp.ones(problem.windows.count, bool))

    solver = optx.BestSoFarMinimiser(solver)
    return optx.minimise(cost, solver, y, (problem, stage), has_aux=True, max_steps=limit, throw=False)


def _ordinary(problem, u, stage):
    """The size of an ordinary error at `u`, in sigmas: what half of the residuals do not exceed; not below a sigma."""
    unforgiving = eqx.tree_at(lambda stage: stage.ordinary, stage, jnp.asarray(jnp.inf))
    rows = equations(problem, u, unforgiving).rows
    # What was not measured, or does not count yet, is zero.
    half = jnp.nanmedian(jnp.where(rows == 0, jnp.nan, jnp.abs(rows)))
    return jnp.maximum(OF_NORMAL * jnp.where(jnp.isfinite(half), half, 0.0), 1.0)


def _cost(values: Equations):
    return 0.5 * sum(jnp.sum(x**2) for x in values)


def _largest_change(tree):
    """How far an iteration changed what is predicted; what the data do not see may drift."""
    return jnp.asarray(0.0) if isinstance(tree, Unknowns) else optx.max_norm(tree)


@eqx.filter_jit
def search(problem: Problem, start: Unknowns, stages: Stage, tolerances, optimiser: Any, limit: int, tell: bool):
    """Search from `start` through all stages, whose numbers have a leading axis; `tell` those who are `listening`.

    Returns a `Searched` and, where the search has its slopes, what the data say at its end.
    """
    return _in_turn(lambda *args: _search(*args, limit, tell), problem, start, stages, tolerances, optimiser)


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


def _in_turn(function: Callable, *args):
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


def _search(problem, start, stages, tolerances, optimiser, limit, tell):
    def one_stage(carried, x):
        (y, taken), (number, stage, tolerance) = carried, x
        told = partial(jax.debug.callback, _heard, number) if tell else lambda cost: None
        if problem.loss != "squares":
            # Far from the truth every residual would look like an outlier, and such a loss has no slope there.
            estimated = _ordinary(problem, _natural(problem, y), stage)
            ordinary = jnp.where(number == len(tolerances) - 1, stage.ordinary, estimated)
            stage = eqx.tree_at(lambda stage: stage.ordinary, stage, ordinary)
        solver = optimiser
        if optimiser is None:
            solver = optx.LevenbergMarquardt(tolerance, tolerance, norm=_largest_change, linear_solver=ByWindows())
        by = _minimise if isinstance(solver, optx.AbstractMinimiser) else _least_squares
        solution = by(solver, problem, y, stage, limit, told)
        last = None
        if optimiser is None and problem.loss == "squares":
            # The slopes that the search has last, by free numbers, as its linear solver sees them.
            info = solution.state.f_info
            last = info.residual, slopes_of(info.jac.mv, y)
        converged = solution.result == optx.RESULTS.successful
        return (solution.value, taken + solution.stats["num_steps"]), (solution.aux, converged, last)

    first = Unknowns(problem.found.free(start.shared), start.own), jnp.asarray(0)
    (y, steps), stagewise = lax.scan(one_stage, first, (jnp.arange(len(tolerances)), stages, tolerances))
    (cost, well), converged, last = jax.tree.map(lambda x: x[-1], stagewise)
    u = _natural(problem, y)
    if last is not None:
        values, by_free = last
        _, rate = jax.jvp(problem.found.natural, (y.shared,), (jnp.ones_like(y.shared),))
        last = Linear(values, by_free.scaled(jnp.where(rate != 0, 1 / rate, 0.0)), well)
        last = seen_from(problem, u, last, jax.tree.map(lambda x: x[-1], stages))
    return Searched(u, cost, steps, converged), last
