"""Trajectories written into files: everything except the functions of their system, of which a signature is kept."""

import os
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.core import Tracer

from lagjax.files import Writer, npz
from lagjax.integrate.error_report import angle_mask
from lagjax.integrate.results import RESULTS
from lagjax.system import UnknownSystem, middle_state, signature

# Fields that are arrays or trees of arrays, the same in the trajectory and in the file.
PLAIN = "t", "q", "v", "multipliers", "stats", "scaled_error", "tolerance"


def save(trajectory, path: str | os.PathLike) -> None:
    """Write a trajectory into a file: see `Trajectory.save`."""
    _check_known(trajectory)
    writer, known = Writer(), described(trajectory)
    nodes = {name: writer.down(x, name) for name, x in parts(trajectory, result_in_names).items()}
    nodes["system"] = writer.down(_fields(known), "system")
    npz.write(path, "trajectory", {"trajectory": nodes}, writer.arrays)


def parts(trajectory, of_result: Callable) -> dict[str, Any]:
    """All parts of a trajectory except its system, by name; `of_result(result)` is written for a result."""
    tree: dict[str, Any] = {name: getattr(trajectory, name) for name in PLAIN}
    tree |= {"end": trajectory.end._asdict(), "events": {n: _fields(x) for n, x in trajectory.events.items()}}
    tree |= {"params": trajectory.params, "asked": trajectory.asked._asdict()}
    tree |= {"how": trajectory.static.how._asdict(), "result": of_result(trajectory.result)}
    error = trajectory.error
    tree["error"] = None if error is None else error._asdict() | {"result": of_result(error.result)}
    if hasattr(trajectory, "phase"):
        tree |= {"phase": trajectory.phase, "switches": _fields(trajectory.switches), "modes": trajectory.modes}
    return tree


def described(trajectory) -> UnknownSystem:
    """The description of a trajectory's system that a file keeps."""
    system = trajectory.any_system
    if isinstance(system, UnknownSystem):
        return system
    if 0 in np.shape(trajectory.t):
        return UnknownSystem(repr(system), (), {}, None)
    # In a batch the numbers of the system have its axes too.
    first = (0,) * (np.ndim(trajectory.t) - 1)
    one = jax.tree.map(lambda x: x[first] if isinstance(x, (jax.Array, np.ndarray)) else x, trajectory)
    state = middle_state(one.t, one.q, one.v, one.params)
    angles = tuple(map(bool, angle_mask(one)))
    return UnknownSystem(repr(system), angles, signature(one.any_system, state), tuple(state))


def _check_known(trajectory):
    if any(isinstance(x, Tracer) for x in jax.tree.leaves(trajectory)):
        raise TypeError(
            "this trajectory is being traced, and has no numbers yet.\n"
            "Fix: return it from the traced function, and save it then."
        )


def _fields(module) -> dict:
    """The fields of a module, by name."""
    return {name: getattr(module, name) for name in module.__dataclass_fields__}


def result_in_names(result: Any) -> dict[str, Any]:
    """Results by their names, which are stable; their numbers may differ in another version."""
    codes = np.asarray(result._value)
    names = {int(x._value): name for name, x in RESULTS._name_to_item.items()}
    return {"codes": result._value, "names": {str(code): names[int(code)] for code in np.unique(codes)}}
