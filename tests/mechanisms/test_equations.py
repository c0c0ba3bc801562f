"""The mechanisms' equations agree with the printed ones of the sources, and so does the number of constraints."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanisms import MECHANISMS, andrews, car_axis
from lagjax.system import constraints, coordinates
from lagjax.system.model import model_of
from tests.mechanisms import published


def stacked(tree):
    """A pytree of numbers as one vector."""
    return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(tree)])


@eqx.filter_jit
def matrices(system, t, q, v, params):
    """M, F, A and gamma from lagjax."""
    model = model_of(system, t, q, v, params)
    x, u = model.vectors(q, v)
    linear, rows = mass_and_forcing(model, t, x, u), constraints.acceleration_rows(model, t, x, u)
    return linear.mass, linear.forcing, rows.jacobian, rows.gamma


def equations(mechanism, t=0.0, q=None, v=None):
    """M, F, A, gamma of a mechanism, at its start or at another state."""
    q, v = mechanism.q0 if q is None else q, mechanism.v0 if v is None else v
    found = matrices(mechanism.system, *coordinates.state(t, q, v, mechanism.params))
    return tuple(np.asarray(part) for part in found)


def residual(mechanism, t, q):
    """All position residuals of a mechanism, stacked by name, as JAX flattens a dict."""
    in_order = [constraint for _, constraint in sorted(mechanism.system.constraints.items())]
    return jnp.concatenate([jnp.ravel(constraint.g(t, q, mechanism.params)) for constraint in in_order])


def assert_close(ours, theirs, digits=1e-12):
    """Agreement relative to the largest entry."""
    assert np.max(np.abs(ours - theirs)) <= digits * np.max(np.abs(theirs)), (ours, theirs)


def test_andrews_against_the_printed_equations():
    """M, f, g, G and the acceleration level from the Lagrangian are Hairer & Wanner's at a random state."""
    rng = np.random.default_rng(5)
    q, v = rng.uniform(-1, 1, 7), rng.uniform(-100, 100, 7)
    params = andrews.PARAMS
    mass, force, jacobian, gamma = equations(andrews.MECHANISM, q=andrews.Angles(*q), v=andrews.Angles(*v))
    M, f, g, G = published.andrews(q, v, params)
    G_rate = published.andrews(q + 1e-30j * v, v + 0j, params)[3].imag / 1e-30
    assert_close(mass, M)
    assert_close(force, f)
    assert_close(jacobian, G)
    assert_close(gamma, -G_rate @ v)
    assert_close(residual(andrews.MECHANISM, 0.0, andrews.Angles(*q)), g)
    # Twin: a motor of twice the torque, a joint half a millimetre away.
    assert not np.allclose(force, published.andrews(q, v, params | {"mom": 0.066})[1], rtol=1e-12)
    assert not np.allclose(jacobian, published.andrews(q, v, params | {"d": 0.0285})[3], rtol=1e-12)


def test_car_axis_against_the_printed_equations():
    """Mass, springs, both constraints and the signs of both multipliers are the test set's at a random state."""
    rng = np.random.default_rng(6)
    q, t, params = np.array([0.1, 0.5, 1.1, 0.4]) + rng.uniform(-0.2, 0.2, 4), 1.23, car_axis.PARAMS
    v = rng.uniform(-1, 1, 4)
    mass, force, jacobian, gamma = equations(car_axis.MECHANISM, t, car_axis.Ends(*q), car_axis.Ends(*v))
    k, f, g, G = published.car_axis(t, q, params)
    # The source lists the upright spring first, lagjax the names in order: axle, upright.
    g, G = g[::-1], G[::-1]
    assert_close(mass, k * np.eye(4))
    assert_close(force, f)
    assert_close(jacobian, G)
    assert_close(residual(car_axis.MECHANISM, t, car_axis.Ends(*q)), g)
    # gamma = -d²g/dt² at a = 0, by a sixth-order difference along q + v t.
    along = lambda s: published.car_axis(t + s, q + v * s, params)[2][::-1]
    step, weights = 1e-2, (1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90)
    second = sum(w * along(i * step) for i, w in zip(range(-3, 4), weights)) / step**2
    assert_close(gamma, -second, 1e-5)
    # Twin: the wheel half a wave earlier.
    assert not np.allclose(force, published.car_axis(t - np.pi / params["omega"], q, params)[1], rtol=1e-12)


@pytest.mark.parametrize("name", sorted(MECHANISMS))
def test_degrees_of_freedom(name):
    """The start satisfies both levels, the constraints leave the stated freedoms, and M is definite on them."""
    mechanism = MECHANISMS[name]
    mass, _, jacobian, _ = equations(mechanism)
    _, values, directions = np.linalg.svd(jacobian)
    rank = int(np.sum(values > 1e-10 * values[0]))
    assert mass.shape[0] - rank == mechanism.freedom
    free = directions[rank:]
    assert np.all(np.linalg.eigvalsh(free @ mass @ free.T) > 1e-9 * np.max(np.abs(mass)))
    size = np.max(np.abs(stacked(mechanism.q0)))
    assert np.max(np.abs(residual(mechanism, 0.0, mechanism.q0))) <= 1e-15 * max(size, 1.0)
    _, drive = jax.jvp(lambda t: residual(mechanism, t, mechanism.q0), (0.0,), (1.0,))
    velocity = jacobian @ stacked(mechanism.v0) + np.asarray(drive)
    assert np.max(np.abs(velocity)) <= 1e-14 * max(np.max(np.abs(stacked(mechanism.v0))), 1.0)


def test_bricard_has_one_constraint_too_many():
    """24 equations, 23 independent; without any one equation of the dependent set still 23."""
    _, _, jacobian, _ = equations(MECHANISMS["bricard"])
    assert jacobian.shape == (24, 24)
    left, values, _ = np.linalg.svd(jacobian)
    assert values[-1] < 1e-15 * values[0] < values[-2]
    dependent = np.flatnonzero(np.abs(left[:, -1]) > 1e-12)
    assert dependent.size > 1
    for i in dependent:
        assert np.linalg.matrix_rank(np.delete(jacobian, i, axis=0)) == 23
    # Twin: an equation outside the dependent set is missed.
    outside = np.setdiff1d(np.arange(24), dependent)
    for i in outside:
        assert np.linalg.matrix_rank(np.delete(jacobian, i, axis=0)) == 22
