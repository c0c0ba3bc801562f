"""Programs as data: long chains of one call become loops."""

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import jaxpr_as_fun

from lagjax.jax_internals.programs import length, without_chains


def below(x, count=100):
    """The floating number so many places below x, times a number that is used before the end, too."""
    for _ in range(count):
        x = eqxi.prevbefore(x)
    return x


@jax.jit
def inside(x):
    """The chain in a function and in a loop."""
    return jax.lax.fori_loop(0, 2, lambda _, x: below(x, 50), x)


@pytest.mark.parametrize("function", [below, inside])
def test_a_chain_becomes_a_loop(function):
    """The same number and derivative, from a program of a tenth the length."""
    program = jax.make_jaxpr(function)(1.0)
    looped = without_chains(program)
    assert length(looped.jaxpr) < 0.2 * length(program.jaxpr)
    x = jnp.asarray(3.7)
    (found,), (slope,) = jax.jvp(lambda x: jaxpr_as_fun(looped)(x), (x,), (jnp.ones_like(x),))
    assert found == np.float64(3.7) - 100 * np.spacing(np.float64(3.0))
    assert slope == 1.0


def test_what_is_no_chain_stays():
    """Short ones, those of other calls, and those whose members are used."""

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
