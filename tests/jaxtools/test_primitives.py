"""Primitives of our own: a linear map that JAX transposes, differentiates and batches."""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax.jaxtools.primitives import ad, front, linear_map_primitive, split

X, DIRECTION, COTANGENT = np.random.default_rng(0).normal(size=(3, 4))


def product(name, factor):
    """The map dx -> 2 x dx, as a function of x and dx; its transpose multiplies by `factor` x."""

    def shapes(x, dx):
        return [dx]

    def jvp(primals, tangents):
        x, dx = primals
        of_x, of_dx = map(ad.instantiate_zeros, tangents)
        return [times(x, dx)], [times(x, of_dx) + times(of_x, dx)]

    def batched(operands, axes):
        moved, _, lanes = front(operands, axes)
        return [times(*(jnp.broadcast_to(x, (lanes, *np.shape(dx)[-1:])) for x, dx in zip(moved, operands)))], [0]

    new = linear_map_primitive(
        name,
        along=lambda points, directions: [2.0 * points[0] * directions[0]],
        transpose=lambda points, like, wanted, cotangents: [factor * points[0] * cotangents[0]],
        shapes=shapes,
        count=lambda params: 1,
        jvp=jvp,
        batched=batched,
    )

    def times(x, dx):
        return new.bind(x, dx)[0]

    return times


RIGHT, WRONG = product("product", 2.0), product("wrong product", 3.0)


def adjoint_error(times):
    """How far c·(A dx) is from (Aᵀ c)·dx."""
    pull = jax.linear_transpose(lambda dx: times(X, dx), DIRECTION)
    (pulled,), pushed = jax.jit(lambda c, dx: (pull(c), times(X, dx)))(COTANGENT, DIRECTION)
    return abs(COTANGENT @ np.asarray(pushed) - np.asarray(pulled) @ DIRECTION)


def test_a_linear_map_has_a_transpose():
    """c·(A dx) = (Aᵀ c)·dx, in Python and compiled; twin: the transpose of another map."""
    assert adjoint_error(RIGHT) < 1e-14 and adjoint_error(WRONG) > 1e-2
    np.testing.assert_allclose(RIGHT(X, DIRECTION), 2 * X * DIRECTION, rtol=1e-15)


def test_derivatives_and_batches():
    """Both modes, and lanes with one of the operands shared."""
    lanes = np.stack([DIRECTION, 3 * DIRECTION])
    derivatives = lambda x, dx: [mode(RIGHT, argnums=1)(x, dx) for mode in (jax.jacfwd, jax.jacrev)]
    of_lanes = jax.vmap(RIGHT, in_axes=(None, 0))
    found, together = jax.jit(lambda x, dx, many: (derivatives(x, dx), of_lanes(x, many)))(X, DIRECTION, lanes)
    for derivative in found:
        np.testing.assert_allclose(derivative, np.diag(2 * X), rtol=1e-15)
    np.testing.assert_allclose(together, 2 * X * lanes, rtol=1e-15)


def test_operands():
    """The last ones are directions; the axis of a batch comes first, and it is known which operands have one."""
    assert split((1, 2, 3), 1) == ((1, 2), (3,)) and split((1, 2), 0) == ((1, 2), ())
    moved, batched, lanes = front([np.ones((3, 5)), np.ones(3)], [1, None])
    assert [x.shape for x in moved] == [(5, 3), (3,)] and batched == (True, False) and lanes == 5
