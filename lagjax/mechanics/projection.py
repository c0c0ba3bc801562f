"""States on the constraint manifold.

A step of any integrator leaves the manifold by its local error, and the error accumulates: the constraint
drifts. The nearest state on it, nearest in the metric of the mass matrix, is the stationary point of

    ½ (q* - q)ᵀ M (q* - q) + μᵀ g(t, q*)        then        ½ (v* - v)ᵀ M (v* - v) + νᵀ phi(t, q*, v*)

One Newton step of either is a saddle-point solve with the matrix that also gives the accelerations, so a
massless coordinate (M singular) is no obstacle. Positions are moved only where positions are constrained.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §IV.4 and §VII.1.2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, jitted, stop_gradient
from lagjax.mechanics.equations import Equations, equations_of
from lagjax.mechanics.first_order import resolved
from lagjax.system import InModes, Model, constraints, coordinates, given_in

# With a fixed matrix, an iteration multiplies the residual by about the initial one: one iteration is enough if that is
# below 1e-8 of the size of the state; a crude fixed step of 0.1 takes eight.
ITERATIONS = 12
ONE_IS_ENOUGH_BELOW = 1e-8


class Projected(NamedTuple):
    """A state returned to the constraints, and whether it satisfies them to the tolerance."""

    q: PyTree[Array]
    v: PyTree[Array]
    holds: Bool[Array, ""]


def returned(equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array) -> Projected:
    """Return the state moved onto the constraints; NaN if equations assumed regular turn out singular."""
    if equations.are_written and equations.are_taken_for_regular:
        return Projected(*equations.projected(t, q, v), jnp.asarray(True))
    return to_manifold(equations, t, q, v, rtol, atol)


@compiled
def to_manifold(equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array) -> Projected:
    """Return the nearest state that satisfies all constraints, for a state near it: Newton with a fixed matrix.

    `holds` is true if a displacement of `atol + rtol |y|` accounts for what is left of each residual, including those
    of dependent constraints; `rtol` and `atol` are one number, or one for q and one for v.
    """
    model, y = equations.model, jnp.stack(equations.model.vectors(q, v))
    if not model.m:
        return Projected(q, model.tree(resolved(model, t, *y)), jnp.asarray(True))
    # Not differentiated: where the residual vanishes, the derivative of the matrix does not contribute.
    frozen, at = stop_gradient(equations), stop_gradient((t, q, v))
    displacement, (slopes, size) = frozen.displacement(*at), _slopes(model, frozen.row_sizes(*at), *at[1:])
    first_level = model.holonomic.sum()

    def step(r: Array):
        of_positions, of_velocities = jnp.split(r, [first_level])
        # Positions move only in directions that the velocity constraints allow: a rolling body keeps rolling.
        along_q = displacement(model.holonomic, of_positions) if first_level else jnp.zeros_like(y[0])
        return jnp.stack([along_q, displacement(np.ones(model.m, bool), of_velocities)])

    def sizes(r: Array):
        return jnp.max(jnp.abs(r)[:, None] / jnp.where(slopes > 0, slopes, jnp.inf), axis=0)

    y, r = _newton(_residuals, (model, t), y, step, sizes)
    holds = jnp.all(jnp.abs(r) <= slopes @ _allowed(size, rtol, atol))
    return Projected(model.tree(y[0]), model.tree(resolved(model, t, *y)), lax.stop_gradient(holds))


# Jitted, so that JAX traces it once for all the places of a program that need it.
@jitted
def _residuals(problem: tuple, y: Float[Array, "2 n"]) -> Array:
    """The residuals of positions, and after them those of velocities."""
    return jnp.concatenate([constraints.position_residual(*problem, y[0]), constraints.velocity_residual(*problem, *y)])


def _newton(residual: Callable, problem: PyTree, y: Array, step: Callable, sizes: Callable):
    """Iterate `y - step(r(problem, y))` for positions and velocities together; return y and what is left of r.

    `sizes(r)`: of both levels. Only the last two iterations are differentiated, enough where r vanishes: velocities
    follow the positions that the first of them moves. The residual is in the program twice: four copies made up half
    of a vehicle's.
    """
    fixed, start = stop_gradient((problem, y))

    def iterate(state):
        i, _, y, first, _ = state
        r = residual(fixed, y)
        first = jnp.where(i == 0, sizes(r), first)
        going = jnp.any(sizes(r) > ONE_IS_ENOUGH_BELOW * jnp.maximum(jnp.max(jnp.abs(y), axis=1), first))
        return i + 1, y, y - step(r), first, going

    def unfinished(state):
        return (state[0] <= ITERATIONS) & state[4]

    at_start = jnp.asarray(0), start, start, jnp.zeros(2, y.dtype), jnp.asarray(True)
    near = lax.while_loop(unfinished, iterate, at_start)[1]

    def last(y: Array, moves: Array):
        r = residual(problem, y)
        return y - step(jnp.where(moves, r, 0.0)), r

    y, residuals = lax.scan(last, near + (y - lax.stop_gradient(y)), jnp.asarray([True, True, False]))
    return y, residuals[-1]


def velocity_change(model: Model, t: Array, q: PyTree, v: PyTree, change: Array):
    """Return the least change of v, in the metric of M, that changes the residuals of all constraints by `change`.

    `change` (m,): that of `constraints.velocity_residual`. The result has the structure of v, to be added to it.
    """
    return model.tree(equations_of(model).displacement(t, q, v)(np.ones(change.size, bool), change))


def worst_residual(model: Model, t: Array, q: PyTree, v: PyTree, given: InModes | None = None):
    """Return the largest relative residual along a trajectory, of positions and velocities.

    A residual is taken relative to `Σ_j |A_ij| Q`, with Q the largest coordinate on the trajectory (the largest
    velocity for the velocity level): to the residual that a displacement as large as the motion would cause. `given`:
    for a system with elements, the modes in each row.
    """
    equations = equations_of(model)

    def at(t: Array, q: PyTree, v: PyTree, row: InModes | None):
        here = equations if row is None else equations_of(model.of(given_in(row, model.params.params)))
        return residuals_and_slopes(here, t, q, v)

    residual, slope, size = jax.vmap(at)(t, q, v, given)
    # Outputs after an event or a failure are NaN and say nothing about the constraints.
    scale = slope @ level_size(jnp.nanmax(size, axis=0))
    return jnp.nanmax(jnp.abs(residual) / jnp.where(scale > 0, scale, 1.0))


def level_size(size: Array):
    """Return the largest coordinate and the largest velocity; a single coordinate may be zero and sets no scale."""
    return jnp.max(size.reshape(2, -1), axis=1)


def within(
    equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array, known: tuple | None = None
) -> Bool[Array, ""]:
    """Whether a displacement of `atol + rtol |y|` accounts for every residual, of positions and velocities.

    `known`: the residuals and A at this state, if they have been computed.
    """
    if known is None:
        residual, slope, size = residuals_and_slopes(equations, t, q, v)
    else:
        residual, slope, size = known[0], *_slopes(equations.model, jnp.sum(jnp.abs(known[1]), axis=1), q, v)
    return jnp.all(jnp.abs(residual) <= slope @ _allowed(size, rtol, atol))


def _allowed(size: Array, rtol: Array, atol: Array):
    """Return the displacements of coordinates and of velocities that count as zero, for a state of these sizes."""
    return jnp.broadcast_to(atol, 2) + jnp.broadcast_to(rtol, 2) * level_size(size)


@compiled
def residuals_and_slopes(equations: Equations, t: Array, q: PyTree, v: PyTree):
    """Return the residuals of both levels, the sums of their slopes over q and over v (two columns), and `|(q, v)|`."""
    model, (x, u) = equations.model, equations.model.vectors(q, v)
    return _residuals((model, t), jnp.stack([x, u])), *_slopes(model, equations.row_sizes(t, q, v), q, v)


def _slopes(model: Model, slope: Array, q: PyTree, v: PyTree):
    x, u = model.vectors(q, v)
    # ∂(dg/dt)/∂v = ∂g/∂q: the holonomic rows serve both levels.
    of_q = slope[model.holonomic]
    columns = [jnp.concatenate([of_q, jnp.zeros_like(slope)]), jnp.concatenate([jnp.zeros_like(of_q), slope])]
    return jnp.stack(columns, axis=1), jnp.abs(jnp.concatenate([x, u]))


def departures(model: Model, s: coordinates.State, rtol: Array, atol: Array) -> str:
    """Name the constraints that a state violates by more than a displacement `atol + rtol |y|`; else ''."""
    residual, slope, size = (np.asarray(part) for part in residuals_and_slopes(equations_of(model), *s[:3]))
    allowed = np.asarray(_allowed(size, rtol, atol))
    # NaN is a violation too.
    off = np.flatnonzero(~(np.abs(residual) <= slope @ allowed))
    equations = list(zip(model.equation_names, model.holonomic))
    labels = [f"'{name}'" for name, holonomic in equations if holonomic]
    labels += [f"d/dt '{name}'" if holonomic else f"'{name}'" for name, holonomic in equations]
    return ", ".join(f"{labels[i]} = {residual[i]:.3g}" for i in off)
