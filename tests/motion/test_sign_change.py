"""The search for the time of an event, on functions of one variable."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from lagjax.motion.sign_change import SignChange

TOLERANCE = 1e-15
# Function on [0, 1], where it ends, and the most evaluations that this may take; about 52 halve the interval away.
CASES = {
    "smooth": (lambda x: jnp.cos(2 * x), np.pi / 4, 12),
    "linear": (lambda x: x - 0.3, 0.3, 8),
    "steep": (lambda x: jnp.exp(30 * x) - 10, np.log(10) / 30, 16),
    "of third order": (lambda x: (x - 0.3) ** 3, 0.3, 70),
    "a jump": (lambda x: jnp.where(x < 0.123, -1.0, 1.0), 0.123, 70),
    "a pole": (lambda x: 1 / (x - 0.37), 0.37, 70),
    "zero at the start, too": (lambda x: x * (0.5 - x), 0.5, 12),
    "zero at the end": (lambda x: x - 1, 1.0, 8),
    "no change": (lambda x: x + 1, 1.0, 3),
    "never a number": (lambda x: x * jnp.nan, 1.0, 3),
}


def test_ends_where_the_sign_changes():
    """In a batch: each lane at its own change, or at the upper end; smooth ones in few evaluations."""
    functions, ends, most = zip(*CASES.values())

    def search(i):
        f = lambda x, args: jax.lax.switch(i, functions, x)
        bounds = {"lower": jnp.asarray(0.0), "upper": jnp.asarray(1.0)}
        finder = SignChange(rtol=0.0, atol=TOLERANCE)
        found = optx.root_find(f, finder, jnp.asarray(0.0), options=bounds, max_steps=256, throw=False)
        return found.value, found.stats["num_steps"], found.result == optx.RESULTS.successful

    value, asked, ended = jax.jit(jax.vmap(search))(jnp.arange(len(CASES)))
    assert ended.all()
    np.testing.assert_allclose(value, ends, atol=3 * TOLERANCE)
    assert np.all(np.asarray(asked) <= most), dict(zip(CASES, asked.tolist()))
    # Twin: where there is nothing to interpolate it halves, and takes as long as that does.
    assert asked[list(CASES).index("a jump")] > 45
