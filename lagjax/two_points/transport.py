"""Parallel transport: a tangent vector carried along a curve without turning.

Accelerations of motions without forces are a = -Γ(v, v), quadratic in v, so the equation of transport along q(t) is

    ẇ = -Γ(q̇, w) = ½ (∂a/∂v) w    at v = q̇

On a surface in space a is the normal acceleration that keeps the motion on it, and so is ẇ, which keeps w tangent. The
equation is linear, and is solved on elements of the path by Gauss's collocation, of order 2s for s points.

Source: do Carmo, *Riemannian Geometry*, §2.2-2.3; Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §II.1.3.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, PyTree

from lagjax.integrate import integrate
from lagjax.jaxtools import compiled, is_traced
from lagjax.mechanics import accelerations_at
from lagjax.numerics import dense
from lagjax.system import Model, State, System, check_system, constraints, coordinates, prepare
from lagjax.two_points.elements import integrals, rule_of_degree
from lagjax.two_points.geodesic import Geodesic, of_metric, tolerance_in

POINTS, ELEMENTS = 6, 64
# So much of a vector may be across a constraint, and of a path off it, as parts of their sizes.
OFF = {np.dtype("float64"): 1e-6, np.dtype("float32"): 1e-4}


def parallel_transport(
    metric: Callable | System,
    path: Callable | Geodesic,
    w: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    t_a: ArrayLike = 0.0,
    t_b: ArrayLike = 1.0,
    elements: int = ELEMENTS,
) -> PyTree[Array]:
    """Return the vector w at the start of a path as it arrives at the end, carried parallel to itself.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def sphere(q, v, params):
    ...     return v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2
    >>> def latitude(t):
    ...     return {"psi": jnp.pi / 3, "theta": 2 * jnp.pi * t}
    >>> w = parallel_transport(sphere, latitude, {"psi": 1.0, "theta": 0.0})
    >>> print(w["psi"].round(9))  # once round it has turned by 2π (1 - cos π/3) = π
    -1.0

    **Arguments:**

    - `metric`, `params`: as for `lj.geodesic`.
    - `path`: `q(t)` -> coordinates, smooth between `t_a` and `t_b`, on the constraints; or a `Geodesic`.
    - `w`: a vector at the start, like the coordinates, tangent to the constraints.
    - `elements`: of the path; the error is of order 12 in their length.

    **Returns:** w at the end, like the coordinates; differentiable in both modes.

    **Raises:** `TypeError`, `ValueError` for arguments of the wrong kind or shape; a w that is not tangent to a
    constraint, a path that leaves one; forces and velocity constraints. Under `jit` and `vmap` w at the end is NaN
    where it is not tangent, or the path is off.

    Source: do Carmo, *Riemannian Geometry*, §2.2.
    """
    system = of_metric(metric)
    check_system(system, w, params, states=False)
    if not isinstance(path, Geodesic) and not callable(path):
        raise TypeError(
            f"a path is a function of t or a Geodesic, not {type(path).__name__}.\n"
            'Fix: lambda t: {"psi": 1.0, "theta": 2.0 * t}.'
        )
    if isinstance(path, Geodesic):
        start = jax.tree.map(lambda x: x[0], path.connection.q)
        t_a, t_b = np.zeros((), path.length.dtype), np.ones((), path.length.dtype)
    else:
        t_a, t_b = (jnp.asarray(t, jnp.result_type(float)) for t in (t_a, t_b))
        start = path(t_a)
    model, s = prepare(system, t_a, start, w, params)
    dtype, rule = s.t.dtype, rule_of_degree(POINTS)
    h = (t_b - t_a) / elements
    t = (t_a + h * (np.arange(elements)[:, None] + rule.points).ravel()).astype(dtype)
    if isinstance(path, Geodesic):
        # The first output is the start.
        ts = np.concatenate([t_a[None], t])
        motion = integrate(system, start, path.connection.start_velocity, s.params, ts=ts, rtol=tolerance_in(s))
        x, u = (jax.vmap(model.vector)(y)[1:] for y in (motion.q, motion.v))
    else:

        def at(t: Array) -> tuple[Array, Array]:
            return jax.jvp(lambda t: model.vector(coordinates.as_floats(path(t))), (t,), (jnp.ones_like(t),))

        x, u = jax.vmap(at)(t)
    w, x_a = model.vector(s.v), model.vector(s.q)
    carried = _carried(model, t, x, u, jnp.asarray(h, dtype), w)
    if not model.m:
        return model.tree(carried)
    bound = OFF.get(np.dtype(dtype), 1e-4)
    across, away = _off(model, jnp.asarray(t_a, dtype), x_a, w, t, x)
    if is_traced((across, away)):
        well = jnp.all(across < bound) & jnp.all(away < bound)
        return model.tree(jnp.where(well, carried, jnp.nan))
    _check(model, np.asarray(across), np.asarray(away), t, bound)
    return model.tree(carried)


def _check(model: Model, across: np.ndarray, away: np.ndarray, t: np.ndarray, bound: float):
    """Raise for a vector that is not tangent, and a path that leaves the constraints."""
    worst = int(np.argmax(np.where(np.isfinite(across), across, np.inf)))
    if not across[worst] < bound:
        raise ValueError(
            f"w is not tangent to the constraint '{model.equation_names[worst]}': {across[worst]:.3g} of it is not.\n"
            "Usual cause: a vector in space that points off the surface.\n"
            "Fix: _, w = lj.consistent_state(system, t_a, q, w, params), its part along the constraints."
        )
    at, worst = np.unravel_index(np.argmax(np.where(np.isfinite(away), away, np.inf)), away.shape)
    if not away[at, worst] < bound:
        raise ValueError(
            f"the path is off the constraint '{model.equation_names[worst]}' at t = {float(t[at]):.6g}, by "
            f"{away[at, worst]:.3g} of the distance from the origin.\n"
            "Usual cause: a path beside the surface, as a straight line between two of its points.\n"
            "Fix: path=lj.geodesic(system, a, b, params), or a function of t that stays on it."
        )


@compiled
def _off(model: Model, t_a: Array, x_a: Float[Array, " n"], w: Array, t: Float[Array, " T"], x: Float[Array, "T n"]):
    """How much of w is across each constraint (m,), and how far the path is from it (T, m), as parts of their sizes."""

    def rows(t: Array, x: Array) -> tuple[Array, Array]:
        slope = jax.jacfwd(lambda x: constraints.position_residual(model, t, x))(x)
        return slope, jnp.sqrt(jnp.sum(slope**2, axis=1))

    def away(t: Array, x: Array) -> Array:
        return jnp.abs(constraints.position_residual(model, t, x)) / (rows(t, x)[1] * largest)

    largest = jnp.maximum(jnp.max(jnp.abs(x)), jnp.finfo(x.dtype).tiny)
    slope, size = rows(t_a, x_a)
    length = jnp.sqrt(jnp.sum(w**2))
    across = jnp.abs(slope @ w) / (size * jnp.where(length > 0, length, 1.0))
    return across, jax.vmap(away)(t, x)


@compiled
def _carried(
    model: Model, t: Float[Array, " T"], x: Float[Array, "T n"], u: Float[Array, "T n"], h: Array, w: Float[Array, " n"]
) -> Float[Array, " n"]:
    """w from element to element, from states at Gauss's points."""
    rule, n = rule_of_degree(POINTS), model.n
    size, weights = POINTS * n, jnp.asarray(rule.weights, w.dtype)
    reach = jnp.asarray(integrals(rule.points, np.zeros(POINTS)), w.dtype)

    def turning(t: Array, x: Array, u: Array) -> Array:
        """½ ∂a/∂v."""
        q = model.tree(x)
        a = jax.jacfwd(lambda u: model.vector(accelerations_at(model, State(t, q, model.tree(u), model.params))[0]))
        return a(u) / 2

    def across(w: Array, matrices: Array):
        # The rates k_i = M_i (w + h Σ_j a_ij k_j).
        known = jnp.einsum("iab,b->ia", matrices, w).reshape(size)
        system = jnp.eye(size, dtype=w.dtype) - h * jnp.einsum("ij,iab->iajb", reach, matrices).reshape(size, size)
        rates = (dense.inverse(system) @ known).reshape(POINTS, n)
        return w + h * weights @ rates, None

    return lax.scan(across, w, jax.vmap(turning)(t, x, u).reshape(-1, POINTS, n, n))[0]
