"""A trajectory as data: in a file, and as an xarray.Dataset with the user's names.

A file has everything except the functions of the system, of which a signature is kept.

The variables of a dataset are named as in the trajectory (`q.x`, `v.x`), multipliers like their constraints. The
dimension of outputs is `t`; the axes of an array coordinate are named after it with a number, `r_0`, and q and v share
them.
"""

import os
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.files import Writer, npz
from lagjax.integrate.results import RESULTS, angle_mask, in_words
from lagjax.refusals import installed, must_have_values
from lagjax.system import UnknownSystem, middle_state, signature

# Fields that are arrays or trees of arrays, the same in the trajectory and in the file.
PLAIN = "t", "q", "v", "multipliers", "stats", "scaled_error", "tolerance"


def save(trajectory, path: str | os.PathLike) -> None:
    """Write a trajectory into a file: see `Trajectory.save`."""
    fix = "return it from the traced function, and save it then"
    must_have_values(trajectory, "a trajectory is saved by its values", fix)
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


def _fields(module) -> dict:
    """The fields of a module, by name."""
    return {name: getattr(module, name) for name in module.__dataclass_fields__}


def result_in_names(result: Any) -> dict[str, Any]:
    """Results by their names, which are stable; their numbers may differ in another version."""
    codes = np.asarray(result._value)
    names = {int(x._value): name for name, x in RESULTS._name_to_item.items()}
    return {"codes": result._value, "names": {str(code): names[int(code)] for code in np.unique(codes)}}


# The counts that a trajectory keeps for each motion.
COUNTS = "num_steps", "num_accepted_steps", "num_rejected_steps"

MODES = {
    "of_gaps": "0 open, 1 closed",
    "of_sliding_velocities": "1 and -1 slides, 2 sticks, 3 is held by others, 0 free",
}


def dataset(trajectory, dims: Sequence[str] | None = None, under: str = ""):
    """Return a trajectory, or a batch of them, as an `xarray.Dataset`.

    **Arguments:** `dims`: the names of a batch's axes, which come first; by default "batch", or "batch_0" and so on.
    `under`: the prefix of every name, such as `"motion."`, if several trajectories share a dataset.

    **Raises:** `ImportError` without xarray; `ValueError` if there are not as many names as axes.
    """
    xarray = installed("xarray", "this", "data")
    lead, variables = dims_of(trajectory, dims), {}
    t, coords = f"{under}t", {}
    times = np.asarray(trajectory.t)
    shared = times.reshape(-1, times.shape[-1])
    if len(shared) and np.array_equal(shared, np.broadcast_to(shared[0], shared.shape), equal_nan=True):
        coords[t] = (t, shared[0])
    else:
        variables[f"{under}times"] = ((*lead, t), times)
    for name, names, x in outputs(trajectory):
        variables[under + name] = ((*lead, t, *names), x)
    for name, names, x in of_motions(trajectory):
        variables[under + name] = ((*lead, *names), x)
    if lead:
        for name, names, x in parameters(trajectory):
            variables[under + name] = ((*lead, *names), x)
    found = xarray.Dataset(variables, coords, attributes(trajectory))
    codes = np.unique(np.asarray(trajectory.result._value))
    meanings = [in_words(code) for code in codes]
    found[f"{under}result"].attrs = {"flag_values": codes, "flag_meanings": " ".join(map(_one_word, meanings))}
    if f"{under}phase" in found:
        names = trajectory.switches.names
        flags = {"flag_values": np.arange(len(names)), "flag_meanings": " ".join(map(_one_word, names))}
        found[f"{under}phase"].attrs = flags
    if f"{under}modes" in found:
        found = found.assign_coords({"mode": [name for name, _ in trajectory.switches.of_modes]})
        found[f"{under}modes"].attrs = MODES
    return found


def dims_of(trajectory, dims: Sequence[str] | None) -> tuple[str, ...]:
    """Return the names of the axes of a batch."""
    count = np.ndim(trajectory.t) - 1
    if dims is None:
        return () if count == 0 else ("batch",) if count == 1 else tuple(f"batch_{i}" for i in range(count))
    dims = (dims,) if isinstance(dims, str) else tuple(dims)
    if len(dims) != count:
        raise ValueError(
            f"dims has {len(dims)} names, {', '.join(map(repr, dims))}, but this trajectory has {count} axes in front "
            f"of its outputs.\nFix: dims={tuple(f'axis_{i}' for i in range(count))}."
        )
    return dims


def outputs(trajectory):
    """Yield what is known at each output: (name, names of the axes after the outputs, values)."""
    lead = np.ndim(trajectory.t)
    for which in ("q", "v"):
        for path, x in jax.tree_util.tree_leaves_with_path(getattr(trajectory, which)):
            yield named(which, path), axes(named("", path) or "q", x, lead), np.asarray(x)
    for name, x in trajectory.multipliers.items():
        free = name if name not in _taken(trajectory) else f"multipliers.{name}"
        yield free, axes(name, x, lead), np.asarray(x)
    if hasattr(trajectory, "phase"):
        yield "phase", (), np.asarray(trajectory.phase)
        if trajectory.modes is not None:
            yield "modes", ("mode",), np.asarray(trajectory.modes)
    if trajectory.error is None:
        return
    for which in ("q", "v"):
        for path, x in jax.tree_util.tree_leaves_with_path(getattr(trajectory.error, which)):
            yield named(f"error.{which}", path), axes(named("", path) or "q", x, lead), np.asarray(x)


def of_motions(trajectory):
    """Yield what is known of each motion as a whole, likewise."""
    yield "result", (), np.asarray(trajectory.result._value)
    yield "end", (), np.asarray(trajectory.end.t)
    yield "scaled_error", (), np.asarray(trajectory.scaled_error)
    for name in COUNTS:
        yield name, (), np.asarray(trajectory.stats[name])
    for name, found in trajectory.events.items():
        yield f"events.{name}", (f"crossing_of_{name}",), np.asarray(found.t)


def parameters(trajectory):
    """Yield the parameters that are arrays, of a batch, likewise."""
    lead = np.ndim(trajectory.t) - 1
    for path, x in jax.tree_util.tree_leaves_with_path(trajectory.params):
        if isinstance(x, (jax.Array, np.ndarray)):
            name = named("params", path)
            yield name, axes(name, x, lead), np.asarray(x)


def attributes(trajectory) -> dict[str, Any]:
    """Return how it was integrated and, for one motion, its result and the parameters that are numbers."""
    rtol, atol = (np.asarray(x) for x in trajectory.tolerance)
    lead = np.ndim(trajectory.t) - 1
    found: dict[str, Any] = {"method": trajectory.static.method, "drift": trajectory.asked.drift}
    if not lead:
        by_size = atol.ndim > 1
        found |= {"rtol": rtol.tolist(), "atol": "by the size of each number" if by_size else atol.tolist()}
        found["result"] = in_words(trajectory.result._value)
        for path, x in jax.tree_util.tree_leaves_with_path(trajectory.params):
            if isinstance(x, (bool, int, float, str, np.generic, np.ndarray, jax.Array)):
                if np.ndim(x) <= 1 and np.size(x) <= 64:
                    # NetCDF cannot store booleans.
                    x = np.asarray(x, int) if np.asarray(x).dtype == bool else np.asarray(x)
                    found[named("params", path)] = x.tolist()
    return found


def named(which: str, path) -> str:
    """Return the name of a leaf of `which`."""
    inner = jax.tree_util.keystr(path, simple=True, separator=".")
    return f"{which}.{inner}" if which and inner else which or inner


def axes(name: str, x, lead: int) -> tuple[str, ...]:
    """Return the names of the axes of x after the first `lead` ones."""
    return tuple(f"{name}_{i}" for i in range(np.ndim(x) - lead))


def _taken(trajectory):
    coordinates = [named(which, path) for which in ("q", "v") for path, _ in _leaves(getattr(trajectory, which))]
    return {"t", "times", "phase", "modes", "mode", "result", "end", "scaled_error", *COUNTS, *coordinates}


def _leaves(tree: PyTree):
    return jax.tree_util.tree_leaves_with_path(tree)


def _one_word(words):
    return "_".join(words.replace(".", "").split())
