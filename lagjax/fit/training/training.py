"""Training with an optimiser of optax: split off held-back records, run the rounds, return the result."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lagjax.display import plots as plot
from lagjax.display.progress import meter, waiting
from lagjax.fit.problem.arguments import problem_of
from lagjax.fit.problem.records import Record
from lagjax.fit.problem.residuals import WHOLE, FitProblem
from lagjax.fit.result.result import Fit
from lagjax.fit.search.search import Evaluation, Searched, evaluate
from lagjax.fit.training.rounds import (
    FinalResult,
    Optimiser,
    Task,
    TrainingState,
    all_rounds,
    final_result,
    has_another_round,
    initial_state,
    round_of,
    with_params,
)
from lagjax.jaxtools.tracing import is_traced, numpy_of

# Defaults: the number of steps, and of evaluations without improvement after which training ends.
STEPS, PATIENCE = 1000, 10
# A round has at least this many steps, and passes each window this often, so that the evaluation costs little.
ROUND, PASSES = 10, 4
# Training has converged if its last quarter improved the best score by less than this fraction.
CONVERGED_BELOW = 0.01
# With more numbers than this, forward-mode slopes of all windows would take as long as the training itself.
SLOPES_UP_TO = 100
NEVER = np.iinfo(np.int32).max


@jtu.register_dataclass
@dataclass(frozen=True, eq=False, repr=False)
class Training:
    """The course of a training: `found.training` of an `lj.fit` with an optimiser of optax.

    - `losses` (S,): the mean squared residual of each step's batch, in sigmas (without sigmas in units of the data's
      spread); NaN for steps that were not taken.
    - `judged` (J,): the steps after which the parameters were evaluated. `scores` (J,): the mean squared residual of
      the held-back records or, without these, of all windows.
    - `best`: the step whose parameters count, those with the smallest score. `early`: whether `patience` ended it.
    - `held_back`: a `Fit` of the held-back records, of their starts alone, or None.
    - `failed`: the number of motions that stopped early, of `motions` in all; these changed nothing.
      `skipped`: the number of steps that were not taken because their gradient was not finite.
    - `batch`, `windows`: the number of windows in a step, and in all.
    """

    losses: Float[Array, " S"]
    judged: Int[Array, " J"]
    scores: Float[Array, " J"]
    best: Int[Array, ""]
    steps: Int[Array, ""]
    early: Bool[Array, ""]
    failed: Int[Array, ""]
    skipped: Int[Array, ""]
    held_back: Fit | None
    batch: int = eqx.field(static=True)
    windows: int = eqx.field(static=True)

    @property
    def motions(self) -> Int[Array, ""]:
        return self.steps * self.batch

    @property
    def rested(self) -> Bool[Array, ""]:
        """Whether it converged: it ended early, or with a score that hardly fell any more."""
        xp: Any = numpy_of(self.scores)
        count = xp.sum(xp.isfinite(self.scores))
        before = xp.arange(len(self.scores)) < 0.75 * count
        smallest = lambda known: xp.min(xp.where(known & xp.isfinite(self.scores), self.scores, np.inf))
        return self.early | (smallest(before) < (1 + CONVERGED_BELOW) * smallest(~before))

    def plot(self):
        """Draw how the mean squared residuals fell, step by step; returns a matplotlib `Figure`."""
        judged = np.isfinite(self.scores)
        panels = {"batch": (1 + np.arange(len(self.losses)), np.asarray(self.losses))}
        if self.held_back is not None:
            panels["held back"] = (np.asarray(self.judged)[judged], np.asarray(self.scores)[judged])
        return plot.training(panels, int(self.best))

    def __repr__(self):
        if is_traced(self.scores):
            return "Training, being traced"
        data = "held-back records" if self.held_back is not None else "all windows"
        best = float(np.min(self.scores, initial=np.inf, where=np.isfinite(self.scores)))
        end = "; stopped early" if self.early else ""
        lines = [
            f"Training: {int(self.steps)} steps on {self.batch} of {self.windows} windows{end}",
            f"  mean squared residual {best:.4g} of {data}, smallest after step {int(self.best)}, "
            "whose parameters count",
        ]
        if self.failed:
            lines.append(f"  {int(self.failed)} of {int(self.motions)} motions stopped early and changed nothing")
        if self.skipped:
            lines.append(f"  {int(self.skipped)} steps without a finite gradient were not taken")
        return "\n".join(lines)


class Trained(NamedTuple):
    """The end of a training as that of a search, its evaluation (None for many numbers), and its course."""

    searched: Searched
    evaluation: Evaluation | None
    course: Training


def split_records(
    records: Record | Sequence[Record], held_back: float | Record | Sequence[Record] | None, seed: int
) -> tuple[list[Record], list[Record]]:
    """The records to train on, and those held back: given ones, or a fraction of the records drawn with `seed`."""
    records = [records] if isinstance(records, Record) else list(records)
    if held_back is None or isinstance(held_back, Record):
        return records, [] if held_back is None else [held_back]
    if not isinstance(held_back, int | float):
        return records, list(held_back)
    if not 0 <= held_back < 1:
        raise ValueError(
            f"held_back must be a fraction between 0 and 1, or records, not {held_back}.\nFix: held_back=0.2."
        )
    if held_back == 0:
        return records, []
    if len(records) < 2:
        raise ValueError(
            "one record cannot be divided into records to train on and records to hold back.\n"
            "Fix: two records of it, lj.Record(t[:n], q=q[:n]) and lj.Record(t[n:], q=q[n:]); held_back=[the second]."
        )
    count = min(max(1, round(held_back * len(records))), len(records) - 1)
    chosen = set(np.random.default_rng(seed).permutation(len(records))[:count].tolist())
    return [r for i, r in enumerate(records) if i not in chosen], [records[i] for i in sorted(chosen)]


def held_problem(problem: FitProblem, records, system, params, observe, loss, window, options) -> FitProblem | None:
    """The problem of the held-back records, weighted like the training records; None if there are none."""
    if not records:
        return None
    held = problem_of(system, records, params, [], observe, None, None, loss, window, dict(options))
    if jax.tree.structure(held.measured) != jax.tree.structure(problem.measured) or held.absolute != problem.absolute:
        raise ValueError(
            "held-back records must have the same measurements as the others, and a sigma if these have one.\n"
            "Fix: write NaN for what was not measured in a run."
        )
    if problem.absolute:
        return held
    sigma = jax.tree.map(lambda x, known: np.full(x.shape, np.nanmax(known)), held.measured, problem.sigma)
    return replace(held, sigma=sigma)


def train(
    problem: FitProblem,
    held: FitProblem | None,
    optimiser: Any,
    batch: int | None,
    steps: int | None,
    patience: int | None,
    seed: int,
    progress: bool | None,
    check: Callable,
) -> Trained:
    """Train and evaluate.

    `check()` raises the error of a failing motion; it is called if no motion succeeds in the first round.
    """
    windows, steps = problem.windows.count, STEPS if steps is None else steps
    for name, count in (("batch", batch), ("iterations", steps), ("patience", patience)):
        if count is not None and (not isinstance(count, int | np.integer) or count < 1):
            raise ValueError(f"{name} must be a whole number of at least 1, not {count!r}.")
    batch = windows if batch is None else min(int(batch), windows)
    if patience is None:
        patience = NEVER if held is None else PATIENCE
    rounds = int(np.ceil(steps / max(ROUND, np.ceil(PASSES * windows / batch))))
    each = int(np.ceil(steps / rounds))
    numbers = (np.asarray(x) for x in (seed, steps, patience))
    task = Task(problem, held, Optimiser(optimiser, problem.found), batch, each, *numbers)
    if is_traced((problem, held)):
        first, state, (losses, scores) = all_rounds(task, rounds)
        scores = jnp.concatenate([first.best.score[None], scores])
        losses = jnp.ravel(losses)
    else:
        state, losses, scores = _run_rounds(task, progress, check)
    end, end_held = final_result(task, state)
    xp: Any = numpy_of((state, scores))
    stopped = (state.step < steps) & (state.round - state.best.round >= patience)
    held_back = None if end_held is None else _fit_of_held_back(task, state, end, end_held)
    course = Training(
        losses[:steps], np.minimum(each * np.arange(len(scores)), steps), scores,
        xp.minimum(each * state.best.round, steps), state.step, stopped, state.failed, state.skipped, held_back,
        batch, windows,
    )  # fmt: skip
    numbers = problem.found.start.size + end.unknowns.local.size // windows
    evaluation = evaluate(problem, end.unknowns, WHOLE) if 0 < numbers <= SLOPES_UP_TO else None
    searched = Searched(end.unknowns, end.cost, state.step, course.rested, end.misfit, end.cost[None])
    return Trained(searched, evaluation, course)


def _run_rounds(task: Task, progress, check) -> tuple[TrainingState, np.ndarray, np.ndarray]:
    """Run the rounds one by one, with a meter; an interrupt between two leaves nothing behind."""
    losses = []
    with meter(progress, unit=" steps", desc="training", total=int(task.limit)) as shown:
        with waiting(False if shown.disable else progress, "compiling"):
            state = initial_state(task)
            scores = [state.best.score]
            after, result = round_of(task, state)
        if after.failed == after.step * task.batch:
            check()
        while True:
            losses.append(result.losses)
            scores.append(result.score)
            last = result.losses[np.isfinite(result.losses)][-1:]
            shown.set_postfix_str(f"batch {float(last.sum()):.4g}, score {float(result.score):.4g}", refresh=False)
            shown.update(int(after.step - state.step))
            state = after
            if not has_another_round(task, state):
                return state, np.concatenate(losses), np.stack(scores)
            after, result = round_of(task, state)


def _fit_of_held_back(task: Task, state: TrainingState, end: FinalResult, end_held: FinalResult) -> Fit:
    """The fit of the starts of the held-back records."""
    held: Any = task.held
    problem = with_params(held, task.problem, end.unknowns.shared)
    # Known starts leave nothing to evaluate.
    evaluation = evaluate(problem, end_held.unknowns, WHOLE) if end_held.unknowns.local.size else None
    rested = jnp.ones((), bool) if is_traced(end_held) else np.asarray(True)
    return Fit(problem, *end_held[:2], state.step, rested, end_held.misfit, end_held.cost[None], evaluation, ())
