"""Names for what a sweep has, the same in xarray, in pandas and in a store: variables, dimensions, flags.

An array that `run` returns is named by its path, `end.q`; "value" where it is alone. Its dimensions are those of the
sweep, and behind them its own, `end.q_0`. Of a trajectory the outputs are shown, over the times `t`, their errors, its
end, events and parameters, named as by `Trajectory.to_xarray`; what else it consists of has no name here. A name that
is taken gets `value_` or `status_` in front.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.motion.results import RESULTS, in_words
from lagjax.motion.trajectory import Trajectory
from lagjax.sweeps.axes import POINT, Axes
from lagjax.sweeps.lanes import LOST, NOT_RUN, Status

# What a store keeps beside them.
KEPT_FREE = "lagjax"
# The times of a trajectory, and where among its arrays its parameters are.
TIMES, PARAMS = "t", 1
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
        dims = *part.dims, *inner_dims(part.of or names[part.key], part.inner)
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
        dim = f"value_{dim}"
    return dim


class _Part(NamedTuple):
    """An array among values: its leaf; its name before others are looked at; its dimensions, the last `inner` of them
    named after `of`, or after itself.
    """

    key: str
    name: str
    dims: tuple[str, ...]
    inner: int
    of: str = ""
    times: bool = False


def _shown(like) -> Iterable[_Part]:
    for path, part in _with_path(like):
        key = keyed(path) or "value"
        if isinstance(part, Trajectory):
            yield from _of_motion(part, f"{key}." if keyed(path) else "")
        else:
            yield _Part(key, _flat(key), (), len(part.shape))


def _of_motion(motion, under):
    """What a trajectory shows, as its own `to_xarray` names it."""
    batch = inner_dims(f"{under}lane", len(motion.t.shape) - 1)
    dims = *batch, f"{under}{TIMES}"

    def part(key, name, dims, x, of="", times=False):
        inner, flat = len(x.shape) - len(dims), tuple(map(_flat, dims))
        return _Part(under + key, _flat(under + name), flat, inner, _flat(under + of) if of else "", times)

    yield part("t", "times", dims, motion.t, times=True)
    errors = {} if motion.error is None else {f"error.{name}": getattr(motion.error, name) for name in ("q", "v")}
    for which, tree in {"q": motion.q, "v": motion.v, **errors}.items():
        for path, x in _with_path(tree):
            inner = keyed(path)
            yield part(_joined(which, inner), _joined(which, inner), dims, x, inner or "q")
    for name, x in motion.multipliers.items():
        yield part(f"multipliers.{name}", name, dims, x, name)
    if hasattr(motion, "phase"):
        yield part("phase", "phase", dims, motion.phase)
    yield part("end.t", "end", batch, motion.end.t)
    for name, found in motion.events.items():
        yield part(f"events.{name}.t", f"events.{name}", (*batch, f"{under}crossing_of_{name}"), found.t)
    for path, x in _with_path(motion.arrays[PARAMS]):
        inner = keyed(path)
        yield part(_joined(f"arrays.{PARAMS}", inner), _joined("params", inner), batch, x)


def _joined(which, inner):
    return f"{which}.{inner}" if inner else which


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


def shared_times(x: np.ndarray, there: np.ndarray):
    """The times that all points have of which there are values; None where they differ, or there is none."""
    times = x[there]
    return times[0] if len(times) and np.all(times == times[0]) else None
