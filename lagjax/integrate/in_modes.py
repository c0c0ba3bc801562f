"""A system with elements as one system in modes: constraints that are on or off, forces that depend on the modes.

The functions of the system take `InModes` in place of the parameters, so that one program serves all modes.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import dtypes
from jaxtyping import Array, PyTree

from lagjax.integrate.compliant import Compliant
from lagjax.integrate.elements import laws_of
from lagjax.integrate.jumps import OfParams
from lagjax.integrate.laws import CLOSED, STICKS, Laws, Tangent
from lagjax.system import (
    WITH_MULTIPLIERS,
    Holonomic,
    InModes,
    Nonholonomic,
    State,
    System,
    check_use,
    model_of,
    takes_of,
    traced_system,
)


class Masked(eqx.Module):
    """A gap, or a sliding velocity, as the residual of a constraint: zero where it does not hold."""

    function: Callable
    at: tuple[int, int] = eqx.field(static=True)
    holds: int = eqx.field(static=True)

    def __call__(self, *arguments):
        *state, given = arguments
        value = self.function(*state, given.params)
        on = given.modes[slice(*self.at)] == self.holds
        return jnp.where(on.reshape(jnp.shape(value)), value, 0.0)


class WithElements(eqx.Module):
    """The force of a system with those of everything that slides, or is pressed."""

    force: Callable | None
    tangents: tuple[Tangent, ...]
    compliant: tuple[Compliant, ...]
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        params = given.params
        total = jax.tree.map(jnp.zeros_like, q) if self.force is None else self.force(t, q, v, params)
        for force in self.by_element(t, q, v, multipliers, given).values():
            total = jax.tree.map(jnp.add, total, force)
        return total

    def by_element(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        """The forces that elements add, each like q, by the names of their modes: of friction, while it slides."""
        found, params, forces = {}, given.params, dict(multipliers)
        for law in self.compliant:
            forces[law.name], found[law.name] = law.push(t, q, v, given)
        for law in self.tangents:
            slip, back = jax.vjp(lambda v, law=law: law.slips(t, q, v, params), v)
            found[law.name] = back(law.friction(t, q, slip, v, forces, given))[0]
        return found


class OneGuard(eqx.Module):
    """The guards of all modes as one: the least of them, each in units of its slack.

    Guards are followed one by one, so that many of them would take long to compile. One that rests at zero counts as
    far from its end: else the least of all would be that, until another one is as near to zero.
    """

    laws: Laws
    takes: tuple[str, ...] = eqx.field(static=True, default=WITH_MULTIPLIERS)

    def __call__(self, t: Array, q: PyTree, v: PyTree, multipliers: dict[str, Array], given: InModes):
        slack, last = self.laws.slack(given), self.laws.last(t, q, v, multipliers, given)
        size = jnp.where(slack > 0, slack, 1.0)
        values, far = (last + slack) / size, 1 / jnp.finfo(last.dtype).eps
        return jnp.min(jnp.where(self.laws.rests(given) & (values > 0.5), jnp.maximum(values, far), values))


def in_modes(system: System, start: State) -> tuple[System, Laws]:
    """A system with elements as a system of `InModes`, with its laws; all functions checked and traced."""
    assert system.elements is not None
    plain = traced_system(replace(system, elements=None), start)
    if plain.force is not None and takes_of(plain.force) == WITH_MULTIPLIERS:
        raise ValueError(
            "a force that takes multipliers cannot stand beside elements.\n"
            'Fix: lj.Friction(sliding, coefficient, normal="name of the constraint") among the elements.'
        )
    normals, tangents, owners, compliant, sampled = laws_of(system.elements, plain, start)
    # As constraints are, contacts are no place for states.
    as_constraints = {law.name: Holonomic(law.gap) for law in (*normals, *compliant)}
    as_constraints |= {law.name: Nonholonomic(law.sliding) for law in tangents}
    check_use(replace(plain, constraints=as_constraints, force=None))
    always = plain.map(lambda function, role: OfParams(function))
    constraints: dict[str, Any] = dict(always.constraints)
    constraints |= {law.name: Holonomic(Masked(law.gap, law.at, CLOSED)) for law in normals}
    constraints |= {law.name: Nonholonomic(Masked(law.sliding, law.at, STICKS)) for law in tangents}
    force = WithElements(plain.force, tangents, compliant) if tangents or compliant else always.force
    masked = replace(always, constraints=constraints, force=force)
    guarded = [law.at[1] for law in (*normals, *tangents, *compliant)]
    guarded += [law.side[1] for law in tangents if law.side]
    count = max(guarded, default=0) + len(sampled)
    # The order of the stacked equations is known only with their shapes.
    none = np.zeros(count, dtypes.canonicalize_dtype(int)), np.zeros(0, bool), np.zeros(count, start.t.dtype)
    given = InModes(start.params, *none)
    form = model_of(masked, *start[:3], given).form
    places, first = {}, 0
    for residual in form.residuals:
        places[residual.name] = range(first, first + residual.size)
        first += residual.size
    rows = tuple(place for law in (*normals, *tangents) for place in places[law.name])
    return masked, Laws(normals, tangents, compliant, sampled, rows, owners, form.m, system.elements.impacts)
