"""Messages when `max_steps` is used up or steps collapse: each cause by its own words, and none by another's."""

import re

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.systems import PARAMS, pendulum


def free(t, q, v, params):
    """A particle on a line."""
    return 0.5 * v**2


def spring(t, q, v, params):
    """A particle on a spring."""
    return 0.5 * v**2 - 0.5 * q**2


def stiff_rod(t, q, v, params):
    """A pendulum whose rod is a spring of 1e8."""
    length = jnp.sqrt(q["x"] ** 2 + q["y"] ** 2)
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 9.81 * q["y"] - 0.5e8 * (length - 1.0) ** 2


def force(function, lagrangian=free):
    """A system with a force."""
    return lj.System(lagrangian, force=function)


KINDS = {
    "friction": ("with the velocity", r"jnp.sign\(v\) in the force itself"),
    "sticking": ("it sticks", 'Fix: jumps="found"'),
    "switched": ("with the time", r"jump_ts=jnp.array"),
    "stop": ("with the position", 'jumps="found"'),
    "singularity": ("a singularity of the motion near", "softer potential"),
    "stiff": ("a stiff system", r"method=lj.Radau5\(\), whose"),
    "spring": ("a stiff spring", r"a constraint in place.*Radau5\(step_powers=\(0, 1\)\)"),
    "span": ("an oscillation of period 2.6", r"max_steps=\d+, or a looser rtol"),
}
CASES = {
    "dry friction that sticks": (
        force(lambda t, q, v, params: -2 * jnp.sign(v - 0.5)), (0.0, 1.0), 10.0, {"friction", "sticking"}),
    "a force that is switched": (
        force(lambda t, q, v, params: jnp.sign(jnp.sin(300 * t)), spring), (0.0, 1.0), 10.0, {"switched"}),
    "an end stop": (
        lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2 - 1e4 * jnp.maximum(-q, 0.0) ** 2), (1.0, 0.0), 400.0,
        {"stop"}),
    "a collision": (lj.System(lambda t, q, v, params: 0.5 * v**2 + 1 / q), (1.0, 0.0), 2.0, {"singularity"}),
    "strong damping": (
        lj.System(spring, dissipation=lambda t, q, v, params: 0.5e6 * v**2), (1.0, 0.0), 10.0, {"stiff"}),
    "a stiff spring": (
        lj.System(stiff_rod), ({"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}), 10.0, {"spring"}),
    "many periods": (pendulum, (1.0, 0.0), 3000.0, {"span"}),
    # Twins: what is smooth, does not decay, or stays away from its singularity gets another message.
    "friction with a slope": (
        force(lambda t, q, v, params: -2 * jnp.tanh((v - 0.5) / 0.5) - jnp.sin(4 * q)), (0.0, 1.0), 3000.0, set()),
    "a repulsion": (lj.System(lambda t, q, v, params: 0.5 * v**2 - 1 / q - 0.5 * q**2), (1.0, -3.0), 3000.0, set()),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_each_cause_is_told_apart(case):
    """The message has the words of the right cause with its remedy, and of no other."""
    system, start, span, kinds = CASES[case]
    params = PARAMS if system is pendulum else None
    limit = 90 if case == "a collision" else 500
    with pytest.raises(RuntimeError, match=f"max_steps = {limit} is used up") as raised:
        lj.integrate(system, *start, params, ts=np.array([0.0, span]), max_steps=limit, jumps="ignored")
    said = str(raised.value)
    found = {kind for kind, words in KINDS.items() if re.search(words[0], said)}
    assert found - {"span"} == kinds - {"span"}, said
    assert all(re.search(KINDS[kind][1], said) for kind in kinds), said


@pytest.mark.slow
@pytest.mark.parametrize("backward", (False, True))
def test_the_number_of_steps_is_the_one_that_is_missing(backward):
    """The advised max_steps suffices, and is less than three times what is needed; also backward in time."""
    ts = np.array([0.0, 300.0])
    run = lambda **options: lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=ts[::-1] if backward else ts, **options)
    with pytest.raises(RuntimeError, match="max_steps") as raised:
        run(max_steps=300)
    asked = int(re.findall(r"max_steps=(\d+)", str(raised.value))[0])
    taken = int(run().stats["num_steps"])
    assert taken <= asked <= 3 * taken


@pytest.mark.slow
def test_a_short_fixed_step():
    """The number of fixed steps is known: 10,000 of 0.01."""
    with pytest.raises(RuntimeError, match="it needs 9.8e\\+03 more"):
        lj.integrate(
            pendulum, 1.0, 0.0, PARAMS, ts=np.array([0.0, 100.0]), dt0=0.01, max_steps=200,
            stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip


@pytest.mark.slow
def test_the_advice_for_friction_helps():
    """With the jump found the block is caught by the belt, which moves at 0.5, and goes with it."""
    system = CASES["dry friction that sticks"][0]
    traj = lj.integrate(system, 0.0, 1.0, ts=np.array([0.0, 0.25, 10.0]))
    # From 1 to 0.5 at a deceleration of 2, and on at 0.5.
    np.testing.assert_allclose(traj.q, [0.0, 0.1875, 0.1875 + 9.75 * 0.5], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(traj.v[-1], 0.5, atol=1e-12)
    assert traj.stats["num_steps"] < 100


@pytest.mark.slow
def test_steps_that_collapse_at_a_singularity():
    """If steps collapse before max_steps, the singularity is named too."""
    kepler = lj.System(lambda t, q, v, params: 0.5 * v**2 + 1 / q)
    with pytest.raises(RuntimeError, match="near t = 1.1107"):
        lj.integrate(kepler, 1.0, 0.0, ts=np.array([0.0, 2.0]), method=lj.Dopri8())


@pytest.mark.exhaustive
def test_the_advice_for_a_stiff_spring_helps():
    """With `step_powers=(0, 1)` it moves as on a rod to 1e-5, in a fifth of the steps of `Radau5()`."""
    start, ts = ({"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}), np.array([0.0, 10.0])
    rigid = lj.integrate(pendulum, np.pi / 2, 0.0, {"g": 9.81, "l": 1.0}, ts=ts, rtol=1e-12, atol=1e-12).q[-1]
    run = lambda method, rtol: lj.integrate(lj.System(stiff_rod), *start, ts=ts, rtol=rtol, atol=rtol, method=method)
    advised, plain = run(lj.Radau5(step_powers=(0, 1)), 1e-6), run(lj.Radau5(), 1e-6)
    np.testing.assert_allclose([advised.q["x"][-1], advised.q["y"][-1]], [np.sin(rigid), -np.cos(rigid)], atol=2e-5)
    assert 5 * advised.stats["num_steps"] < plain.stats["num_steps"]
    assert 20 * advised.stats["num_steps"] < run(None, 1e-6).stats["num_steps"]
