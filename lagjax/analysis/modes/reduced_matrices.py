"""The linear equations of small motions about a steady one, as matrices on the constraint surface.

With `x = x₀ + u₀ t + ξ` and f = F + (A + B)ᵀ λ, the total force with constraint forces for fixed multipliers,

    M ξ̈ + C ξ̇ + K ξ = Aᵀ δλ,    C = -∂f/∂u,    K = -∂f/∂x        (K contains λ·∂²g)

Holonomic constraints allow the positions ξ = P η, with A_h P = 0. Velocity constraints, A_v ξ̇ + B_v ξ = 0 with
B_v = ∂phi/∂q, allow fewer velocities, and a displacement ξ may require a nonzero one:

    ξ̇ = V w + W ξ,    A V = 0,    A W = -B_v (zero in the rows of holonomic constraints)

Multiplying from the left by Lᵀ with Lᵀ Aᵀ = 0 eliminates the constraint forces (L = V unless there is friction):

    (Lᵀ M V) ẇ + Lᵀ (M W + C) V w + Lᵀ ((M W + C) W + K) P η = 0,    η̇ = P⁺ (V w + W P η)

A coordinate that nothing depends on does not appear in these equations: it follows from ξ̇ and is left out of η.

A null space basis N₀ is computed without derivatives and then projected onto the null space of A: `N = (1 - A⁺ A) N₀`
is a smooth function of A with correct derivatives.

Source: Goldstein, *Classical Mechanics*, §6.1-6.2; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*, ch. V;
Meijaard, Papadopoulos, Ruina & Schwab, *Proc. R. Soc. A* 463 (2007) 1955, Appendix B (linearised velocity constraints).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.mechanics import forcing_and_inertia, response
from lagjax.numerics import dense, independent_rows, lapack
from lagjax.system import Model, State, constraints

# The reduced mass matrix is singular if its reciprocal condition, after scaling, is below this.
SINGULAR_BELOW = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}


class LinearisationKind(NamedTuple):
    """The static part of a linearisation, known before its numbers are; hashable.

    - `unseen` (n,): coordinates that nothing depends on. `holonomic` (m,): which constraint equations are holonomic.
    - `independent` (m,): which constraint equations are used.
    - `conservative`: there is no force, no dissipation and no velocity constraint; `at_rest`: velocities are zero and L
      has no terms linear in them.
    - `timeless`: nothing depends on time.
    """

    unseen: tuple[bool, ...]
    holonomic: tuple[bool, ...]
    independent: tuple[bool, ...]
    conservative: bool
    at_rest: bool
    timeless: bool


class Raw(NamedTuple):
    """The matrices in the original coordinates, which must not change along a steady motion."""

    mass: Float[Array, "n n"]
    velocity: Float[Array, "n n"]
    position: Float[Array, "n n"]
    rows: Float[Array, "m n"]
    slopes: Float[Array, "m n"]


class LinearParts(NamedTuple):
    """The reduced equations, `mass ẇ + velocity w + position η = 0` and `η̇ = drift η + transfer w`.

    - `positions` (n, n_p): P, with zero rows for coordinates that nothing depends on; `velocities`: V; `turning`: W P.
    - `a`: the accelerations at the state itself, zero in a steady motion; `off`: the residuals of the constraints on
      positions and velocities; `forces`: the size of the balancing forces in each coordinate, divided by its inertia.
    - `sound`: the reduced mass matrix is regular and all entries are finite; `independent` (m,): which constraint
      equations are independent.
    """

    mass: Float[Array, "k k"]
    velocity: Float[Array, "k k"]
    position: Float[Array, "k p"]
    drift: Float[Array, "p p"]
    transfer: Float[Array, "p k"]
    positions: Float[Array, "n p"]
    velocities: Float[Array, "n k"]
    turning: Float[Array, "n p"]
    multipliers: PyTree[Array]
    a: Float[Array, " n"]
    off: Float[Array, " r"]
    forces: Float[Array, " n"]
    sound: Bool[Array, ""]
    independent: Bool[Array, " m"]
    raw: Raw


def parts_of(kind: LinearisationKind, model: Model, s: State) -> LinearParts:
    """The reduced equations at one state."""
    t, (x, u) = s.t, model.vectors(s.q, s.v)
    n, m = model.n, len(kind.holonomic)
    unseen, holonomic = np.array(kind.unseen, bool), np.array(kind.holonomic, bool)
    chosen = np.array(kind.independent, bool)

    mass = jax.jacfwd(lambda u: jax.grad(model.lagrangian, argnums=2)(t, x, u))(u).astype(x.dtype)
    mass = (mass + mass.T) / 2
    velocity, position, forcing = _forces(kind, model, t, x, u)
    rows, gamma = constraints.acceleration_rows(model, t, x, u)
    slopes = jax.jacfwd(lambda x: constraints.velocity_residual(model, t, x, u))(x)
    slopes = jnp.where(holonomic[:, None], 0.0, slopes).astype(x.dtype)
    friction = response(model, t, x, u)
    pushing = rows.T if friction is None else rows.T + friction

    all_independent = independent_rows(rows) if m else jnp.zeros(0, bool)
    live, positions_live = rows[chosen], rows[chosen & holonomic][:, ~unseen]
    velocities, lift = _null_space(live, all_independent[chosen])
    kept, _ = _null_space(positions_live, all_independent[chosen & holonomic])
    positions = jnp.zeros((n, kept.shape[1]), x.dtype).at[~unseen].set(kept)
    if holonomic.all():
        # Positions and velocities share their directions; coordinates that nothing depends on come first.
        velocities = jnp.concatenate([jnp.eye(n, dtype=x.dtype)[:, unseen], positions], axis=1)
    left = velocities if friction is None else _null_space(pushing.T[chosen], all_independent[chosen])[0]

    # The multipliers that balance the force in a steady motion, a = 0.
    stacked = _spread(rows, live, lift, chosen, -_least_squares(pushing[:, chosen], forcing))

    if m:

        def force_of_constraints(x: Array, u: Array) -> Array:
            return jax.grad(lambda u: stacked @ constraints.velocity_residual(model, t, x, u))(u)

        by_position, by_velocity = jax.jacfwd(force_of_constraints, argnums=(0, 1))(x, u)
        velocity, position = velocity - by_velocity.astype(x.dtype), position - by_position.astype(x.dtype)
    if friction is not None:

        def friction_force(x, u):
            by_multipliers = response(model, t, x, u)
            assert by_multipliers is not None
            return by_multipliers @ stacked

        by_position, by_velocity = jax.jacfwd(friction_force, argnums=(0, 1))(x, u)
        velocity, position = velocity - by_velocity.astype(x.dtype), position - by_position.astype(x.dtype)
    if kind.at_rest:
        velocity = jnp.zeros_like(velocity)
    elif kind.conservative:
        velocity = (velocity - velocity.T) / 2
    if kind.conservative:
        position = (position + position.T) / 2

    reduced_mass = left.T @ mass @ velocities
    if holonomic.all():
        turning = jnp.zeros((n, n), x.dtype)
        shifts = int(unseen.sum())
        drift, transfer = (
            jnp.zeros((kept.shape[1],) * 2, x.dtype),
            jnp.eye(n - int(chosen.sum()), dtype=x.dtype)[shifts:],
        )
    else:
        turning = -lift @ slopes[chosen]
        # P⁺ of the nearly orthonormal P, without the rows of coordinates that nothing depends on.
        back = _left_inverse(kept)
        drift, transfer = back @ (turning @ positions)[~unseen], back @ velocities[~unseen]
    moved = mass @ turning + velocity
    parts = (
        reduced_mass,
        left.T @ moved @ velocities,
        left.T @ (moved @ turning + position) @ positions,
        drift,
        transfer,
    )
    onto = lift @ gamma[chosen] if m else jnp.zeros_like(x)
    sound = jnp.asarray(True)
    for part in parts:
        sound = sound & jnp.all(jnp.isfinite(part))
    sound = sound & (_reciprocal_condition(reduced_mass) > SINGULAR_BELOW[np.dtype(x.dtype)])
    safe = jnp.where(sound, reduced_mass, jnp.eye(reduced_mass.shape[0], dtype=x.dtype))
    a = onto + velocities @ lapack.solve(safe, (left.T @ (forcing - mass @ onto))[:, None])[:, 0]
    off = [constraints.position_residual(model, t, x)] if holonomic.any() else []
    off += [constraints.velocity_residual(model, t, x, u)] if m else []
    constraint_force = pushing @ stacked if m else jnp.zeros_like(x)
    diagonal = jnp.abs(jnp.diag(mass))
    forces = (jnp.abs(forcing) + jnp.abs(constraint_force)) / jnp.where(diagonal > 0, diagonal, 1.0)
    return LinearParts(
        *parts, positions, velocities, turning @ positions,
        model.split(stacked), a,
        jnp.concatenate(off) if off else jnp.zeros(0, x.dtype), forces, sound, all_independent,
        Raw(mass, velocity, position, rows, slopes),
    )  # fmt: skip


def _forces(kind: LinearisationKind, model: Model, t, x, u):
    """-∂F/∂u, -∂F/∂x and F, without constraint forces."""
    if kind.at_rest:
        # At rest there is no momentum, so the force is that of the potential.
        slope = jax.grad(model.lagrangian, argnums=1)
        position, forcing = jax.jacfwd(lambda x: 2 * (slope(t, x, jnp.zeros_like(u)),), has_aux=True)(x)
        return jnp.zeros((x.size, x.size), x.dtype), -position.astype(x.dtype), forcing.astype(x.dtype)

    def force(x, u):
        forcing, _ = forcing_and_inertia(model, t, x, u)
        return forcing, forcing

    (position, velocity), forcing = jax.jacfwd(force, argnums=(0, 1), has_aux=True)(x, u)
    return -velocity.astype(x.dtype), -position.astype(x.dtype), forcing


def _null_space(rows, independent):
    """A basis (n, n - r) of the null space of rows (r, n), and their right inverse (n, r); smooth in the rows."""
    r, n = rows.shape
    if r == 0:
        return jnp.eye(n, dtype=rows.dtype), jnp.zeros((n, 0), rows.dtype)
    # Dependent rows are left out to avoid NaN here; `Parts.independent` reports them to the caller.
    rows = jnp.where(independent[:, None], rows, 0.0)
    start = lapack.complement(rows.T)
    gram = rows @ rows.T + jnp.diag(jnp.where(independent, 0.0, 1.0).astype(rows.dtype))
    lift = dense.solved(gram, rows).T
    return start - lift @ (rows @ start), lift


def _left_inverse(basis):
    return dense.solved(basis.T @ basis, basis.T) if basis.shape[1] else basis.T


def _least_squares(columns, target):
    """The least-squares solution y of `columns y = target`, for independent columns."""
    if columns.shape[1] == 0:
        return jnp.zeros(0, target.dtype)
    gram = columns.T @ columns
    size = jnp.diag(gram)
    return dense.solved(gram + jnp.diag(jnp.where(size > 0, 0.0, 1.0)), columns.T @ target)


def _spread(rows, live, lift, chosen, multipliers: PyTree):
    """The shortest multipliers of all equations that exert the same force as the chosen ones."""
    if chosen.all():
        return multipliers
    # Each row is a combination of the chosen ones.
    combination = rows @ lift
    return combination @ dense.solved(combination.T @ combination, multipliers)


def _reciprocal_condition(matrix):
    """The reciprocal condition of a matrix after its rows and columns are scaled by their largest entries."""
    matrix = jnp.where(jnp.isfinite(matrix), lax.stop_gradient(matrix), 0.0)
    largest = jnp.sqrt(jnp.maximum(jnp.max(jnp.abs(matrix), axis=0), jnp.max(jnp.abs(matrix), axis=1)))
    scale = jnp.where(largest > 0, largest, 1.0)
    sizes = lapack.singular_values(matrix / (scale[:, None] * scale[None, :]))
    return sizes[-1] / jnp.where(sizes[0] > 0, sizes[0], 1.0)
