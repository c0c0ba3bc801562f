"""One-parameter groups of motions of a system, and what each of them conserves.

A generator moves the coordinates by ε ξ(t, q) and the time by ε τ(t, q). It is a symmetry of L where the action changes
only by terms at its ends: by ε times the total derivative of a function F(t, q), the gauge term,

    τ ∂L/∂t + ξ·∂L/∂q + (dξ/dt - v dτ/dt)·p + L dτ/dt - dF/dt = 0,        p = ∂L/∂v

with d/dt = ∂/∂t + v·∂/∂q. Call the left side ρ. With all forces f = Q - ∂R/∂v + Aᵀ λ that L does not contain, the
equations of motion `dp/dt = ∂L/∂q + f` give

    C = p·ξ - τ (v·p - L) - F,        dC/dt = ρ + f·(ξ - τ v)

at every state, symmetry or not. So C is constant where ρ = 0 and no force acts along ξ - τ v; a constraint's own force
λ·A (ξ - τ v) vanishes for all λ where the displacement is one that the constraint allows.

Source: Noether, Nachr. Ges. Wiss. Göttingen (1918) 235, §2; Goldstein, *Classical Mechanics*, §13.7;
Neĭmark & Fufaev, *Dynamics of Nonholonomic Systems*, §III.6 (velocity constraints).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.jaxtools import compiled
from lagjax.mechanics.accelerations import accelerations_at
from lagjax.mechanics.generators import Generator, as_generator
from lagjax.mechanics.lagrangian import applied_force
from lagjax.system import Model, State, System, check_system, constraints, coordinates, model_of, traced_system


class NoetherCharge(eqx.Module):
    """The charge of a generator: a function of (t, q, v, params), `[L] [t]`; `noether_charge` makes it.

    `rate(t, q, v, params)`: its rate of change along a motion, zero where it is conserved and correct where it is not.
    """

    system: System
    generator: Generator

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        """The charge at one state."""
        return _charge(*self._checked(t, q, v, params))

    def rate(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        """How fast the charge changes at one state, `[L]`: ρ + f·(ξ - τ v)."""
        generator, model, s = self._checked(t, q, v, params)
        return _rate(generator, model, s, accelerations_at(model, s)[1] if model.m else {})

    def size(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
        """The size of the terms that the charge is a sum of, to compare a change of it with."""
        return _size(*self._checked(t, q, v, params))

    def _checked(self, *state):
        s = coordinates.state(*state)
        self.generator.check(s)
        return self.generator, model_of(traced_system(self.system, s), *s), s

    def __repr__(self):
        return f"NoetherCharge({self.generator.name} of {self.system})"


def noether_charge(system: System, generator) -> NoetherCharge:
    """Return the charge `C = p·ξ - τ (v·p - L) - F` that a one-parameter group conserves where it is a symmetry.

    >>> import lagjax as lj
    >>> def kepler(t, q, v, params):
    ...     return 0.5 * (v["x"] ** 2 + v["y"] ** 2) + params["k"] / (q["x"] ** 2 + q["y"] ** 2) ** 0.5
    >>> turn = lambda t, q, params: {"x": -q["y"], "y": q["x"]}
    >>> L_z = noether_charge(lj.System(kepler), turn)
    >>> print(L_z(0.0, {"x": 3.0, "y": 0.0}, {"x": 1.0, "y": 2.0}, {"k": 1.0}))
    6.0

    A translation gives the momentum p, a rotation the angular momentum; `lj.Generator.time_translation()`, which sets
    the clock back (τ = -1), the Jacobi integral v·p - L, and a `time` of +1 minus that.

    **Arguments:**

    - `system`: as for `integrate`.
    - `generator`: a `lj.Generator`, or the function `delta(t, q, params)` -> like q, the velocity ξ with which the
      group moves the coordinates, `[q]/[ε]`.

    **Returns:** a function of (t, q, v, params) -> scalar, `[L] [t]/[ε]`, for `jit`, `vmap` and derivatives; its
    `rate` of the same arguments is dC/dt along a motion, also where that is not zero.

    **Raises:** `TypeError` for a generator that is not a function; `ValueError`, when it is called, for one whose
    displacement does not have the structure of q, with the coordinate by name.

    Source: Goldstein, §13.7; the gauge term as in Derivation 8 of its chapter 1.
    """
    check_system(system, generator, states=False)
    return NoetherCharge(system, as_generator(generator))


class GeneratorFlow(NamedTuple):
    """A generator at one state: ξ, τ and F, and their total derivatives along the motion; ξ in vector form."""

    xi: Float[Array, " n"]
    tau: Float[Array, ""]
    gauge: Float[Array, ""]
    xi_rate: Float[Array, " n"]
    tau_rate: Float[Array, ""]
    gauge_rate: Float[Array, ""]


def flow(generator: Generator, t: Array, q: PyTree, v: PyTree, params: PyTree) -> GeneratorFlow:
    """A generator and its total derivatives at one state."""
    (xi, tau, gauge), (xi_rate, tau_rate, gauge_rate) = jax.jvp(
        lambda t, q: generator.at(t, q, params), (t, q), (jnp.ones_like(t), v)
    )

    def vector(y: PyTree) -> Array:
        return coordinates.flatten(y)[0]

    return GeneratorFlow(vector(xi), tau, gauge, vector(xi_rate), tau_rate, gauge_rate)


def _terms(generator, model: Model, s: State):
    x, u = model.vectors(s.q, s.v)
    value, p = jax.value_and_grad(model.lagrangian, argnums=2)(s.t, x, u)
    xi, tau, gauge = generator.at(s.t, s.q, s.params)
    return p * model.vector(xi), tau * p * u, tau * value, gauge


@compiled
def _charge(generator, model: Model, s: State):
    moved, power, value, gauge = _terms(generator, model, s)
    return jnp.sum(moved - power) + value - gauge


@compiled
def _size(generator, model: Model, s: State):
    return sum(jnp.sum(jnp.abs(term)) for term in _terms(generator, model, s))


@compiled
def _rate(generator, model: Model, s: State, multipliers: Array):
    x, u = model.vectors(s.q, s.v)
    moved = flow(generator, *s)
    change = (moved.tau, moved.xi, moved.xi_rate - u * moved.tau_rate)
    value, rate = jax.jvp(model.lagrangian, (s.t, x, u), change)
    rate = rate + value * moved.tau_rate - moved.gauge_rate
    stacked = model.stacked(multipliers)
    force = applied_force(model, s.t, x, u, stacked)
    if model.m:
        force = force + stacked @ constraints.jacobian(model, s.t, x, u)
    return rate + force @ (moved.xi - moved.tau * u)
