"""Whether a closed form is a motion: its rates are its velocities, and its accelerations those of the system."""

import jax
import numpy as np

from tests.by_numpy import by_numpy, equations


def defect(system, exact, q0, v0, params, times):
    """The largest error of dq/dt = v and dv/dt = a along `exact(q0, v0, params, ts)`; `ts` begins with the start's."""
    ts, going = np.append(0.0, times), np.append(0.0, np.ones(len(times)))
    moving = lambda q0, v0, params, ts: jax.jvp(lambda ts: exact(q0, v0, params, ts), (ts,), (going,))
    (q, v), rates = by_numpy(moving)(q0, v0, params, ts)
    errors = []
    for i, t in enumerate(times, 1):
        state, found = jax.tree.map(lambda x, i=i: x[i], ((q, v), rates))
        right = state[1], equations(system, t, *state, params).a
        errors += [np.max(np.abs(x - y)) for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True)]
    return max(errors)
