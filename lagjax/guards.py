"""Guards of `lj.Switch` for contacts between two phases: one touches, releases, slips or sticks.

>>> import lagjax as lj
>>> lj.Switch("rolls", to="flies", when=lj.guards.releases("contact"))
Switch('rolls' -> 'flies', with a reset)

Any function of (t, q, v, params) can be a guard; these know of multipliers, and bring the impact with them.

    touches    a gap closes, with an impact in the metric of M
    releases   a multiplier, the force of a contact, reaches zero
    slips      the force that holds reaches the cone of friction
    sticks     a sliding speed reaches zero

Source: Glocker, *Set-Valued Force Laws*, §6 (impacts in the metric of M), §5.3 (Coulomb's law);
Brogliato, *Nonsmooth Mechanics*, §4.2.

At an impact, with friction or without, the impulse of a contact acts along the gradients of its gap g and of its
sliding velocity γ_T, and constraints that hold before the impact keep holding, with impulses of their own:

    M Δv = A_Nᵀ Λ_N + A_Tᵀ Λ_T + A_heldᵀ Λ_held,    A_held Δv = 0,    A_N = ∂g/∂q,    A_T = ∂γ_T/∂v

In the normal direction Newton's law holds, A_N Δv = (1 + e) |γ_N| = c. Along the contact, friction opposes the sliding
velocity γ_T' after the impact,

    sticks:    γ_T' = 0,         |Λ_T| ≤ μ Λ_N
    slides:    ± γ_T' > 0,       Λ_T = ∓ μ Λ_N

Let d_N and d_T be the least changes of the velocities, in the metric of M, that change γ_N by one, and γ_T by one at
constant γ_N. Then, with γ₀ the sliding velocity after the impact without friction,

    Δv = c d_N + σ d_T,    γ_T' = γ₀ + σ,    Λ_T = h σ,    Λ_N = c n - k Λ_T
    n = d_Nᵀ M d_N,    h = d_Tᵀ M d_T,    k = A_T d_N,    γ₀ = γ_T + c k

The contact sticks, with σ = -γ₀, if that is in the cone. Otherwise it slides to the side s of γ₀, with
Λ_T = -s μ c n / (1 - s μ k). For Λ_T = -ρ μ Λ_N, γ_T' falls strictly from ρ = -1 to 1 as long as Λ_N > 0, so that there
is exactly one solution; if that denominator is not above zero, friction jams the contact before it slides, and sticking
is in the cone. Unlike the forces of a motion (`mechanics/lagrangian.py`), an impact with Newton's law has no paradox,
except for a contact whose sliding velocity is fixed by the gap and the constraints, γ_T' = γ₀ whatever friction does.
If friction would then exceed what pushes the contact together, there is no impulse, and the velocities are NaN.

The energy changes by ½ Λ_N (γ_N + γ_N') + ½ Λ_T (γ_T + γ_T'). Without restitution, or where k is zero (a ball), it
never grows. With restitution it may, in an impact that reverses the sliding: the fault is then in Newton's law (Kane).

Source: Pfeiffer & Glocker, *Multibody Dynamics with Unilateral Contacts*, ch. 7 and 8; Glocker, *Set-Valued Force
Laws*, §6; Kane, *A dynamics puzzle* (1984), on the energy.
"""

from collections.abc import Callable
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.integrate import OfPhases, Plastic, check_linear
from lagjax.jaxtools import shape_of, stop_gradient
from lagjax.mechanics import velocity_change
from lagjax.refusals import must_be_among, must_be_function, must_go_together, must_name, must_return
from lagjax.system import (
    OF_POSITION,
    OF_STATE,
    WITH_MULTIPLIERS,
    Holonomic,
    Nonholonomic,
    System,
    constraints,
    coordinates,
    model_of,
)

__all__ = ["releases", "slips", "sticks", "touches"]

# Names reserved for a contact's gap and sliding velocity among the constraints of a phase.
GAP, SLIDING = "lagjax gap", "lagjax sliding"
# γ_T depends on the gap and the constraints if d_T changes these, relative to its size, by more than this.
DEPENDENT = 1e-6
# A contact that lets go separates at least this fast, in round-offs of its speed.
OPENS = 64


class Impact(OfPhases):
    """An impact with a restitution, and with friction if it has a coefficient: see `lj.guards.touches`."""

    gap: Callable
    restitution: Callable | ArrayLike
    friction: Callable | ArrayLike | None = None
    sliding: Callable | None = None

    def mapped(self, on: Callable) -> "Impact":
        """Return the same with `on(role, function, takes)` in place of each function."""

        def part(role: str, f, *takes):
            return on(role, f, takes) if callable(f) else f

        return Impact(
            part("gap", self.gap, *OF_POSITION),
            part("restitution", self.restitution, "speed"),
            part("friction", self.friction, "params"),
            part("sliding", self.sliding, *OF_STATE),
        )

    def between(self, before: System, after: System) -> Callable:
        """Return the reset: constraints of the phase before keep holding, and only the contact's velocities jump."""
        return _Rebound(self, before)


class _Rebound(eqx.Module):
    impact: Impact
    before: System
    takes: tuple[str, ...] = eqx.field(static=True, default=OF_STATE)

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        gap, e = self.impact.gap, self.impact.restitution
        _, opening = jax.jvp(lambda t, q: gap(t, q, params), (t, q), (jnp.ones_like(t), v))
        # A contact that is opening receives no impulse.
        closing = jnp.maximum(-opening, 0.0)
        jump = (1 + (e(closing) if callable(e) else e)) * closing
        by_gap, _ = self._unit({GAP: Holonomic(gap)}, t, q, v, params)
        after = _moved(v, jump, by_gap)
        if self.impact.sliding is None:
            return after
        _check_sliding(self.impact.sliding, t, q, v, params)
        both = {GAP: Holonomic(gap), SLIDING: Nonholonomic(self.impact.sliding)}
        along, independent = self._unit(both, t, q, v, params)
        return _moved(after, self._friction_change(t, q, v, params, jump, by_gap, along, independent), along)

    def _unit(self, contact, t: Array, q: PyTree, v: PyTree, params: PyTree):
        """Return the least change of the velocities that changes the residual of the last entry of `contact` by one,
        but no other residual, of `contact` or of the constraints that hold; and whether there is such a change."""
        system = replace(self.before, constraints=self.before.constraints | contact)
        model = model_of(system, t, q, v, params)
        change = model.belongs_to(list(contact)[-1]).astype(model.form.dtype)
        found = velocity_change(model, t, q, v, jnp.asarray(change))
        rows, d = constraints.jacobian(model, t, *model.vectors(q, v)), model.vector(found)
        off = jnp.abs(rows @ d - change) > DEPENDENT * (change + jnp.abs(rows) @ jnp.abs(d))
        return found, ~jnp.any(off)

    def _friction_change(
        self, t: Array, q: PyTree, v: PyTree, params: PyTree, jump, by_gap, along: Callable, independent
    ):
        """Return σ, the change of the sliding velocity by friction."""
        mu, sliding = self.impact.friction, self.impact.sliding
        assert sliding is not None
        mu = mu(params) if callable(mu) else mu

        def metric(d):
            return (
                coordinates.flatten(d)[0]
                @ coordinates.flatten(
                    jax.jvp(lambda v: jax.grad(self.before.lagrangian, argnums=2)(t, q, v, params), (v,), (d,))[1]
                )[0]
            )

        n, h = metric(by_gap), metric(along)
        speed, k = jax.jvp(lambda v: sliding(t, q, v, params), (v,), (by_gap,))
        smooth = speed + jump * k
        room = 1 - mu * k * jnp.sign(smooth)
        sticks = h * jnp.abs(smooth) <= mu * (jump * n + k * h * smooth)
        # If these are not above zero, the contact sticks or nothing changes.
        scale = jnp.where((room > 0) & (h > 0), room * h, 1.0)
        change_by_friction = jnp.where(sticks, -smooth, -jnp.sign(smooth) * mu * jump * n / scale)
        return jnp.where(independent, change_by_friction, jnp.where((room > 0) | (jump == 0), 0.0, jnp.nan))


class Opening(OfPhases):
    """A reset that opens a contact of the phase before, whose force has reached zero, at a negligible speed."""

    contact: str = eqx.field(static=True)

    def between(self, before: System, after: System) -> Callable:
        """Return the reset of the velocities."""
        return _Opened(before, self.contact)


class _Opened(eqx.Module):
    before: System
    contact: str = eqx.field(static=True)
    takes: tuple[str, ...] = eqx.field(static=True, default=OF_STATE)

    def __call__(self, t: Array, q: PyTree, v: PyTree, params: PyTree):
        model = model_of(self.before, t, q, v, params)
        x, u = model.vectors(q, v)
        sizes = jnp.abs(constraints.jacobian(model, t, x, u)) @ jnp.abs(u)
        mine, opening = model.belongs_to(self.contact), constraints.velocity_residual(model, t, x, u)
        # The speed must be above zero for a body at rest, too.
        least = OPENS * jnp.finfo(x.dtype).eps * sizes + jnp.sqrt(jnp.finfo(x.dtype).tiny)
        change = stop_gradient(jnp.where(mine, jnp.maximum(least - opening, 0.0), 0.0))
        return _moved(v, 1.0, velocity_change(model, t, q, v, change))


def _moved(v: PyTree, size: int, along: Callable):
    return jax.tree.map(lambda x, d: x + size * d, v, along)


def _check_sliding(sliding, t: Array, q: PyTree, v: PyTree, params: PyTree):
    """Raise if a sliding velocity is not one number, or not linear in v."""
    found = shape_of(sliding, t, q, v, params)
    well = getattr(found, "shape", () if isinstance(found, float | int) else None) == ()
    fix = "its component along the contact, in the plane of the motion"
    must_return(well, "sliding(t, q, v, params)", "one number", found, fix, "the velocity of a point in space")
    check_linear(sliding, t, q, v, params)


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
      smooth. The contact sticks, or slides with the impulse of friction on the cone; see `guards.py`. The guards of
      the phases decide between these: let the switch go to the phase that slides; its own guard, `lj.guards.sticks`,
      ends that at once if the contact does not slide in its direction.
    - `sliding`: `sliding(t, q, v, params)`, the velocity at which the contact slides, linear in v.

    **Raises:** `TypeError` for a gap, or a sliding velocity, that is not a function; `ValueError` for friction without
    a sliding velocity or a restitution, and for a sliding velocity that is not one number, or not linear in v.

    Source: Glocker, *Set-Valued Force Laws*, §6; for friction Pfeiffer & Glocker, *Multibody Dynamics with Unilateral
    Contacts*, §8, with Newton's law in place of Poisson's and no tangential restitution.
    """
    must_be_function(gap, "a gap", "(t, q, params)", 'lj.guards.touches(lambda t, q, params: q["y"])')
    if friction is None and sliding is None:
        return Touches(gap, Plastic() if restitution is None else Impact(gap, _number(restitution)))
    pair = {"friction": friction, "sliding": sliding}
    fix = 'lj.guards.touches(gap, 0.5, friction=0.3, sliding=lambda t, q, v, params: v["x"])'
    must_go_together(pair, "friction in an impact needs a coefficient and a velocity", fix)
    must_be_function(sliding, "sliding", "(t, q, v, params)", 'sliding=lambda t, q, v, params: v["x"]')
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
    must_be_among((1, -1, 0), side, "side", "side=0 for both")
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
    must_name(name, multipliers, "a guard names", "constraint of this phase", "its name in constraints=, '{}'")
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
