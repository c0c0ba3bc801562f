"""Write fits into files: everything except functions; a signature identifies those of the system."""

import os
from typing import Any

import jax
import numpy as np

from lagjax.files import npz
from lagjax.files.tree_json import NotGiven, NotWritable, Writer
from lagjax.jaxtools.tracing import is_traced
from lagjax.system.coordinates import State
from lagjax.system.signature import UnknownSystem, signature


def save(fit, path: str | os.PathLike) -> None:
    """Write a fit into a file: see `Fit.save`."""
    if is_traced(fit):
        raise TypeError("this fit is being traced and has no numbers yet.\nFix: save it outside of the program.")
    problem = fit.problem
    # Without phases, `first` is the system itself.
    roles = {id(problem.first): "first", id(problem.system): "system", id(problem.unflatten): "unflatten"}
    if problem.observe is not None:
        roles[id(problem.observe)] = "observe"
    for name, value in problem.options.items():
        if isinstance(value, NotGiven) or not _is_data(value):
            roles[id(value)] = f"options.{name}"
    writer = Writer(lambda value: roles.get(id(value)))
    contents = {"fit": writer.down(fit, ""), "known": writer.down(_known_of_system(fit), "system")}
    contents["q"] = writer.down(jax.tree.map(np.asarray, problem.unflatten(problem.starts.q.guess[0])), "coordinates")
    contents["functions"] = sorted(set(roles.values()) - {"first", "unflatten"})
    npz.write(path, "fit", contents, writer.arrays)


def _is_data(value):
    try:
        Writer().down(value, "")
    except NotWritable:
        return False
    return True


def _known_of_system(fit) -> dict[str, Any]:
    system = fit.problem.system
    if isinstance(system, UnknownSystem):
        return {name: getattr(system, name) for name in system.__dataclass_fields__}
    q, v = jax.tree.map(np.asarray, fit.starts()[0])
    params = jax.tree.map(np.asarray, fit.problem.params(fit.unknowns.shared, 0))
    t = np.asarray(np.asarray(fit.problem.windows.ts)[0, 0], jax.tree.leaves(q)[0].dtype)
    state = State(t, q, v, params)
    phase = int(system.first) if system.in_phases else None
    about = {"words": repr(system), "angles": (), "signature": signature(system, state), "state": tuple(state)}
    return about | {"starts": jax.tree.map(np.asarray, fit.known_starts()), "phase": phase}
