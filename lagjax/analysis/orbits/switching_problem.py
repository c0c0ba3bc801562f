"""What the programs of a motion in phases, or with elements, show about its orbits: whether t matters, what may shift.

Everything of which the motion is made has to agree: the equations of each phase, the guards that end it, and what
happens to the state there. A system with elements is one phase, with all of its contacts among the constraints; the
rest of their laws, coefficients, do not see the state apart from speeds.
"""

import jax
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.orbits.flow import independent_rows_of
from lagjax.analysis.orbits.monodromy import OrbitProblem, Reasons, check_freedom, problem_of, refuse_singular
from lagjax.integrate import InElements, integrate, phases_in, traced_phases
from lagjax.jaxtools import depends, is_traced
from lagjax.mechanics import invariance
from lagjax.system import Hybrid, State, System, check_system, coordinates, model_of, replace_fields, with_rates


def any_problem_of(system: System | Hybrid, given: State, phase: str | int | None = None) -> OrbitProblem:
    """Check a system, in phases or not, at a state; `phase`: that in which a hybrid starts."""
    check_system(system, *given[1:], phases=True, elements=True)
    system = system.starting(phase, "phase")
    if not system.in_phases and system.elements is None:
        return problem_of(system, given)
    if isinstance(system, Hybrid) and is_traced(system.first):
        raise ValueError(
            "the phase in which an orbit starts must be known while JAX is tracing, since it decides what may move.\n"
            'Fix: phase="flying", or a Python number; a loop over phases in place of vmap.'
        )
    s = coordinates.prepared(*given._replace(v=with_rates(system, given.q, given.v)))
    hybrid: Hybrid = traced_phases(system, s)
    # As a Python number it is known where JAX is tracing.
    hybrid = replace_fields(hybrid, first=int(hybrid.first))
    state = coordinates.state(*s)
    first = model_of(hybrid.first_phase, *state)
    rows = independent_rows_of(first, state)
    check_freedom(first, rows)
    timeless, unseen = _invariance(hybrid, state)
    # Forces and impacts do work, so that nothing is conserved; and no coordinate is known to be an angle for guards.
    return OrbitProblem(hybrid, s, Reasons(timeless, False, unseen, False), rows, (False,) * first.n)


def user_system(problem: OrbitProblem) -> System | Hybrid:
    """The system of a problem, with its elements if it has any."""
    return problem.system.user if isinstance(problem.system, InElements) else problem.system


def refuse_unfollowed(problem: OrbitProblem, period: float):
    """After a motion could not be followed: raise, in the user's names, if that is so at its start, or on its way."""
    if not problem.system.in_phases:
        return refuse_singular(problem)
    s = problem.state
    integrate(user_system(problem), s.q, s.v, s.params, ts=np.array([s.t, s.t + period]), estimate_error=False)


def _invariance(system: Hybrid, s: State) -> tuple[bool, tuple[bool, ...]]:
    """Whether nothing depends on t, and the coordinates, (n,), on which nothing depends."""
    model = model_of(system, *s)
    known = [invariance(phase) for phase in model.phases]
    timeless = all(each.timeless for each in known)
    unseen = np.all([each.unseen for each in known], axis=0)
    for phase, here in zip(phases_in(system, s, {}), model.phases):
        for number, reset in zip(phase.switches, phase.resets):
            t_seen, seen = _seen(system.switches[number], reset, here.zero_multipliers(), s)
            timeless, unseen = timeless and not t_seen, unseen & ~seen
    return timeless, tuple(unseen.tolist())


def _seen(switch, reset, multipliers: PyTree, s: State) -> tuple[bool, np.ndarray]:
    """Whether a switch depends on t, and on which coordinates, by whole leaves of q."""

    def happens(t, q: PyTree, v: PyTree):
        whole = reset.changes_positions(t, q, v, multipliers, s.params)
        q_after, *after = reset(t, q, v, multipliers, s.params)
        return switch.value(t, q, v, multipliers, s.params), after, q_after if whole else None

    leaves = jtu.tree_leaves(s.q)
    jaxpr = jax.make_jaxpr(happens)(*s[:3]).jaxpr
    t, *of_q = jaxpr.invars[: 1 + len(leaves)]
    return depends(jaxpr, [t]), np.repeat([depends(jaxpr, [x]) for x in of_q], [np.size(x) for x in leaves])
