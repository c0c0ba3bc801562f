"""The forces, or impulses, of contacts that are solved together: a complementarity problem with Coulomb's law.

With the forces λ of all contacts, normal ones and tangential ones, their accelerations are W λ + b. For each contact

    0 ≤ λ_N ⊥ a_N ≥ 0,        |λ_T| ≤ μ N,        a_T = 0 or λ_T = -μ N a_T / |a_T|

where a_T and λ_T are numbers along a line, or two components in a plane. This is the root of λ - proj(λ - r (W λ + b)),
with the projection onto λ_N ≥ 0 and onto |λ_T| ≤ μ N, for any r > 0 that both components of a plane share.
It is found by Gauss-Seidel's relaxation and Newton's method on this piecewise smooth equation; each linear system is
solved in the sense of least squares, since contacts may depend on each other (a table on four legs).

Source: Alart & Curnier, Comput. Methods Appl. Mech. Eng. 92 (1991) 353; Acary & Brogliato, *Numerical Methods for
Nonsmooth Dynamical Systems*, §12.6, §13.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from lagjax.jaxtools import stop_gradient

SWEEPS, STEPS = 30, 30
# A root is found where the residual is below this part of the forces; singular values below this part of the largest
# count as zero.
SMALL = {np.dtype("float64"): 1e-11, np.dtype("float32"): 1e-4}
# And not improved where it is below so many round-offs, or did not fall to this part in so many steps.
EXACT, FALLS_TO, STALLS = 4, 0.25, 4
DEPENDENT = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-4}


def lengths(x: Float[Array, " k"], partners: np.ndarray) -> Float[Array, " k"]:
    """|x|: of each number by itself, or of both components of a plane; the derivative at zero is zero."""
    in_plane = partners != np.arange(x.size)
    if not in_plane.any():
        return jnp.abs(x)
    square = x**2 + x[partners] ** 2
    root = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return jnp.where(in_plane, root, jnp.abs(x))


def directions(x: Float[Array, " k"], partners: np.ndarray) -> Float[Array, " k"]:
    """x / |x|: the sign of a number, the direction in a plane; zero at zero."""
    size = lengths(x, partners)
    return x / jnp.where(size > 0, size, 1.0)


def pseudo_inverse(matrix: Float[Array, "k k"]) -> Float[Array, "k k"]:
    """The inverse in the sense of least squares."""
    if matrix.shape[0] == 1:
        # In a batch a singular value decomposition takes as long as a step of the motion.
        return jnp.where(matrix != 0, 1 / jnp.where(matrix != 0, matrix, 1.0), 0.0)
    return jnp.linalg.pinv(matrix, rtol=DEPENDENT[matrix.dtype])


class ContactProblem(NamedTuple):
    """The problem of k_N normal forces and k_T tangential ones, stacked: k = k_N + k_T.

    - `matrix`, `free`: W and b.
    - `may_push` (k_N,): which contacts there are; the forces of the others are zero.
    - `of_forces`, `constant`: the normal force of each tangential one is `constant + of_forces @ λ`.
    - `coefficient`: μ; zero where there is no friction.
    - `slides` (k_T,): 1 or -1 where the sliding is given, or in a plane its direction, and with it λ_T = -slides μ N;
      else 0.
    - `partners` (k_T,): for each tangential force the other component of its plane; itself, along a line.
    - `both` (k_T,): whether the normal force presses from both sides: then it counts by its size.
    """

    matrix: Float[Array, "k k"]
    free: Float[Array, " k"]
    may_push: Bool[Array, " kN"]
    of_forces: Float[Array, "kT k"]
    constant: Float[Array, " kT"]
    coefficient: Float[Array, " kT"]
    slides: Float[Array, " kT"]
    partners: np.ndarray
    both: np.ndarray | bool = False

    @property
    def given(self) -> Bool[Array, " kT"]:
        """Where the sliding is given."""
        return lengths(self.slides, self.partners) > 0

    @property
    def step(self) -> Float[Array, " k"]:
        """r of each force."""
        own, count = jnp.diag(self.matrix), self.may_push.size
        own = jnp.concatenate([own[:count], jnp.maximum(own[count:], own[count:][self.partners])])
        return 1 / jnp.where(own > 0, own, 1.0)

    def projected(self, forces: Float[Array, " k"]) -> Float[Array, " k"]:
        """proj(λ - r (W λ + b))."""
        count = self.may_push.size
        z = forces - self.step * (self.matrix @ forces + self.free)
        normal = jnp.where(self.may_push, jnp.maximum(z[:count], 0.0), 0.0)
        most = self.most(jnp.concatenate([normal, forces[count:]]))
        size = lengths(z[count:], self.partners)
        within = z[count:] * jnp.where(size > most, most / jnp.where(size > most, size, 1.0), 1.0)
        return jnp.concatenate([normal, jnp.where(self.given, -self.slides * most, within)])

    def normal_forces(self, forces: Float[Array, " k"]) -> Float[Array, " kT"]:
        """N of each tangential force."""
        return self.constant + self.of_forces @ forces

    def most(self, forces: Float[Array, " k"]) -> Float[Array, " kT"]:
        """μ N of each tangential force, with |N| where that presses from both sides."""
        found = self.normal_forces(forces)
        return self.coefficient * jnp.where(self.both, jnp.abs(found), jnp.maximum(found, 0.0))

    def on_sides_of(self, forces: Float[Array, " k"]) -> "ContactProblem":
        """The same with normal forces above zero, where those of these forces are below."""
        sign = jnp.where(self.both & (self.normal_forces(forces) < 0), -1.0, 1.0)
        return self._replace(of_forces=sign[:, None] * self.of_forces, constant=sign * self.constant)


class Forces(NamedTuple):
    """λ, and whether it is a solution."""

    forces: Float[Array, " k"]
    found: Bool[Array, ""]


def solved(problem: ContactProblem) -> Forces:
    """The forces of contacts that are solved together; the first derivative is that of the solution's own case."""
    # The problem has no size of its own: one of forces of 1e-255 is solved as any other.
    size = jnp.max(jnp.abs(jnp.concatenate([problem.step * problem.free, problem.constant])))
    unit = stop_gradient(jnp.ldexp(jnp.ones_like(size), jnp.frexp(size)[1]))
    unit = jnp.where((size > 0) & (unit > 0) & jnp.isfinite(unit), unit, 1.0)
    problem = problem._replace(free=problem.free / unit, constant=problem.constant / unit)
    still = stop_gradient(problem)._replace(partners=problem.partners, both=problem.both)

    def residual(problem: ContactProblem, forces: Array) -> Array:
        return forces - problem.projected(forces)

    def inverse(forces: Array) -> Array:
        return pseudo_inverse(jax.jacfwd(lambda forces: residual(still, forces))(forces))

    def sweep(state: tuple) -> tuple:
        forces, _, count = state
        new = lax.fori_loop(0, forces.size, lambda i, x: x.at[i].set(still.projected(x)[i]), forces)
        return new, jnp.any(new != forces), count + 1

    def error(forces: Array) -> Array:
        size = jnp.maximum(jnp.max(jnp.abs(forces)), jnp.max(jnp.abs(still.step * still.free)))
        return jnp.max(jnp.abs(residual(still, forces))) / jnp.where(size > 0, size, 1.0)

    def newton(state: tuple) -> tuple:
        forces, best, before, stalled, count = state
        slope, left = inverse(forces), error(forces)
        stalled = jnp.where(left <= FALLS_TO * before, 0, stalled + 1)
        # The first counts, also where nothing is a number.
        better = (left < best[1]) | (count == 0)
        best = jax.tree.map(lambda new, old: jnp.where(better, new, old), (forces, left, slope), best)
        return forces - slope @ residual(still, forces), best, left, stalled, count + 1

    def goes_on(state: tuple) -> Array:
        # What breaks a law by little more than round-off is in another case: so it is not left at what is small.
        _, (_, left, _), _, stalled, count = state
        done = (left <= small) & ((left <= EXACT * jnp.finfo(near.dtype).eps) | (stalled >= STALLS))
        return ~done & (count < STEPS)

    first = jnp.zeros_like(still.free), jnp.asarray(True), jnp.asarray(0)
    near, *_ = lax.while_loop(lambda s: s[1] & (s[2] < SWEEPS), sweep, first)
    unknown, small = jnp.full_like(near[0], jnp.inf), SMALL[near.dtype]
    start = near, (near, unknown, jnp.zeros_like(still.matrix)), unknown, jnp.asarray(0), jnp.asarray(0)
    _, (forces, left, slope), *_ = lax.while_loop(goes_on, newton, start)
    # One more step from the best: its matrix is that of the solution's own case.
    forces = stop_gradient(forces)
    return Forces(unit * (forces - stop_gradient(slope) @ residual(problem, forces)), left <= small)
