"""Roots of small systems of equations, of any rank and from any distance: Levenberg-Marquardt by singular values.

A step of `r(y) = 0` is, with the singular values of the scaled Jacobian `J = U Σ Vᵀ`,

    d = -V Σ (Σ² + δ)⁻¹ Uᵀ r

For δ → 0 it is Newton's, the shortest where there are many; so equations that follow from others do no harm, and a
family of solutions is met at its nearest point. A step that does not lessen `|r|` is taken back and δ is enlarged.

Source: Nocedal & Wright, *Numerical Optimization*, §10.3; Nielsen, IMM-REP-1999-05 (how δ changes).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from lagjax.numerics import lapack

# Singular values below this part of the largest are zero.
ZERO_BELOW = 1e3
# A stiff system is followed along a narrow valley; a start that leads nowhere ends much earlier.
MOST = 600


class Root(NamedTuple):
    """`y` (n,) with residuals `r` (m,) and the `jacobian` there, the largest entries of its `rows` to begin with."""

    y: Float[Array, " n"]
    r: Float[Array, " m"]
    jacobian: Float[Array, "m n"]
    rows: Float[Array, " m"]
    steps: Int[Array, ""]


def zero_below(dtype) -> float:
    """The part of the largest singular value up to which one is round-off."""
    return ZERO_BELOW * float(jnp.finfo(dtype).eps)


def least_squares_root(residual: Callable, y0: Float[Array, " n"], linear: np.ndarray | None = None) -> Root:
    """Find a root of `residual(y)` near y0, or where its size is least. Without derivatives: see `differentiable`.

    >>> found = least_squares_root(lambda y: jnp.stack([y[0] * y[1] - 2.0]), jnp.array([2.0, 2.0]))
    >>> print(found.y.round(6), abs(found.r[0]) < 1e-6)
    [1.414214 1.414214] True

    **Arguments:** `residual(y)` -> (m,), of any units; y0 (n,); `linear` (n,): which unknowns enter linearly and are
    chosen first, for the others as they are in y0.
    """
    eps, tiny = jnp.finfo(y0.dtype).eps, jnp.finfo(y0.dtype).tiny
    linear = np.zeros(y0.size, bool) if linear is None else linear
    positive = lambda x: jnp.where(x > 0, x, 1.0)

    def step_of(r, jacobian, rows, columns, damping):
        u, s, vt = lapack.decomposed(jacobian / rows[:, None] / columns[None, :])
        kept = s > zero_below(y0.dtype) * jnp.maximum(s[0], tiny)
        gain = jnp.where(kept, s / jnp.where(kept, s**2 + damping, 1.0), 0.0)
        return -(vt.T @ (gain * (u.T @ (r / rows)))) / columns

    def unfinished(state):
        i, *_, going = state
        return (i < MOST) & (going > 0)

    # Residuals and Jacobian stand once in the program: at the point that is tried, which the first is too.
    def iterate(state):
        i, y, r, jacobian, trial, rows, columns, damping, grow, expected, going = state
        new_r, new_jacobian = with_value(residual, trial)
        first = i == 0
        sizes = positive(jnp.max(jnp.abs(new_jacobian), axis=1))
        # Of the first step, and of the place that the linear unknowns make of it.
        rows = jnp.where(i <= 1, sizes, rows)
        size = lambda r: jnp.where(jnp.isfinite(squared := jnp.sum((r / rows) ** 2)), squared, jnp.inf)
        old, new = size(r), size(new_r)
        chosen = first | (linear.any() & (i == 1))
        better = jnp.all(jnp.isfinite(new_jacobian)) & (chosen | (new < old))
        share = jnp.where(expected > 0, (old - new) / positive(expected), 0.0)
        less = damping * jnp.maximum(1e-3, 1 - (2 * share - 1) ** 3)
        more = jnp.maximum(damping, 1e-12) * grow
        damping = jnp.where(chosen, damping, jnp.where(better, less, more)).astype(y.dtype)
        grow = jnp.where(better, 2.0, 2 * grow).astype(y.dtype)
        moved = jnp.max(jnp.abs(trial - y)) > 4 * eps * jnp.max(jnp.abs(trial))
        y = jnp.where(better, trial, y)
        r, jacobian = jnp.where(better, new_r, r), jnp.where(better, new_jacobian, jacobian)
        columns = jnp.where(chosen, 0.0, columns)
        columns = jnp.maximum(columns, jnp.max(jnp.abs(jacobian / rows[:, None]), axis=0))
        # In the end Newton's steps, as long as they get nearer.
        last = damping < 1e-9
        only_linear = first & linear.any()
        used = jnp.where(only_linear & ~linear[None, :], 0.0, jacobian)
        step = step_of(r, used, rows, positive(columns), jnp.where(last | only_linear, 0.0, damping))
        expected = size(r) - size(r + jacobian @ step)
        going = jnp.where(last & ~better & ~chosen, going - 1, going)
        going = jnp.where((moved | chosen) & (size(r) > 0) & (damping < 1e12), going, 0)
        going = jnp.where(chosen & ~better, 0, going)
        return i + 1, y, r, jacobian, y + step, rows, columns, damping, grow, expected, going

    count = jax.eval_shape(residual, y0).shape[0]
    of = lambda *shape: jnp.zeros(shape, y0.dtype)
    one = jnp.ones((), y0.dtype)
    start = (
        0,
        y0,
        of(count) * jnp.nan,
        of(count, y0.size),
        y0,
        of(count) + 1,
        of(y0.size),
        1e-3 * one,
        2 * one,
        of(),
        2,
    )
    steps, y, r, jacobian, _, rows, *_ = lax.while_loop(unfinished, iterate, start)
    return Root(y, r, jacobian, rows, steps)


def with_value(residual: Callable, y):
    """A residual and its Jacobian, by one linearization."""
    r, push = jax.linearize(residual, y)
    return r, jax.vmap(push, out_axes=1)(jnp.eye(y.size, dtype=y.dtype))


def differentiable(residual: Callable, root: Root) -> Float[Array, " n"]:
    """The root with its derivatives of any order by all that `residual` depends on: the implicit function theorem.

    Where the equations leave a family of roots, it is the nearest one that is followed.
    """
    y, jacobian = lax.stop_gradient((root.y, root.jacobian))
    size = lambda axis: jnp.where((s := jnp.max(jnp.abs(jacobian), axis=axis)) > 0, s, 1.0)
    rows = size(1)
    columns = jnp.where((s := jnp.max(jnp.abs(jacobian / rows[:, None]), axis=0)) > 0, s, 1.0)
    inverted = jnp.linalg.pinv(jacobian / rows[:, None] / columns[None, :], rtol=zero_below(y.dtype))
    inverted = inverted / columns[:, None] / rows[None, :]
    free = jnp.eye(y.size, dtype=y.dtype) - inverted @ jacobian

    def linear_solve(of, known):
        matrix = jax.jacfwd(of)(jnp.zeros_like(known))
        return jnp.linalg.solve(matrix + free, known)

    return lax.custom_root(lambda y: inverted @ residual(y), y, lambda _, y: y, linear_solve)
