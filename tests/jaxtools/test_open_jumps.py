"""A program with the modes of its jumps given is the program itself, with its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.system import Given
from tests.integrate.test_jumps import JUMPING, jumps_of
from tests.jaxtools.in_numpy import run


@pytest.mark.parametrize("name", JUMPING)
def test_in_its_mode_a_force_is_itself(name):
    """At random states: value and derivatives in the state's own mode; guards above zero; a crossed one below.

    Twin: with another mode the value is another one.
    """
    force, rng, differs = JUMPING[name], np.random.default_rng(1), 0
    system, jumps = jumps_of(force)
    smooth_force, guards, beyond = jumps.smooth(system).force, jumps.numbers(system, 0), jumps.numbers(system, 1)
    assert smooth_force is not None

    def at(t, q, v, p):
        modes = jumps.modes(system, t, q, v, p)
        given = Given(p, modes, jnp.zeros(jumps.count, bool), jnp.asarray(False))
        crossed = [given._replace(modes=jnp.where(np.arange(jumps.count) == i, other(t, q, v, given), modes))
                   for i, other in enumerate(beyond)]  # fmt: skip
        for f, params in ((smooth_force, given), (force, p)):
            yield from jax.value_and_grad(lambda x: f(t, *x, params))((q, v))
        yield [guard(t, q, v, given) for guard in guards]
        yield [guard(t, q, v, of) for guard, of in zip(guards, crossed)]
        yield [smooth_force(t, q, v, of) for of in crossed]

    program = jax.make_jaxpr(lambda *state: list(at(*state)))(0.0, 0.0, 0.0, 0.3)
    for state in rng.uniform(-1.5, 1.5, (12, 3)):
        found = np.array(run(program, *state, 0.3))
        np.testing.assert_allclose(found[:3], found[3:6], rtol=1e-14, atol=1e-14)
        inside, outside, others = found[6:].reshape(3, -1)
        assert np.all(inside >= 0) and np.all(outside <= 0)
        differs += not np.allclose(others, found[0])
    assert differs > 0
