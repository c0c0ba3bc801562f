"""Explain what is wrong with a state in the user's names: the coordinate or constraint, the usual cause, the fix.

Everything here looks at values, and so runs outside compiled programs.

*A mass matrix with an eigenvalue below zero.* Where an eigenvalue of M passes zero, `M a = F` has no solution:
velocities grow like one over its root, and no motion reaches the other side. In the coordinates that constraints leave
free, Nᵀ M N counts, with A N = 0. How many eigenvalues are below zero does not depend on units (Sylvester's law of
inertia); the numbers themselves do.

The eigenvalues at the start, at the end and just beyond it decide. An r² that only touches zero, as in polar
coordinates, is thus told apart: beyond its zero it is positive again.

Source: Golub & Van Loan, *Matrix Computations*, §8.1.5 (the law of inertia).
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.mechanics.equations import equations_of
from lagjax.mechanics.lagrangian import balance_matrix, is_determined, of_states, with_first_order
from lagjax.mechanics.saddle_point import SINGULAR_BELOW, Examined, examined, missed
from lagjax.refusals import listed
from lagjax.system import Model, State, constraints, coordinates

# An eigenvalue counts as below zero beyond so many round-offs of the largest.
ROUND_OFFS = 1e3
# How far beyond the end M is looked at, as parts of the way so far.
BEYOND = 4.0 ** np.arange(-24.0, -2.0)


class IndefiniteMass(NamedTuple):
    """The cause in words and the fix, and whether an eigenvalue passes zero from the start to just beyond the end."""

    cause: str
    fix: str
    crossed: bool


def indefinite_mass(model: Model, start: State, end: State) -> IndefiniteMass | None:
    """What M's eigenvalues at the start, the end and beyond it say; None where none is below zero."""
    first, last = _Eigenvalues(model, start), _Eigenvalues(model, end)
    if not (first.known and last.known):
        return None
    found = last if last.differs(first) else _beyond(model, start, end, first)
    if found is not None:
        cause = (
            f"a mass matrix that is not positive definite: its smallest eigenvalue is {first.smallest:.3g} at the "
            f"start, {last.smallest:.2g} at the end and {found.smallest:.2g} at t = {float(found.t):.9g}, most in "
            f"'{found.name}'. Where it passes zero, accelerations have no bound"
        )
    elif first.below:
        cause = (
            f"a mass matrix that is not positive definite: its smallest eigenvalue is {first.smallest:.3g} at the "
            f"start, most in '{first.name}', and {last.smallest:.2g} at the end. A kinetic energy without a lower "
            "bound lets velocities grow without end"
        )
    else:
        return None
    fix = (
        "M = lj.learned.positive_definite(numbers, sizes) for an M that is learned; else the sign of the kinetic "
        "energy in L: np.linalg.eigvalsh(lj.mass_matrix(system, t, q, v, params)) must be above zero"
    )
    return IndefiniteMass(cause, fix, found is not None)


def indefinite_in_words(mass: Any, rows: Any, names: Callable[[], list[str]], again: bool = False) -> str | None:
    """Say of M and A at one state that an eigenvalue is below zero; None where none is, or M is not finite.

    `names()`: those of the coordinates. `again`: M was definite at another state or with other parameters, and is
    looked at again only where one of its diagonal entries is not above zero, which takes two microseconds.
    """
    mass = np.asarray(mass)
    # A definite M is so in all directions.
    if mass.diagonal().min() > 0 and (again or len(mass) == 1 or _has_root(mass)):
        return None
    eps, mass, rows = np.finfo(mass.dtype).eps, np.asarray(mass, float), np.asarray(rows, float)
    if not (np.all(np.isfinite(mass)) and np.all(np.isfinite(rows))):
        return None
    values, directions = _in_free_directions(mass, rows)
    round_off = ROUND_OFFS * eps * np.max(np.abs(values), initial=0.0)
    if not np.any(values < -round_off):
        return None
    most = names()[int(np.argmax(np.abs(directions[:, 0])))]
    every = not np.any(values > round_off)
    cause = "L = V - T, or a mass below zero" if every else "the sign of one term of the kinetic energy, or of one mass"
    return (
        f"the mass matrix is {'negative definite' if every else 'not positive definite'} where the motion starts: its "
        f"smallest eigenvalue is {values[0]:.3g}, most in '{most}'. The motion is that of the equations as they are, "
        f"{'and forces act the other way round' if every else 'and velocities may grow without end'}.\n"
        f"Usual cause: {cause}.\n"
        "Fix: L = T - V with T above zero: lj.mass_matrix(system, t, q, v, params, by_name=True) says where it is not. "
        'If it is meant, as in spacetime: warnings.filterwarnings("ignore", "the mass matrix is").'
    )


def _has_root(matrix: np.ndarray) -> bool:
    try:
        return bool(np.isfinite(np.linalg.cholesky(matrix)[-1, -1]))
    except np.linalg.LinAlgError:
        return False


def _in_free_directions(mass: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The eigenvalues of M in the directions that constraints leave free, and these directions as columns."""
    _, sizes, right = np.linalg.svd(rows)
    free = right[int(np.sum(sizes > 1e-9 * np.max(sizes, initial=0.0))) :].T
    values, vectors = np.linalg.eigh(free.T @ mass @ free)
    return values, free @ vectors


class _Eigenvalues:
    """The eigenvalues of M at a state, in the directions that constraints leave free; not `known` if not finite."""

    def __init__(self, model: Model, s: State):
        found = examined(model, s)
        mass, rows = np.asarray(found.linear.mass, float), np.asarray(found.rows.jacobian, float)
        self.t, self.known, self.below = s.t, bool(np.all(np.isfinite(mass)) and np.all(np.isfinite(rows))), 0
        if not self.known:
            return
        values, directions = _in_free_directions(mass, rows)
        self.known = values.size > 0
        if self.known:
            round_off = ROUND_OFFS * np.finfo(found.linear.mass.dtype).eps * np.max(np.abs(values))
            self.below, self.above = int(np.sum(values < -round_off)), int(np.sum(values > round_off))
            self.smallest = float(values[0])
            self.name = model.names[int(np.argmax(np.abs(directions[:, 0])))]

    def differs(self, first: "_Eigenvalues") -> bool:
        """Whether an eigenvalue has another sign than at `first`, beyond round-off."""
        return self.below > first.below or self.above > first.above


def _beyond(model: Model, start: State, end: State, first: _Eigenvalues) -> _Eigenvalues | None:
    """The first state on the straight line beyond the end where an eigenvalue has another sign than at `first`."""
    (x0, _), (x, u) = (model.vectors(s.q, s.v) for s in (start, end))
    way, pace = float(np.max(np.abs(x - x0))), float(np.max(np.abs(u)))
    for part in BEYOND if 0 < way * pace < np.inf else ():
        ahead = np.sign(end.t - start.t) * part * way / pace
        q = jax.tree.map(lambda q, v: np.asarray(q) + ahead * np.asarray(v), end.q, end.v)
        there = _Eigenvalues(model, end._replace(t=end.t + ahead, q=q))
        if not there.known:
            return None
        if there.differs(first):
            return there
    return None


# A row counts as part of a combination if it makes up more than this share of it.
SHARE = 1e-6
# Velocities violate a constraint if they would have to change by more than this share of their size to satisfy it.
OFF_ABOVE = 1e-6


def explain_failure(model: Model, s: coordinates.State) -> str | None:
    """Say in the user's names why the equations fail at a state; None where they do not."""
    found = examined(model, s)
    # What divides by a singular matrix does not solve its equations either.
    if model.solves_itself and not explain_singular(np.asarray(found.matrix), model, s):
        if disagreement := explain_disagreement(model, s):
            return disagreement
    linear, rows, lagrangian = found.linear, found.rows, found.lagrangian
    names = model.names
    place = where(s)
    if not np.isfinite(lagrangian):
        return (
            f"L is {float(lagrangian)} {place}.\n"
            "Usual cause: a division by zero, a root or logarithm of a negative number, or NaN in params.\n"
            "Fix: evaluate lagrangian(t, q, v, params) there, term by term."
        )
    if undetermined := explain_undetermined(model, s):
        return undetermined
    has_states = with_first_order(model).form.first_order is not None
    for i in np.flatnonzero(~np.isfinite(coordinates.flatten(found.a)[0])) if has_states else ():
        if of_states(model)[i]:
            return (
                f"the rate of state '{names[i]}', or its change with time, is not finite {place}.\n"
                "Usual cause: a division by zero in its function, or sqrt at 0.\n"
                "Fix: evaluate the function there."
            )
    for what, values in (("mass matrix", linear.mass), ("force", linear.forcing)):
        if not np.all(np.isfinite(values)):
            bad = np.argwhere(~np.isfinite(np.asarray(values)))[0]
            return (
                f"L is finite but the {what} of coordinate '{names[bad[0]]}' is not, {place}.\n"
                "Usual cause: a derivative that does not exist there, as of sqrt at 0 or arccos at 1, "
                "also behind a jnp.where whose other branch is taken.\n"
                "Fix: make the argument safe before the function: jnp.sqrt(jnp.where(x > 0, x, 1.0))."
            )
    equations = model.equation_names
    for what, values in (("derivative", rows.jacobian), ("second derivative", rows.gamma)):
        if not np.all(np.isfinite(values)):
            bad = np.argwhere(~np.isfinite(np.asarray(values)))[0]
            return (
                f"the {what} of constraint '{equations[bad[0]]}' is not finite {place}.\n"
                "Usual cause: a distance written with sqrt, which has no derivative at zero.\n"
                "Fix: constrain the square of the distance."
            )
    return (
        explain_singular(np.asarray(found.matrix), model, s)
        or explain_contradiction(found, model, s)
        or _explain_paradox(found, s)
    )


def explain_disagreement(model: Model, s: State) -> str | None:
    """Say in which coordinate forward dynamics miss the equations of L; None where they solve them."""
    model = with_first_order(model)
    state = s.t, *model.vectors(s.q, s.v)
    by, wrong = (np.asarray(x) for x in missed(model, *state, np.eye(model.n, dtype=s.t.dtype)))
    if not np.any(wrong) or not np.isfinite(model.lagrangian(*state)):
        return None
    i = int(np.argmax(np.where(wrong, by, 0.0)))
    return (
        f"forward_dynamics do not solve the equations of L: M a = F is missed by {by[i]:.3g} in '{model.names[i]}', "
        f"{where(s)} or at other velocities there.\n"
        "Usual cause: a term of L that they leave out, as a potential or a Coriolis force; the force that they "
        "are given, which is all that acts beside L; or a sign.\n"
        "Fix: compare them with lj.accelerations(lj.System(lagrangian, ...), ...) without forward_dynamics."
    )


def explain_undetermined(model: Model, s: State) -> str | None:
    """Name the coordinates without a mass whose equations do not determine their velocities; None if they do."""
    model = with_first_order(model)
    first, state = model.form.first_order, (s.t, *model.vectors(s.q, s.v))
    if first is None or bool(is_determined(model, *state)):
        return None
    matrix = np.asarray(balance_matrix(model, *state))
    free = np.ones(len(matrix), bool)
    if np.all(np.isfinite(matrix)):
        _, sizes, directions = np.linalg.svd(matrix)
        null = directions[sizes <= max(sizes[-1], SINGULAR_BELOW[matrix.dtype] * sizes[0])]
        free = np.max(np.abs(null), axis=0) > SHARE
    names = [model.names[i] for i, is_free in zip(first.massless, free) if is_free]
    whose = f"velocity of '{names[0]}' is" if len(names) == 1 else f"velocities of {listed(names)} are"
    return (
        f"the {whose} not determined {where(s)}: without a mass, what is linear in velocities in L, force and "
        "dissipation must determine them, and is singular there.\n"
        "Usual cause: a damping of zero in params; a field or circulation that vanishes; or an odd number of "
        "coordinates in A(q) v, whose forces K v are antisymmetric.\n"
        f"Fix: a damping above zero, a mass of '{names[0]}' in L, or the system without it."
    )


def _explain_paradox(found: Examined, s: State):
    if found.unique:
        return None
    return (
        f"friction leaves no acceleration, or two, {where(s)}: the force grows with the multipliers faster than these "
        "can balance it (Painlevé's paradox).\n"
        "Usual cause: a rod or a wedge that is pushed against the surface it slides on, with a large coefficient; or a "
        "friction force with the wrong sign.\n"
        "Fix: check the sign first: friction acts against the sliding velocity; else take a smaller coefficient, or a "
        "contact that gives way (a stiff spring in L)."
    )


def describe(tree: PyTree) -> str:
    """A pytree of numbers on one line, six digits each."""
    values = np.asarray(coordinates.vector(tree))
    pairs = [f"{name} = {float(x):.6g}" for name, x in zip(coordinates.names(tree), values)]
    shown = pairs if len(pairs) <= 6 else [*pairs[:6], "..."]
    return "(" + ", ".join(shown) + ")"


def explain_singular(matrix: Array, model: Model, s: coordinates.State) -> str | None:
    """Name the coordinate or constraint in which a saddle-point matrix is singular; None if it is not."""
    for i in np.flatnonzero(~np.any(matrix, axis=1)):
        return _singular_message(i, model, s)
    _, values, right = np.linalg.svd(_equilibrate(matrix))
    if values[-1] > SINGULAR_BELOW[matrix.dtype] * values[0]:
        return None
    return _singular_message(int(np.argmax(np.abs(right[-1]))), model, s)


def explain_contradiction(found: Examined, model: Model, s: coordinates.State) -> str | None:
    """Name dependent constraints that ask for different accelerations; None where there are none."""
    contradicting = np.flatnonzero(found.contradictory)
    if not contradicting.size:
        return None
    names = model.equation_names
    groups = {group[0]: group for group in dependencies(found.rows.jacobian, found.independent, names)}
    involved = groups[names[contradicting[0]]]
    violated = _violated_by_velocities(model, s, involved)
    if violated:
        return (
            f"constraints {listed(involved)} depend on each other, and the state is off them: {violated} instead of 0. "
            f"They agree about the acceleration only where they hold. This is {where(s)}.\n"
            "Usual cause: velocities that the constraints do not allow, computed for other parameters or guessed.\n"
            "Fix: q, v = lj.consistent_state(system, t, q, v, params) for a consistent state near it."
        )
    return (
        f"constraints {listed(involved)} contradict each other {where(s)}: they restrict the same motion, and no "
        "acceleration satisfies all of them.\n"
        "Usual cause: one motion prescribed twice, with functions of time or parameters that differ, or a loop that "
        "cannot close.\n"
        f"Fix: remove '{involved[0]}', or make it demand the same as the others."
    )


def _violated_by_velocities(model: Model, s: State, names: Sequence[str]):
    """Which of the named equations the velocities violate, with their residuals."""
    x, u = model.vectors(s.q, s.v)
    residual = np.asarray(constraints.velocity_residual(model, s.t, x, u))
    slopes = np.asarray(equations_of(model).row_sizes(s.t, s.q, s.v))
    allowed = OFF_ABOVE * slopes * max(1e-300, float(np.max(np.abs(u))))
    rows = zip(model.equation_names, model.holonomic, residual, allowed)
    return ", ".join(
        f"{'d/dt ' if holonomic else ''}'{name}' = {r:.3g}"
        for name, holonomic, r, most in rows
        if name in names and abs(r) > most
    )


def dependencies(jacobian: Array, independent: Array, names: Sequence[str]) -> list[tuple[str, ...]]:
    """Each dependent constraint equation, followed by those that it is a combination of, by name."""
    rows, chosen = np.asarray(jacobian, float), np.flatnonzero(independent)
    size = np.linalg.norm(rows, axis=1, keepdims=True)
    rows = rows / np.where(size > 0, size, 1.0)
    groups = []
    for i in np.flatnonzero(~np.asarray(independent)):
        # Of rows of length one, whatever their units.
        share = np.abs(np.linalg.lstsq(rows[chosen].T, rows[i], rcond=None)[0])
        groups.append((names[i], *(names[j] for j in chosen[share > SHARE])))
    return groups


def _equilibrate(matrix: Array):
    """Scale rows and columns alike until each row's largest entry is near one (Ruiz)."""
    scaled = matrix.copy()
    for _ in range(20):
        scale = 1 / np.sqrt(np.max(np.abs(scaled), axis=1))
        scaled = scale[:, None] * scaled * scale[None, :]
    return scaled


def _singular_message(i, model: Model, s: State):
    names, equations = model.names, model.equation_names
    n, place = len(names), where(s)
    if i < n:
        return (
            f"the mass matrix is singular in coordinate '{names[i]}' {place}: its acceleration is not "
            "determined.\nUsual cause: a coordinate singularity (an azimuth at the pole), a coordinate "
            "whose velocity is missing from L, or a zero mass.\n"
            f"Fix: leave the singular point (or use Cartesian coordinates with a constraint), or give "
            f"'{names[i]}' a kinetic energy or a constraint that determines it."
        )
    return (
        f"constraint '{equations[i - n]}' does not act independently of the others {place}: its multiplier is "
        "not determined.\nUsual cause: a constraint given twice or implied by the others, or one whose "
        "derivative vanishes there.\n"
        f"Fix: remove '{equations[i - n]}', or write it so that its derivative does not vanish."
    )


def where(s: coordinates.State) -> str:
    """The state on one line, for the end of an error message."""
    return f"at t = {float(s.t):.6g}, q = {describe(s.q)}, v = {describe(s.v)}"
