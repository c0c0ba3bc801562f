"""Whether the residuals of a fit can be measurement errors: as large as `sigma` says, and uncorrelated.

Of n independent errors r of size one, x = Σr²/n has a cube root that is nearly normal, with the mean 1 - 2/9n and the
variance 2/9n. The correlations ρ_k of white residuals with the k-th next are normal, with the variance 1/n, so that
n Σρ_k² over some lags has a chi-squared distribution. Both are computed with the search, so that each of hundreds of
fits in one program reports its misfit, as a single fit does.

Source: Wilson & Hilferty, *Proc. Natl. Acad. Sci.* 17 (1931) 684; Box & Pierce, *J. Am. Stat. Assoc.* 65 (1970) 1509.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax.fit.problem.residuals import LOSSES, FitProblem
from lagjax.numerics.windowed_least_squares import WindowedEquations

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


def _channel(problem, left, ordered, r, known, sigma, spread):
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
    above = lambda z: (left > 0) & (x > _exceeded_by_chance(jnp.maximum(free, 1e-3), z))
    lags, alike, squares = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    if ordered:
        # (W, lag, T, ...): the residuals that follow each one.
        most = min(LAGS, r.shape[1] - 1)
        following = np.arange(1, most + 1)[:, None] + np.arange(r.shape[1])
        later = lambda x: jnp.concatenate([x, jnp.zeros_like(x[:, :most])], axis=1)[:, following]
        each = (0, *range(2, r.ndim + 1))
        pairs = jnp.sum(known[:, None] & later(known), axis=each)
        lags = jnp.sum(pairs > 0).astype(r.dtype)
        one = jnp.maximum(jnp.sum(r**2) / count, jnp.finfo(r.dtype).tiny)
        correlations = jnp.sum(r[:, None] * later(r), axis=each) / jnp.where(pairs > 0, pairs, 1) / one
        squares = jnp.sum(pairs * correlations**2)
        alike = jnp.max(jnp.where(pairs > count / 2, jnp.abs(correlations), 0.0))
    follows = lambda z: (lags > 0) & (squares > lags * _exceeded_by_chance(jnp.maximum(lags, 1), z))
    # The size of the curve, as a fraction of the data's spread.
    of_data = jnp.sqrt(alike * jnp.sum((r * jnp.where(known, sigma, 0.0)) ** 2) / count) / spread
    if not problem.absolute:
        no = jnp.asarray(False)
        doubtful = follows(DOUBT) & (of_data > TRACE)
        return jnp.full((), jnp.nan), no, follows(CHANCE) & (of_data > CURVE), doubtful
    large = above(CHANCE) & (x > largest)
    curved = follows(CHANCE) & (above(CHANCE) | (of_data > CURVE))
    return jnp.sqrt(x), large, curved, above(DOUBT) | (follows(DOUBT) & (of_data > TRACE))


def _exceeded_by_chance(n, z):
    """The value that Σr²/n exceeds as rarely as a standard normal number exceeds `z`."""
    return jnp.maximum(1 - 2 / (9 * n) + z * jnp.sqrt(2 / (9 * n)), 0.0) ** 3


def _undampened(r, loss):
    """The residual that `dampened` maps to `r`, which must not be negative."""
    constant, _ = LOSSES[loss]
    z = r / constant
    inverse = {
        "soft_l1": lambda z: z * jnp.sqrt(1 + z**2 / 4),
        "huber": lambda z: jnp.where(z > 1, (1 + z**2) / 2, z),
        "cauchy": lambda z: jnp.sqrt(jnp.expm1(jnp.minimum(z**2, 100.0))),
    }
    return constant * inverse[loss](z)
