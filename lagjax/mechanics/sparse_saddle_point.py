"""The saddle-point system of a large system whose parts touch few others: nothing of size n × n or m × n is formed.

    M a = F + Aᵀ λ,    A a = gamma        =>        S λ = gamma - A M⁻¹ F,    S = A M⁻¹ Aᵀ

M is split into blocks that share no velocity (bodies, particles), and inverted block by block. S couples constraint
equations that act on a common block, and is a band once they are ordered (`numerics/banded.py`). M, A and S are
found from their products with a few coloured vectors, M and A as derivatives of the user's functions. Which entries can
be nonzero is read off the jaxpr (see below) and holds at every state.

One step of iterative refinement on the whole system follows. It restores the digits that S, being a square, loses, and
corrects the error from a vanishing mass, which counts as a small one in M⁻¹. Where the refinement does not converge the
answer is NaN: S is singular, or far from definite.

**Redundant constraints**, as in `saddle_point.py`: rows that depend on others are found by the pivots of G = A Aᵀ,
which is a band as well, and left out; the shortest multipliers that exert the same force are their part outside the
null space of Aᵀ, and hence of G. Applied to a vector, `mu (G + mu)⁻¹` keeps its part in that null space and makes the
rest smaller by `mu` over an eigenvalue of G.

Source: as for `saddle_point.py`; Benzi, Golub & Liesen, Acta Numerica 14 (2005) 1, §5 (Schur complement).

**When.** The jaxpr shows which velocities M couples, and which velocities each constraint equation restricts. With M in
small blocks, the matrix S = A M⁻¹ Aᵀ of the multipliers couples equations that act on a common block; ordered, it is a
band. Nothing here depends on values, so a plan holds at every state.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.jaxtools import length, once, pattern
from lagjax.mechanics.lagrangian import forcing_and_inertia
from lagjax.mechanics.saddle_point import Misses, Verdict, slightly_off, vanishing
from lagjax.numerics import banded, dense
from lagjax.system import Model, constraints

# The banded solve is faster from six unknowns on (a chain of two: 2.4 microseconds against 4.8; of twelve: 4 against
# 24); the dense one exchanges rows, which suits any mass matrix, and is kept where little is to be gained.
UNKNOWNS_AT_LEAST = 24
# Blocks of M are inverted by elimination up to this size.
BLOCK_AT_MOST = dense.ELIMINATE_UP_TO
# A band wider than this share of its rows leaves little out.
BAND_AT_MOST = 0.5


@dataclass(frozen=True, eq=False)
class SparsePlan:
    """What is known of a system independently of values: blocks of M, entries of M and A, the band of S."""

    members: Int[np.ndarray, "blocks size"]
    place: Int[np.ndarray, " n"]
    of_mass: banded.Sparse
    of_rows: banded.Sparse
    band: banded.Band | None

    def __str__(self):
        size = self.members.shape[1]
        mass = "mass matrix diagonal" if size == 1 else f"mass matrix in blocks of up to {size}"
        if self.band is None:
            return mass
        rows, half_bandwidth = self.band.order
        return f"banded, half bandwidth {half_bandwidth}, {len(rows)} equations; {mass}"


def plan(model: Model) -> SparsePlan | None:
    """How to solve a system sparsely; None where the dense solve is as good. Only shapes and dtypes count."""
    if model.reacts or model.off is not None or model.n + model.m < UNKNOWNS_AT_LEAST:
        return None
    leaves, structure = jtu.tree_flatten(model)
    leaves = tuple(jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x for x in leaves)
    return _plan(structure, leaves)


# The equations are traced at several places of one program.
@once
def _plan(structure, leaves: tuple) -> SparsePlan | None:
    model = jtu.tree_unflatten(structure, leaves)
    t, u = (jax.ShapeDtypeStruct(shape, model.form.dtype) for shape in ((), (model.n,)))
    given = [x if isinstance(x, jax.ShapeDtypeStruct) else None for x in leaves], t, u

    def at(given):
        arrays, t, x = given
        filled = [leaf if x is None else x for x, leaf in zip(arrays, leaves)]
        return jtu.tree_unflatten(structure, filled), t, x

    def momentum(u: Array, given):
        model, t, x = at(given)
        return jax.grad(model.lagrangian, argnums=2)(t, x, u)

    def residual(u: Array, given):
        return constraints.velocity_residual(*at(given), u)

    of_mass = pattern(momentum, u, given)
    blocks = banded.blocks(of_mass)
    if max(map(len, blocks)) > BLOCK_AT_MOST:
        return None
    members = np.full((len(blocks), max(map(len, blocks))), u.size)
    coupled = np.zeros((u.size, u.size), np.float32)
    for k, block in enumerate(blocks):
        members[k, : len(block)] = block
        coupled[np.ix_(block, block)] = 1
    of_rows = pattern(residual, u, given)
    m, band = len(of_rows), None
    if m:
        rows = of_rows.astype(np.float32)
        band = banded.band(rows @ coupled @ rows.T > 0)
        if band.order.half_bandwidth > max(1, BAND_AT_MOST * m):
            return None
    where = np.flatnonzero(members.ravel() < u.size)
    place = where[np.argsort(members.ravel()[where])]
    return SparsePlan(members, place, banded.sparse(coupled > 0), banded.sparse(of_rows), band)


# A program multiplies with M and A some twenty times. It calls functions of up to this many operations, as those of
# chains of particles (9), and multiplies by the entries of others, which would make it too long: 3,600 operations for a
# chain of eight bodies (48), 2,000 by entries, which compile in three quarters of the time and run no slower.
SHORT = 30
# The sine below which a row is dependent; only its square is known, which round-off reaches sooner than in
# `numerics/dense.py`.
DEPENDENT_BELOW = {np.dtype("float64"): 1e-5, np.dtype("float32"): 1e-2}
# A vanishing mass counts as this share of the largest: small enough for one refinement to correct.
VANISHING_MASS = {np.dtype("float64"): 1e-8, np.dtype("float32"): 1e-4}
# The most that a refinement may change, relative to the terms of the acceleration.
CORRECTION_AT_MOST = 1e-4
# `mu` relative to G, powers of `mu (G + mu)⁻¹`, and how often the part found with it is subtracted.
NULL_SHIFT, NULL_POWER, NULL_ROUNDS = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-4}, 3, 3


class Operators(NamedTuple):
    """The equations at one state: F, the products with M, M⁻¹, A and Aᵀ, and -gamma.

    `of_mass`, `of_rows`: M and A by the colours of their columns. `added`: what was added to M for M⁻¹. Without
    constraints what belongs to A is None.
    """

    forcing: Float[Array, " n"]
    of_mass: Float[Array, "colours n"]
    inertia: Callable
    mass_inverse: Callable
    added: Float[Array, " n"]
    of_rows: Any = None
    push: Any = None
    pull: Any = None
    rate: Any = None


def operators_at(plan: SparsePlan, model: Model, t: Array, x: Array, u: Array) -> Operators:
    """The equations at one state."""
    forcing, inertia = forcing_and_inertia(model, t, x, u)
    of_mass = banded.compressed(inertia, plan.of_mass.colours, x.dtype)
    inertia, _ = _multiplications(inertia, of_mass, plan.of_mass)
    of_inertia = Operators(forcing, of_mass, inertia, *_mass_inverse(plan, of_mass))
    if plan.band is None:
        return of_inertia
    push = _push(model, t, x, u)
    of_rows = banded.compressed(push, plan.of_rows.colours, x.dtype)
    push, pull = _multiplications(push, of_rows, plan.of_rows)
    _, rate = jax.jvp(lambda t, x: constraints.velocity_residual(model, t, x, u), (t, x), (jnp.ones_like(t), u))
    return of_inertia._replace(of_rows=of_rows, push=push, pull=pull, rate=rate)


def _push(model: Model, t: Array, x: Array, u: Array) -> Callable:
    """The product with A."""
    return jax.linearize(lambda u: constraints.velocity_residual(model, t, x, u), u)[1]


def _multiplications(push: Callable, products: Array, where: banded.Sparse) -> tuple[Callable, Callable]:
    """The products with a matrix and with its transpose: by the function `push` if it is short, else by its entries."""
    like = jax.ShapeDtypeStruct((len(where.in_column),), products.dtype)
    if length(jax.make_jaxpr(push)(like).jaxpr) > SHORT:
        return banded.multiplications(products, where)
    transposed = jax.linear_transpose(push, like)
    return push, lambda multipliers: transposed(multipliers)[0]


class Banded(NamedTuple):
    """The equations solved through S, by a plan. A state is given as (model, t, x, u)."""

    plan: SparsePlan

    def accelerations(self, model: Model, t: Array, x: Array, u: Array, baumgarte_rate: Array | None = None, kept=None):
        """The accelerations and the stacked multipliers, as vectors; `kept` (m,) says which equations to solve with."""
        operators = operators_at(self.plan, model, t, x, u)
        if self.plan.band is None:
            return _unconstrained(operators), jnp.zeros(0, x.dtype)
        gamma = -operators.rate
        if baumgarte_rate is not None:
            gamma = gamma + constraints.baumgarte_feedback(model, t, x, u, baumgarte_rate)
        return self._solved(operators, _independent(self.plan, operators) if kept is None else kept, gamma)

    def _solved(self, operators: Operators, kept: Array, gamma: Array):
        a, multipliers = _solve(self.plan, operators, kept, gamma)
        shortest = partial(_shortest, self.plan, operators)
        return a, lax.cond(jnp.all(kept), lambda x: x, shortest, multipliers)

    def independent(
        self, model: Model, t: Array, x: Array, u: Array, dependent_below: float | None = None
    ) -> Bool[Array, " m"]:
        """Which constraint equations to solve with; see `numerics.banded.independent`."""
        return _independent(self.plan, operators_at(self.plan, model, t, x, u), dependent_below)

    def displacement(self, model: Model, t: Array, x: Array, u: Array) -> Callable:
        """`displacement(r)`: the shortest one, in the metric of M, that changes the residuals by r."""
        operators = operators_at(self.plan, model, t, x, u)
        kept = _independent(self.plan, operators)
        schur, invert = _schur(self.plan, operators, kept)

        def of_residuals(r: Array):
            r = jnp.where(kept, r, 0.0)
            multipliers = lax.custom_linear_solve(schur, r, lambda _, r: invert(r), symmetric=True)
            return operators.mass_inverse(operators.pull(multipliers))

        return of_residuals

    def row_sizes(self, model: Model, t: Array, x: Array, u: Array) -> Float[Array, " m"]:
        """`Σ_j |A_ij|` of each constraint equation: columns of one colour share no row."""
        if self.plan.band is None:
            return jnp.zeros(0, x.dtype)
        return jnp.sum(jnp.abs(banded.compressed(_push(model, t, x, u), self.plan.of_rows.colours, x.dtype)), axis=0)

    def verdict(self, model: Model, t: Array, x: Array, u: Array) -> Verdict:
        """Solve the equations at one state, and say whether they are finite, regular, and agree with each other."""
        plan, operators = self.plan, operators_at(self.plan, model, t, x, u)
        known = [operators.forcing, model.lagrangian(t, x, u)]
        singular, contradictory = jnp.zeros((), bool), jnp.zeros((), bool)
        mass = jnp.max(jnp.abs(operators.of_mass), axis=0)
        if plan.band is None:
            a, multipliers = _unconstrained(operators), jnp.zeros(0, x.dtype)
        else:
            rate, sizes = operators.rate, jnp.abs(operators.of_rows)
            known.append(rate)
            kept = _independent(plan, operators)
            a, multipliers = self._solved(operators, kept, -rate)
            nearby = _push(model, t, *map(slightly_off, (x, u)))
            nearby = jnp.abs(banded.compressed(nearby, plan.of_rows.colours, x.dtype))
            vanishes = vanishing(jnp.max(sizes, axis=0), jnp.max(nearby, axis=0))
            singular = jnp.any(vanishes) | _undetermined(plan, operators, kept)
            push, pull = banded.multiplications(sizes, plan.of_rows)
            terms, forces = push(jnp.abs(a)) + jnp.abs(rate), jnp.abs(operators.forcing) + pull(jnp.abs(multipliers))
            misses = Misses(operators.push(a) + rate, terms, jnp.sum(sizes, axis=0), mass, forces)
            contradictory = jnp.any(misses.contradictory(kept, DEPENDENT_BELOW[np.dtype(x.dtype)], x, u))
        finite = jnp.all(jnp.isfinite(jnp.concatenate([jnp.ravel(x) for x in known])))
        solved = jnp.all(jnp.isfinite(jnp.concatenate([a, multipliers])))
        return Verdict(a, multipliers, finite, finite & (singular | ~solved), contradictory, mass)

    def solution_or_nan(self, *state):
        """The solution as vectors, NaN where it is not valid."""
        found = self.verdict(*state)
        valid = ~(found.singular | found.contradictory)
        return tuple(jnp.where(valid, x, jnp.nan) for x in (found.a, found.multipliers))

    def __str__(self):
        return str(self.plan)


def _undetermined(plan: SparsePlan, operators: Operators, kept: Array):
    """Whether the constraints leave a massless direction free: what was added to M would decide there."""
    added = operators.added
    probe = jnp.cos(jnp.arange(added.size, dtype=added.dtype))
    moved, _ = _eliminated(plan, operators, kept)(added * probe, jnp.zeros_like(operators.rate))
    return jnp.max(jnp.abs(moved)) > CORRECTION_AT_MOST**0.5


def _mass_inverse(plan: SparsePlan, of_mass: Array):
    """The product with M⁻¹, block by block, without derivatives; and what was added to the diagonal for that."""
    n, size = of_mass.shape[1], plan.members.shape[1]
    products = lax.stop_gradient(of_mass)
    least = VANISHING_MASS[np.dtype(of_mass.dtype)] * jnp.max(jnp.abs(products))
    if size == 1:
        added = jnp.where(products[0] == 0, least, 0.0)
        return lambda f: f / (products[0] + added), added
    i, j, inside = plan.members[:, :, None], plan.members[:, None, :], plan.members < n
    both = inside[:, :, None] & inside[:, None, :]
    entries = products[np.append(plan.of_mass.colours.of_column, 0)[j], np.minimum(i, n - 1)]
    blocks = jnp.where(both, entries, jnp.eye(size, dtype=of_mass.dtype)[None])
    added = jnp.where(jnp.all(blocks == 0, axis=2), least, 0.0)
    inverted = jax.vmap(dense.inverse)(blocks + added[:, :, None] * jnp.eye(size, dtype=of_mass.dtype)[None])

    def apply(f):
        parts = jnp.append(f, 0.0)[plan.members]
        return jnp.einsum("kij,kj->ki", inverted, parts).reshape(-1)[plan.place]

    return apply, added.reshape(-1)[plan.place]


def _schur(plan, operators: Operators, kept: Array):
    """The products with S and with its inverse; rows that are not kept are those of the unit matrix."""
    rows = plan.band.order.rows
    back = np.argsort(rows)

    def product(multipliers: Array) -> Array:
        return operators.push(operators.mass_inverse(operators.pull(multipliers)))

    invert = banded.solver(banded.keep(banded.entries(product, plan.band, operators.rate.dtype), kept[rows]))

    def of_kept(multipliers: Array):
        return jnp.where(kept, product(jnp.where(kept, multipliers, 0.0)), multipliers)

    return of_kept, lambda r: invert(r[rows])[back]


def _eliminated(plan: SparsePlan, operators: Operators, kept: Array) -> Callable:
    """The function (F, gamma) -> (a, λ) that eliminates a, without refinement; it has no derivative by the state."""
    mass_inverse = operators.mass_inverse
    _, invert = _schur(plan, operators, kept)

    def solve(forcing: Array, gamma: Array):
        free = mass_inverse(forcing)
        multipliers = invert(jnp.where(kept, gamma - operators.push(free), 0.0))
        return free + mass_inverse(operators.pull(multipliers)), multipliers

    return solve


def _solve(plan: SparsePlan, operators: Operators, kept: Array, gamma: Array):
    """a and λ with the rows that are kept, refined; differentiated by the implicit function theorem."""
    inertia, mass_inverse, push, pull = operators.inertia, operators.mass_inverse, operators.push, operators.pull

    def product(unknown):
        a, minus = jnp.split(unknown, [n])
        return jnp.concatenate([inertia(a) + pull(jnp.where(kept, minus, 0.0)), jnp.where(kept, push(a), minus)])

    def refined(_, known):
        forcing, gamma = jnp.split(known, [n])
        solve = _eliminated(plan, operators, kept)
        a, multipliers = solve(forcing, gamma)
        by_constraints = pull(multipliers)
        da, more = solve(forcing + by_constraints - inertia(a), gamma - push(a))
        terms = jnp.abs(mass_inverse(forcing)) + jnp.abs(mass_inverse(by_constraints))
        converged = jnp.max(jnp.abs(da)) <= CORRECTION_AT_MOST * jnp.max(terms)
        return jnp.where(converged, jnp.concatenate([a + da, -(multipliers + more)]), jnp.nan)

    # One vector of unknowns: with two, JAX 0.10 fails in a second derivative that leaves one of them unchanged.
    n = operators.forcing.size
    known = jnp.concatenate([operators.forcing, jnp.where(kept, gamma, 0.0)])
    a, minus = jnp.split(lax.custom_linear_solve(product, known, refined, symmetric=True), [n])
    return a, -minus


def _unconstrained(operators: Operators):
    """a without constraints, refined; a vanishing mass makes it infinite or NaN."""
    inertia, mass_inverse = operators.inertia, operators.mass_inverse

    def refined(_, forcing: Array):
        a = jnp.where(operators.added == 0, mass_inverse(forcing), jnp.nan)
        return a + mass_inverse(forcing - inertia(a))

    return lax.custom_linear_solve(inertia, operators.forcing, refined, symmetric=True)


def _gram(plan: SparsePlan, operators: Operators):
    dtype = operators.rate.dtype
    return banded.entries(lambda multipliers: operators.push(operators.pull(multipliers)), plan.band, dtype)


def _independent(plan, operators: Operators, dependent_below: float | None = None):
    rows = plan.band.order.rows
    least = DEPENDENT_BELOW[np.dtype(operators.rate.dtype)]
    least = least if dependent_below is None else max(least, dependent_below)
    return banded.independent(_gram(plan, operators), least)[np.argsort(rows)]


def _shortest(plan, operators: Operators, multipliers: Array):
    """The shortest multipliers that exert the force of these: their part outside the null space of Aᵀ."""
    rows = plan.band.order.rows
    back, dtype = np.argsort(rows), multipliers.dtype
    gram = lax.stop_gradient(_gram(plan, operators))
    shift = NULL_SHIFT[np.dtype(dtype)] * jnp.max(gram[:, 0])
    invert = banded.solver(gram.at[:, 0].add(shift))

    def smaller(x: Array, _):
        return lax.custom_linear_solve(
            lambda y: operators.push(operators.pull(y)) + shift * y,
            shift * x,
            lambda _, r: invert(r[rows])[back],
            symmetric=True,
        ), None

    def outside(x: Array, _):
        in_null_space, _ = lax.scan(smaller, x, length=NULL_POWER)
        return x - in_null_space, None

    return lax.scan(outside, multipliers, length=NULL_ROUNDS)[0]
