"""Operations on all arrays of a tree: they choose, stop derivatives, and leave the rest as it is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools.trees import decided, like, stop_gradient, where, without_init
from tests.jaxtools.in_numpy import evaluated


class Checked(eqx.Module):
    """A module whose `__init__` refuses everything."""

    x: float

    def __init__(self, x):
        raise ValueError("refused")


def test_each_array_is_chosen():
    """Arrays come from one of two trees, in the dtypes of the second; what is no array stays."""
    a, b, names = {"name": "a"}, {"name": "b"}, []

    def chosen(mask, x, y):
        found = where(mask, a | {"x": x}, b | {"x": y})
        names.append(found["name"])
        return found["x"]

    for mask, expected in ((np.array([True, False, True]), [0.0, 0.0, 2.0]), (False, [0.0] * 3)):
        (x,) = evaluated(chosen, mask, np.arange(3.0), np.zeros(3, np.float32))
        assert x.dtype == np.float32 and x.tolist() == expected
    assert set(names) == {"b"}


def test_a_mask_has_the_axes_of_what_it_masks():
    """A mask of lanes selects whole lanes; twin: without it the shapes do not fit."""
    mask, x = np.array([True, False]), np.ones((2, 3))
    assert np.where(like(mask, x), x, 0.0).sum(axis=1).tolist() == [3.0, 0.0] and like(mask, mask).shape == (2,)
    with pytest.raises((TypeError, ValueError)):
        jnp.where(mask, x, 0.0)


def test_derivatives_stop():
    """x · x has the slope x where one factor is held; twin: 2 x where none is."""
    assert evaluated(jax.grad(lambda x: x * stop_gradient({"x": x, "name": "x"})["x"]), 3.0) == [3.0]
    assert evaluated(jax.grad(lambda x: x * x), 3.0) == [6.0]


def test_no_init_is_called():
    """The fields are set without a check; twin: the usual way refuses."""
    made = without_init(Checked, {"x": 2.0})
    assert isinstance(made, Checked) and jax.tree.leaves(made) == [2.0]
    with pytest.raises(ValueError, match="refused"):
        Checked(2.0)


def _kept(through):
    def selections(*x):
        test = through(jnp.abs(x[0]) + sum(jnp.abs(x[i] * x[i + 1]) for i in range(6)) < 3.0)
        return [jnp.where(test, x[i], jnp.nan) for i in range(7)]

    return jax.jit(selections)


def test_what_decides_is_compiled_once():
    """A test of seven terms that decides about seven numbers: seven terms in the program, not 49; the same results.

    Where the twin fails, XLA no longer copies, and `decided` can go.
    """
    x = [0.1 * i for i in range(8)]
    once, copied = _kept(decided), _kept(lambda truth: truth)
    assert once.lower(*x).compile().as_text().count(" abs(") == 7
    assert copied.lower(*x).compile().as_text().count(" abs(") == 49
    large = [x[0] + 2.0, *x[1:]]
    for given in (x, large):
        np.testing.assert_array_equal(once(*given), copied(*given))
    assert np.isfinite(once(*x)).all() and np.isnan(once(*large[:1], *[y + 2.0 for y in x[1:]])).all()
