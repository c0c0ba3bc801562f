"""The saddle-point system, a and λ of one state: solved as one matrix, or by the user's own forward dynamics.

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

**Forward dynamics.** The user's own `forward_dynamics` solves the equations: f(t, q, v, force, params) -> a, with M a =
F + force. a is affine in the force, and its slope is M⁻¹: products with it are pushed forward through f, as many as
there are constraint equations. With them

    a = a₀ + M⁻¹ Aᵀ λ,    S λ = gamma - A a₀,    S = A M⁻¹ Aᵀ

and nothing of size n × n is formed. A force that depends on the multipliers, B λ, is solved with as elsewhere, by the
accelerations M⁻¹ B that it causes (`lagrangian.py`). That f solves the equations of L is checked where a motion
starts and at each call from Python, there and at other velocities, along a few directions w: w·(M a - F) takes
derivatives of L forward alone.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §6.1 (forward dynamics), §8.4 (constraint forces by M⁻¹).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, jitted
from lagjax.mechanics.lagrangian import (
    LinearEquation,
    Reactions,
    applied_force,
    at_once,
    completed,
    is_determined,
    mass_and_forcing,
    resolved,
    response,
    with_first_order,
    with_reactions,
)
from lagjax.numerics import DEPENDENT_BELOW, SINGULAR_BELOW, dense, independent_rows, unit_rows
from lagjax.system import Model, State, constraints

# A constraint whose derivative is this much smaller than nearby has none: it is written as a square.
VANISHES_BELOW = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-4}


class Verdict(NamedTuple):
    """A solution of the equations at one state, as vectors or by name, and whether it is valid.

    `mass`: the largest entry of each row of M. `given`: residuals and A at the state before it was returned to the
    constraints, where they are known. `whole`: M and A, where they are formed.
    """

    a: PyTree[Array]
    multipliers: Any
    finite: Bool[Array, ""]
    singular: Bool[Array, ""]
    contradictory: Bool[Array, ""]
    mass: Float[Array, " n"]
    given: tuple[Float[Array, "2 m"], Float[Array, "m n"]] | None = None
    whole: tuple[Float[Array, "n n"], Float[Array, "m n"]] | None = None


def slightly_off(y: Array):
    """Shift a position or velocity by a thousandth of its size, differently in each coordinate."""
    size = jnp.max(jnp.abs(y))
    return y + 1e-3 * jnp.cos(jnp.arange(y.size, dtype=y.dtype)) * jnp.where(size > 0, size, 1.0)


def vanishing(size: Array, nearby: Array):
    """Which rows of A are round-off: their `size` is far below that at a nearby state."""
    return size <= VANISHES_BELOW[np.dtype(size.dtype)] * jnp.nan_to_num(nearby, posinf=0.0)


class Misses(NamedTuple):
    """What the solution misses of A a = gamma in each equation, with the sizes of what could cause it.

    `terms`: of A a - gamma, added up; `sizes`: `Σ_j |A_ij|`; `mass`, `forces`: of each row of M a - F - Aᵀ λ.
    """

    by: Float[Array, " m"]
    terms: Float[Array, " m"]
    sizes: Float[Array, " m"]
    mass: Float[Array, " n"]
    forces: Float[Array, " n"]

    def contradictory(self, independent: Bool[Array, " m"], below: float, x: Array, u: Array) -> Bool[Array, " m"]:
        """Which dependent equations ask for another acceleration than those that they depend on; by how much of their
        terms, and by more than round-off."""
        round_off = self.sizes * _acceleration_round_off(self.mass, self.forces, x, u)
        return ~independent & (jnp.abs(self.by) > below * self.terms + round_off)


def _acceleration_round_off(inertia, forces, x: Array, u: Array):
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
        mass, rows = found.linear.mass, found.rows.jacobian
        size = largest_of_rows(mass)
        return Verdict(found.a, found.multipliers, finite, singular, contradictory, size, None, (mass, rows))

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


def _contradictory(
    linear: LinearEquation, rows: constraints.ConstraintRows, independent: Array, a: Array, multipliers: Array,
    x: Array, u: Array,
) -> Bool[Array, " m"]:  # fmt: skip
    forces = jnp.abs(linear.forcing) + jnp.abs(multipliers) @ jnp.abs(rows.jacobian)
    misses = _misses(rows, a, largest_of_rows(linear.mass), forces)
    return misses.contradictory(independent, DEPENDENT_BELOW[np.dtype(x.dtype)], x, u)


def _misses(rows: constraints.ConstraintRows, a: Array, mass: Array, forces: Array) -> Misses:
    jacobian, gamma = rows
    terms = jnp.abs(jacobian) @ jnp.abs(a) + jnp.abs(gamma)
    return Misses(jacobian @ a - gamma, terms, jnp.sum(jnp.abs(jacobian), axis=1), mass, forces)


# The most by which M a may miss F, as a share of the largest of their terms.
AGREES = {np.dtype("float64"): 1e-8, np.dtype("float32"): 1e-3}
# Directions along which that is looked at, and entries of M that are found together.
DIRECTIONS, BLOCK = 3, 64


class Solver(NamedTuple):
    """The equations at one state: a₀ without multipliers, A, gamma, M⁻¹ Aᵀ as rows, and S with its independent rows.

    `reactions`: M⁻¹ B of a force that depends on multipliers, None where it does not.
    """

    free: Float[Array, " n"]
    rows: constraints.ConstraintRows
    responses: Float[Array, "m n"]
    schur: Float[Array, "m m"]
    independent: Bool[Array, " m"]
    reactions: Float[Array, "n m"] | None

    def solved(self, gamma: Float[Array, " m"]) -> Reactions:
        """a and λ with A a = gamma, and whether there are no others."""

        def held(a: Array, gamma: Array) -> tuple[Array, Array]:
            wanted = jnp.where(self.independent, gamma - self.rows.jacobian @ a, 0.0)
            multipliers = dense.solve(self.schur, wanted)
            a = a + multipliers @ self.responses
            return a, minimum_norm(self.rows.jacobian, multipliers, self.independent)

        return with_reactions(held, self.free, gamma, self.reactions, at_once)


class ForwardDynamics(NamedTuple):
    """The equations solved by a function of the user's. A state is given as (model, t, x, u)."""

    name: str

    def accelerations(
        self,
        model: Model,
        t: Array,
        x: Array,
        u: Array,
        baumgarte_rate: Array | None = None,
        independent: Array | None = None,
    ):
        """The accelerations and the stacked multipliers, as vectors; `independent` (m,): which to solve with."""
        if not model.m:
            force = applied_force(model, t, x, resolved(model, t, x, u))
            return _solved_by_them(model, t, x, u)(force), jnp.zeros(0, x.dtype)
        solver = _solver(model, t, x, u, independent)
        gamma = solver.rows.gamma
        if baumgarte_rate is not None:
            gamma = gamma + constraints.baumgarte_feedback(model, t, x, u, baumgarte_rate)
        return solver.solved(gamma)[:2]

    def independent(
        self, model: Model, t: Array, x: Array, u: Array, dependent_below: float | None = None
    ) -> Bool[Array, " m"]:
        """Which constraint equations to solve with."""
        return chosen(model, constraints.jacobian(model, t, x, u), dependent_below)

    def displacement(self, *state) -> Callable:
        """`displacement(r)`: the shortest one, in the metric of M, that changes the residuals by r."""
        solver = _solver(*state, None)
        matrix = jnp.where(solver.independent[None], solver.responses.T @ dense.inverse(solver.schur), 0.0)
        return lambda r: matrix @ r

    def row_sizes(self, *state) -> Float[Array, " m"]:
        """`Σ_j |A_ij|` of each constraint equation."""
        return jnp.sum(jnp.abs(constraints.jacobian(*state)), axis=1)

    def verdict(self, model: Model, t: Array, x: Array, u: Array) -> Verdict:
        """Solve the equations at one state, and say whether they are finite, regular, those of L, and agree."""
        state = model, t, x, u
        along = np.random.default_rng(0).uniform(0.5, 1.0, (DIRECTIONS, model.n)).astype(x.dtype)
        seen = _seen(*state, along)
        a, multipliers = self.accelerations(*state) if model.m else (seen.a, jnp.zeros(0, x.dtype))
        mass = seen.mass
        singular, contradictory = ~is_determined(*state), jnp.asarray(False)
        if model.m:
            solver = _solver(*state, None)
            scale = 1 / jnp.sqrt(jnp.abs(jnp.diagonal(solver.schur)))
            conditioned = dense.reciprocal_condition(scale[:, None] * solver.schur * scale[None, :])
            singular |= (conditioned <= SINGULAR_BELOW[np.dtype(x.dtype)]) | ~solver.solved(solver.rows.gamma).unique
            forces = jnp.abs(mass * a) + jnp.abs(multipliers) @ jnp.abs(solver.rows.jacobian)
            misses = _misses(solver.rows, a, mass, forces)
            contradictory = jnp.any(misses.contradictory(solver.independent, DEPENDENT_BELOW[np.dtype(x.dtype)], x, u))
        known = jnp.concatenate([a, multipliers, jnp.ravel(model.lagrangian(t, x, u))])
        finite = jnp.all(jnp.isfinite(known)) & ~jnp.any(seen.is_missed)
        return Verdict(a, multipliers, finite, singular, contradictory, mass)

    def solution_or_nan(self, *state):
        """The solution as vectors, NaN where constraints contradict each other."""
        if not state[0].m:
            return self.accelerations(*state)
        found = self.verdict(*state)
        return tuple(jnp.where(found.contradictory, jnp.nan, x) for x in (found.a, found.multipliers))

    def __str__(self):
        return self.name


class Seen(NamedTuple):
    """By how much accelerations miss M a = F along directions, and where that is more than round-off; the accelerations
    without constraints, and the diagonal of M."""

    by: Float[Array, " k"]
    is_missed: Bool[Array, " k"]
    a: Float[Array, " n"]
    mass: Float[Array, " n"]


def missed(
    model: Model, t: Array, x: Array, u: Array, along: Float[Array, "k n"]
) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
    """By how much the accelerations miss M a = F along some directions, and where that is more than round-off.

    The larger of the misses at these velocities and at others, where Coriolis terms have their part.
    """
    return _seen(model, t, x, u, along)[:2]


def _seen(model: Model, t: Array, x: Array, u: Array, along: Float[Array, "k n"]) -> Seen:
    """That, and more: the second derivatives of L are in the program once, in lanes."""
    size = jnp.max(jnp.abs(u))
    other = u + jnp.where(size > 0, size, 1.0) * jnp.cos(jnp.arange(u.size, dtype=u.dtype))

    def moving(u: Array) -> tuple[Array, Array, Array]:
        u = resolved(model, t, x, u)
        force = applied_force(model, t, x, u)
        return u, _solved_by_them(model, t, x, u)(force), force

    both, a, forces = jax.vmap(moving)(jnp.stack([u, other]))
    along, unit = _without_first_order(model, along), jnp.eye(u.size, dtype=x.dtype)
    still = jnp.zeros_like(unit)
    count = len(along)

    def lanes(of_both: Array, of_mass: Array) -> Array:
        return jnp.concatenate([jnp.repeat(of_both, count, axis=0), of_mass])

    def terms(lane: tuple) -> Array:
        u, dt, dx, dv, w = lane
        _, slope = jax.jvp(lambda x: model.lagrangian(t, x, u), (x,), (w,))
        return jnp.stack([_momentum_rate(model, t, x, u, (dt, dx, dv), w), -slope])

    time = lanes(jnp.ones(2, x.dtype), jnp.zeros_like(x))
    w = jnp.concatenate([along, along, unit])
    every = lanes(both, u + still), time, lanes(both, still), lanes(a, unit), w
    found = lax.map(terms, every, batch_size=BLOCK)
    of_force = jnp.repeat(forces, count, axis=0)
    found, mass = jnp.split(found, [2 * count])
    found = jnp.concatenate([found, -jnp.sum(of_force * w[: 2 * count], axis=1)[:, None]], axis=1)
    found = found.reshape(2, count, 3)
    by = jnp.max(jnp.abs(jnp.sum(found, axis=2)), axis=0)
    return Seen(by, ~(by <= AGREES[np.dtype(x.dtype)] * jnp.max(jnp.abs(found))), a[0], mass[:, 0])


def _momentum_rate(model: Model, t: Array, x: Array, u: Array, onward: tuple, w: Array) -> Float[Array, ""]:
    """The change of w·∂L/∂v along a direction (dt, dx, dv): derivatives forward alone, which take least to compile."""

    def momentum(t: Array, x: Array, u: Array) -> Array:
        return jax.jvp(lambda u: model.lagrangian(t, x, u), (u,), (w,))[1]

    onward = tuple(jnp.asarray(d, x.dtype) for d in onward)
    return jax.jvp(momentum, (t, x, u), onward)[1]


def _without_first_order(model: Model, along: Array) -> Array:
    first = model.form.first_order
    return jnp.asarray(along) if first is None else jnp.where(first.mask(model.n)[None], 0.0, along)


def _solved_by_them(model: Model, t: Array, x: Array, u: Array) -> Callable:
    """The accelerations as a function of the force beside L."""
    first = model.form.first_order
    moving = resolved(model, t, x, u)

    def of_force(force: Array) -> Array:
        a = model.forward_dynamics(t, x, moving, force)
        return a if first is None else jnp.where(first.mask(model.n), 0.0, a)

    return of_force


def _solver(model: Model, t: Array, x: Array, u: Array, independent: Array | None) -> Solver:
    force = applied_force(model, t, x, resolved(model, t, x, u))
    free, push = jax.linearize(_solved_by_them(model, t, x, u), force)
    rows = constraints.acceleration_rows(model, t, x, u)
    responses = jax.vmap(push)(rows.jacobian)
    independent = chosen(model, rows.jacobian) if independent is None else independent
    both = independent[:, None] & independent[None, :]
    schur = jnp.where(both, responses @ rows.jacobian.T, jnp.eye(model.m, dtype=x.dtype))
    loads = response(model, t, x, resolved(model, t, x, u))
    reactions = None if loads is None else jax.vmap(push, in_axes=1, out_axes=1)(loads)
    return Solver(free, rows, responses, schur, independent, reactions)
