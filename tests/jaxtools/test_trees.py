"""Operations on all arrays of a tree: they choose, stop derivatives, and leave the rest as it is."""

import jax
import jax.numpy as jnp
import numpy as np

from lagjax.jaxtools.tracing import decided


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
