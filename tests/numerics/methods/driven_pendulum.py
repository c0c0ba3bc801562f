"""A driven pendulum by the steps of methods of diffrax's form, evaluated in NumPy: nothing is compiled."""

from functools import cache

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy import integrate

from tests.jaxtools.in_numpy import run

END = 5.0
START = {"angle": np.array(1.0)}, {"angle": np.array(0.0)}


def swing(t, y, args):
    """The rates of (q, v)."""
    q, v = y
    return v, {"angle": -jnp.sin(q["angle"]) + 0.1 * jnp.cos(2 * t)}


@cache
def exact(t):
    """Angle and rate by another method with a far smaller error."""
    field = lambda t, y: [y[1], -np.sin(y[0]) + 0.1 * np.cos(2 * t)]
    return integrate.solve_ivp(field, (0.0, t), [1.0, 0.0], "DOP853", rtol=1e-13, atol=1e-15).y[:, -1]


def in_numpy(function, *like):
    """The same function of trees of arrays, traced once."""
    program, shape = jax.make_jaxpr(function, return_shape=True)(*like)
    back = jax.tree.structure(shape).unflatten
    return lambda *args: back(run(program, *jax.tree.leaves(args)))


def errors(method, count):
    """The errors of (angle, rate) at the end of `count` equal steps, and in the middle of the step around t = 1.3."""
    term, h = diffrax.ODETerm(swing), END / count

    def step(t0, t1, y, state):
        y1, _, dense, state, _ = method.step(term, t0, t1, y, None, state, False)
        return y1, state, method.interpolation_cls(t0=t0, t1=t1, **dense).evaluate((t0 + t1) / 2)

    y, state, between = START, in_numpy(lambda y: method.init(term, 0.0, h, y, None), START)(START), None
    advance = in_numpy(step, 0.0, h, y, state)
    for i in range(count):
        y, state, middle = advance(i * h, (i + 1) * h, y, state)
        between = middle if i == int(1.3 / h) else between
    return np.subtract(jax.tree.leaves(y), exact(END)), np.subtract(jax.tree.leaves(between), exact(1.3))
