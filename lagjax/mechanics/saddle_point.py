"""The saddle-point system: accelerations and multipliers of one state.

Lagrange's equations with constraints and the constraints at acceleration level,

    M a = F + Aᵀ λ,    A a = gamma,

are one symmetric linear system in (a, -λ):

    [M  Aᵀ] [ a]   [  F  ]
    [A  0 ] [-λ] = [gamma]

It is regular where M is definite on the directions that the constraints leave free and the rows of A
are independent. M itself may be singular (a massless wedge) or indefinite. Without constraints only
`M a = F` is compiled.

**Redundant constraints.** Where rows depend on others (a loop closed twice, a door on three hinges), a is
still unique, and λ is not: any λ + n with Aᵀ n = 0 exerts the same force. A largest set of independent rows
is chosen and the others are left out of the solve, which stays regular: their rows and columns become those of
the unit matrix. With every row a combination of the chosen ones, A = C A_chosen, the force fixes only
Cᵀ λ = λ_chosen, and the shortest such λ is `C (Cᵀ C)⁻¹ λ_chosen`.

The choice is made where the constraints hold. Away from there, as in the stages of a step, dependent rows
disagree by as much as the state is off, and solving with all of them would divide that by itself.

Source: Goldstein, Eq. (2.24)-(2.27); Hairer & Wanner, *Solving ODEs II*, Eq. (VII.1.46); García de Jalón &
Gutiérrez-López, Multibody Syst. Dyn. 30 (2013) 311 (uniqueness of a, minimum-norm λ).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.mechanics import constraints, coordinates, sparse_plan, sparse_saddle_point
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.lagrangian import Linear, mass_and_forcing
from lagjax.numerics import dense
from lagjax.numerics.rank import DEPENDENT_BELOW, independent_rows, unit_rows

# Below this reciprocal condition, after scaling, the matrix counts as singular.
SINGULAR_BELOW = {np.dtype("float64"): 1e-13, np.dtype("float32"): 1e-6}
# A constraint whose derivative is this much smaller than near by has none: it is written as a square.
VANISHES_BELOW = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-4}


# Jitted, so that JAX traces L once for all the places of a compiled trajectory that need accelerations.
@eqx.filter_jit
def equations_of_motion(system, t, q, v, params, baumgarte_rate=None, independent=None):
    """The accelerations, like q, and the multipliers by name.

    `independent` (m,) says which constraint equations to solve with; chosen at this state if None.
    """
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    if (plan := sparse_plan.plan(system, t, q, v, params)) is not None:
        a, multipliers = sparse_saddle_point.accelerations(
            plan, system, t, x, u, params, unflatten, baumgarte_rate, independent
        )
        return unflatten(a), constraints.split(system, multipliers, t, q, v, params)
    linear = mass_and_forcing(system, t, x, u, params, unflatten)
    if not system.constraints:
        return unflatten(dense.solve(linear.mass, linear.forcing)), {}
    jacobian, gamma = constraints.acceleration_rows(system, t, x, u, params, unflatten)
    if baumgarte_rate is not None:
        gamma = gamma + constraints.baumgarte_feedback(system, t, x, u, params, unflatten, baumgarte_rate)
    independent = independent_rows(jacobian) if independent is None else independent
    a, multipliers = saddle_point(linear.mass, jacobian, linear.forcing, gamma, independent)
    return unflatten(a), constraints.split(system, multipliers, t, q, v, params)


@eqx.filter_jit
def independent_equations(system, t, q, v, params, dependent_below=None) -> Bool[Array, " m"] | None:
    """Which constraint equations to solve with near a state; None where one or none leaves no choice."""
    if constraints.count(system, t, q, v, params) < 2:
        return None
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    if (plan := sparse_plan.plan(system, t, q, v, params)) is not None:
        return sparse_saddle_point.independent(plan, system, t, x, u, params, unflatten, dependent_below)
    return independent_rows(constraints.jacobian(system, t, x, u, params, unflatten), dependent_below)


def saddle_point(mass, jacobian, forcing, gamma, independent):
    """Solve `M a - Aᵀ λ = F`, `A a = gamma` for a and the shortest λ, with the independent rows of A."""
    n = mass.shape[0]
    known = jnp.concatenate([forcing, _pick(gamma, independent, n)])
    solution = dense.solve(saddle_point_matrix(mass, jacobian, independent), known)
    multipliers = _spread(-solution[n:], independent)
    return solution[:n], minimum_norm(jacobian, multipliers, independent)


def saddle_point_matrix(mass, jacobian, independent):
    """`[[M, Aᵀ], [A, 0]]` with the independent rows of A; those of the unit matrix in place of the others."""
    m, n = jacobian.shape
    rows = _pick(jacobian, independent, n)
    filled = _pick(jnp.ones_like(jacobian[:, 0]), independent, n) if m > 1 else jnp.ones(m, mass.dtype)
    return jnp.block([[mass, rows.T], [rows, jnp.diag(1 - filled)]])


def displacement_map(mass, jacobian, independent):
    """The shortest displacement in the metric of M that changes the residuals by a given amount, (n, m)."""
    n = mass.shape[0]
    inverted = dense.inverse(saddle_point_matrix(mass, jacobian, independent))
    return _spread(inverted[:n, n:], independent)


def row_sizes(system, t, q, v, params) -> Float[Array, " m"]:
    """`Σ_j |A_ij|` of each constraint equation."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    if (plan := sparse_plan.plan(system, t, q, v, params)) is not None:
        return sparse_saddle_point.row_sizes(plan, system, t, x, u, params, unflatten)
    return jnp.sum(jnp.abs(constraints.jacobian(system, t, x, u, params, unflatten)), axis=1)


class Return(NamedTuple):
    """How to return to the constraints near a state: displacements by residuals of some equations, and the slopes."""

    displacement: Callable
    slope: Float[Array, " m"]


def returning(system, t, q, v, params) -> Return:
    """`displacement(which, r)` changes the residuals of the equations `which` by r; `slope` is `Σ_j |A_ij|`."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    state = (system, t, x, u, params, unflatten)
    if (plan := sparse_plan.plan(system, t, q, v, params)) is not None:
        kept = sparse_saddle_point.independent(plan, *state)
        displacement = sparse_saddle_point.displacement(plan, *state, kept)
        placed = lambda which, r: jnp.zeros(which.size, r.dtype).at[np.flatnonzero(which)].set(r)
        return Return(lambda which, r: displacement(placed(which, r)), sparse_saddle_point.row_sizes(plan, *state))
    jacobian = constraints.jacobian(*state)
    # Chosen here and not at the step's start: the step may have come near a singular position.
    matrix = displacement_map(mass_and_forcing(*state).mass, jacobian, independent_rows(jacobian))
    return Return(lambda which, r: matrix[:, which] @ r, jnp.sum(jnp.abs(jacobian), axis=1))


def _pick(x, independent, n):
    """The entries of x (m, ...) that belong to independent equations: min(m, n) rows, zero where there are fewer.

    No more than n can be independent: with many redundant ones the system is smaller than it was written.
    """
    m = x.shape[0]
    if m > n:
        return jnp.tensordot(_places(independent, n, x.dtype), x, 1)
    return x if m < 2 else jnp.where(independent.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)


def _spread(x, independent):
    """Undo `_pick` along the last axis of x: zeros where an equation was left out."""
    m, picked = independent.size, x.shape[-1]
    if m > picked:
        return jnp.tensordot(x, _places(independent, picked, x.dtype), 1)
    return x if m < 2 else jnp.where(independent if x.ndim == 1 else independent[None], x, 0.0)


def _places(independent, n, dtype):
    """The matrix of zeros and ones that puts the independent equations first, (n, m)."""
    place = jnp.cumsum(independent) - 1
    return (independent[None, :] & (place[None, :] == np.arange(n)[:, None])).astype(dtype)


def minimum_norm(jacobian, multipliers, independent):
    """The shortest multipliers that exert the force of `multipliers`, which are zero on dependent rows."""
    if jacobian.shape[0] < 2:
        return multipliers
    combined = combinations(jacobian, independent)
    gram = combined.T @ combined + jnp.diag(jnp.where(independent, 0.0, 1.0))
    shortest = combined @ dense.solve(gram, multipliers)
    # Without dependent rows the two agree; this keeps the last digit.
    return jnp.where(jnp.all(independent), multipliers, shortest)


def combinations(jacobian: Float[Array, "m n"], independent: Bool[Array, " m"]) -> Float[Array, "m m"]:
    """C with `A = C A_chosen`: each row of A as a combination of the independent ones; differentiable.

    Least squares on rows of length one; columns of dependent rows are zero.
    """
    rows, size = unit_rows(jacobian)
    chosen = jnp.where(independent[:, None], rows, 0.0)
    gram = chosen @ chosen.T + jnp.diag(jnp.where(independent, 0.0, 1.0))
    coefficients = jax.vmap(dense.solve, in_axes=(None, 0))(gram, rows @ chosen.T)
    scaled = coefficients * size[:, None] / jnp.where(size > 0, size, 1.0)[None, :]
    unit = jnp.eye(size.size, dtype=jacobian.dtype)
    return jnp.where(independent[:, None], unit, scaled)


@eqx.filter_jit
def verdict(system, t, q, v, params) -> sparse_saddle_point.Verdict:
    """Solve the equations at one state, and say whether the solution is to be believed."""
    plan = sparse_plan.plan(system, t, q, v, params)
    if plan is not None:
        x, unflatten = coordinates.flatten(q)
        u, _ = coordinates.flatten(v)
        least = VANISHES_BELOW[np.dtype(x.dtype)]
        found = sparse_saddle_point.verdict(plan, system, t, x, u, params, unflatten, least)
        return found._replace(
            a=unflatten(found.a), multipliers=constraints.split(system, found.multipliers, t, q, v, params)
        )
    found = examined(system, t, q, v, params)
    finite = jnp.all(jnp.isfinite(coordinates.flatten((found.a, found.multipliers, found.lagrangian))[0]))
    singular = dense.reciprocal_condition(found.matrix) <= SINGULAR_BELOW[np.dtype(t.dtype)]
    return sparse_saddle_point.Verdict(found.a, found.multipliers, finite, singular, jnp.any(found.contradictory))


def is_regular(system, t, q, v, params) -> Bool[Array, ""]:
    """Whether the equations at one state are regular: no constraint depends on others, and nothing is undetermined."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    mass = mass_and_forcing(system, t, x, u, params, unflatten).mass
    jacobian = _without_vanishing(system, t, x, u, params, unflatten).jacobian
    independent = independent_rows(jacobian)
    matrix = saddle_point_matrix(mass, jacobian, independent)
    return jnp.all(independent) & (dense.reciprocal_condition(matrix) > SINGULAR_BELOW[np.dtype(x.dtype)])


class Examined(NamedTuple):
    """A solution of the equations beside what tells whether to believe it."""

    a: PyTree[Array]
    multipliers: dict[str, Array]
    linear: Linear
    rows: constraints.Rows
    independent: Bool[Array, " m"]
    lagrangian: Float[Array, ""]
    matrix: Float[Array, "k k"]
    contradictory: Bool[Array, " m"]


@compiled
def examined(system, t, q, v, params) -> Examined:
    """Solve the equations at one state, and keep their matrix and which dependent constraints disagree."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    linear = mass_and_forcing(system, t, x, u, params, unflatten)
    rows = _without_vanishing(system, t, x, u, params, unflatten)
    independent = independent_rows(rows.jacobian)
    a, multipliers = saddle_point(linear.mass, rows.jacobian, linear.forcing, rows.gamma, independent)
    against = _contradictory(linear, rows, independent, a, multipliers, x, u)
    matrix = saddle_point_matrix(linear.mass, rows.jacobian, independent)
    lagrangian = jnp.asarray(system.lagrangian(t, q, v, params))
    return Examined(
        a=unflatten(a),
        multipliers=constraints.split(system, multipliers, t, q, v, params),
        linear=linear,
        rows=rows,
        independent=independent,
        lagrangian=lagrangian,
        matrix=matrix,
        contradictory=against,
    )


def _without_vanishing(system, t, x, u, params, unflatten):
    """The rows of all constraints, with those set to zero that are round-off: far larger a little way off."""
    rows = constraints.acceleration_rows(system, t, x, u, params, unflatten)
    if not rows.gamma.size:
        return rows
    x, u = map(sparse_saddle_point.slightly_off, (x, u))
    nearby = constraints.jacobian(system, t, x, u, params, unflatten)
    size = lambda rows: jnp.max(jnp.abs(rows), axis=1)
    least = VANISHES_BELOW[np.dtype(x.dtype)]
    vanishes = size(rows.jacobian) <= least * jnp.nan_to_num(size(nearby), posinf=0.0)
    return rows._replace(jacobian=jnp.where(vanishes[:, None], 0.0, rows.jacobian))


def _contradictory(linear, rows, independent, a, multipliers, x, u):
    """Which dependent equations ask for another acceleration than those that they depend on."""
    jacobian, gamma = rows
    disagreement = jnp.abs(jacobian @ a - gamma)
    terms = jnp.abs(jacobian) @ jnp.abs(a) + jnp.abs(gamma)
    forces = jnp.abs(linear.forcing) + jnp.abs(jacobian).T @ jnp.abs(multipliers)
    inertia = jnp.max(jnp.abs(linear.mass), axis=1)
    slopes = jnp.sum(jnp.abs(jacobian), axis=1)
    round_off = slopes * sparse_saddle_point.acceleration_round_off(inertia, forces, x, u)
    return ~independent & (disagreement > DEPENDENT_BELOW[np.dtype(x.dtype)] * terms + round_off)
