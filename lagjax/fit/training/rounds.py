"""Training: steps of an optimiser of optax on batches of windows, evaluated on held-back records.

The cost is that of a fit, half the sum of squared residuals and of the squares of the priors, divided by the number of
measurements N. A step takes a batch of B of the W windows, in a new random order in each pass through all of them, and
the sum over the batch estimates that over all,

    cost = (W/B Σ_batch r² / 2 + Σ ((x - mean)/sd)² / 2) / N.

Its gradient is computed in reverse mode, for all motions of the batch at once. The gradient by each window's own start
comes at no extra cost and allows more than a step of the optimiser: with the curvature JᵀJ of that start, which hardly
depends on the parameters and is computed once a round, the start takes half a Newton step. So starts have no learning
rate, and move only with the batches that contain them.

For held-back windows only the starts are fitted, so their residuals say how well the parameters do on data that they
were not trained on.

Optimisers of optax: pairs of functions, `init(params)` and `update(gradients, state, params)`.

They get the fitted numbers in the structure of `params`, with None in place of all others, so that transformations that
go by names (`optax.multi_transform`, `optax.masked`) work. Numbers with bounds are passed as unbounded ones. If only
some entries of an array are fitted, these are passed as a vector.

The starts of all windows for given parameters, by Levenberg-Marquardt, each on its own and all in parallel.

A window has few unknowns s, so their slopes J are computed in forward mode with the residuals r, and a step is

    (JᵀJ + damping diag JᵀJ) ds = -Jᵀr,

taken if it reduces the window's own sum of squares; else the window's damping grows. The parameters, a network perhaps,
are the same in all lanes, so products with them are matrix products.
"""

import inspect
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.fit.problem.checks import check_predicted
from lagjax.fit.problem.parameters import FreeNumbers
from lagjax.fit.problem.residuals import WHOLE, FitProblem, dampened, equations, prior_and_hold, window_part
from lagjax.fit.search.search import OF_NORMAL, Misfit, in_turn, misfit
from lagjax.jaxtools.compiled import compiled
from lagjax.jaxtools.jaxpr_identity import Meaning, content_of, meaning_of
from lagjax.numerics.windowed_least_squares import Unknowns

# The initial damping, and its factors after a step that reduces the sum of squares or does not.
DAMPING, EASED, TIGHTENED = 1e-3, 0.2, 10.0
# Starts have converged if a step would reduce no sum of squares by more than this fraction.
CONVERGED_BELOW = 1e-3
# The number of windows in parallel.
LANES = 64


class Squares(NamedTuple):
    """For each window: the sum of squared residuals, Jᵀr, JᵀJ, and whether its motion ended well."""

    sums: Float[Array, " W"]
    slopes: Float[Array, "W k"]
    curvatures: Float[Array, "W k k"]
    well: Bool[Array, " W"]


def squares(problem: FitProblem, x, local) -> Squares:
    """The squares at parameters `x` and starts `local` (W, k)."""

    def one(window):
        w, s = window
        rows = lambda s: _rows(problem, x, s, w)
        if not s.size:
            r, well = rows(s)
            return Squares(jnp.sum(r**2), s, jnp.zeros((0, 0), s.dtype), well)
        # The residuals do not depend on the direction d, so vmap computes them once.
        along = lambda d: jax.jvp(rows, (s,), (d,), has_aux=True)
        r, pushed, well = jax.vmap(along)(jnp.eye(s.size, dtype=s.dtype))
        pushed = jnp.where(well[0] & jnp.all(jnp.isfinite(pushed)), pushed, 0.0)
        return Squares(jnp.sum(r[0] ** 2), pushed @ r[0], pushed @ pushed.T, well[0])

    windows = jnp.arange(problem.windows.count), local
    # `lax.map` in batches does not take empty arrays, which known starts have.
    return lax.map(one, windows, batch_size=min(LANES, len(local))) if local.size else jax.vmap(one)(windows)


def inverse_of(curvatures: Float[Array, "W k k"], damping: Float[Array, " W"]) -> Float[Array, "W k k"]:
    """The inverses of damped curvatures; 1 on the diagonal for unknowns without effect, such as held ones."""
    size = jax.vmap(jnp.diag)(curvatures)
    damped = jnp.where(size > 0, damping[:, None] * size, 1.0)
    return jnp.linalg.inv(curvatures + jax.vmap(jnp.diag)(damped))


def fit_starts(problem: FitProblem, x, local, most: int, least_gain: float = CONVERGED_BELOW) -> tuple[Array, Squares]:
    """The starts with the smallest sums of squares for given parameters, after at most `most` steps."""

    def steps(at, damping):
        return jnp.einsum("wij,wj->wi", inverse_of(at.curvatures, damping), at.slopes)

    def go_on(state):
        i, _, at, damping = state
        falls = jnp.sum(steps(at, damping) * at.slopes, axis=1)
        return (i < most) & jnp.any(falls > least_gain * at.sums)

    def step(state):
        i, local, at, damping = state
        tried = local - steps(at, damping)
        there = squares(problem, x, tried)
        better = there.sums < at.sums
        chosen = lambda new, old: jnp.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
        local, at = chosen(tried, local), jax.tree.map(chosen, there, at)
        return i + 1, local, at, damping * jnp.where(better, EASED, TIGHTENED)

    start = jnp.asarray(0), local, squares(problem, x, local), jnp.full(local.shape[0], DAMPING, local.dtype)
    _, local, at, _ = lax.while_loop(go_on, step, start)
    return local, at


def _rows(problem, x, s, w):
    part, well = window_part(problem, x, s, w, WHOLE, diffrax.ForwardMode())
    return part.rows, well


def is_of_optax(optimiser: Any) -> bool:
    """Whether something looks like a gradient transformation of optax."""
    return isinstance(optimiser, tuple) and all(callable(getattr(optimiser, x, None)) for x in ("init", "update"))


class Optimiser:
    """A gradient transformation, equal to all that do the same: `optax.adam(1e-2)` is a new object in each call."""

    def __init__(self, given: Any, found: FreeNumbers):
        self.given = given
        # Some take the value, too, such as `optax.contrib.reduce_on_plateau`.
        kinds = [p.kind for p in inspect.signature(given.update).parameters.values()]
        self.takes_value = inspect.Parameter.VAR_KEYWORD in kinds
        programs = jax.make_jaxpr(partial(self._first_step, found))(found.free(found.start))
        self.meaning = Meaning((meaning_of(programs.jaxpr), tuple(map(content_of, programs.consts))))

    def _first_step(self, found, y):
        value = jnp.sum(y)
        return self.step(found, y, y, self.init(found, y), value, lambda y: value)

    def __hash__(self):
        return hash(self.meaning)

    def __eq__(self, other):
        return isinstance(other, Optimiser) and self.meaning == other.meaning

    def init(self, found: FreeNumbers, y):
        """The state of the optimiser at free numbers `y` (p,)."""
        return self.given.init(as_params(found, y))

    def step(self, found: FreeNumbers, y, slopes, state, value, value_of):
        """Free numbers after a step, and the state; `value` is that of the function `value_of(y)` with these slopes."""
        more = {}
        if self.takes_value:
            value_of_tree = lambda tree: value_of(as_vector(tree, y))
            more = {"value": value, "grad": as_params(found, slopes), "value_fn": value_of_tree}
        changes, state = self.given.update(as_params(found, slopes), state, as_params(found, y), **more)
        return y + as_vector(changes, y), state


def as_params(found: FreeNumbers, y):
    """Numbers (p,) in the structure of `params`, with None in place of numbers that are not fitted."""
    leaves, structure = jtu.tree_flatten(found.params)
    chosen: list[Any] = [None] * len(leaves)
    at = 0
    for number, places in found.leaves:
        shape = leaves[number].shape if places is None else (len(places),)
        size = leaves[number].size if places is None else len(places)
        chosen[number] = y[at : at + size].reshape(shape)
        at += size
    return jtu.tree_unflatten(structure, chosen)


def as_vector(tree, like):
    """All numbers of a tree as a vector, with the dtype of `like`."""
    leaves = [jnp.ravel(x).astype(like.dtype) for x in jax.tree.leaves(tree)]
    return jnp.concatenate(leaves) if leaves else jnp.zeros_like(like)


# The fraction of a Newton step that a start takes, and its largest size relative to the spread of the starts.
OF_NEWTON, FARTHEST = 0.5, 0.1
# Steps for the starts of windows in an evaluation of the parameters, and at the end.
EVALUATION_STEPS, FINAL_STEPS = 4, 20
# At the end they have converged if a step would reduce no sum of squares by more than this fraction.
AT_REST = 1e-9


class Best(NamedTuple):
    """The best evaluation so far: its score, its round, and the evaluated unknowns."""

    score: Float[Array, ""]
    round: Int[Array, ""]
    y: Float[Array, " p"]
    local: Float[Array, "W k"]
    held: Float[Array, "H k"]


class TrainingState(NamedTuple):
    """The state of a training.

    - `y` (p,): unbounded numbers. `local` (W, k), `held` (H, k): starts of windows, and of the held-back ones.
    - `optimiser`: its state. `inverses` (W, k, k): the inverse curvatures of the starts.
    - `order` (W,): the order of the windows; those before `at` are done. `step`, `round`: how many have been done.
    - `failed`: motions that ended early. `skipped`: steps without a finite gradient.
    """

    y: Float[Array, " p"]
    local: Float[Array, "W k"]
    held: Float[Array, "H k"]
    optimiser: Any
    inverses: Float[Array, "W k k"]
    order: Int[Array, " W"]
    at: Int[Array, ""]
    step: Int[Array, ""]
    round: Int[Array, ""]
    failed: Int[Array, ""]
    skipped: Int[Array, ""]
    best: Best


class Round(NamedTuple):
    """The mean squared residual of each batch of a round, in sigmas (NaN after the last step), and its score."""

    losses: Float[Array, " steps"]
    score: Float[Array, ""]


class Task(NamedTuple):
    """The whole task of a training, without its state.

    `held` is None if no records are held back. A round has `steps` steps, of `batch` windows each.
    """

    problem: FitProblem
    held: FitProblem | None
    optimiser: Optimiser
    batch: int
    steps: int
    seed: Any
    limit: Any
    patience: Any

    @property
    def known(self) -> Any:
        """The number of measurements of each window."""
        count = lambda x, s: jnp.sum((jnp.isfinite(x) & jnp.isfinite(s)).reshape(x.shape[0], -1), axis=1)
        return sum(count(x, s) for x, s in zip(*map(jax.tree.leaves, self.problem.data)))


class FinalResult(NamedTuple):
    """The end of a training, or of the fit of held-back records, as that of a search."""

    unknowns: Unknowns
    cost: Float[Array, ""]
    misfit: Misfit


@partial(compiled, in_numpy=True)
def initial_state(task: Task) -> TrainingState:
    """The state before the first step."""

    def begin(task):
        check_predicted(task.problem)
        problem, local = task.problem, jnp.asarray(task.problem.start.local)
        y, (windows, k), zero = problem.found.free(problem.found.start), local.shape, jnp.zeros((), int)
        # Bad starts give slopes so large that optimisers that remember them, such as Adam, would hardly move later.
        local, at = fit_starts(problem, problem.found.natural(y), local, EVALUATION_STEPS)
        held, score = jnp.zeros((0, k), local.dtype), jnp.sum(at.sums) / jnp.maximum(jnp.sum(task.known), 1)
        if task.held is not None:
            held, score = _evaluate_held(task, y, jnp.asarray(task.held.start.local), FINAL_STEPS)
        return TrainingState(
            y, local, held, task.optimiser.init(problem.found, y), _inverses(at),
            jnp.arange(windows), jnp.full((), windows), zero, zero, zero, zero, Best(score, zero, y, local, held),
        )  # fmt: skip

    return in_turn(begin, task)


@partial(compiled, in_numpy=True)
def round_of(task: Task, state: TrainingState) -> tuple[TrainingState, Round]:
    """One round: its steps and an evaluation."""
    return in_turn(_round, task, state)


@compiled
def all_rounds(task: Task, rounds: int) -> tuple[TrainingState, TrainingState, Round]:
    """All rounds in one program, for a fit inside another program; returns the initial state first."""

    def run(task):
        nan = lambda state, *shape: jnp.full(shape, jnp.nan, state.y.dtype)
        nothing = lambda state: (state, Round(nan(state, task.steps), nan(state)))
        turn = lambda state, _: lax.cond(has_another_round(task, state), partial(_round, task), nothing, state)
        first = initial_state(task)
        return first, *lax.scan(turn, first, length=rounds)

    return in_turn(run, task)


def has_another_round(task: Task, state: TrainingState):
    """Whether there is another round."""
    return (state.step < task.limit) & (state.round - state.best.round < task.patience)


@partial(compiled, in_numpy=True)
def final_result(task: Task, state: TrainingState) -> tuple[FinalResult, FinalResult | None]:
    """The best parameters with all starts fitted to them, and the same for the held-back records."""

    def end(task, state):
        problem, best = task.problem, state.best
        x = problem.found.natural(best.y)
        found = _final_result(problem, x, best.local)
        return found, None if task.held is None else _final_result(with_params(task.held, problem, x), x[:0], best.held)

    return in_turn(end, task, state)


def _final_result(problem, x, local) -> FinalResult:
    u = Unknowns(x, fit_starts(problem, x, local, FINAL_STEPS, AT_REST)[0])
    values = equations(problem, u, WHOLE)
    return FinalResult(u, 0.5 * sum(jnp.sum(r**2) for r in values), misfit(problem, values))


def with_params(held: FitProblem, problem: FitProblem, x) -> FitProblem:
    """The problem of the held-back records with these parameters, which it does not fit."""
    return replace(held, found=replace(held.found, params=problem.found.into(x)))


def _round(task: Task, state: TrainingState):
    stays = lambda state: (state, jnp.asarray(jnp.nan, state.y.dtype))
    one = lambda state, _: lax.cond(state.step < task.limit, partial(_step, task), stays, state)
    state, losses = lax.scan(one, state, length=task.steps)
    at = squares(task.problem, task.problem.found.natural(state.y), state.local)
    state, score = state._replace(inverses=_inverses(at)), jnp.sum(at.sums) / jnp.maximum(jnp.sum(task.known), 1)
    if task.held is not None:
        held, score = _evaluate_held(task, state.y, state.held, EVALUATION_STEPS)
        state = state._replace(held=held)
    number = state.round + 1
    new = Best(score, number, state.y, state.local, state.held)
    best = jax.tree.map(lambda a, b: jnp.where(score < state.best.score, a, b), new, state.best)
    return state._replace(round=number, best=best), Round(losses, score)


def _inverses(at: Squares):
    return inverse_of(at.curvatures, jnp.full(len(at.sums), DAMPING, at.sums.dtype))


def _evaluate_held(task: Task, y, held, most):
    """The starts of the held-back records, and their mean squared residual, at unbounded numbers."""
    problem: Any = task.held
    fixed = with_params(problem, task.problem, task.problem.found.natural(y))
    held, at = fit_starts(fixed, y[:0], held, most)
    known = sum(jnp.sum(jnp.isfinite(a) & jnp.isfinite(b)) for a, b in zip(*map(jax.tree.leaves, problem.data)))
    return held, jnp.sum(at.sums) / jnp.maximum(known, 1)


def _step(task: Task, state: TrainingState):
    """One step of the optimiser, and half a Newton step for the starts of its batch."""
    problem, found, known = task.problem, task.problem.found, task.known
    count, total = problem.windows.count, jnp.maximum(jnp.sum(known), 1)
    drawn = lambda: jax.random.permutation(jax.random.fold_in(jax.random.key(task.seed), state.step), count)
    new_pass = state.at + task.batch > count
    order = lax.cond(new_pass, drawn, lambda: state.order)
    at = jnp.where(new_pass, 0, state.at)
    chosen = lax.dynamic_slice(order, (at,), (task.batch,))

    def cost(y, local):
        x = found.natural(y)
        sums, well = _sums(problem, x, local, chosen)
        mean, weight = prior_and_hold(problem, WHOLE)
        before = jnp.sum((weight * (x - mean)) ** 2)
        return 0.5 * (count / task.batch * jnp.sum(sums) + before) / total, (jnp.sum(sums), well)

    local = state.local[chosen]
    (value, (squared, well)), (by_y, by_local) = jax.value_and_grad(cost, (0, 1), has_aux=True)(state.y, local)
    y, optimiser = task.optimiser.step(
        found, state.y, by_y, state.optimiser, value, lambda y: cost(y, local)[0]
    )  # fmt: skip
    finite = jnp.all(jnp.isfinite(by_y)) & jnp.all(jnp.isfinite(y))
    kept = lambda new, old: jax.tree.map(lambda a, b: jnp.where(finite, a, b), new, old)
    y, optimiser = kept((y, optimiser), (state.y, state.optimiser))
    slopes = by_local * (total * task.batch / count)
    local = local + _newton_steps(problem, chosen, state.inverses[chosen], slopes)
    state = state._replace(
        y=y, optimiser=optimiser, local=state.local.at[chosen].set(local), order=order, at=at + task.batch,
        step=state.step + 1, failed=state.failed + jnp.sum(~well), skipped=state.skipped + ~finite,
    )  # fmt: skip
    return state, squared / jnp.maximum(jnp.sum(known[chosen]), 1)


def _sums(problem, x, local, chosen):
    """The sum of squares of each chosen window, and which motions ended well. All lanes share the parameters."""

    def one(s, w):
        found, well = window_part(problem, x, s, w, WHOLE, loss="squares")
        # A failed motion contributes a constant cost, without a gradient.
        return jnp.where(well, found.rows, lax.stop_gradient(found.rows)), well

    rows, well = jax.vmap(one)(local, chosen)
    if problem.loss != "squares":
        # Far from the truth every residual would look like an outlier, for which a robust loss has no slope.
        half = jnp.nanmedian(jnp.where(rows == 0, jnp.nan, jnp.abs(rows)))
        ordinary = jnp.maximum(OF_NORMAL * jnp.where(jnp.isfinite(half), half, 0.0), 1.0)
        rows = dampened(rows, problem.loss, lax.stop_gradient(ordinary))
    return jnp.sum(rows**2, axis=1), well


def _newton_steps(problem, chosen, inverses, slopes):
    """The steps of the starts of some windows; zero where a slope is not finite."""
    slopes = jnp.where(jnp.all(jnp.isfinite(slopes), axis=1, keepdims=True), slopes, 0.0)
    steps = -OF_NEWTON * jnp.einsum("bij,bj->bi", inverses, slopes)
    moved = [jnp.einsum("bij,bj->bi", chart.along[chosen], steps) for chart in problem.starts]
    far = jnp.max(jnp.abs(jnp.concatenate(moved, axis=1)) / problem.unit[None], axis=1, initial=0.0)
    return steps * jnp.minimum(1.0, FARTHEST / jnp.maximum(far, FARTHEST))[:, None]
