"""The forces, or impulses, of contacts that are solved together: a complementarity problem with Coulomb's law.

With the forces λ of all contacts, normal ones and tangential ones, their accelerations are W λ + b. For each contact

    0 ≤ λ_N ⊥ a_N ≥ 0,        |λ_T| ≤ μ N,        a_T = 0 or λ_T = -μ N a_T / |a_T|

where a_T and λ_T are numbers along a line, or two components in a plane. This is the root of λ - proj(λ - r (W λ + b)),
with the projection onto λ_N ≥ 0 and onto |λ_T| ≤ μ N, for any r > 0 that both components of a plane share.
It is found by Gauss-Seidel's relaxation and Newton's method on this piecewise smooth equation; each linear system is
solved in the sense of least squares, since contacts may depend on each other (a table on four legs).

Source: Alart & Curnier, Comput. Methods Appl. Mech. Eng. 92 (1991) 353; Acary & Brogliato, *Numerical Methods for
Nonsmooth Dynamical Systems*, §12.6, §13.

Such forces may be not unique: a box pushed on two corners, a beam on three supports, a pivoted arm at rest.

Where the rows of what is held depend on each other, accelerations are unique and forces are not, and the equations take
the shortest (`mechanics/saddle_point.py`). Among these one may break its law where others obey theirs: then it gets the
bound of its law, and what is still held carries the rest. A gap gets no force and is open, though it stays at zero;
friction that holds what others hold too gets a fixed direction, and the size μ N.

All forces λ, of contacts and of the constraints that always hold, are the shortest if none of them lies in the null
space of Aᵀ, with the rows A of all that is held.

Source: Lawson & Hanson, *Solving Least Squares Problems*, §23.3 (bounds that become active, one after the other).

Newton's law of impact is for contacts that are struck one after the other or all at once, with Coulomb's law.
Velocities c of the contacts jump by W Λ, where Λ are the impulses of all contacts. With γ the velocity of a gap before

    one after the other    the gap that closes fastest opens with -e γ, until none with e > 0 closes; what then still
                           closes is stopped all at once
    simultaneous           0 ≤ Λ_N ⊥ γ' + e γ ≥ 0 for all closed gaps at once

Friction has an impulse where its normal force is that of a gap: |Λ_T| ≤ μ Λ_N.

Source: Glocker, *Set-Valued Force Laws*, §6; Pfeiffer & Glocker, *Multibody Dynamics with Unilateral Contacts*, ch. 8.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.laws import Laws, at_most_one, directions, lengths
from lagjax.jaxtools import stop_gradient, where
from lagjax.numerics import DEPENDENT_BELOW

SWEEPS, STEPS = 30, 30
# A root is found where the residual is below this part of the forces; singular values below this part of the largest
# count as zero.
SMALL = {np.dtype("float64"): 1e-11, np.dtype("float32"): 1e-4}
# And not improved where it is below so many round-offs, or did not fall to this part in so many steps.
EXACT, FALLS_TO, STALLS = 4, 0.25, 4
DEPENDENT = {np.dtype("float64"): 1e-10, np.dtype("float32"): 1e-4}


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


class AtBound(NamedTuple):
    """What has the bound of its law: gaps that are open, and the directions of frictions, zero where there is none."""

    lifted: Bool[Array, " kN"]
    leans: Float[Array, " kT"]

    def on(self, problem: ContactProblem) -> ContactProblem:
        """The problem of the other forces."""
        leans = lengths(self.leans, problem.partners) > 0
        slides = jnp.where(leans, -self.leans, problem.slides)
        return problem._replace(may_push=problem.may_push & ~self.lifted, slides=slides)


class HeldRows(NamedTuple):
    """What may be held: the rows of contacts (k, n), and of what always is (m_b, n), with λ_b = constant + λ of_forces.

    Forces of contacts that slide, or are at their bound, follow from the normal forces.
    """

    contacts: Float[Array, "k n"]
    always: Float[Array, "mb n"]
    constant: Float[Array, " mb"]
    of_forces: Float[Array, "k mb"]

    def excess(self, problem: ContactProblem, on: Bool[Array, " k"]) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """The shortest forces that hold the rows `on`, and by how much each of these breaks its law; zero where a force
        is unique."""
        gaps, k, dtype = problem.may_push.size, on.size, self.contacts.dtype
        small, own = DEPENDENT_BELOW[np.dtype(dtype)], jnp.where(on[:, None], jnp.eye(k, dtype=dtype), 0.0)
        rows = jnp.concatenate([jnp.where(on[:, None], self.contacts, 0.0), self.always])
        every = jnp.concatenate([on, jnp.ones(self.constant.size, bool)])
        null = jnp.eye(every.size, dtype=dtype) - rows @ jnp.linalg.pinv(rows, rtol=small)
        null = jnp.where(every[:, None] & every[None], null, 0.0)
        # Zero where λ obeys the equations, and where it is the shortest.
        rubbed = jnp.concatenate([jnp.zeros(gaps, dtype), problem.slides * problem.coefficient])
        presses = jnp.concatenate([jnp.zeros((gaps, k), dtype), problem.of_forces])
        pressed = jnp.concatenate([jnp.zeros(gaps, dtype), problem.constant])
        follows = jnp.eye(k, dtype=dtype) + rubbed[:, None] * presses
        slope = jnp.where(on[:, None], problem.step[:, None] * problem.matrix, follows)
        slope = jnp.concatenate([slope, null @ jnp.concatenate([own, self.of_forces.T])])
        at_zero = jnp.where(on, problem.step * problem.free, rubbed * pressed)
        at_zero = jnp.concatenate([at_zero, null @ jnp.concatenate([jnp.zeros(k, dtype), self.constant])])
        forces = -jnp.linalg.pinv(slope, rtol=small) @ at_zero
        beyond = lengths(forces[gaps:], problem.partners) - problem.most(forces)
        beyond = jnp.concatenate([-forces[:gaps], beyond])
        return forces, jnp.where(on & (jnp.diag(null)[:k] > small), beyond, 0.0)


class HeldByForces(NamedTuple):
    """What forces hold: which rows (k,), and below which size each force is zero; which gaps without a force close; and
    to which side, or direction, what is not held begins to slide."""

    rows: Bool[Array, " k"]
    no_force: Float[Array, " k"]
    closes: Bool[Array, " kN"]
    begins: Float[Array, " kT"]


class BoundsTried(NamedTuple):
    """The forces with what is at its bound, the next such choice, and whether that is to be tried."""

    bound: AtBound
    solution: Forces
    next: AtBound
    goes_on: Bool[Array, ""]
    count: Int[Array, ""]


def within_laws(
    problem: ContactProblem, held: HeldRows, holds: Callable[[AtBound, Forces], HeldByForces]
) -> tuple[AtBound, Forces]:
    """The forces of contacts, and what has the bound of its law since the shortest forces would break that.

    `holds(bound, solution)`: what they hold.
    """
    gaps = problem.may_push.size
    none = AtBound(jnp.zeros(gaps, bool), jnp.zeros_like(problem.slides))
    if problem.free.size == 1 and not held.always.size:
        return none, solved(problem)

    def attempt(before: BoundsTried) -> BoundsTried:
        bound, tried = before.next, before.next.on(problem)
        solution = solved(tried)
        on, no_force, closes, begins = holds(bound, solution)
        shortest, beyond = held.excess(tried.on_sides_of(solution.forces), on)
        worst = jnp.max(beyond - no_force / 2)
        here = (beyond - no_force / 2 == worst) & (worst > 0)
        leans = jnp.where(here[gaps:], directions(shortest[gaps:], problem.partners), bound.leans)
        further = AtBound(bound.lifted | here[:gaps], leans)
        # A gap that closes needs its force: then what slid without that is at its bound, and not the gap.
        closing = jnp.any(closes)
        slid = jnp.where(lengths(bound.leans, problem.partners) > 0, bound.leans, -begins)
        further = where(closing, AtBound(bound.lifted & ~closes, slid), further)
        # Where the others cannot carry it, all are held as they were.
        better = solution.found & ~closing | (before.count == 0)
        goes_on = solution.found & ((worst > 0) | closing) & (before.count < problem.free.size)
        chosen = where(better, (bound, solution), (before.bound, before.solution))
        return BoundsTried(*chosen, further, goes_on, before.count + 1)

    nothing = Forces(jnp.zeros_like(problem.free), jnp.asarray(False))
    first = BoundsTried(none, nothing, none, jnp.asarray(True), jnp.asarray(0))
    found = lax.while_loop(lambda trial: trial.goes_on, attempt, first)
    return found.bound, found.solution


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
        """The impulses of gap i, whose velocity changes by `jump`, and of its friction: `lagjax/guards.py`."""
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
