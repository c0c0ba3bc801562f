"""Newton's law of impact: contacts that are struck, one after the other or all at once, with Coulomb's law.

Velocities c of the contacts jump by W Λ, where Λ are the impulses of all contacts. With γ the velocity of a gap before

    one after the other    the gap that closes fastest opens with -e γ, until none with e > 0 closes; what then still
                           closes is stopped all at once
    simultaneous           0 ≤ Λ_N ⊥ γ' + e γ ≥ 0 for all closed gaps at once

Friction has an impulse where its normal force is that of a gap: |Λ_T| ≤ μ Λ_N.

Source: Glocker, *Set-Valued Force Laws*, §6; Pfeiffer & Glocker, *Multibody Dynamics with Unilateral Contacts*, ch. 8.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.complementarity import DEPENDENT, ContactProblem, solved
from lagjax.integrate.laws import Laws, at_most_one
from lagjax.jaxtools import stop_gradient

# Impacts one after the other, at most: so many for each pair of gaps, and a few more.
MORE_IMPACTS = 8


class Struck(eqx.Module):
    """Contacts at an impact.

    - `matrix` (k, k), `before` (k,): W, and the velocities of gaps and sliding before the impact.
    - `closed` (k_N,): which gaps are; `still` (k_N,): below which closing velocity nothing is struck.
    - `coefficient` (k_T,): μ; `pressed_by` (k_T, k): the impulse that presses each sliding velocity is that times Λ.
    """

    laws: Laws
    params: PyTree
    matrix: Float[Array, "k k"]
    before: Float[Array, " k"]
    closed: Bool[Array, " kN"]
    still: Float[Array, " kN"]
    coefficient: Float[Array, " kT"]
    pressed_by: Float[Array, "kT k"]

    def impulses(self) -> Float[Array, " k"]:
        """Λ."""
        if self.laws.impacts == "simultaneous":
            return self._together(self.before, self._opening(self._closing(self.before)))
        normals = self.closed.size

        def next_impact(impulses: Array, _) -> tuple[Array, None]:
            c = self.before + self.matrix @ impulses
            closing = self._closing(c)
            # One whose restitution is NaN strikes, so that the motion fails.
            struck = self._closes(c) & ~(stop_gradient(self._restitution(closing)) <= 0)
            i = jnp.argmax(jnp.where(struck, stop_gradient(closing), 0.0))
            return impulses + jnp.where(jnp.any(struck), self._alone(c, i, self._opening(closing)), 0.0), None

        most = normals * (normals + 1) + MORE_IMPACTS if normals > 1 else 1
        impulses, _ = lax.scan(next_impact, jnp.zeros_like(self.before), None, length=most)
        stopped = self._together(self.before + self.matrix @ impulses, jnp.zeros_like(self.still))
        return impulses + stopped

    def allowed(self) -> Bool[Array, ""]:
        """Whether the restitutions at these speeds are 0 to 1."""
        e = stop_gradient(self._restitution(self._closing(self.before)))
        return jnp.all(~self._closes(self.before) | (e >= 0) & (e <= at_most_one(e.dtype)))

    def _closes(self, c: Float[Array, " k"]) -> Bool[Array, " kN"]:
        return self.closed & (stop_gradient(c[: self.still.size]) < -self.still)

    def _closing(self, c: Float[Array, " k"]) -> Float[Array, " kN"]:
        return jnp.where(self.closed, jnp.maximum(-c[: self.still.size], 0.0), 0.0)

    def _restitution(self, closing: Float[Array, " kN"]) -> Float[Array, " kN"]:
        return jnp.concatenate([law.returned(closing[slice(*law.at)], self.params) for law in self.laws.normals])

    def _opening(self, closing: Float[Array, " kN"]) -> Float[Array, " kN"]:
        """-e γ."""
        return self._restitution(closing) * closing

    def _together(self, c: Float[Array, " k"], opening: Float[Array, " kN"]) -> Float[Array, " k"]:
        """The impulses of all closed gaps at once, if one closes."""
        return lax.cond(
            jnp.any(self._closes(c)), lambda: self._solved(c, opening, self.closed), lambda: jnp.zeros_like(c)
        )

    def _solved(self, c: Float[Array, " k"], opening: Float[Array, " kN"], closed: Bool[Array, " kN"]):
        """The impulses of the gaps `closed` at once: 0 ≤ Λ_N ⊥ c + W Λ - opening ≥ 0, with Coulomb's law."""
        normals, zero = self.still.size, jnp.zeros_like(self.coefficient)
        free = jnp.concatenate([c[:normals] - opening, c[normals:]])
        problem = ContactProblem(
            self.matrix, free, closed, self.pressed_by, zero, self.coefficient, zero, self.laws.partners
        )
        return solved(problem).forces

    def _alone(self, c: Float[Array, " k"], i: Int[Array, ""], opening: Float[Array, " kN"]) -> Float[Array, " k"]:
        """The impulses of gap i, which opens with `opening`."""
        if self.laws.in_planes.any():
            return self._solved(c, opening, jnp.arange(self.still.size) == i)
        return self._along_a_line(c, i, opening[i] - c[i])

    def _along_a_line(self, c: Float[Array, " k"], i: Int[Array, ""], jump: Float[Array, ""]) -> Float[Array, " k"]:
        """The impulses of gap i, whose velocity changes by `jump`, and of its friction: `contacts/impacts.py`."""
        unit, w = jnp.zeros_like(c).at[i].set(1.0), self.matrix
        smooth = jump / w[i, i]
        if not self.coefficient.size:
            return smooth * unit
        owners = np.array(self.laws.owners, int)
        j = self.still.size + jnp.argmax(owners == i)
        n, k, h = w[i, i], w[i, j], w[j, j]
        after = c[j] + smooth * k
        det = n * h - k * k
        held_t = (-c[j] * n - jump * k) / jnp.where(det > 0, det, 1.0)
        held_n = (jump - k * held_t) / n
        most, side = self.coefficient[j - self.still.size], jnp.sign(after)
        room = n - side * most * k
        slid_n = jump / jnp.where(room > 0, room, 1.0)
        sticks = (jnp.abs(held_t) <= most * held_n) & (det > DEPENDENT[c.dtype] * n * h) | (room <= 0)
        normal = jnp.where(sticks, held_n, slid_n)
        tangential = jnp.where(sticks, held_t, -side * most * slid_n)
        both = normal * unit + tangential * jnp.zeros_like(unit).at[j].set(1.0)
        return jnp.where(jnp.any(owners == i), both, smooth * unit)
