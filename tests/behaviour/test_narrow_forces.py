"""Forces that act for a short time or over a short distance: `max_step` and `jump_ts`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.stepping import between_jumps, together
from tests.counting import compiles
from tests.tiers import exhaustive_but

# A push of 10 for a tenth of a unit of time: afterwards the velocity is 1.
START, STOP = 50.25, 50.35


def push(t, q, v, params):
    """A force of 10 between START and STOP."""
    return jnp.where((t >= START) & (t < STOP), 10.0, 0.0)


pushed = lj.System(lambda t, q, v, params: 0.5 * v**2, force=push)
CALM = np.array([0.0, 100.0])
AFTER = 0.05 + (100.0 - STOP)


def test_a_pulse():
    """Steps of a tenth of the span miss the pulse; steps limited by `max_step` meet it; `jump_ts` makes it exact."""

    def run(max_step=np.inf, jump_ts=(-3.0, -2.0, -1.0, 250.0)):
        limits = {"max_step": max_step, "jump_ts": list(jump_ts)}
        return lj.integrate(pushed, 0.0, 0.0, ts=CALM, jumps="ignored", estimate_error=False, **limits)

    missed = run()
    assert missed.q[-1] == 0.0 and missed.stats["num_steps"] < 10
    told = run(jump_ts=[STOP, START, -3.0, 250.0])
    np.testing.assert_allclose([told.q[-1], told.v[-1]], [AFTER, 1.0], rtol=1e-11)
    assert told.stats["num_steps"] < 12
    for limit in (0.05, 0.04):
        np.testing.assert_allclose(run(limit).q[-1], AFTER, rtol=1e-6)


@pytest.mark.slow
def test_another_limit_is_no_other_program():
    """The limit and the times of jumps are arguments of the compiled program, not parts of it."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2)
    counts = []
    for limit in (0.1, 0.2, 0.3):
        with compiles() as programs:
            lj.integrate(system, 1.0, 0.0, ts=CALM, max_step=limit, jump_ts=[limit, 1.0])
        counts.append(len(programs))
    assert counts[0] > 0 and counts[1:] == [0, 0]


@pytest.mark.slow
def test_a_barrier():
    """A barrier 0.001 wide that reflects: the default steps over it, `max_step` meets it."""
    barrier = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * jnp.exp(-(((q - 0.6) / 1e-3) ** 2)))
    run = lambda **limits: lj.integrate(barrier, 0.0, 1.0, ts=np.array([0.0, 1.0]), **limits)
    assert run().v[-1] == 1.0
    np.testing.assert_allclose(run(max_step=5e-4).v[-1], -1.0, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize("method", exhaustive_but((lj.Radau5,), (lj.Nystrom12, lj.Dopri8, lj.Tsit5, lj.Radau5)))
def test_outputs_at_and_beside_jumps(method):
    """Outputs at the jumps, within round-off of them, and between; each method restarts at a jump."""
    beside = np.nextafter(START, 100.0)
    ts = np.array([0.0, 10.0, START, beside, 50.3, STOP, 60.0, 100.0])
    traj = lj.integrate(pushed, 0.0, 0.0, ts=ts, jump_ts=[START, STOP], method=method())
    v = np.clip(10 * (ts - START), 0.0, 1.0)
    np.testing.assert_allclose(traj.v, v, atol=1e-11)
    np.testing.assert_allclose(traj.q, 0.05 * v**2 + np.maximum(ts - STOP, 0), atol=1e-9)
    assert traj.stats["num_steps"] < 30


@pytest.mark.exhaustive
def test_derivatives_by_the_time_of_a_jump():
    """A fall, and a force F from t_on: q(T) = v0 T - g/2 T² + F/2 (T - t_on)², differentiated in both modes.

    An output at the jump itself does not depend on the jump: its derivative is zero, as before the jump.
    """
    switched = lj.System(
        lambda t, q, v, params: 0.5 * v**2 - params["g"] * q,
        force=lambda t, q, v, params: jnp.where(t >= params["on"], params["F"], 0.0),
    )

    def states(params, outputs):
        traj = lj.integrate(switched, 0.0, 1.0, params, ts=outputs, jump_ts=[params["on"]])
        return jnp.stack([traj.q[1:], traj.v[1:]])

    params = {"on": 37.0, "F": 0.25, "g": 0.125}
    for outputs in (np.array([0.0, 20.0, 100.0]), np.array([0.0, 37.0, 100.0])):
        t = outputs[1:]
        after = np.array([0.0, 63.0])
        exact = {"on": [-0.25 * after, [0.0, -0.25]], "F": [0.5 * after**2, after], "g": [-0.5 * t**2, -t]}
        for derivative in (jax.jacrev, jax.jacfwd):
            found = derivative(states)(params, outputs)
            jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9), found, jax.tree.map(
                np.asarray, exact, is_leaf=lambda x: isinstance(x, list)))  # fmt: skip


def test_the_times_that_steps_end_at():
    """Jumps outside the span and repeated times are left out; a step next to a jump stays on its side of it."""
    ts, jump_ts = np.array([0.0, 1.0, 2.0]), np.array([1.5, 1.0, -1.0, 7.0])

    def ends(first, last):
        return together(ts, jump_ts), between_jumps(first, last, jump_ts, False)

    found, (t0, t1, made_jump) = jax.tree.map(np.asarray, jax.jit(ends)(1.0, 1.5))
    np.testing.assert_array_equal(found, [0.0, 1.0, 1.5, 2.0, 2.0, 2.0, 2.0])
    assert 1.0 < t0 < 1.0 + 1e-14 and 1.5 - 1e-14 < t1 < 1.5 and made_jump
    t0, t1, made_jump = jax.jit(ends)(0.5, 0.75)[1]
    assert (t0, t1) == (0.5, 0.75) and not made_jump
