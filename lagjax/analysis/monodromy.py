"""The monodromy matrix of a motion, and its eigenvalues, with the trivial ones (1 for a known reason) deflated.

With an orthonormal basis B of the tangent space of the constraints, and orthonormal rows Q of the trivial directions,
the motion takes B w to B N w. The eigenvalues of

    (1 - QᵀQ) N (1 - QᵀQ) + QᵀQ

are the nontrivial multipliers, and exactly 1 for each row of Q. For a motion in several parts, from node to node, N is
the product of their matrices.

The trivial directions: a cycle of a system without explicit time can start at any of its states: a displacement along
the motion f returns unchanged. A coordinate c on which nothing depends can be shifted: a displacement along it returns
unchanged, too. If a function h of the state is conserved, dh of any displacement returns unchanged. For the monodromy
matrix M this means

    M f = f,    M e_c = e_c,    dh M = dh.

Two such directions make 1 a double root, usually with one eigenvector, and round-off splits it by the square root of
its size. They are therefore removed first: M then acts on states of the same h, up to displacements along f and e_c.

Source: Meyer & Offin, *Introduction to Hamiltonian Dynamical Systems*, §8.2-8.3 (multipliers 1 of integrals and flows).

*Of a motion in phases, or with elements*, the programs show whether t matters, and what may shift. Everything of which
the motion is made has to agree: the equations of each phase, the guards that end it, and what happens to the state
there. A system with elements is one phase, with all of its contacts among the constraints; the rest of their laws,
coefficients, do not see the state apart from speeds.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float, PyTree

from lagjax.analysis.flow import TOLERANCE, Flow, SwitchingFlow, any_flow, flow_of, independent_rows_of, scale_of
from lagjax.analysis.shooting import TURN, in_parts, times_of
from lagjax.contexts import WATCHED
from lagjax.integrate import InElements, integrate, phases_in, traced_phases
from lagjax.jaxtools import compiled, depends, is_eager, is_traced, numpy_of
from lagjax.mechanics import are_angles, explain_failure, invariance
from lagjax.system import (
    Hybrid,
    Model,
    State,
    System,
    check_system,
    coordinates,
    model_of,
    replace_fields,
    traced_system,
    with_rates,
)

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

    def names(self, q: PyTree) -> tuple[str, ...]:
        """A description of each direction, in the order of `directions`."""
        shifted = [name for name, yes in zip(coordinates.names(q), self.ignorable) if yes]
        return (
            *(("along the motion",) if self.autonomous else ()),
            *(("across energies",) if self.energy else ()),
            *(f"shift of {name}" for name in shifted),
            *(f"across momenta of {name}" for name in shifted if self.momenta),
        )


def directions(flow: Flow | SwitchingFlow, reasons: Reasons, t, z, rate, scale, basis) -> Float[Array, "r k"]:
    """The directions of `reasons.names`, in coordinates of the tangent space; zero if there is none. `rate`: of z."""
    n, rows = flow.size, []
    shifts = [jnp.eye(2 * n, dtype=z.dtype)[i] for i in np.flatnonzero(reasons.ignorable)]

    def momentum(z):
        return jax.grad(flow.model.lagrangian, argnums=2)(t, z[:n], z[n:])

    if reasons.autonomous:
        rows.append(rate / scale)
    if reasons.energy:
        rows.append(jax.grad(lambda z: momentum(z) @ z[n:] - flow.model.lagrangian(t, z[:n], z[n:]))(z) * scale)
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


# The factor on the tolerance of the second run, which measures the error of the first.
LOOSER = 10.0


class Period(NamedTuple):
    """The numerical results of following a motion for a period.

    `multipliers` are sorted, the `trivial` ones first; `reasons` (r,): which of the
    reasons apply. `reduced`: N. `apart`: how far the end is from the start, in units of the state.
    """

    multipliers: Complex[Array, " k"]
    trivial: Bool[Array, " k"]
    reasons: Bool[Array, " r"]
    reduced: Float[Array, "k k"]
    monodromy: Float[Array, "2n 2n"]
    log_volume: Float[Array, ""]
    apart: Float[Array, ""]
    ended: Bool[Array, ""]


class OrbitProblem(NamedTuple):
    """A checked system and its state, and what its programs show; all but these two are static.

    `system`: a `System`, or what `any_problem_of` makes of a motion in phases or with elements.
    """

    system: Any
    state: State
    reasons: Reasons
    rows: tuple[int, ...] | None
    is_angle: tuple[bool, ...]


def problem_of(system: System, given: State) -> OrbitProblem:
    """Check a system at a state; unless JAX is tracing, dependent constraints are found and left out."""
    check_system(system, *given[1:])
    s = coordinates.prepared(*given._replace(v=with_rates(system, given.q, given.v)))
    system = traced_system(system, s)
    state = coordinates.state(*s)
    model = model_of(system, *state)
    rows = independent_rows_of(model, state)
    check_freedom(model, rows)
    known = invariance(model)
    conserves = not system.is_forced and system.is_holonomic
    reasons = Reasons(known.timeless, known.timeless and conserves, known.unseen, conserves)
    return OrbitProblem(system, s, reasons, rows, tuple(are_angles(model).tolist()))


def refuse_singular(problem: OrbitProblem):
    """After a motion could not be followed: raise, in the user's names, if the equations fail at its start."""
    s = coordinates.state(*problem.state)
    words = explain_failure(model_of(problem.system, *s), s)
    if words is not None:
        raise ValueError(words)


def check_freedom(model: Model, rows: tuple[int, ...] | None) -> None:
    """Raise if constraints leave nothing to move; `rows`: those equations that are known to be independent."""
    flow, known = flow_of(model, 1.0, rows), rows is not None
    if flow.dimension > 0:
        return
    cause = "constraints that fix every coordinate" if known else "constraints that depend on each other"
    fix = "leave one out" + ("" if known else ", or call this outside of jit and vmap, where dependent ones are found")
    raise ValueError(
        f"there are {2 * model.n} coordinates and velocities, and {len(flow.rows)} equations restrict them: nothing is "
        f"left to move.\nUsual cause: {cause}.\nFix: {fix}."
    )


def tolerance_of(rtol, dtype):
    """The tolerance of the steps; the default is the tightest that costs little."""
    return np.asarray(TOLERANCE.get(np.dtype(dtype), 1e-5) if rtol is None else rtol, dtype)


def period_of(problem: OrbitProblem, period, rtol, nodes=None) -> tuple[Period, Float[Array, ""]]:
    """The results of a period, and the error of the entries of N; measured by a second run unless JAX is tracing."""
    system, s, reasons, rows, is_angle = problem
    eager = is_eager() and not is_traced((s, period, nodes))
    # Unrolled stages run in a third of the time but take three times as long to compile, which pays off in sweeps.
    in_a_loop = not WATCHED.value or sum(np.size(x) for x in jax.tree.leaves(s.q)) > 1
    rtol, period = tolerance_of(rtol, s.t.dtype), numpy_of(period).asarray(period, s.t.dtype)

    # With switches only the flow is a program, which searches for orbits share.
    follow = _followed if system.in_phases and eager else _period
    if follow is _followed:
        s, period, rtol = coordinates.state(*s), jnp.asarray(period), jnp.asarray(rtol)
        nodes = None if nodes is None else jnp.asarray(nodes)

    def run(rtol: Array):
        return follow(system, s, nodes, period, rtol, reasons, rows, is_angle, in_a_loop, not eager)

    first = run(rtol)
    if eager:
        second = run(LOOSER * rtol)
        error = np.max(np.abs(np.asarray(first.reduced) - np.asarray(second.reduced)))
        return first, jnp.asarray(error)
    # Only the product of the multipliers is known independently; the error is at least the tolerance of the steps.
    off = jnp.abs(jnp.linalg.det(lax.stop_gradient(first.reduced)) * jnp.exp(-lax.stop_gradient(first.log_volume)) - 1)
    # Where there are switches, not even that.
    off = jnp.where(jnp.isnan(off), 0.0, off)
    return first, jnp.maximum(off, LOOSER * rtol) * jnp.maximum(1.0, jnp.max(jnp.abs(lax.stop_gradient(first.reduced))))


@compiled
def _period(*given) -> Period:
    return _followed(*given)


def _followed(system, s, nodes, period, rtol, reasons, rows, is_angle, in_a_loop, differentiable) -> Period:
    flow, t = any_flow(system, s, rtol, rows, in_a_loop), s.t
    first = flow.vector(s.q, s.v)
    scale = scale_of(first, period)
    first = flow.onto_constraints(t, first, scale)
    nodes = first[None] if nodes is None else nodes.at[0].set(first)
    count = len(nodes)
    times = times_of(t, period, count)
    bases = [flow.tangent_space(t, z, scale) for t, z in zip(times, nodes)]

    def part(t: Array, z: Array, basis: Array):
        return flow.passage(t, z, period / count, basis, scale, True, differentiable)

    passed = in_parts(part, times, nodes, jnp.stack(bases))
    whole, after = jnp.eye(bases[0].shape[1], dtype=t.dtype), [*bases[1:], bases[0]]
    for basis, frame in zip(after, passed.frame):
        whole = basis.T @ frame @ whole
    rate = flow.rates(times, nodes, passed, period / count)[0]
    rows_of, there = orthonormal(reasons, directions(flow, reasons, t, first, rate, scale, bases[0]), TURN / period)
    ended = jnp.all(passed.ended) & jnp.all(jnp.isfinite(whole))
    if passed.returns is not None:
        ended = ended & jnp.all(passed.returns)
    multipliers, trivial = _sorted(without(rows_of, whole), jnp.sum(there))
    matrix = scale[:, None] * (bases[0] @ whole @ _coordinates(flow, bases[0])) / scale[None]
    multipliers = jnp.where(ended, multipliers, jnp.nan)
    apart = _apart(flow, reasons, is_angle, passed.z[-1] - first, scale)
    return Period(multipliers, trivial, there, whole, matrix, jnp.sum(passed.growth), apart, ended)


def _coordinates(flow: Flow | SwitchingFlow, basis):
    """The matrix that takes a displacement to its tangent coordinates, whatever it says of determined velocities."""
    if not flow.determined.any():
        return basis.T
    free = jnp.where(flow.determined[:, None], 0.0, basis)
    return jnp.linalg.solve(free.T @ free, free.T)


def without(rows, matrix):
    """The matrix with eigenvalue 1 in the directions of `rows`, which are decoupled from the rest."""
    rest = np.eye(matrix.shape[0], dtype=matrix.dtype) - rows.T @ rows
    return rest @ matrix @ rest + rows.T @ rows


def _sorted(matrix, trivial):
    """The eigenvalues: first the `trivial` ones, which are exactly 1, then the others by falling size."""
    finite = jnp.all(jnp.isfinite(matrix))
    # LAPACK may not return if the matrix is not finite.
    eigenvalues = jnp.linalg.eigvals(jnp.where(finite, matrix, jnp.eye(len(matrix), dtype=matrix.dtype)))
    eigenvalues = jnp.where(finite, eigenvalues, jnp.nan)
    near = jnp.argsort(jnp.argsort(jnp.abs(lax.stop_gradient(eigenvalues) - 1)))
    first = near < trivial
    size = jnp.abs(lax.stop_gradient(eigenvalues))
    # Rounded because the sizes of a conjugate pair differ by round-off; the one in the upper half plane comes first.
    size = jnp.round(size / jnp.max(size), 9) + 1e-12 * jnp.sign(jnp.imag(lax.stop_gradient(eigenvalues)))
    order = jnp.argsort(jnp.where(first, -jnp.inf, -size))
    return eigenvalues[order], first[order]


def _apart(flow, reasons, is_angle, difference, scale):
    """How far a state is from its start, ignoring whole turns and coordinates that nothing depends on."""
    x, u = jnp.split(lax.stop_gradient(difference), 2)
    x = jnp.where(np.array(is_angle), x - TURN * jnp.round(x / TURN), x)
    x = jnp.where(np.array(reasons.ignorable), 0.0, x)
    return jnp.max(jnp.abs(jnp.concatenate([x, u])) / scale)


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
