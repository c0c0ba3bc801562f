"""Hamilton's action of a path: S = ∫ L(t, q, dq/dt) dt, stationary on true motions among paths with the same ends.

A path is a trajectory, or a function of time whose derivative is the velocity. A trajectory is integrated again, at the
nodes of a quadrature, so that it does not matter how far apart its outputs lie. The quadrature is refined until it is
as accurate as the motion (`analysis/works.py`); while JAX traces, its nodes must be known beforehand.

Source: Goldstein, *Classical Mechanics*, Eq. (2.1), (2.2).
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from lagjax.analysis.works import Motion
from lagjax.integrate import Trajectory, in_one_solve
from lagjax.jaxtools import compiled, is_eager, is_traced
from lagjax.numerics import quadrature
from lagjax.system import System, check_system, coordinates, traced_system

# Points of Gauss's rule on each piece, which is exact up to degree 15.
POINTS = 8
PIECES = 32


def action(
    system,
    path: Trajectory | Callable,
    params: PyTree = None,
    t0=None,
    t1=None,
    *,
    pieces: int = PIECES,
    error: bool = False,
) -> Float[Array, ""] | tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the action `S = ∫ L dt` of a path, differentiable in everything that the path and L depend on.

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> print(action(fall, lambda t: 2.0 * t - 5.0 * t**2, {"g": 10.0}, 0.0, 1.0).round(12))
    15.333333333333

    **Arguments:**

    - `path`: `q(t)` -> coordinates, smooth between t0 and t1, or a `Trajectory`.
    - `params`: as L takes it; by default those of the trajectory.
    - `t0`, `t1`: the ends, `[t]`; by default those of the trajectory.
    - `pieces`: the number of equal parts of the time span, each integrated by a rule of degree 15. A trajectory is
      integrated again, however far apart its outputs lie, in parts as short as it takes; while JAX traces (under `jit`,
      `grad`, `vmap`) in this number of parts, or one for each output if these are more: `error` tells whether they
      suffice.
    - `error`: return the estimated error of the integral as well; that of the motion itself is `traj.error`.

    **Returns:** S, scalar, `[L] [t]`; NaN for a trajectory that failed. With `error=True` (S, its estimated error).

    **Raises:** `TypeError` for a path that is neither a function nor a trajectory; `ValueError` for a function without
    t0 and t1, a batch of trajectories, or one that ends before t1; `TypeError` for a motion in phases while JAX traces.

    Source: Goldstein, Eq. (2.1).
    """
    check_system(system, path, params, states=False)
    if isinstance(path, Trajectory):
        found = _action_of_trajectory(system, path, params, t0, t1, pieces)
        return found if error else found[0]
    if not callable(path):
        raise TypeError(
            f"a path is a function of t or a Trajectory, not {type(path).__name__}.\n"
            'Fix: lambda t: {"x": 2.0 * t, "y": 0.0 * t}.'
        )
    if t0 is None or t1 is None:
        raise ValueError("a path that is a function needs its ends.\nFix: lj.action(system, path, params, 0.0, 1.0).")
    t0, t1 = (jnp.asarray(t, jnp.result_type(float)) for t in (t0, t1))

    def edges(pieces: int):
        return t0 + (t1 - t0) * jnp.arange(pieces + 1) / pieces

    q, v = _position_and_velocity(path, t0)
    s = coordinates.state(t0, q, v, params)
    system = traced_system(system, s)

    def at(t: Array):
        return system.lagrangian(t, *_position_and_velocity(path, t), s.params)

    whole, halves = (_integral(at, edges(n)[:-1], edges(n)[1:]) for n in (pieces, 2 * pieces))
    return (whole, jnp.abs(halves - whole)) if error else whole


def _action_of_trajectory(system, path, params: PyTree, t0, t1, pieces):
    if path.t.ndim != 1:
        raise ValueError(
            f"this trajectory is a batch of shape {path.t.shape[:-1]}: take the action of one lane of it.\n"
            "Fix: jax.vmap(lambda traj: lj.action(system, traj))(trajectories)."
        )
    params = path.params if params is None else params
    t, q, v = path.t, path.q, path.v
    s = coordinates.state(t[0], *jax.tree.map(lambda x: x[0], (q, v)), params)
    system = traced_system(system, s)
    t0, t1 = (t[0] if t0 is None else t0), (t[-1] if t1 is None else t1)
    if not is_traced((t, t0, t1)):
        low, high = float(np.min(t)), float(np.max(t))
        if not (low <= float(t0) <= high and low <= float(t1) <= high):
            raise ValueError(
                f"the trajectory goes from t = {low:.6g} to {high:.6g}, but the action is asked from "
                f"{float(t0):.6g} to {float(t1):.6g}.\nFix: a trajectory with outputs at or beyond these times."
            )
    if is_eager() and not is_traced((path, t0, t1, s.params, eqx.filter(system, eqx.is_array))):
        return _along_the_steps(system, path, s.params, float(t0), float(t1))

    # From the earlier end, as the motion runs, to the later one.
    runs = -1 if path.static.how.backward else 1
    ends = jnp.stack([jnp.asarray(end, t.dtype) for end in (t0, t1)])
    turned = runs * ends[0] > runs * ends[1]
    first, last = jnp.where(turned, ends[::-1], ends)
    edges = first + (last - first) * jnp.linspace(0.0, 1.0, max(pieces, len(t) - 1) + 1, dtype=t.dtype)
    nodes = quadrature.nodes(edges[:-1], edges[1:]).ravel()
    at = in_one_solve(path, nodes)
    values = jax.vmap(lambda t, q, v: system.lagrangian(t, q, v, s.params))(nodes, at.q, at.v)
    values = values.reshape(-1, quadrature.NODES.size)
    # NaN for a motion that failed, also where the nodes lie before that.
    complete = jnp.all(jnp.isfinite(jnp.concatenate([x.ravel() for x in jax.tree.leaves((q, v))])))
    values = jnp.where(complete, jnp.where(turned, -values, values), jnp.nan)

    def integral(weights: Array):
        return jnp.sum(0.5 * jnp.diff(edges) * (values @ weights.astype(t.dtype)))

    found = integral(quadrature.KRONROD)
    return found, jnp.abs(found - integral(quadrature.GAUSS))


def _along_the_steps(system, path, params: PyTree, t0, t1):
    """The action of a motion that is integrated again, and the error of the quadrature."""
    states = np.concatenate([np.ravel(y) for y in jax.tree.leaves((path.q, path.v))])
    dtype = np.asarray(path.t).dtype
    if not np.all(np.isfinite(states)):
        return jnp.asarray(np.nan, dtype), jnp.asarray(np.nan, dtype)
    if t0 == t1:
        return jnp.zeros((), dtype), jnp.zeros((), dtype)
    motion = Motion(path, path.system)
    knots = motion.between(t0, t1)

    def at_nodes(a, b):
        _, t, q, v, _ = motion.again(a, b)
        return np.asarray(_lagrangians(system, params, t, q, v))[:, None]

    size = float(np.max(np.abs(at_nodes(knots[:-1], knots[1:]))))
    rtol = max(float(np.max(np.asarray(path.tolerance[0]))), float(np.finfo(dtype).eps))
    _, sums, errors = motion.integrals(knots, at_nodes, rtol * size * abs(t1 - t0))
    return jnp.asarray(np.sum(sums), dtype), jnp.asarray(np.sum(np.abs(errors)), dtype)


@compiled
def _lagrangians(system: System, params: PyTree, t: Array, q: PyTree, v: PyTree) -> Array:
    return jax.vmap(lambda t, q, v: system.lagrangian(t, q, v, params))(t, q, v)


def _position_and_velocity(path, t):
    """The position and velocity of a path at time t."""
    q, v = jax.jvp(lambda t: coordinates.as_floats(path(t)), (t,), (jnp.ones_like(t),))

    def as_array(x: Array):
        return jnp.asarray(x, jnp.result_type(t))

    return jax.tree.map(as_array, q), jax.tree.map(as_array, v)


def _integral(function, a, b):
    """The integral of a function of time over all pieces, from a (m,) to b (m,)."""
    nodes, weights = np.polynomial.legendre.leggauss(POINTS)
    half = 0.5 * (b - a)
    times = (0.5 * (a + b))[:, None] + half[:, None] * nodes.astype(half.dtype)[None]
    values = jax.vmap(jax.vmap(function))(times)
    return jnp.sum(half * (values @ weights.astype(values.dtype)))
