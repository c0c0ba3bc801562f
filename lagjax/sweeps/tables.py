"""Sweeps for others to read: as an `xarray.Dataset`, as a `pandas.DataFrame`."""

from typing import Any

import jax
import numpy as np

from lagjax.motion.trajectory import Trajectory
from lagjax.sweeps.fingerprint import named_leaves
from lagjax.sweeps.labels import Labels, labels_of, shared_times, status_attributes, words_of
from lagjax.sweeps.lanes import Status

# Columns of one array of a point.
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
    variables, there = {}, swept.status.result >= 0
    for key, x in named_leaves(values):
        label = labels.values.get(key)
        if label is None:
            continue
        shared = shared_times(x, there) if label.times and len(label.dims) == 1 else None
        if shared is None:
            variables[label.name] = ((*lead, *label.dims), x)
        else:
            coords[label.dims[0]] = shared
    for field, x in zip(Status._fields, swept.status):
        variables[labels.status[field].name] = (lead, x, status_attributes(field))
    return xarray.Dataset(variables, coords, {"how": swept.how})


def frame(swept: Any, of_values):
    """A row a point: `Sweep.to_pandas`."""
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
    codes, places = np.unique(columns[result], return_inverse=True)
    columns[result] = pandas.Categorical.from_codes(places, [words_of(code) for code in codes])
    return pandas.DataFrame(columns)


def _labels(swept, values) -> Labels:
    lead = len(swept.axes.shape)
    return labels_of(swept.axes, jax.tree.map(lambda x: jax.ShapeDtypeStruct(np.shape(x)[lead:], x.dtype), values))


def _columns(name, x):
    """An array (points, ...) as columns."""
    if x.ndim == 1:
        return {name: x}
    places = np.ndindex(*x.shape[1:])
    return {f"{name}[{', '.join(map(str, place))}]": x[(slice(None), *place)] for place in places}


def _check_rows(swept, values):
    """Whether each value fits into a row, and is one of the sweep's points."""
    lead, advice = swept.axes.shape, 'swept.to_pandas(lambda values: {"end": values.q[..., -1]})'
    motions = [x for x in jax.tree.leaves(values, is_leaf=_is_motion) if _is_motion(x)]
    if motions:
        raise ValueError(
            f"a point has a whole trajectory, at {motions[0].t.shape[-1]} times, for which a row has no room.\n"
            f"Fix: choose what to show, as {advice}; or swept.to_xarray().to_dataframe(), with a row an output."
        )
    for name, x in named_leaves(values):
        if np.shape(x)[: len(lead)] != lead:
            raise ValueError(
                f"'{name}' has the shape {np.shape(x)}, and does not begin with that of the axes, {lead}.\n"
                f"Usual cause: an axis that was summed over or left out. Fix: as in {advice}."
            )
        if np.prod(np.shape(x)[len(lead) :]) > MOST_COLUMNS:
            raise ValueError(
                f"a point has '{name}' {np.shape(x)[len(lead) :]}, for which a row has no room.\n"
                f"Fix: choose what to show, as {advice}; or swept.to_xarray().to_dataframe()."
            )


def _is_motion(x):
    return isinstance(x, Trajectory)
