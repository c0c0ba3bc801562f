"""Hamilton's action of a path: S = ∫ L(t, q, dq/dt) dt, stationary on true motions among paths with the same ends.

A path is a trajectory, or a function of time whose derivative is the velocity. Between the outputs of a trajectory, q
is the cubic through their positions and velocities. Because S is stationary on true motions, its error is of the order
of the square of the cubic's error; it is of the order of the error itself only if t0 or t1 lies between outputs.

Source: Goldstein, *Classical Mechanics*, Eq. (2.1), (2.2).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax.mechanics import coordinates
from lagjax.mechanics.first_call import traced_system
from lagjax.mechanics.refusals import check_system
from lagjax.motion.trajectory import Trajectory

# Points of Gauss's rule on each piece, which is exact up to degree 15.
POINTS = 8
PIECES = 32


def action(
    system, path: Trajectory | Callable, params=None, t0=None, t1=None, *, pieces: int = PIECES
) -> Float[Array, ""]:
    """Return the action `S = ∫ L dt` of a path, differentiable in everything that the path and L depend on.

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> print(action(fall, lambda t: 2.0 * t - 5.0 * t**2, {"g": 10.0}, 0.0, 1.0).round(12))
    15.333333333333

    **Arguments:**

    - `path`: `q(t)` -> coordinates, smooth between t0 and t1, or a `Trajectory`.
    - `params`: as L takes it; by default those of the trajectory.
    - `t0`, `t1`: the ends, `[t]`; by default those of the trajectory.
    - `pieces`: the number of equal parts of the time span, each integrated by a rule of degree 15; for a trajectory
      each interval between outputs is one part.

    **Returns:** S, scalar, `[L] [t]`; NaN for a trajectory that failed.

    **Raises:** `TypeError` for a path that is neither a function nor a trajectory; `ValueError` for a function without
    t0 and t1, a batch of trajectories, or one that ends before t1.

    Source: Goldstein, Eq. (2.1).
    """
    check_system(system, path, params)
    if isinstance(path, Trajectory):
        return _action_of_trajectory(system, path, params, t0, t1)
    if not callable(path):
        raise TypeError(
            f"a path is a function of t or a lj.Trajectory, not {type(path).__name__}.\n"
            'Fix: lambda t: {"x": 2.0 * t, "y": 0.0 * t}.'
        )
    if t0 is None or t1 is None:
        raise ValueError("a path that is a function needs its ends.\nFix: lj.action(system, path, params, 0.0, 1.0).")
    t0, t1 = (jnp.asarray(t, jnp.result_type(float)) for t in (t0, t1))
    edges = t0 + (t1 - t0) * jnp.arange(pieces + 1) / pieces
    q, v = _position_and_velocity(path, t0)
    s = coordinates.state(t0, q, v, params)
    system = traced_system(system, s)
    at = lambda t: system.lagrangian(t, *_position_and_velocity(path, t), s.params)
    return _integral(at, edges[:-1], edges[1:])


def _action_of_trajectory(system, path, params, t0, t1):
    if path.t.ndim != 1:
        raise ValueError(
            f"this trajectory is a batch of shape {path.t.shape[:-1]}: take the action of one lane of it.\n"
            "Fix: jax.vmap(lambda traj: lj.action(system, traj))(trajectories)."
        )
    params = path.params if params is None else params
    t, q, v = path.t, path.q, path.v
    _, unflatten = coordinates.flatten(jax.tree.map(lambda x: x[0], q))
    s = coordinates.state(t[0], *jax.tree.map(lambda x: x[0], (q, v)), params)
    system = traced_system(system, s)
    flat = lambda tree: jax.vmap(lambda y: coordinates.flatten(y)[0])(tree)
    x, u = flat(q), flat(v)
    t0, t1 = (t[0] if t0 is None else t0), (t[-1] if t1 is None else t1)
    if not coordinates.is_traced((t, t0, t1)):
        low, high = float(np.min(t)), float(np.max(t))
        if not (low <= float(t0) <= high and low <= float(t1) <= high):
            raise ValueError(
                f"the trajectory goes from t = {low:.6g} to {high:.6g}, but the action is asked from "
                f"{float(t0):.6g} to {float(t1):.6g}.\nFix: a trajectory with outputs at or beyond these times."
            )

    def piece(a, b, x_a, x_b, u_a, u_b):
        def at(t):
            where = lambda t: unflatten(_cubic((t - a) / (b - a), b - a, x_a, x_b, u_a, u_b))
            return system.lagrangian(t, *_position_and_velocity(where, t), s.params)

        # Only the part of the piece between t0 and t1 counts.
        inside = lambda end: jnp.clip(end, jnp.minimum(a, b), jnp.maximum(a, b))
        forward = jnp.where(t1 >= t0, 1.0, -1.0) * jnp.where(b >= a, 1.0, -1.0)
        first, last = jnp.where(forward > 0, inside(t0), inside(t1)), jnp.where(forward > 0, inside(t1), inside(t0))
        return forward * _integral(at, first[None], last[None])

    return jnp.sum(jax.vmap(piece)(t[:-1], t[1:], x[:-1], x[1:], u[:-1], u[1:]))


def _cubic(s, h, x_a, x_b, u_a, u_b):
    """Hermite's cubic between two outputs, for s from 0 to 1."""
    return (
        (1 + 2 * s) * (1 - s) ** 2 * x_a
        + s**2 * (3 - 2 * s) * x_b
        + h * (s * (1 - s) ** 2 * u_a - s**2 * (1 - s) * u_b)
    )


def _position_and_velocity(path, t):
    """The position and velocity of a path at time t."""
    q, v = jax.jvp(lambda t: coordinates.as_floats(path(t)), (t,), (jnp.ones_like(t),))
    as_array = lambda x: jnp.asarray(x, jnp.result_type(t))
    return jax.tree.map(as_array, q), jax.tree.map(as_array, v)


def _integral(function, a, b):
    """The integral of a function of time over all pieces, from a (m,) to b (m,)."""
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    half = 0.5 * (b - a)
    times = (0.5 * (a + b))[:, None] + half[:, None] * nodes.astype(half.dtype)[None]
    values = jax.vmap(jax.vmap(function))(times)
    return jnp.sum(half * (values @ weights.astype(values.dtype)))
