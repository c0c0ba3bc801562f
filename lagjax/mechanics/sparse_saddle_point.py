"""The saddle-point system of a large system whose parts touch few others: nothing of size n × n or m × n is formed.

    M a = F + Aᵀ λ,    A a = gamma        =>        S λ = gamma - A M⁻¹ F,    S = A M⁻¹ Aᵀ

M is split into blocks that share no velocity (bodies, particles), and inverted block by block. S couples constraint
equations that act on a common block, and is a band once they are ordered (`numerics/linalg/banded.py`). M, A and Aᵀ are
functions, derivatives of the user's, and S is found from its products with a few coloured vectors. Which entries can
be nonzero is read off the jaxpr (see below) and holds at every state.

One step of iterative refinement on the whole system follows. It restores the digits that S, being a square, loses, and
corrects the error from a vanishing mass, which counts as a small one in M⁻¹. Where the refinement does not converge the
answer is NaN: S is singular, or far from definite.

**Redundant constraints**, as in `saddle_point.py`: rows that depend on others are found by the pivots of G = A Aᵀ,
which is a band as well, and left out; the shortest multipliers that exert the same force are their part outside the
null space of Aᵀ, and hence of G. Applied to a vector, `mu (G + mu)⁻¹` keeps its part in that null space and makes the
rest smaller by `mu` over an eigenvalue of G.

Source: as for `saddle_point.py`; Benzi, Golub & Liesen, Acta Numerica 14 (2005) 1, §5 (Schur complement).

Decide whether a system is large and made of parts that touch few others, and how to solve it then.

The jaxpr shows which velocities M couples, and which velocities each constraint equation restricts. With M in small
blocks, the matrix S = A M⁻¹ Aᵀ of the multipliers couples equations that act on a common block; ordered, it is a band.
Nothing here depends on values, so a plan holds at every state.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from lagjax.jaxtools import once, pattern
from lagjax.mechanics.lagrangian import forcing_and_inertia
from lagjax.mechanics.saddle_point import Verdict, acceleration_round_off, slightly_off, vanishing
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
    """What is known of a system independently of values: blocks of M, colours of M and A, the band of S."""

    members: Int[np.ndarray, "blocks size"]
    place: Int[np.ndarray, " n"]
    of_mass: banded.Colours
    of_rows: banded.Colours
    of_columns: banded.Colours
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
    return SparsePlan(members, place, *map(banded.colours, (coupled > 0, of_rows, of_rows.T)), band)


# The sine below which a row is dependent; only its square is known, which round-off reaches sooner than in `rank.py`.
DEPENDENT_BELOW = {np.dtype("float64"): 1e-5, np.dtype("float32"): 1e-2}
# A vanishing mass counts as this share of the largest: small enough for one refinement to correct.
VANISHING_MASS = {np.dtype("float64"): 1e-8, np.dtype("float32"): 1e-4}
# The most that a refinement may change, relative to the terms of the acceleration.
CORRECTION_AT_MOST = 1e-4
# `mu` relative to G, powers of `mu (G + mu)⁻¹`, and how often the part found with it is subtracted.
NULL_SHIFT, NULL_POWER, NULL_ROUNDS = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-4}, 3, 3


class Operators(NamedTuple):
    """The products with M, M⁻¹, A and Aᵀ at one state, what was added to M for M⁻¹, and which equations count."""

    inertia: Callable
    mass_inverse: Callable
    added: Float[Array, " n"]
    push: Callable
    pull: Callable
    kept: Bool[Array, " m"]


class Banded(NamedTuple):
    """The equations solved through S, by a plan. A state is given as (model, t, x, u)."""

    plan: SparsePlan

    def accelerations(self, model: Model, t: Array, x: Array, u: Array, baumgarte_rate: Array | None = None, kept=None):
        """The accelerations and the stacked multipliers, as vectors; `kept` (m,) says which equations to solve with."""
        plan = self.plan
        forcing, inertia = forcing_and_inertia(model, t, x, u)
        if plan.band is None:
            return _unconstrained(plan, inertia, forcing), jnp.zeros(0, x.dtype)
        push, pull, rate = _rows(model, t, x, u)
        gamma = -rate
        if baumgarte_rate is not None:
            gamma = gamma + constraints.baumgarte_feedback(model, t, x, u, baumgarte_rate)
        kept = _independent(plan, push, pull, x.dtype) if kept is None else kept
        operators = Operators(inertia, *_mass_inverse(plan, inertia, x), push, pull, kept)
        a, multipliers = _solve(plan, operators, forcing, gamma)
        shortest = partial(_shortest, plan, push, pull)
        return a, lax.cond(jnp.all(kept), lambda x: x, shortest, multipliers)

    def independent(
        self, model: Model, t: Array, x: Array, u: Array, dependent_below: float | None = None
    ) -> Bool[Array, " m"]:
        """Which constraint equations to solve with; see `numerics.banded.independent`."""
        push, pull, _ = _rows(model, t, x, u)
        return _independent(self.plan, push, pull, x.dtype, dependent_below)

    def displacement(self, model: Model, t: Array, x: Array, u: Array) -> Callable:
        """`displacement(which, r)`: the shortest one, in the metric of M, that changes the residuals `which` by r."""
        plan = self.plan
        _, inertia = forcing_and_inertia(model, t, x, u)
        push, pull, _ = _rows(model, t, x, u)
        kept = _independent(plan, push, pull, x.dtype)
        operators = Operators(inertia, *_mass_inverse(plan, inertia, x), push, pull, kept)
        schur, invert = _schur(plan, operators, x.dtype)

        def of_residuals(which: np.ndarray, r: Array):
            r = jnp.where(kept, jnp.zeros(which.size, r.dtype).at[np.flatnonzero(which)].set(r), 0.0)
            multipliers = lax.custom_linear_solve(schur, r, lambda _, r: invert(r), symmetric=True)
            return operators.mass_inverse(pull(multipliers))

        return of_residuals

    def row_sizes(self, model: Model, t: Array, x: Array, u: Array, norm=jnp.sum) -> Float[Array, " m"]:
        """`Σ_j |A_ij|` of each constraint equation, or another norm: columns of one colour share no row."""
        if self.plan.band is None:
            return jnp.zeros(0, x.dtype)
        push, _, _ = _rows(model, t, x, u)
        return norm(jnp.abs(banded.compressed(push, self.plan.of_rows, x.dtype)), axis=0)

    def verdict(self, model: Model, t: Array, x: Array, u: Array) -> Verdict:
        """Solve the equations at one state, and say whether they are finite, regular, and agree with each other."""
        plan, state = self.plan, (model, t, x, u)
        a, multipliers = self.accelerations(*state)
        forcing, inertia = forcing_and_inertia(*state)
        known = [forcing, model.lagrangian(t, x, u)]
        singular, contradictory = jnp.zeros((), bool), jnp.zeros((), bool)
        if plan.band is not None:
            push, pull, rate = _rows(*state)
            known.append(rate)
            kept = _independent(plan, push, pull, x.dtype)

            def at(x: Array, u: Array) -> Array:
                return self.row_sizes(model, t, x, u, jnp.max)

            vanishes = vanishing(at(x, u), at(*map(slightly_off, (x, u))))
            operators = Operators(inertia, *_mass_inverse(plan, inertia, x), push, pull, kept)
            singular = jnp.any(vanishes) | _undetermined(plan, operators, x.dtype)
            # |A| |a| and |A|ᵀ |λ|, colour by colour.
            terms = _by_colours(push, plan.of_rows, a) + jnp.abs(rate)
            forces = jnp.abs(forcing) + _by_colours(pull, plan.of_columns, multipliers)
            round_off = acceleration_round_off(_largest_inertia(plan, inertia, x), forces, x, u)
            tolerance = DEPENDENT_BELOW[np.dtype(x.dtype)] * terms + self.row_sizes(*state) * round_off
            contradictory = jnp.any(~kept & (jnp.abs(push(a) + rate) > tolerance))
        finite = jnp.all(jnp.isfinite(jnp.concatenate([jnp.ravel(x) for x in known])))
        solved = jnp.all(jnp.isfinite(jnp.concatenate([a, multipliers])))
        mass = _largest_inertia(plan, inertia, x)
        return Verdict(a, multipliers, finite, finite & (singular | ~solved), contradictory, mass)

    def solution_or_nan(self, *state):
        """The solution as vectors, NaN where it is not valid."""
        found = self.verdict(*state)
        valid = ~(found.singular | found.contradictory)
        return tuple(jnp.where(valid, x, jnp.nan) for x in (found.a, found.multipliers))

    def __str__(self):
        return str(self.plan)


def _undetermined(plan: SparsePlan, operators: Operators, dtype: DTypeLike):
    """Whether the constraints leave a massless direction free: what was added to M would decide there."""
    probe = jnp.cos(jnp.arange(operators.added.size, dtype=dtype))
    moved, _ = _eliminated(plan, operators, dtype)(operators.added * probe, jnp.zeros(operators.kept.size, dtype))
    return jnp.max(jnp.abs(moved)) > CORRECTION_AT_MOST**0.5


def _by_colours(push: Callable, coloured, y: Array):
    """The product of the absolute values of y and of the matrix that `push` multiplies with."""
    seeds = np.arange(coloured.count)[:, None] == coloured.of_column[None, :]
    return jnp.sum(jnp.abs(jax.vmap(push)(jnp.where(seeds, y[None], 0.0))), axis=0)


def _largest_inertia(plan: SparsePlan, inertia: Callable, x: Array):
    return jnp.max(jnp.abs(banded.compressed(inertia, plan.of_mass, x.dtype)), axis=0)


def _rows(model: Model, t: Array, x: Array, u: Array):
    """The products with A and Aᵀ, and d/dt of the velocity residual at constant velocity: -gamma."""

    def residual(t: Array, x: Array, u: Array):
        return constraints.velocity_residual(model, t, x, u)

    _, rate = jax.jvp(lambda t, x: residual(t, x, u), (t, x), (jnp.ones_like(t), u))
    _, push = jax.linearize(lambda u: residual(t, x, u), u)
    transposed = jax.linear_transpose(push, u)
    return push, lambda multipliers: transposed(multipliers)[0], rate


def _mass_inverse(plan: SparsePlan, inertia: Callable, x: Array):
    """The product with M⁻¹, block by block, without derivatives; and what was added to the diagonal for that."""
    n, size = x.size, plan.members.shape[1]
    products = lax.stop_gradient(banded.compressed(inertia, plan.of_mass, x.dtype))
    least = VANISHING_MASS[np.dtype(x.dtype)] * jnp.max(jnp.abs(products))
    if size == 1:
        added = jnp.where(products[0] == 0, least, 0.0)
        return lambda f: f / (products[0] + added), added
    i, j, inside = plan.members[:, :, None], plan.members[:, None, :], plan.members < n
    both = inside[:, :, None] & inside[:, None, :]
    entries = products[np.append(plan.of_mass.of_column, 0)[j], np.minimum(i, n - 1)]
    blocks = jnp.where(both, entries, jnp.eye(size, dtype=x.dtype)[None])
    added = jnp.where(jnp.all(blocks == 0, axis=2), least, 0.0)
    inverted = jax.vmap(dense.inverse)(blocks + added[:, :, None] * jnp.eye(size, dtype=x.dtype)[None])

    def apply(f):
        parts = jnp.append(f, 0.0)[plan.members]
        return jnp.einsum("kij,kj->ki", inverted, parts).reshape(-1)[plan.place]

    return apply, added.reshape(-1)[plan.place]


def _schur(plan, operators: Operators, dtype: DTypeLike):
    """The products with S and with its inverse; rows that are not kept are those of the unit matrix."""
    _, mass_inverse, _, push, pull, kept = operators
    rows = plan.band.order.rows
    back = np.argsort(rows)

    def product(multipliers: Array) -> Array:
        return push(mass_inverse(pull(multipliers)))

    invert = banded.solver(banded.keep(banded.entries(product, plan.band, dtype), kept[rows]))

    def of_kept(multipliers: Array):
        return jnp.where(kept, product(jnp.where(kept, multipliers, 0.0)), multipliers)

    return of_kept, lambda r: invert(r[rows])[back]


def _eliminated(plan: SparsePlan, operators: Operators, dtype: DTypeLike) -> Callable:
    """The function (F, gamma) -> (a, λ) that eliminates a, without refinement; it has no derivative by the state."""
    _, mass_inverse, _, push, pull, kept = operators
    _, invert = _schur(plan, operators, dtype)

    def solve(forcing: Array, gamma: Array):
        free = mass_inverse(forcing)
        multipliers = invert(jnp.where(kept, gamma - push(free), 0.0))
        return free + mass_inverse(pull(multipliers)), multipliers

    return solve


def _solve(plan: SparsePlan, operators: Operators, forcing: Array, gamma: Array):
    """a and λ with the rows that are kept, refined; differentiated by the implicit function theorem."""
    inertia, mass_inverse, _, push, pull, kept = operators

    def product(unknown):
        a, minus = jnp.split(unknown, [n])
        return jnp.concatenate([inertia(a) + pull(jnp.where(kept, minus, 0.0)), jnp.where(kept, push(a), minus)])

    def refined(_, known):
        forcing, gamma = jnp.split(known, [n])
        solve = _eliminated(plan, operators, forcing.dtype)
        a, multipliers = solve(forcing, gamma)
        by_constraints = pull(multipliers)
        da, more = solve(forcing + by_constraints - inertia(a), gamma - push(a))
        terms = jnp.abs(mass_inverse(forcing)) + jnp.abs(mass_inverse(by_constraints))
        converged = jnp.max(jnp.abs(da)) <= CORRECTION_AT_MOST * jnp.max(terms)
        return jnp.where(converged, jnp.concatenate([a + da, -(multipliers + more)]), jnp.nan)

    # One vector of unknowns: with two, JAX 0.10 fails in a second derivative that leaves one of them unchanged.
    known, n = jnp.concatenate([forcing, jnp.where(kept, gamma, 0.0)]), forcing.size
    a, minus = jnp.split(lax.custom_linear_solve(product, known, refined, symmetric=True), [n])
    return a, -minus


def _unconstrained(plan: SparsePlan, inertia: Callable, forcing: Array):
    """a without constraints, refined; a vanishing mass makes it infinite or NaN."""

    def refined(_, forcing: Array):
        mass_inverse, added = _mass_inverse(plan, inertia, forcing)
        a = jnp.where(added == 0, mass_inverse(forcing), jnp.nan)
        return a + mass_inverse(forcing - inertia(a))

    return lax.custom_linear_solve(inertia, forcing, refined, symmetric=True)


def _gram(plan: SparsePlan, push: Callable, pull: Callable, dtype: DTypeLike):
    return banded.entries(lambda multipliers: push(pull(multipliers)), plan.band, dtype)


def _independent(plan, push: Callable, pull: Callable, dtype: DTypeLike, dependent_below: float | None = None):
    rows = plan.band.order.rows
    least = DEPENDENT_BELOW[np.dtype(dtype)]
    least = least if dependent_below is None else max(least, dependent_below)
    return banded.independent(_gram(plan, push, pull, dtype), least)[np.argsort(rows)]


def _shortest(plan, push: Callable, pull: Callable, multipliers: Array):
    """The shortest multipliers that exert the force of these: their part outside the null space of Aᵀ."""
    rows = plan.band.order.rows
    back, dtype = np.argsort(rows), multipliers.dtype
    gram = lax.stop_gradient(_gram(plan, push, pull, dtype))
    shift = NULL_SHIFT[np.dtype(dtype)] * jnp.max(gram[:, 0])
    invert = banded.solver(gram.at[:, 0].add(shift))

    def smaller(x: Array, _):
        return lax.custom_linear_solve(
            lambda y: push(pull(y)) + shift * y, shift * x, lambda _, r: invert(r[rows])[back], symmetric=True
        ), None

    def outside(x: Array, _):
        in_null_space, _ = lax.scan(smaller, x, length=NULL_POWER)
        return x - in_null_space, None

    return lax.scan(outside, multipliers, length=NULL_ROUNDS)[0]
