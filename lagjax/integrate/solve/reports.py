"""Reports on motions: the error of one, by a second run; and how those inside a program went.

The error of a motion is estimated by integrating it a second time, ten times more precisely. A tolerance bounds the
error of a step; no method knows how large the motion lets these errors grow. The same compiled program with tolerances
ten times tighter has a tenth of the error, so that the difference of the two runs is the error of the first, to within
a tenth of it. This holds even if the motion amplifies errors until no digits are left, since it amplifies the
difference alike, and for round-off, which differs between the runs as their steps do.

If something else than the tolerance determined the steps, both runs would take the same ones. So fixed steps are
halved, and so is `max_step` if it limits them; outputs are reached in one step more than before; the first step is
shorter.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.4 (global error by a second tolerance).

Reports on the integrations inside a program are for callers who run it and do not see the trajectories. `reporting`
turns a function that integrates anywhere inside it into one that also returns how its integrations went. While it
traces the function, `integrate` passes every trajectory through `report`, a primitive that does nothing.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.contexts import PATIENCE, REGULAR_FIRST, WATCHED
from lagjax.integrate.results import ENDED_WELL, RESULTS, Errors, columns, ended_well, is_among, scaled_error
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import (
    ClosedJaxpr,
    anywhere,
    applied,
    bodies,
    interpreted,
    is_eager,
    once_per_program,
    poisoned,
    primitive,
    stands_for,
    stop_gradient,
)
from lagjax.refusals import must_be

# The tightest tolerance that is not below round-off.
ROUND_OFFS = 8
TIGHTER = 10.0
# A motion of more steps is integrated again only if the user requests it.
STEPS_AT_MOST = 20_000
# Up to FEW steps per output, outputs may have determined the steps. Since the first steps are short, this share of a
# step per output is not counted.
FEW, UNCOUNTED = 4, 0.2
# The least number of steps per output if there were more than FEW, and the share of the first step that is taken.
MANY, FIRST = 3.0, 0.7
# `max_step` limits the steps if their mean is above this share of it.
LIMITED = 0.7
# Round-off adds at least this many round-offs of a number, times the square root of the number of steps.
ROUND_OFF = 3.0


def steps_to_repeat(estimate: bool | None, controller, progress: bool) -> np.ndarray:
    """Return the most steps of a motion to be integrated again; raise if `estimate` is not None, True or False."""
    kinds = bool | np.bool_ | None
    must_be(kinds, estimate, "estimate_error must be True, False or None", "estimate_error=True, or leave it out")
    ours = controller is None or _fixed(controller)
    by_default = STEPS_AT_MOST if is_eager() and ours and not progress else 0
    limits = {None: by_default, True: np.iinfo(np.int32).max, False: 0}
    return np.asarray(limits[None if estimate is None else bool(estimate)], np.int32)


def with_errors(run: Callable, first: Trajectory, settings, ts: Array) -> Trajectory:
    """Return the trajectory with its errors by `run(settings)`, if it is short enough; not while JAX is tracing."""
    if not is_among(first.result, ENDED_WELL):
        return _unknown(first, first.result)
    steps = int(first.stats["num_accepted_steps"])
    if steps > settings.repeated_up_to or not _can_be_closer(settings):
        return _unknown(first)
    return _compared(np, first, run(_closer(np, settings, steps, np.asarray(first.end.t), ts)), ts)


def with_errors_inside(run: Callable, first: Trajectory, settings, ts: Array) -> Trajectory:
    """Do the same in a traced program, without derivatives of the errors."""
    if not _can_be_closer(settings):
        return _unknown(first)
    known, settings, ts = stop_gradient((first, settings, ts))
    second = stop_gradient(run(_closer(jnp, settings, known.stats["num_accepted_steps"], known.end.t, ts)))
    found = _compared(jnp, known, second, ts)
    excess = jnp.where(ended_well(known.result), found.scaled_error, first.scaled_error)
    return replace(first, error=found.error, scaled_error=excess)


def _fixed(controller):
    return isinstance(controller, diffrax.ConstantStepSize)


def _can_be_closer(settings):
    return settings.controller is None or _fixed(settings.controller) and settings.dt0 is not None


def _closer(xp: ModuleType, settings, steps: Any, end: Any, ts: Array):
    """Return the settings of the second run, after a first one of `steps` steps to the time `end`."""
    if settings.controller is not None:
        return replace(settings, dt0=settings.dt0 / 2)
    # Looser if tighter would be below round-off: the difference is then the error of the second run, the larger one.
    scale = xp.where(settings.rtol / TIGHTER >= ROUND_OFFS * np.finfo(ts.dtype).eps, 1 / TIGHTER, TIGHTER)
    per_output = steps / xp.maximum(1, xp.sum(ts < end))
    limited = steps * settings.max_step * LIMITED <= end - ts[0]
    longest = xp.where(limited, settings.max_step / 2, settings.max_step)
    pieces = xp.where(per_output <= FEW, xp.maximum(1, xp.ceil(per_output - UNCOUNTED)) + 1, MANY)
    values = settings.rtol * scale, settings.atol * scale, longest, xp.stack([xp.asarray(FIRST), 1 / pieces])
    rtol, atol, longest, shares = (x.astype(ts.dtype) for x in values)
    return replace(settings, rtol=rtol, atol=atol, max_step=longest, shares=shares)


def _compared(xp: ModuleType, first, second, ts: Array) -> Trajectory:
    """Return the first trajectory with its errors: the difference of the two, plus the least effect of round-off."""
    steps = xp.asarray(second.stats["num_accepted_steps"])
    share = ROUND_OFF * np.finfo(ts.dtype).eps * xp.sqrt(1.0 + steps)
    x, y, well = _columns(xp, first), _columns(xp, second), True
    if xp is jnp or np.isnan(y).any():
        # The second run, which an event may have ended a little sooner, keeps its last state after its end.
        well = ended_well(second.result) if xp is jnp else is_among(second.result, ENDED_WELL)
        y = xp.where(xp.isnan(y) & well, _columns(xp, second.end), y)
    # Outputs that were not reached are NaN, and come last.
    sizes = np.fmax.accumulate(abs(x)) if xp is np else lax.cummax(jnp.nan_to_num(abs(x)))
    errors = (abs(x - y) + share * sizes).astype(ts.dtype)
    both = {name: (xp.asarray(found.t), xp.asarray(second.events[name].t)) for name, found in first.events.items()}
    times = {name: _of_times(xp, *pair, share) for name, pair in both.items()}
    found = Errors(*_like_trajectory(errors, first), times, second.result, steps)

    def of_motion(row):
        return row[: 2 * sum(np.size(x) for x in jax.tree.leaves(first.end.q))].reshape(2, -1)

    worst = of_motion(np.fmax.reduce(errors) if xp is np else jnp.nanmax(errors, axis=0))
    excess = scaled_error(xp, worst, of_motion(sizes[-1]), first, ts, tuple(map(xp.asarray, first.tolerance)))
    if well is not True:
        # Where the second run failed, no error is known from there on.
        excess = xp.where(well, excess, xp.maximum(excess, xp.asarray(first.scaled_error))).astype(ts.dtype)
    return replace(first, error=found, scaled_error=excess)


def _unknown(first, result=RESULTS.not_estimated) -> Trajectory:
    nothing = jax.tree.map(lambda x: np.full(x.shape, np.nan, x.dtype), (first.q, first.v, first.multipliers))
    times = {name: np.full(found.t.shape, np.nan, found.t.dtype) for name, found in first.events.items()}
    return replace(first, error=Errors(*nothing, times, result, np.zeros((), int)))


def _columns(xp: ModuleType, of):
    """Return coordinates, velocities and multipliers as columns, one row for each instant."""
    return columns(xp, (of.q, of.v, of.multipliers), rows=np.size(of.t))


def _like_trajectory(errors, first):
    leaves, structure = jax.tree.flatten((first.q, first.v, first.multipliers))
    ends = np.cumsum([x.size // len(errors) for x in leaves])
    parts = (errors[:, end - x.size // len(errors) : end].reshape(x.shape) for x, end in zip(leaves, ends))
    return jax.tree.unflatten(structure, parts)


def _of_times(xp: ModuleType, first, second, share: Any):
    found = xp.where(xp.isnan(second), np.inf, abs(first - second) + share * abs(first))
    return xp.where(xp.isnan(first), np.nan, found).astype(first.dtype)


class Report(NamedTuple):
    """How motions went, taken together: the first bad result, all steps, the worst scaled_error and residual.

    `scaled_error`: as in `Trajectory`; `residual`: the worst constraint residual, relative; both at the outputs.
    """

    result: Int[Array, ""]
    steps: Int[Array, ""]
    scaled_error: Float[Array, ""]
    residual: Float[Array, ""]


class Settled(NamedTuple):
    """Whether the robust solve would give the same motion, for one whose equations were assumed regular."""

    settled: Bool[Array, ""]


def report(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory unchanged; under `reporting`, enter its report into the program that is being traced."""

    def of(trajectory):
        t = stop_gradient(trajectory)
        return Report(t.result._value, t.stats["num_steps"], t.scaled_error, t.residual())

    return reported(trajectory, of)


def report_settled(trajectory: Trajectory, settled: Bool[Array, ""]) -> Trajectory:
    """Return a trajectory of equations assumed regular unchanged; enter into the program whether it is settled."""
    return reported(trajectory, lambda _: Settled(settled))


def reported(found: PyTree, of: Callable[[Any], Report | Settled]) -> PyTree:
    """Return `found` unchanged; under `reporting`, enter `of(found)` into the program that is being traced."""
    if not WATCHED.value:
        return found
    # NumPy arrays stay NumPy arrays: windows of a fit, for example.
    arrays, rest = eqx.partition(found, lambda x: isinstance(x, jax.Array))
    leaves, structure = jtu.tree_flatten(arrays)
    mark = of(found)
    kept = _report_p.bind(*map(jnp.asarray, (*leaves, *mark)), kind=type(mark))[: -len(mark)]
    return eqx.combine(jtu.tree_unflatten(structure, kept), rest)


def reporting(function: Callable) -> Callable:
    """Wrap `function` to return its result, a `Report` of the integrations in it, and whether those are settled.

    The report is None without integrations. With `REGULAR_FIRST` the equations of integrations are assumed regular; if
    they are not settled, the result must not be used. `settled` is None if no equations were assumed regular; they are
    not if an integration is inside a loop or a branch, whose inside `reporting` does not see.

    A check of the user's that calls the host (equinox's `error_if`) gives NaN if it fails: one lane must not end the
    others.
    """

    def wrapped(*args):
        program, structure = watched(function, *args)
        program, marks = poisoned(program), []

        def collect(equation: Any, operands: Sequence):
            if equation.primitive is _report_p:
                kind = equation.params["kind"]
                marks.append(kind(*operands[-len(kind._fields) :]))
                return operands
            return applied(program.jaxpr, equation, operands)

        found = interpreted(program, jtu.tree_leaves(args), collect, lambda x, _: x, _reports)
        reports = [x for x in marks if isinstance(x, Report)]
        settled = [jnp.all(x.settled) for x in marks if isinstance(x, Settled)]
        all_settled = jnp.all(jnp.stack(settled)) if settled else None
        return jtu.tree_unflatten(structure, found), _together(reports), all_settled

    return wrapped


def watched(function: Callable, *args) -> tuple[ClosedJaxpr, PyTree]:
    """The program of a function, with the reports of its integrations in it, and the structure of its results."""
    leaves, structure = jtu.tree_flatten(args)
    rest = []

    def of_leaves(*leaves):
        found, shape = jtu.tree_flatten(function(*jtu.tree_unflatten(structure, leaves)))
        rest.append(shape)
        for x in found:
            if not isinstance(x, Array | np.ndarray | np.generic | bool | int | float | complex):
                fix = "a module without its functions, eqx.filter(net, eqx.is_array), or " if callable(x) else ""
                raise TypeError(
                    f"run must return numbers and arrays, and returned {x!r:.60}, a {type(x).__name__}.\n"
                    f"Fix: return {fix}only what differs from point to point."
                )
        return [jnp.asarray(x) for x in found]

    with WATCHED(True):
        program = jax.make_jaxpr(of_leaves)(*leaves)
        if _hides(program.jaxpr):
            with REGULAR_FIRST(False):
                program = jax.make_jaxpr(of_leaves)(*leaves)
    return program, rest[-1]


def in_turn(function: Callable, *args) -> PyTree:
    """`function(*args)`; on a CPU lanes of a `vmap` run one after the other, which compiles once and wastes no steps.

    Motions that a search tries do not report to a surrounding sweep.

    >>> print(jax.vmap(lambda x: in_turn(jnp.sqrt, x))(jnp.array([1.0, 4.0])))
    [1. 2.]
    """
    live, static = eqx.partition(args, eqx.is_array)
    rest = []

    def run(live: PyTree):
        with WATCHED(False), PATIENCE(None):
            found, others = eqx.partition(function(*eqx.combine(live, static)), eqx.is_array)
        rest.append(others)
        return found

    if jax.default_backend() == "cpu":
        run = jax.custom_batching.sequential_vmap(run)
    return eqx.combine(run(jax.tree.map(jnp.asarray, live)), rest[-1])


_has_report = anywhere(lambda equation: equation.primitive is _report_p)
_says_settled = anywhere(lambda equation: equation.primitive is _report_p and equation.params["kind"] is Settled)


def _reports(equation: Any):
    return any(map(_has_report, bodies(equation)))


@once_per_program
def _hides(jaxpr: Any):
    """Whether a motion assumed regular is in a part of the program that the interpreter does not enter."""
    entered = [(equation, stands_for(equation)) for equation in jaxpr.eqns]
    return any(
        any(map(_says_settled, bodies(equation))) if inner is None else _hides(inner.jaxpr)
        for equation, inner in entered
    )


def _together(reports: Sequence):
    if not reports:
        return None
    # The motions inside a derivative are batched: the worst lane counts.
    flat = [Report(*(jnp.ravel(x) for x in report)) for report in reports]
    results, steps, scaled_errors, residuals = (jnp.concatenate(parts) for parts in zip(*flat))
    bad = (results != RESULTS.successful._value) & (results != RESULTS.event_occurred._value)
    scaled_error, worst = jnp.nanmax(scaled_errors), results[jnp.argmax(bad)]
    result = jnp.where(jnp.any(bad) | ~(scaled_error > 1), worst, RESULTS.drifted._value)
    return Report(result, jnp.sum(steps), scaled_error, jnp.nanmax(residuals))


def _batched(operands: Sequence, axes: Sequence, kind: type):
    return _report_p.bind(*operands, kind=kind), axes


def _jvp(primals: Sequence, tangents: Sequence, kind: type):
    return _report_p.bind(*primals, kind=kind), list(tangents)


def _same(*operands, kind: type):
    return list(operands)


_report_p = primitive("report", _same, _same, several=True, jvp=_jvp, batched=_batched)
