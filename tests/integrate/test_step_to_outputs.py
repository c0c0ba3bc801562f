"""Outputs are ends of steps: they are exact, and cost only the steps that they shorten."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.results import message
from lagjax.integrate.step_sizes import WHOLE_STEPS, StepToOutputs
from tests.by_hand import swing
from tests.systems import PARAMS, pendulum


def run(ts):
    """The pendulum over 8 units of time."""
    return lj.integrate(pendulum, 2.0, 0.0, PARAMS, ts=ts, rtol=1e-10)


def test_outputs_are_those_of_one_solve():
    """Eight uneven outputs, two of them close together, are on the exact motion; the first is the start."""
    ts = np.concatenate([[0.0, 1e-9], np.sort(np.random.default_rng(1).uniform(0.0, 8.0, 5)), [8.0]])
    found = np.asarray(run(ts).q)
    np.testing.assert_allclose(found, swing(ts, 2.0, np.sqrt(PARAMS["g"] / PARAMS["l"]))[0], atol=3e-9)
    assert found[0] == 2.0


@pytest.mark.parametrize("counts", [(2, 6), pytest.param((2, 6, 101), marks=pytest.mark.slow)])
def test_outputs_shorten_few_steps(counts):
    """Each output adds at most one step, whether there are few or many of them."""
    alone, *more = (int(run(np.linspace(0.0, 8.0, count)).stats["num_steps"]) for count in counts)
    for steps, count in zip(more, counts[1:]):
        assert count - 1 <= steps <= alone + count - 1


ONE = np.asarray(1.0)


def stepping(ts, **limits):
    """A controller that ends steps at `ts`, and its choice, compiled, after a step from t0 to t1 with some error."""
    pid = diffrax.PIDController(rtol=1e-6, atol=1e-6, **limits)
    controller = StepToOutputs(pid, jnp.array(ts), jnp.array(WHOLE_STEPS))
    choose = lambda t0, t1, error, state: controller.adapt_step_size(t0, t1, ONE, ONE, None, error, 5, state)
    return controller, jax.jit(choose)


def test_the_size_proposed_before_is_kept():
    """After a step shortened to an output, the next one is as long as was proposed before."""
    (controller, choose), before = stepping([0.0, 1.0, 1.001, 5.0]), 0.4
    inner = controller.controller.init(None, 0.0, 5.0, 1.0, 0.4, None, lambda *a: 0.0, 5)[1]
    state = inner, np.asarray(2), np.asarray(before), np.asarray(0)
    keep, t0, t1, _, (_, index, proposed, _), _ = choose(*map(np.asarray, (1.0, 1.001, 1e-9)), state)
    assert keep and index == 3 and proposed >= before
    np.testing.assert_allclose(np.asarray(t1) - np.asarray(t0), proposed)
    assert 10 * (1.001 - 1.0) < 0.05 * before  # what the shortened step alone would have allowed


@pytest.mark.parametrize("first", [1.5e-3, 0.9e-3])
def test_a_rejected_step_is_not_tried_again(first):
    """Steps between one and two least steps that are rejected shrink until the least step ends the motion."""
    controller, choose = stepping([0.0, 5.0], dtmin=1e-3, force_dtmin=False)
    begin = jax.jit(lambda dt0: controller.init(None, jnp.zeros(()), 5.0, ONE, dt0, None, lambda *a: 0.0, 5))
    (t1, state), result = begin(first), None
    for _ in range(20):
        keep, _, t1, _, state, result = choose(np.asarray(0.0), t1, np.asarray(2e-6 * 1.01), state)
        assert not keep
        if result == diffrax.RESULTS.dt_min_reached:
            break
    assert result == diffrax.RESULTS.dt_min_reached and t1 < first


# Oscillations faster and faster: infinitely many before t = 1.
ENDLESS = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2 / (1 - t) ** (2 * params))


@pytest.mark.slow
def test_steps_that_have_collapsed_end_a_motion():
    """A lane that does not arrive ends within 10,000 steps, and says it; the lane beside it, and alone, arrives."""
    ts = np.linspace(0.0, 10.0, 11)
    both = jax.jit(jax.vmap(lambda p: lj.integrate(ENDLESS, 1.0, 0.0, p, ts=ts, rtol=1e-5, throw=False)))
    found = both(jnp.array([2.0, 0.0]))
    assert [int(code) for code in found.result._value] == [int(lj.RESULTS.no_progress._value), 0]
    assert found.stats["num_steps"][0] < 10_000 and 0.99 < found.end.t[0] < 1.0
    np.testing.assert_allclose(found.q[1], np.cos(ts), atol=1e-3)
    assert "a hundred times max_steps would not be enough" in message(lj.RESULTS.no_progress)


@pytest.mark.exhaustive
def test_long_honest_motions_go_on():
    """Steps that stay short for long, but arrive: strong damping by an explicit method, at the edge of its stability;
    outputs that crowd together over twelve decades; a comet that passes its sun at 2e-6, there and back."""
    damped = lj.System(lambda t, q, v, p: 0.5 * v**2 - q, dissipation=lambda t, q, v, p: 0.5 * 2e4 * v**2)
    end = lj.integrate(damped, 0.0, 0.0, ts=np.array([0.0, 10.0]), rtol=1e-6, estimate_error=False)
    assert end.stats["num_steps"] > 20_000
    np.testing.assert_allclose(end.v[-1], -1 / 2e4, rtol=1e-3)
    ts = np.concatenate([[0.0], np.logspace(-9, 3, 24_000)])
    found = lj.integrate(pendulum, 1e-3, 0.0, PARAMS, ts=ts, estimate_error=False)
    assert found.result == lj.RESULTS.successful
    comet = lj.System(lambda t, q, v, p: 0.5 * v @ v + 1 / jnp.sqrt(q @ q))
    far, speed = np.array([2.0, 0.0]), np.array([0.0, np.sqrt(1e-6)])
    back = lj.integrate(comet, far, speed, ts=np.array([0.0, 2 * np.pi]), max_steps=2**14, estimate_error=False)
    np.testing.assert_allclose(back.q[-1], far, atol=1e-4)
