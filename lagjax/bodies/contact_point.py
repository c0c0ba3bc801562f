"""Where a body touches a surface f = 0: at the point of the body where f is least.

The points of the body are c + uᵀS for unit vectors u: a sphere with S = R 1, a rim in the plane of the two rows of S.
With F(u) = f(c + uᵀS), at the point of contact

    ∇F = μ u,      a change y of ∇F turns u by x:      x·(∇²F - μ 1) x' + x'·y = 0 for all x' at right angles to u

u is found for numbers alone, by steps of Newton's without loops, so that the equations are written out in single
numbers. Its derivatives are those of the implicit function: `following` is u, and the rule for its derivative is
written with `following`, so that it has a derivative again, to any order. Those of the least value of F do not contain
those of u: x·∇F = 0.

Source: Krantz & Parks, *The Implicit Function Theorem*; Milgrom & Segal, Econometrica 70 (2002) 583 (envelopes).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.jaxtools import is_traced, jaxpr_as_fun, rule_follows

# Steps of Newton's to the point of contact from the one below the centre, of which the last turns u by less than
# `SETTLED`. A further one with its matrix leaves the third power of that.
STEPS, SETTLED = 4, 1e-5


class Touch(NamedTuple):
    """The point of contact and the way there from the centre; f, |∇f| and ∇f/|∇f| there."""

    point: Float[Array, "3"]
    arm: Float[Array, "3"]
    height: Float[Array, ""]
    slope: Float[Array, ""]
    normal: Float[Array, "3"]


def on_plane(centre: Array, shape: Array) -> Touch:
    """The point of contact with the plane z = 0, of which z is the height."""
    up = jnp.asarray((0.0, 0.0, 1.0), centre.dtype)
    arm = -unit(shape[:, 2]) @ shape
    return Touch(centre + arm, arm, centre[2] + arm[2], jnp.ones_like(centre[2]), up)


def below(f: Callable, centre: Array, radius: Array) -> Touch:
    """The point of contact of a sphere where f is the distance: straight below its centre, nearer by the radius."""
    height, normal = jax.value_and_grad(f)(centre)
    arm = -radius * normal
    return Touch(centre + arm, arm, height - radius, jnp.sqrt(jnp.sum(normal**2)), normal)


def searched(f: Callable, centre: Array, shape: Array) -> Touch:
    """The point of contact of any of these bodies, given its `shape` S (2, 3) or (3, 3)."""
    start = -unit(shape @ jax.grad(f)(lax.stop_gradient(centre)))
    u, height = least_of(lambda u: f(centre + u @ shape), lax.stop_gradient(start))
    arm = u @ shape
    gradient = jax.grad(f)(centre + arm)
    slope = jnp.sqrt(jnp.sum(gradient**2))
    return Touch(centre + arm, arm, height, slope, gradient / slope)


def least_of(f: Callable, start: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """The unit vector of two or three numbers, near that at the start, for which a function is least; and its value.

    >>> import jax
    >>> import numpy as np
    >>> nearest = jax.jit(lambda to, start: least_of(lambda u: jnp.sum((u - to) ** 2), start))
    >>> u, value = nearest(np.array([3.0, 4.0]), np.array([0.8, 0.6]))
    >>> print(u.round(6), value.round(6))
    [0.6 0.8] 16.0

    Both are NaN where it is not found. They are differentiable in what f depends on, to any order.
    """
    program = jax.make_jaxpr(f)(start)
    traced = list(map(is_traced, program.consts))
    beside = [x for x, changes in zip(program.consts, traced) if changes]

    def value(u: Array, beside: Sequence[Array]) -> Array:
        rest = iter(beside)
        consts = [next(rest) if changes else x for x, changes in zip(program.consts, traced)]
        return jaxpr_as_fun(program.replace(consts=consts))(u)[0]

    gradient = jax.grad(value)

    def turning(u: Array, beside: Sequence[Array]) -> tuple[Callable[[Array], Array], Array]:
        """How u turns when the gradient there changes; whether F curves upward in all directions."""
        matrix = jax.jacfwd(gradient)(u, beside) - jnp.dot(u, gradient(u, beside)) * np.eye(len(u), dtype=u.dtype)
        if len(u) == 2:
            across = jnp.stack([-u[1], u[0]])
            curvature = jnp.dot(across, matrix @ across)
            return lambda y: -jnp.dot(across, y) / curvature * across, curvature > 0
        # The inverse of a symmetric matrix (2, 2) is that matrix, turned by a right angle, by its determinant.
        a, b, c = matrix
        cofactors = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
        determinant = jnp.dot(u, cofactors @ u)
        is_least = (determinant > 0) & (jnp.trace(matrix) > jnp.dot(u, matrix @ u))
        return lambda y: jnp.cross(u, matrix @ jnp.cross(u, y)) / determinant, is_least

    @rule_follows
    def following(u: Array, beside: Sequence[Array]) -> Array:
        return u

    @following.defjvp
    def _(primals: tuple, tangents: tuple):
        u, (_, beside), (_, moving) = following(*primals), primals, tangents
        y = jax.jvp(lambda beside: gradient(u, beside), (beside,), (moving,))[1]
        return u, turning(u, beside)[0](y)

    @rule_follows
    def least(u: Array, beside: Sequence[Array]) -> Array:
        return value(u, beside)

    @least.defjvp
    def _(primals: tuple, tangents: tuple):
        u, (_, beside), (_, moving) = following(*primals), primals, tangents
        # The value is `least` again: by `value` its derivative would contain that of u.
        return least(*primals), jax.jvp(lambda beside: value(u, beside), (beside,), (moving,))[1]

    held, found, before = lax.stop_gradient(beside), start, start
    turn, is_least = turning(found, held)
    for i in range(STEPS):
        before, found = found, unit(found + turn(gradient(found, held)))
        if i < STEPS - 1:
            turn, is_least = turning(found, held)
    is_found = is_least & (jnp.sum((found - before) ** 2) < SETTLED**2)
    found = unit(jnp.where(is_found, found, jnp.nan) + turn(gradient(found, held)))
    return following(found, beside), least(found, beside)


def unit(x: Array) -> Array:
    """The unit vector along another."""
    return x / jnp.sqrt(jnp.sum(x**2))
