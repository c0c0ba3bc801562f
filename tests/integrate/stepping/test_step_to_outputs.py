"""Outputs are ends of steps: they are exact, and cost only the steps that they shorten."""

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.stepping.step_to_outputs import WHOLE_STEPS, StepToOutputs
from tests.systems import PARAMS, pendulum


def run(ts, **options):
    """The pendulum over 8 units of time."""
    return lj.integrate(pendulum, 2.0, 0.0, PARAMS, ts=np.asarray(ts), rtol=1e-10, atol=1e-10, **options)


@pytest.mark.slow
def test_outputs_are_those_of_one_solve():
    """Twelve uneven outputs, two of them close together, agree with another method's; the first is the start."""
    ts = np.concatenate([[0.0, 1e-9], np.sort(np.random.default_rng(1).uniform(0.0, 8.0, 9)), [8.0]])
    found, exact = run(ts), run(ts, method=lj.Tsit5(), max_steps=2**22)
    np.testing.assert_allclose(found.q, exact.q, atol=3e-9)
    assert found.q[0] == 2.0


@pytest.mark.slow
def test_outputs_shorten_few_steps():
    """Each output adds at most one step, whether there are few or many of them."""
    steps = lambda count: int(run(np.linspace(0.0, 8.0, count)).stats["num_steps"])
    alone, few, many = steps(2), steps(6), steps(101)
    assert few <= alone + 5
    assert 100 <= many <= alone + 100


def test_the_size_proposed_before_is_kept():
    """After a step shortened to an output, the next one is as long as was proposed before."""
    controller = StepToOutputs(
        diffrax.PIDController(rtol=1e-6, atol=1e-6), jnp.array([0.0, 1.0, 1.001, 5.0]), jnp.array(WHOLE_STEPS)
    )
    before = jnp.asarray(0.4)
    state = (controller.controller.init(None, 0.0, 5.0, 1.0, 0.4, None, lambda *a: 0.0, 5)[1], jnp.asarray(2), before)
    keep, t0, t1, _, (_, index, proposed), _ = controller.adapt_step_size(
        1.0, 1.001, jnp.asarray(1.0), jnp.asarray(1.0), None, jnp.asarray(1e-9), 5, state
    )
    assert keep and index == 3 and proposed >= before
    np.testing.assert_allclose(t1 - t0, proposed)
    assert 10 * (1.001 - 1.0) < 0.05 * before  # what the shortened step alone would have allowed
