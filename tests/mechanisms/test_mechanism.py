"""Each mechanism: its start is on its constraints, which leave the freedoms that it states."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanisms import MECHANISMS
from lagjax.system import constraints, coordinates
from lagjax.system.model import model_of


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


def assert_reference(mechanism, q, v):
    """Stored and recomputed ends agree to the stored number of digits, separately for positions and velocities."""
    for stored, computed in zip(mechanism.reference, (q, v)):
        stored = stacked(stored)
        assert np.max(np.abs(stored - np.ravel(computed))) <= 10.0**-mechanism.digits * np.max(np.abs(stored))


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
