"""Contacts with a spring and a damper as laws: F = k d + c d' at the depth d = -gap, while both d and F are above zero.

One function decides between the two modes, of the unit of d:

    m = d + (c/k) min(d', 0)        pressed while m > 0, apart while m < 0

since F has the sign of d + (c/k) d', and is above zero where d is and d' is. At m = 0 a contact that comes is pressed,
and a contact that goes has F = 0: accelerations are the same in both modes, so that none leads back to the other. For
k ~ d^½ and c ~ d^(3/2), Hertz's and Hunt and Crossley's, m goes through zero as steeply as d does, and F does not.

Source: Schwager & Pöschel, Granular Matter 9 (2007) 465.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.integrate.coefficients import coefficient
from lagjax.jaxtools import stop_gradient
from lagjax.system import InModes

APART, PRESSED = 0, 1
# m is zero below so many round-offs of what it is made of; and where its guard was found to be zero.
ZERO_BELOW, AT_ZERO = 16, 1000


class Compliant(eqx.Module):
    """The springs and dampers behind the gaps of an element; `at`: their places among the modes."""

    name: str = eqx.field(static=True)
    gap: Callable
    stiffness: Any
    damping: Any
    at: tuple[int, int] = eqx.field(static=True)
    shape: tuple[int, ...] = eqx.field(static=True)

    def forces(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> Float[Array, " k"]:
        """F of each, zero where it is apart."""
        depth, speed = self._depths(t, q, v, given.params)
        k, c = self._law(depth, given.params)
        return jnp.where(given.modes[slice(*self.at)] == PRESSED, k * depth + c * speed, 0.0)

    def push(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> tuple[Float[Array, " k"], PyTree]:
        """F, and the generalized force, like q."""
        _, back = jax.vjp(lambda q: jnp.ravel(self.gap(t, q, given.params)), q)
        forces = self.forces(t, q, v, given)
        return forces, back(forces)[0]

    def last(self, t: Array, q: PyTree, v: PyTree, given: InModes) -> Float[Array, " k"]:
        """The guard of each mode."""
        m = self._pressed(t, q, v, given.params)
        return jnp.where(given.modes[slice(*self.at)] == PRESSED, m, -m)

    def after(
        self, t: Array, q: PyTree, v: PyTree, given: InModes, fired: Bool[Array, " k"], sizes: Float[Array, "2 n"]
    ) -> tuple[Array, Float[Array, " k"]]:
        """The modes after a meeting, and how far one round-off may take m; `sizes`: of coordinates and velocities.

        Where m is zero within that, a guard that has fired ends its mode; else what comes, or stays, is pressed.
        """
        t, q, v, params = stop_gradient((t, q, v, given.params))
        depth, speed = self._depths(t, q, v, params)
        k, c = self._law(depth, params)
        slope = jax.jacobian(lambda x: jnp.ravel(self.gap(t, x, params)))(q)
        by_row = jnp.concatenate([jnp.reshape(x, (depth.size, -1)) for x in jax.tree.leaves(slope)], axis=1)
        gaps, rates = sizes @ jnp.abs(by_row).T
        slack = jnp.finfo(t.dtype).eps * (gaps + jnp.abs(depth) + c / jnp.where(k > 0, k, jnp.inf) * rates)
        m = self._pressed(t, q, v, params)
        now = given.modes[slice(*self.at)] == PRESSED
        unclear = jnp.abs(m) <= jnp.where(fired, AT_ZERO, ZERO_BELOW) * slack
        presses = jnp.where(unclear, jnp.where(fired, ~now, speed >= 0), m > 0)
        return jnp.where(presses, PRESSED, APART), ZERO_BELOW * slack

    def _depths(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> tuple[Array, Array]:
        """d and d'."""
        gap, rate = jax.jvp(lambda t, q: jnp.ravel(self.gap(t, q, params)), (t, q), (jnp.ones_like(t), v))
        return -gap, -rate

    def _law(self, depth: Array, params: PyTree) -> tuple[Array, Array]:
        # Above zero, where powers have derivatives; without a comparison, which would count as a kink of the force.
        depth = jnp.sqrt(depth**2 + jnp.finfo(depth.dtype).tiny)
        return coefficient(self.stiffness, depth, params), coefficient(self.damping, depth, params)

    def _pressed(self, t: Array, q: PyTree, v: PyTree, params: PyTree) -> Array:
        """m."""
        depth, speed = self._depths(t, q, v, params)
        k, c = self._law(depth, params)
        return depth + c / jnp.where(k > 0, k, jnp.inf) * jnp.minimum(speed, 0.0)
