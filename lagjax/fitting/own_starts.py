"""The start of each window for given parameters, by Levenberg-Marquardt: each by itself, all of them at once.

A window's own unknowns s are few, so their slopes J come forward with the residuals r, and a step is

    (JᵀJ + damping diag JᵀJ) ds = -Jᵀr,

taken where it makes the window's own sum of squares smaller; else its damping grows. Parameters, a network perhaps, are
the same in all lanes: products with them stay products of matrices.
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.fitting.equations import WHOLE, Problem, of_window

# The damping at first, and what a step that helps, or does not, makes of it.
DAMPING, EASED, TIGHTENED = 1e-3, 0.2, 10.0
# Starts have come to rest where a step makes no sum of squares smaller by this part.
SAME = 1e-3
# Windows side by side.
LANES = 64


class Squares(NamedTuple):
    """Of each window: the sum of squared residuals, Jᵀr, JᵀJ, and whether its motion ended well."""

    sums: Float[Array, " W"]
    slopes: Float[Array, "W k"]
    curvatures: Float[Array, "W k k"]
    well: Bool[Array, " W"]


def squares(problem: Problem, x, own) -> Squares:
    """The squares at parameters `x` and starts `own` (W, k)."""

    def of(window):
        w, s = window
        rows = lambda s: _rows(problem, x, s, w)
        if not s.size:
            r, well = rows(s)
            return Squares(jnp.sum(r**2), s, jnp.zeros((0, 0), s.dtype), well)
        # The residuals are the same along all directions, and computed once.
        along = lambda d: jax.jvp(rows, (s,), (d,), has_aux=True)
        r, pushed, well = jax.vmap(along)(jnp.eye(s.size, dtype=s.dtype))
        pushed = jnp.where(well[0] & jnp.all(jnp.isfinite(pushed)), pushed, 0.0)
        return Squares(jnp.sum(r[0] ** 2), pushed @ r[0], pushed @ pushed.T, well[0])

    windows = jnp.arange(problem.windows.count), own
    # JAX's `map` in batches takes no arrays of nothing, as of starts that are known.
    return lax.map(of, windows, batch_size=min(LANES, len(own))) if own.size else jax.vmap(of)(windows)


def inverse_of(curvatures: Float[Array, "W k k"], damping: Float[Array, " W"]) -> Float[Array, "W k k"]:
    """The inverses of damped curvatures; the identity where nothing is seen, as of what is held."""
    size = jax.vmap(jnp.diag)(curvatures)
    damped = jnp.where(size > 0, damping[:, None] * size, 1.0)
    return jnp.linalg.inv(curvatures + jax.vmap(jnp.diag)(damped))


def settled(problem: Problem, x, own, most: int, same: float = SAME) -> tuple[Array, Squares]:
    """The starts with the smallest sums of squares for given parameters, after at most so many steps."""

    def steps(at, damping):
        return jnp.einsum("wij,wj->wi", inverse_of(at.curvatures, damping), at.slopes)

    def go_on(state):
        i, _, at, damping = state
        falls = jnp.sum(steps(at, damping) * at.slopes, axis=1)
        return (i < most) & jnp.any(falls > same * at.sums)

    def step(state):
        i, own, at, damping = state
        tried = own - steps(at, damping)
        there = squares(problem, x, tried)
        better = there.sums < at.sums
        chosen = lambda new, old: jnp.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)
        own, at = chosen(tried, own), jax.tree.map(chosen, there, at)
        return i + 1, own, at, damping * jnp.where(better, EASED, TIGHTENED)

    start = jnp.asarray(0), own, squares(problem, x, own), jnp.full(own.shape[0], DAMPING, own.dtype)
    _, own, at, _ = lax.while_loop(go_on, step, start)
    return own, at


def _rows(problem, x, s, w):
    found, well = of_window(problem, x, s, w, WHOLE, diffrax.ForwardMode())
    return found.rows, well
