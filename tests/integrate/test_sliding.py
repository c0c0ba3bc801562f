"""Motions that slide along a jump of their forces: dry friction, relays, blocks that are set free."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import lagjax as lj
from tests.integrate.solve.test_over_jumps import GRAVITY, MASS, SPRING, kinetic


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
