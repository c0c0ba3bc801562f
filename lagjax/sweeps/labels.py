"""Names for what a sweep has, the same in xarray, in pandas and in a store: variables, dimensions, flags.

An array that `run` returns is named by its path, `end.q`; "value" where it is alone. Its dimensions are those of the
sweep, and behind them its own, `end.q_0`. Of a trajectory the coordinates, velocities and multipliers are shown, over
the times `t`; what else it consists of has no name here. A name that is taken gets `value_` or `status_` in front.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.motion.trajectory import RESULTS, Trajectory, in_words
from lagjax.sweeps.axes import POINT, Axes
from lagjax.sweeps.lanes import LOST, NOT_RUN, Status

# What a store keeps beside them.
KEPT_FREE = "lagjax"
# What a trajectory shows, and the times of it all.
SHOWN, TIMES = ("q", "v", "multipliers"), "t"
OF_STATUS = Status(
    "how each point went",
    "steps of all integrations of a point",
    "worst error of a point, in units of what is allowed",
    "worst constraint residual of a point, relative",
)


class Label(NamedTuple):
    """An array's name, and its dimensions behind those of the sweep; `times` where it has a trajectory's times."""

    name: str
    dims: tuple[str, ...]
    times: bool = False


class Labels(NamedTuple):
    """The names of a sweep: of its axes (with all their dimensions), values by leaf, status by field."""

    axes: dict[str, Label]
    values: dict[str, Label]
    status: dict[str, Label]


def labels_of(axes: Axes, like: PyTree) -> Labels:
    """The names of a sweep whose `run` returns what is like this, of shapes.

    **Raises:** `ValueError` for two of one name.
    """
    of_axes, names, values = _of_axes(axes), {}, {}
    dims_of_axes = {dim for label in of_axes.values() for dim in label.dims}
    taken = {KEPT_FREE, *dims_of_axes, *(label.name for label in of_axes.values())}
    shown = list(_shown(like))
    for part in shown:
        names[part.key] = _free(part.name, "value", taken)
        taken.add(names[part.key])
    status = {}
    for field in Status._fields:
        status[field] = Label(_free(field, "status", taken), ())
        taken.add(status[field].name)
    for part in shown:
        dims = *part.dims, *inner_dims(names[part.key], part.inner)
        values[part.key] = Label(names[part.key], tuple(_apart(dim, taken) for dim in dims), part.times)
    return Labels(of_axes, values, status)


def _of_axes(axes):
    found, taken = {}, set(axes.names) | {POINT}
    for name, x in axes.values.items():
        inner = tuple(_apart(dim, taken) for dim in inner_dims(name, x.ndim - 1))
        dims = (POINT if axes.paired else name, *inner)
        # A coordinate of a dimension's name has one number for each of its places.
        shown = _apart(f"{name}_values", taken) if inner and name == dims[0] else name
        taken |= {shown, *inner}
        found[name] = Label(shown, dims)
    return found


def inner_dims(name: str, count: int) -> tuple[str, ...]:
    """The dimensions of an array of a point."""
    return tuple(f"{name}_{i}" for i in range(count))


def _free(name, kind, taken):
    for free in (name, f"{kind}_{name}"):
        if free not in taken:
            return free
    raise ValueError(f"two of the values are named '{name}'.\nFix: another key in what run returns.")


def _apart(dim, taken):
    while dim in taken:
        dim = f"of_{dim}"
    return dim


class _Part(NamedTuple):
    """An array among values: its leaf, its name before others are looked at, its dimensions with the last `inner`."""

    key: str
    name: str
    dims: tuple[str, ...]
    inner: int
    times: bool = False


def _shown(like) -> Iterable[_Part]:
    for path, part in _with_path(like):
        key = keyed(path)
        if not isinstance(part, Trajectory):
            yield _Part(key or "value", _flat(key or "value"), (), len(part.shape))
            continue
        under = f"{key}." if key else ""
        lanes = len(part.t.shape) - 1
        dims = tuple(_flat(dim) for dim in (*inner_dims(f"{under}lane", lanes), f"{under}{TIMES}"))
        yield _Part(f"{under}{TIMES}", _flat(f"{under}times"), dims, 0, True)
        for leaf, x in _with_path({name: getattr(part, name) for name in SHOWN}):
            name = keyed(leaf)
            shown = _flat(under + name.removeprefix("multipliers."))
            yield _Part(under + name, shown, dims, len(x.shape) - lanes - 1)


def _flat(name):
    # Zarr and netCDF take what stands before a slash for a folder.
    return name.replace("/", "_")


def _with_path(tree):
    return jax.tree_util.tree_leaves_with_path(tree, is_leaf=lambda x: isinstance(x, Trajectory))


def keyed(path) -> str:
    """A path as `named_leaves` writes it."""
    return jax.tree_util.keystr(path, simple=True, separator=".").lstrip(".")


def flags() -> dict[str, Any]:
    """What the numbers of a result mean, as the CF conventions write it."""
    codes = {LOST: "lost_from_the_store", NOT_RUN: "not_run"}
    codes |= {int(item._value): name for name, item in RESULTS._name_to_item.items()}
    codes = dict(sorted(codes.items()))
    return {"flag_values": list(codes), "flag_meanings": " ".join(codes.values())}


def status_attributes(field: str) -> dict[str, Any]:
    """What xarray shows of a status."""
    return {"long_name": getattr(OF_STATUS, field)} | (flags() if field == "result" else {})


def words_of(code) -> str:
    """A result's number in words."""
    return {NOT_RUN: "not run", LOST: "lost from the store"}.get(int(code)) or in_words(code)


def shared_times(x: np.ndarray, lead: int, run: np.ndarray):
    """The times (..., T) that all points have that were run; None where they differ, or none was run."""
    times = x.reshape(-1, *x.shape[lead:])[run.reshape(-1)]
    return times[0] if len(times) and np.all(times == times[0]) else None
