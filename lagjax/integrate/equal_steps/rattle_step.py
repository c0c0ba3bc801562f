"""One step of the explicit splitting where positions are constrained: RATTLE, and steps of it after each other.

Of the length h, with the forces at both ends and the multipliers κ that bring the position back to the constraints, and
μ the velocity:

    u½ = u0 + h/2 M⁻¹ F(x0) + M⁻¹ A(x0)ᵀ κ        x1 = x0 + h u½        0 = g(t1, x1)
    u1 = u½ + h/2 M⁻¹ F(x1) + M⁻¹ A(x1)ᵀ μ                              0 = A(x1) u1 + ∂g/∂t

It is symmetric and, on the constraints, symplectic, of order 2; steps of the lengths γ_i h after each other
(`numerics/symplectic.py`) are so of a higher order. κ is found by iteration with A(x1) M⁻¹ A(x0)ᵀ at a guess of
x1, and is h/2 times the multiplier there. Of constraints that depend on each other a largest independent set is kept in
each step, chosen at its start: the others then hold as well.

Source: Andersen, J. Comput. Phys. 52 (1983) 24; Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §VII.1.4;
Leimkuhler & Skeel, J. Comput. Phys. 112 (1994) 117 (symplecticity).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.integrate.equal_steps.gauss_step import CORRECTIONS, ENOUGH, MOST_ITERATIONS, ROUND_OFFS, added
from lagjax.jaxtools import stop_gradient
from lagjax.mechanics import applied_force, mass_and_forcing
from lagjax.numerics import dense, independent_rows, lengths
from lagjax.system import Model, constraints


class Advance(NamedTuple):
    """What steps after each other add to the state at their start.

    `pull`: M⁻¹ F; `rows`: A, of the kept constraints; `multipliers`: those of the last step.
    """

    dx: Float[Array, " n"]
    du: Float[Array, " n"]
    pull: Float[Array, " n"]
    rows: Float[Array, "m n"]
    multipliers: Float[Array, " m"]
    unsolved: Bool[Array, ""]


class RattleWay(NamedTuple):
    """The state between two steps, and what is to be added to it; `kept`: the constraints to step with."""

    x: Float[Array, " n"]
    u: Float[Array, " n"]
    moved: Advance
    kept: Bool[Array, " m"]
    unsolved: Bool[Array, ""]


class RattleStep(NamedTuple):
    """Steps of a model whose mass matrix is constant, with constraints on positions.

    `differentiated`: whether derivatives will be taken.
    """

    model: Model
    order: int
    mass: Float[Array, "n n"]
    inverse: Float[Array, "n n"]
    differentiated: bool

    @classmethod
    def of(cls, model: Model, order: int, t: Array, x: Array, u: Array, differentiated: bool) -> "RattleStep":
        """Steps of this model."""
        mass = mass_and_forcing(model, t, x, u).mass
        return cls(model, order, mass, dense.inverse(mass), differentiated)

    def first(self, t: Array, x: Array, u: Array) -> RattleWay:
        """The state at the start."""
        none, rows = jnp.zeros_like(x), self._rows(t, x)
        kept, solved = independent_rows(rows), jnp.asarray(False)
        moved = Advance(none, none, self._pull(t, x), rows, jnp.zeros(self.model.m, x.dtype), solved)
        return RattleWay(x, u, moved, kept, solved)

    def advanced(self, way: RattleWay, t: Array, h: Array) -> RattleWay:
        """The state after a step from t to t + h."""
        parts = lengths(self.order).astype(h.dtype)
        ends = parts.cumsum()

        def one(moved: Advance, part: tuple[Array, Array, Array]):
            start, share, end = part
            return self._rattle(way, moved, (t + start * h, share * h, t + end * h)), None

        moved, _ = lax.scan(one, way.moved, (ends - parts, jnp.asarray(parts), ends))
        x, dx = added(way.x, moved.dx)
        u, du = added(way.u, moved.du)
        unsolved = way.unsolved | moved.unsolved | ~jnp.all(jnp.isfinite(x))
        return RattleWay(x, u, moved._replace(dx=dx, du=du), independent_rows(moved.rows), unsolved)

    def velocity(self, way: RattleWay, t: Array) -> Float[Array, " n"]:
        """The velocity."""
        return way.u

    def _rattle(self, way: RattleWay, moved: Advance, times: tuple[Array, Array, Array]) -> Advance:
        """A step of order 2."""
        _, h, t1 = times
        half = moved.du + h / 2 * moved.pull
        by_impulse = self._by_impulse(moved.rows, way.kept)
        impulses = jnp.where(way.kept, moved.multipliers, 0.0) * h / 2
        problem = way, moved.dx, half, by_impulse, h, t1
        impulses, solved = stop_gradient(self)._solved(*stop_gradient((problem, impulses)))
        if self.differentiated:
            impulses = self._with_derivatives(problem, impulses)
        half = half + by_impulse @ impulses
        dx = moved.dx + h * (way.u + half)
        x = way.x + dx
        pull, rows = self._pull(t1, x), self._rows(t1, x)
        du, by_impulse = half + h / 2 * pull, self._by_impulse(rows, way.kept)
        slopes = constraints.velocity_residual(self.model, t1, x, way.u + du)
        du = du - by_impulse @ (self._inverse_of(rows, by_impulse, way.kept) @ jnp.where(way.kept, slopes, 0.0))
        return Advance(dx, du, pull, rows, 2 * impulses / h, moved.unsolved | ~solved)

    def _solved(self, problem: tuple, impulses: Array) -> tuple[Array, Bool[Array, ""]]:
        """κ, by iteration, and whether that came to an end."""
        way, _, _, by_impulse, h, t1 = problem
        place = self._place(problem, impulses)
        inverse = self._inverse_of(self._rows(t1, place), by_impulse, way.kept) / h
        small = jnp.finfo(h.dtype).eps ** 2 * (jnp.abs(place) @ jnp.abs(self.mass) @ jnp.abs(place))

        def better(state: tuple) -> tuple:
            impulses, before, _, count = state
            gaps = self._gaps(problem, impulses)
            change = inverse @ gaps
            # The size of a correction: what it moves, squared in the metric of M.
            return impulses - change, jnp.abs(h * (change @ gaps)), before, count + 1

        def missing(size: Array, before: Array) -> Array:
            # At the rate of the last two corrections.
            return size * jnp.where(jnp.isfinite(before) & (before > 0), jnp.minimum(size / before, 1.0), 1.0)

        def goes_on(state: tuple) -> Array:
            _, size, before, count = state
            closer = (size < before) | (missing(size, before) > ROUND_OFFS**2 * small)
            return (missing(size, before) > ENOUGH**2 * small) & closer & (count < MOST_ITERATIONS)

        infinite = jnp.asarray(jnp.inf, h.dtype)
        start = better((impulses, infinite, infinite, jnp.asarray(0)))
        impulses, size, before, _ = lax.while_loop(goes_on, better, start)
        return impulses, missing(size, before) <= ROUND_OFFS**2 * small

    def _with_derivatives(self, problem: tuple, impulses: Array) -> Array:
        """The same κ as a function of the state and the parameters: by Newton's method, which moves it by round-off,
        and makes one more derivative right in each correction."""
        way, _, _, by_impulse, h, t1 = stop_gradient(problem)
        still = stop_gradient(self)
        rows = still._rows(t1, still._place(stop_gradient(problem), impulses))
        inverse = still._inverse_of(rows, by_impulse, way.kept) / h
        for _ in range(CORRECTIONS):
            impulses = impulses - inverse @ self._gaps(problem, impulses)
        return impulses

    def _place(self, problem: tuple, impulses: Array) -> Array:
        way, dx, half, by_impulse, h, _ = problem
        return way.x + (dx + h * (way.u + (half + by_impulse @ impulses)))

    def _gaps(self, problem: tuple, impulses: Array) -> Array:
        gaps = constraints.position_residual(self.model, problem[-1], self._place(problem, impulses))
        return jnp.where(problem[0].kept, gaps, 0.0)

    def _by_impulse(self, rows: Array, kept: Array) -> Float[Array, "n m"]:
        """M⁻¹ Aᵀ of the kept constraints."""
        return self.inverse @ jnp.where(kept[:, None], rows, 0.0).T

    def _inverse_of(self, rows: Array, by_impulse: Array, kept: Array) -> Float[Array, "m m"]:
        """(A M⁻¹ Aᵀ)⁻¹ of the kept constraints, and the unit matrix for the others."""
        rows = jnp.where(kept[:, None], rows, 0.0)
        return dense.inverse(rows @ by_impulse + jnp.diag(jnp.where(kept, 0.0, 1.0).astype(rows.dtype)))

    def _rows(self, t: Array, x: Array) -> Float[Array, "m n"]:
        return constraints.jacobian(self.model, t, x, jnp.zeros_like(x))

    def _pull(self, t: Array, x: Array) -> Array:
        u = jnp.zeros_like(x)
        return self.inverse @ (jax.grad(self.model.lagrangian, argnums=1)(t, x, u) + applied_force(self.model, t, x, u))
