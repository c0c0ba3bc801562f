"""The rates of change of the charges of many generators at many states, computed by one program.

    dC/dt = ρ + (Q - ∂R/∂v)·(ξ - τ v) + λ·A (ξ - τ v)

(`mechanics/noether.py`). The last part vanishes for every λ if the constraints allow the displacement ξ - τ v; its m
numbers per state are kept separately. Rates are given in units of what they would be if nothing were conserved, e times
the size of the generator:

    e = |p|·|v| + |∂L/∂q|·ℓ + |Q - ∂R/∂v|·ℓ,        |ξ|/ℓ + |τ|/T

where ℓ is the size of each coordinate, and T the time in which the velocities cover such lengths.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from lagjax.analysis.symmetry.random_states import States, around
from lagjax.jaxtools import compiled, numpy_of
from lagjax.mechanics import Generator, GeneratorFlow, applied_force, equations_of, flow
from lagjax.system import Model, constraints


class Precision(NamedTuple):
    """Values up to these, relative to the size that they could have, are round-off.

    `null`: of a rate of change; `zero`: of an entry of a combination; `exact`: of a rate that needs no gauge function;
    `agrees`: of the difference of two numbers that are taken to be equal.
    """

    null: float
    zero: float
    exact: float
    agrees: float


PRECISIONS = {
    np.dtype("float64"): Precision(null=1e-9, zero=1e-8, exact=1e-13, agrees=1e-9),
    np.dtype("float32"): Precision(null=2e-4, zero=1e-3, exact=3e-5, agrees=1e-4),
}


def precision_of(dtype) -> Precision:
    """The tolerances of a dtype."""
    return PRECISIONS[np.dtype(dtype)]


class Affine(eqx.Module):
    """K generators of the form ξ = shift + matrix x + t drift, τ = clock + t clock_rate."""

    shift: np.ndarray
    matrix: np.ndarray
    drift: np.ndarray
    clock: np.ndarray
    clock_rate: np.ndarray

    def at(self, t, x, u) -> GeneratorFlow:
        """The flow of each generator at a state."""

        def to(y: Array):
            return jnp.asarray(y, x.dtype)

        xi = to(self.shift) + to(self.matrix) @ x + t * to(self.drift)
        xi_rate = to(self.matrix) @ u + to(self.drift)
        tau, tau_rate = to(self.clock) + t * to(self.clock_rate), to(self.clock_rate)
        return GeneratorFlow(xi, tau, jnp.zeros_like(tau), xi_rate, tau_rate, jnp.zeros_like(tau))


class Rates(NamedTuple):
    """The rates for N states, m constraint equations and K generators, relative to the size that they could have.

    `charge` (N, K): the rate due to L, force and dissipation together; `lagrangian` and `force`: its two parts.
    `displacement` (N, m, K): how much each constraint equation forbids ξ - τ v. `invariance` (N, m, K): how much the
    motion changes a velocity constraint. `value` (N,): L.

    Not relative: `size` (K,) of each generator; `energy` (N,), the e of each state; `xi` (N, K, n), `tau` (N, K);
    `charges` (N, K), the charges themselves; `first` (K,) and `pushed` (m, K): the rate without constraints and
    A (ξ - τ v), both at the first state.
    """

    states: States
    charge: Float[Array, "N K"]
    lagrangian: Float[Array, "N K"]
    force: Float[Array, "N K"]
    displacement: Float[Array, "N m K"]
    invariance: Float[Array, "N m K"]
    value: Float[Array, " N"]
    size: Float[Array, " K"]
    energy: Float[Array, " N"]
    xi: Float[Array, "N K n"]
    tau: Float[Array, "N K"]
    charges: Float[Array, "N K"]
    first: Float[Array, " K"]
    pushed: Float[Array, "m K"]


class _StateRates(NamedTuple):
    """The quantities at one state, not relative."""

    by_lagrangian: Array
    by_force: Array
    forbidden: Array
    slope: Array
    changed: Array
    size: Array
    energy: Array
    xi: Array
    tau: Array
    value: Array
    charges: Array


def rates(model: Model, affine: Affine, generators: tuple[Generator, ...], s, places) -> Rates:
    """The rates of change of all charges at states around the given one."""
    states, scales = around(model, s, places)
    raw = _rates(model, affine, generators, states, scales)
    xp = numpy_of(raw)
    raw = _StateRates(*(xp.asarray(y) for y in raw))
    finite = xp.isfinite(raw.energy) & xp.all(xp.isfinite(raw.by_lagrangian + raw.by_force), axis=1)
    found = states.found & finite

    def kept(y: Array):
        return xp.where(found.reshape(-1, *[1] * (y.ndim - 1)), y, xp.zeros_like(y))

    count = xp.maximum(xp.sum(found), 1).astype(raw.energy.dtype)
    size = xp.sqrt(xp.sum(kept(raw.size) ** 2, axis=0) / count)
    size = xp.where(size > 0, size, xp.ones_like(size))
    # A state where nothing moves and no force acts has no scale of its own.
    energy = kept(raw.energy) + raw.energy.dtype.type(1e-12) * xp.max(kept(raw.energy))
    energy = xp.where(found & (energy > 0), energy, xp.ones_like(energy))

    def relative(y: Array):
        return kept(y) / (energy[:, None] * size[None])

    slope = xp.where(raw.slope > 0, raw.slope, xp.ones_like(raw.slope))[:, :, None] * size[None, None]
    return Rates(
        states._replace(found=found),
        relative(raw.by_lagrangian + raw.by_force), relative(raw.by_lagrangian), relative(raw.by_force),
        kept(raw.forbidden) / slope, kept(raw.changed) * scales.t / slope, kept(raw.value) / energy,
        size, energy, kept(raw.xi), kept(raw.tau), raw.charges, (raw.by_lagrangian + raw.by_force)[0], raw.forbidden[0],
    )  # fmt: skip


@compiled
def _rates(model: Model, affine, generators, states, scales) -> _StateRates:
    params, equations = model.params, equations_of(model) if model.reacts else None

    def at(t, x, u):
        value, (slope_t, slope, p) = jax.value_and_grad(model.lagrangian, argnums=(0, 1, 2))(t, x, u)
        q, v = model.tree(x), model.tree(u)
        flows = [flow(generator, t, q, v, params) for generator in generators]
        moved = jtu.tree_map(
            lambda first, *rest: jnp.concatenate([first, *(y[None] for y in rest)]), affine.at(t, x, u), *flows
        )
        turned = moved.xi_rate - jnp.outer(moved.tau_rate, u)
        displaced = moved.xi - jnp.outer(moved.tau, u)
        # ρ and C of `noether.py`.
        of_L = moved.tau * slope_t + moved.xi @ slope + turned @ p + value * moved.tau_rate - moved.gauge_rate
        charges = displaced @ p + moved.tau * value - moved.gauge
        multipliers = None if equations is None else model.stacked(equations.accelerations(t, q, v)[1])
        force = applied_force(model, t, x, u, multipliers)
        energy = jnp.abs(p) @ jnp.abs(u) + (jnp.abs(slope) + jnp.abs(force)) @ scales.x
        size = jnp.sqrt(moved.xi**2 @ (1 / scales.x**2)) + jnp.abs(moved.tau) / scales.t
        rows = _constraint_rates(model, scales, (t, x, u), moved, turned, displaced)
        return _StateRates(of_L, displaced @ force, *rows, size, energy, moved.xi, moved.tau, value, charges)

    return jax.vmap(at)(*states[:3])


def _constraint_rates(model: Model, scales, state, moved, turned, displaced):
    """A (ξ - τ v) (m, K), the size of each row of A (m,), and the change of each velocity constraint (m, K)."""
    t, x, u = state
    if not model.m:
        empty = jnp.zeros((0, moved.tau.size), x.dtype)
        return empty, jnp.zeros(0, x.dtype), empty
    of_t, of_x, rows = jax.jacfwd(lambda t, x, u: constraints.velocity_residual(model, t, x, u), argnums=(0, 1, 2))(
        t, x, u
    )
    change = jnp.outer(of_t, moved.tau) + of_x @ moved.xi.T + rows @ turned.T
    return rows @ displaced.T, jnp.abs(rows) @ scales.x, change
