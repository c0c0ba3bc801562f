"""Impacts: the velocities after a gap has closed, with Coulomb's friction or without.

The impulse of a contact acts along the gradients of its gap g and of its sliding velocity γ_T, and constraints that
hold before the impact keep holding, with impulses of their own:

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
is in the cone. Unlike the forces of a motion (`lagrangian.py`), an impact with Newton's law has no paradox,
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
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.integrate.elements import check_linear
from lagjax.integrate.solve.phases import OfPhases
from lagjax.jaxtools import shape_of, stop_gradient
from lagjax.mechanics import velocity_change
from lagjax.system import OF_POSITION, OF_STATE, Holonomic, Nonholonomic, System, constraints, coordinates, model_of

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
    shape = getattr(found, "shape", () if isinstance(found, float | int) else None)
    if shape != ():
        raise ValueError(
            f"sliding(t, q, v, params) must return one number, but returned {shape or type(found).__name__}.\n"
            "Usual cause: the velocity of a point in space.\n"
            "Fix: its component along the contact, in the plane of the motion."
        )
    check_linear(sliding, t, q, v, params)
