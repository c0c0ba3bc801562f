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
from jaxtyping import Array, Float, PyTree

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.first_call import traced_system
from lagjax.mechanics.reactions import force_at, response
from lagjax.mechanics.refusals import check_system


class Linear(NamedTuple):
    """The equation `M a = F` at one state, in vector form.

    `response`: B of a force F + B λ that depends on multipliers; None where it does not.
    """

    mass: Float[Array, "n n"]
    forcing: Float[Array, " n"]
    response: Float[Array, "n m"] | None


def mass_and_forcing(system, t, x, u, params, unflatten) -> Linear:
    """M and F at the state with position vector `x` and velocity vector `u`."""
    forcing, inertia = forcing_and_inertia(system, t, x, u, params, unflatten)
    if x.size == 1:
        mass = inertia(jnp.ones_like(u))[None]
    else:
        # One column of M for each velocity, stacked as rows: M is symmetric.
        mass = jax.vmap(inertia)(jnp.eye(x.size, dtype=x.dtype))
    return Linear(mass.astype(x.dtype), forcing, response(system, t, x, u, params, unflatten))


def forcing_and_inertia(system, t, x, u, params, unflatten):
    """F at a state without the part of the multipliers, and the function that multiplies an acceleration by M."""

    def lagrangian(t, x, u):
        return system.lagrangian(t, unflatten(x), unflatten(u), params)

    def momentum_and_gradient(t, x, u):
        gradient, p = jax.grad(lagrangian, argnums=(1, 2))(t, x, u)
        return p, gradient

    _, push, gradient = jax.linearize(momentum_and_gradient, t, x, u, has_aux=True)
    zero_t, zero = jnp.zeros_like(t), jnp.zeros_like(x)
    # ∂p/∂t + (∂p/∂q) v: the part of dp/dt that does not involve the acceleration.
    forcing = gradient - push(jnp.ones_like(t), u, zero)
    if system.force is not None:
        forcing = forcing + _force_vector(system, t, x, u, params, unflatten)
    if system.dissipation is not None:
        forcing = forcing - jax.grad(lambda u: system.dissipation(t, unflatten(x), unflatten(u), params))(u)
    return forcing.astype(x.dtype), lambda a: push(zero_t, zero, a)


def momentum(system, t, q, v, params) -> PyTree[Float[Array, "..."]]:
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
    system, s = _checked(system, t, q, v, params)
    return _momentum(system, *s)


def mass_matrix(system, t, q, v, params) -> Float[Array, "n n"]:
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
    system, s = _checked(system, t, q, v, params)
    return _mass_matrix(system, *s)


def jacobi_integral(system, t, q, v, params) -> Float[Array, ""]:
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
    system, s = _checked(system, t, q, v, params)
    return _jacobi_integral(system, *s)


def _checked(system, t, q, v, params):
    check_system(system, t, q, v, params)
    s = coordinates.state(t, q, v, params)
    return traced_system(system, s), s


@compiled
def _momentum(system, t, q, v, params):
    return jax.grad(system.lagrangian, argnums=2)(t, q, v, params)


@compiled
def _mass_matrix(system, t, q, v, params):
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    return mass_and_forcing(system, t, x, u, params, unflatten).mass


@compiled
def _jacobi_integral(system, t, q, v, params):
    value, p = jax.value_and_grad(system.lagrangian, argnums=2)(t, q, v, params)
    return coordinates.flatten(v)[0] @ coordinates.flatten(p)[0] - value


def _force_vector(system, t, x, u, params, unflatten):
    q, v = unflatten(x), unflatten(u)
    no_multipliers = jnp.zeros(constraints.count(system, t, q, v, params), x.dtype)
    force = force_at(system, t, q, v, params, no_multipliers)
    return coordinates.flatten(force)[0].astype(x.dtype)
