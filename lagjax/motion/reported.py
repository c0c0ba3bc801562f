"""How each motion inside a program went, for those who run the program and not the motion.

`reporting` turns a function that integrates, wherever in it, into one that says how its integrations went, too. While
it traces the function, `integrate` passes every trajectory through a primitive that does nothing, `report`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.jax_internals.one_function import poisoned
from lagjax.jax_internals.primitives import primitive
from lagjax.jax_internals.programs import applied, bodies, equations, interpreted, stands_for
from lagjax.jax_internals.tracing import REGULAR_FIRST, WATCHED
from lagjax.motion.consistency import stopped
from lagjax.motion.results import RESULTS
from lagjax.motion.trajectory import Trajectory

# In a program for many lanes that wait for each other, the steps after which a motion is given up, to be run alone.
PATIENCE = jax.make_user_context(default_value=None)


class Report(NamedTuple):
    """How motions went: together the first result that was not good, all steps, the worst scaled_error and residual.

    `scaled_error` is that of a `Trajectory`; `residual` the worst of the constraints at the outputs, relative.
    """

    result: Int[Array, ""]
    steps: Int[Array, ""]
    scaled_error: Float[Array, ""]
    residual: Float[Array, ""]


class Settled(NamedTuple):
    """Whether a motion that was taken for regular would be the same with the robust way."""

    settled: Bool[Array, ""]


def report(trajectory: Trajectory) -> Trajectory:
    """The trajectory, unchanged; where somebody watches, its report is put down in the program that is being traced."""

    def of(trajectory):
        t = stopped(trajectory)
        return Report(t.result._value, t.stats["num_steps"], t.scaled_error, t.residual())

    return reported(trajectory, of)


def report_settled(trajectory: Trajectory, settled: Bool[Array, ""]) -> Trajectory:
    """The trajectory of what was taken for regular, unchanged; whether it is settled is put down in the program."""
    return reported(trajectory, lambda _: Settled(settled))


def reported(found: PyTree, of: Callable[[Any], Report | Settled]) -> PyTree:
    """What was found, unchanged; where somebody watches, `of(found)` is put down in the program."""
    if not WATCHED.value:
        return found
    # NumPy arrays stay what they are: windows of a fit, for example.
    arrays, rest = eqx.partition(found, lambda x: isinstance(x, jax.Array))
    leaves, structure = jtu.tree_flatten(arrays)
    told = of(found)
    kept = _report_p.bind(*map(jnp.asarray, (*leaves, *told)), kind=type(told))[: -len(told)]
    return eqx.combine(jtu.tree_unflatten(structure, kept), rest)


def patient(max_steps: int | None) -> int | None:
    """The steps that a motion may take here and now."""
    limits = [limit for limit in (max_steps, PATIENCE.value) if limit is not None]
    return min(limits, default=None)


def reporting(function: Callable) -> Callable:
    """`function`, returning what it returned, a `Report` of the integrations in it, and whether those are settled.

    The report is None where there are no integrations. With `REGULAR_FIRST` integrations are taken for regular; where
    they are not settled, what was returned is not to be used. It is None where none was taken for regular: also where
    one is inside a loop or a branch, from which nobody is told.

    A check of the user's that calls the host (equinox's `error_if`) gives NaN where it fails: one lane must not end the
    others.
    """

    def wrapped(*args):
        leaves, structure = jtu.tree_flatten(args)
        rest = []

        def of_leaves(*leaves):
            found, shape = jtu.tree_flatten(function(*jtu.tree_unflatten(structure, leaves)))
            rest.append(shape)
            for x in found:
                if not isinstance(x, Array | np.ndarray | np.generic | bool | int | float | complex):
                    raise TypeError(
                        f"run must return numbers and arrays, and returned {x!r:.60}, a {type(x).__name__}.\n"
                        "Fix: return only what differs from point to point."
                    )
            return [jnp.asarray(x) for x in found]

        with WATCHED(True):
            program = jax.make_jaxpr(of_leaves)(*leaves)
            if _hides(program.jaxpr):
                with REGULAR_FIRST(False):
                    program = jax.make_jaxpr(of_leaves)(*leaves)
        program, marks = poisoned(program), []

        def told(equation, operands):
            if equation.primitive is _report_p:
                kind = equation.params["kind"]
                marks.append(kind(*operands[-len(kind._fields) :]))
                return operands
            return applied(program.jaxpr, equation, operands)

        found = interpreted(program, leaves, told, lambda x, _: x, _reports)
        reports = [x for x in marks if isinstance(x, Report)]
        settled = [jnp.all(x.settled) for x in marks if isinstance(x, Settled)]
        all_settled = jnp.all(jnp.stack(settled)) if settled else None
        return jtu.tree_unflatten(rest[0], found), _together(reports), all_settled

    return wrapped


def _reports(equation):
    return any(inner.primitive is _report_p for body in bodies(equation) for inner in equations(body))


def _hides(jaxpr):
    """Whether a motion that was taken for regular is in a part of a program that is not entered."""
    entered = [(equation, stands_for(equation)) for equation in jaxpr.eqns]
    return any(_reports_settled(equation) if inner is None else _hides(inner.jaxpr) for equation, inner in entered)


def _reports_settled(equation):
    inside = (inner for body in bodies(equation) for inner in equations(body))
    return any(inner.primitive is _report_p and inner.params["kind"] is Settled for inner in inside)


def _together(reports):
    if not reports:
        return None
    # A derivative inside has lanes of its own: the worst of them counts.
    flat = [Report(*(jnp.ravel(x) for x in told)) for told in reports]
    results, steps, scaled_errors, residuals = (jnp.concatenate(parts) for parts in zip(*flat))
    bad = (results != RESULTS.successful._value) & (results != RESULTS.event_occurred._value)
    scaled_error, worst = jnp.nanmax(scaled_errors), results[jnp.argmax(bad)]
    result = jnp.where(jnp.any(bad) | ~(scaled_error > 1), worst, RESULTS.drifted._value)
    return Report(result, jnp.sum(steps), scaled_error, jnp.nanmax(residuals))


def _batched(operands, axes, kind):
    return _report_p.bind(*operands, kind=kind), axes


def _jvp(primals, tangents, kind):
    return _report_p.bind(*primals, kind=kind), list(tangents)


_same = lambda *operands, kind: list(operands)
_report_p = primitive("report", _same, _same, several=True, jvp=_jvp, batched=_batched)
