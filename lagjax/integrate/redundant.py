"""Forces of contacts that are not unique: a box pushed on two corners, a beam on three supports, a pivoted arm at rest.

Where the rows of what is held depend on each other, accelerations are unique and forces are not, and the equations take
the shortest (`mechanics/saddle_point.py`). Among these one may break its law where others obey theirs: then it gets the
bound of its law, and what is still held carries the rest. A gap gets no force and is open, though it stays at zero;
friction that holds what others hold too gets a fixed direction, and the size μ N.

All forces λ, of contacts and of the constraints that always hold, are the shortest if none of them lies in the null
space of Aᵀ, with the rows A of all that is held.

Source: Lawson & Hanson, *Solving Least Squares Problems*, §23.3 (bounds that become active, one after the other).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from lagjax.integrate.complementarity import ContactProblem, Forces, directions, lengths, solved
from lagjax.jaxtools import where
from lagjax.numerics import DEPENDENT_BELOW


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
