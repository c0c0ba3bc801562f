"""Export a comparison as a `pandas.DataFrame` or an `xarray.Dataset`."""

from typing import Any

import numpy as np

# The numbers of a point; unknown ones are NaN.
NUMBERS = ("error", "seconds", "least", "steps", "evaluations")


def frame(found: Any):
    """A table with one row per point: see `WorkPrecision.to_pandas`."""
    try:
        import pandas
    except ImportError as error:
        raise ImportError('this needs pandas, an optional extra.\nFix: pip install "lagjax[data]"') from error
    points = list(found.points)
    columns = {name: [getattr(point, name) for point in points] for name in ("method", "tolerance", "error", "trusted")}
    columns |= {name: [getattr(point, name) for point in points] for name in ("seconds", "least")}
    # Whole numbers, some of which may be unknown.
    columns |= {
        name: pandas.array([getattr(point, name) for point in points], "Int64") for name in ("steps", "evaluations")
    }
    columns["order"] = [found[point.method].order for point in points]
    columns["compile_seconds"] = [found[point.method].compile_seconds for point in points]
    columns["result"] = [point.result for point in points]
    table = pandas.DataFrame(columns)
    for name in ("method", "result"):
        table[name] = pandas.Categorical(table[name], list(dict.fromkeys(table[name])))
    return table


def dataset(found: Any):
    """Arrays of methods by tolerances: see `WorkPrecision.to_xarray`."""
    try:
        import xarray
    except ImportError as error:
        raise ImportError('this needs xarray, an optional extra.\nFix: pip install "lagjax[data]"') from error
    methods, points = list(found.curves), list(found.points)
    tolerances = sorted({point.tolerance for point in points}, reverse=True)
    # Not called `method`, which is an argument of xarray's `sel`.
    shape, dims = (len(methods), len(tolerances)), ("solver", "tolerance")
    numbers = {name: np.full(shape, np.nan) for name in NUMBERS}
    trusted, results = np.zeros(shape, bool), np.full(shape, "not tried", object)
    for point in points:
        at = methods.index(point.method), tolerances.index(point.tolerance)
        for name, x in numbers.items():
            known = getattr(point, name)
            x[at] = np.nan if known is None else known
        trusted[at], results[at] = point.trusted, point.result
    variables: dict[str, Any] = {name: (dims, x) for name, x in numbers.items()}
    variables |= {"trusted": (dims, trusted), "result": (dims, results.astype(str))}
    coords: dict[str, Any] = {"solver": methods, "tolerance": tolerances}
    for name in ("order", "compile_seconds"):
        coords[name] = "solver", [getattr(curve, name) for curve in found.curves.values()]
    attributes = {"measured": found.measured, "call_seconds": found.call_seconds}
    if found.reference is not None:
        attributes["reference_error"] = found.reference.error
    return xarray.Dataset(variables, coords, attributes)
