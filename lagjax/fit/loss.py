"""`fit_residuals` and `fit_loss`: what `fit` minimises, as pure functions for any optimiser.

These are the residuals of `fit` in its last stage, with the same weights and masks, and half the sum of their squares.
In a batch of B of the W windows each stands for W/B windows, so that the mean over random batches is the loss of all:

    loss = W/B Σ_batch r² / 2 + Σ d² / 2 + Σ ((x - mean)/sd)² / 2,

with the jumps d between windows, where these are joined. A motion that fails contributes a large constant without a
slope: it moves nothing.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from lagjax.fit.problem.arguments import problem_of
from lagjax.fit.problem.checks import check_predicted
from lagjax.fit.problem.records import Record
from lagjax.fit.problem.residuals import JOINING, WHOLE, FitProblem, Stage, assemble, prior_and_hold, window_part
from lagjax.jaxtools import jitted
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns
from lagjax.system import Hybrid, System


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
