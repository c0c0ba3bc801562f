"""Read fits from files, with the functions that the user passes again."""

import math
import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from inspect import signature
from typing import Any

import jax
import numpy as np

from lagjax.display import printable
from lagjax.files import NotGiven, Reader, Table, npz
from lagjax.fit.problem.initial_states import unflatten_of
from lagjax.fit.result.result import Fit
from lagjax.integrate import described_system, integrate, same_system
from lagjax.jaxtools import kinds
from lagjax.mechanics import listed
from lagjax.system import Hybrid, System, UnknownSystem


def load_fit(
    path: str | os.PathLike,
    system: System | Hybrid | None = None,
    observe: Callable | None = None,
    *,
    classes: Iterable[type] = (),
    **options,
) -> Fit:
    """Read a fit that `found.save(path)` has written, bit for bit.

    A file is data: reading it imports nothing, runs nothing of it and writes nothing, whoever has written it.

    >>> import os
    >>> import tempfile
    >>> import numpy as np
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t = np.linspace(0.0, 1.0, 6)
    >>> found = lj.fit(fall, lj.Record(t, q=3.0 * t - 5.0 * t**2 + 1e-3 * np.cos(9.0 * t), sigma=1e-3), {"g": 9.0})
    >>> path = os.path.join(tempfile.mkdtemp(), "fall.npz")
    >>> found.save(path)
    >>> again = lj.load_fit(path, fall)
    >>> print(again.names, bool(again.sd == found.sd), again.motion().q.shape)
    ('g',) True (6,)

    **Arguments:**

    - `path`: the file.
    - `system`, `observe`: the fitted system and function, which are not in the file; `options`: those of `lj.fit` that
      contain functions, such as `events=`. `motion()`, `log_likelihood` and `laplace()` need them; without them these
      raise an error that names what is missing, and the estimates, their uncertainties and the residuals are available.
    - `classes`: your own classes of which it holds objects, as in `lj.load_trajectory`.

    **Returns:** the `Fit`.

    **Raises:**

    - `FileNotFoundError` if the file does not exist.
    - `ValueError` for a file that is damaged, holds something else, or was written by a newer lagjax or a version that
      stores fits in another form; for a `system` other than the fitted one; for a float64 file while JAX works in
      float32; for objects of a class that was not passed.
    - `TypeError` for functions that the fit did not have.
    """
    known = {"system": system, "observe": observe} | {f"options.{name}": x for name, x in options.items()}
    known = {role: x for role, x in known.items() if x is not None}
    table = Table(classes)
    with npz.opened(path, "fit") as (contents, array):
        reader, asked = Reader(array, table=table), contents["functions"]
        if not isinstance(asked, list) or not all(isinstance(role, str) for role in asked):
            raise ValueError("its list of functions is not one that lagjax writes.")
        said, unflatten = reader.up(contents["known"]), unflatten_of(kinds(reader.up(contents["q"])))
        described = described_system(said)
        given: dict[str, Any] = {"system": described, "first": described, "unflatten": unflatten}
        reader.given = lambda role: given[role] if role in given else NotGiven(_short(role))
        found = reader.up(contents["fit"])
        if described.starts is None:
            raise ValueError("it does not say where its motions start.")
        check_shapes(found, described)
    if unknown := sorted(set(known) - set(asked)):
        raise TypeError(
            f"this fit has no {', '.join(_short(role) for role in unknown)} to be passed again.\n"
            f"It has {', '.join(printable(_short(role)) for role in asked)}."
        )
    return _with(found, known, described, path)


def _with(found: Fit, known: dict[str, Any], described: UnknownSystem, path: Any) -> Fit:
    """A fit with the functions that the user passes again."""
    problem, fields = found.problem, {}
    if "observe" in known:
        fields["observe"] = known["observe"]
    if "system" in known:
        system: Any = same_system(known["system"], described, path)
        if described.phase is not None:
            if not system.in_phases or not 0 <= described.phase < len(system.phases):
                raise ValueError(f"{path} starts in phase {described.phase}, which this system does not have.")
            system = system.starting(described.phase)
        fields |= {"system": system, "first": system.first_phase}
    options = {name: known.get(f"options.{name}", x) for name, x in problem.options.items()}
    return replace(found, problem=replace(problem, options=options, **fields))


def check_shapes(found: Fit, described: UnknownSystem) -> None:
    """Raise `ValueError` if the numbers of a fit do not belong together."""
    problem = found.problem
    numbers, windows, starts = problem.found, problem.windows, problem.starts
    p, (count, times), n = len(numbers.names), windows.ts.shape, np.size(problem.unit) // 2
    k, searched = starts.unknowns, found.unknowns

    def check(name: str, kinds: str, *expected, lead: bool = False):
        for x, shape in expected:
            here = np.shape(x)[: len(shape)] if lead else np.shape(x)
            if not isinstance(x, (np.ndarray, np.generic, jax.Array)) or here != shape or x.dtype.kind not in kinds:
                raise ValueError(f"{name} of shape {np.shape(x)} does not belong to {p} numbers in {count} windows.")

    of_numbers = (numbers.start, numbers.low, numbers.high, numbers.mean, numbers.sd, searched.shared)
    check("found", "f", *((x, (p,)) for x in of_numbers), (searched.local, (count, k)))
    check("windows", "f", (windows.ts, (count, times)))
    check("windows", "b", (windows.real, (count, times)), (windows.seam, (count,)))
    check("windows", "iu", (windows.sample, (count, times)), (windows.last, (count,)), (windows.record, (count,)))
    check("starts", "f", *((chart.guess, (count, n)) for chart in starts), (problem.unit, (2 * n,)))
    check("starts", "f", *((chart.along, (count, n, k)) for chart in starts))
    check("starts", "f", *((chart.across, (count, n, chart.across.shape[-1])) for chart in starts))
    check("the search", "f", (found.cost, ()), (found.costs, (found.costs.size,)), (problem.spread_in_sigmas, ()))
    check("the search", "b", (found.rested, ()), (found.misfit.doubtful, ()))
    check("the search", "iu", (found.steps, ()))
    channels, columns = jax.tree.leaves(problem.measured), 0
    check("misfit", "f", (found.misfit.times, (len(channels),)))
    check("misfit", "b", *((x, (len(channels),)) for x in (found.misfit.large, found.misfit.curved)))
    for kind, tree in problem.measured.items():
        rows = (count,) if kind == "end" else (count, times)
        for x, sigma in zip(jax.tree.leaves(tree), jax.tree.leaves(problem.sigma[kind]), strict=True):
            check(kind, "f", (x, rows), (sigma, rows), lead=True)
            check(kind, "f", (sigma, x.shape))
            columns += math.prod(x.shape[1:])
    records = len(windows.first)
    if described.starts is not None:
        (q, v), (q_slopes, v_slopes) = described.starts
        for tree, slopes in ((q, q_slopes), (v, v_slopes)):
            leaves = jax.tree.leaves(tree)
            for x, slope in zip(leaves, jax.tree.leaves(slopes), strict=True):
                check("starts", "f", (x, (records,)), lead=True)
                check("starts", "f", (slope, (*x.shape, p + k)))
            if sum(x[0].size for x in leaves) != n or jax.tree.structure(tree) != jax.tree.structure(slopes):
                raise ValueError(f"its starts do not have {n} coordinates.")
    if not in_order(windows.record, windows.last, times):
        raise ValueError("its windows are not in the order of its records.")
    if (at := found.evaluation) is not None:
        of, determined = at.covariance, at.determined
        check("covariance", "f", (of.shared, (p, p)), (of.local, (count, k, k)), (of.local_shared, (count, k, p)))
        check("determined", "b", (determined.shared, (p,)), (determined.local, (count, k)))
        check("rows", "f", (at.rows, (count, columns)))
        check("combinations", "f", (at.combinations, (p, p)), (at.singular_values, (p,)))
        check("chi2", "f", (at.chi2, ()), (at.freedom, ()))
    leaves = jax.tree.leaves(numbers.params)
    sizes = [np.size(leaves[number]) if places is None else len(places) for number, places in numbers.leaves]
    inside = all(0 <= i < np.size(leaves[number]) for number, places in numbers.leaves for i in places or ())
    if unknown := set(problem.options) - set(signature(integrate).parameters):
        raise ValueError(f"its options are not those of lj.integrate: {listed(sorted(unknown))}.")
    if sum(sizes) != p or not inside:
        raise ValueError(f"its parameters do not hold {p} numbers.")


def _short(role: str):
    return role.removeprefix("options.")


def in_order(record: np.ndarray, last: np.ndarray, times: int) -> bool:
    """Whether windows (count,) belong to records one after the other, from the first on, and end at a sample of theirs.

    >>> print([in_order(np.array(record), np.array([3, 1]), 4) for record in ([0, 0], [0, 1], [1, 1], [0, 2], [1, 0])])
    [True, True, False, False, False]
    >>> print([in_order(np.array([0, 1]), np.array(last), 4) for last in ([0, 4], [-1, 4], [0, 5])])
    [True, False, False]
    """
    steps = np.diff(record, prepend=0)
    return bool(record[0] == 0 and steps.min() >= 0 and steps.max() <= 1 and last.min() >= 0 and last.max() <= times)
