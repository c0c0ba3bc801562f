"""Programs rewritten number by number: the same results with fewer operations."""

from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from jax.extend.core import jaxpr_as_fun

from lagjax.jaxtools.jaxpr import needed, staged
from lagjax.jaxtools.scalarize import TooLong, written_out
from tests.jaxtools.in_numpy import along, evaluated, run

X, DIRECTION = np.array([[0.3, -1.2, 0.7, 2.0], [0.9, 0.4, -0.7, 1.3]])
MATRIX = np.arange(12.0).reshape(3, 4) / 7
integers = lambda: jnp.arange(16).reshape(4, 4)


def numbers(function, *args):
    """The written-out program."""
    program = jax.make_jaxpr(function)(*args)
    return jax.make_jaxpr(lambda *args: written_out(program, *args))(*args)


def operations(program):
    """The count of each primitive on which the results depend."""
    return Counter(equation.primitive.name for equation in needed(program.jaxpr))


@jax.custom_jvp
def doubled(x):
    """A function with a custom derivative rule, which differs from its derivative."""
    return 2 * x


doubled.defjvp(lambda primals, tangents: (doubled(*primals), 7 * tangents[0]))

FUNCTIONS = {
    "products": lambda x: MATRIX @ x + jnp.dot(x, x) + jnp.outer(x, x)[1, 2],
    "einsum": lambda x: jnp.einsum("ij,j,kj->ik", MATRIX, x, MATRIX),
    "moves": lambda x: jnp.concatenate([x[::-1], jnp.pad(x[1:3], (2, 1)), x.reshape(2, 2).T.reshape(-1), x[::2]]),
    "stacks": lambda x: jnp.stack([x, 2 * x], axis=1) @ jnp.array([1.0, -1.0]),
    "sums": lambda x: jnp.cumsum(x) + jnp.sum(MATRIX * x[None], axis=0) + jnp.mean(x),
    "choices": lambda x: jnp.where(x > 0, x, jnp.sin(x)) * jnp.clip(x, -1, 1) + jnp.maximum(x, 0.5) ** 3,
    "cosines": lambda x: jnp.cos(x) * jnp.sin(x[0]),
    "indices": lambda x: x[jnp.array([3, 0, 2])] + x[1] * x[-1] + jnp.take(x, 2),
    "order": lambda x: jnp.sort(x) + jnp.argmax(x) + jnp.max(x),
    "loops": lambda x: lax.scan(lambda c, y: (c + y, c * y), 0.0, x)[1] + lax.cond(x[0] > 0, jnp.sin, jnp.cos, x),
    "norms": lambda x: x / jnp.linalg.norm(x) + jnp.cross(x[:3], x[1:])[0],
    "rules": lambda x: doubled(x) + jax.nn.softplus(x),
    "mixed": lambda x: jnp.diag(x) @ x + jnp.eye(4)[1] + jnp.where(jnp.eye(4) > 0, x, 0).sum(0),
    "updates": lambda x: x.at[1].set(x[2]).at[2:].add(1.0),
    "known infinities": lambda x: x * jnp.minimum(1 / jnp.array([1.0, 0.0, -2.0, -0.0]), 5.0).clip(-7.0),
    "products of mixed kinds": lambda x: integers() @ x + x @ (integers() > 3).T + integers().astype(jnp.float32) @ x,
    "integers": lambda x: x * ((integers()[0] + 29) // 10) + x[(integers()[1] + 3) % 4] * lax.div(integers()[2], 3),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_same_values_and_derivatives(name):
    """The written-out program and its derivative give the same values."""
    written = jaxpr_as_fun(numbers(FUNCTIONS[name], X))
    found, expected = (evaluated(along(f), X, DIRECTION) for f in (lambda x: written(x)[0], FUNCTIONS[name]))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-14, atol=1e-15)
    np.testing.assert_allclose(found[1], expected[1], rtol=1e-13, atol=1e-14)


def test_zeros_and_ones_leave_no_trace():
    """A diagonal product has one multiplication per entry that is neither 0 nor 1; a full one has all of them."""
    diagonal = operations(numbers(lambda x: jnp.diag(jnp.array([2.0, 0.0, 1.0, 3.0])) @ x, X))
    assert diagonal["mul"] == 2 and diagonal["add"] == 0
    full = operations(numbers(lambda x: (MATRIX + 2) @ x, X))
    assert full["mul"] == 12 and full["add"] == 9


def test_the_same_is_written_once():
    """x y, y x and -x (-y) are one product; twins: other operands, the other order of a quotient."""

    def arithmetic(function):
        counts = operations(numbers(function, X))
        return {name: counts[name] for name in ("add", "sub", "mul", "div", "neg") if counts[name]}

    same = lambda x: jnp.stack([x[0] * x[1], x[1] * x[0], -x[0] * -x[1], x[2] - x[0] * -x[1], -x[0] * x[1] + x[3]])
    assert arithmetic(same) == {"mul": 1, "add": 1, "sub": 1}
    np.testing.assert_array_equal(run(numbers(same, X), X), evaluated(same, X))
    other = lambda x: jnp.stack([x[0] * x[1], x[0] * x[2], x[0] / x[1], x[1] / x[0], x[0] / x[1]])
    assert arithmetic(other) == {"mul": 2, "div": 2}
    # Not the same: a difference and its negative are zeros of different sign.
    opposite = lambda x: jnp.stack([x[0] - x[1], x[1] - x[0], 0.0, 0.0, 0.0])
    assert not np.signbit(run(numbers(opposite, X), np.ones(4))).any()


def test_two_stages():
    """Operations independent of the second argument are computed first, including inverses of divisors."""

    def function(p, x):
        return jnp.sin(p) * x / (p**2 + 1)

    first, then = staged(numbers(function, 0.7, 1.3), [0], [1])
    (found,) = evaluated(lambda p, x: then(first(p), x), 0.7, 1.3)
    np.testing.assert_allclose(found, np.sin(0.7) * 1.3 / (0.7**2 + 1), rtol=1e-15)
    late = jax.make_jaxpr(then)(jax.eval_shape(first, 0.7), 1.3)
    assert Counter(e.primitive.name for e in late.jaxpr.eqns)["mul"] == 2
    assert not {"sin", "div", "integer_pow"} & {e.primitive.name for e in late.jaxpr.eqns}


def test_integers_are_divided_as_integers():
    """Integer division of known numbers is exact: 29 by 10 is 2, and can be used as an index."""

    def function(n, x):
        count = (jnp.floor(x) + 29).astype(int)
        return x * lax.div(count, n) + jnp.asarray(X)[count // n]

    first, then = staged(numbers(function, 10, 0.7), [0], [1])
    assert evaluated(lambda n, x: then(first(n), x), 10, 0.7) == [0.7 * 2 + X[2]]


def test_what_becomes_too_long_is_left_early():
    """A sum over 200 nodes is 600 operations; known numbers count as none."""
    nodes = np.linspace(0.0, 1.0, 200)
    program = jax.make_jaxpr(lambda x: jnp.exp(nodes * x[0]) + jnp.square(nodes))(X)
    written = lambda most: jax.make_jaxpr(lambda x: written_out(program, x, most=most))(X)
    assert 600 <= len(written(650).jaxpr.eqns) <= 1200
    with pytest.raises(TooLong):
        written(550)


def test_programs_that_ask_for_nan_keep_their_meaning():
    """0 · ∞ is NaN where it is known or asked for; twin: elsewhere a product with a known zero leaves no trace."""
    asked = lambda x: jnp.nan_to_num(0.0 * (1 / (x - x)), nan=3.0)
    known = lambda x: x + jnp.dot(jnp.array([0.0, 1.0]), jnp.array([np.inf, 1.0]))
    compared = lambda x: jnp.where(jnp.isinf(1 / (0.0 * x)), 1.0, 2.0)
    dropped = lambda x: 0.0 * (1 / (x - x))
    for function, expected in ((asked, 3.0), (known, np.nan), (compared, 1.0)):
        np.testing.assert_array_equal([*run(numbers(function, 2.0), 2.0), *evaluated(function, 2.0)], expected)
    assert run(numbers(dropped, 2.0), 2.0) == [0.0] and np.isnan(evaluated(dropped, 2.0))
