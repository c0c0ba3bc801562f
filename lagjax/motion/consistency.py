"""States on the constraint manifold.

A step of any integrator leaves the manifold by its local error, and the error accumulates: the constraint
drifts. The nearest state on it, nearest in the metric of the mass matrix, is the stationary point of

    ½ (q* - q)ᵀ M (q* - q) + μᵀ g(t, q*)        then        ½ (v* - v)ᵀ M (v* - v) + νᵀ phi(t, q*, v*)

One Newton step of either is a saddle-point solve with the matrix that also gives the accelerations, so a
massless coordinate (M singular) is no obstacle. Positions are moved only where positions are constrained.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §IV.4 and §VII.1.2.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.lagrangian import check_scalar, mass_and_forcing
from lagjax.mechanics.multipliers import describe, equation_names, saddle_point_matrix
from lagjax.numerics import dense

# After a step the state is off by its local error e. With the matrix kept, each iteration multiplies the
# residual by a number of the size of e: three reach round-off from e = 1e-4.
ITERATIONS_AFTER_STEP = 3
NEWTON_FROM_AFAR = 30


@eqx.filter_jit
def to_manifold(system, t, q, v, params, iterations=ITERATIONS_AFTER_STEP):
    """The nearest state that satisfies all constraints, for a state near it: Newton with a fixed matrix.

    The matrix is not differentiated: where the residual vanishes its derivative does not count.
    """
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    mass = mass_and_forcing(system, t, x, u, params, unflatten).mass
    jacobian = constraints.acceleration_rows(system, t, x, u, params, unflatten).jacobian
    inverted = lax.stop_gradient(dense.inverse(saddle_point_matrix(mass, jacobian)))
    to_displacement = inverted[: x.size, x.size :]
    holonomic = constraints.holonomic_equations(system, t, q, v, params)

    if holonomic.any():
        # Positions move only in directions that the velocity constraints allow: a rolling body keeps rolling.
        to_position = to_displacement[:, holonomic]
        for _ in range(iterations):
            x = x - to_position @ constraints.position_residual(system, t, x, params, unflatten)
    for _ in range(iterations):
        u = u - to_displacement @ constraints.velocity_residual(system, t, x, u, params, unflatten)
    return unflatten(x), unflatten(u)


def consistent_state(system, t, q, v, params):
    """Return a state near the given one that satisfies the constraints, by steps shortest in the mass matrix's metric.

    Each Newton step is the shortest one; together they lead to the nearest state up to the square of the distance.

    >>> import lagjax as lj
    >>> rod = lj.Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["length"] ** 2)
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2), {"rod": rod})
    >>> q, v = consistent_state(
    ...     pendulum, 0.0, {"x": 6.0, "y": 8.0}, {"x": 1.0, "y": 0.0}, {"length": 5.0}
    ... )
    >>> print(q["x"].round(6), q["y"].round(6))
    3.0 4.0

    **Arguments:** `t` scalar, `q` and `v` alike, `params` as the system takes it.

    **Returns:** (q, v) in the same structure. Its derivative is that of the shortest step: exact from a state that is
    consistent already, and up to the distance from one that is not.

    **Raises:** `ValueError` where no consistent state is reached, with the residual by constraint name
    (not while JAX is tracing); as `accelerations` for a state of the wrong shape or dtype.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, Eq. (IV.4.3).
    """
    s = coordinates.state(t, q, v, params)
    check_scalar(system, *s)
    if not system.constraints:
        return s.q, s.v
    q, v = _consistent_state(system, *s)
    if not coordinates.is_traced((q, v)):
        round_off = 1e3 * float(jnp.finfo(s.t.dtype).eps)
        found = coordinates.State(s.t, q, v, s.params)
        excess = departures(system, found, rtol=round_off, atol=round_off)
        if excess:
            raise ValueError(
                f"no consistent state was found near q = {describe(s.q)}: after {NEWTON_FROM_AFAR} Newton "
                f"iterations constraint {excess}.\n"
                "Usual cause: constraints that contradict each other, or a start too far from the manifold.\n"
                "Fix: start nearer, or check each constraint with lj.constraint_residual(system, t, q, v, params)."
            )
    return q, v


def worst_residual(system, t, q, v, params):
    """The largest residual along a trajectory, of positions and velocities, relative to its size.

    A residual counts as its size over `Σ_j |A_ij| Q`, Q the largest coordinate on the trajectory (the largest
    velocity for the velocity level): what a displacement as large as the motion would make of it.
    """
    residual, slope, size = jax.vmap(lambda t, q, v: residuals_and_slopes(system, t, q, v, params))(t, q, v)
    # Outputs after an event or a failure are NaN and say nothing about the constraints.
    scale = slope @ level_size(jnp.nanmax(size, axis=0))
    return jnp.nanmax(jnp.abs(residual) / jnp.where(scale > 0, scale, 1.0))


def level_size(size):
    """The largest coordinate and the largest velocity, in place of each: one zero sets no scale."""
    positions, velocities = jnp.split(size, 2)
    return jnp.concatenate([jnp.full_like(positions, positions.max()), jnp.full_like(velocities, velocities.max())])


@eqx.filter_jit
def residuals_and_slopes(system, t, q, v, params):
    """`(r, |J|, |y|)`: residuals of both levels, their slopes in `y = (q, v)`, and the sizes of y."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    position = constraints.position_residual(system, t, x, params, unflatten)
    velocity = constraints.velocity_residual(system, t, x, u, params, unflatten)
    slope_u = constraints.acceleration_rows(system, t, x, u, params, unflatten).jacobian
    # ∂(dg/dt)/∂v = ∂g/∂q: the holonomic rows serve both levels.
    slope_x = slope_u[constraints.holonomic_equations(system, t, q, v, params)]
    slope = jnp.block(
        [
            [slope_x, jnp.zeros((position.size, u.size), x.dtype)],
            [jnp.zeros((velocity.size, x.size), x.dtype), slope_u],
        ]
    )
    return jnp.concatenate([position, velocity]), jnp.abs(slope), jnp.abs(jnp.concatenate([x, u]))


def departures(system, s: coordinates.State, rtol, atol) -> str:
    """Name the constraints that a state violates by more than a displacement `atol + rtol |y|`; else ''."""
    residual, slope, size = (np.asarray(part) for part in residuals_and_slopes(system, *s))
    # NaN is a violation too.
    off = np.flatnonzero(~(np.abs(residual) <= slope @ (atol + rtol * np.asarray(level_size(size)))))
    equations = list(zip(equation_names(system, s), constraints.holonomic_equations(system, *s)))
    labels = [f"'{name}'" for name, holonomic in equations if holonomic]
    labels += [f"d/dt '{name}'" if holonomic else f"'{name}'" for name, holonomic in equations]
    return ", ".join(f"{labels[i]} = {residual[i]:.3g}" for i in off)


@eqx.filter_jit
def _consistent_state(system, t, q, v, params):
    def newton_step(state, _):
        return to_manifold(system, t, *state, params, iterations=1), None

    return lax.scan(newton_step, (q, v), length=NEWTON_FROM_AFAR)[0]
