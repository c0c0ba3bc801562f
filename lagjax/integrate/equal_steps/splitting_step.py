"""One step of an explicit symplectic splitting (`numerics/symplectic.py`)."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.integrate.equal_steps.gauss_step import added
from lagjax.mechanics import applied_force, mass_and_forcing
from lagjax.numerics import dense, sequence
from lagjax.system import Model


class SplitWay(NamedTuple):
    """The state between two steps; `x_rest`, `u_rest`: what is to be added; `pull`: the acceleration there."""

    x: Float[Array, " n"]
    x_rest: Float[Array, " n"]
    u: Float[Array, " n"]
    u_rest: Float[Array, " n"]
    pull: Float[Array, " n"]
    unsolved: Bool[Array, ""]


class SplittingStep(NamedTuple):
    """Steps of a model whose mass matrix is constant, with its inverse."""

    model: Model
    order: int
    inverse: Float[Array, "n n"]

    @classmethod
    def of(cls, model: Model, order: int, t: Array, x: Array, u: Array) -> "SplittingStep":
        """Steps of this model."""
        return cls(model, order, dense.inverse(mass_and_forcing(model, t, x, u).mass))

    def first(self, t: Array, x: Array, u: Array) -> SplitWay:
        """The state at the start."""
        return SplitWay(x, jnp.zeros_like(x), u, jnp.zeros_like(u), self._pull(t, x), jnp.asarray(False))

    def advanced(self, way: SplitWay, t: Array, h: Array) -> SplitWay:
        """The state after a step from t to t + h."""
        kicks, drifts = sequence(self.order)
        # Python's numbers take the dtype of the state.
        start = way.x_rest, way.u_rest + float(kicks[0]) * h * way.pull, way.pull

        def one(state: tuple, row: tuple):
            (dx, du, _), (kick, drift, part) = state, row
            dx = dx + drift * h * (way.u + du)
            pull = self._pull(t + part * h, way.x + dx)
            return (dx, du + kick * h * pull, pull), None

        rows = jax.tree.map(lambda x: jnp.asarray(x, h.dtype), (kicks[1:], drifts, np.cumsum(drifts)))
        # Of single numbers XLA computes the forces again for each result of a step: in a loop order 8 takes a fifth.
        (dx, du, pull), _ = lax.scan(one, start, rows, unroll=self.model.n > 1)
        x, x_rest = added(way.x, dx)
        u, u_rest = added(way.u, du)
        return SplitWay(x, x_rest, u, u_rest, pull, ~jnp.all(jnp.isfinite(x)))

    def velocity(self, way: SplitWay, t: Array) -> Float[Array, " n"]:
        """The velocity."""
        return way.u

    def _pull(self, t: Array, x: Array) -> Array:
        u = jnp.zeros_like(x)
        return self.inverse @ (jax.grad(self.model.lagrangian, argnums=1)(t, x, u) + applied_force(self.model, t, x, u))
