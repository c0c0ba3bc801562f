"""Many steps: controls held in each, the steps of a loop by hand with its gradients, lanes, dtypes, and memory."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import flatten_util, lax

import lagjax as lj
from lagjax.steps import equations_for_steps
from lagjax.system import coordinates, model_of, traced_system
from tests.by_numpy import network
from tests.systems import HORIZONTAL, PARAMS, rod_pendulum

cart = lj.System(
    lambda t, q, v, params: 0.5 * params["m"] * jnp.sum(v**2),
    force=lambda t, q, v, params: params["push"] * jnp.ones_like(q),
)
swing = lj.System(
    lambda t, q, v, params: 0.5 * params["m"] * v**2 + params["m"] * params["g"] * jnp.cos(q),
    force=lambda t, q, v, params: params["torque"],
)
# q, v, params, torques, dt
TORQUES = np.random.default_rng(4).normal(size=53)
ARGUMENTS = 1.0, -0.5, {"m": 2.0, "g": 9.0}, TORQUES, 0.05
FEW = (*ARGUMENTS[:3], TORQUES[:4], 0.05)


def by_hand(q, v, params, torques, dt):
    """The same motion by Kutta's method on the pendulum's equation, in NumPy."""

    def rate(y, u):
        return np.stack([y[1], u / params["m"] - params["g"] * np.sin(y[0])])

    states = [np.stack([q, v])]
    for u in torques:
        y = states[-1]
        k1 = rate(y, u)
        k2 = rate(y + dt / 2 * k1, u)
        k3 = rate(y + dt / 2 * k2, u)
        k4 = rate(y + dt * k3, u)
        states.append(y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return np.stack(states)


def slopes_by_hand(arguments):
    """The derivatives of all states by all arguments (states, 2, argument), by complex steps."""
    flat, unflatten = flatten_util.ravel_pytree(arguments)
    lanes = np.asarray(flat)[:, None] + 1e-30j * np.eye(flat.size)
    leaves, structure = jax.tree.flatten(arguments)
    sizes = np.cumsum([np.size(x) for x in leaves])[:-1]
    parts = [part if np.ndim(x) else part[0] for x, part in zip(leaves, np.split(lanes, sizes))]
    return np.imag(by_hand(*jax.tree.unflatten(structure, parts))) / 1e-30


def ours(q, v, params, torques, dt):
    """The same by `rollout`."""
    return jnp.stack(lj.rollout(swing, q, v, params, {"torque": torques}, dt)[1:], axis=1)


def scanned(q, v, params, torques, dt):
    """The same by `step` in a scan, where the control is an entry of params."""

    def one(state, u):
        state = lj.step(swing, *state, {**params, "torque": u}, dt)
        return state, jnp.stack(state[1:])

    start = jnp.zeros_like(q), q, v
    return jnp.concatenate([jnp.stack([q, v])[None], lax.scan(one, start, torques)[1]])


def close(a, b, rtol=1e-12):
    """Whether two trees of arrays agree, relative to the largest entry of each array."""
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=rtol * np.max(np.abs(y))), a, b)


def test_controls_are_held():
    """A pushed cart: each push lasts for its step; twin: shifted by one step it is another motion."""
    push, h = np.array([2.0, -1.0, 0.0, 4.0]), 0.5
    t, q, v = lj.rollout(cart, 0.0, 1.0, {"m": 2.0}, {"push": push}, h, t0=3.0)
    rates = 1.0 + np.concatenate([[0.0], np.cumsum(push / 2.0 * h)])
    places = np.concatenate([[0.0], np.cumsum(h * (rates[:-1] + rates[1:]) / 2)])
    np.testing.assert_allclose(t, 3.0 + h * np.arange(5), rtol=1e-15)
    np.testing.assert_allclose(v, rates, rtol=1e-14)
    np.testing.assert_allclose(q, places, rtol=1e-14)
    other = lj.rollout(cart, 0.0, 1.0, {"m": 2.0}, {"push": np.roll(push, 1)}, h, t0=3.0)[2]
    assert np.max(np.abs(np.asarray(other) - rates)) > 0.1


@pytest.mark.parametrize(("function", "arguments"), [(ours, ARGUMENTS), (scanned, FEW)])
def test_the_loop_by_hand_and_its_gradients(function, arguments):
    """States, and gradients by all arguments, of `rollout` and of `step` in a user's scan."""
    arguments = jax.tree.map(np.asarray, arguments)
    count = len(arguments[3])
    weights = np.random.default_rng(5).normal(size=(count + 1, 2))

    def loss(*arguments):
        states = function(*arguments)
        return jnp.sum(weights * states), states

    slopes, states = jax.jit(jax.grad(loss, (0, 1, 2, 3, 4), has_aux=True))(*arguments)
    close(states, by_hand(*arguments))
    each = slopes_by_hand(arguments)
    close(flatten_util.ravel_pytree(slopes)[0], np.einsum("tik,ti->k", each, weights), 1e-11)
    # Twin: the gradient of other weights is another one.
    assert np.max(np.abs(np.sum(each, (0, 1)) - np.einsum("tik,ti->k", each, weights))) > 1e-2


@pytest.mark.slow
def test_jacobians_and_lanes_in_float32():
    """The Jacobian by torques in forward mode; and lanes in float32 are its motions, with gradients in float32."""
    close(jax.jacfwd(ours, 3)(*ARGUMENTS), slopes_by_hand(ARGUMENTS)[..., 4:-1], 1e-11)
    few = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), (*ARGUMENTS[:3], TORQUES[:12], 0.05))
    starts = np.linspace(-1.0, 1.0, 5, dtype=np.float32)

    def loss(starts, *others):
        states = jax.vmap(ours, (0, None, None, None, None))(starts, *others)
        return jnp.sum(states**2), states

    slopes, found = jax.jit(jax.grad(loss, (2, 3), has_aux=True))(starts, *few[1:])
    assert {x.dtype for x in jax.tree.leaves((found, slopes))} == {np.dtype("float32")}
    by_lane = [(q, *jax.tree.map(lambda x: np.asarray(x, float), few[1:])) for q in starts.astype(float)]
    states = np.stack([by_hand(*arguments) for arguments in by_lane])
    close(found, states, 1e-5)
    expected = np.sum([np.einsum("tik,ti->k", slopes_by_hand(a), 2 * y) for a, y in zip(by_lane, states)], axis=0)
    close((slopes[0]["g"], slopes[0]["m"], slopes[1]), (expected[2], expected[3], expected[4:-1]), 1e-4)


def test_float32_stays():
    """The states of a start in float32 are in float32."""
    single = jax.tree.map(np.float32, FEW)
    assert {x.dtype for x in jax.tree.leaves(jax.eval_shape(ours, *single))} == {np.dtype("float32")}


@pytest.mark.exhaustive
def test_constraints_in_both_modes():
    """With a rod: at round-off in every state; the gradient is that of forward mode, and, to a step's error, of
    differences."""

    def end(g):
        _, q, v = lj.rollout(rod_pendulum, *HORIZONTAL, {**PARAMS, "g": g}, 30, 0.04)
        return q["x"][-1], (q, v, q["x"][-1])

    forward, reverse = (jax.jit(mode(end, has_aux=True)) for mode in (jax.jacfwd, jax.jacrev))
    slope, (q, v, _) = forward(9.0)
    round_off = 16 * np.finfo(float).eps * PARAMS["l"] ** 2
    assert np.max(np.abs(q["x"] ** 2 + q["y"] ** 2 - PARAMS["l"] ** 2)) < round_off
    assert np.max(np.abs(q["x"] * v["x"] + q["y"] * v["y"])) < 8 * round_off
    np.testing.assert_allclose(slope, reverse(9.0)[0], rtol=1e-11)
    # The derivative of the return to the rod leaves out that of its matrix, which is multiplied by a step's error.
    above, below = (forward(9.0 + h)[1][2] for h in (1e-5, -1e-5))
    np.testing.assert_allclose(slope, (above - below) / 2e-5, rtol=1e-4)


def test_a_control_law_of_the_users():
    """`with_control` makes the parameters: from an array of controls, with a gain that is differentiated."""

    def end(gain):
        law = lambda params, u: {**params, "push": gain * u[0]}
        return lj.rollout(cart, 0.0, 0.0, {"m": 1.0}, np.ones((4, 1)), 0.5, with_control=law)[1][-1]

    np.testing.assert_allclose(jax.jit(jax.value_and_grad(end))(3.0), (6.0, 2.0), rtol=1e-14)


class Driven(eqx.Module):
    """Parameters that are no dict, with a function among them."""

    net: eqx.nn.MLP
    push: jax.Array


def test_modules_in_params():
    """A network in `params`, with its functions: the steps are those of `step` with such parameters."""
    net = network(1, "scalar", 2, 1, activation=jnp.tanh)
    system = lj.System(
        lambda t, q, v, params: 0.5 * v**2 - params.net(q[None]), force=lambda t, q, v, params: params.push
    )
    pushes, drive = np.array([1.0, -2.0]), lambda params, u: Driven(params.net, u)
    _, q, _ = lj.rollout(system, 0.1, 0.0, Driven(net, np.zeros(())), pushes, 0.5, with_control=drive)
    state = 0.0, 0.1, 0.0
    for push, found in zip(pushes, np.asarray(q)[1:]):
        state = lj.step(system, *state, Driven(net, np.asarray(push)), 0.5)
        np.testing.assert_allclose(found, state[1], rtol=1e-14)


def test_a_network_in_the_force():
    """Kutta's method in NumPy with the network's torque, which the equations, written out, take as an argument; twin:
    in L it is in the equations, which stay in arrays."""
    net = network(2, "scalar", 8, 2, activation=jnp.tanh)
    params = {"m": 2.0, "g": 9.0, "net": net}
    system = lj.System(swing.lagrangian, force=lambda t, q, v, params: params["net"](jnp.stack([q, v])))

    def torque(q, v):
        x = np.array([q, v])
        for layer in net.layers[:-1]:
            x = np.tanh(layer.weight @ x + layer.bias)
        return float((net.layers[-1].weight @ x + net.layers[-1].bias)[0])

    def rate(y):
        return np.array([y[1], torque(*y) / 2.0 - 9.0 * np.sin(y[0])])

    y, h = np.array([1.0, -0.5]), 0.05
    for _ in range(3):
        k1 = rate(y)
        k2 = rate(y + h / 2 * k1)
        k3 = rate(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(y + h * k3))
    _, q, v = lj.rollout(system, 1.0, -0.5, params, 3, h)
    np.testing.assert_allclose([q[-1], v[-1]], y, rtol=1e-13)

    def equations(system):
        s = coordinates.state(0.0, 1.0, -0.5, params)
        return equations_for_steps(model_of(traced_system(system, s), *s))

    inside = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["net"](jnp.stack([q, 0.0 * q])))
    assert equations(system).are_written and not equations(inside).are_written


def test_few_steps():
    """No step, one step, and the forms of a number of steps."""
    rolled = lambda q, count: lj.rollout(cart, q, 0.0 * q, {"m": 1.0, "push": 2.0}, count, 1.0)[1]
    assert [len(rolled(0.0, count)) for count in (0, 1)] == [1, 2]
    np.testing.assert_allclose(rolled(np.zeros(3), np.int64(2)), np.outer([0.0, 1.0, 4.0], np.ones(3)), rtol=1e-15)


NOTES = np.arange(1.0, 65.0)
rippled = lj.System(
    lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: jnp.sum(jnp.sin(NOTES * q)) + params["push"]
)


@pytest.mark.slow
def test_memory_of_reverse_mode():
    """Of all that steps need, only their states are kept: a fifth of the memory of a scan by hand, or less."""

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
