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
disagree by as much as the state is off, and solving with all of them would divide two such errors by each other.

Source: Goldstein, Eq. (2.24)-(2.27); Hairer & Wanner, *Solving ODEs II*, Eq. (VII.1.46); García de Jalón &
Gutiérrez-López, Multibody Syst. Dyn. 30 (2013) 311 (uniqueness of a, minimum-norm λ).

Judge whether a solution of the equations at one state is valid.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, jitted
from lagjax.mechanics.first_order import completed, is_determined, resolved, with_first_order
from lagjax.mechanics.lagrangian import LinearEquation, applied_force, mass_and_forcing
from lagjax.mechanics.multiplier_forces import Reactions, at_once, response, with_reactions
from lagjax.numerics import DEPENDENT_BELOW, SINGULAR_BELOW, dense, independent_rows, unit_rows
from lagjax.system import Model, State, constraints

# A constraint whose derivative is this much smaller than nearby has none: it is written as a square.
VANISHES_BELOW = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-4}


class Verdict(NamedTuple):
    """A solution of the equations at one state, as vectors or by name, and whether it is valid.

    `mass`: the largest entry of each row of M. `given`: residuals and A at the state before it was returned to the
    constraints, where they are known.
    """

    a: PyTree[Array]
    multipliers: Any
    finite: Bool[Array, ""]
    singular: Bool[Array, ""]
    contradictory: Bool[Array, ""]
    mass: Float[Array, " n"]
    given: tuple[Float[Array, "2 m"], Float[Array, "m n"]] | None = None


def slightly_off(y: Array):
    """Shift a position or velocity by a thousandth of its size, differently in each coordinate."""
    size = jnp.max(jnp.abs(y))
    return y + 1e-3 * jnp.cos(jnp.arange(y.size, dtype=y.dtype)) * jnp.where(size > 0, size, 1.0)


def vanishing(size: Array, nearby: Array):
    """Which rows of A are round-off: their `size` is far below that at a nearby state."""
    return size <= VANISHES_BELOW[np.dtype(size.dtype)] * jnp.nan_to_num(nearby, posinf=0.0)


def acceleration_round_off(inertia, forces, x: Array, u: Array):
    """The round-off of an acceleration in equilibrium or uniform motion, where all its terms nearly cancel."""
    by_force = jnp.max(jnp.where(inertia > 0, forces / jnp.where(inertia > 0, inertia, 1.0), 0.0))
    extent = jnp.max(jnp.abs(x))
    by_velocity = jnp.max(jnp.abs(u)) ** 2 / jnp.where(extent > 0, extent, 1.0)
    return 1e4 * jnp.finfo(x.dtype).eps * (by_force + by_velocity)


class Known(NamedTuple):
    """What is known of a state besides: L, M, A and the residuals of positions and velocities."""

    lagrangian: Float[Array, ""]
    mass: Float[Array, "n n"]
    jacobian: Float[Array, "m n"]
    residuals: Float[Array, "2 m"]


def known_at(model: Model, t: Array, x: Array, u: Array, mass: Array, jacobian: Array) -> Known:
    """What is known of a state, given M and A."""
    return Known(jnp.asarray(model.lagrangian(t, x, u)), mass, jacobian, constraints.residuals(model, t, x, u))


class Dense(NamedTuple):
    """The equations solved as one matrix of `unknowns` rows. A state is given as (model, t, x, u).

    `diagonal`: there are no constraints, and the mass matrix is known to be diagonal. `regular`: all constraint
    equations are solved with, and the results are NaN where they depend on each other.
    """

    unknowns: int
    diagonal: bool = False
    regular: bool = False

    def accelerations(
        self,
        model: Model,
        t: Array,
        x: Array,
        u: Array,
        baumgarte_rate: Array | None = None,
        independent: Array | None = None,
    ):
        """The accelerations and the stacked multipliers, as vectors; `independent` (m,): which equations to solve with.

        If None, they are chosen at this state.
        """
        linear, (jacobian, gamma) = linear_equations(model, t, x, u)
        if not model.m:
            no_multipliers = jnp.zeros(0, x.dtype)
            if self.diagonal:
                return linear.forcing / jnp.sum(linear.mass, axis=1), no_multipliers
            return dense.solve(linear.mass, linear.forcing), no_multipliers
        if baumgarte_rate is not None:
            gamma = gamma + constraints.baumgarte_feedback(model, t, x, u, baumgarte_rate)
        independent = self._chosen(model, jacobian) if independent is None else independent
        return _solved(linear, jacobian, gamma, independent)[:2]

    def with_more(self, model: Model, t: Array, x: Array, u: Array):
        """The accelerations and the stacked multipliers, and what else is `Known`."""
        linear, rows = linear_equations(model, t, x, u)
        a, multipliers, unique = _solved(linear, *rows, self._chosen(model, rows.jacobian))
        a = jnp.where(unique, completed(model, t, x, u, a), jnp.nan)
        return (model.tree(a), multipliers), known_at(model, t, x, u, linear.mass, rows.jacobian)

    def _chosen(self, model: Model, jacobian: Array, dependent_below: float | None = None):
        return None if self.regular else chosen(model, jacobian, dependent_below)

    def independent(
        self, model: Model, t: Array, x: Array, u: Array, dependent_below: float | None = None
    ) -> Bool[Array, " m"] | None:
        """Which constraint equations to solve with; None: all."""
        return self._chosen(model, linear_equations(model, t, x, u)[1].jacobian, dependent_below)

    def displacement(self, *state) -> Callable:
        """`displacement(r)`: the shortest one, in the metric of M, that changes the residuals by r."""
        linear, (jacobian, _) = linear_equations(*state)
        # The rows are chosen here and not at the step's start, as the step may have come near a singular position.
        matrix = displacement_map(linear.mass, jacobian, self._chosen(state[0], jacobian))
        return lambda r: matrix @ r

    def row_sizes(self, *state) -> Float[Array, " m"]:
        """`Σ_j |A_ij|` of each constraint equation."""
        return jnp.sum(jnp.abs(linear_equations(*state)[1].jacobian), axis=1)

    def verdict(self, *state) -> Verdict:
        """Solve the equations at one state, and say whether they are finite, regular, and agree with each other."""
        found = _examined(*state)
        solution = jnp.concatenate([found.a, found.multipliers, jnp.ravel(found.lagrangian)])
        singular = dense.reciprocal_condition(found.matrix) <= SINGULAR_BELOW[np.dtype(found.matrix.dtype)]
        finite, contradictory = jnp.all(jnp.isfinite(solution)), jnp.any(found.contradictory)
        singular = singular | ~found.unique
        return Verdict(found.a, found.multipliers, finite, singular, contradictory, largest_of_rows(found.linear.mass))

    def solution_or_nan(self, *state):
        """The solution as vectors, NaN where constraints contradict each other."""
        found = _examined(*state)
        valid = found.unique & ~jnp.any(found.contradictory)
        return tuple(jnp.where(valid, x, jnp.nan) for x in (found.a, found.multipliers))

    def __str__(self):
        by = "division" if self.diagonal else "elimination" if self.unknowns <= dense.ELIMINATE_UP_TO else "LAPACK"
        return f"{self.unknowns} equations by {by}"


# Jitted, so that JAX traces the derivatives of L and of the constraints once for all that needs them.
@jitted
def linear_equations(model: Model, t: Array, x: Array, u: Array) -> tuple[LinearEquation, constraints.ConstraintRows]:
    """`M a = F` and `A a = gamma` at one state.

    Momenta and constraints are linearised together, and pushed along the motion and the unit velocities as the lanes of
    one program, some two thirds as long as programs for each of M, F, A and gamma.
    """
    if not model.m or model.form.first_order is not None:
        # Alone M may be constant, and is then factored before a loop over states.
        return mass_and_forcing(model, t, x, u), constraints.acceleration_rows(model, t, x, u)

    def of_state(t: Array, x: Array, u: Array):
        gradient, p = jax.grad(model.lagrangian, argnums=(1, 2))(t, x, u)
        return (p, constraints.velocity_residual(model, t, x, u)), gradient

    _, push, gradient = jax.linearize(of_state, t, x, u, has_aux=True)
    still = jnp.zeros((x.size, x.size), x.dtype)
    along_t = jnp.ones_like(t) * jnp.eye(1, x.size + 1, dtype=x.dtype)[0]
    along_x, along_u = jnp.concatenate([u[None], still]), jnp.eye(x.size + 1, x.size, -1, dtype=x.dtype)
    momentum, residual = jax.vmap(push)(along_t, along_x, along_u)
    forcing = gradient - momentum[0] + applied_force(model, t, x, u)
    reacting = response(model, t, x, u) if model.reacts else None
    linear = LinearEquation(momentum[1:].astype(x.dtype), forcing.astype(x.dtype), reacting)
    return linear, constraints.ConstraintRows(residual[1:].T, -residual[0])


def chosen(model: Model, jacobian: Array, dependent_below: float | None = None) -> Bool[Array, " m"]:
    """Which constraint equations to solve with: independent ones, of those that are not off."""
    independent = independent_rows(jacobian, dependent_below)
    return independent if model.off is None else independent & ~model.off


def solve_saddle_point(mass: Array, jacobian: Array, forcing: Array, gamma: Array, independent: Array | None):
    """Solve `M a - Aᵀ λ = F`, `A a = gamma` for a and the shortest λ, with the independent rows of A.

    If None, with all of them; NaN where they depend on each other.
    """
    n = mass.shape[0]
    if independent is None:
        matrix, inverted = inverse_if_regular(mass, jacobian)
        a, multipliers = jnp.split(dense.refined(inverted, matrix, jnp.concatenate([forcing, gamma])), [n])
        return a, -multipliers
    known = jnp.concatenate([forcing, _pick(gamma, independent, n)])
    solution = dense.solve(saddle_point_matrix(mass, jacobian, independent), known)
    multipliers = _spread(-solution[n:], independent)
    return solution[:n], minimum_norm(jacobian, multipliers, independent)


def inverse_if_regular(mass: Array, jacobian: Array):
    """The saddle-point matrix of all rows, and its inverse: NaN where a row would be left out.

    Its columns hold displacements that change one residual by one and the others not at all. None of these is shorter
    than 1 / (|A_i| s), with s the sine of the angle of the row to the span of the others.
    """
    m, n = jacobian.shape
    matrix = jnp.block([[mass, jacobian.T], [jacobian, jnp.zeros((m, m), mass.dtype)]])
    inverted = dense.inverse(matrix)
    squared = jnp.sum(jacobian**2, axis=1) * jnp.sum(inverted[:n, n:] ** 2, axis=0)
    regular = jnp.max(squared) < DEPENDENT_BELOW[np.dtype(mass.dtype)] ** -2
    return matrix, jnp.where(regular, inverted, jnp.nan)


def _solved(linear: LinearEquation, jacobian: Array, gamma: Array, independent: Array | None) -> Reactions:
    """The solution where the force may depend on the multipliers."""
    return with_reactions(
        lambda forcing, gamma: solve_saddle_point(linear.mass, jacobian, forcing, gamma, independent),
        linear.forcing,
        gamma,
        linear.response,
        at_once,
    )


def saddle_point_matrix(mass: Array, jacobian: Array, independent: Array):
    """`[[M, Aᵀ], [A, 0]]` with the independent rows of A, and rows of the unit matrix in place of the others."""
    m, n = jacobian.shape
    rows = _pick(jacobian, independent, n)
    filled = _pick(jnp.ones_like(jacobian[:, 0]), independent, n) if m > 1 else independent.astype(mass.dtype)
    return jnp.block([[mass, rows.T], [rows, jnp.diag(1 - filled)]])


def _scaled_matrix(mass: Array, jacobian: Array, independent: Array):
    """The saddle-point matrix with M and A each divided by its largest entry, to judge whether it is singular."""

    def scaled(x: Array) -> Array:
        return x / jnp.where(jnp.any(x != 0), jnp.max(jnp.abs(x), initial=0.0), 1.0)

    return saddle_point_matrix(scaled(mass), scaled(jacobian), independent)


def displacement_map(mass: Array, jacobian: Array, independent: Array | None):
    """The shortest displacement in the metric of M that changes the residuals by a given amount, (n, m)."""
    n = mass.shape[0]
    if independent is None:
        return inverse_if_regular(mass, jacobian)[1][:n, n:]
    inverted = dense.inverse(saddle_point_matrix(mass, jacobian, independent))
    return _spread(inverted[:n, n:], independent)


def corrected(model: Model, t: Array, y: Float[Array, "2 n"], known):
    """The state after one of Newton's iterations to all constraints, the shortest in the metric of M.

    `known`: M, A and the residuals there.
    """
    if model.m:
        used = jnp.ones(model.m, bool) if model.off is None else ~model.off
        y = y - known.residuals @ displacement_map(known.mass, known.jacobian, used).T
    return jnp.stack([y[0], resolved(model, t, *y)])


def _pick(x: Array, independent: Array, n: int):
    """The entries of x (m, ...) that belong to independent equations: min(m, n) rows, zero where there are fewer.

    No more than n can be independent: with many redundant ones the system is smaller than it was written.
    """
    m = x.shape[0]
    if m > n:
        return jnp.tensordot(_places(independent, n, x.dtype), x, 1)
    return x if m < 2 else jnp.where(independent.reshape(-1, *[1] * (x.ndim - 1)), x, 0.0)


def _spread(x: Array, independent: Array):
    """Undo `_pick` along the last axis of x: zeros where an equation was left out."""
    m, picked = independent.size, x.shape[-1]
    if m > picked:
        return jnp.tensordot(x, _places(independent, picked, x.dtype), 1)
    return x if m < 2 else jnp.where(independent if x.ndim == 1 else independent[None], x, 0.0)


def _places(independent: Array, n: int, dtype: DTypeLike):
    """The matrix of zeros and ones that puts the independent equations first, (n, m)."""
    place = jnp.cumsum(independent) - 1
    return (independent[None, :] & (place[None, :] == np.arange(n)[:, None])).astype(dtype)


def minimum_norm(jacobian: Array, multipliers: Array, independent: Array):
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


def is_regular(model: Model, mass: Array, jacobian: Array, nearby: Array) -> Bool[Array, ""]:
    """Whether no constraint depends on others and no acceleration is undetermined, by M and A at one state.

    `nearby`: A at a state that is `slightly_off`.
    """
    jacobian = _where_it_counts(jacobian, nearby)
    independent = chosen(model, jacobian)
    matrix = _scaled_matrix(mass, jacobian, independent)
    known = independent if model.off is None else independent | model.off
    return jnp.all(known) & (dense.reciprocal_condition(matrix) > SINGULAR_BELOW[np.dtype(mass.dtype)])


def largest_of_rows(mass: Array) -> Float[Array, " n"]:
    """The largest entry of each row."""
    return jnp.max(jnp.abs(mass), axis=1)


class Examined(NamedTuple):
    """A solution of the equations, with what decides whether it is valid.

    `matrix`: the saddle-point matrix, with M and A each divided by its largest entry. `unique`: whether the equations
    have one solution where the force depends on the multipliers, and for velocities of first order.
    """

    a: PyTree[Array]
    multipliers: Any
    linear: LinearEquation
    rows: constraints.ConstraintRows
    independent: Bool[Array, " m"]
    lagrangian: Float[Array, ""]
    matrix: Float[Array, "k k"]
    contradictory: Bool[Array, " m"]
    unique: Bool[Array, ""]


@compiled
def examined(model: Model, s: State) -> Examined:
    """Solve the equations at one state, and keep their matrix and which dependent constraints disagree."""
    model, state = with_first_order(model), (s.t, *model.vectors(s.q, s.v))
    found = _examined(model, *state)
    a = completed(model, *state, found.a)
    return found._replace(a=model.tree(a), multipliers=model.split(found.multipliers))


def _examined(model: Model, t: Array, x: Array, u: Array) -> Examined:
    """The same in vector form."""
    linear, rows = linear_equations(model, t, x, u)
    rows = _without_vanishing(model, rows, t, x, u)
    independent = chosen(model, rows.jacobian)
    a, multipliers, unique = _solved(linear, rows.jacobian, rows.gamma, independent)
    return Examined(
        a=a,
        multipliers=multipliers,
        linear=linear,
        rows=rows,
        independent=independent,
        lagrangian=jnp.asarray(model.lagrangian(t, x, u)),
        matrix=_scaled_matrix(linear.mass, rows.jacobian, independent),
        contradictory=_contradictory(linear, rows, independent, a, multipliers, x, u),
        unique=unique & is_determined(model, t, x, u),
    )


def _without_vanishing(model: Model, rows: constraints.ConstraintRows, t: Array, x: Array, u: Array):
    """The rows, of which those that are round-off, being far larger at a nearby state, are set to zero."""
    if not rows.gamma.size:
        return rows
    nearby = constraints.jacobian(model, t, *map(slightly_off, (x, u)))
    return rows._replace(jacobian=_where_it_counts(rows.jacobian, nearby))


def _where_it_counts(jacobian: Array, nearby: Array):
    """A with its rows set to zero that are round-off, being far larger at a nearby state."""

    def size(rows: Array) -> Array:
        return jnp.max(jnp.abs(rows), axis=1)

    return jnp.where(vanishing(size(jacobian), size(nearby))[:, None], 0.0, jacobian)


def _contradictory(linear, rows: Array, independent: Array, a, multipliers: Array, x: Array, u: Array):
    """Which dependent equations ask for another acceleration than those that they depend on."""
    jacobian, gamma = rows
    disagreement = jnp.abs(jacobian @ a - gamma)
    terms = jnp.abs(jacobian) @ jnp.abs(a) + jnp.abs(gamma)
    forces = jnp.abs(linear.forcing) + jnp.abs(jacobian).T @ jnp.abs(multipliers)
    inertia = jnp.max(jnp.abs(linear.mass), axis=1)
    slopes = jnp.sum(jnp.abs(jacobian), axis=1)
    round_off = slopes * acceleration_round_off(inertia, forces, x, u)
    return ~independent & (disagreement > DEPENDENT_BELOW[np.dtype(x.dtype)] * terms + round_off)
