"""Equations that the user's own `forward_dynamics` solves: f(t, q, v, force, params) -> a, with M a = F + force.

a is affine in the force, and its slope is M⁻¹: products with it are pushed forward through f, as many as there are
constraint equations. With them

    a = a₀ + M⁻¹ Aᵀ λ,    S λ = gamma - A a₀,    S = A M⁻¹ Aᵀ

and nothing of size n × n is formed. A force that depends on the multipliers, B λ, is solved with as elsewhere, by the
accelerations M⁻¹ B that it causes (`multiplier_forces.py`). That f solves the equations of L is checked where a motion
starts and at each call from Python, there and at other velocities, along a few directions w: w·(M a - F) takes
derivatives of L forward alone.

Source: Featherstone, *Rigid Body Dynamics Algorithms*, §6.1 (forward dynamics), §8.4 (constraint forces by M⁻¹).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.mechanics.first_order import is_determined, resolved
from lagjax.mechanics.lagrangian import applied_force
from lagjax.mechanics.multiplier_forces import Reactions, at_once, response, with_reactions
from lagjax.mechanics.saddle_point import Verdict, acceleration_round_off, chosen, minimum_norm
from lagjax.numerics import DEPENDENT_BELOW, SINGULAR_BELOW, dense
from lagjax.system import Model, constraints

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
            return _solved(model, t, x, u)(applied_force(model, t, x, resolved(model, t, x, u))), jnp.zeros(0, x.dtype)
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
        a, multipliers = self.accelerations(*state)
        unit = np.eye(model.n, dtype=x.dtype)
        mass = lax.map(lambda w: _momentum_rate(*state, (0.0, jnp.zeros_like(x), w), w), unit, batch_size=BLOCK)
        along = np.random.default_rng(0).uniform(0.5, 1.0, (DIRECTIONS, model.n)).astype(x.dtype)
        singular, contradictory = ~is_determined(*state), jnp.asarray(False)
        if model.m:
            solver = _solver(*state, None)
            scale = 1 / jnp.sqrt(jnp.abs(jnp.diagonal(solver.schur)))
            conditioned = dense.reciprocal_condition(scale[:, None] * solver.schur * scale[None, :])
            jacobian, gamma = solver.rows
            singular |= (conditioned <= SINGULAR_BELOW[np.dtype(x.dtype)]) | ~solver.solved(gamma).unique
            terms = jnp.abs(jacobian) @ jnp.abs(a) + jnp.abs(gamma)
            forces = jnp.abs(mass * a) + jnp.abs(multipliers) @ jnp.abs(jacobian)
            round_off = self.row_sizes(*state) * acceleration_round_off(mass, forces, x, u)
            allowed = DEPENDENT_BELOW[np.dtype(x.dtype)] * terms + round_off
            contradictory = jnp.any(~solver.independent & (jnp.abs(jacobian @ a - gamma) > allowed))
        known = jnp.concatenate([a, multipliers, jnp.ravel(model.lagrangian(t, x, u))])
        finite = jnp.all(jnp.isfinite(known)) & ~jnp.any(missed(*state, along)[1])
        return Verdict(a, multipliers, finite, singular, contradictory, mass)

    def solution_or_nan(self, *state):
        """The solution as vectors, NaN where constraints contradict each other."""
        if not state[0].m:
            return self.accelerations(*state)
        found = self.verdict(*state)
        return tuple(jnp.where(found.contradictory, jnp.nan, x) for x in (found.a, found.multipliers))

    def __str__(self):
        return self.name


def missed(
    model: Model, t: Array, x: Array, u: Array, along: Float[Array, "k n"]
) -> tuple[Float[Array, " k"], Bool[Array, " k"]]:
    """By how much the accelerations miss M a = F along some directions, and where that is more than round-off.

    The larger of the misses at these velocities and at others, where Coriolis terms have their part.
    """
    size = jnp.max(jnp.abs(u))
    other = u + jnp.where(size > 0, size, 1.0) * jnp.cos(jnp.arange(u.size, dtype=u.dtype))

    def terms(u: Array) -> Array:
        u = resolved(model, t, x, u)
        force = applied_force(model, t, x, u)
        onward = jnp.ones_like(t), u, _solved(model, t, x, u)(force)

        def of(w: Array) -> Array:
            _, slope = jax.jvp(lambda x: model.lagrangian(t, x, u), (x,), (w,))
            return jnp.stack([_momentum_rate(model, t, x, u, onward, w), -slope, -force @ w])

        return jax.vmap(of)(_without_first_order(model, along))

    found = jax.vmap(terms)(jnp.stack([u, other]))
    by = jnp.max(jnp.abs(jnp.sum(found, axis=2)), axis=0)
    return by, ~(by <= AGREES[np.dtype(x.dtype)] * jnp.max(jnp.abs(found)))


def _momentum_rate(model: Model, t: Array, x: Array, u: Array, onward: tuple, w: Array) -> Float[Array, ""]:
    """The change of w·∂L/∂v along a direction (dt, dx, dv): derivatives forward alone, which take least to compile."""

    def momentum(t: Array, x: Array, u: Array) -> Array:
        return jax.jvp(lambda u: model.lagrangian(t, x, u), (u,), (w,))[1]

    onward = tuple(jnp.asarray(d, x.dtype) for d in onward)
    return jax.jvp(momentum, (t, x, u), onward)[1]


def _without_first_order(model: Model, along: Array) -> Array:
    first = model.form.first_order
    return jnp.asarray(along) if first is None else jnp.where(first.mask(model.n)[None], 0.0, along)


def _solved(model: Model, t: Array, x: Array, u: Array) -> Callable:
    """The accelerations as a function of the force beside L."""
    first = model.form.first_order
    moving = resolved(model, t, x, u)

    def of_force(force: Array) -> Array:
        a = model.forward_dynamics(t, x, moving, force)
        return a if first is None else jnp.where(first.mask(model.n), 0.0, a)

    return of_force


def _solver(model: Model, t: Array, x: Array, u: Array, independent: Array | None) -> Solver:
    force = applied_force(model, t, x, resolved(model, t, x, u))
    free, push = jax.linearize(_solved(model, t, x, u), force)
    rows = constraints.acceleration_rows(model, t, x, u)
    responses = jax.vmap(push)(rows.jacobian)
    independent = chosen(model, rows.jacobian) if independent is None else independent
    both = independent[:, None] & independent[None, :]
    schur = jnp.where(both, responses @ rows.jacobian.T, jnp.eye(model.m, dtype=x.dtype))
    loads = response(model, t, x, resolved(model, t, x, u))
    reactions = None if loads is None else jax.vmap(push, in_axes=1, out_axes=1)(loads)
    return Solver(free, rows, responses, schur, independent, reactions)
