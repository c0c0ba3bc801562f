"""The starts of all windows for given parameters, by Levenberg-Marquardt, each on its own and all in parallel.

A window has few unknowns s, so their slopes J are computed in forward mode with the residuals r, and a step is

    (JᵀJ + damping diag JᵀJ) ds = -Jᵀr,

taken if it reduces the window's own sum of squares; else the window's damping grows. The parameters, a network perhaps,
are the same in all lanes, so products with them are matrix products.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.fit.problem.residuals import WHOLE, FitProblem, window_part

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
