"""The course of a training: which records are held back, round after round, and what became of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from lagjax import plot
from lagjax.fitting.equations import WHOLE, Problem
from lagjax.fitting.optimisers import Optimiser
from lagjax.fitting.problem import problem_of
from lagjax.fitting.records import Record
from lagjax.fitting.result import Fit
from lagjax.fitting.search import Evaluation, Searched, evaluate
from lagjax.fitting.training import Ended, State, Task, all_rounds, begun, ended, goes_on, round_of, with_params
from lagjax.mechanics import coordinates
from lagjax.meter import meter, waiting

# Steps, and judgements without improvement after which training ends, where the user does not say.
STEPS, PATIENCE = 1000, 10
# A round has at least so many steps, and sees each window so often: judging costs little beside that.
ROUND, TIMES = 10, 4
# Training has come to rest where the last quarter of it made the best score better by less than this part.
RESTED = 0.01
# Beyond this many numbers forward slopes of all windows take as long as the training itself.
SLOPES_UP_TO = 100
NEVER = np.iinfo(np.int32).max


@jtu.register_dataclass
@dataclass(frozen=True, eq=False, repr=False)
class Training:
    """How a training went: `found.training` of an `lj.fit` by an optimiser of optax.

    - `losses` (S,): the mean squared residual of each step's batch, in sigmas (without sigmas in units of the data's
      spread); NaN of steps that were not taken.
    - `judged` (J,): the step after which the parameters were judged. `scores` (J,): the mean squared residual of what
      is held back, or, where nothing is, of all windows.
    - `best`: the step whose parameters count, those with the smallest score. `early`: whether it stopped for want of
      patience.
    - `held_back`: the records that were held back as a `Fit` of their starts alone, or None.
    - `failed`: motions that stopped early, of `motions` in all; they moved nothing. `skipped`: steps whose gradient was
      not finite; they were not taken.
    - `batch`, `windows`: how many windows a step saw, of how many.
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
        """Whether it ended of its own accord: early, or with a score that hardly fell any more."""
        xp: Any = coordinates.numpy_of(self.scores)
        count = xp.sum(xp.isfinite(self.scores))
        before = xp.arange(len(self.scores)) < 0.75 * count
        smallest = lambda known: xp.min(xp.where(known & xp.isfinite(self.scores), self.scores, np.inf))
        return self.early | (smallest(before) < (1 + RESTED) * smallest(~before))

    def plot(self):
        """Draw how the mean squared residuals fell, step by step; returns a matplotlib `Figure`."""
        judged = np.isfinite(self.scores)
        panels = {"batch": (1 + np.arange(len(self.losses)), np.asarray(self.losses))}
        if self.held_back is not None:
            panels["held back"] = (np.asarray(self.judged)[judged], np.asarray(self.scores)[judged])
        return plot.training(panels, int(self.best))

    def __repr__(self):
        if coordinates.is_traced(self.scores):
            return "Training, being traced"
        of = "held-back records" if self.held_back is not None else "all windows"
        best = float(np.min(self.scores, initial=np.inf, where=np.isfinite(self.scores)))
        end = "; stopped early" if self.early else ""
        lines = [
            f"Training: {int(self.steps)} steps on {self.batch} of {self.windows} windows{end}",
            f"  mean squared residual {best:.4g} of {of}, smallest after step {int(self.best)}, whose parameters count",
        ]
        if self.failed:
            lines.append(f"  {int(self.failed)} of {int(self.motions)} motions stopped early and moved nothing")
        if self.skipped:
            lines.append(f"  {int(self.skipped)} steps without a finite gradient were not taken")
        return "\n".join(lines)


class Trained(NamedTuple):
    """The end of a training as of a search, what the data say there (None of many numbers), and its course."""

    searched: Searched
    evaluation: Evaluation | None
    course: Training


def parted_records(
    records: Record | Sequence[Record], held_back: float | Record | Sequence[Record] | None, seed: int
) -> tuple[list[Record], list[Record]]:
    """The records to train on, and those held back: given ones, or a part of them drawn by `seed`."""
    records = [records] if isinstance(records, Record) else list(records)
    if held_back is None or isinstance(held_back, Record):
        return records, [] if held_back is None else [held_back]
    if not isinstance(held_back, int | float):
        return records, list(held_back)
    if not 0 <= held_back < 1:
        raise ValueError(f"held_back must be a part between 0 and 1, or records, not {held_back}.\nFix: held_back=0.2.")
    if held_back == 0:
        return records, []
    if len(records) < 2:
        raise ValueError(
            "one record cannot be divided into some to train on and some that are held back.\n"
            "Fix: two records of it, lj.Record(t[:n], q=q[:n]) and lj.Record(t[n:], q=q[n:]); held_back=[the second]."
        )
    count = min(max(1, round(held_back * len(records))), len(records) - 1)
    chosen = set(np.random.default_rng(seed).permutation(len(records))[:count].tolist())
    return [r for i, r in enumerate(records) if i not in chosen], [records[i] for i in sorted(chosen)]


def held_problem(problem: Problem, records, system, params, observe, loss, window, options) -> Problem | None:
    """What is held back, weighed as the records that are trained on; None where nothing is."""
    if not records:
        return None
    held = problem_of(system, records, params, [], observe, None, None, loss, window, dict(options))
    if jax.tree.structure(held.measured) != jax.tree.structure(problem.measured) or held.absolute != problem.absolute:
        raise ValueError(
            "records that are held back must hold what the others do, and have a sigma if these have one.\n"
            "Fix: write NaN for what was not measured in a run."
        )
    if problem.absolute:
        return held
    sigma = jax.tree.map(lambda x, known: np.full(x.shape, np.nanmax(known)), held.measured, problem.sigma)
    return replace(held, sigma=sigma)


def train(
    problem: Problem,
    held: Problem | None,
    optimiser: Any,
    batch: int | None,
    steps: int | None,
    patience: int | None,
    seed: int,
    progress: bool | None,
    check: Callable,
) -> Trained:
    """Train.

    `check(well)` raises where no motion succeeds in the first round.
    """
    windows, steps = problem.windows.count, STEPS if steps is None else steps
    for name, count in (("batch", batch), ("iterations", steps), ("patience", patience)):
        if count is not None and (not isinstance(count, int | np.integer) or count < 1):
            raise ValueError(f"{name} must be a whole number of at least 1, not {count!r}.")
    batch = windows if batch is None else min(int(batch), windows)
    if patience is None:
        patience = NEVER if held is None else PATIENCE
    rounds = int(np.ceil(steps / max(ROUND, np.ceil(TIMES * windows / batch))))
    each = int(np.ceil(steps / rounds))
    numbers = (np.asarray(x) for x in (seed, steps, patience))
    task = Task(problem, held, Optimiser(optimiser), batch, each, *numbers)
    if coordinates.is_traced((problem, held)):
        first, state, (losses, scores) = all_rounds(task, rounds)
        scores = jnp.concatenate([first.best.score[None], scores])
        losses = jnp.ravel(losses)
    else:
        state, losses, scores = _in_rounds(task, progress, check)
    end, end_held = ended(task, state)
    xp: Any = coordinates.numpy_of((state, scores))
    stopped = (state.step < steps) & (state.round - state.best.round >= patience)
    held_back = None if end_held is None else _held_back(task, state, end, end_held)
    course = Training(
        losses[:steps], np.minimum(each * np.arange(len(scores)), steps), scores,
        xp.minimum(each * state.best.round, steps), state.step, stopped, state.failed, state.skipped, held_back,
        batch, windows,
    )  # fmt: skip
    numbers = problem.found.start.size + end.unknowns.local.size // windows
    evaluation = evaluate(problem, end.unknowns, WHOLE) if 0 < numbers <= SLOPES_UP_TO else None
    searched = Searched(end.unknowns, end.cost, state.step, course.rested, end.misfit, end.cost[None])
    return Trained(searched, evaluation, course)


def _in_rounds(task: Task, progress, check) -> tuple[State, np.ndarray, np.ndarray]:
    """Round after round, with a meter; an interrupt between two leaves nothing behind."""
    losses = []
    with meter(progress, unit=" steps", desc="training", total=int(task.limit)) as shown:
        with waiting(False if shown.disable else progress, "compiling"):
            state = begun(task)
            scores = [state.best.score]
            after, told = round_of(task, state)
        if after.failed == after.step * task.batch:
            check()
        while True:
            losses.append(told.losses)
            scores.append(told.score)
            last = told.losses[np.isfinite(told.losses)][-1:]
            shown.set_postfix_str(f"batch {float(last.sum()):.4g}, score {float(told.score):.4g}", refresh=False)
            shown.update(int(after.step - state.step))
            state = after
            if not goes_on(task, state):
                return state, np.concatenate(losses), np.stack(scores)
            after, told = round_of(task, state)


def _held_back(task: Task, state: State, end: Ended, end_held: Ended) -> Fit:
    """The records that were held back as a fit of their starts."""
    held: Any = task.held
    problem = with_params(held, task.problem, end.unknowns.shared)
    # Of starts that are known nothing is to be said.
    evaluation = evaluate(problem, end_held.unknowns, WHOLE) if end_held.unknowns.local.size else None
    rested = jnp.ones((), bool) if coordinates.is_traced(end_held) else np.asarray(True)
    return Fit(problem, *end_held[:2], state.step, rested, end_held.misfit, end_held.cost[None], evaluation, ())
