"""Velocities from momenta: p = ∂L/∂v solved for v, numerically, for any regular L.

If L is quadratic in the velocities, p is linear in them and one solve with M = ∂²L/∂v∂v is exact; the program of L
shows whether this is so. Otherwise Newton's method finds v, with steps shortened until L is finite and the residual
falls. The derivatives of v, of any order and in both modes, are those of the implicit function:
dv = M⁻¹ (dp - d(∂L/∂v) at fixed v).

Source: Goldstein, *Classical Mechanics*, Eq. (8.15)-(8.18); Arnold, *Mathematical Methods of Classical Mechanics*, §14.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.jaxtools.jaxpr import depends
from lagjax.jaxtools.open_jumps import judging
from lagjax.mechanics.saddle_point import SINGULAR_BELOW
from lagjax.numerics.linalg import dense

ITERATIONS = 60
# The line search takes the best of these fractions of a Newton step.
FRACTIONS = 0.5 ** np.arange(16.0)
# The momentum counts as reached if the residual is below this many round-offs of its terms.
ROUND_OFFS = 1e3


class SolvedVelocity(NamedTuple):
    """The velocity for a given momentum, whether M is regular there, and whether the momentum was reached."""

    v: Float[Array, " n"]
    mass: Float[Array, "n n"]
    regular: Bool[Array, ""]
    reached: Bool[Array, ""]


def velocity_of(momentum: Callable, p: Float[Array, " n"]) -> SolvedVelocity:
    """Solve `momentum(v) = p`, the gradient of a function of v, in vector form."""
    zero = jnp.zeros_like(p)
    mass = jax.jacfwd(momentum)
    if is_linear(momentum, zero):
        matrix = mass(zero)
        v = dense.solve(matrix, p - momentum(zero))
        reached = jnp.all(jnp.isfinite(v))
        return SolvedVelocity(v, matrix, _regular(matrix), reached)
    v = lax.custom_root(lambda v: momentum(v) - p, zero, _newton, _tangent)
    at, target = lax.stop_gradient(v), lax.stop_gradient(p)
    matrix = mass(at)
    return SolvedVelocity(v, matrix, _regular(matrix), _reached(momentum(at), target, matrix, at))


def is_linear(momentum: Callable, like) -> bool:
    """Whether ∂p/∂v is known not to depend on the velocities."""
    program = jax.make_jaxpr(jax.jacfwd(momentum))(like).jaxpr
    return not depends(program, program.invars)


@judging
def _regular(matrix):
    return dense.reciprocal_condition(lax.stop_gradient(matrix)) > SINGULAR_BELOW[np.dtype(matrix.dtype)]


@judging
def _reached(found, target, matrix, v):
    terms = jnp.abs(target) + jnp.abs(matrix) @ jnp.abs(v)
    return jnp.max(jnp.abs(found - target)) <= ROUND_OFFS * jnp.finfo(v.dtype).eps * jnp.max(terms)


def _newton(residual, start):
    size = lambda v: jnp.max(jnp.abs(residual(v)))

    def unfinished(state):
        i, _, before, now = state
        # Round-off ends the quadratic convergence: the residual no longer falls.
        return (i < ITERATIONS) & (now > 0) & (now < before)

    def step(state):
        i, v, _, now = state
        along = dense.solve(jax.jacfwd(residual)(v), residual(v))
        trials = v[None] - FRACTIONS.astype(v.dtype)[:, None] * along[None]
        sizes = jax.vmap(size)(trials)
        sizes = jnp.where(jnp.isfinite(sizes), sizes, jnp.inf)
        best = jnp.argmin(sizes)
        better = sizes[best] < now
        return i + 1, jnp.where(better, trials[best], v), now, jnp.where(better, sizes[best], now)

    first = size(start)
    return lax.while_loop(unfinished, step, (0, start, jnp.full_like(first, jnp.inf), first))[1]


def _tangent(linear, y):
    return dense.solve(jax.jacfwd(linear)(jnp.zeros_like(y)), y)
