"""Sweeps as an `xarray.Dataset` or a `pandas.DataFrame`."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.sweep.batch_program import Status
from lagjax.sweep.labels import Labels, labels_of, motions_in, named_leaves, shared_times, status_attributes, words_of

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
