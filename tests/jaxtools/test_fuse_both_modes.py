"""A function as one machine function: derivatives in both modes, of any order, in lanes, and next to whole numbers."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from lagjax.jaxtools.fuse import one_function, one_function_in_both_modes

X, Y = np.array([[0.3, -0.7], [0.2, 0.5]])
MODES = {"forward": jax.jacfwd, "reverse": jax.jacrev}


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


def of_lanes(function):
    """Gradients of lanes and lanes of gradients, where an argument is shared by all."""
    lanes = lambda derived: jax.vmap(derived, (0, None))
    total = lambda x, y: jnp.sum(lanes(value(function))(x, y))
    many = lambda x: jnp.stack([x, 2 * x, -x])
    return lambda x, y: (jax.grad(total, (0, 1))(many(x), y), lanes(jax.grad(value(function), 1))(many(x), y))


TOLERANCES = {"first": 1e-14, "second": 1e-13, "lanes": 1e-13}
ALL = {("lanes",): of_lanes}
for outer in MODES:
    ALL["first", outer] = lambda f, outer=outer: MODES[outer](value(f), (0, 1))
    for inner in MODES:
        ALL["second", outer, inner] = lambda f, outer=outer, inner=inner: MODES[outer](MODES[inner](value(f), 0), 1)


SLOW = [("second", mode, mode) for mode in MODES] + [("second", "forward", "reverse")]
FAST = [name for name in ALL if name not in SLOW]


@cache
def both(*names):
    """Values and these derivatives of the fused function and of the plain one, by one program of each."""
    all_of = lambda f: jax.jit(lambda x, y: (f(x, y, 2), [ALL[name](f)(x, y) for name in names]))
    return [all_of(f)(X, Y) for f in (fused, turned)]


def test_values():
    """Values, whole numbers among them; twin: `one_function` has no reverse mode."""
    (found, _), (expected, _) = both(*FAST)
    np.testing.assert_allclose(found["x"], expected["x"], rtol=1e-15)
    assert found["count"] == 3
    with pytest.raises(ValueError, match="Linearization failed"):
        jax.make_jaxpr(jax.grad(lambda x: jnp.sum(one_function(turned, x, Y, 2)["x"])))(X)


@pytest.mark.parametrize("names", [FAST, pytest.param(SLOW, marks=pytest.mark.slow)], ids=["each kind", "all orders"])
def test_derivatives(names):
    """First derivatives in both modes, second ones in all four orders of the modes, and those of lanes."""
    for name, *pair in zip(names, *(derivatives for _, derivatives in both(*names))):
        for a, b in zip(*map(jax.tree.leaves, pair), strict=True):
            np.testing.assert_allclose(a, b, rtol=TOLERANCES[name[0]], err_msg=str(name))


def test_what_does_not_move_has_no_derivative():
    """An argument that the result does not depend on, and one that is not differentiated."""
    slope, along = jax.jit(lambda x, y: (
        jax.grad(lambda z: value(fused)(x, y) + 0 * z)(1.0), jax.jvp(lambda x: fused(x, y)["count"], (x,), (x,))[1]
    ))(X, Y)  # fmt: skip
    assert slope == 0 and along.dtype == jax.dtypes.float0
