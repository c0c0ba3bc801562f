"""A function as one machine function: derivatives in both modes, of any order, in lanes, and next to whole numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from lagjax.jaxtools.fuse_both_modes import one_function_in_both_modes
from lagjax.jaxtools.fuse_cpu import one_function

X, Y = jnp.array([0.3, -0.7]), jnp.array([0.2, 0.5])


def turned(x, y, count):
    """A loop with a whole number in it, which also returns one."""
    found, _ = lax.scan(lambda s, _: (jnp.sin(s) * y + 0.5 * s, None), x, None, 3)
    return {"x": found * count, "count": count + 1}


def fused(x, y, count=2):
    """The same as one function."""
    return one_function_in_both_modes(turned, x, y, jnp.asarray(count))


def value(function):
    """A number that depends on all entries."""
    return lambda x, y: jnp.sum(function(x, y, 2)["x"] ** 2)


def test_values_and_first_derivatives():
    """Values, whole numbers among them, and derivatives in both modes; twin: `one_function` has no reverse mode."""
    found, expected = fused(X, Y), turned(X, Y, 2)
    np.testing.assert_allclose(found["x"], expected["x"], rtol=1e-15)
    assert found["count"] == 3
    for mode in (jax.jacfwd, jax.jacrev):
        for a, b in zip(*(mode(value(f), (0, 1))(X, Y) for f in (fused, turned))):
            np.testing.assert_allclose(a, b, rtol=1e-14)
    with pytest.raises(ValueError, match="Linearization failed"):
        jax.grad(lambda x: jnp.sum(one_function(turned, x, Y, 2)["x"]))(X)


@pytest.mark.parametrize("outer", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("inner", [jax.jacfwd, jax.jacrev])
def test_second_derivatives(outer, inner):
    """All four orders of the two modes."""
    found, expected = (outer(inner(value(f), 0), 1)(X, Y) for f in (fused, turned))
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_lanes():
    """Gradients of lanes and lanes of gradients, where an argument is shared by all."""
    many = jnp.stack([X, 2 * X, -X])

    def total(function):
        return lambda x, y: jnp.sum(jax.vmap(value(function), (0, None))(x, y))

    for a, b in zip(*(jax.grad(total(f), (0, 1))(many, Y) for f in (fused, turned))):
        np.testing.assert_allclose(a, b, rtol=1e-13)
    each = jax.vmap(jax.grad(value(fused), 1), (0, None))(many, Y)
    np.testing.assert_allclose(jnp.sum(each, axis=0), jax.grad(total(turned), 1)(many, Y), rtol=1e-13)


def test_what_does_not_move_has_no_derivative():
    """An argument that the result does not depend on, and one that is not differentiated."""
    np.testing.assert_array_equal(jax.grad(lambda z: value(fused)(X, Y) + 0 * z)(1.0), 0.0)
    along = jax.jvp(lambda x: fused(x, Y)["count"], (X,), (X,))[1]
    assert along.dtype == jax.dtypes.float0
