"""Programs with the same meaning are equal, whatever objects they consist of; others are not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from lagjax.jaxtools.identity import (
    Itself,
    content_of,
    meaning_of,
    rule_follows,
    rules_of,
    with_own_constants,
    without_repeats,
)
from lagjax.jaxtools.jaxpr import callbacks_in_turn
from tests.jaxtools.in_numpy import evaluated, run

TABLE = np.arange(300.0)


def meaning(function, *args):
    """The meaning of a function at some arguments, with the content of its constants."""
    closed = jax.make_jaxpr(function)(*(args or (1.0,)))
    return meaning_of(closed.jaxpr), tuple(map(content_of, closed.consts))


def scaled(factor):
    """A function that is made anew at each call, with a function and a loop inside."""
    inner = jax.jit(lambda x: jnp.sin(x) * factor)
    return lambda x: jax.lax.fori_loop(0, 3, lambda _, x: inner(x), x)


def test_the_same_again():
    """Functions made anew with the same numbers are equal, and so are their hashes."""
    assert meaning(scaled(2.0)) == meaning(scaled(2.0)) and hash(meaning(scaled(2.0))) == hash(meaning(scaled(2.0)))
    assert meaning(lambda x: x + TABLE) == meaning(lambda x: x + TABLE.copy())


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (scaled(2.0), scaled(3.0)),
        (lambda x: x - 1.0, lambda x: 1.0 - x),
        (lambda x: x * 0.0, lambda x: x * -0.0),
        (lambda x: x + TABLE, lambda x: x + TABLE[::-1]),
        (lambda x: (x, 2 * x), lambda x: (2 * x, x)),
        (lambda x: jnp.sum(x * jnp.ones((2, 3)), axis=0), lambda x: jnp.sum(x * jnp.ones((2, 3)), axis=1)),
    ],
    ids=["number", "order", "sign of zero", "table", "results", "axis"],
)
def test_others_differ(one, other):
    """Twins: another number, order, sign of zero, table, order of results, or parameter of a primitive."""
    assert meaning(one) != meaning(other)


def test_types_count():
    """1 is not True, and single precision is not double."""
    assert content_of(1) != content_of(True) and content_of(np.float32(1.0)) != content_of(1.0)
    assert meaning(lambda x: 2 * x, 1.0) != meaning(lambda x: 2 * x, np.float32(1.0))
    assert Itself(TABLE) == Itself(TABLE) != Itself(TABLE.copy())


def test_constants_of_inner_functions_become_its_own():
    """An array that a function inside holds is then a constant of the program, which computes the same."""
    inner = jax.jit(lambda x: x + TABLE)
    own = with_own_constants(jax.make_jaxpr(lambda x: 2 * inner(x))(1.0))
    assert any(np.array_equal(x, TABLE) for x in own.consts)
    np.testing.assert_array_equal(run(own, 1.0)[0], 2 * (1.0 + TABLE))


def with_rule(slope):
    """x², with a rule of its own for the derivative."""
    square = jax.custom_jvp(lambda x: x * x)
    square.defjvps(lambda dx, value, x: slope(x) * dx)
    return square


def test_rules_that_follow_do_not_count():
    """A function whose rule follows from the program has it, and none that is compared; another's is compared."""

    def twice(kind):
        function = kind(lambda x: 1.0 * x)
        function.defjvp(lambda primals, tangents: (primals[0], 2 * tangents[0]))
        return function

    known, other = twice(rule_follows), twice(jax.custom_jvp)
    assert evaluated(jax.grad(known), 1.0) == [2.0]
    assert rules_of(known, jax.make_jaxpr(known)(1.0), 1.0) == ()
    assert rules_of(other, jax.make_jaxpr(other)(1.0), 1.0) != ()


def test_rules_of_differentiation_count():
    """Equal values with other rules are told apart by `rules_of` alone; without rules there is nothing to compare."""
    right, wrong = with_rule(lambda x: 2 * x), with_rule(lambda x: 3 * x)
    rules = lambda function: rules_of(function, jax.make_jaxpr(function)(1.0), 1.0)
    assert meaning(right) == meaning(wrong) and rules(right) != rules(wrong)
    assert rules(right) == rules(with_rule(lambda x: 2 * x)) and rules(jnp.sin) == ()


def on_host(function):
    """A function of the host's, which JAX cannot differentiate."""
    shape = jax.ShapeDtypeStruct((), float)
    return lambda x: jax.pure_callback(lambda x: np.asarray(function(x)), shape, x)


def with_slope(function, slope):
    """A function of the host's with its own derivative, which is of the host's too."""
    known = jax.custom_jvp(on_host(function))
    known.defjvp(lambda primals, tangents: (known(primals[0]), tangents[0] * on_host(slope)(primals[0])))
    return known


def test_rules_without_a_derivative_of_their_own():
    """A rule that calls the host has no second derivative, and one beside a loop none in reverse: nothing is refused,
    and functions are told apart."""
    half, other = with_slope(lambda x: x / 2, lambda x: 0.5), with_slope(lambda x: x / 2, lambda x: 0.7)
    rules = lambda function, user: rules_of(function, jax.make_jaxpr(function)(1.0), 1.0, user=user)
    assert rules(half, half) == rules(lambda x: half(x), half) != rules(other, other)

    def beside_a_loop(function):
        shrunk = lambda x: jax.lax.while_loop(lambda c: c > 2.0, lambda c: c / 2, x)
        return lambda x: function(x) + shrunk(x)

    relu = rules(beside_a_loop(jax.nn.relu), None)
    assert relu == rules(beside_a_loop(jax.nn.relu), None) != rules(beside_a_loop(jax.nn.softplus), None)


def test_callbacks_in_lanes():
    """A callback that does not say how it is put in lanes is called for one after the other; twin: JAX refuses."""
    function = lambda x: jax.lax.cond(x > 0, on_host(lambda x: x / 2), jnp.negative, x)
    lanes, closed = np.array([4.0, -1.0]), jax.make_jaxpr(function)(1.0)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jaxpr_as_fun(callbacks_in_turn(closed))))(lanes)[0], [2.0, 1.0])
    with pytest.raises(NotImplementedError, match="vmap is only supported"):
        jax.make_jaxpr(jax.vmap(jaxpr_as_fun(closed)))(lanes)


def repeated(q):
    """Sums of squares of partial sums, each built anew: the double loop of a chain."""
    total = 0.0
    for i in range(len(q)):
        partial_sum = 0.0
        for j in range(i + 1):
            partial_sum = partial_sum + jnp.where(q[j] > 0, jnp.cos(q[j]), 1.0)
        total = total + partial_sum**2
    return total


def test_repeats_are_written_once():
    """A double loop has as many operations as a single one, and gives the same bits; derivatives differ by round-off,
    as they are summed in another order."""
    q = np.linspace(-0.3, 1.2, 5)
    closed = jax.make_jaxpr(repeated)(q)
    short = closed.replace(jaxpr=without_repeats(closed.jaxpr))
    assert len(closed.eqns) > 15 * 5 and len(short.eqns) < 5 * 9
    assert run(short, q) == run(closed, q)
    for order in (jax.grad, lambda f: jax.jacfwd(jax.grad(f))):
        again, expected = (evaluated(order(f), q) for f in (lambda q: jaxpr_as_fun(short)(q)[0], repeated))
        np.testing.assert_allclose(again, expected, rtol=1e-13, atol=1e-13)


@jax.custom_jvp
def bent(x):
    """A square whose rule of differentiation says 5."""
    return x**2


@jax.custom_jvp
def bent_otherwise(x):
    """The same with 7."""
    return x**2


bent.defjvp(lambda x, dx: (bent(*x), 5.0 * dx[0]))
bent_otherwise.defjvp(lambda x, dx: (bent_otherwise(*x), 7.0 * dx[0]))


@pytest.mark.parametrize(
    "function",
    [
        lambda x: jnp.arctan2(x * 0.0, -1.0) - jnp.arctan2(x * -0.0, -1.0),
        lambda x: bent(x) + bent_otherwise(x),
        lambda x: jax.jit(lambda y: bent(y))(x) + jax.jit(lambda y: bent_otherwise(y))(x),
        lambda x: (x / 7).astype(jnp.float32).astype(float) - 2 * (x / 7).astype(jnp.float16).astype(float),
        lambda x: x**2 - 2 * x**3,
    ],
    ids=["signs of zero", "rules", "rules inside", "dtypes", "parameters"],
)
def test_what_differs_is_not_a_repeat(function):
    """Zeros of other signs, rules of differentiation, dtypes and parameters keep operations apart."""
    closed = jax.make_jaxpr(function)(1.5)
    short = closed.replace(jaxpr=without_repeats(closed.jaxpr))
    value_and_slope = lambda f: evaluated(jax.value_and_grad(f), 1.5)
    assert value_and_slope(lambda x: jaxpr_as_fun(short)(x)[0]) == value_and_slope(function)
