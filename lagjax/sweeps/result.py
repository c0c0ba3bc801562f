"""The answer of a sweep: values and statuses by axis, printed, plotted, exported, and what failed run again."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax import plot
from lagjax.mechanics import coordinates
from lagjax.motion.trajectory import Trajectory, in_words
from lagjax.sweeps.axes import POINT, Axes
from lagjax.sweeps.fingerprint import in_words as versions_in_words
from lagjax.sweeps.fingerprint import named_leaves, versions
from lagjax.sweeps.lanes import LOST, NOT_RUN, TRUSTED, Status
from lagjax.sweeps.metadata import restore
from lagjax.sweeps.store import Store, nothing, tell

COMPUTED_AGAIN = (
    "These points are lost in status, and NaN or 0 in values.\n"
    "Fix: lj.sweep(run, axes, store=path), which computes them again."
)


class Sweep:
    """What a sweep found, by axis. It prints how its points went, plots itself and exports to xarray.

    - `axes`: the names and values of what varied; `dims` the dimensions and their lengths.
    - `values`: what `run` returned, each leaf with the axes in front (NumPy). NaN where a point failed. Of a sweep with
      a store they are read from it when asked for; what cannot be read is told, and lost in `status`.
    - `status`: a `Status` of arrays in the shape of the axes; `ok` where the values are to be trusted.
    - `how`: what ran it, in words; `ran` how many points this call computed, in how many `seconds`, after so many of
      `compiling`: 0 where a sweep before it had done that.
    """

    def __init__(
        self,
        axes: Axes,
        values: "PyTree | Stored",
        status: Status,
        how: str,
        ran: int,
        compiling: float,
        seconds: float,
        again: Callable,
    ):
        self.axes = axes
        self.status = Status(*(x.reshape(axes.shape) for x in status))
        self.how, self.ran, self.compiling, self.seconds = how, ran, compiling, seconds
        self._values, self._again = values, again

    def __getstate__(self):
        # What ran it is a compiled program, which stays where it was compiled.
        return self.__dict__ | {"_again": _cannot}

    @property
    def dims(self) -> dict[str, int]:
        """The dimensions and their lengths."""
        return self.axes.dims

    @property
    def values(self) -> PyTree:
        """What `run` returned, each leaf with the axes in front."""
        flat = self._values
        if isinstance(flat, Stored):
            flat, lost = flat.read(self.status.result.reshape(-1) == LOST)
            self.status.result.reshape(-1)[lost] = LOST
        return jax.tree.map(lambda x: x.reshape(self.axes.shape + x.shape[1:]), flat)

    @property
    def ok(self) -> np.ndarray:
        """Which points were computed to their end, drifting no more than the tolerance lets expect, or fitted well."""
        return np.isin(self.status.result, TRUSTED)

    def counts(self) -> dict[str, int]:
        """How many points went which way, in words, the most frequent first."""
        codes, counts = np.unique(self.status.result, return_counts=True)
        return {_words(codes[i]): int(counts[i]) for i in np.argsort(-counts)}

    def resweep(self, run: Callable | None = None, where=None) -> "Sweep":
        """Run the points that are not `ok` again, with another `run` (other settings), and keep the rest.

        **Arguments:** `run` as in `lj.sweep`, returning the same structure; by default the same one, which finishes a
        sweep that was interrupted. `where`: booleans in the shape of the axes, of the points to run.

        **Returns:** a new `Sweep`, in memory.
        """
        where = ~self.ok if where is None else np.broadcast_to(np.asarray(where, bool), self.axes.shape)
        return self._again(self, run, np.flatnonzero(where.reshape(-1)))

    def to_xarray(self):
        """Values, statuses and axes as an `xarray.Dataset`, with dimensions and coordinates by name.

        The outputs of a `Trajectory` have the dimension `t`, where all points share their times.

        **Raises:** `ImportError` without xarray; `ValueError` for two values of one name.
        """
        try:
            import xarray
        except ImportError as error:
            raise ImportError('this needs xarray, an optional extra.\nFix: pip install "lagjax[data]"') from error
        coords, variables = self._coordinates(), {}
        for name, dims, x in self._labelled(coords):
            # An axis of that name is a coordinate.
            free = f"value_{name}" if name in coords else name
            if free in variables:
                raise ValueError(f"two of the values are named '{name}'.\nFix: another key in what run returns.")
            variables[free] = ((*self.dims, *dims), x)
        for name, x in zip(Status._fields, self.status):
            variables[f"status_{name}" if name in variables else name] = (tuple(self.dims), x)
        dataset = xarray.Dataset(variables, coords)
        codes = np.unique(self.status.result)
        dataset["result"].attrs = {"flag_values": codes.tolist(), "flag_meanings": [_words(code) for code in codes]}
        dataset.attrs = {"how": self.how}
        return dataset

    def plot(self, value: str | Callable | None = None):
        """Draw values over the axes: lines over one, a map over two, a map for each value of the first over three.

        **Arguments:** `value`: the name of a leaf, or a function of `values` that returns an array in the shape of the
        axes; by default every leaf with one number a point. Lines mark what is not `ok`; NaN is grey in maps. A
        `Trajectory` over one axis is drawn against time, a curve a point.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` where there is no such value, or more than three axes.
        """
        values = self.values
        if value is None and isinstance(values, Trajectory) and len(self.axes.shape) == 1:
            return self._plot_motions(values)
        panels = self._panels(values, value)
        if self.axes.paired:
            name, x = next(iter(self.axes.values.items()))
            return plot.lines(name, x if x.ndim == 1 else np.arange(len(x)), panels, ~self.ok)
        axes = {name: x if x.ndim == 1 else np.arange(len(x)) for name, x in self.axes.values.items()}
        if len(axes) == 1:
            ((name, x),) = axes.items()
            return plot.lines(name, x, panels, ~self.ok)
        if len(axes) > 3:
            raise ValueError(
                f"a picture has room for three axes, and this sweep has {len(axes)}: {', '.join(axes)}.\n"
                "Fix: choose a part with swept.to_xarray().isel(...) and plot that."
            )
        return plot.maps(axes, panels)

    def _plot_motions(self, motions):
        (name, x), *others = self.axes.values.items()
        if others or x.ndim > 1:
            name, x = POINT if others else name, np.arange(len(x))
        columns = [q.reshape(*motions.t.shape, -1) for q in jax.tree.leaves(motions.q)]
        curves = np.moveaxis(np.concatenate(columns, axis=-1), -1, 0)
        one = jax.tree.map(lambda q: q[0, 0], motions.q)
        return plot.families(name, x, motions.t, dict(zip(coordinates.names(one), curves)))

    def _panels(self, values, value):
        if callable(value):
            chosen = {"value": np.asarray(value(values))}
        else:
            of_motions = jax.tree.map(_without_motion, values, is_leaf=lambda x: isinstance(x, Trajectory))
            drawn = named_leaves(of_motions if value is None else values)
            chosen = {name: x for name, x in drawn if value is None or name == value}
        numbers = {name: x for name, x in chosen.items() if x.shape == self.axes.shape}
        if not numbers:
            there = ", ".join(f"'{name}' {x.shape[len(self.axes.shape) :]}" for name, x in named_leaves(values))
            named = f" named {value!r}" if isinstance(value, str) else ""
            raise ValueError(
                f"there is no value{named} with one number a point; a point has {there}.\n"
                "Fix: choose one, as swept.plot(lambda values: values.q[..., -1])."
            )
        return numbers

    def _coordinates(self):
        if self.axes.paired:
            return {name: ((POINT, *_inner(name, x)), x) for name, x in self.axes.values.items()}
        flat = {name: x for name, x in self.axes.values.items() if x.ndim == 1}
        slices = {f"{name}_values": ((name, *_inner(name, x)), x) for name, x in self.axes.values.items() if x.ndim > 1}
        return flat | slices

    def _labelled(self, coords):
        """Every array as (name, dimensions behind the axes, values); shared times become a coordinate."""
        found, values = [], self.values
        lead = len(self.axes.shape)
        for path, part in jax.tree_util.tree_leaves_with_path(values, is_leaf=lambda x: isinstance(x, Trajectory)):
            key = jax.tree_util.keystr(path, simple=True, separator=".")
            if not isinstance(part, Trajectory):
                found.append((key or "value", tuple(_inner(key or "value", part, lead)), part))
                continue
            under = f"{key}." if key else ""
            times = part.t[self.status.result != NOT_RUN]
            t = f"{under}t"
            if len(times) and np.all(times == times[0]):
                coords[t] = times[0]
            else:
                found.append((f"{under}times", (t,), part.t))
            for leaf_path, x in jax.tree_util.tree_leaves_with_path({"q": part.q, "v": part.v, **part.multipliers}):
                name = under + jax.tree_util.keystr(leaf_path, simple=True, separator=".")
                found.append((name, (t, *_inner(name, x, lead + 1)), x))
        return found

    def __repr__(self):
        size, steps = self.axes.size, self.status.steps.reshape(-1)
        dims = " x ".join(f"{name} ({n})" for name, n in self.dims.items())
        rows = [("points", f"{size:,}: {dims}")]
        rows += [("status" if i == 0 else "", f"{n:,} {words}") for i, (words, n) in enumerate(self.counts().items())]
        if bad := np.flatnonzero(~self.ok.reshape(-1)).tolist():
            rows.append(("first not ok", self.axes.words(bad[0])))
        if steps.any():
            worst = int(np.argmax(steps))
            rows.append(
                ("steps a point", f"{int(np.median(steps)):,} (median), {steps[worst]:,} at {self.axes.words(worst)}")
            )
        residual = self.status.residual[np.isfinite(self.status.residual)]
        if residual.any():
            rows.append(("worst constraint residual", f"{residual.max():.1e} (relative)"))
        rows.append(("values", ", ".join(self._shapes())))
        rows.append(("run", self.how))
        if self.ran:
            compiled = f"compiled in {self.compiling:.3g} s" if self.compiling else "nothing had to be compiled"
            rows.append(("", f"{compiled}; computed in {self.seconds:.3g} s, {self.ran / self.seconds:,.0f} points/s"))
        width = max(len(label) for label, _ in rows)
        return "\n".join(["Sweep", *(f"  {label:<{width}}  {value}" for label, value in rows)])

    def _shapes(self):
        shown = []
        leaves = self._values.like if isinstance(self._values, Stored) else jax.tree.map(lambda x: x[0], self._values)
        is_trajectory = lambda x: isinstance(x, Trajectory)
        for path, part in jax.tree_util.tree_leaves_with_path(leaves, is_leaf=is_trajectory):
            name = jax.tree_util.keystr(path, simple=True, separator=".")
            if is_trajectory(part):
                shown.append(f"{name or 'value'} Trajectory at {part.t.shape[-1]} times")
            else:
                shown.append(f"{name or 'value'} {part.dtype}{list(part.shape) if part.shape else ''}")
        return shown


def _inner(name, x, lead=1):
    return [f"{name}_{i}" for i in range(np.ndim(x) - lead)]


def _without_motion(part):
    return None if isinstance(part, Trajectory) else part


def _words(code):
    return {NOT_RUN: "not run", LOST: "lost from the store"}.get(int(code)) or in_words(code)


def open_sweep(path: str | os.PathLike) -> Sweep:
    """Open the sweep in a store, without what ran it: its values are a dictionary by name.

    Any version of lagjax, jax and diffrax may have written it. Statuses are read now, values when they are asked for.
    A file that is missing, cut off or of another block is seen now, without reading the values; one that has changed
    inside, when they are read. Either is told by name, and from then on its points are "lost from the store" in
    `status`, and not `ok`; `lj.sweep(run, axes, store=path)` computes them again.

    >>> import tempfile
    >>> import lagjax as lj
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     done = lj.sweep(lambda point: point["x"] ** 2, {"x": [1.0, 2.0]}, store=folder + "/squares", progress=False)
    ...     print(open_sweep(folder + "/squares").values["value"])
    [1. 4.]

    **Arguments:** `path`: the folder that `lj.sweep` was given as `store`.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` where there is no store, or nothing can be told of it.
    """
    path = Path(path)
    if wrong := restore(path):
        tell(path, wrong, "It is put back; nothing needs to be done.", stacklevel=2)
    store = Store(path, "r")
    axes, (status, missing, lost) = store.axes(), store.status()
    if lost:
        tell(path, lost.values(), COMPUTED_AGAIN, stacklevel=2)
    how = f"from {path}" + (f", of which {len(missing)} blocks are missing" if missing else "")
    if (by := store.about["fingerprint"]["versions"]) != versions():
        how += f", written by {versions_in_words(by)}"
    return Sweep(axes, Stored(store, None), status, how, 0, 0.0, 0.0, _cannot)


def _cannot(swept, run, indices):
    raise ValueError(
        "a sweep that was opened from its store, or copied, does not know what ran it.\n"
        "Fix: lj.sweep(run, axes, store=path), which computes what is missing; without a store lj.sweep(run, axes)."
    )


class Stored:
    """The values of a store, read when asked for; `like` has the shapes of one point."""

    def __init__(self, store: Store, like: PyTree):
        self.store, self._like = store, like

    @property
    def like(self) -> Any:
        """One point's values, as shapes."""
        return self.store.one() if self._like is None else self._like

    def read(self, known: np.ndarray) -> tuple[PyTree, np.ndarray]:
        """(the values, which points are lost); those that are not `known` to be are told."""
        values, lost = self.store.values(self._like)
        where, new = known.copy(), []
        for number, wrong in lost.items():
            here = self.store.points(number)
            new += [] if known[here].all() else [wrong]
            where[here] = True
        if new:
            tell(self.store.path, new, COMPUTED_AGAIN, stacklevel=3)
        for x in jax.tree.leaves(values):
            x[where] = nothing(x.dtype)
        return values, where
