"""Read fits from files, with the functions that the user passes again."""

import os
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from lagjax.fitting.result import Fit
from lagjax.fitting.starts import unflatten_of
from lagjax.mechanics import files
from lagjax.mechanics.file_table import Table
from lagjax.mechanics.hybrid import Hybrid, first_phase, replace_fields
from lagjax.mechanics.memory import kinds
from lagjax.mechanics.printable import printable
from lagjax.mechanics.signature import UnknownSystem
from lagjax.mechanics.system import System
from lagjax.mechanics.written_trees import NotGiven, Reader
from lagjax.motion.saved import described_system, same_system


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
    with files.opened(path, "fit") as (contents, array):
        reader, asked = Reader(array, table=table), contents["functions"]
        if not isinstance(asked, list) or not all(isinstance(role, str) for role in asked):
            raise ValueError("its list of functions is not one that lagjax writes.")
        said, unflatten = reader.up(contents["known"]), unflatten_of(kinds(reader.up(contents["q"])))
        described = described_system(said)
        given: dict[str, Any] = {"system": described, "first": described, "unflatten": unflatten}
        reader.given = lambda role: given[role] if role in given else NotGiven(_short(role))
        found = reader.up(contents["fit"])
        check_shapes(found, described)
    if unknown := sorted(set(known) - set(asked)):
        raise TypeError(
            f"this fit has no {', '.join(_short(role) for role in unknown)} to be passed again.\n"
            f"It has {', '.join(printable(_short(role)) for role in asked)}."
        )
    return _with(found, known, described, path)


def _with(found: Fit, known: dict[str, Any], described: UnknownSystem, path) -> Fit:
    """A fit with the functions that the user passes again."""
    problem, fields = found.problem, {}
    if "observe" in known:
        fields["observe"] = known["observe"]
    if "system" in known:
        system: Any = same_system(known["system"], described, path)
        if described.phase is not None:
            system = replace_fields(system, first=np.asarray(described.phase, np.int32))
        fields |= {"system": system, "first": first_phase(system)}
    options = {name: known.get(f"options.{name}", x) for name, x in problem.options.items()}
    training = found.training
    if training is not None and training.held_back is not None:
        training = replace(training, held_back=_with(training.held_back, known, described, path))
    return replace(found, problem=replace(problem, options=options, **fields), training=training)


def check_shapes(found: Fit, described: UnknownSystem) -> None:
    """Raise `ValueError` if the numbers of a fit do not belong together."""
    problem = found.problem
    numbers, windows, starts = problem.found, problem.windows, problem.starts
    p, (count, times), n = len(numbers.names), windows.ts.shape, np.size(problem.unit) // 2
    k, searched = starts.unknowns, found.unknowns

    def check(name, *expected):
        for x, shape in expected:
            if np.shape(x)[: len(shape)] != shape or not isinstance(x, (np.ndarray, np.generic, jax.Array)):
                raise ValueError(f"{name} of shape {np.shape(x)} does not belong to {p} numbers in {count} windows.")

    of_numbers = (numbers.start, numbers.low, numbers.high, numbers.mean, numbers.sd, searched.shared)
    check("found", *((x, (p,)) for x in of_numbers), (searched.local, (count, k)))
    check("windows", *((x, (count, times)) for x in (windows.real, windows.sample)))
    check("windows", *((x, (count,)) for x in (windows.last, windows.seam, windows.record)))
    check("starts", *((x, (count, n)) for chart in starts for x in chart), (problem.unit, (2 * n,)))
    check("starts", *((chart.along, (count, n, k)) for chart in starts))
    for kind, tree in problem.measured.items():
        lead = (count,) if kind == "end" else (count, times)
        for x, sigma in zip(jax.tree.leaves(tree), jax.tree.leaves(problem.sigma[kind]), strict=True):
            check(kind, (x, lead), (sigma, lead))
    records, order = len(windows.first), np.diff(windows.record, prepend=-1)
    known_starts = jax.tree.leaves(described.starts)
    check("starts", *((x, (records,)) for x in known_starts))
    if windows.record[0] != 0 or order.min() < 0 or order.max() > 1 or not 0 <= windows.last.min() <= times:
        raise ValueError("its windows are not in the order of its records.")
    if found.evaluation is not None:
        at = found.evaluation
        of, determined = at.covariance, at.determined
        check("covariance", (of.shared, (p, p)), (of.local, (count, k, k)), (of.local_shared, (count, k, p)))
        check("determined", (determined.shared, (p,)), (determined.local, (count, k)), (at.rows, (count,)))
        check("combinations", (at.combinations, (p, p)), (at.singular_values, (p,)))
    leaves = jax.tree.leaves(numbers.params)
    sizes = [np.size(leaves[number]) if places is None else len(places) for number, places in numbers.leaves]
    inside = all(0 <= i < np.size(leaves[number]) for number, places in numbers.leaves for i in places or ())
    if sum(sizes) != p or not inside:
        raise ValueError(f"its parameters do not hold {p} numbers.")
    if found.training is not None and found.training.held_back is not None:
        check_shapes(found.training.held_back, replace(described, starts=None))


def _short(role):
    return role.removeprefix("options.")
