"""Roots of small systems of equations, of any rank and from any start: Levenberg-Marquardt by singular values.

A step for `r(y) = 0` is, with the singular value decomposition of the scaled Jacobian `J = U Σ Vᵀ`,

    d = -V Σ (Σ² + δ)⁻¹ Uᵀ r

For δ → 0 it is Newton's step, the shortest if there are many; so redundant equations do no harm, and a family of
solutions is reached at its nearest point. A step that does not reduce `|r|` is taken back and δ is increased.

Source: Nocedal & Wright, *Numerical Optimization*, §10.3; Nielsen, IMM-REP-1999-05 (how δ changes).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from lagjax.numerics.linalg import lapack

# Singular values below this many round-offs of the largest count as zero.
ZERO_BELOW = 1e3
# The largest number of steps. A stiff system is followed along a narrow valley; a hopeless start ends much earlier.
MOST = 600


class Root(NamedTuple):
    """`y` (n,) with residuals `r` (m,) and the `jacobian` there; `rows`: largest entries of its rows at the start."""

    y: Float[Array, " n"]
    r: Float[Array, " m"]
    jacobian: Float[Array, "m n"]
    rows: Float[Array, " m"]
    steps: Int[Array, ""]


def zero_below(dtype) -> float:
    """Singular values up to this part of the largest are round-off."""
    return ZERO_BELOW * float(jnp.finfo(dtype).eps)


def least_squares_root(residual: Callable, y0: Float[Array, " n"], linear: np.ndarray | None = None) -> Root:
    """Find a root of `residual(y)` near y0, or a minimum of its size. Not differentiable: see `differentiable`.

    >>> found = least_squares_root(lambda y: jnp.stack([y[0] * y[1] - 2.0]), jnp.array([2.0, 2.0]))
    >>> print(found.y.round(6), abs(found.r[0]) < 1e-6)
    [1.414214 1.414214] True

    **Arguments:** `residual(y)` -> (m,), of any units; y0 (n,); `linear` (n,): which unknowns enter linearly;
    these are solved for first, with the others as in y0.
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
        i, *_, tries_left = state
        return (i < MOST) & (tries_left > 0)

    # Residuals and Jacobian appear only once in the program, at the trial point, which the start is as well.
    def iterate(state):
        i, y, r, jacobian, trial, rows, columns, damping, grow, expected, tries_left = state
        new_r, new_jacobian = with_value(residual, trial)
        first = i == 0
        sizes = positive(jnp.max(jnp.abs(new_jacobian), axis=1))
        # Rows are scaled at the start, and again after the step of the linear unknowns.
        rows = jnp.where(i <= 1, sizes, rows)
        size = lambda r: jnp.where(jnp.isfinite(squared := jnp.sum((r / rows) ** 2)), squared, jnp.inf)
        old, new = size(r), size(new_r)
        always_accepted = first | (linear.any() & (i == 1))
        better = jnp.all(jnp.isfinite(new_jacobian)) & (always_accepted | (new < old))
        gain_ratio = jnp.where(expected > 0, (old - new) / positive(expected), 0.0)
        less = damping * jnp.maximum(1e-3, 1 - (2 * gain_ratio - 1) ** 3)
        more = jnp.maximum(damping, 1e-12) * grow
        damping = jnp.where(always_accepted, damping, jnp.where(better, less, more)).astype(y.dtype)
        grow = jnp.where(better, 2.0, 2 * grow).astype(y.dtype)
        moved = jnp.max(jnp.abs(trial - y)) > 4 * eps * jnp.max(jnp.abs(trial))
        y = jnp.where(better, trial, y)
        r, jacobian = jnp.where(better, new_r, r), jnp.where(better, new_jacobian, jacobian)
        columns = jnp.where(always_accepted, 0.0, columns)
        columns = jnp.maximum(columns, jnp.max(jnp.abs(jacobian / rows[:, None]), axis=0))
        # The last steps are Newton's, as long as they reduce the residual.
        is_newton = damping < 1e-9
        only_linear = first & linear.any()
        reduced_jacobian = jnp.where(only_linear & ~linear[None, :], 0.0, jacobian)
        step = step_of(r, reduced_jacobian, rows, positive(columns), jnp.where(is_newton | only_linear, 0.0, damping))
        expected = size(r) - size(r + jacobian @ step)
        tries_left = jnp.where(is_newton & ~better & ~always_accepted, tries_left - 1, tries_left)
        tries_left = jnp.where((moved | always_accepted) & (size(r) > 0) & (damping < 1e12), tries_left, 0)
        tries_left = jnp.where(always_accepted & ~better, 0, tries_left)
        return i + 1, y, r, jacobian, y + step, rows, columns, damping, grow, expected, tries_left

    count = jax.eval_shape(residual, y0).shape[0]
    zeros = lambda *shape: jnp.zeros(shape, y0.dtype)
    one = jnp.ones((), y0.dtype)
    start = (
        0,
        y0,
        zeros(count) * jnp.nan,
        zeros(count, y0.size),
        y0,
        zeros(count) + 1,
        zeros(y0.size),
        1e-3 * one,
        2 * one,
        zeros(),
        2,
    )
    steps, y, r, jacobian, _, rows, *_ = lax.while_loop(unfinished, iterate, start)
    return Root(y, r, jacobian, rows, steps)


def with_value(residual: Callable, y):
    """A residual and its Jacobian, by one linearisation."""
    r, push = jax.linearize(residual, y)
    return r, jax.vmap(push, out_axes=1)(jnp.eye(y.size, dtype=y.dtype))


def differentiable(residual: Callable, root: Root) -> Float[Array, " n"]:
    """The root with derivatives of any order, by the implicit function theorem.

    The derivatives are with respect to everything that `residual` depends on. If there is a family of roots, they
    follow its nearest member.
    """
    y, jacobian = lax.stop_gradient((root.y, root.jacobian))
    size = lambda axis: jnp.where((s := jnp.max(jnp.abs(jacobian), axis=axis)) > 0, s, 1.0)
    rows = size(1)
    columns = jnp.where((s := jnp.max(jnp.abs(jacobian / rows[:, None]), axis=0)) > 0, s, 1.0)
    inverted = jnp.linalg.pinv(jacobian / rows[:, None] / columns[None, :], rtol=zero_below(y.dtype))
    inverted = inverted / columns[:, None] / rows[None, :]
    free = jnp.eye(y.size, dtype=y.dtype) - inverted @ jacobian

    def linear_solve(function, known):
        matrix = jax.jacfwd(function)(jnp.zeros_like(known))
        return jnp.linalg.solve(matrix + free, known)

    return lax.custom_root(lambda y: inverted @ residual(y), y, lambda _, y: y, linear_solve)
