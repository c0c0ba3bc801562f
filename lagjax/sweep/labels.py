"""Names for the arrays of a sweep, the same in xarray, in pandas and in a store; and sweeps as tables of both.

An array that `run` returns is named by its path, `end.q`; a single array is named "value". Its dimensions are those of
the sweep, followed by its own, `end.q_0`. A trajectory shows its outputs over the times `t`, their errors, its end,
events and parameters, named as by `Trajectory.to_xarray`; its other parts have no name here. A name that is already
taken gets the prefix `value_` or `status_`.
"""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import RESULTS, Trajectory, in_words
from lagjax.sweep.axes import POINT, Axes
from lagjax.sweep.engine import LOST, NOT_RUN, Status, is_motion

# The name of a store's own group, not available to arrays.
STORE_GROUP = "lagjax"
# The name of a trajectory's times, and the index of the parameters among its `arrays`.
TIMES, PARAMS = "t", 1
STATUS_LONG_NAMES = Status(
    "how each point ended",
    "total steps of all integrations of a point",
    "worst error of a point, relative to the allowed error",
    "worst relative constraint residual of a point",
)


class Label(NamedTuple):
    """An array's name and its dimensions after those of the sweep; `times` if it holds the times of a trajectory."""

    name: str
    dims: tuple[str, ...]
    times: bool = False


class Labels(NamedTuple):
    """The labels of a sweep: its axes (with all their dimensions), values by leaf, status by field."""

    axes: dict[str, Label]
    values: dict[str, Label]
    status: dict[str, Label]


def labels_of(axes: Axes, like: PyTree) -> Labels:
    """The labels of a sweep whose `run` returns values of the shapes in `like`.

    **Raises:** `ValueError` if two values have the same name.
    """
    of_axes, names, values = _of_axes(axes), {}, {}
    dims_of_axes = {dim for label in of_axes.values() for dim in label.dims}
    taken = {STORE_GROUP, *dims_of_axes, *(label.name for label in of_axes.values())}
    shown = list(_shown_arrays(like))
    for part in shown:
        names[part.key] = _unused_name(part.name, "value", taken)
        taken.add(names[part.key])
    status = {}
    for field in Status._fields:
        status[field] = Label(_unused_name(field, "status", taken), ())
        taken.add(status[field].name)
    for part in shown:
        dims = *part.dims, *inner_dims(part.of or names[part.key], part.inner)
        values[part.key] = Label(names[part.key], tuple(_unused_dimension(dim, taken) for dim in dims), part.times)
    return Labels(of_axes, values, status)


def _of_axes(axes: Axes):
    found, taken = {}, set(axes.names) | {POINT}
    for name, x in axes.values.items():
        inner = tuple(_unused_dimension(dim, taken) for dim in inner_dims(name, x.ndim - 1))
        dims = (POINT if axes.paired else name, *inner)
        # xarray requires that a coordinate named like a dimension is one-dimensional.
        shown = _unused_dimension(f"{name}_values", taken) if inner and name == dims[0] else name
        taken |= {shown, *inner}
        found[name] = Label(shown, dims)
    return found


def inner_dims(name: str, count: int) -> tuple[str, ...]:
    """The names of an array's own dimensions."""
    return tuple(f"{name}_{i}" for i in range(count))


def _unused_name(name: str, kind: str, taken: set[str]):
    for candidate in (name, f"{kind}_{name}"):
        if candidate not in taken:
            return candidate
    raise ValueError(f"two of the values are named '{name}'.\nFix: another key in the dictionary that run returns.")


def _unused_dimension(dim: str, taken: set[str]):
    while dim in taken:
        dim = f"value_{dim}"
    return dim


class _ShownArray(NamedTuple):
    """An array among the values: its leaf, preferred name and named dimensions.

    Its other `inner` dimensions are named after `of`, or after the array.
    """

    key: str
    name: str
    dims: tuple[str, ...]
    inner: int
    of: str = ""
    times: bool = False


def _shown_arrays(like: PyTree) -> Iterable[_ShownArray]:
    for path, part in with_path(like):
        key = key_of(path) or "value"
        if is_motion(part):
            yield from _of_motion(part, f"{key}." if key_of(path) else "")
        else:
            yield _ShownArray(key, _flat(key), (), len(part.shape))


def _of_motion(motion: Any, prefix: str):
    """The arrays that a trajectory shows, named as by its own `to_xarray`."""
    batch = inner_dims(f"{prefix}lane", len(motion.t.shape) - 1)
    dims = *batch, f"{prefix}{TIMES}"

    def part(key: str, name: str, dims: tuple[str, ...], x: Any, of: str = "", times: bool = False):
        inner, flat = len(x.shape) - len(dims), tuple(map(_flat, dims))
        return _ShownArray(prefix + key, _flat(prefix + name), flat, inner, _flat(prefix + of) if of else "", times)

    yield part("t", "times", dims, motion.t, times=True)
    errors = {} if motion.error is None else {f"error.{name}": getattr(motion.error, name) for name in ("q", "v")}
    for which, tree in {"q": motion.q, "v": motion.v, **errors}.items():
        for path, x in with_path(tree):
            inner = key_of(path)
            yield part(_joined(which, inner), _joined(which, inner), dims, x, inner or "q")
    for name, x in motion.multipliers.items():
        yield part(f"multipliers.{name}", name, dims, x, name)
    if hasattr(motion, "phase"):
        yield part("phase", "phase", dims, motion.phase)
        if motion.modes is not None:
            yield part("modes", "modes", dims, motion.modes, "mode")
    yield part("end.t", "end", batch, motion.end.t)
    for name, found in motion.events.items():
        yield part(f"events.{name}.t", f"events.{name}", (*batch, f"{prefix}crossing_of_{name}"), found.t)
    for path, x in with_path(motion.arrays[PARAMS]):
        inner = key_of(path)
        yield part(_joined(f"arrays.{PARAMS}", inner), _joined("params", inner), batch, x)


def _joined(which: str, inner: str):
    return f"{which}.{inner}" if inner else which


def _flat(name: str):
    # Zarr and netCDF interpret a slash as a folder separator.
    return name.replace("/", "_")


def with_path(tree: PyTree) -> list[tuple[Any, Any]]:
    """The paths and leaves of values, each trajectory as one."""
    return jax.tree_util.tree_leaves_with_path(tree, is_leaf=is_motion)


def motions_in(tree: PyTree) -> list[Trajectory]:
    """The trajectories among values."""
    return [x for _, x in with_path(tree) if is_motion(x)]


def key_of(path: tuple[Any, ...]) -> str:
    """A path as text; "" for a single leaf."""
    return jax.tree_util.keystr(path, simple=True, separator=".").lstrip(".")


def named_leaves(tree: PyTree) -> list[tuple[str, Any]]:
    """The leaves of what `run` returns, each with a name: its path, or "value" for a single leaf.

    **Raises:** `ValueError` if two have the same name.
    """
    found = [(key_of(path) or "value", path, leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)]
    paths = {}
    for name, path, _ in found:
        paths.setdefault(name, []).append(jax.tree_util.keystr(path) or "the value itself")
    for name, same_name in paths.items():
        if len(same_name) > 1:
            raise ValueError(
                f"run returns {len(same_name)} values named '{name}': {', '.join(same_name)}.\n"
                f"Usual cause: a key with a dot in it. Fix: another key, such as '{name.replace('.', '_')}'."
            )
    return [(name, leaf) for name, _, leaf in found]


def shapes_of(values: PyTree, lead: int) -> str:
    """The names and shapes of a point's values as text; the first `lead` dimensions are those of the sweep."""
    return ", ".join(sorted(f"{name} {x.dtype}{list(np.shape(x)[lead:]) or ''}" for name, x in named_leaves(values)))


def flags() -> dict[str, Any]:
    """The meanings of the result codes, in the form of the CF conventions."""
    codes = {LOST: "lost_from_the_store", NOT_RUN: "not_run"}
    codes |= {int(item._value): name for name, item in RESULTS._name_to_item.items()}
    codes = dict(sorted(codes.items()))
    return {"flag_values": list(codes), "flag_meanings": " ".join(codes.values())}


def status_attributes(field: str) -> dict[str, Any]:
    """The attributes of a status array in xarray."""
    return {"long_name": getattr(STATUS_LONG_NAMES, field)} | (flags() if field == "result" else {})


def words_of(code: int) -> str:
    """A result code in words."""
    return {NOT_RUN: "not run", LOST: "lost from the store"}.get(int(code)) or in_words(code)


def shared_times(x: np.ndarray, has_values: np.ndarray):
    """The times shared by all points that have values; None if they differ, or no point has values."""
    times = x[has_values]
    return times[0] if len(times) and np.all(times == times[0]) else None


# The largest number of columns for one array of a point.
MOST_COLUMNS = 100


def dataset(swept: Any):
    """A sweep with its axes as dimensions: `Sweep.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError('this needs xarray, an optional extra.\nFix: pip install "lagjax[data]"') from error
    values = swept.values
    labels, lead = _labels(swept, values), tuple(swept.dims)
    coords = {label.name: (label.dims, swept.axes.values[name]) for name, label in labels.axes.items()}
    variables, has_values = {}, swept.status.result >= 0
    for key, x in named_leaves(values):
        label = labels.values.get(key)
        if label is None:
            continue
        shared = shared_times(x, has_values) if label.times and len(label.dims) == 1 else None
        if shared is None:
            variables[label.name] = ((*lead, *label.dims), x)
        else:
            coords[label.dims[0]] = shared
    for field, x in zip(Status._fields, swept.status):
        variables[labels.status[field].name] = (lead, x, status_attributes(field))
    return xarray.Dataset(variables, coords, {"how": swept.how})


def frame(swept: Any, of_values: Callable | None):
    """A sweep with one row per point: `Sweep.to_pandas`."""
    try:
        import pandas
    except ImportError as error:
        raise ImportError('this needs pandas, an optional extra.\nFix: pip install "lagjax[data]"') from error
    values = swept.values if of_values is None else of_values(swept.values)
    _check_rows(swept, values)
    labels, shape = _labels(swept, values), swept.axes.shape
    points = swept.axes.at(np.arange(swept.axes.size))
    columns = {}
    for name, x in points.items():
        columns |= _columns(name, x)
    for key, x in named_leaves(values):
        label = labels.values.get(key)
        if label is not None:
            columns |= _columns(label.name, np.asarray(x).reshape(swept.axes.size, *np.shape(x)[len(shape) :]))
    for field, x in zip(Status._fields, swept.status):
        columns[labels.status[field].name] = x.reshape(-1)
    result = labels.status["result"].name
    codes, indices = np.unique(columns[result], return_inverse=True)
    columns[result] = pandas.Categorical.from_codes(indices, [words_of(code) for code in codes])
    return pandas.DataFrame(columns)


def _labels(swept: Any, values: PyTree) -> Labels:
    lead = len(swept.axes.shape)
    return labels_of(swept.axes, jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x)[lead:], x.dtype), values))


def _columns(name: str, x: np.ndarray):
    """The columns of an array (points, ...), by name."""
    if x.ndim == 1:
        return {name: x}
    indices = np.ndindex(*x.shape[1:])
    return {f"{name}[{', '.join(map(str, place))}]": x[(slice(None), *place)] for place in indices}


def _check_rows(swept: Any, values: PyTree):
    """Raise `ValueError` unless each value has the sweep's axes in front and fits into a row."""
    lead, advice = swept.axes.shape, 'swept.to_pandas(lambda values: {"end": values.q[..., -1]})'
    motions = motions_in(values)
    if motions:
        raise ValueError(
            f"each point has a whole trajectory, at {motions[0].t.shape[-1]} times, which does not fit into a row.\n"
            f"Fix: choose what to show: {advice}; or swept.to_xarray().to_dataframe(), with one row per output."
        )
    for name, x in named_leaves(values):
        if np.shape(x)[: len(lead)] != lead:
            raise ValueError(
                f"'{name}' has the shape {np.shape(x)}, which does not begin with the shape of the axes, {lead}.\n"
                f"Usual cause: an axis that was summed over or left out. Fix: keep the axes: {advice}."
            )
        if np.prod(np.shape(x)[len(lead) :]) > MOST_COLUMNS:
            raise ValueError(
                f"each point has '{name}' {np.shape(x)[len(lead) :]}, which does not fit into a row.\n"
                f"Fix: choose what to show: {advice}; or swept.to_xarray().to_dataframe()."
            )
