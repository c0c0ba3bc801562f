"""The action against closed forms: of functions, and of trajectories whatever their outputs."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj


def swinging(t, q, v, params):
    """A harmonic oscillator."""
    return 0.5 * v**2 - 0.5 * params["k"] * q**2


@pytest.mark.slow
def test_the_action_is_stationary_on_motions():
    """S of an oscillator in closed form; δS = 0 and δ²S as known; ∂S/∂q₁ is p. Twin: a straight path."""
    system, params, end = lj.System(swinging), {"k": 4.0}, 0.5
    w = 2.0

    def off(size, q1=1.0, straight=0.0):
        motion = lambda t: q1 * jnp.sin(w * t) / jnp.sin(w * end)
        path = lambda t: (1 - straight) * motion(t) + straight * q1 * t / end + size * jnp.sin(jnp.pi * t / end)
        return lj.action(system, path, params, 0.0, end)

    np.testing.assert_allclose(off(0.0), w / (2 * np.tan(w * end)), rtol=1e-13)
    first, second = jax.grad(off)(0.0), jax.grad(jax.grad(off))(0.0)
    assert abs(first) < 1e-13 and abs(jax.grad(lambda size: off(size, straight=1.0))(0.0)) > 0.1
    np.testing.assert_allclose(second, ((np.pi / end) ** 2 - params["k"]) * end / 2, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(lambda q1: off(0.0, q1))(1.0), w / np.tan(w * end), rtol=1e-12)


@pytest.mark.exhaustive
def test_the_action_of_a_trajectory():
    """The action from outputs, with ends between them and backward; twin: the part differs from the whole."""
    system, params, w = lj.System(swinging), {"k": 4.0}, 2.0
    motion = lj.integrate(system, 0.0, w, params, ts=np.linspace(0.0, 1.0, 41), rtol=1e-12, atol=1e-12)
    exact = lambda a, b: 0.25 * w * (np.sin(2 * w * b) - np.sin(2 * w * a))
    whole, error = lj.action(system, motion, error=True)
    np.testing.assert_allclose(whole, exact(0.0, 1.0), rtol=1e-10)
    far = lj.integrate(system, 0.0, w, params, ts=np.array([0.0, 10.0]))
    few, off = jax.jit(lambda far: lj.action(system, far, error=True, pieces=1))(far)
    assert float(error) < 1e-9 and 1e-6 < abs(float(few) - exact(0.0, 10.0)) < 2 * float(off)
    part = lj.action(system, motion, t0=0.11, t1=0.87)
    np.testing.assert_allclose(part, exact(0.11, 0.87), rtol=1e-10)
    np.testing.assert_allclose(lj.action(system, motion, t0=0.87, t1=0.11), -np.asarray(part), rtol=1e-12)
    assert abs(np.asarray(part) - exact(0.0, 1.0)) > 1e-4
    with pytest.raises(ValueError, match="the action is asked from 0 to 2"):
        lj.action(system, motion, t0=0.0, t1=2.0)
    with pytest.raises(ValueError, match="a path that is a function needs its ends"):
        lj.action(system, lambda t: t, params)
    with pytest.raises(TypeError, match="a path is a function of t or a Trajectory"):
        lj.action(system, 1.0, params, 0.0, 1.0)


@pytest.mark.exhaustive
def test_the_action_in_a_program():
    """The action of a motion with two outputs and its derivative, in lanes; twin: the chord between them is far off."""
    system, ts = lj.System(swinging), np.array([0.0, 10.0])

    def found(k):
        motion = lj.integrate(system, 1.0, 0.5, {"k": k}, ts=ts)
        return lj.action(system, motion)

    def exact(k):
        w = jnp.sqrt(k)
        q = jnp.cos(w * ts) + 0.5 / w * jnp.sin(w * ts)
        v = 0.5 * jnp.cos(w * ts) - w * jnp.sin(w * ts)
        # Homogeneous of degree two: L = d(qv/2)/dt on motions.
        return 0.5 * (q[1] * v[1] - q[0] * v[0]), 0.5 * (q[1] - q[0]) ** 2 / 10.0 - k * jnp.sum(q**2) / 6 * 10.0

    stiffness = jnp.array([2.0, 3.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(found)))(stiffness)
    right, by_chord = jax.vmap(exact)(stiffness)
    np.testing.assert_allclose(values, right, rtol=1e-8)
    np.testing.assert_allclose(slopes, jax.vmap(jax.grad(lambda k: exact(k)[0]))(stiffness), rtol=1e-7)
    assert np.all(np.abs(by_chord - right) > 0.1)
