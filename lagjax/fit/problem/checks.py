"""Check that a motion reaches its end and that measurements have the shapes of its predictions, in the user's words."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, PyTree

from lagjax.fit.problem.records import channel_name
from lagjax.fit.problem.residuals import WHOLE, FitProblem
from lagjax.integrate import integrate
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns
from lagjax.system import model_of


def check_predicted(problem: FitProblem):
    """Raise if the measurements do not have the shapes of the motion's predictions."""
    begin = jax.tree.map(lambda x: x[0], (problem.starts.q.guess, problem.starts.v.guess))
    q, v = (jax.eval_shape(problem.unflatten, x) for x in begin)
    t, params = jax.ShapeDtypeStruct((), problem.windows.ts.dtype), problem.found.params

    def one_time(t: Array, q: PyTree, v: PyTree, params: PyTree):
        phases = model_of(problem.system, t, q, v, params).phases
        multipliers = {name: jnp.asarray(x) for phase in phases for name, x in phase.zero_multipliers().items()}
        values = {"q": q, "v": v, "multipliers": multipliers}
        if problem.observe is not None:
            values["observed"] = problem.observe(t, q, v, params)
        return values | {"end": {"t": t, **values}}

    predicted = eqx.filter_eval_shape(one_time, t, q, v, params)
    for kind, tree in problem.measured.items():
        _check_match(kind, predicted[kind], tree, 1 if kind == "end" else 2)


def _check_match(kind: str, predicted: Any, measured: Any, axes: int, path: tuple[Any, ...] = ()):
    if isinstance(measured, dict) and isinstance(predicted, dict):
        for name, part in measured.items():
            if name not in predicted:
                raise ValueError(
                    f"'{name}' was measured as {kind}, but the motion has no such name: {listed(list(predicted))}.\n"
                    f"Fix: use the motion's names: {kind}={{{list(predicted)[0]!r}: ...}}."
                )
            _check_match(kind, predicted[name], part, axes, (*path, jtu.DictKey(name)))
        return
    structure, wanted = jtu.tree_structure(predicted), jtu.tree_structure(measured)
    if structure != wanted:
        raise ValueError(
            f"{kind} was measured as {wanted}, but the motion has {structure}.\nFix: give it in that structure."
        )
    for x, y in zip(jtu.tree_leaves(predicted), jtu.tree_leaves(measured)):
        if x.shape != y.shape[axes:]:
            raise ValueError(
                f"'{channel_name(kind, path)}' was measured with the shape {y.shape[axes:]} at each time, but the "
                f"motion has {x.shape}.\nUsual cause: an array of one entry in place of a number."
            )


def check_motion(problem: FitProblem, well: Bool[Array, " W"], u: Unknowns):
    """Raise if a motion fails, with the message of `integrate`."""
    failed = np.flatnonzero(~np.asarray(well))
    if not failed.size:
        return
    w = int(failed[0])
    ts, params, (q, v), options = problem.setting(u.shared, u.local[w], w, WHOLE)
    reason = "it stops early"
    try:
        integrate(problem.system, q, v, params, ts=ts, **(options | {"throw": True}))
    except (ValueError, RuntimeError) as error:
        reason = str(error)
    raise ValueError(
        f"from the guess the motion of record {int(problem.windows.record[w])} fails: {reason}\n"
        "Fix: better guesses of params, q0 and v0; try them with lj.integrate first."
    )
