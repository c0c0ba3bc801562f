"""Forces that depend on multipliers, as Coulomb's friction does on the normal force: what they add to the equations.

A force Q = Q₀ + B λ acts in addition to the constraints' own, Aᵀ λ:

    M a - Aᵀ λ = F + B λ,    A a = gamma

The equations without B λ have the same matrix, and their solution, which is linear in the force, solves these too. With
(a₀, λ₀) for F, (a_j, λ_j) for each column of B alone, and R the matrix with the columns λ_j,

    (I - R) λ = λ₀,    a = a₀ + Σ_j λ_j a_j

Where a pivot of I - R is below zero there is no motion, or there are two: friction pushes a contact together harder
than the contact pushes it apart (Painlevé's paradox). This counts as singular.

Source: Painlevé, *Leçons sur le frottement* (1895); Génot & Brogliato, Eur. J. Mech. A/Solids 18 (1999) 653, §2.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lagjax.numerics import solve_without_exchanges
from lagjax.system import Model

# The pivots of I - R must be above this; without friction they are one.
PIVOT_ABOVE = 1e-10


class Reactions(NamedTuple):
    """The solution of the equations, and whether it is the only one."""

    a: Float[Array, " n"]
    multipliers: Float[Array, " m"]
    unique: Bool[Array, ""]


def force_with_ones(model: Model) -> Callable:
    """The force with all multipliers one: a function of the state alone that depends on the same arguments."""
    return lambda t, q, v, params: model.of(params).force_at(t, q, v, jnp.ones(model.m, jnp.result_type(t)))


def response(model: Model, t: Array, x: Array, u: Array) -> Float[Array, "n m"] | None:
    """B, the change of the force with each multiplier; None if it does not depend on them."""
    if not model.reacts:
        return None
    return jax.jacfwd(lambda multipliers: model.force(t, x, u, multipliers))(jnp.zeros(model.m, x.dtype))


def one_by_one(solve: Callable, loads: list[tuple]) -> list[tuple]:
    """(a, λ) for each of these (forcing, gamma)."""
    return [solve(*load) for load in loads]


def at_once(solve: Callable, loads: list[tuple]) -> list[tuple]:
    """The same in lanes, which share what does not depend on them: the inverse of the matrix."""
    forcing, gamma = (jnp.stack(x) for x in zip(*loads))
    return list(zip(*jax.vmap(solve)(forcing, gamma)))


def with_reactions(
    solve: Callable, forcing: Array, gamma: Array, response: Array | None, each: Callable = one_by_one
) -> Reactions:
    """Solve the equations with the force B λ, given `solve(forcing, gamma)` -> (a, λ) for those without it."""
    if response is None:
        return Reactions(*solve(forcing, gamma), jnp.asarray(True))
    count, still = response.shape[1], jnp.zeros_like(gamma)
    (a, multipliers), *columns = each(solve, [(forcing, gamma), *((response[:, j], still) for j in range(count))])
    # The rows of I - R, and λ₀ as the right-hand side.
    rows = [[(1.0 if i == j else 0.0) - columns[j][1][i] for j in range(count)] for i in range(count)]
    known, pivots = solve_without_exchanges(rows, [multipliers[i] for i in range(count)])
    unique = jnp.all(jnp.stack(pivots) > PIVOT_ABOVE)
    for (along, _), size in zip(columns, known):
        a = a + size * along
    return Reactions(a, jnp.stack(known), unique)
