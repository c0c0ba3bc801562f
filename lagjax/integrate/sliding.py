"""Sliding: where the forces on both sides of a jump push the motion back onto it, it goes along the jump.

Dry friction `-mu N sign(v)` holds a block as long as both of its values push v back to zero. By Filippov's rule the
force is then the mixture of its values on both sides, Q = Q₋ + α (Q₊ - Q₋) with 0 < α < 1, that keeps the motion on
the jump: with the difference g that is compared, dg/dt = 0. Accelerations are linear in α, so for several jumps

    dg_i/dt (a₀) + Σ_j α_j ∂g_i/∂v · D_j = 0

with the acceleration a₀ of one side and the change D_j that the other side of jump j makes. Where an α leaves [0, 1]
the motion leaves that jump, to the side where it does.

Source: Filippov, *Differential Equations with Discontinuous Righthand Sides*, §4; Utkin, *Sliding Modes in Control and
Optimization*, ch. 2.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from lagjax.integrate.jumps import Jumps, Smooth
from lagjax.mechanics import applied_force, completed, mass_and_forcing, with_first_order
from lagjax.numerics import dense
from lagjax.system import (
    OF_STATE,
    WITH_MULTIPLIERS,
    Given,
    Model,
    System,
    constraints,
    coordinates,
    model_of,
    rate_of,
    takes_of,
)

# A force is evaluated once more for each jump along which a motion could slide.
MOST_SLIDING = 8


def slidable(jumps: Jumps, system: System) -> tuple[int, ...]:
    """The numbers of the modes along whose jumps a motion could slide: comparisons of velocities, in forces."""
    if system.force is not None and takes_of(system.force) == WITH_MULTIPLIERS:
        return ()
    of_forces, rates = frozenset({"force", "dissipation"}), frozenset(map(rate_of, system.states))
    found = tuple(
        i
        for i, slot in enumerate(jumps.each())
        if "v" in slot.depends
        and not slot.levels
        # The rate of a state may have a kink there; for one that jumps, no side is right while the motion slides.
        and slot.roles - rates <= of_forces
        and not slot.jumps & rates
        # A kink of Rayleigh's function is a jump of its force.
        and (slot.jumps or "dissipation" in slot.roles)
    )
    return found if len(found) <= MOST_SLIDING else ()


class Mixture(NamedTuple):
    """How a motion slides: α of each jump (zero where it does not slide), and the rate of each difference."""

    shares: list[Float[Array, ""]]
    rates: list[Float[Array, ""]]


class Sliding(eqx.Module):
    """The mixture of forces; `system`: the smooth system, whose modes are those of one side; `which` of its modes may
    slide, with the `differences` that these compare."""

    system: System
    differences: tuple[Smooth, ...]
    which: tuple[int, ...] = eqx.field(static=True)

    def mixture(self, t: Array, q: PyTree, v: PyTree, given: Given) -> Mixture:
        """Solve for the shares."""
        model = with_first_order(model_of(self.system, t, q, v, given))
        x, u = model.vectors(q, v)
        a, solve = self._accelerations(model, t, x, u)
        changes = [solve(self._change(i, t, q, v, given)) for i in self.which]

        def difference(t: Array, x, u):
            return jnp.stack([f(t, model.tree(x), model.tree(u), given) for f in self.differences])

        _, rates = jax.jvp(difference, (t, x, u), (jnp.ones_like(t), u, a))
        pushes, count = (
            [jax.jvp(lambda u: difference(t, x, u), (u,), (change,))[1] for change in changes],
            len(self.which),
        )
        active = [given.slides[i] for i in self.which]
        rows = [[jnp.where(active[i], pushes[j][i], float(i == j)) for j in range(count)] for i in range(count)]
        rows = [[jnp.where(active[j] | (i == j), x, 0.0) for j, x in enumerate(row)] for i, row in enumerate(rows)]
        shares, _ = dense.solve_without_exchanges(rows, [jnp.where(active[i], -rates[i], 0.0) for i in range(count)])
        shares = [jnp.where(on, share, 0.0) for on, share in zip(active, shares)]
        total = [rates[i] + sum(share * pushes[j][i] for j, share in enumerate(shares)) for i in range(count)]
        return Mixture(shares, total)

    def _accelerations(self, model: Model, t: Array, x, u):
        """The accelerations without sliding, and the function that gives those of one more force."""
        linear = mass_and_forcing(model, t, x, u)
        if model.n == 1 and not model.m:
            return linear.forcing / linear.mass[0], lambda force: force / linear.mass[0]
        rows = constraints.acceleration_rows(model, t, x, u)
        solver = dense.Saddle(linear.mass, rows.jacobian)
        still = jnp.zeros_like(rows.gamma)
        a = completed(model, t, x, u, solver.solve(linear.forcing, rows.gamma)[0])
        return a, lambda force: solver.solve(force, still)[0]

    def _change(self, i, t: Array, q: PyTree, v: PyTree, given):
        """How the generalized force changes on the other side of jump i, as a vector."""
        beyond = given._replace(modes=given.modes.at[i].set(1 - given.modes[i]))
        return self._force(t, q, v, beyond) - self._force(t, q, v, given)

    def _force(self, t: Array, q: PyTree, v: PyTree, given):
        model = model_of(self.system, t, q, v, given)
        return applied_force(model, t, *model.vectors(q, v))

    def extra(self, t: Array, q: PyTree, v: PyTree, given):
        """The force that is added to that of the system, as a vector."""
        shares = self.mixture(t, q, v, given).shares
        found = [share * self._change(i, t, q, v, given) for i, share in zip(self.which, shares)]
        # A side whose force is infinite does not count where the motion does not slide.
        return sum(jnp.where(given.slides[i], x, 0.0) for i, x in zip(self.which, found))


class Mixed(eqx.Module):
    """The force of a system with its mixtures: (t, q, v, given) -> like q."""

    force: Callable | None
    sliding: Sliding
    takes: tuple[str, ...] = eqx.field(static=True, default=OF_STATE)

    def __call__(self, t: Array, q: PyTree, v: PyTree, given):
        extra = coordinates.like(q, self.sliding.extra(t, q, v, given))
        if self.force is None:
            return extra
        return jax.tree.map(jnp.add, self.force(t, q, v, given), extra)
