"""The motion between outputs, by steps of the method itself from the output before.

A trajectory keeps only the requested outputs, and outputs are ends of steps. A polynomial through them would have an
order of its own, and be wrong if the motion turned between two of them. So the motion is continued from the last output
before the requested time, with the method, the tolerances and the longest step that it was integrated with: the result
has the order of the method and satisfies the constraints. It costs one short solve for each time; the program is
compiled once for a system and then serves all times and all of its trajectories.

At the time of an output the result is that output. A solve of length zero would have no derivative with respect to
time; a step of length zero of the classical Runge-Kutta method has the first four of them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Float, Int, PyTree

from lagjax.integrate.problem import Problem
from lagjax.integrate.results import ENDED_WELL, HELD_BY_OTHERS, NO_PHASE, Snapshot, SolveOptions, in_words
from lagjax.integrate.settings import Settings, patient
from lagjax.integrate.stepping import WHOLE_STEPS, Forced, rounded, span_of
from lagjax.jaxtools import compiled, filled_up, is_eager, is_traced, numpy_of, to_jax
from lagjax.mechanics import accelerations
from lagjax.refusals import must, must_be_single
from lagjax.system import InModes, System, given_in

# Controllers that can begin at any time; others plan the steps of the whole motion.
BEGIN_ANYWHERE = type(None), diffrax.PIDController, diffrax.ConstantStepSize, diffrax.ClipStepSizeController
# Times within this many round-offs are the same: a user may compute the end of a motion in another way.
SAME = 4
# If the result is the output itself, the continuation, which is not used, is this part of the motion long.
ASIDE = 1e-6
MAX_STEPS = 2**20
# The number of times solved for in one batch: each then takes 7 microseconds, or 20 alone, if one step is enough.
LANES = 256
IN_PHASES = (
    "a motion in phases between its outputs needs the values of its switches, but this one is being traced, or a "
    "batch.\nFix: take one motion outside the program; or give these times to lj.integrate as ts."
)


class Instants(NamedTuple):
    """The instants from which a motion can be continued, in the order of its run: outputs and states after switches.

    `phase`: the number of the phase that begins or goes on there; None for a motion without phases. `modes`: likewise
    those of elements.
    """

    at: Snapshot
    is_output: np.ndarray | None = None
    phase: Int[Array, " N"] | None = None
    modes: Int[Array, "N k"] | None = None


def at(trajectory, t: ArrayLike) -> Snapshot:
    """Return the motion at times of any shape: see `Trajectory.at`."""
    _check_can_be_continued(trajectory)
    dtype = trajectory.t.dtype
    t = _times(t, dtype)
    if not is_eager() or is_traced((trajectory, t)):
        return _at_all(trajectory, t)
    if trajectory.t.ndim > 1:
        _check_inside(t, np.asarray(trajectory.t)[..., 0], np.asarray(trajectory.t)[..., -1])
        return _at_all(trajectory, t)
    _check_ended(trajectory, t)
    times = t.ravel()
    known = _known_of(trajectory)
    index = _before(known, times, trajectory.static.how.backward)
    nodes, modes = jax.tree.map(lambda x: np.asarray(x)[index], (known.at, known.modes))
    found = jax.tree.map(np.array, nodes._replace(t=times))
    between = np.flatnonzero(nodes.t != times)
    for phase in [None] if known.phase is None else np.unique(np.asarray(known.phase)[index[between]]):
        rows = between if phase is None else between[np.asarray(known.phase)[index[between]] == phase]
        if rows.size:
            here = jax.tree.map(lambda x, rows=rows: x[rows], (nodes, modes))
            _fill(found, rows, trajectory, phase, *here, times[rows])
    return jax.tree.map(lambda x: to_jax(x.reshape(t.shape + x.shape[1:])), found)


def _fill(found, rows, trajectory, phase, nodes: Snapshot, modes: Int[Array, "N k"] | None, times):
    """Write the motion at `times`, all in one phase, into the rows `rows` of `found`."""
    system = trajectory.system if phase is None else trajectory.system.systems[phase]
    given = None if modes is None else trajectory.system.given(None, modes, phase)
    multipliers = {name: x for name, x in nodes.multipliers.items() if name in system.constraints}
    # Padded to one of a few sizes, since a program is compiled for each size.
    count = filled_up(len(times)) if len(times) <= LANES else LANES * filled_up(-(-len(times) // LANES))
    fill = np.minimum(np.arange(count), len(times) - 1)
    nodes = nodes._replace(multipliers=multipliers)
    nodes, given, times = jax.tree.map(lambda x: x[fill], (nodes, given, times))
    of_system = system, trajectory.params, trajectory.asked, trajectory.tolerance
    ends = np.asarray(trajectory.t)[[0, -1]]
    new, result = _continue_all(*of_system, nodes, given, times, ends, trajectory.static.integrate)
    # Padded as well, for the same reason.
    acting = {} if given is None else of_elements(trajectory, phase, times, *new[1:], given.modes)
    new, result, acting = jax.tree.map(lambda x: np.asarray(x)[: rows.size], (new, result, acting))
    # Not `ended_well`, which would compile a comparison for each number of times.
    well = np.isin(result._value, [int(good._value) for good in ENDED_WELL])
    if not well.all():
        _raise_not_continued(nodes.t, times, result._value, int(np.argmin(well)))
    for name, x in found.multipliers.items():
        x[rows] = new.multipliers[name] if name in multipliers else np.nan
    if given is not None:
        for name, x in acting.items():
            found.multipliers[name][rows] = x
        # Where others hold what would slide, the direction of its friction is known at outputs alone.
        slips = np.char.startswith(np.array(trajectory.system.laws[phase].kinds, str), "sliding velocity")
        held = np.any((np.asarray(given.modes)[: rows.size] == HELD_BY_OTHERS) & slips, axis=1)
        for x in found.multipliers.values():
            x[rows[held]] = np.nan
    for old, x in zip(jax.tree.leaves((found.q, found.v)), jax.tree.leaves((new.q, new.v))):
        old[rows] = x


def of_elements(trajectory, phase: int, times, q: PyTree, v: PyTree, multipliers: dict, modes) -> dict[str, Array]:
    """The forces of compliant contacts, and of friction, at these states of a phase, by name; `modes`: its own."""
    laws = trajectory.system.laws[phase]
    known = laws.compliant or laws.tangents
    return _acting(laws, trajectory.params, times, q, v, multipliers, modes) if known else {}


@compiled
def _acting(laws, params: PyTree, times: Array, q: PyTree, v: PyTree, multipliers: dict, modes: Array):
    def forces(t: Array, q: PyTree, v: PyTree, multipliers: dict, modes: Array) -> dict[str, Array]:
        return laws.acting(t, q, v, multipliers, laws.given(params, modes))

    return jax.vmap(forces)(times, q, v, multipliers, modes)


def _known_of(trajectory) -> Instants:
    outputs = Snapshot(trajectory.t, trajectory.q, trajectory.v, trajectory.multipliers)
    if not trajectory.in_phases:
        return Instants(outputs)
    outputs = jax.tree.map(np.asarray, outputs)
    s, count = trajectory.switches, len(trajectory.switches)
    unknown = {name: np.full((count, *x.shape[1:]), np.nan) for name, x in outputs.multipliers.items()}
    after = jax.tree.map(lambda x: np.asarray(x)[:count], (s.t, s.q_after, s.v_after))
    reached = np.asarray(trajectory.phase) != NO_PHASE
    both = jax.tree.map(
        lambda a, b: np.concatenate([a[reached], b]).astype(a.dtype), outputs, Snapshot(*after, unknown)
    )
    phase = np.concatenate([np.asarray(trajectory.phase)[reached], np.asarray(s.to)[:count]])
    is_output = np.arange(len(phase)) < reached.sum()
    # An output at the time of a switch comes before it.
    order = np.lexsort((np.arange(len(phase)), both.t))
    modes = None
    if trajectory.modes is not None:
        modes = np.concatenate([np.asarray(trajectory.modes)[reached], np.asarray(s.modes)[:count]])[order]
    return Instants(jax.tree.map(lambda x: x[order], both), is_output[order], phase[order], modes)


def _before(known: Instants, t, backward: bool):
    """Return for each time the index of the last instant, at or before it, from which the motion can be continued.

    A switch does not count at its own time, when the motion is still before it.
    """
    xp: Any = numpy_of((known.at.t, t))
    sign = -1 if backward else 1
    times = xp.asarray(known.at.t)
    index = xp.searchsorted(sign * times, sign * t, side="right") - 1
    if known.is_output is not None:
        first = xp.searchsorted(times, t, side="left")
        here = np.minimum(first, len(times) - 1)
        index = np.where((times[here] == t) & known.is_output[here], here, first - 1)
    return xp.clip(index, 0, len(times) - 1)


@partial(compiled, in_line=True)
def _at_all(trajectory, t):
    """Return the motion at t, of lanes as well, in a program: NaN where there is no motion."""
    if trajectory.in_phases:
        raise TypeError(IN_PHASES)
    of_one = partial(_at_one, trajectory)
    for _ in range(t.ndim):
        of_one = jax.vmap(of_one)
    if trajectory.t.ndim == 1:
        return of_one(t)
    return jax.vmap(lambda lane: _at_all(lane, t))(trajectory)


def _at_one(trajectory, t):
    sign = -1 if trajectory.static.how.backward else 1
    first, last = trajectory.t[0], trajectory.end.t
    slack = _slack(first, trajectory.t[-1])
    inside = (sign * (t - first) >= -slack) & (sign * (last - t) >= -slack)
    low, high = jnp.minimum(first, last), jnp.maximum(first, last)
    # Not `clip`, whose derivative is one half at its ends.
    near = jnp.where(t < low, low, jnp.where(t > high, high, t))
    known = _known_of(trajectory)
    index = _before(known, lax.stop_gradient(near), trajectory.static.how.backward)
    node = jax.tree.map(lambda x: jnp.asarray(x)[index], known.at)
    exact = node.t == near
    aside = node.t + sign * ASIDE * lax.stop_gradient(jnp.abs(trajectory.t[-1] - first))
    of_system = trajectory.system, trajectory.params, trajectory.asked, trajectory.tolerance
    found, _ = _continued(*of_system, node, jnp.where(exact, aside, near), trajectory.static.integrate)
    # The requested time, even if it is a round-off beyond the end.
    there = _of_length_zero(trajectory.system, trajectory.params, node, jnp.where(exact, t, node.t))
    chosen = jax.tree.map(lambda a, b: jnp.where(inside, jnp.where(exact, a, b), jnp.nan), there, found)
    return chosen._replace(t=t)


def _continued(
    system: System, params: PyTree, asked: SolveOptions, tolerance, node: Snapshot, t, integrate: Callable,
    forced: Forced | None = None,
):  # fmt: skip
    """Continue the motion from a node to t; return it there, and the result."""
    found, result = _solved_from(system, params, asked, tolerance, node, t[None], integrate, forced)
    return jax.tree.map(lambda x: x[-1], found)._replace(t=t), result


def in_one_solve(trajectory, t):
    """The motion at times (N,), in its own order, by one solve from its start, while JAX traces; NaN where it fails.

    The span stays that of the trajectory, on which some settings depend.
    """
    if trajectory.in_phases:
        raise TypeError(IN_PHASES)
    first = jax.tree.map(lambda x: x[0], _known_of(trajectory).at)
    of_system = trajectory.system, trajectory.params, trajectory.asked, trajectory.tolerance
    ts = jnp.append(t, trajectory.t[-1])
    found, _ = _solved_from(*of_system, first, ts, trajectory.static.integrate)
    return jax.tree.map(lambda x: x[1:-1], found)


def _solved_from(
    system: System, params: PyTree, asked: SolveOptions, tolerance, node: Snapshot, ts, integrate: Callable,
    forced: Forced | None = None,
):  # fmt: skip
    """Integrate from a node to the times ts, (N,); return the motion at the node and at these, and the result.

    `forced`: the accelerations of forces that may cancel.
    """
    rtol, atol = tolerance
    by_size = atol.ndim == 2
    settings = Settings(
        method=asked.method,
        controller=asked.stepsize_controller,
        event=None,
        adjoint=None,
        rtol=rtol,
        atol=rtol if by_size else atol,
        dt0=asked.dt0,
        max_step=asked.max_step,
        jump_ts=asked.jump_ts,
        shares=np.array(WHOLE_STEPS, node.t.dtype),
        repeated_up_to=np.zeros((), np.int32),
        by_size=by_size,
        apart=True,
        max_steps=patient(MAX_STEPS),
        drift=asked.drift if system.constraints else "none",
        progress=False,
        jumps=asked.jumps,
        forced=forced,
    )
    ts = jnp.append(node.t, ts)
    found = integrate(Problem(system, node.q, node.v, params, ts, None, settings))
    return Snapshot(ts, found.q, found.v, found.multipliers), found.result


@partial(compiled, in_numpy=True)
def _continue_all(
    system: System, params: PyTree, asked: SolveOptions, tolerance, nodes: Snapshot, given: InModes | None, times, ends,
    integrate: Callable,
):  # fmt: skip
    forced = None if given is None else _forced(tolerance, ends)

    def one(each: tuple):
        node, row, t = each
        return _continued(system, given_in(row, params), asked, tolerance, node, t, integrate, forced)

    return lax.map(one, (nodes, given, times), batch_size=min(LANES, len(times)))


def _forced(tolerance, ends: Float[Array, " 2"]) -> Forced | None:
    """The accelerations of forces that may cancel in a motion between these times, as its tolerance knows them."""
    _, nothing = tolerance
    if nothing.ndim < 2:
        return None
    a = rounded(nothing[1]) / span_of(ends)
    return Forced(ends, jnp.stack([a, a]))


def _of_length_zero(system: System, params: PyTree, node: Snapshot, t):
    """Return the node itself, with its derivatives with respect to t, which equals its time."""
    h = t - node.t

    def rate(dt, y: PyTree):
        return y[1], accelerations(system, node.t + dt, *y, params)[0]

    def moved(dt, slope):
        return jax.tree.map(lambda y, k: y + dt * k, (node.q, node.v), slope)

    k1 = rate(0.0 * h, (node.q, node.v))
    k2 = rate(h / 2, moved(h / 2, k1))
    k3 = rate(h / 2, moved(h / 2, k2))
    k4 = rate(h, moved(h, k3))
    slope = jax.tree.map(lambda a, b, c, d: (a + 2 * b + 2 * c + d) / 6, k1, k2, k3, k4)
    q, v = moved(h, slope)
    if not node.multipliers:
        return Snapshot(t, q, v, {})
    _, multipliers = accelerations(system, t, q, v, params)
    # The multipliers as computed at the output, bit for bit.
    known = jax.tree.map(lax.stop_gradient, node.multipliers)
    exactly = jax.tree.map(lambda known, x: known + (x - lax.stop_gradient(x)), known, multipliers)
    return Snapshot(t, q, v, exactly)


def _check_can_be_continued(trajectory):
    if trajectory.in_phases:
        must_be_single(trajectory.t.shape[:-1], "this motion in phases", "{traj}.at(t)")
    asked = trajectory.asked
    instead = "Fix: give these times to lj.integrate as ts."
    if asked.drift == "baumgarte" or asked.drift == "none" and _has_constraints(trajectory.system):
        raise ValueError(
            f'at(t) is not available for a motion with drift="{asked.drift}": its outputs are off the constraints, '
            f"and no motion can start there.\n{instead}"
        )
    if not isinstance(asked.stepsize_controller, BEGIN_ANYWHERE):
        raise ValueError(
            f"{type(asked.stepsize_controller).__name__} plans the steps of the whole motion, which cannot be "
            f"continued from an output in the middle.\n{instead}"
        )


def _has_constraints(system: System):
    return any(phase.constraints for phase in system.phases)


def _check_ended(trajectory, t):
    first, last, end = (float(x) for x in (*np.asarray(trajectory.t)[[0, -1]], trajectory.end.t))
    _check_inside(t, first, last)
    beyond = np.abs(t - first) > np.abs(end - first) + _slack(first, last)
    if np.any(beyond) or not np.isfinite(end):
        where = f"t = {t[beyond].flat[0]:.9g}" if np.any(beyond) else "this time"
        raise ValueError(
            f"the motion ended at t = {end:.9g} ({in_words(trajectory.result._value)}), before {where}.\n"
            "Fix: times up to traj.end.t; traj.result says what went wrong, and an event ends a motion if its "
            "lj.Crossing is terminal."
        )


def _times(t, dtype: np.dtype):
    given, t = t, numpy_of(t).asarray(t)
    real = jnp.issubdtype(t.dtype, jnp.floating) or jnp.issubdtype(t.dtype, jnp.integer)
    must(real, "t must be a time or an array of times", given, "traj.at(0.5)", error=TypeError)
    return t.astype(dtype)


def _check_inside(t, first, last):
    """Raise for a time outside the motion from `first` to `last`."""
    low, high = np.min(np.minimum(first, last)), np.max(np.maximum(first, last))
    slack = _slack(low, high)
    with np.errstate(invalid="ignore"):
        outside = ~((t >= low - slack) & (t <= high + slack))
    if np.any(outside):
        raise ValueError(
            f"t = {t[outside].flat[0]:.9g} is outside of the motion, which is known from t = {low:.9g} to {high:.9g}.\n"
            "Usual cause: another unit of time, or an end that was meant to be later.\n"
            "Fix: integrate for longer, with ts up to there."
        )


def _slack(first, last):
    xp: Any = numpy_of((first, last))
    return SAME * xp.finfo(xp.asarray(first).dtype).eps * xp.maximum(xp.abs(first), xp.abs(last))


def _raise_not_continued(nodes, times, codes, bad):
    raise RuntimeError(
        f"the motion cannot be continued from its output at t = {float(nodes[bad]):.9g} to t = "
        f"{float(times[bad]):.9g}: {in_words(codes[bad])}\n"
        "Fix: give this time to lj.integrate as one of ts."
    )
