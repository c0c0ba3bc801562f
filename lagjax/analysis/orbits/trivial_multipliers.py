"""The trivial multipliers of a cycle, which are 1 for a known reason, and their directions.

A cycle of a system without explicit time can start at any of its states: a displacement along the motion f returns
unchanged. A coordinate c on which nothing depends can be shifted: a displacement along it returns unchanged, too. If a
function h of the state is conserved, dh of any displacement returns unchanged. For the monodromy matrix M this means

    M f = f,    M e_c = e_c,    dh M = dh.

Two such directions make 1 a double root, usually with one eigenvector, and round-off splits it by the square root of
its size. They are therefore removed first: M then acts on states of the same h, up to displacements along f and e_c.

Source: Meyer & Offin, *Introduction to Hamiltonian Dynamical Systems*, §8.2-8.3 (multipliers 1 of integrals and flows).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from lagjax.analysis.orbits.flow import Flow
from lagjax.mechanics.structure import conserves_jacobi_integral, is_autonomous, unseen_coordinates
from lagjax.system import coordinates

# A direction shorter than this, relative to its possible length, is round-off.
NO_DIRECTION = 1e-7


class Reasons(NamedTuple):
    """The reasons why multipliers are 1 that the programs of the system's functions show.

    - `autonomous`: nothing depends on t. `energy`: the Jacobi integral is conserved.
    - `ignorable` (n,): the coordinates on which nothing depends; `momenta`: whether their momenta are conserved.
    """

    autonomous: bool
    energy: bool
    ignorable: tuple[bool, ...]
    momenta: bool

    def names(self, q) -> tuple[str, ...]:
        """A description of each direction, in the order of `directions`."""
        shifted = [name for name, yes in zip(coordinates.names(q), self.ignorable) if yes]
        return (
            *(("along the motion",) if self.autonomous else ()),
            *(("across energies",) if self.energy else ()),
            *(f"shift of {name}" for name in shifted),
            *(f"across momenta of {name}" for name in shifted if self.momenta),
        )


def reasons_of(model) -> Reasons:
    """The reasons that the programs of a system show."""
    system, autonomous = model.system, is_autonomous(model)
    potential = system.force is None and system.dissipation is None
    momenta = potential and system.is_holonomic
    return Reasons(
        autonomous,
        autonomous and conserves_jacobi_integral(model),
        tuple(bool(x) for x in unseen_coordinates(model)),
        momenta,
    )


def directions(flow: Flow, reasons: Reasons, t, z, scale, basis) -> Float[Array, "r k"]:
    """The directions of `reasons.names`, in coordinates of the tangent space; zero if there is none."""
    n, rows = flow.size, []
    shifts = [jnp.eye(2 * n, dtype=z.dtype)[i] for i in np.flatnonzero(reasons.ignorable)]

    def momentum(z):
        return jax.grad(flow.model.lagrangian, argnums=2)(t, z[:n], z[n:])

    if reasons.autonomous:
        rows.append(flow.rate(t, z) / scale)
    if reasons.energy:
        integral = lambda z: momentum(z) @ z[n:] - flow.model.lagrangian(t, z[:n], z[n:])
        rows.append(jax.grad(integral)(z) * scale)
    rows += shifts
    if reasons.momenta and shifts:
        slopes = jax.jacfwd(momentum)(z) * scale[None]
        rows += [slopes[i] for i in np.flatnonzero(reasons.ignorable)]
    if not rows:
        return jnp.zeros((0, basis.shape[1]), z.dtype)
    return jnp.stack(rows) @ basis


def orthonormal(reasons: Reasons, rows: Float[Array, "r k"], rate) -> tuple[Float[Array, "r k"], Bool[Array, " r"]]:
    """The directions orthonormalised one after the other, with zero for dependent ones; and which are independent.

    `rate`: the typical rate of the motion, from its period; a state is at rest if its rate is negligible compared to
    it.
    """
    basis, kept = [], []
    for i, row in enumerate(rows):
        length = _length(row)
        rest = row / jnp.where(length > 0, length, 1.0)
        for other in basis:
            rest = rest - (other @ rest) * other
        left = _length(rest)
        is_new = (length > 0) & (left > NO_DIRECTION)
        if reasons.autonomous and i == 0:
            is_new = length > NO_DIRECTION * rate
        if reasons.energy and i == 1:
            # At rest the energy has no slope either.
            is_new = is_new & kept[0]
        basis.append(jnp.where(is_new, rest / jnp.where(is_new, left, 1.0), 0.0))
        kept.append(is_new)
    if not basis:
        return rows, jnp.zeros(0, bool)
    return jnp.stack(basis), jnp.stack(kept)


def _length(row):
    squared = row @ row
    # The square root has no derivative at zero.
    return jnp.where(squared > 0, jnp.sqrt(jnp.where(squared > 0, squared, 1.0)), 0.0)
