"""Jumps and kinks in programs: which are found, the smooth functions of each mode, guards, times.

Motions that slide along a jump of their forces: dry friction, relays, blocks that are set free.
"""

from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from lagjax.integrate.jumps import found, with_jumps_in_time
from lagjax.system.coordinates import State
from lagjax.system.model import model_of
from tests.integrate.solve.test_over_jumps import GRAVITY, MASS, SPRING, kinetic

# The room hands out a function of this name.
legendre = import_module("lagjax.analysis.formulations")
KNOTS, HEIGHTS = np.array([-1.0, 0.0, 0.5, 2.0]), np.array([1.0, 0.0, -0.2, -3.0])
free = lambda t, q, v, params: 0.5 * v**2
JUMPING = {
    "where": lambda t, q, v, p: jnp.where(q > p, -3.0 * q, q**2),
    "opposite": lambda t, q, v, p: jnp.where(p <= q, 1.0, v),
    "sign": lambda t, q, v, p: -jnp.sign(v) * q,
    "abs": lambda t, q, v, p: v * jnp.abs(v - q),
    "maximum": lambda t, q, v, p: jnp.where(q > 0, -jnp.maximum(8 * q + v, 0.0), 0.0),
    "minimum": lambda t, q, v, p: jnp.minimum(q, v**2),
    "clip": lambda t, q, v, p: jnp.clip(3 * q, -p, p),
    "floor": lambda t, q, v, p: jnp.floor(2 * q) * v,
    "ceil": lambda t, q, v, p: jnp.ceil(q - v),
    "round": lambda t, q, v, p: jnp.round(5 * q),
    "remainder": lambda t, q, v, p: jnp.mod(q, 0.7),
    "whole": lambda t, q, v, p: (10 * q).astype(int) * 0.1,
    "table": lambda t, q, v, p: jnp.interp(q, KNOTS, HEIGHTS),
    "relu": lambda t, q, v, p: jax.nn.relu(q) - jax.nn.relu(-v),
    "cond": lambda t, q, v, p: jax.lax.cond(q > v, jnp.sin, jnp.cos, q),
    "heaviside": lambda t, q, v, p: jnp.heaviside(q, 0.5) * v,
    "moving edge": lambda t, q, v, p: jnp.where(q > jnp.sin(t), q, -v),
}


def jumps_of(force, params=0.3, lagrangian=free):
    """The system and its jumps."""
    system = lj.System(lagrangian, force=force)
    number = np.array(0.1)
    state = State(number, number, number, np.array(params))
    return system, found(model_of(system, *state), state)


def test_what_is_found():
    """One mode for each pair of numbers, whichever way and in which function they are compared; none that is decided.

    Twin: another pair is another mode.
    """
    friction = lambda t, q, v, p: -jnp.sign(v) - jnp.where(v > 0, 1.0, jnp.where(v < 0, -1.0, 0.0)) + jnp.maximum(-v, 0)
    assert jumps_of(friction)[1].count == 1
    assert jumps_of(lambda t, q, v, p: friction(t, q, v, p) + jnp.sign(v - q))[1].count == 2
    smooth = (
        lambda t, q, v, p: 1 / jnp.where(jnp.sqrt(q**2) > 0, jnp.sqrt(q**2), 1.0),
        lambda t, q, v, p: jnp.arccos(jnp.clip(jnp.cos(q), -1.0, 1.0)),
        lambda t, q, v, p: jnp.hypot(q, 1.0) + jax.nn.softplus(v) + jax.nn.logsumexp(jnp.stack([q, v])),
        lambda t, q, v, p: jnp.where(p > 0, q, v) + jnp.where(q == 0, 1.0, q),
        lambda t, q, v, p: jnp.sin(q),
    )
    assert [jumps_of(force)[1] for force in smooth] == [None] * len(smooth)


def test_what_is_not_followed_is_said():
    """Comparisons in loops, the largest of an array, many at once; twin: what is followed is not among them."""
    loop = lambda t, q, v, p: jax.lax.fori_loop(0, 3, lambda i, x: jnp.where(x > 0, x - 1.0, x), q)
    many = lambda t, q, v, p: jnp.sum(jnp.maximum(jnp.arange(100.0) * q, 0.0))
    largest = lambda t, q, v, p: jnp.max(jnp.stack([q, v, 1.0]))
    for force, words in ((loop, "loop"), (many, "100 numbers"), (largest, "largest of an array")):
        _, jumps = jumps_of(force)
        assert words in " ".join(jumps.missed) and jumps.count == 0
    assert jumps_of(JUMPING["where"])[1].missed == ()
    text = str(lj.explain(lj.System(free, force=largest), 0.0, 1.0, 1.0))
    assert "not followed" in text
    text = str(lj.explain(lj.System(free, force=JUMPING["maximum"]), 0.0, 1.0, 1.0))
    assert "a comparison of q in the force; max of q, v in the force" in text and "not followed" not in text


def times_of(force, params, last=10.0):
    """The times at which a force jumps because of t, increasing, as a function of the parameters."""
    system, jumps = jumps_of(force, params)
    zero, ts = np.array(0.0), np.array([0.0, last])
    return lambda params: jnp.sort(with_jumps_in_time(jumps, None, system, zero, zero, params, jnp.asarray(ts))[0])


def test_times_of_jumps():
    """A pulse, a relay, a square wave, a table of times: exact times and their derivatives up to the second.

    Twin: for the relay these are not zero.
    """
    pulse = times_of(lambda t, q, v, p: jnp.where((t > p) & (t < p + 0.05), 1.0, 0.0), 4.0)
    relay = times_of(lambda t, q, v, p: jnp.sign(jnp.sin(p * t)), 5.0)
    wave = times_of(lambda t, q, v, p: jnp.where(t % p < 0.3, 1.0, 0.0), 1.0, last=2.5)
    table = times_of(lambda t, q, v, p: jnp.interp(t, p * KNOTS, HEIGHTS), 2.0)

    @jax.jit
    def all_times(p):
        of_relay = [relay, jax.jacfwd(relay), jax.jacfwd(jax.jacfwd(relay))]
        return pulse(p[0]), [f(p[1]) for f in of_relay], wave(p[2]), table(p[3])

    at, of_relay, of_wave, of_table = jax.tree.map(np.asarray, all_times(np.array([4.0, 5.0, 1.0, 2.0])))
    np.testing.assert_array_equal(at, [4.0, 4.05])
    right = np.arange(1, 16) * np.pi / 5.0
    np.testing.assert_allclose(of_relay[0][1:16], right, rtol=1e-15)
    np.testing.assert_allclose(of_relay[1][1:16], -right / 5.0, rtol=1e-12)
    np.testing.assert_allclose(of_relay[2][1:16], 2 * right / 25.0, rtol=1e-9)
    np.testing.assert_allclose(np.unique(of_wave.round(14)), [0.3, 1.0, 1.3, 2.0, 2.3, 2.5], rtol=1e-13)
    # The first knot lies before the motion; unused places hold its end.
    assert {1.0, 4.0} <= set(of_table.round(12)) <= {-2.0, 0.0, 1.0, 4.0, 10.0}


@pytest.mark.parametrize("marked", [True, False])
def test_a_solver_of_ours_is_no_jump(marked, monkeypatch):
    """Routh's function of a kinetic energy that is not quadratic, found by Newton's method: only the jump in V counts.

    Twin: whether the method arrived is a comparison, if it is not said to be a judgement.
    """
    if not marked:
        for name in ("_regular", "_reached"):
            monkeypatch.setattr(legendre, name, getattr(legendre, name).__wrapped__)

    def lagrangian(t, q, v, p):
        slow = 1 - 0.01 * (v["r"] ** 2 + (q["r"] * v["angle"]) ** 2)
        return -100 * jnp.sqrt(slow) - 0.3 * jnp.maximum(q["r"] - 2.0, 0.0)

    radial, params = lj.routhian(lj.System(lagrangian), "angle"), {"params": None, "momenta": {"angle": 1.2}}
    state = State(np.array(0.0), {"r": np.array(1.0)}, {"r": np.array(0.0)}, params)
    jumps = found(model_of(radial, *state), state)
    assert jumps is not None and (len(jumps.slots) + len(jumps.missed) == 1) == marked


def rest_of_block(mu, amplitude=0.5):
    """Where a block on a spring with dry friction comes to rest, after how many half swings."""
    lost = mu * MASS * GRAVITY / SPRING
    n = np.ceil((amplitude / lost - 1) / 2)
    return (-1) ** n * (amplitude - 2 * n * lost), n


def block(force=None, dissipation=None):
    """A block on a spring."""
    return lj.System(lambda t, q, v, p: 0.5 * MASS * v**2 - 0.5 * SPRING * q**2, force=force, dissipation=dissipation)


@pytest.mark.slow
def test_dry_friction():
    """`sign(v)`: the block rests where it must, from when it must, with the derivative by the coefficient of friction.

    Twins: without sliding the motion is not followed to its rest; the usual tanh creeps 9 % off.
    """
    rubbed = block(lambda t, q, v, mu: -mu * MASS * GRAVITY * jnp.sign(v))
    right, n = rest_of_block(0.3)
    stop = n * np.pi / np.sqrt(SPRING / MASS)

    def end(mu):
        traj = lj.integrate(rubbed, 0.5, 0.0, mu, ts=jnp.array([0.0, stop - 1e-3, stop, 4.0]))
        return traj.q[-1], (traj.q, traj.v, traj.stats["lost_jumps"])

    (_, (q, v, lost)), by_mu = jax.value_and_grad(end, has_aux=True)(0.3)
    np.testing.assert_allclose(q[2:], right, rtol=1e-7)
    assert abs(v[1]) > 1e-3 and np.max(np.abs(v[2:])) < 1e-9 and not lost
    np.testing.assert_allclose(by_mu, -((-1) ** n) * 2 * n * MASS * GRAVITY / SPRING, rtol=1e-8)
    creeping = lambda t, y: [y[1], -SPRING / MASS * y[0] - 0.3 * GRAVITY * np.tanh(y[1] / 1e-3)]
    crept = solve_ivp(creeping, (0.0, 4.0), [0.5, 0.0], "Radau", rtol=1e-6, atol=1e-8).y[0, -1]
    assert abs(crept - right) > 0.05 * abs(right)


@pytest.mark.slow
def test_a_relay_that_slides():
    """u = -4 sign(q + v/2): after the first jump the motion stays on q + v/2 = 0, where q decays by e in 1/2.

    Twin: with a force of 1 it cannot stay at first.
    """
    relay = lj.System(kinetic, force=lambda t, q, v, p: -p * jnp.sign(q + 0.5 * v))
    ts = np.array([0.0, 1.0, 2.0, 4.0])
    begin = (-2 + np.sqrt(12)) / 4
    right = (1 - 2 * begin**2) * np.exp(-2 * (ts[1:] - begin))
    np.testing.assert_allclose(lj.integrate(relay, 1.0, 0.0, 4.0, ts=ts).q[1:], right, rtol=1e-8)
    assert abs(lj.integrate(relay, 1.0, 0.0, 1.0, ts=ts).q[1] - right[0]) > 0.01


@pytest.mark.exhaustive
def test_two_blocks_at_once():
    """Two blocks that slide and rest together, from one array of signs, in lanes of different friction."""
    blocks = lj.System(
        lambda t, q, v, p: 0.5 * MASS * jnp.sum(v**2) - 0.5 * SPRING * jnp.sum(q**2),
        force=lambda t, q, v, mu: -mu * MASS * GRAVITY * jnp.sign(v),
    )
    end = lambda mu: lj.integrate(blocks, jnp.array([0.5, 0.45]), jnp.zeros(2), mu, ts=jnp.array([0.0, 4.0])).q[-1]
    coefficients = np.array([0.3, 0.35])
    found = jax.jit(jax.vmap(end))(jnp.asarray(coefficients))
    right = [[rest_of_block(mu, x)[0] for x in (0.5, 0.45)] for mu in coefficients]
    np.testing.assert_allclose(found, right, rtol=1e-6)


@pytest.mark.exhaustive
def test_a_push_sets_a_block_free():
    """A block rests until a push in time is stronger than friction; derivatives by the push's ends and strength.

    With d the duration it slides (F - 1) d²/2 during the push and ((F - 1) d)²/2 afterwards. Twin: a weak push.
    """
    pushed = lj.System(kinetic, force=lambda t, q, v, p: -jnp.sign(v) + jnp.where((t > p[0]) & (t < p[1]), p[2], 0.0))

    def end(p):
        q = lj.integrate(pushed, 0.0, 0.0, p, ts=jnp.array([0.0, 1.2, 3.0])).q[-1]
        return q, q

    slopes_and_end = jax.jit(jax.jacfwd(end, has_aux=True))
    right = lambda a, b, strength: (strength - 1) / 2 * (b - a) ** 2 + ((strength - 1) * (b - a)) ** 2 / 2
    at = (1.0, 1.5, 2.0)
    slopes, found = slopes_and_end(at)
    np.testing.assert_allclose(found, right(*at), rtol=1e-12)
    np.testing.assert_allclose(slopes, jax.grad(right, argnums=(0, 1, 2))(*at), rtol=1e-9)
    assert abs(slopes_and_end((1.0, 1.5, 0.5))[1]) < 1e-12
