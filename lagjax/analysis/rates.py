"""At what rate the charge of each of many generators changes, at many states: one program for all.

    dC/dt = ρ + (Q - ∂R/∂v)·(ξ - τ v) + λ·A (ξ - τ v)

(`mechanics/noether.py`). The last part vanishes for every λ where the constraints allow the displacement ξ - τ v: these
are kept apart, (m,) numbers a state. Rates are told in units of what they would be if nothing were conserved: of

    e = |p|·|v| + |∂L/∂q|·ℓ + |Q - ∂R/∂v|·ℓ        times        |ξ|/ℓ + |τ|/T

with ℓ the size of each coordinate, and T the time in which velocities make such lengths.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float

from lagjax.analysis.states import States, around
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.closures import lift
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.generators import Generator
from lagjax.mechanics.noether import Flow, applied_force, flow
from lagjax.mechanics.reactions import reacts


class Affine(eqx.Module):
    """Many generators of the kind ξ = shift + matrix x + t drift, τ = clock + t clock_rate, K of each."""

    shift: np.ndarray
    matrix: np.ndarray
    drift: np.ndarray
    clock: np.ndarray
    clock_rate: np.ndarray

    def at(self, t, x, u) -> Flow:
        """What each of them does at a state."""
        to = lambda y: jnp.asarray(y, x.dtype)
        xi = to(self.shift) + to(self.matrix) @ x + t * to(self.drift)
        xi_rate = to(self.matrix) @ u + to(self.drift)
        tau, tau_rate = to(self.clock) + t * to(self.clock_rate), to(self.clock_rate)
        return Flow(xi, tau, xi_rate, tau_rate, jnp.zeros_like(tau))


class Rates(NamedTuple):
    """Of N states, m constraint equations and K generators, all in units of what they could be.

    `charge` (N, K): by L, force and dissipation; of these `lagrangian` (N, K) and `force` (N, K). `displacement`
    (N, m, K): by how much each constraint equation forbids ξ - τ v. `invariance` (N, m, K): by how much a constraint of
    velocities is changed by the motion. `size` (K,): of each generator; `energy` (N,): the e of each state. `flows`: ξ,
    (N, K, n), and τ. `value` (N,): L, in units of e.
    """

    states: States
    charge: Float[Array, "N K"]
    lagrangian: Float[Array, "N K"]
    force: Float[Array, "N K"]
    displacement: Float[Array, "N m K"]
    invariance: Float[Array, "N m K"]
    size: Float[Array, " K"]
    energy: Float[Array, " N"]
    xi: Float[Array, "N K n"]
    tau: Float[Array, "N K"]
    value: Float[Array, " N"]


@compiled
def rates(system, affine: Affine, generators: tuple[Generator, ...], s, places) -> Rates:
    """The rates of change of all charges at states around the given one."""
    return rates_of(system, affine, generators, s, places)


def rates_of(system, affine, generators, s, places) -> Rates:
    """The same as part of another program."""
    x, unflatten = coordinates.flatten(s.q)
    states, scales = around(system, s, places)
    equations = equations_of(lift(system, s), *s) if reacts(system) else None

    def at(t, x, u):
        lagrangian = lambda t, x, u: system.lagrangian(t, unflatten(x), unflatten(u), s.params)
        value, (slope_t, slope, p) = jax.value_and_grad(lagrangian, argnums=(0, 1, 2))(t, x, u)
        q, v = unflatten(x), unflatten(u)
        flows = [flow(generator, t, q, v, s.params) for generator in generators]
        moved = jtu.tree_map(lambda first, *rest: jnp.concatenate([first, *(y[None] for y in rest)]),
                             affine.at(t, x, u), *flows)  # fmt: skip
        turned = moved.xi_rate - jnp.outer(moved.tau_rate, u)
        displaced = moved.xi - jnp.outer(moved.tau, u)
        # ρ, as `noether.py` has it.
        of_L = moved.tau * slope_t + moved.xi @ slope + turned @ p + value * moved.tau_rate - moved.gauge_rate
        none = jnp.zeros(constraints.count(system, t, q, v, s.params), x.dtype)
        if equations is not None:
            stacked = equations.accelerations(t, q, v)[1]
            none = jnp.concatenate([jnp.atleast_1d(stacked[name]) for name in system.constraints])
        force = applied_force(system, t, q, v, s.params, none)
        energy = jnp.abs(p) @ jnp.abs(u) + (jnp.abs(slope) + jnp.abs(force)) @ scales.x
        forbidden, changed = _of_constraints(system, s.params, unflatten, scales, (t, x, u), moved, turned, displaced)
        size = jnp.sqrt(moved.xi**2 @ (1 / scales.x**2)) + jnp.abs(moved.tau) / scales.t
        return of_L, displaced @ force, forbidden, changed, size, energy, moved.xi, moved.tau, value

    of_L, force, forbidden, changed, size, energy, xi, tau, value = jax.vmap(at)(*states[:3])
    finite = jnp.isfinite(energy) & jnp.all(jnp.isfinite(of_L + force), axis=1)
    states = states._replace(found=states.found & finite)
    seen = lambda y: jnp.where(states.found.reshape(-1, *[1] * (y.ndim - 1)), y, 0.0)
    count = jnp.maximum(jnp.sum(states.found), 1).astype(x.dtype)
    size = jnp.sqrt(jnp.sum(seen(size) ** 2, axis=0) / count)
    size = jnp.where(size > 0, size, 1.0)
    energy = seen(energy)
    # A state where nothing happens has no scale of its own.
    energy = jnp.where(states.found, energy + 1e-12 * jnp.max(energy), 1.0)
    energy = jnp.where(energy > 0, energy, 1.0)
    relative = lambda y: seen(y) / jnp.outer(energy, size)
    of_rows = lambda y: seen(y) / size[None, None]
    return Rates(
        states, relative(of_L + force), relative(of_L), relative(force), of_rows(forbidden), of_rows(changed), size,
        energy, seen(xi), seen(tau), seen(value) / energy,
    )  # fmt: skip


def _of_constraints(system, params, unflatten, scales, state, moved, turned, displaced):
    """A (ξ - τ v), and the change of each constraint of velocities, of every generator; relative, (m, K)."""
    t, x, u = state
    if not system.constraints:
        none = jnp.zeros((0, moved.tau.size), x.dtype)
        return none, none
    residual = lambda t, x, u: constraints.velocity_residual(system, t, x, u, params, unflatten)
    of_t, of_x, rows = jax.jacfwd(residual, argnums=(0, 1, 2))(t, x, u)
    slope = jnp.abs(rows) @ scales.x
    slope = jnp.where(slope > 0, slope, 1.0)[:, None]
    change = jnp.outer(of_t, moved.tau) + of_x @ moved.xi.T + rows @ turned.T
    return rows @ displaced.T / slope, change / slope * scales.t
