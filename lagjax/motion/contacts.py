"""Switches of contacts, ready made: what touches, lets go, slips and sticks.

    touches    a gap closes, with an impact in the metric of M
    releases   a multiplier, the force of a contact, reaches zero
    slips      the force that holds reaches the cone of friction
    sticks     a sliding speed reaches zero

Source: Glocker, *Set-Valued Force Laws*, §6 (impacts in the metric of M), §5.3 (Coulomb's law);
Brogliato, *Nonsmooth Mechanics*, §4.2.
"""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.arguments import OF_STATE, WITH_MULTIPLIERS
from lagjax.mechanics.constraints import Holonomic
from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.system import System
from lagjax.motion.switching import OfPhases, Plastic

# The name of a gap among the constraints of a phase.
GAP = "lagjax gap"


class Touches(eqx.Module):
    """A gap that closes, as a guard; `reset` is its impact."""

    gap: Callable
    reset: OfPhases

    def __call__(self, t, q, v, params):
        return self.gap(t, q, params)


class Impact(OfPhases):
    """An impact with a restitution: what it makes of the velocities; see `touches`."""

    gap: Callable
    restitution: Callable | ArrayLike

    def between(self, before: System, after: System) -> Callable:
        """The velocities after it: what holds in the phase before holds on, and only the gap's velocity jumps."""
        held = before.constraints | {GAP: Holonomic(self.gap)}
        return _Rebound(self, System(before.lagrangian, held, before.force, before.dissipation))


class _Rebound(eqx.Module):
    impact: Impact
    held: System
    takes: tuple[str, ...] = eqx.field(static=True, default=OF_STATE)

    def __call__(self, t, q, v, params):
        gap, e = self.impact.gap, self.impact.restitution
        _, opening = jax.jvp(lambda t, q: gap(t, q, params), (t, q), (jnp.ones_like(t), v))
        e = e(-opening) if callable(e) else e
        shapes = constraints.shapes(self.held, t, q, v, params)
        jumps = [np.full(math.prod(shape), name == GAP) for name, shape in shapes.items()]
        off = jnp.where(np.concatenate(jumps), (1 + e) * opening, 0.0)
        u, unflatten = coordinates.flatten(v)
        displacement = equations_of(self.held, t, q, v, params).displacement(t, q, v)
        return unflatten(u - displacement(np.ones(off.size, bool), off))


def touches(gap: Callable, restitution: Callable | ArrayLike | None = None) -> Touches:
    """A guard for `lj.Switch`: a gap closes; and the impact that goes with it.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> ball = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q)
    >>> bounce = lj.Switch("flying", to="flying", when=touches(lambda t, q, params: q, restitution=0.5))
    >>> traj = lj.integrate(lj.Hybrid({"flying": ball}, [bounce]), 5.0, 0.0, ts=jnp.array([0.0, 1.5]))
    >>> print(f"{traj.q[-1]:.6f} {traj.switches.v_after[0]:.6f} {traj.switches.impulse[0]:.6f}")
    1.250000 5.000000 15.000000

    **Arguments:**

    - `gap`: `gap(t, q, params)`, above zero as long as nothing touches, of any unit.
    - `restitution`: the speed at which the gap opens after the impact over that at which it closed: a number, or a
      function of the closing speed. The impulse acts along the gap's gradient, and so the velocities change by the
      least in the metric of M that the constraints of the phase allow. None: the velocities become the nearest, in that
      metric, that the constraints of the *next* phase allow (a perfectly plastic impact, which sticks where they do).

    **Raises:** `TypeError` for a gap that is no function.
    """
    if not callable(gap):
        raise TypeError(
            f"a gap must be a function of (t, q, params), not {type(gap).__name__}.\n"
            'Fix: lj.touches(lambda t, q, params: q["y"]).'
        )
    return Touches(gap, Plastic() if restitution is None else Impact(gap, _number(restitution)))


class Releases(eqx.Module):
    """The multiplier of a contact, as a guard."""

    contact: str = eqx.field(static=True)
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t, q, v, multipliers, params):
        return _multiplier(multipliers, self.contact)


def releases(contact: str) -> Releases:
    """A guard for `lj.Switch`: the multiplier of a constraint that pushes, as a contact does, reaches zero.

    >>> import lagjax as lj
    >>> lj.Switch("on the ground", to="flying", when=releases("ground"))
    Switch('on the ground' -> 'flying')

    **Arguments:** `contact`: the name of a constraint of one equation, written so that its multiplier is above zero as
    long as it pushes: as a gap, λ > 0 pushes along +∂g/∂q.
    """
    return Releases(contact)


class Slips(eqx.Module):
    """How far the force that holds is inside the cone of friction, as a guard."""

    held: str = eqx.field(static=True)
    on: str = eqx.field(static=True)
    side: int = eqx.field(static=True)
    coefficient: Callable | ArrayLike
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t, q, v, multipliers, params):
        mu = self.coefficient(params) if callable(self.coefficient) else self.coefficient
        force = jnp.ravel(_multiplier(multipliers, self.held, many=True))
        size = self.side * force[0] if self.side else _length(force)
        return mu * _multiplier(multipliers, self.on) - size


def slips(held: str, on: str, coefficient: Callable | ArrayLike, side: int = 0) -> Slips:
    """A guard for `lj.Switch`: the force that holds two bodies together reaches the cone of friction.

    >>> import lagjax as lj
    >>> grip = slips("rolling", on="contact", coefficient=lambda params: params["mu"])
    >>> lj.Switch("rolls", to="slips", when=grip)
    Switch('rolls' -> 'slips')

    **Arguments:**

    - `held`: the name of the velocity constraint that keeps the contact from sliding. It is to be the sliding velocity
      itself, as its multiplier is then the force of friction.
    - `on`: the name of the contact, whose multiplier is the normal force: `g` a length.
    - `coefficient`: of static friction, a number or a function of `params`.
    - `side`: 1 or -1 where only a multiplier above or below zero counts: to slide in two directions are two phases.
    """
    if side not in (-1, 0, 1):
        raise ValueError(f"side must be 1, -1, or 0 for both, not {side!r}.")
    return Slips(held, on, side, _number(coefficient))


class Sticks(eqx.Module):
    """A sliding speed, as a guard."""

    sliding: Callable

    @property
    def takes(self):
        return OF_STATE

    def __call__(self, t, q, v, params):
        return self.sliding(t, q, v, params)


def sticks(sliding: Callable) -> Sticks:
    """A guard for `lj.Switch`: what slides comes to rest.

    >>> import lagjax as lj
    >>> lj.Switch("slides", to="sticks", when=sticks(lambda t, q, v, params: v["x"] - params["belt"]))
    Switch('slides' -> 'sticks')

    **Arguments:** `sliding`: `sliding(t, q, v, params)`, the sliding velocity in the direction in which its phase
    slides, above zero there. Where friction does not hold what came to rest, the next phase ends at once by its own
    `lj.slips(..., side=...)`, and it slides on, or the other way.
    """
    return Sticks(sliding)


def _multiplier(multipliers, name, many=False):
    if name not in multipliers:
        raise ValueError(
            f"there is no constraint '{name}' in this phase; there {'are ' if multipliers else 'is '}"
            f"{', '.join(map(repr, multipliers)) or 'none'}.\nFix: the name under which it stands in constraints=."
        )
    found = multipliers[name]
    if jnp.size(found) != 1 and not many:
        raise ValueError(f"constraint '{name}' has {jnp.size(found)} equations, and a contact one.")
    return found if many else jnp.reshape(found, ())


def _length(x):
    """The length of a vector, whose derivative at zero is zero."""
    if x.size == 1:
        return jnp.abs(x[0])
    square = jnp.sum(x**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _number(x):
    """A number as an array, which is no part of a program; a function as it is."""
    return x if callable(x) or isinstance(x, jax.Array) else np.asarray(x, float)
