"""One step of the variational integrator by Gauss' quadrature (`numerics/symplectic.py`).

The unknowns of a step are the velocities V_i at its nodes, the multipliers λ_j of constraints on positions at Lobatto's
nodes but the last, and those of velocity constraints, μ_i, at Gauss' nodes. They are found by iteration. With what the
momenta at node i, the positions and the velocities still lack, R_i, r_i, each node has the same small system with the
matrices in the middle of the step:

    [M  -Aᵀ] [δV_i]   [R_i]
    [A   0 ] [δκ_i] = [r_i]        κ = h ã λ, or h a μ: what the multipliers add to the momenta at the nodes

The last multipliers of a step are those with which its velocity at the end satisfies the constraints. Of constraints
that depend on each other a largest independent set is kept in each step, chosen at its start. Positions and momenta
carry what is lost when a step is added to them (compensated summation).

Coordinates of first order, v = φ(t, q, v_others), are collocated at the same nodes: V_i = φ(Q_i, V_i), a row of the
unit matrix in M. With q, p and these as unknowns all of it is one Gauss method, which keeps quadratic invariants.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §VIII.6.1 (iteration), §VIII.5 (round-off).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from lagjax.jaxtools import stop_gradient
from lagjax.mechanics import applied_force, mass_and_forcing, resolved
from lagjax.numerics import Tableau, dense, independent_rows
from lagjax.system import Model, constraints

MOST_ITERATIONS = 60
# Steps have one length if they differ by less than this part of it.
SAME_LENGTH = 1e-6
# A step is solved if the last correction is below this power of the round-off, in kinetic energy.
SOLVED = 1.2
# Iteration ends where less than this part of a round-off is missing.
ENOUGH = 0.1
# Or if it is below so many round-offs of positions, over the length of the step.
ROUND_OFFS = 100
# The corrections that make first and second derivatives right.
CORRECTIONS = 2


class Unknown(NamedTuple):
    """V, and the multipliers of all constraints, of velocities at Gauss' nodes and of positions at Lobatto's."""

    velocities: Float[Array, "s n"]
    multipliers: Float[Array, "s m"]


class GaussState(NamedTuple):
    """The state between two steps.

    `x_rest`, `p_rest`: what is to be added to x and p; `velocities`, `multipliers`: at the nodes of the last two steps,
    and of the last one. `independent`: which constraint equations the next step is solved with. `alike`: how many of
    these steps had the length `h`.
    """

    x: Float[Array, " n"]
    x_rest: Float[Array, " n"]
    p: Float[Array, " n"]
    p_rest: Float[Array, " n"]
    velocities: Float[Array, "2s n"]
    multipliers: Float[Array, "s m"]
    independent: Bool[Array, " m"]
    h: Float[Array, ""]
    alike: Int[Array, ""]
    unsolved: Bool[Array, ""]


class GaussStep(NamedTuple):
    """Steps of a model. `newton`: solved by Newton's method; `differentiated`: whether derivatives will be taken."""

    model: Model
    tableau: Tableau
    newton: bool
    differentiated: bool

    def first(self, t: Array, x: Array, u: Array) -> GaussState:
        """The state at the start."""
        s, none = len(self.tableau.nodes), jnp.zeros_like(x)
        multipliers = jnp.zeros((s, self.model.m), x.dtype)
        p = self._momentum(t, x, u)
        h, alike = jnp.zeros_like(t), jnp.asarray(0)
        kept = independent_rows(constraints.jacobian(self.model, t, x, u))
        return GaussState(x, none, p, none, jnp.tile(u, (2 * s, 1)), multipliers, kept, h, alike, jnp.asarray(False))

    def advanced(self, way: GaussState, t: Array, h: Array) -> GaussState:
        """The state after a step from t to t + h."""
        s, dtype = len(self.tableau.nodes), h.dtype
        alike = jnp.where(jnp.abs(h - way.h) <= SAME_LENGTH * h, way.alike, 0)
        guess = Unknown(self._guess(way, alike, dtype), jnp.where(way.independent, way.multipliers, 0.0))
        found, solved = self._solved(stop_gradient(way), *stop_gradient((t, h, guess)))
        if self.differentiated:
            found = self._with_derivatives(way, t, h, found)
        at = self._at_nodes(way, t, h, found)
        x, x_rest = added(way.x, way.x_rest + jnp.sum(at.moves, axis=0))
        dp, kept = way.p_rest + jnp.sum(at.kicks, axis=0) + jnp.sum(at.impulses, axis=0), way.independent
        if self.model.m:
            _, dp, kept = self._at_end(t + h, x, way.p, dp, self.tableau.at_end.astype(dtype) @ found.velocities)
        p, p_rest = added(way.p, dp)
        velocities = jnp.concatenate([way.velocities[s:], found.velocities])
        alike = jnp.minimum(alike + 1, 2)
        return GaussState(x, x_rest, p, p_rest, velocities, found.multipliers, kept, h, alike, way.unsolved | ~solved)

    def _guess(self, way: GaussState, alike: Array, dtype) -> Float[Array, "s n"]:
        """Velocities at the nodes, by the polynomial through those of the steps of this length."""
        tab, s = self.tableau, len(self.tableau.nodes)
        last = way.velocities[s:]
        same = jnp.tile(tab.at_end.astype(dtype) @ last, (s, 1))
        if self.newton:
            # Through steps that are longer than an oscillation a polynomial leads nowhere.
            return jnp.tile(jnp.mean(last, axis=0), (s, 1))
        of_one, of_two = tab.ahead.astype(dtype) @ last, tab.ahead_of_two.astype(dtype) @ way.velocities
        return jnp.where(alike == 0, same, jnp.where(alike == 1, of_one, of_two))

    def velocity(self, way: GaussState, t: Array) -> Float[Array, " n"]:
        """The velocity that belongs to the momentum."""
        u = self.tableau.at_end.astype(t.dtype) @ way.velocities[len(self.tableau.nodes) :]
        return self._at_end(t, way.x, way.p, way.p_rest, u)[0]

    def _at_end(self, t: Array, x: Array, p: Array, dp: Array, u: Array):
        """The velocity at x with the momentum p + dp, dp with the impulse that keeps it on the constraints, and which
        of these are independent."""
        model, rows = self.model, constraints.jacobian(self.model, t, x, u)
        kept = independent_rows(rows)
        inverse, _ = self._matrices(t, x, u, kept)
        for _ in range(CORRECTIONS):
            short = self._of_first_order(t, x, u, dp + (p - self._momentum(t, x, u)))
            lacks = jnp.where(kept, -constraints.velocity_residual(model, t, x, u), 0.0)
            change = inverse @ jnp.concatenate([short, lacks])
            u, dp = u + change[: model.n], dp + change[model.n :] @ rows
        return u, dp, kept

    def _of_first_order(self, t: Array, x: Array, u: Array, short: Array) -> Array:
        """What momenta lack; for coordinates of first order what their velocities lack."""
        if self.model.form.first_order is None:
            return short
        return jnp.where(self._is_first_order, resolved(self.model, t, x, u) - u, short)

    @property
    def _is_first_order(self) -> np.ndarray:
        first = self.model.form.first_order
        return np.zeros(self.model.n, bool) if first is None else first.mask(self.model.n)

    def _momentum(self, t: Array, x: Array, u: Array) -> Array:
        return jax.grad(self.model.lagrangian, argnums=2)(t, x, u)

    def _momentum_and_push(self, t: Array, x: Array, u: Array) -> tuple[Array, Array]:
        push, p = jax.grad(self.model.lagrangian, argnums=(1, 2))(t, x, u)
        return p, push + applied_force(self.model, t, x, u)

    def _matrices(self, t: Array, x: Array, u: Array, kept: Array) -> tuple[Array, Array]:
        """The inverse of the matrix with these constraints, and the round-off of x."""
        t, x, u, model = stop_gradient((t, x, u, self.model))
        mass = mass_and_forcing(model, t, x, u).mass
        size = jnp.where(self._is_first_order, 0.0, jnp.abs(x))
        round_off = size @ jnp.abs(mass) @ size * jnp.finfo(x.dtype).eps ** 2
        if not model.m:
            return dense.inverse(mass), round_off
        rows = jnp.where(kept[:, None], constraints.jacobian(model, t, x, u), 0.0)
        matrix = jnp.block([[mass, -rows.T], [rows, jnp.diag(jnp.where(kept, 0.0, 1.0).astype(x.dtype))]])
        return dense.inverse(matrix), round_off

    def _at_nodes(self, way: GaussState, t: Array, h: Array, z: Unknown) -> "AtNodes":
        """What the path of these unknowns lacks."""
        tab, model, dtype = self.tableau, self.model, h.dtype
        times, parts, mixed = (
            t + tab.nodes.astype(dtype) * h,
            h * tab.weights.astype(dtype)[:, None],
            tab.mixed.astype(dtype),
        )
        moves = parts * z.velocities
        x = way.x[None] + (way.x_rest[None] + mixed @ moves)
        momenta, pushes = jax.vmap(self._momentum_and_push)(times, x, z.velocities)
        lacks, impulses = jnp.zeros_like(z.multipliers), jnp.zeros_like(momenta)
        # By products: XLA makes no machine function of a program that scatters.
        holonomic, columns = model.holonomic, np.eye(model.m, dtype=dtype)
        if not holonomic.all():
            which = ~holonomic
            rows = jax.vmap(lambda t, x, u: constraints.jacobian(model, t, x, u)[which])(times, x, z.velocities)
            pushes = pushes + jnp.einsum("sm,smn->sn", z.multipliers[:, which], rows)
            slopes = jax.vmap(lambda t, x, u: constraints.velocity_residual(model, t, x, u)[which])
            lacks -= slopes(times, x, z.velocities) @ columns[which]
        kicks = parts * pushes
        after = mixed @ kicks
        if holonomic.any():
            ends, to_nodes = t + tab.lobatto_nodes.astype(dtype) * h, tab.to_nodes.astype(dtype)
            at_ends = way.x[None] + (way.x_rest[None] + to_nodes[1:] @ moves)
            starts = jnp.concatenate([way.x[None], at_ends[:-1]])
            rows = jax.vmap(lambda t, x: constraints.jacobian(model, t, x, z.velocities[0])[holonomic])
            forces = h * tab.lobatto_weights[:-1, None].astype(dtype) * z.multipliers[:, holonomic]
            impulses = jnp.einsum("sm,smn->sn", forces, rows(ends[:-1], starts))
            after = after + (1 - to_nodes[:-1].T) @ impulses
            gaps = jax.vmap(lambda t, x: constraints.position_residual(model, t, x))(ends[1:], at_ends)
            lacks -= (_inverted(tab.inner_to_nodes, dtype) @ gaps / h) @ columns[holonomic]
        short = way.p[None] + (way.p_rest[None] + after) - momenta
        short = jax.vmap(self._of_first_order)(times, x, z.velocities, short)
        if model.m > 1:
            # The multipliers of the others are zero.
            lacks = jnp.where(way.independent, lacks, z.multipliers)
        return AtNodes(momenta, moves, kicks, impulses, short, lacks)

    def _solved(self, way: GaussState, t: Array, h: Array, guess: Unknown) -> tuple[Unknown, Bool[Array, ""]]:
        """The unknowns, by iteration, and whether that came to an end."""
        step = self._replace(model=stop_gradient(self.model))
        small = jnp.finfo(h.dtype).eps
        middle = way.x + h * (self.tableau.to_middle.astype(h.dtype) @ guess.velocities)
        turning = jnp.mean(guess.velocities, axis=0)
        at_nodes, round_off = step._matrices(t + h / 2, middle, turning, way.independent)
        whole = step._whole_inverse(way, t, h, guess) if self.newton else None
        first, noise = self._is_first_order, step._noise(t + h / 2, middle, turning)
        slack = ROUND_OFFS**2 * round_off / h**2

        def better(state: tuple) -> tuple:
            z, before, *_, count = state
            at = step._at_nodes(way, t, h, z)
            du, dm, dk = step._change(h, at, at_nodes, whole)
            new, heavy = Unknown(z.velocities + du, z.multipliers + dm), jnp.where(first, 0.0, z.velocities)
            # In the metric of M: M δV = R + Aᵀ δκ, where forces change little.
            size = jnp.abs(jnp.sum(jnp.where(first, 0.0, du * at.short))) + jnp.abs(jnp.sum(dk * at.lacks))
            motion = jnp.abs(jnp.sum(heavy * at.momenta))
            solved = size <= small**SOLVED * motion + slack
            if first.any():
                # There is no such metric: each relative to the velocities of its kind.
                change = jnp.max(jnp.abs(du), axis=0)
                speed = self._levels(jnp.max(jnp.maximum(jnp.abs(z.velocities), jnp.abs(new.velocities)), axis=0))
                solved &= jnp.all(~first | (change <= small ** (SOLVED / 2) * speed + noise))
                share = jnp.where(first, change / jnp.where(speed > 0, speed, 1.0), 0.0)
                size, motion = jnp.stack([size, jnp.max(share) ** 2]), jnp.stack([motion, jnp.ones_like(motion)])
            return new, size, before, motion, solved, count + 1

        def goes_on(state: tuple) -> Array:
            _, size, before, motion, solved, count = state
            # What is still missing, at the rate of the last two corrections.
            missing = size * jnp.where(jnp.isfinite(before) & (before > 0), jnp.minimum(size / before, 1.0), 1.0)
            nearer = jnp.any((missing > (ENOUGH * small) ** 2 * motion) & (size < before))
            return (nearer | ~solved) & jnp.all(jnp.isfinite(size)) & (count < MOST_ITERATIONS)

        infinite = jnp.full((2,) if first.any() else (), jnp.inf, h.dtype)
        start = better((guess, infinite, infinite, infinite, jnp.asarray(False), jnp.asarray(0)))
        z, *_, solved, _ = lax.while_loop(goes_on, better, start)
        return z, solved

    def _levels(self, y: Array) -> Array:
        """The largest |y| among coordinates of each one's kind: with a mass, determined by a balance, one state."""
        kinds, first = np.zeros((1, self.model.n), bool), self.model.form.first_order
        if first is not None:
            of_kinds = [first.massless, *(places for _, places in first.states)]
            kinds = np.stack([np.isin(np.arange(self.model.n), places) for places in ([], *of_kinds)])
            kinds[0] = ~self._is_first_order
        largest = jnp.max(jnp.where(kinds, jnp.abs(y)[None], 0.0), axis=1)
        return largest @ kinds.astype(y.dtype)

    def _noise(self, t: Array, x: Array, u: Array) -> Array:
        """By how much velocities of first order change where everything else does by a small part of its size."""
        if self.model.form.first_order is None:
            return jnp.zeros_like(x)
        share = jnp.sqrt(jnp.finfo(x.dtype).eps) * jnp.cos(jnp.arange(x.size, dtype=x.dtype))
        others = jnp.where(self._is_first_order, 0.0, self._levels(u))
        nearby = resolved(self.model, t, x + share * self._levels(x), u + share * others)
        return jnp.abs(nearby - resolved(self.model, t, x, u))

    def _change(self, h: Array, at: "AtNodes", at_nodes: Array, whole: Array | None) -> tuple[Array, Array, Array]:
        """The changes of V and of the multipliers that give what is lacking, and δκ."""
        n, lacks = self.model.n, jnp.concatenate([at.short, at.lacks], axis=1)
        if whole is None:
            change = lacks @ at_nodes.T
            return change[:, :n], self._multipliers(change[:, n:], h), change[:, n:]
        s, m = at.lacks.shape
        change = -whole @ jnp.concatenate([at.short.ravel(), at.lacks.ravel()])
        dm = change[s * n :].reshape(s, m)
        return change[: s * n].reshape(s, n), dm, h * dm

    def _multipliers(self, impulses: Array, h: Array) -> Array:
        """The multipliers whose impulses at the nodes are these."""
        if not self.model.m:
            return impulses
        tab, holonomic = self.tableau, self.model.holonomic
        of_positions = _inverted(tab.of_forces, h.dtype) @ impulses / h
        of_velocities = _inverted(tab.inner, h.dtype) @ impulses / h
        return jnp.where(holonomic[None], of_positions, of_velocities)

    def _whole_inverse(self, way: GaussState, t: Array, h: Array, found: Unknown) -> Array:
        """The inverse of the derivative of all that is lacking by all unknowns."""
        flat, unflatten = ravel_pytree(found)
        return dense.inverse(jax.jacfwd(lambda flat: self._lacks(way, t, h, unflatten(flat)))(flat))

    def _lacks(self, way: GaussState, t: Array, h: Array, z: Unknown) -> Array:
        at = self._at_nodes(way, t, h, z)
        return jnp.concatenate([at.short.ravel(), at.lacks.ravel()])

    def _with_derivatives(self, way: GaussState, t: Array, h: Array, found: Unknown) -> Unknown:
        """The same unknowns as a function of the state and the parameters: by Newton's method, which moves them by
        round-off, and makes one more derivative right in each correction."""
        still = self._replace(model=stop_gradient(self.model))
        inverse = still._whole_inverse(*stop_gradient((way, t, h)), found)
        flat, unflatten = ravel_pytree(found)
        for _ in range(CORRECTIONS):
            flat = flat - inverse @ self._lacks(way, t, h, unflatten(flat))
        return unflatten(flat)


class AtNodes(NamedTuple):
    """Momenta at the nodes, the parts of the step, h b V and h b F, the impulses of constraints on positions, and what
    momenta and constraints lack."""

    momenta: Float[Array, "s n"]
    moves: Float[Array, "s n"]
    kicks: Float[Array, "s n"]
    impulses: Float[Array, "s n"]
    short: Float[Array, "s n"]
    lacks: Float[Array, "s m"]


def added(x: Array, dx: Array) -> tuple[Array, Array]:
    """x + dx, and what is lost (Kahan's compensated summation)."""
    new = x + dx
    return new, dx - (new - x)


def _inverted(matrix, dtype) -> Array:
    return np.linalg.inv(matrix).astype(dtype)
