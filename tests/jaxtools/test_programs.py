"""Programs as data: long chains of one call become loops."""

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from lagjax.jaxtools.jaxpr import anywhere, applied, interpreted, length, without_chains


def below(x, count=100):
    """The floating-point number that is `count` places below x."""
    for _ in range(count):
        x = eqxi.prevbefore(x)
    return x


@jax.jit
def inside(x):
    """The chain in a function and in a loop."""
    return jax.lax.fori_loop(0, 2, lambda _, x: below(x, 50), x)


@pytest.mark.parametrize("function", [below, inside])
def test_a_chain_becomes_a_loop(function):
    """The same number and derivative, from a program less than a fifth as long."""
    program = jax.make_jaxpr(function)(1.0)
    looped = without_chains(program)
    assert length(looped.jaxpr) < 0.2 * length(program.jaxpr)
    x = jnp.asarray(3.7)
    (found,), (slope,) = jax.jvp(lambda x: jaxpr_as_fun(looped)(x), (x,), (jnp.ones_like(x),))
    assert found == np.float64(3.7) - 100 * np.spacing(np.float64(3.0))
    assert slope == 1.0


def test_what_is_no_chain_stays():
    """Short chains, chains of different calls, and chains whose members are used elsewhere stay."""

    def used(x):
        every = [x]
        for _ in range(30):
            every.append(eqxi.prevbefore(every[-1]))
        return jnp.stack(every)

    def other(x):
        for _ in range(15):
            x = eqxi.nextafter(eqxi.prevbefore(x))
        return x

    for function in (lambda x: below(x, 15), used, other, lambda x: x):
        program = jax.make_jaxpr(function)(1.0)
        assert without_chains(program) is program


@jax.custom_jvp
def sine(x):
    """A call with a rule of its own."""
    return jnp.sin(x)


sine.defjvps(lambda dx, value, x: jnp.cos(x) * dx)
TABLE = np.arange(3.0)


def calls(x):
    """Calls of both kinds, one inside the other, a constant, and a loop, which is not a call."""
    inner = jax.jit(lambda x: sine(x) + TABLE)
    return inner(x) * 2.0, jax.lax.fori_loop(0, 3, lambda _, x: 2.0 * x, x)


def entered(enters=None):
    """The results of a program by `interpreted`, the primitives that it met, and JAX's results."""
    program, x, met = jax.make_jaxpr(calls)(jnp.ones(3)), jnp.array([0.1, 0.2, 0.3]), []

    def rule(equation, operands):
        met.append(equation.primitive.name)
        return applied(program.jaxpr, equation, operands)

    return interpreted(program, [x], rule, lambda x, aval: jnp.asarray(x, aval.dtype), enters), met, calls(x)


def test_a_program_is_interpreted():
    """With arrays as values it gives the program's results; calls are entered, a loop is one primitive."""
    found, met, expected = entered()
    np.testing.assert_allclose(found, expected, rtol=1e-15)
    assert {"sin", "add", "mul"} <= set(met) and not {"jit", "custom_jvp_call"} & set(met)
    assert {"scan", "while"} & set(met)


def test_calls_that_are_not_entered():
    """Twin: calls that are not entered stay primitives, which the rule evaluates."""
    _, met, _ = entered(lambda equation: equation.primitive.name == "jit")
    assert "custom_jvp_call" in met and "sin" not in met


def test_what_is_anywhere_in_a_program():
    """An equation inside a loop is found, and a program is looked through once; twin: none in another one."""
    looked_at = []
    has_sine = anywhere(lambda equation: looked_at.append(equation) or equation.primitive.name == "sin")
    looped = jax.make_jaxpr(lambda x: jax.lax.fori_loop(0, 3, lambda _, x: jnp.sin(x), x))(1.0).jaxpr
    for _ in range(2):
        assert has_sine(looped) and not has_sine(jax.make_jaxpr(jnp.cos)(1.0).jaxpr)
    seen = len(looked_at)
    assert seen >= 3 and has_sine(looped) and len(looked_at) == seen
