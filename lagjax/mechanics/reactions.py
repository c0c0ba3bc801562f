"""Forces that depend on multipliers, as Coulomb's friction on the normal force: what they add to the equations.

A force Q = Q₀ + B λ acts beside the constraints' own, Aᵀ λ:

    M a - Aᵀ λ = F + B λ,    A a = gamma

The matrix is that of the equations without it, and so it is solved by their solution, which is linear in the force.
With (a₀, λ₀) for F, and (a_j, λ_j) for each column of B alone, where R has the columns λ_j,

    (I - R) λ = λ₀,    a = a₀ + Σ_j λ_j a_j

What the pivots of I - R are below zero for has no motion, or two: where friction pushes a contact harder than the
contact keeps it away, a paradox of Painlevé. It counts as singular.

Source: Painlevé, *Leçons sur le frottement* (1895); Génot & Brogliato, Eur. J. Mech. A/Solids 18 (1999) 653, §2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.arguments import WITH_MULTIPLIERS, takes_of

# A pivot of I - R, which is one without friction.
PIVOT_ABOVE = 1e-10


class Reactions(NamedTuple):
    """The solution of the equations, and whether it is the only one."""

    a: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    unique: Bool[Array, ""]


def reacts(system) -> bool:
    """Whether the force of a system depends on multipliers."""
    return system.force is not None and takes_of(system.force) == WITH_MULTIPLIERS and bool(system.constraints)


def force_at(system, t, q, v, params, multipliers):
    """The generalized force that L does not contain, like q; `multipliers` stacked."""
    if takes_of(system.force) != WITH_MULTIPLIERS:
        return system.force(t, q, v, params)
    return system.force(t, q, v, constraints.split(system, multipliers, t, q, v, params), params)


def force_with_ones(system) -> Callable:
    """The force as a function of the state alone, which depends on all that it depends on with multipliers."""

    def of_state(t, q, v, params):
        ones = jnp.ones(constraints.count(system, t, q, v, params), jnp.result_type(t))
        return force_at(system, t, q, v, params, ones)

    return of_state


def response(system, t, x, u, params, unflatten) -> Float[Array, "n m"] | None:
    """B, the change of the force with each multiplier; None where there is none."""
    if not reacts(system):
        return None
    q, v = unflatten(x), unflatten(u)
    at = lambda multipliers: coordinates.flatten(force_at(system, t, q, v, params, multipliers))[0].astype(x.dtype)
    return jax.jacfwd(at)(jnp.zeros(constraints.count(system, t, q, v, params), x.dtype))


def with_reactions(solve: Callable, forcing, gamma, response) -> Reactions:
    """`solve(forcing, gamma)` -> (a, λ) of the equations without the force's own part in the multipliers, with it."""
    a, multipliers = solve(forcing, gamma)
    if response is None:
        return Reactions(a, multipliers, jnp.asarray(True))
    count = response.shape[1]
    columns = [solve(response[:, j], jnp.zeros_like(gamma)) for j in range(count)]
    # I - R, and λ₀ beside it.
    rows = [[(1.0 if i == j else 0.0) - columns[j][1][i] for j in range(count)] for i in range(count)]
    known, unique = [multipliers[i] for i in range(count)], jnp.asarray(True)
    for k in range(count):
        unique = unique & (rows[k][k] > PIVOT_ABOVE)
        pivot = jnp.where(rows[k][k] != 0, rows[k][k], 1.0)
        for i in range(k + 1, count):
            factor = rows[i][k] / pivot
            known[i] = known[i] - factor * known[k]
            rows[i] = [x - factor * y for x, y in zip(rows[i], rows[k])]
    for k in reversed(range(count)):
        rest = sum(rows[k][j] * known[j] for j in range(k + 1, count))
        known[k] = (known[k] - rest) / jnp.where(rows[k][k] != 0, rows[k][k], 1.0)
    for (along, _), size in zip(columns, known):
        a = a + size * along
    return Reactions(a, jnp.stack(known), unique)
