"""Whether a motion goes through, and measurements have the shapes of what it says, or an error in the user's words."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from lagjax.fitting.equations import WHOLE, Problem
from lagjax.fitting.records import channel_name
from lagjax.mechanics import constraints
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.hybrid import phases_of
from lagjax.motion.integrate import integrate


def check_predicted(problem: Problem):
    """Raise where the measurements do not have the shape of what the motion says."""
    begin = jax.tree.map(lambda x: x[0], (problem.starts.q.guess, problem.starts.v.guess))
    q, v = (jax.eval_shape(problem.unflatten, x) for x in begin)
    t, params = jax.ShapeDtypeStruct((), problem.windows.ts.dtype), problem.found.params

    def one_time(t, q, v, params):
        shapes = [constraints.shapes(phase, t, q, v, params) for phase in phases_of(problem.system)]
        multipliers = {name: jnp.zeros(shape) for phase in shapes for name, shape in phase.items()}
        said = {"q": q, "v": v, "multipliers": multipliers}
        if problem.observe is not None:
            said["observed"] = problem.observe(t, q, v, params)
        return said | {"end": {"t": t, **said}}

    said = eqx.filter_eval_shape(one_time, t, q, v, params)
    for kind, tree in problem.measured.items():
        _match(kind, said[kind], tree, 1 if kind == "end" else 2)


def _match(kind: str, said: Any, measured: Any, axes: int, path=()):
    if isinstance(measured, dict) and isinstance(said, dict):
        for name, part in measured.items():
            if name not in said:
                raise ValueError(
                    f"'{name}' was measured as {kind}, and there {listed(list(said))}.\n"
                    f"Fix: name what the motion has: {kind}={{{list(said)[0]!r}: ...}}."
                )
            _match(kind, said[name], part, axes, (*path, jtu.DictKey(name)))
        return
    found, wanted = jtu.tree_structure(said), jtu.tree_structure(measured)
    if found != wanted:
        raise ValueError(
            f"{kind} was measured as {wanted}, and the motion has {found}.\nFix: give it in that structure."
        )
    for x, y in zip(jtu.tree_leaves(said), jtu.tree_leaves(measured)):
        if x.shape != y.shape[axes:]:
            raise ValueError(
                f"'{channel_name(kind, path)}' was measured with the shape {y.shape[axes:]} at each time, and the "
                f"motion has {x.shape}.\nUsual cause: an array of one entry where a number is meant."
            )


def check_motion(problem, well, u):
    """Raise, in the words of the integration, where a motion fails."""
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
        "Fix: guess params, q0 and v0 nearer to the truth; try them with lj.integrate first."
    )
