"""Many steps: controls held in each, the steps of a scan by hand with its gradients, lanes, dtypes, and memory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import lagjax as lj
from lagjax.steps.rollout import piece_length
from tests.systems import HORIZONTAL, PARAMS, rod_pendulum

cart = lj.System(
    lambda t, q, v, params: 0.5 * params["m"] * jnp.sum(v**2),
    force=lambda t, q, v, params: params["push"] * jnp.ones_like(q),
)
swing = lj.System(
    lambda t, q, v, params: 0.5 * params["m"] * v**2 + params["m"] * params["g"] * jnp.cos(q),
    force=lambda t, q, v, params: params["torque"],
)
SWING = {"m": 2.0, "g": 9.0}
TORQUES = np.random.default_rng(4).normal(size=53)


def by_hand(q, v, params, torques, dt):
    """The same motion by a scan of Kutta's method on the pendulum's equation."""

    def rate(y, u):
        return jnp.stack([y[1], u / params["m"] - params["g"] * jnp.sin(y[0])])

    def step(y, u):
        k1 = rate(y, u)
        k2 = rate(y + dt / 2 * k1, u)
        k3 = rate(y + dt / 2 * k2, u)
        k4 = rate(y + dt * k3, u)
        y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return y, y

    y0 = jnp.stack([q, v])
    return jnp.concatenate([y0[None], lax.scan(step, y0, torques)[1]])


def ours(q, v, params, torques, dt):
    """The same by `rollout`."""
    return jnp.stack(lj.rollout(swing, q, v, params, {"torque": torques}, dt)[1:], axis=1)


ARGUMENTS = (
    jnp.asarray(1.0),
    jnp.asarray(-0.5),
    jax.tree.map(jnp.asarray, SWING),
    jnp.asarray(TORQUES),
    jnp.asarray(0.05),
)


def close(a, b, rtol=1e-12):
    """Whether two trees of arrays agree, relative to the largest entry of each array."""
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.max(np.abs(y))), a, b)


def test_controls_are_held():
    """A pushed cart: each push lasts for its step; twin: shifted by one step it is another motion."""
    push, h = np.array([2.0, -1.0, 0.0, 4.0, 3.0]), 0.5
    t, q, v = lj.rollout(cart, 0.0, 1.0, {"m": 2.0}, {"push": push}, h, t0=3.0)
    rates = 1.0 + np.concatenate([[0.0], np.cumsum(push / 2.0 * h)])
    places = np.concatenate([[0.0], np.cumsum(h * (rates[:-1] + rates[1:]) / 2)])
    np.testing.assert_allclose(t, 3.0 + h * np.arange(6), rtol=1e-15)
    np.testing.assert_allclose(v, rates, rtol=1e-14)
    np.testing.assert_allclose(q, places, rtol=1e-14)
    assert np.max(np.abs(lj.rollout(cart, 0.0, 1.0, {"m": 2.0}, {"push": np.roll(push, 1)}, h)[2] - rates)) > 0.1


def test_the_scan_by_hand_and_its_gradients():
    """States, gradients by all arguments, and Jacobians in both modes, for a number of steps that leaves a rest."""
    assert -len(TORQUES) % piece_length(len(TORQUES)) != 0
    close(ours(*ARGUMENTS), by_hand(*ARGUMENTS))
    weights = jnp.asarray(np.random.default_rng(5).normal(size=(len(TORQUES) + 1, 2)))

    def loss(function):
        return lambda *arguments: jnp.sum(weights * function(*arguments))

    expected = jax.grad(loss(by_hand), (0, 1, 2, 3, 4))(*ARGUMENTS)
    close(jax.grad(loss(ours), (0, 1, 2, 3, 4))(*ARGUMENTS), expected, 1e-11)
    close(jax.jacfwd(ours, 3)(*ARGUMENTS), jax.jacfwd(by_hand, 3)(*ARGUMENTS), 1e-11)
    # Twin: the gradient of other weights is another one.
    assert np.max(np.abs(expected[3] - jax.grad(lambda *a: jnp.sum(by_hand(*a)), 3)(*ARGUMENTS))) > 1e-2


def test_steps_in_a_scan_of_the_user():
    """`step` in a scan, where the control is an entry of params: the same states and gradients."""

    def scanned(q, v, params, torques, dt):
        def one(state, u):
            state = lj.step(swing, *state, {**params, "torque": u}, dt)
            return state, jnp.stack(state[1:])

        start = jnp.zeros_like(q), q, v
        return jnp.concatenate([jnp.stack([q, v])[None], lax.scan(one, start, torques)[1]])

    few = (*ARGUMENTS[:3], ARGUMENTS[3][:4], ARGUMENTS[4])
    close(scanned(*few), ours(*few))
    gradients = [jax.grad(lambda *a, f=f: jnp.sum(f(*a) ** 2), (2, 3))(*few) for f in (scanned, by_hand)]
    close(*gradients)


def test_lanes_in_float32():
    """A batch in float32 is its motions one by one, with their gradients, in float32."""
    few = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (*ARGUMENTS[:3], ARGUMENTS[3][:12], ARGUMENTS[4]))
    starts = jnp.linspace(-1.0, 1.0, 5, dtype=jnp.float32)

    def lanes(function):
        return lambda *a: jax.vmap(function, (0, None, None, None, None))(starts, *a[1:])

    found = lanes(ours)(*few)
    assert found.dtype == jnp.float32
    close(found, lanes(by_hand)(*few), 1e-5)
    gradients = [jax.grad(lambda *a, f=f: jnp.sum(lanes(f)(*a) ** 2), (2, 3))(*few) for f in (ours, by_hand)]
    assert {x.dtype for x in jax.tree.leaves(gradients[0])} == {np.dtype("float32")}
    close(*gradients, 1e-4)


@pytest.mark.slow
def test_constraints_in_both_modes():
    """With a rod: at round-off in every state; the gradient is that of forward mode, and, to a step's error, of
    differences."""

    def end(g):
        _, q, v = lj.rollout(rod_pendulum, *HORIZONTAL, {**PARAMS, "g": g}, 30, 0.04)
        return q["x"][-1], (q, v)

    value, (q, v) = end(9.0)
    round_off = 16 * np.finfo(float).eps * PARAMS["l"] ** 2
    assert np.max(np.abs(q["x"] ** 2 + q["y"] ** 2 - PARAMS["l"] ** 2)) < round_off
    assert np.max(np.abs(q["x"] * v["x"] + q["y"] * v["y"])) < 8 * round_off
    slopes = [mode(lambda g: end(g)[0])(9.0) for mode in (jax.jacfwd, jax.jacrev)]
    np.testing.assert_allclose(*slopes, rtol=1e-11)
    # The derivative of the return to the rod leaves out that of its matrix, which is multiplied by a step's error.
    np.testing.assert_allclose(slopes[0], (end(9.0 + 1e-5)[0] - end(9.0 - 1e-5)[0]) / 2e-5, rtol=1e-4)


def test_a_control_law_of_the_users():
    """`with_control` makes the parameters: from an array of controls, with a gain that is differentiated."""

    def end(gain, form):
        if form == "law":
            law = lambda params, u: {**params, "push": gain * u[0]}
            return lj.rollout(cart, 0.0, 0.0, {"m": 1.0}, np.ones((4, 1)), 0.5, with_control=law)[1][-1]
        return lj.rollout(cart, 0.0, 0.0, {"m": 1.0}, {"push": gain * np.ones(4)}, 0.5)[1][-1]

    assert end(3.0, "law") == end(3.0, "names") == 6.0
    assert jax.grad(end)(3.0, "law") == 2.0


class Driven(eqx.Module):
    """Parameters that are no dict, with a function among them."""

    net: eqx.nn.MLP
    push: jax.Array


def test_modules_in_params():
    """A network in `params`, with its functions: the steps are those of `step` with such parameters."""
    net = eqx.nn.MLP(1, "scalar", 2, 1, activation=jnp.tanh, key=jax.random.key(0))
    system = lj.System(
        lambda t, q, v, params: 0.5 * v**2 - params.net(q[None]), force=lambda t, q, v, params: params.push
    )
    pushes, drive = jnp.array([1.0, -2.0]), lambda params, u: Driven(params.net, u)
    _, q, _ = lj.rollout(system, 0.1, 0.0, Driven(net, jnp.zeros(())), pushes, 0.5, with_control=drive)
    state = 0.0, 0.1, 0.0
    for push, found in zip(pushes, q[1:]):
        state = lj.step(system, *state, Driven(net, push), 0.5)
        np.testing.assert_allclose(found, state[1], rtol=1e-14)


def test_few_steps():
    """No step, one step, and the forms of a number of steps."""
    params = {"m": 1.0, "push": 2.0}
    assert [len(lj.rollout(cart, 0.0, 0.0, params, n, 1.0)[1]) for n in (0, 1, np.int64(2))] == [1, 2, 3]
    _, q, _ = lj.rollout(cart, np.zeros(3), np.zeros(3), params, 2, 1.0)
    np.testing.assert_allclose(q, np.outer([0.0, 1.0, 4.0], np.ones(3)), rtol=1e-15)


NOTES = np.arange(1.0, 65.0)
rippled = lj.System(
    lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: jnp.sum(jnp.sin(NOTES * q)) + params["push"]
)


@pytest.mark.slow
def test_memory_of_reverse_mode():
    """Of what a step needs, √N are kept: a fifth of the memory of a scan by hand, or less."""

    def by_hand(u):
        def one(y, u):
            for _ in range(4):
                y = (y[0] + 0.01 * y[1], y[1] + 0.01 * (jnp.sum(jnp.sin(NOTES * y[0])) + u))
            return y, None

        return lax.scan(one, (1.0, 0.0), u)[0][0]

    def ours(u):
        return lj.rollout(rippled, 1.0, 0.0, {}, {"push": u}, 0.01)[1][-1]

    def size(function):
        program = jax.jit(jax.grad(function)).lower(jnp.zeros(4096)).compile()
        return program.memory_analysis().temp_size_in_bytes

    assert size(ours) < size(by_hand) / 5


@pytest.mark.parametrize(
    ("controls", "error", "words"),
    [
        ({"pull": np.ones(3)}, ValueError, "nothing in the system reads the control 'pull'"),
        (np.ones(3), TypeError, "controls is no dict"),
        ({"push": 1.0}, ValueError, "one row for each step"),
        ({"push": np.ones(3), "m": np.ones(4)}, ValueError, "one row for each step"),
        ({}, ValueError, "one row for each step"),
        (1e3, ValueError, "1e3 steps, a float"),
        (-1, ValueError, "one row for each step"),
        ({"push": np.array(["a"])}, TypeError, "must be real numbers"),
    ],
)
def test_refused(controls, error, words):
    """Controls that are none, in words."""
    with pytest.raises(error, match=words):
        lj.rollout(cart, 0.0, 0.0, {"m": 1.0, "push": 0.0}, controls, 0.1)
