"""Whether what a fit leaves over can be errors of measurement: as large as `sigma` says, and none like the next.

Of n independent errors r of size one, x = Σr²/n has a cube root that is nearly normal, with the mean 1 - 2/9n and the
variance 2/9n. Of white residuals the correlations ρ_k with the k-th next are normal, with the variance 1/n, so that
n Σρ_k² over some lags has a chi-squared distribution. Both are computed with the search, so that a fit among hundreds
in one program tells it as well as one that somebody looks at.

Source: Wilson & Hilferty, *Proc. Natl. Acad. Sci.* 17 (1931) 684; Box & Pierce, *J. Am. Stat. Assoc.* 65 (1970) 1509.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax.fitting.equations import LOSSES, Problem
from lagjax.numerics.chained import Equations

# Chance does not explain what is so many standard deviations off; what is half as many off is worth another look.
CHANCE, A_LOOK = 5.0, 3.0
# White residuals so many times larger than sigma show more than a sigma that was guessed; with a loss that forgives
# outliers twice that, since these make the median larger.
LARGER, OUTLIERS = 1.5, 2.0
# A curve of no more than this part of the data's spread is one that a good model leaves as well.
MISSED, A_TRACE = 0.05, 0.01
# How far residuals are compared with those that follow.
LAGS = 10
# A standard deviation over the median of the absolute value, of normal errors, whose square is as certain as that of so
# much of the measurements.
OF_NORMAL, EFFICIENCY = 1.4826, 0.37


class Misfit(NamedTuple):
    """What residuals say of a fit, by channel: each leaf of what was measured.

    - `times` (c,): how many times larger than sigma they are; NaN where no sigma was given.
    - `large` (c,): too much larger for chance. `curved` (c,): they follow a curve.
    - `doubtful`: whether some, or what is half as clear, makes it worth to look for a better end.
    """

    times: Float[Array, " c"]
    large: Bool[Array, " c"]
    curved: Bool[Array, " c"]
    doubtful: Bool[Array, ""]

    @property
    def any(self) -> Bool[Array, ""]:
        """Whether the fit is none."""
        return (self.large | self.curved).any()


def misfit(problem: Problem, values: Equations) -> Misfit:
    """Judge the residuals at an end, as the problem's loss has them."""
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
    """Of one channel: times, whether too large, whether on a curve, whether worth a look."""
    count = jnp.sum(known)
    count = jnp.where(count > 0, count, 1).astype(r.dtype)
    if problem.loss == "squares":
        x, free = jnp.sum(r**2) / (count * jnp.where(left > 0, left, 1.0)), count * left
        largest = LARGER**2
    else:
        half = jnp.nanmedian(jnp.where(known, jnp.abs(r), jnp.nan))
        x, free = (OF_NORMAL * _undampened(half, problem.loss)) ** 2, EFFICIENCY * count * left
        largest = (OUTLIERS * LARGER) ** 2
    above = lambda z: (left > 0) & (x > _beyond(jnp.maximum(free, 1e-3), z))
    lags, alike, squares = jnp.zeros(()), jnp.zeros(()), jnp.zeros(())
    if ordered:
        # (W, lag, T, ...): what follows each residual.
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
    follows = lambda z: (lags > 0) & (squares > lags * _beyond(jnp.maximum(lags, 1), z))
    # The part of the data's spread that lies on the curve.
    of_data = jnp.sqrt(alike * jnp.sum((r * jnp.where(known, sigma, 0.0)) ** 2) / count) / spread
    if not problem.absolute:
        nothing = jnp.asarray(False)
        looks = follows(A_LOOK) & (of_data > A_TRACE)
        return jnp.full((), jnp.nan), nothing, follows(CHANCE) & (of_data > MISSED), looks
    large = above(CHANCE) & (x > largest)
    curved = follows(CHANCE) & (above(CHANCE) | (of_data > MISSED))
    return jnp.sqrt(x), large, curved, above(A_LOOK) | (follows(A_LOOK) & (of_data > A_TRACE))


def _beyond(n, z):
    """What Σr²/n exceeds as rarely as a normal number exceeds `z`."""
    return jnp.maximum(1 - 2 / (9 * n) + z * jnp.sqrt(2 / (9 * n)), 0.0) ** 3


def _undampened(r, loss):
    """The residual whose dampened one is `r`, a number that is not negative."""
    constant, _ = LOSSES[loss]
    z = r / constant
    inverse = {
        "soft_l1": lambda z: z * jnp.sqrt(1 + z**2 / 4),
        "huber": lambda z: jnp.where(z > 1, (1 + z**2) / 2, z),
        "cauchy": lambda z: jnp.sqrt(jnp.expm1(jnp.minimum(z**2, 100.0))),
    }
    return constant * inverse[loss](z)
