"""Whether JAX is tracing, here and now."""

import jax
import jax.numpy as jnp

from lagjax.jaxtools.tracing import is_eager


def test_where_nothing_is_traced():
    """`is_eager` is false inside all of JAX's transformations, even if no argument is traced."""
    seen = []
    look = lambda x: (seen.append(is_eager()), x)[1]
    look(1.0)
    for transform in (jax.jit, jax.grad, jax.vmap, jax.linearize):
        transform(look, *([1.0] if transform is jax.linearize else []))
        if transform is not jax.linearize:
            transform(look)(jnp.ones(2) if transform is jax.vmap else 1.0)
    look(1.0)
    assert seen[0] and seen[-1] and not any(seen[1:-1])
