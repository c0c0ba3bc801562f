"""Operations on all arrays of a tree: they choose, stop derivatives, and leave the rest as it is."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools.trees import decided, without_init


class Checked(eqx.Module):
    """A module whose `__init__` refuses everything."""

    x: float

    def __init__(self, x):
        raise ValueError("refused")


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
