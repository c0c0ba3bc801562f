"""A motion that fails says where it stopped, why, and what to do; inside programs too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.behaviour.test_bad_input import refusal
from tests.systems import PARAMS, TS, pendulum


@pytest.mark.slow
def test_max_steps():
    """The message says where the motion stopped, after how many steps, how many are missing, and what to do."""
    with refusal(RuntimeError, "stopped at t = 0", "max_steps = 4", r"needs \d more", r"max_steps=\d+, or"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, max_steps=4)


def test_singularity_on_the_way():
    """A fall into the centre is reported with the state where it happened, not as `max_steps`."""
    kepler = lj.System(lambda t, q, v, params: 0.5 * v**2 + 1 / q)
    with refusal(RuntimeError, "stopped at t = 1.1107", "(singularity|not finite|L is)"):
        lj.integrate(kepler, 1.0, 0.0, ts=np.array([0.0, 2.0]))


def test_failure_under_jit_is_not_silent():
    """Inside jit a failed integration raises at run time; with throw=False it carries its result."""
    run = jax.jit(lambda q0, throw: lj.integrate(
        pendulum, q0, 0.0, PARAMS, ts=TS, throw=throw).result, static_argnums=1)  # fmt: skip
    with pytest.raises(RuntimeError, match="not finite"):
        jax.block_until_ready(run(jnp.nan, True))
    assert bool(run(jnp.nan, False) == lj.RESULTS.start_not_finite)
