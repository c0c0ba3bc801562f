"""States on the constraint manifold.

A step of any integrator leaves the manifold by its local error, and the error accumulates: the constraint
drifts. The nearest state on it, nearest in the metric of the mass matrix, is the stationary point of

    ½ (q* - q)ᵀ M (q* - q) + μᵀ g(t, q*)        then        ½ (v* - v)ᵀ M (v* - v) + νᵀ phi(t, q*, v*)

One Newton step of either is a saddle-point solve with the matrix that also gives the accelerations, so a
massless coordinate (M singular) is no obstacle. Positions are moved only where positions are constrained.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §IV.4 and §VII.1.2.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import compiled, jitted, stop_gradient
from lagjax.mechanics.equations import Equations, equations_of
from lagjax.mechanics.first_order import resolved
from lagjax.numerics import newton
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
    frozen, at, start = stop_gradient((equations, (t, q, v), y))
    # Positions move only in directions that the velocity constraints allow: a rolling body keeps rolling.
    step, slope = jax.vmap(frozen.displacement(*at)), frozen.row_sizes(*at)[None]

    def size(r: Array):
        return jnp.max(jnp.abs(r) / jnp.where(slope > 0, slope, jnp.inf), axis=1)

    def last(y: Array, moves: Array):
        r = _residuals(model, t, y)
        return y - step(jnp.where(moves, r, 0.0)), r

    of_y = partial(_residuals, frozen.model, at[0])
    near = newton(of_y, lambda y, r, i: step(r), start, ITERATIONS, size=size, enough=ONE_IS_ENOUGH_BELOW)
    # Two steps are differentiated, as velocities follow the positions that the first moves, and one moves nothing: the
    # residuals are in the program twice, where four copies made up half of a vehicle's.
    y, residuals = lax.scan(last, near + (y - start), jnp.asarray([True, True, False]))
    holds = jnp.all(jnp.abs(residuals[-1]) <= _allowed(start, rtol, atol) * slope)
    return Projected(model.tree(y[0]), model.tree(resolved(model, t, *y)), lax.stop_gradient(holds))


# Jitted, so that JAX traces it once for all the places of a program that need it.
@jitted
def _residuals(model: Model, t: Array, y: Float[Array, "2 n"]) -> Float[Array, "2 m"]:
    return constraints.residuals(model, t, *y)


def velocity_change(model: Model, t: Array, q: PyTree, v: PyTree, change: Array):
    """Return the least change of v, in the metric of M, that changes the residuals of all constraints by `change`.

    `change` (m,): that of `constraints.velocity_residual`. The result has the structure of v, to be added to it.
    """
    return model.tree(equations_of(model).displacement(t, q, v)(change))


def worst_residual(model: Model, t: Array, q: PyTree, v: PyTree, given: InModes | None = None, least=0.0):
    """Return the largest relative residual along a trajectory, of positions and velocities.

    A residual is taken relative to `Σ_j |A_ij| Q`, with Q the largest coordinate on the trajectory (the largest
    velocity for the velocity level): to the residual that a displacement as large as the motion would cause. `given`:
    for a system with elements, the modes in each row. `least` (2, 1): Q is at least this.
    """
    equations = equations_of(model)

    def at(t: Array, q: PyTree, v: PyTree, row: InModes | None):
        here = equations if row is None else equations_of(model.of(given_in(row, model.params.params)))
        return *residuals_and_slopes(here, t, q, v), jnp.maximum(level_size(jnp.stack(model.vectors(q, v))), least)

    residual, slope, size = jax.vmap(at)(t, q, v, given)
    # Outputs after an event or a failure are NaN and say nothing about the constraints.
    scale = jnp.nanmax(size, axis=0, keepdims=True) * slope
    return jnp.nanmax(jnp.abs(residual) / jnp.where(scale > 0, scale, 1.0))


def level_size(y: Float[Array, "2 n"]) -> Float[Array, "2 1"]:
    """Return the largest coordinate and the largest velocity; a single coordinate may be zero and sets no scale."""
    return jnp.max(jnp.abs(y), axis=1, keepdims=True)


def within(
    equations: Equations, t: Array, q: PyTree, v: PyTree, rtol: Array, atol: Array, known: tuple | None = None
) -> Bool[Array, ""]:
    """Whether a displacement of `atol + rtol |y|` accounts for every residual, of positions and velocities.

    `known`: the residuals and A at this state, if they have been computed.
    """
    if known is None:
        residual, slope = residuals_and_slopes(equations, t, q, v)
    else:
        residual, slope = known[0], jnp.sum(jnp.abs(known[1]), axis=1)[None]
    return jnp.all(jnp.abs(residual) <= _allowed(jnp.stack(equations.model.vectors(q, v)), rtol, atol) * slope)


def _allowed(y: Float[Array, "2 n"], rtol: Array, atol: Array) -> Float[Array, "2 1"]:
    """Return the displacements of coordinates and of velocities that count as zero at a state."""
    rtol, atol = (jnp.broadcast_to(tolerance, 2)[:, None] for tolerance in (rtol, atol))
    return atol + rtol * level_size(y)


@compiled
def residuals_and_slopes(equations: Equations, t: Array, q: PyTree, v: PyTree):
    """Return the residuals of positions and of velocities (2, m), and the sums of their slopes (1, m).

    ∂(dg/dt)/∂v = ∂g/∂q: the rows of A serve both levels.
    """
    y = jnp.stack(equations.model.vectors(q, v))
    return _residuals(equations.model, t, y), equations.row_sizes(t, q, v)[None]


def departures(model: Model, s: coordinates.State, rtol: Array, atol: Array) -> str:
    """Name the constraints that a state violates by more than a displacement `atol + rtol |y|`; else ''."""
    residual, slope = (np.asarray(part) for part in residuals_and_slopes(equations_of(model), *s[:3]))
    allowed = np.asarray(_allowed(jnp.stack(model.vectors(s.q, s.v)), rtol, atol))
    # NaN is a violation too; constraints of velocities ask nothing of positions.
    off = ~(np.abs(residual) <= allowed * slope) & np.stack([model.holonomic, np.ones_like(model.holonomic)])
    equations = list(zip(model.equation_names, model.holonomic))
    labels = [f"'{name}'" for name, _ in equations]
    labels += [f"d/dt '{name}'" if holonomic else f"'{name}'" for name, holonomic in equations]
    return ", ".join(f"{labels[i]} = {residual.flat[i]:.3g}" for i in np.flatnonzero(off))
