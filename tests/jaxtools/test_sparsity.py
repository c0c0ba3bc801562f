"""Patterns read off a jaxpr: never too empty, and exact where the primitives are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.jaxtools.dependence import pattern
from tests.jaxtools.in_numpy import evaluated

CHOSEN = np.array([3, 1, 1, 0, 7])
INCIDENCE = np.eye(8) - np.eye(8, k=-1)
EXACT = {
    "differences": lambda x: jnp.diff(x) ** 2,
    "chosen": lambda x: x[CHOSEN] * 2,
    "of rows chosen": lambda x: jnp.sin(x.reshape(4, 2)[np.array([[0, 1], [2, 3]])]).sum(1),
    "added": lambda x: jnp.zeros(8).at[CHOSEN].add(x[:5]),
    "constant matrix": lambda x: jnp.asarray(INCIDENCE) @ x,
    "quadratic form": jax.grad(lambda x: x @ jnp.asarray(INCIDENCE) @ x),
    "cumulative": lambda x: jnp.flip(jnp.cumsum(jnp.flip(x))),
    "rolled": lambda x: jnp.roll(x, 3) * x,
    "padded": lambda x: jax.lax.pad(x, 0.0, ((2, -3, 1),)),
    "masked": lambda x: x * jnp.asarray([0, 1.0, 0, 1, 0, 0, 1, 1]),
    "where": lambda x: jnp.where(np.arange(8) < 3, x, 0),
    "lengths": lambda x: jnp.linalg.norm(x.reshape(4, 2), axis=1),
    "relativistic": jax.grad(lambda x: -jnp.sum(jnp.sqrt(1 - 0.1 * jnp.sum(x.reshape(4, 2) ** 2, 1)))),
    "gradient of chosen": jax.grad(lambda x: jnp.sum(x[CHOSEN] ** 2 * jnp.sin(x[CHOSEN]))),
    "mapped": lambda x: jax.vmap(lambda a: a[0] * jnp.cos(a[1]))(x.reshape(4, 2)),
    "one by one": lambda x: jnp.stack([x[i] * x[i + 1] for i in range(7)]),
    "set": lambda x: jnp.zeros((4, 2)).at[1:3, 0].set(x[:2]).at[:, 1].add(x[4:]),
    "every other": jax.grad(lambda x: jnp.sum(x[::2] ** 2 * x[1::2])),
    "segments": lambda x: jax.ops.segment_sum(x, np.array([0, 0, 1, 1, 2, 2, 3, 0]), 4),
    "inner jit": jax.jit(lambda x: jnp.hypot(x[1:], x[:-1])),
}
TOO_FULL = {
    "loop": lambda x: jax.lax.scan(lambda c, a: (a, c * a), 0.0, x)[1],
    "indices that are not constants": lambda x: x[jnp.argsort(x)],
    "reduction by a function": lambda x: jax.lax.reduce(x.reshape(4, 2), 0.0, lambda a, b: a * b + a + b, (1,)),
    "branches": lambda x: jax.lax.cond(x[0] > 0.5, lambda y: y, lambda y: y[::-1], x),
    "replaced": lambda x: x.at[np.array([2, 4])].set(x[:2]),
}


def nonzero(function, seed=0):
    """Where the derivative is nonzero at one of three random states."""
    states = np.random.default_rng(seed).uniform(0.2, 1.0, (3, 8))
    (slopes,) = evaluated(jax.vmap(jax.jacfwd(lambda x: jnp.ravel(function(x)))), states)
    return np.any(slopes != 0, axis=0)


@pytest.mark.parametrize("name", EXACT)
def test_patterns_are_exact(name):
    """For known primitives the pattern is that of the derivative, no more and no less."""
    np.testing.assert_array_equal(pattern(EXACT[name], np.zeros(8)), nonzero(EXACT[name]))


@pytest.mark.parametrize("name", ["chosen", "added", "gradient of chosen"])
def test_patterns_are_found_while_tracing(name):
    """Constant indices are constants also inside a function that is being compiled."""
    found = []
    jax.eval_shape(lambda x: found.append(pattern(EXACT[name], x)), np.zeros(8))
    np.testing.assert_array_equal(found[0], nonzero(EXACT[name]))


@pytest.mark.parametrize("name", TOO_FULL)
def test_unknown_primitives_are_full(name):
    """For unknown primitives every output depends on every input: too full, never too empty."""
    found, really = pattern(TOO_FULL[name], np.zeros(8)), nonzero(TOO_FULL[name])
    assert not np.any(really & ~found)
    assert np.any(found & ~really)


def test_what_is_traced_or_an_argument_is_not_looked_at():
    """The zeros of a constant mask count; a mask that is an argument, or traced, may be anything."""
    mask, x = np.array([0.0, 1.0]), np.ones(2)
    assert pattern(lambda x: mask * x, x).sum() == 1
    assert pattern(lambda x, mask: mask * x, x, mask).sum() == 2
    seen = []
    jax.eval_shape(lambda mask: seen.append(pattern(lambda x: mask * x, x).sum()), mask)
    assert seen == [2]


def test_traced_indices_make_everything_depend():
    """Entries taken at indices that are arguments could come from anywhere."""
    take = lambda x, i: x[i]
    assert pattern(lambda x: take(x, CHOSEN), np.zeros(8)).sum() == CHOSEN.size
    assert pattern(take, np.zeros(8), CHOSEN).all()
