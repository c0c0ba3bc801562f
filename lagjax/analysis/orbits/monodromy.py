"""The monodromy matrix of a motion, and its eigenvalues, with the trivial ones (1 for a known reason) deflated.

With an orthonormal basis B of the tangent space of the constraints, and orthonormal rows Q of the trivial directions
(`trivial_multipliers.py`), the motion takes B w to B N w. The eigenvalues of

    (1 - QᵀQ) N (1 - QᵀQ) + QᵀQ

are the nontrivial multipliers, and exactly 1 for each row of Q. For a motion in several parts, from node to node, N is
the product of their matrices.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Complex, Float

from lagjax.analysis.orbits.flow import TOLERANCE, all_rows, flow_of, independent_rows_of, scale_of
from lagjax.analysis.orbits.trivial_multipliers import Reasons, directions, orthonormal, reasons_of
from lagjax.jaxtools.compiled import compiled
from lagjax.jaxtools.tracing import WATCHED, is_eager, is_traced, numpy_of
from lagjax.mechanics.diagnosis import explain_failure
from lagjax.mechanics.structure import are_angles
from lagjax.system import coordinates
from lagjax.system.argument_checks import check_system
from lagjax.system.check_functions import traced_system
from lagjax.system.coordinates import State
from lagjax.system.model import model_of

# The factor on the tolerance of the second run, which measures the error of the first.
LOOSER = 10.0
TURN = 2 * np.pi


class Period(NamedTuple):
    """The numerical results of following a motion for a period.

    `multipliers` are sorted, the `trivial` ones first; `reasons` (r,): which reasons of `trivial_multipliers.py`
    apply. `reduced`: N. `apart`: how far the end is from the start, in units of the state.
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
    """A checked system and its state, and what its programs show; all but these two are static."""

    system: object
    state: State
    reasons: Reasons
    rows: tuple[int, ...] | None
    is_angle: tuple[bool, ...]


def problem_of(system, t, q, v, params) -> OrbitProblem:
    """Check a system at a state; unless JAX is tracing, dependent constraints are found and left out."""
    check_system(system, q, v, params)
    s = coordinates.prepared(t, q, v, params)
    system = traced_system(system, s)
    state = coordinates.state(*s)
    model = model_of(system, *state)
    rows = independent_rows_of(model, state)
    _check_freedom(model, rows)
    return OrbitProblem(system, s, reasons_of(model), rows, tuple(are_angles(model).tolist()))


def refuse_singular(problem: OrbitProblem):
    """After a motion could not be followed: raise, in the user's names, if the equations fail at its start."""
    s = coordinates.state(*problem.state)
    words = explain_failure(model_of(problem.system, *s), s)
    if words is not None:
        raise ValueError(words)


def _check_freedom(model, rows):
    n, known = model.n, rows is not None
    rows = all_rows(model) if rows is None else rows
    if len(rows) < 2 * n:
        return
    cause = "constraints that fix every coordinate" if known else "constraints that depend on each other"
    fix = "leave one out" + ("" if known else ", or call this outside of jit and vmap, where dependent ones are found")
    raise ValueError(
        f"there are {2 * n} coordinates and velocities, and {len(rows)} equations restrict them: nothing is left to "
        f"move.\nUsual cause: {cause}.\nFix: {fix}."
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
    run = lambda rtol: _period(system, s, nodes, period, rtol, reasons, rows, is_angle, in_a_loop, not eager)
    first = run(rtol)
    if eager:
        second = run(LOOSER * rtol)
        error = np.max(np.abs(np.asarray(first.reduced) - np.asarray(second.reduced)))
        return first, jnp.asarray(error)
    # Only the product of the multipliers is known independently; the error is at least the tolerance of the steps.
    off = jnp.abs(jnp.linalg.det(lax.stop_gradient(first.reduced)) * jnp.exp(-lax.stop_gradient(first.log_volume)) - 1)
    return first, jnp.maximum(off, LOOSER * rtol) * jnp.maximum(1.0, jnp.max(jnp.abs(lax.stop_gradient(first.reduced))))


@compiled
def _period(system, s, nodes, period, rtol, reasons, rows, is_angle, in_a_loop, differentiable) -> Period:
    flow, t = flow_of(model_of(system, *s), rtol, rows, in_a_loop), s.t
    first = flow.vector(s.q, s.v)
    scale = scale_of(first, period)
    first = flow.onto_constraints(t, first, scale)
    nodes = first[None] if nodes is None else nodes.at[0].set(first)
    count = len(nodes)
    times = t + period * jnp.arange(count, dtype=t.dtype) / count
    bases = [flow.tangent_space(t, z, scale) for t, z in zip(times, nodes)]
    part = lambda t, z, basis: flow.passage(t, z, period / count, basis, scale, True, differentiable)
    if count == 1:
        passed = jax.tree.map(lambda x: x[None], part(times[0], nodes[0], bases[0]))
    else:
        passed = jax.vmap(part)(times, nodes, jnp.stack(bases))
    whole, after = jnp.eye(bases[0].shape[1], dtype=t.dtype), [*bases[1:], bases[0]]
    for basis, frame in zip(after, passed.frame):
        whole = basis.T @ frame @ whole
    rows_of, there = orthonormal(reasons, directions(flow, reasons, t, first, scale, bases[0]), TURN / period)
    ended = jnp.all(passed.ended) & jnp.all(jnp.isfinite(whole))
    multipliers, trivial = _sorted(_without(rows_of, whole), jnp.sum(there))
    matrix = scale[:, None] * (bases[0] @ whole @ bases[0].T) / scale[None]
    multipliers = jnp.where(ended, multipliers, jnp.nan)
    apart = _apart(flow, reasons, is_angle, passed.z[-1] - first, scale)
    return Period(multipliers, trivial, there, whole, matrix, jnp.sum(passed.growth), apart, ended)


def _without(rows, matrix):
    """The matrix with eigenvalue 1 in the directions of `rows`, which are decoupled from the rest."""
    rest = jnp.eye(matrix.shape[0], dtype=matrix.dtype) - rows.T @ rows
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
