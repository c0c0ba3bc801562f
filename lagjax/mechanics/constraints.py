"""Constraints at three levels: position, velocity, acceleration.

A holonomic constraint `g(t, q) = 0` is differentiated twice, a velocity constraint `phi(t, q, v) = 0`
once (index reduction); both end as a linear equation for the acceleration,

    A a = gamma,        holonomic:    A = ∂g/∂q,    gamma = -(d/dt)² g with a = 0
                        velocity:     A = ∂phi/∂v,  gamma = -∂phi/∂t - (∂phi/∂q) v

and the force that keeps it is `Aᵀ λ` (for a velocity constraint, Chetaev's rule). Total derivatives along
the motion are Jacobian-vector products along `(1, v)`; no second-derivative array is ever formed.

Source: Goldstein, *Classical Mechanics*, §1.3 and §2.4; Hairer & Wanner, *Solving ODEs II*, §VII.1.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lagjax.mechanics import coordinates
from lagjax.mechanics.arguments import OF_POSITION, OF_STATE
from lagjax.mechanics.memory import kinds, remembered, shape_of


class Holonomic(eqx.Module):
    """Constrain positions: `g(t, q, params) = 0`.

    >>> import jax.numpy as jnp
    >>> Holonomic(lambda t, q, params: q["x"] ** 2 + q["y"] ** 2 - params["length"] ** 2)
    Holonomic(<lambda>)

    **Arguments:** `g(t, q, params)` -> scalar or (m,), smooth, with ∂g/∂q of full rank where it vanishes.
    Its multiplier λ has the shape of `g` and `[energy]/[g]`; λ > 0 pushes along +∂g/∂q.

    **Raises:** `TypeError` if `g` is not a function.
    """

    g: Callable
    kind: ClassVar[str] = "holonomic"
    role: ClassVar[str] = "g"
    takes: ClassVar[tuple[str, ...]] = OF_POSITION
    of_positions: ClassVar[bool] = True

    def __check_init__(self):
        _check_callable(self.g, "Holonomic", "g(t, q, params)")

    @property
    def function(self) -> Callable:
        return self.g

    def residual(self, t, q, v, params):
        """`g` at a state, as the user wrote it."""
        return self.g(t, q, params)

    def velocity_residual(self, t, x, u, params, unflatten):
        """`dg/dt`, in vector form."""
        return jax.jvp(lambda t, x: self.g(t, unflatten(x), params), (t, x), (jnp.ones_like(t), u))[1]

    def feedback(self, t, x, u, params, unflatten, rate):
        """The term in gamma with which g'' + 2 rate g' + rate² g = 0."""
        position = jnp.atleast_1d(self.g(t, unflatten(x), params))
        return -2 * rate * jnp.atleast_1d(self.velocity_residual(t, x, u, params, unflatten)) - rate**2 * position

    def __repr__(self):
        return f"Holonomic({getattr(self.g, '__name__', 'g')})"


class Nonholonomic(eqx.Module):
    """Constrain velocities: `phi(t, q, v, params) = 0`, linear in v or not, integrable or not.

    >>> Nonholonomic(lambda t, q, v, params: v["x"] - params["radius"] * v["angle"])
    Nonholonomic(<lambda>)

    **Arguments:** `phi(t, q, v, params)` -> scalar or (m,), smooth, with ∂phi/∂v of full rank where it
    vanishes. Its multiplier μ has the shape of `phi` and `[energy]/([phi] [t])`; the force is `(∂phi/∂v)ᵀ μ`.

    **Raises:** `TypeError` if `phi` is not a function.
    """

    phi: Callable
    kind: ClassVar[str] = "velocity"
    role: ClassVar[str] = "phi"
    takes: ClassVar[tuple[str, ...]] = OF_STATE
    of_positions: ClassVar[bool] = False

    def __check_init__(self):
        _check_callable(self.phi, "Nonholonomic", "phi(t, q, v, params)")

    @property
    def function(self) -> Callable:
        return self.phi

    def residual(self, t, q, v, params):
        """`phi` at a state, as the user wrote it."""
        return self.phi(t, q, v, params)

    def velocity_residual(self, t, x, u, params, unflatten):
        """`phi`, in vector form."""
        return self.phi(t, unflatten(x), unflatten(u), params)

    def feedback(self, t, x, u, params, unflatten, rate):
        """The term in gamma with which phi' + rate phi = 0."""
        return -rate * jnp.atleast_1d(self.velocity_residual(t, x, u, params, unflatten))

    def __repr__(self):
        return f"Nonholonomic({getattr(self.phi, '__name__', 'phi')})"


class Rows(NamedTuple):
    """All constraints of a system at one state, stacked: the linear equation `A a = gamma`."""

    jacobian: Float[Array, "m n"]
    gamma: Float[Array, " m"]


def _check_callable(function, kind, signature):
    if not callable(function):
        raise TypeError(
            f"{kind} needs a function {signature}, not {type(function).__name__}.\n"
            f"Fix: lj.{kind}(f), with f defined as a function of these arguments."
        )


def shapes(system, t, q, v, params) -> dict[str, tuple[int, ...]]:
    """The shape of each constraint's residual, by name, found without computing anything."""
    if not system.constraints:
        return {}
    find = lambda: {
        name: jnp.shape(shape_of(constraint.residual, t, q, v, params))
        for name, constraint in system.constraints.items()
    }
    return remembered(system, (shapes, kinds((t, q, v, params))), find)


def count(system, t, q, v, params) -> int:
    """How many constraint equations there are."""
    return sum(int(np.prod(shape)) for shape in shapes(system, t, q, v, params).values())


def split(system, stacked, t, q, v, params) -> dict[str, Array]:
    """Undo the stacking: a vector over all constraint equations -> one array per name."""
    parts, start = {}, 0
    for name, shape in shapes(system, t, q, v, params).items():
        size = shape[0] if shape else 1
        parts[name] = stacked[start : start + size].reshape(shape)
        start += size
    return parts


def zero_multipliers(system, s: coordinates.State) -> dict[str, np.ndarray]:
    """Zero multipliers of the right shapes, by name."""
    return {name: np.zeros(shape, s.t.dtype) for name, shape in shapes(system, *s).items()}


def position_residual(system, t, x, params, unflatten) -> Float[Array, " mh"]:
    """`g(t, q)` of the holonomic constraints, stacked."""
    return _stack([c.g(t, unflatten(x), params) for c in _all(system) if c.of_positions], x.dtype)


def velocity_residual(system, t, x, u, params, unflatten) -> Float[Array, " m"]:
    """`dg/dt` or `phi(t, q, v)` of each constraint, stacked in the order of their names."""
    return _stack([c.velocity_residual(t, x, u, params, unflatten) for c in _all(system)], x.dtype)


def jacobian(system, t, x, u, params, unflatten) -> Float[Array, "m n"]:
    """`A` of all constraints, in vector form."""
    return jax.jacfwd(lambda u: velocity_residual(system, t, x, u, params, unflatten))(u)


def acceleration_rows(system, t, x, u, params, unflatten) -> Rows:
    """`A` and `gamma` of all constraints, in vector form."""

    at = lambda t, x: velocity_residual(system, t, x, u, params, unflatten)
    _, rate = jax.jvp(at, (t, x), (jnp.ones_like(t), u))
    return Rows(jacobian(system, t, x, u, params, unflatten), -rate)


def baumgarte_feedback(system, t, x, u, params, unflatten, rate):
    """Baumgarte's term in gamma, with which g'' + 2 rate g' + rate² g = 0, or phi' + rate phi = 0.

    Source: Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1.
    """
    return _stack([c.feedback(t, x, u, params, unflatten, rate) for c in _all(system)], x.dtype)


def holonomic_equations(system, t, q, v, params) -> np.ndarray:
    """Which of the stacked equations constrain positions, (m,) booleans."""
    kinds = [
        np.full(int(np.prod(shape)), system.constraints[name].of_positions)
        for name, shape in shapes(system, t, q, v, params).items()
    ]
    return np.concatenate(kinds) if kinds else np.zeros(0, bool)


def _all(system):
    return list(system.constraints.values())


def _stack(parts, dtype):
    if not parts:
        return jnp.zeros((0,), dtype)
    return jnp.concatenate([jnp.atleast_1d(part).astype(dtype) for part in parts])
