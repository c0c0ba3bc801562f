"""Reports on the integrations inside programs."""

import jax
import jax.numpy as jnp
import pytest

import lagjax as lj
from lagjax.integrate.solve.harvest import reporting
from tests.sweep.test_sweep import swing


@pytest.mark.exhaustive
def test_reports_are_found_in_every_kind_of_program():
    """Reports are found in plain, jitted, differentiated and batched programs; the worst of several counts."""
    program = lambda wrap: jax.jit(reporting(lambda point: wrap(lambda g: swing({"g": g, "angle": 1.0}).q[-1])(point)))
    _, alone, _ = program(lambda f: f)(4.0)
    assert int(alone.steps) > 0
    for wrap in (jax.jit, jax.grad, lambda f: jax.jit(jax.jit(f)), jax.value_and_grad):
        assert int(program(wrap)(4.0)[1].steps) == int(alone.steps)
    twice = program(lambda f: lambda g: f(g) + f(g))(4.0)[1]
    assert int(twice.steps) == 2 * int(alone.steps)
    some = program(lambda f: lambda g: jax.vmap(f)(jnp.array([g, jnp.nan])))(4.0)[1]
    assert int(some.result) == int(lj.RESULTS.start_not_finite._value)
    assert jax.jit(reporting(lambda x: 2 * x))(1.0)[1] is None
