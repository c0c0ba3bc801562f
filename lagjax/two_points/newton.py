"""Newton's method for the equations of a path (`path.py`).

A step is shortened until the step after it is shorter than itself: a test that knows no units but those of positions.

Source: Deuflhard, *Newton Methods for Nonlinear Problems* (2011), §3.3 (the test, with the new matrix in place of the
old).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from lagjax.system import Model
from lagjax.two_points.path import FIXED, Ends, Path, Solved, eliminated, equations, solve

MOST = 30
# A step of this size, in units of the path's extent, ends the search; one below the second that is no longer reduced.
SMALL, SETTLED = 1e-13, 1e-9
# A path has converged whose last step is below this.
CONVERGED = 1e-7
# From this size on, in units of what the end changes, the next step is judged from the last two.
QUADRATIC = 1e-3
# The shortest part of a step that is tried.
SHORTEST = 2.0**-6


class FoundPath(NamedTuple):
    """A path after Newton's method.

    - `size`: the largest entry of the step after the last, in units of the path's extent, as far as it is known;
      `small`: what counts as zero, 1e-7 or more, where positions have fewer digits. `iterations`: the steps tried.
    - `deltas`: the pivots of the elimination; `response`: what a unit of each equation of the end changes.
    """

    path: Path
    size: Float[Array, ""]
    small: Float[Array, ""]
    iterations: Int[Array, ""]
    deltas: Float[Array, "K sN sN"]
    response: Solved

    @property
    def converged(self) -> Bool[Array, ""]:
        return self.size < self.small


class _Search(NamedTuple):
    path: Path
    solved: Solved
    deltas: Array
    size: Array
    next_size: Array
    share: Array
    iterations: Array
    going: Array


def extent(ends: Ends, path: Path) -> Float[Array, " n"]:
    """The size of each coordinate on a path; one that hardly moves has a thousandth of the largest."""
    x = path.nodes(ends)[..., : ends.x_a.size].reshape(-1, ends.x_a.size)
    moved = jnp.max(x, axis=0) - jnp.min(x, axis=0)
    moved = jnp.maximum(moved, 1e-3 * jnp.max(moved))
    floor = 1e3 * jnp.finfo(x.dtype).eps * jnp.max(jnp.abs(x))
    return jnp.where(moved > floor, moved, jnp.maximum(jnp.max(jnp.abs(x), axis=0), 1.0))


def newton(model: Model, ends: Ends, start: Path, enough: ArrayLike = 0.0) -> FoundPath:
    """Newton's method, shortened where steps do not shrink, until the next one is smaller than `enough`: they shrink
    quadratically, s' = C s², so the one after s' is s' (s' / s)²."""
    n, scale = ends.x_a.size, extent(ends, start)
    eps = float(jnp.finfo(scale.dtype).eps)
    # Positions have round-off of their own size, which may be far above that of their differences.
    blur = 4 * eps * jnp.max(jnp.max(jnp.abs(start.nodes(ends)[..., :n]), axis=(0, 1)) / scale)
    small = jnp.maximum(jnp.maximum(SMALL, blur), enough)

    def after(path: Path, step: Solved, share: ArrayLike) -> Path:
        y = path.y - share * step.y[..., 0].reshape(start.y.shape)
        return path._replace(y=y, border=path.border - share * step.border[:, 0])

    def amplification(solved: Solved) -> Array:
        """What a change of the end becomes on the path; near a conjugate end much."""
        if ends.kind != FIXED:
            return jnp.ones_like(blur)
        units = solved.y[..., 1 : 1 + n].reshape(*start.y.shape, n)[:, :, :n]
        most = jnp.max(jnp.abs(units) * scale[None, None, None] / scale[None, None, :, None])
        return jnp.where(most > 1.0, most, 1.0)

    def amplified(solved: Solved) -> Array:
        """How much round-off becomes in a step."""
        return jnp.minimum(blur * amplification(solved), 1e-5)

    def size_of(solved: Solved) -> Array:
        x = solved.y[..., 0].reshape(start.y.shape)[..., :n]
        size = jnp.max(jnp.abs(x) / scale[None, None])
        size = jnp.maximum(size, jnp.abs(solved.border[-1, 0] / ends.duration)) if ends.free_time else size
        return jnp.where(jnp.isfinite(size), size, jnp.inf)

    def iterate(search: _Search) -> _Search:
        share = search.share
        trial = after(search.path, search.solved, share)
        found = equations(model, ends, trial)
        pivots = eliminated(found)
        solved = solve(found, pivots.inverses, found.r, found.of_border)
        size, first = size_of(solved), search.iterations == 0
        accepted = first | (size <= (1 - share / 4) * search.size) & jnp.isfinite(size)
        # At round-off steps no longer shrink: the trial is as good as what is there.
        settled = jnp.maximum(SETTLED, 1e3 * amplified(search.solved))
        at_round_off = (search.size < settled) & jnp.isfinite(size)
        accepted = accepted | at_round_off
        # Near a conjugate end the matrix itself is not known well enough before.
        quadratic = (share == 1.0) & (size * amplification(solved) < QUADRATIC)
        next_size = jnp.where(quadratic, size * (size / search.size) ** 2, size)
        ended = (
            accepted & (next_size <= small) | at_round_off & (size > 0.25 * search.size) | ~jnp.isfinite(size) & first
        )
        share = jnp.where(first, 1.0, jnp.where(accepted, jnp.minimum(1.0, 4 * share), share / 4))
        iterations = search.iterations + 1
        new = (trial, solved, pivots.deltas, size, next_size)
        kept = jax.tree.map(lambda a, b: jnp.where(accepted, a, b), new, search[:5])
        return _Search(*kept, share, iterations, ~ended & (iterations < MOST) & (share > SHORTEST))

    nothing, zero = unfound(start), jnp.zeros((), scale.dtype)
    columns = jax.tree.map(lambda x: jnp.concatenate([x[..., :1], x], axis=-1), nothing.response)
    size = nothing.size
    search = _Search(start, columns, nothing.deltas, size, size, zero, jnp.zeros((), int), jnp.asarray(True))
    ended = lax.while_loop(lambda search: search.going, iterate, search)
    response = jax.tree.map(lambda x: x[..., 1:], ended.solved)
    zero_below = jnp.maximum(jnp.maximum(CONVERGED, 1e3 * amplified(ended.solved)), enough)
    last = jnp.where(ended.next_size < zero_below, 1.0, 0.0)
    return FoundPath(
        after(ended.path, ended.solved, last), ended.next_size, zero_below, ended.iterations, ended.deltas, response
    )


def unfound(start: Path) -> FoundPath:
    """What is known before Newton's method."""
    count, s, size = start.y.shape
    b, dtype, infinite = start.border.size, start.y.dtype, jnp.full((), jnp.inf, start.y.dtype)
    response = Solved(jnp.zeros((count, s * size, size + b), dtype), jnp.zeros((b, size + b), dtype))
    deltas = jnp.zeros((count, s * size, s * size), dtype)
    return FoundPath(start, infinite, 0 * infinite + CONVERGED, jnp.zeros((), int), deltas, response)
