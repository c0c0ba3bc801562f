"""Coordinates of first order: states and damped coordinates against closed forms, SciPy and eigenvalues."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import lagjax as lj
from lagjax.mechanics import diagnosis, with_first_order
from lagjax.mechanics.lagrangian import is_determined, of_states, resolved
from lagjax.system import coordinates, model_of
from tests.jaxtools.in_numpy import accelerations, in_numpy

ONE = np.array([0.0, 1.0])


def oscillator(t, q, v, params):
    """A mass on a spring."""
    return 0.5 * v["x"] ** 2 - 0.5 * q["x"] ** 2


def cost(t, q, v, params):
    """The square of the speed."""
    return v["x"] ** 2


SWING = {"x": 1.0, "c": 0.0}, {"x": 0.0}
costly = lj.System(oscillator, states={"c": cost})


def spent(t):
    """The integral of sin² until t."""
    return 0.5 * (t - 0.5 * np.sin(2.0 * t))


@pytest.mark.slow
def test_a_running_cost():
    """c' = v² of cos t, to 1e-12; its rate is the velocity of c, at every output. Twin: the cost of another speed."""
    ts = np.linspace(0.0, 20.0, 9)
    motion = lj.integrate(costly, *SWING, ts=ts, rtol=1e-12)
    np.testing.assert_allclose(motion.q["c"], spent(ts), atol=1e-12)
    np.testing.assert_allclose(motion.v["c"], motion.v["x"] ** 2, atol=0.0, rtol=1e-15)
    assert np.max(np.abs(motion.q["c"] - 0.5 * (ts - 0.5 * np.sin(2.1 * ts)))) > 0.1


def first_order(system, x, u, params):
    """The model of a system, in which coordinates of first order are known, and a state as it takes it."""
    like = {"x": 0.0, "c": 0.0} if system is costly else np.zeros(len(x))
    model = with_first_order(model_of(system, *coordinates.state(0.0, like, like, params)))
    return model, (np.array(0.0), np.array(x), np.array(u))


def velocities(system, x, u, params):
    """The velocities that follow from a state."""
    model, state = first_order(system, x, u, params)
    return in_numpy(lambda *state: resolved(model, *state))(*state)


def test_its_acceleration_at_one_state():
    """dv²/dt = 2 v a. Twin: the velocity given for the state does not count."""
    q, v = {"x": 0.5, "c": 7.0}, {"x": 3.0}
    for given in (v | {"c": 0.0}, v | {"c": 100.0}):
        a, multipliers = accelerations(costly, 0.0, q, given, None)
        np.testing.assert_allclose([a["x"], a["c"]], [-0.5, -3.0], rtol=1e-15)
        assert not multipliers
    np.testing.assert_allclose(velocities(costly, [7.0, 0.5], [100.0, 3.0], None), [9.0, 3.0])


@pytest.mark.exhaustive
def test_backward_and_in_steps():
    """The same cost backward in time, between outputs, and by steps of a fixed length."""
    backward = lj.integrate(costly, *SWING, ts=np.array([3.0, 0.0]))
    np.testing.assert_allclose([backward.q["c"][-1], backward.v["c"][0]], [-spent(3.0), 0.0], atol=1e-9)
    np.testing.assert_allclose(backward.at(1.3).q["c"], -spent(1.7), rtol=1e-8)
    _, q, v = lj.rollout(costly, *SWING, None, 300, 0.01)
    np.testing.assert_allclose(q["c"][-1], spent(3.0), rtol=1e-8)
    np.testing.assert_allclose(v["c"], v["x"] ** 2, rtol=1e-15)


@pytest.mark.exhaustive
def test_in_lanes_and_in_float32():
    """Lanes of different starts, and single precision in and out."""
    ts = np.linspace(0.0, 3.0, 4)

    def end(x):
        return lj.integrate(costly, {"x": x, "c": 0.0}, {"x": 0.0}, ts=ts).q["c"][-1]

    ends = jax.vmap(end)(jnp.arange(1.0, 4.0))
    np.testing.assert_allclose(ends, spent(3.0) * np.arange(1.0, 4.0) ** 2, rtol=1e-9)
    single = jax.tree.map(np.float32, SWING)
    motion = lj.integrate(costly, *single, ts=ts)
    assert motion.q["c"].dtype == motion.v["c"].dtype == np.float32
    np.testing.assert_allclose(motion.q["c"], spent(ts), atol=1e-5)


@pytest.mark.exhaustive
def test_an_event_that_reads_a_state():
    """c reaches 1 at spent(t) = 1; its derivative by the amplitude, forward and in reverse, is that of the formula."""
    spends = {"spent": lj.Crossing(lambda t, q, v, p: q["c"] - 1.0, terminal=True)}

    def when(x):
        return lj.integrate(costly, {"x": x, "c": 0.0}, {"x": 0.0}, ts=np.array([0.0, 9.0]), events=spends).end.t

    t, reverse = jax.value_and_grad(when)(1.0)
    assert abs(spent(t) - 1.0) < 1e-9
    # x² spent(t) = 1: dt/dx = -2 spent / sin² t at x = 1.
    np.testing.assert_allclose([reverse, jax.jacfwd(when)(1.0)], -2.0 / np.sin(t) ** 2, rtol=1e-7)


@pytest.mark.exhaustive
def test_derivatives_of_a_cost():
    """In reverse, by replay: the cost of a spring by forty numbers, whose sum is the square of its rate."""
    spring = lj.System(lambda t, q, v, p: 0.5 * v["x"] ** 2 - 0.5 * jnp.sum(p) * q["x"] ** 2, states={"c": cost})
    # The integral of w² sin² w t.
    exact = lambda p: 0.5 * (jnp.sum(p) * 3.0 - 0.5 * jnp.sqrt(jnp.sum(p)) * jnp.sin(6.0 * jnp.sqrt(jnp.sum(p))))
    found = lambda p: lj.integrate(spring, *SWING, p, ts=np.array([0.0, 3.0]), rtol=1e-11).q["c"][-1]
    p = jnp.linspace(0.01, 0.05, 40)
    np.testing.assert_allclose(jax.grad(found)(p), jax.grad(exact)(p), rtol=1e-7)


# c' = 1, and from p on -2.
relay = lj.System(oscillator, states={"c": lambda t, q, v, p: jnp.where(t < p, 1.0, -2.0)})


@pytest.mark.exhaustive
def test_a_relay_is_followed():
    """A rate that jumps, found in its program: exact, with its derivative."""

    def end(p):
        return lj.integrate(relay, *SWING, p, ts=ONE).q["c"][-1]

    np.testing.assert_allclose(jax.value_and_grad(end)(0.55), [0.55 - 0.9, 3.0], rtol=1e-12)


@pytest.mark.slow
def test_a_jump_that_is_not_followed_is_in_the_error():
    """With jumps="ignored" the step control sees it; twin: the accelerations alone, which do not jump, would not."""
    motion = lj.integrate(relay, *SWING, 0.55, ts=ONE, jumps="ignored")
    np.testing.assert_allclose(motion.q["c"][-1], 0.55 - 0.9, rtol=1e-7)
    assert motion.stats["num_rejected_steps"] > 5


def spring(t, q, v, k):
    """A spring alone."""
    return -0.5 * k * q**2


alone = lj.System(spring, dissipation=lambda t, q, v, k: 0.5 * 3.0 * v**2)


@pytest.mark.exhaustive
def test_a_massless_point_between_spring_and_damper():
    """c s' = -k s: an exponential, whatever velocity is given, and its derivative by k, forward and in reverse.

    Twin: with a mass it is another motion.
    """

    def end(k):
        motion = lj.integrate(alone, 2.0, 50.0, k, ts=ONE)
        return motion.q[-1], motion.v

    (q, v), by_k = jax.value_and_grad(end, has_aux=True)(6.0)
    np.testing.assert_allclose([q, v[-1], v[0]], [2 * np.exp(-2.0), -4 * np.exp(-2.0), -4.0], rtol=1e-9)
    np.testing.assert_allclose([by_k, jax.jacfwd(lambda k: end(k)[0])(6.0)], -2 / 3 * np.exp(-2.0), rtol=1e-8)
    heavy = expm(np.array([[0.0, 1.0], [-6.0, -3.0]])) @ [2.0, -4.0]
    assert abs(heavy[0] - q) > 0.1


def maxwell(t, q, v, params):
    """A mass on a spring, one end of which, q[1], is held by a damper alone; and one of which, q[2], by another."""
    return 0.5 * v[0] ** 2 - 0.5 * params["k"] * ((q[0] - q[1]) ** 2 + (q[1] - q[2]) ** 2)


def dampers(t, q, v, params):
    """One to the wall at q[1], and one between the two massless points."""
    return 0.5 * params["c"] * (v[1] ** 2 + (v[1] - v[2]) ** 2)


chain = lj.System(maxwell, dissipation=dampers)
CHAIN = {"k": 4.0, "c": 1.5}


def chain_matrix(k, c):
    """(x, v, s, r)' by hand: the damping matrix c [[2, -1], [-1, 1]] has the inverse [[1, 1], [1, 2]] / c."""
    push = k * np.array([[1.0, -2.0, 1.0], [0.0, 1.0, -1.0]])
    slow = np.array([[1.0, 1.0], [1.0, 2.0]]) @ push / c
    x = [0.0, 1.0, 0.0, 0.0], [-k, 0.0, k, 0.0]
    return np.array([*x, *([row[0], 0.0, row[1], row[2]] for row in slow)])


def test_rates_of_maxwells_element():
    """Velocities of the points and the acceleration of the mass are those of the matrix, whatever velocity is given."""
    q, v = np.array([1.0, 0.5, -0.3]), np.array([0.7, 50.0, 9.0])
    rate = chain_matrix(**CHAIN) @ [q[0], v[0], *q[1:]]
    np.testing.assert_allclose(velocities(chain, q, v, CHAIN), [v[0], *rate[2:]], rtol=1e-13)
    # The massless points' accelerations are the rates of their velocities.
    second = chain_matrix(**CHAIN) @ rate
    np.testing.assert_allclose(accelerations(chain, 0.0, q, v, CHAIN)[0], [rate[1], *second[2:]], rtol=1e-13)
    assert np.max(np.abs(chain_matrix(k=4.0, c=3.0) @ [q[0], v[0], *q[1:]] - rate)) > 0.1


@pytest.mark.slow
def test_a_damped_chain():
    """Two damped points, which move each other, and a mass: the matrix exponential; what the dampers take away is what
    the chain loses. A state in L gives and takes energy too."""
    motion = lj.integrate(chain, np.array([1.0, 0.5, -0.3]), np.zeros(3), CHAIN, ts=ONE, estimate_error=False)
    right, twin = (expm(chain_matrix(4.0, c)) @ [1.0, 0.0, 0.5, -0.3] for c in (1.5, 3.0))
    np.testing.assert_allclose([*motion.q[-1], motion.v[-1, 0]], right[[0, 2, 3, 1]], rtol=1e-9)
    assert np.max(np.abs(twin - right)) > 0.1
    ledger = lj.energy_ledger(motion)
    assert abs(ledger.closure[-1]) < 1e-9 and ledger.works["dissipation"].total[-1] < -0.1
    stiffening = lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2 - 0.5 * q["k"] * q["x"] ** 2,
        states={"k": lambda t, q, v, p: -q["k"] * v["x"]},
    )
    start = {"x": 1.0, "k": 2.0}, {"x": 0.0}
    motion = lj.integrate(stiffening, *start, ts=np.linspace(0.0, 3.0, 4), estimate_error=False)
    # k' = -k x': k = 2 exp(1 - x).
    np.testing.assert_allclose(motion.q["k"], 2 * np.exp(1 - motion.q["x"]), rtol=1e-9)
    ledger = lj.energy_ledger(motion)
    assert abs(ledger.closure[-1]) < 1e-8 and np.max(np.abs(ledger.works["states"].total)) > 0.1


def test_which_are_of_first_order():
    """The coordinates without a mass, and which are states; twins: a mass is neither, nor what a cubic damper holds."""
    for system, params, massless, states in ((costly, None, (), [True, False]), (chain, CHAIN, (1, 2), [False] * 3)):
        model, _ = first_order(system, np.zeros(len(states)), np.zeros(len(states)), params)
        assert model.form.first_order.massless == massless and list(of_states(model)) == states
    cubic = lj.System(spring, dissipation=lambda t, q, v, k: v**4)
    assert with_first_order(model_of(cubic, *coordinates.state(0.0, 1.0, 1.0, 1.0))).form.first_order is None


@pytest.mark.slow
def test_it_is_said():
    """What `explain` says of both kinds."""
    assert "c (state)" in str(lj.explain(costly, 0.0, *SWING, None))
    words = str(lj.explain(chain, 0.0, np.zeros(3), np.zeros(3), CHAIN))
    assert "q[1] (no mass), q[2] (no mass)" in words and "degrees of freedom  1" in words


def test_what_determines_velocities():
    """A damper of zero leaves them undetermined; twin: one above zero does not."""
    for c, expected in ((0.0, False), (1.5, True)):
        model, state = first_order(chain, np.ones(3), np.zeros(3), CHAIN | {"c": c})
        assert in_numpy(lambda *state: is_determined(model, *state))(*state) == expected


def test_no_damping_at_all(monkeypatch):
    """A damping of zero is said to leave velocities undetermined."""
    for name in ("is_determined", "balance_matrix"):
        of = getattr(diagnosis, name)
        monkeypatch.setattr(diagnosis, name, lambda model, *state, of=of: in_numpy(partial(of, model))(*state))
    s = coordinates.state(0.0, np.ones(3), np.zeros(3), CHAIN | {"c": 0.0})
    said = diagnosis.explain_undetermined(model_of(chain, *s), s)
    assert said is not None and re.search(r"(?s)'q\[1\]' and 'q\[2\]' are not determined.*damping above zero", said)


@pytest.mark.slow
def test_a_vector_of_states_beside_a_constraint():
    """A pendulum by a rod, with a filtered velocity fed back, against the angle's equation by SciPy. Twin: a lag."""
    rod = lj.Holonomic(lambda t, q, p: q["r"] @ q["r"] - 1.0)
    fed_back = lj.System(
        lambda t, q, v, p: 0.5 * v["r"] @ v["r"] - 9.81 * q["r"][1],
        {"rod": rod},
        force=lambda t, q, v, p: {"r": -0.5 * q["w"] - 0.1 * v["w"], "w": jnp.zeros(2)},
        states={"w": lambda t, q, v, lag: (v["r"] - q["w"]) / lag},
    )

    def rate(t, y, lag=0.3):
        angle, turning, *w = y
        along = np.array([np.cos(angle), np.sin(angle)])
        filtered = (turning * along - w) / lag
        return [turning, along @ (-0.5 * np.array(w) - 0.1 * filtered) - 9.81 * np.sin(angle), *filtered]

    start = [np.arctan2(0.6, 0.8), 0.0, 0.0, 0.0]
    right, twin = (
        solve_ivp(rate, (0, 3), start, "DOP853", args=a, rtol=1e-12, atol=1e-13).y[:, -1] for a in ((), (1.0,))
    )
    q0, v0 = {"r": np.array([0.6, -0.8]), "w": np.zeros(2)}, {"r": np.zeros(2)}
    motion = lj.integrate(fed_back, q0, v0, 0.3, ts=np.array([0.0, 3.0]))
    found = [*motion.q["r"][-1], *motion.q["w"][-1]]
    np.testing.assert_allclose(found, [np.sin(right[0]), -np.cos(right[0]), *right[2:]], atol=1e-9)
    assert abs(np.sin(twin[0]) - np.sin(right[0])) > 1e-2 and set(motion.multipliers) == {"rod"}
