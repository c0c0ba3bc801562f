"""Reports on the integrations inside a program, for callers who run the program and do not see the trajectories.

`reporting` turns a function that integrates anywhere inside it into one that also returns how its integrations went.
While it traces the function, `integrate` passes every trajectory through `report`, a primitive that does nothing.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.results import RESULTS
from lagjax.integrate.settings import PATIENCE
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import (
    REGULAR_FIRST,
    WATCHED,
    ClosedJaxpr,
    anywhere,
    applied,
    bodies,
    interpreted,
    once_per_program,
    poisoned,
    primitive,
    stands_for,
    stop_gradient,
)


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
