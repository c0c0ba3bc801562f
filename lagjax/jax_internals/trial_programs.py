"""The programs of the trial (`trial.py`): those at which an XLA has ended the process, or is most likely to."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lagjax.jax_internals.one_function import kept_as_call, one_function


def main():
    """Run each of them as one function; raise if a result does not agree with NumPy."""
    x, table = jnp.asarray(2.0), np.linspace(0.0, 1.0, 5000)

    def grown(x, y):
        """A loop whose length depends on its numbers, with a branch and a call in it."""

        def body(state):
            x, y = state
            x = lax.cond(y > 0, lambda: 1.5 * x, lambda: 1.25 * x)
            return x, kept_as_call(jax.jit(lambda x, y: (jnp.sin(x) + y, x))(x, y))[0]

        return lax.while_loop(lambda state: state[0] < 100.0, body, (x, y))

    def summed(x, table):
        return lax.fori_loop(0, 5, lambda i, s: s + jnp.asarray(table)[i * 1000], x)

    a, b = 2.0, 0.5
    while a < 100.0:
        a = 1.5 * a if b > 0 else 1.25 * a
        b = np.sin(a) + b
    _agree(grown, (a, b), x, jnp.asarray(0.5))
    # Operands that are not used, that turn out not to be used, and that are known: XLA must not drop these.
    _agree(lambda x, y: 2 * x, 4.0, x, x)
    _agree(lambda x, y: jnp.where(jnp.asarray(1.0) > 0, 2 * x, y), 4.0, x, x)
    expected = 2.0 + sum(table[::1000])
    _agree(lambda x: summed(x, table), expected, x)
    _agree(summed, expected, x, jnp.asarray(table))
    matrix = np.sin(np.arange(81.0)).reshape(9, 9)
    _agree(lambda m: m @ m, matrix @ matrix, jnp.asarray(matrix))
    _agree(lambda x: jax.jvp(lambda x: one_function(jnp.sin, x), (x,), (x,))[1], 2 * np.cos(2.0), x)


def _agree(function, expected, *args):
    found = jax.jit(lambda *args: one_function(function, *args))(*args)
    # The tolerances allow for single precision, JAX's default.
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-4, atol=1e-5), found, expected)
