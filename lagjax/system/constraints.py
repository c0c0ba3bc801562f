"""Constraints at three levels: position, velocity, acceleration.

A holonomic constraint `g(t, q) = 0` is differentiated twice, a velocity constraint `phi(t, q, v) = 0`
once (index reduction); both end as a linear equation for the acceleration,

    A a = gamma,        holonomic:    A = ∂g/∂q,    gamma = -(d/dt)² g with a = 0
                        velocity:     A = ∂phi/∂v,  gamma = -∂phi/∂t - (∂phi/∂q) v

and the force that keeps it is `Aᵀ λ` (for a velocity constraint, Chetaev's rule). Total derivatives along
the motion are Jacobian-vector products along `(1, v)`; no second-derivative array is ever formed.

Source: Goldstein, *Classical Mechanics*, §1.3 and §2.4; Hairer & Wanner, *Solving ODEs II*, §VII.1.
"""

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float, PyTree

from lagjax.system.function_arguments import OF_POSITION, OF_STATE
from lagjax.system.lanes import vectors


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

    def residual(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        """`g` at a state, as the user wrote it."""
        return self.g(t, q, params)

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

    def residual(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        """`phi` at a state, as the user wrote it."""
        return self.phi(t, q, v, params)

    def __repr__(self):
        return f"Nonholonomic({getattr(self.phi, '__name__', 'phi')})"


class ConstraintRows(NamedTuple):
    """All constraints of a system at one state, stacked: the linear equation `A a = gamma`."""

    jacobian: Float[Array, "m n"]
    gamma: Float[Array, " m"]


def _check_callable(function: Callable, kind, signature: str):
    if not callable(function):
        raise TypeError(
            f"{kind} needs a function {signature}, not {type(function).__name__}.\n"
            f"Fix: lj.{kind}(f), with f defined as a function of these arguments."
        )


def position_residual(model, t: Array, x: Array) -> Float[Array, " mh"]:
    """`g(t, q)` of the holonomic constraints, stacked."""
    return _stack(_positions(model, t, x), x.dtype)


def velocity_residual(model, t: Array, x: Array, u: Array) -> Float[Array, " m"]:
    """`dg/dt` or `phi(t, q, v)` of each constraint, stacked in the order of their names."""
    return _stack(_velocities(model, t, x, u), x.dtype)


def residuals(model, t: Array, x: Array, u: Array) -> Float[Array, "2 m"]:
    """What each constraint asks to vanish of positions, `g` or nothing, and of velocities, `dg/dt` or `phi`."""
    if not model.m:
        return jnp.zeros((2, 0), x.dtype)
    position, velocities = iter(_positions(model, t, x)), _velocities(model, t, x, u)
    given = zip(model.system.constraints.values(), velocities)
    positions = [next(position) if c.of_positions else jnp.zeros_like(velocity) for c, velocity in given]
    return jnp.stack([_stack(positions, x.dtype), _stack(velocities, x.dtype)])


def jacobian(model, t: Array, x: Array, u: Array) -> Float[Array, "m n"]:
    """`A` of all constraints."""
    return jax.jacfwd(lambda u: velocity_residual(model, t, x, u))(u)


def acceleration_rows(model, t: Array, x: Array, u: Array) -> ConstraintRows:
    """`A` and `gamma` of all constraints."""
    _, rate = jax.jvp(lambda t, x: velocity_residual(model, t, x, u), (t, x), (jnp.ones_like(t), u))
    return ConstraintRows(jacobian(model, t, x, u), -rate)


def baumgarte_feedback(model, t: Array, x: Array, u: Array, rate: Array):
    """Baumgarte's term in gamma, with which g'' + 2 rate g' + rate² g = 0, or phi' + rate phi = 0.

    Source: Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1.
    """
    position, terms = iter(_positions(model, t, x)), []
    for c, velocity in zip(model.system.constraints.values(), _velocities(model, t, x, u)):
        of_position = -2 * rate * velocity - rate**2 * next(position) if c.of_positions else -rate * velocity
        terms.append(of_position)
    return _stack(terms, x.dtype)


def _positions(model, t: Array, x: Array) -> list[Float[Array, " k"]]:
    """`g(t, q)` of each holonomic constraint."""
    holonomic = [c.g for c in model.system.constraints.values() if c.of_positions]
    return vectors(holonomic, (t, model.tree(x), model.params))


def _velocities(model, t: Array, x: Array, u: Array) -> list[Float[Array, " k"]]:
    """`dg/dt` or `phi(t, q, v)` of each constraint."""
    given = list(model.system.constraints.values())
    of_positions = of_velocities = iter(())
    if any(c.of_positions for c in given):
        _, rates = jax.jvp(lambda t, x: _positions(model, t, x), (t, x), (jnp.ones_like(t), u))
        of_positions = iter(rates)
    if not all(c.of_positions for c in given):
        phis = [c.phi for c in given if not c.of_positions]
        of_velocities = iter(vectors(phis, (t, model.tree(x), model.tree(u), model.params)))
    return [next(of_positions if c.of_positions else of_velocities) for c in given]


def _stack(parts: Sequence, dtype: DTypeLike):
    if not parts:
        return jnp.zeros((0,), dtype)
    return jnp.concatenate([part.astype(dtype) for part in parts])
