"""Whether a closed form is a motion: its rates are its velocities, and its accelerations those of the system."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj

STEP = 1e-3


@partial(jax.jit, static_argnums=0)
def accelerations(system, t, q, v, params):
    """Those at several times."""
    return jax.vmap(lambda *state: lj.accelerations(system, *state, params)[0])(t, q, v)


def defect(system, exact, q0, v0, params, times):
    """The largest error of dq/dt = v and dv/dt = a along `exact(q0, v0, params, ts)`, by differences of fourth order.

    `ts` begins with the time of the start.
    """
    around = np.asarray(times)[:, None] + STEP * np.arange(-2, 3)
    states = exact(q0, v0, params, jnp.concatenate([jnp.zeros(1), jnp.ravel(around)]))
    states = jax.tree.map(lambda x: np.asarray(x[1:]).reshape(*around.shape, *x.shape[1:]), states)
    weights = np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / (12 * STEP)
    rates = jax.tree.map(lambda x: np.einsum("k,tk...->t...", weights, x), states)
    q, v = jax.tree.map(lambda x: x[:, 2], states)
    a = accelerations(system, np.asarray(times), q, v, params)
    return max(float(np.max(np.abs(x - y))) for x, y in zip(jax.tree.leaves(rates), jax.tree.leaves((v, a))))
