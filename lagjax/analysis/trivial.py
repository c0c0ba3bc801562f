"""The multipliers of a cycle that are 1 for a reason, and which directions they belong to.

A cycle of a system without explicit time can be entered anywhere: a push along the motion f comes back as it was. A
coordinate c on which nothing depends can be shifted: so does a push along it. And where a function h of the state is
conserved, dh of a push comes back as it was. With the monodromy matrix M that is

    M f = f,    M e_c = e_c,    dh M = dh.

Two such directions together make 1 a double root, usually with one eigenvector, which round-off splits by its square
root. They are therefore taken out first: M acts on the states of the same h, up to pushes along f and e_c.

Source: Meyer & Offin, *Introduction to Hamiltonian Dynamical Systems*, §8.2-8.3 (multipliers 1 of integrals and flows).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax.analysis.flow import Flow
from lagjax.mechanics import coordinates
from lagjax.mechanics.constraints import Holonomic
from lagjax.mechanics.structure import conserves_jacobi_integral, is_autonomous, unseen_coordinates

# What is shorter than this, relative to what it could be, is a direction of round-off.
NO_DIRECTION = 1e-7


class Reasons(NamedTuple):
    """Why a multiplier may be 1, as far as the system's functions tell: whether time, energy, and which coordinates.

    - `autonomous`: nothing depends on t. `energy`: the Jacobi integral is conserved.
    - `ignorable` (n,): the coordinates on which nothing depends; `momenta`: whether their momenta are conserved.
    """

    autonomous: bool
    energy: bool
    ignorable: tuple[bool, ...]
    momenta: bool

    def names(self, q) -> tuple[str, ...]:
        """A word for each direction, in the order of `directions`."""
        shifted = [name for name, yes in zip(coordinates.names(q), self.ignorable) if yes]
        return (
            *(("along the motion",) if self.autonomous else ()),
            *(("across energies",) if self.energy else ()),
            *(f"shift of {name}" for name in shifted),
            *(f"across momenta of {name}" for name in shifted if self.momenta),
        )


def reasons_of(system, t, q, v, params) -> Reasons:
    """What the programs of a system tell; of whose state only shapes count."""
    state = t, q, v, params
    autonomous = is_autonomous(system, *state)
    potential = system.force is None and system.dissipation is None
    momenta = potential and all(isinstance(c, Holonomic) for c in system.constraints.values())
    return Reasons(
        autonomous,
        autonomous and conserves_jacobi_integral(system, *state),
        tuple(bool(x) for x in unseen_coordinates(system, *state)),
        momenta,
    )


def directions(flow: Flow, reasons: Reasons, t, z, scale, basis) -> Float[Array, "r k"]:
    """The directions of `reasons.names`, in coordinates of the tangent space; zero where there is none."""
    n, found = flow.size, []
    shifts = [jnp.eye(2 * n, dtype=z.dtype)[i] for i in np.flatnonzero(reasons.ignorable)]

    def momentum(z):
        q, v = flow.state(z)
        return coordinates.flatten(jax.grad(flow.system.lagrangian, argnums=2)(t, q, v, flow.params))[0]

    if reasons.autonomous:
        found.append(flow.rate(t, z) / scale)
    if reasons.energy:
        integral = lambda z: momentum(z) @ z[n:] - flow.system.lagrangian(t, *flow.state(z), flow.params)
        found.append(jax.grad(integral)(z) * scale)
    found += shifts
    if reasons.momenta and shifts:
        slopes = jax.jacfwd(momentum)(z) * scale[None]
        found += [slopes[i] for i in np.flatnonzero(reasons.ignorable)]
    if not found:
        return jnp.zeros((0, basis.shape[1]), z.dtype)
    return jnp.stack(found) @ basis


def orthonormal(reasons: Reasons, rows: Float[Array, "r k"], rate) -> tuple[Float[Array, "r k"], Bool[Array, " r"]]:
    """The directions made orthonormal one after the other, zero where nothing new is left; and where something is.

    `rate`: of the motion, by its period: next to nothing beside that, the state is one of rest.
    """
    found, kept = [], []
    for i, row in enumerate(rows):
        length = _length(row)
        rest = row / jnp.where(length > 0, length, 1.0)
        for other in found:
            rest = rest - (other @ rest) * other
        left = _length(rest)
        is_new = (length > 0) & (left > NO_DIRECTION)
        if reasons.autonomous and i == 0:
            is_new = length > NO_DIRECTION * rate
        if reasons.energy and i == 1:
            # At rest there is no slope of the energy either.
            is_new = is_new & kept[0]
        found.append(jnp.where(is_new, rest / jnp.where(is_new, left, 1.0), 0.0))
        kept.append(is_new)
    if not found:
        return rows, jnp.zeros(0, bool)
    return jnp.stack(found), jnp.stack(kept)


def _length(row):
    squared = row @ row
    # The root has no derivative at zero.
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
