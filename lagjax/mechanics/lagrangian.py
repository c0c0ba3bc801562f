"""What a Lagrangian says about one state: momentum, mass matrix, forcing, Jacobi integral.

With `p = ∂L/∂v`, Lagrange's equations `dp/dt = ∂L/∂q + Q - ∂R/∂v` become linear in the acceleration a:

    M a = F,    M = ∂²L/∂v∂v,    F = ∂L/∂q - ∂p/∂t - (∂p/∂q) v + Q - ∂R/∂v

because `dp/dt = ∂p/∂t + (∂p/∂q) v + M a`. One linearization of `p(t, q, v)` gives all of it: pushed along
`(1, v, 0)` the middle terms of F (Coriolis and gyroscopic terms live there), pushed along the unit
velocities the columns of M. The mixed second derivatives are never formed as an array.

Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (1.70), (2.53).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from lagjax.jaxtools import compiled
from lagjax.mechanics.first_order import resolved
from lagjax.mechanics.multiplier_forces import response
from lagjax.system import Model, State, System, prepare


class LinearEquation(NamedTuple):
    """The equation `M a = F` at one state, in vector form.

    `response`: B of a force F + B λ that depends on multipliers; None where it does not.
    """

    mass: Float[Array, "n n"]
    forcing: Float[Array, " n"]
    response: Float[Array, "n m"] | None


def mass_and_forcing(model: Model, t: Array, x: Array, u: Array) -> LinearEquation:
    """M and F at the state with position vector `x` and velocity vector `u`."""
    forcing, inertia = forcing_and_inertia(model, t, x, u)
    if x.size == 1:
        mass = inertia(jnp.ones_like(u))[None]
    else:
        # One column of M for each velocity, stacked as rows: M is symmetric.
        mass = jax.vmap(inertia)(jnp.eye(x.size, dtype=x.dtype))
    return LinearEquation(mass.astype(x.dtype), forcing, response(model, t, x, u) if model.reacts else None)


def forcing_and_inertia(model: Model, t: Array, x: Array, u: Array):
    """F at a state without the part of the multipliers, and the function that multiplies an acceleration by M."""
    u = resolved(model, t, x, u)

    def momentum_and_gradient(t: Array, x: Array, u: Array):
        gradient, p = jax.grad(model.lagrangian, argnums=(1, 2))(t, x, u)
        return p, gradient

    _, push, gradient = jax.linearize(momentum_and_gradient, t, x, u, has_aux=True)
    zero_t, zero = jnp.zeros_like(t), jnp.zeros_like(x)
    # ∂p/∂t + (∂p/∂q) v: the part of dp/dt that does not involve the acceleration.
    forcing = gradient - push(jnp.ones_like(t), u, zero) + applied_force(model, t, x, u)
    first = model.form.first_order
    if first is None:
        return forcing.astype(x.dtype), lambda a: push(zero_t, zero, a)
    mask = first.mask(model.n)
    return jnp.where(mask, 0.0, forcing).astype(x.dtype), lambda a: push(zero_t, zero, a) + mask.astype(x.dtype) * a


def applied_force(model: Model, t: Array, x: Array, u: Array, multipliers: Array | None = None) -> Float[Array, " n"]:
    """`Q - ∂R/∂v`; without `multipliers` for those of zero."""
    force = jnp.zeros_like(x)
    if model.system.force is not None:
        force = force + model.force(t, x, u, multipliers)
    if model.system.dissipation is not None:
        force = force - jax.grad(model.dissipation, argnums=2)(t, x, u)
    return force


def momentum(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> PyTree[Float[Array, "..."]]:
    """Return the canonical momentum `p = ∂L/∂v`.

    >>> import lagjax as lj
    >>> free = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2)
    >>> print(momentum(free, 0.0, 0.0, 3.0, {"m": 2.0}))
    6.0

    **Arguments:** `t` scalar, `q` and `v` alike, `params` as L takes it.

    **Returns:** p with the structure of `q`, `[L] [t]/[q]`.

    **Raises:** `TypeError`, `ValueError` for a state of the wrong dtype or shape, or an L that is not scalar.

    Source: Goldstein, Eq. (2.44).
    """
    model, s = prepare(system, t, q, v, params)
    return _momentum(model, s)


def mass_matrix(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, "n n"]:
    """Return the mass matrix `M = ∂²L/∂v∂v`.

    >>> import lagjax as lj
    >>> bead = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v["angle"] ** 2 * params["radius"] ** 2)
    >>> print(mass_matrix(bead, 0.0, {"angle": 0.0}, {"angle": 0.0}, {"m": 2.0, "radius": 3.0}))
    [[18.]]

    **Arguments:** as for `momentum`.

    **Returns:** M (n, n), symmetric, rows and columns in the order of `jax.tree.leaves(q)`,
    `[L] [t]²/([q][q])`. It may be singular or indefinite.

    **Raises:** as for `momentum`.

    Source: Goldstein, Eq. (1.71).
    """
    model, s = prepare(system, t, q, v, params)
    return _mass_matrix(model, s)


def jacobi_integral(system: System, t: ArrayLike, q: PyTree, v: PyTree, params: PyTree) -> Float[Array, ""]:
    """Return the Jacobi integral `h = v·p - L`.

    It is constant where L does not depend on time, no force or dissipation acts and no constraint moves;
    it equals T + V only for natural, time-independent coordinates.

    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> print(jacobi_integral(fall, 0.0, 1.0, 2.0, {"g": 10.0}))
    12.0

    **Arguments:** as for `momentum`.

    **Returns:** h, scalar, `[L]`.

    **Raises:** as for `momentum`.

    Source: Goldstein, Eq. (2.53).
    """
    model, s = prepare(system, t, q, v, params)
    return _jacobi_integral(model, s)


@compiled
def _momentum(model: Model, s: State):
    return model.tree(jax.grad(model.lagrangian, argnums=2)(s.t, *model.vectors(s.q, s.v)))


@compiled
def _mass_matrix(model: Model, s: State):
    return mass_and_forcing(model, s.t, *model.vectors(s.q, s.v)).mass


@compiled
def _jacobi_integral(model: Model, s: State):
    x, u = model.vectors(s.q, s.v)
    value, p = jax.value_and_grad(model.lagrangian, argnums=2)(s.t, x, u)
    return u @ p - value
