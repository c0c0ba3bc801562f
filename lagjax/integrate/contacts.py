"""Ready-made guards for contacts that touch, let go, slip and stick.

    touches    a gap closes, with an impact in the metric of M
    releases   a multiplier, the force of a contact, reaches zero
    slips      the force that holds reaches the cone of friction
    sticks     a sliding speed reaches zero

Source: Glocker, *Set-Valued Force Laws*, §6 (impacts in the metric of M), §5.3 (Coulomb's law);
Brogliato, *Nonsmooth Mechanics*, §4.2.
"""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.integrate.impacts import Impact, Opening
from lagjax.integrate.solve.phases import OfPhases, Plastic
from lagjax.system import OF_STATE, WITH_MULTIPLIERS


class Touches(eqx.Module):
    """The guard of a gap that closes; `reset` is its impact."""

    gap: Callable
    reset: OfPhases

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        return self.gap(t, q, params)


def touches(
    gap: Callable,
    restitution: Callable | ArrayLike | None = None,
    friction: Callable | ArrayLike | None = None,
    sliding: Callable | None = None,
) -> Touches:
    """A guard for `lj.Switch`: a gap closes, with an impact.

    A block that falls with (x, y) velocities (4, -10) on a rough floor goes up with half of 10, and loses
    0.2 (1 + 0.5) 10 of its horizontal 4:

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> block = lj.System(lambda t, q, v, params: 0.5 * jnp.sum(v**2) - 10.0 * q[1])
    >>> rough = touches(lambda t, q, params: q[1], 0.5, friction=0.2, sliding=lambda t, q, v, params: v[0])
    >>> hybrid = lj.Hybrid({"flying": block}, [lj.Switch("flying", to="flying", when=rough)])
    >>> traj = lj.integrate(hybrid, jnp.array([0.0, 5.0]), jnp.array([4.0, 0.0]), ts=jnp.array([0.0, 1.5]))
    >>> print(traj.switches.v_after[0].round(6), traj.switches.impulse[0].round(6))
    [1. 5.] [-3. 15.]

    **Arguments:**

    - `gap`: `gap(t, q, params)`, above zero as long as nothing touches, of any unit; with friction it must be
      a distance, `[sliding] [t]`.
    - `restitution`: the speed at which the gap opens after the impact over that at which it closed: a number, or a
      function of the closing speed. The impulse acts along the gap's gradient, so that the velocities change as
      little, in the metric of M, as the constraints of the phase allow. None: the velocities become the nearest, in
      that metric, that the constraints of the *next* phase allow (a perfectly plastic impact, which sticks if they do).
    - `friction`: the coefficient of friction in the impact, a number or a function of `params`; without one it is
      smooth. The contact sticks, or slides with the impulse of friction on the cone; see `impacts.py`. The guards of
      the phases decide between these: let the switch go to the phase that slides; its own guard, `lj.guards.sticks`,
      ends that at once if the contact does not slide in its direction.
    - `sliding`: `sliding(t, q, v, params)`, the velocity at which the contact slides, linear in v.

    **Raises:** `TypeError` for a gap, or a sliding velocity, that is not a function; `ValueError` for friction without
    a sliding velocity or a restitution, and for a sliding velocity that is not one number, or not linear in v.

    Source: Glocker, *Set-Valued Force Laws*, §6; for friction Pfeiffer & Glocker, *Multibody Dynamics with Unilateral
    Contacts*, §8, with Newton's law in place of Poisson's and no tangential restitution.
    """
    if not callable(gap):
        raise TypeError(
            f"a gap must be a function of (t, q, params), not {type(gap).__name__}.\n"
            'Fix: lj.guards.touches(lambda t, q, params: q["y"]).'
        )
    if friction is None and sliding is None:
        return Touches(gap, Plastic() if restitution is None else Impact(gap, _number(restitution)))
    if friction is None or sliding is None:
        given, missing = ("friction", "sliding") if sliding is None else ("sliding", "friction")
        raise ValueError(
            f"{given} is given, but {missing} is not: friction in an impact needs a coefficient and a velocity.\n"
            'Fix: lj.guards.touches(gap, 0.5, friction=0.3, sliding=lambda t, q, v, params: v["x"]).'
        )
    if not callable(sliding):
        raise TypeError(
            f"sliding must be a function of (t, q, v, params), not {type(sliding).__name__}.\n"
            'Fix: sliding=lambda t, q, v, params: v["x"].'
        )
    if restitution is None:
        raise ValueError(
            "friction in an impact needs a restitution: without one, the constraints of the next phase fix the "
            "velocities after the impact, whatever the friction.\n"
            "Fix: lj.guards.touches(gap, restitution=0.0, friction=...)."
        )
    return Touches(gap, Impact(gap, _number(restitution), _number(friction), sliding))


class Releases(eqx.Module):
    """The multiplier of a contact as a guard; `reset` opens the contact with a speed of a few round-offs."""

    contact: str = eqx.field(static=True)
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    @property
    def reset(self):
        return Opening(self.contact)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], params: PyTree):
        return _multiplier(multipliers, self.contact)


def releases(contact: str) -> Releases:
    """A guard for `lj.Switch`: the multiplier of a constraint that pushes, as a contact does, reaches zero.

    >>> import lagjax as lj
    >>> lj.Switch("on the ground", to="flying", when=releases("ground"))
    Switch('on the ground' -> 'flying', with a reset)

    **Arguments:** `contact`: the name of a constraint of one equation, written so that its multiplier is above zero as
    long as it pushes: written as a gap, since λ > 0 pushes along +∂g/∂q.

    The reset opens the contact with a speed of a few round-offs: otherwise its gap would leave zero without speed and
    acceleration, and for a guard of the next phase, `lj.guards.touches` of the same gap, it would stay closed for ever.

    **Raises:** `ValueError`, by `lj.integrate`, if the phase has no such constraint, or if that has several equations.
    """
    return Releases(contact)


class Slips(eqx.Module):
    """A guard: how far the force that holds a contact is inside the cone of friction."""

    held: str = eqx.field(static=True)
    on: str = eqx.field(static=True)
    side: int = eqx.field(static=True)
    coefficient: Callable | ArrayLike
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], params: PyTree):
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

    - `held`: the name of the velocity constraint that keeps the contact from sliding. It must be the sliding velocity
      itself, so that its multiplier is the force of friction.
    - `on`: the name of the contact, whose multiplier is the normal force: its `g` must be a length.
    - `coefficient`: of static friction, a number or a function of `params`.
    - `side`: 1 or -1 if only a multiplier above or below zero counts: sliding in the two directions takes two phases.

    **Raises:** `ValueError` for another side; and, by `lj.integrate`, if the phase has no constraint of these names.
    """
    if side not in (-1, 0, 1):
        raise ValueError(f"side must be 1, -1, or 0 for both, not {side!r}.")
    return Slips(held, on, side, _number(coefficient))


class Sticks(eqx.Module):
    """A sliding speed as a guard."""

    sliding: Callable

    @property
    def takes(self):
        return OF_STATE

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        return self.sliding(t, q, v, params)


def sticks(sliding: Callable) -> Sticks:
    """A guard for `lj.Switch`: a contact stops sliding.

    >>> import lagjax as lj
    >>> lj.Switch("slides", to="sticks", when=sticks(lambda t, q, v, params: v["x"] - params["belt"]))
    Switch('slides' -> 'sticks')

    **Arguments:** `sliding`: `sliding(t, q, v, params)`, the sliding velocity in the direction in which its phase
    slides, above zero there. If friction cannot hold the contact then, the next phase ends at once by its own
    `lj.guards.slips(..., side=...)`, and the contact slides on, or the other way.

    **Raises:** as `lj.Switch`, if it does not return one number.
    """
    return Sticks(sliding)


def _multiplier(multipliers: dict[str, Array], name: str, many=False):
    if name not in multipliers:
        raise ValueError(
            f"there is no constraint '{name}' in this phase; there {'are ' if multipliers else 'is '}"
            f"{', '.join(map(repr, multipliers)) or 'none'}.\nFix: use its name in constraints=."
        )
    found = multipliers[name]
    if jnp.size(found) != 1 and not many:
        raise ValueError(f"constraint '{name}' has {jnp.size(found)} equations, but a contact has one.")
    return found if many else jnp.reshape(found, ())


def _length(x):
    """Return the length of a vector; its derivative at zero is zero."""
    if x.size == 1:
        return jnp.abs(x[0])
    square = jnp.sum(x**2)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def _number(x):
    """Return a number as an array, so that no program is compiled for its value; a function unchanged."""
    return x if callable(x) or isinstance(x, jax.Array) else np.asarray(x, float)
