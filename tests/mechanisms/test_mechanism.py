"""Each mechanism: its start is on its constraints, which leave the freedoms that it states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.mechanisms import MECHANISMS
from lagjax.system import coordinates
from tests.by_numpy import by_numpy, matrices


def stacked(tree):
    """A pytree of numbers as one vector."""
    return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(tree)])


def equations(mechanism, t=0.0, q=None, v=None):
    """M, F, A, gamma of a mechanism, at its start or at another state, in NumPy."""
    q, v = mechanism.q0 if q is None else q, mechanism.v0 if v is None else v
    return matrices(mechanism.system)(*coordinates.state(t, q, v, mechanism.params))


def residuals(mechanism):
    """The function of (t, q) that is zero on the constraints, all stacked by name, as JAX flattens a dict."""
    in_order = [constraint for _, constraint in sorted(mechanism.system.constraints.items())]
    return lambda t, q: jnp.concatenate([jnp.ravel(constraint.g(t, q, mechanism.params)) for constraint in in_order])


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
    at = lambda t, q: jax.jvp(lambda t: residuals(mechanism)(t, q), (t,), (1.0,))
    off, drive = by_numpy(at)(0.0, mechanism.q0)
    assert np.max(np.abs(off)) <= 1e-15 * max(np.max(np.abs(stacked(mechanism.q0))), 1.0)
    velocity = jacobian @ stacked(mechanism.v0) + drive
    assert np.max(np.abs(velocity)) <= 1e-14 * max(np.max(np.abs(stacked(mechanism.v0))), 1.0)
