"""The result of a sweep: values and statuses by axis; printing, plotting, exporting, a page; failed points again.

A page has a slider for each axis, and shows values, curves and motions of every point, and how each ended.

What is drawn of the values of several lanes: numbers, and curves against time or against their index.
"""

import html
import os
from collections.abc import Callable, Iterable
from copy import copy
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import COLOURS, Page, encoded, encoded_once, film, film_scripts, fragment, in_bytes, labelled
from lagjax.display import plots as plot
from lagjax.files import Table
from lagjax.integrate import RESULTS, Trajectory, film_of_lanes
from lagjax.sweep import labels
from lagjax.sweep import store as structure
from lagjax.sweep.axes import POINT, Axes
from lagjax.sweep.engine import LOST, NOT_RUN, TRUSTED, Status, is_motion, nothing
from lagjax.sweep.labels import key_of, motions_in, named_leaves, with_path, words_of
from lagjax.sweep.metadata import damaged, metadata_of, versions
from lagjax.sweep.metadata import in_words as versions_in_words
from lagjax.sweep.objects import Files
from lagjax.sweep.store import Store, warn_of_damage
from lagjax.system import Call, check_arguments, coordinates

# More curves than this in one panel cannot be told apart.
MOST_CURVES = 14
INDEX = "index"


class Panel(NamedTuple):
    """Curves over one axis: `x` (N, T) named `across`, and `curves` by name, (N, T), for N lanes."""

    label: str
    across: str
    x: np.ndarray
    curves: dict[str, np.ndarray]


class Drawn(NamedTuple):
    """`numbers` by name, (N,); `panels`; and, in words, the values `left_out`."""

    numbers: dict[str, np.ndarray]
    panels: list[Panel]
    left_out: list[str]


def drawn(values: PyTree, of_motion: tuple[str, ...] = ("q", "v", "multipliers")) -> Drawn:
    """What can be drawn of values whose leaves have the lanes as first axis, (N, ...).

    A `Trajectory` gives the curves named in `of_motion` against its times. One number per lane stays a number. An array
    gives one curve per column, against the array `t` in the same dictionary if there is one, else against its index.
    """
    found = Drawn({}, [], [])
    named = {key_of(path): leaf for path, leaf in with_path(values)}
    for name, x in named.items():
        if isinstance(x, Trajectory) and np.ndim(x.t) > 2:
            found.left_out.append(f"{name or 'value'}, a batch of trajectories")
            continue
        if isinstance(x, Trajectory):
            found.panels.extend(_of_motion(name, x, of_motion))
            continue
        parent, _, last = name.rpartition(".")
        times = named.get(f"{parent}.t" if parent else "t")
        times = None if isinstance(times, Trajectory) else times
        if last == "t" and np.ndim(x) == 2 and len(named) > 1:
            continue
        for part, x in _real_parts(name or "value", np.asarray(x)):
            _add(found, part, x, times)
    return found


def _of_motion(name: str, motion: Trajectory, of_motion: tuple[str, ...]):
    t, prefix = np.asarray(motion.t), f"{name}: " if name else ""
    parts = {"q": motion.q, "v": motion.v, "multipliers": motion.multipliers}
    for part in of_motion:
        leaves = [np.asarray(x).reshape(*t.shape, -1) for x in jax.tree.leaves(parts[part])]
        if not leaves:
            continue
        one = jax.tree.map(lambda x: np.asarray(x)[0, 0], parts[part])
        columns = np.moveaxis(np.concatenate(leaves, axis=-1), -1, 0)
        curves = dict(zip(coordinates.names(one), columns))
        first = next(iter(curves))
        label = part if len(curves) > 1 or first == "q" else f"{part}: {first}"
        yield Panel(prefix + label, "t", t, curves)


def _real_parts(name: str, x: Any):
    if np.iscomplexobj(x):
        return [(f"{name} (real)", x.real), (f"{name} (imaginary)", x.imag)]
    return [(name, x.astype(float))]


def _add(found: Drawn, name: str, x: np.ndarray, times: Any):
    if x.ndim == 1:
        found.numbers[name] = x
        return
    columns = np.moveaxis(x.reshape(*x.shape[:2], -1), -1, 0)
    if len(columns) > MOST_CURVES or x.shape[1] < 2 or len(columns) == 0:
        found.left_out.append(f"{name} of shape {x.shape[1:]}")
        return
    inner = list(np.ndindex(*x.shape[2:]))
    suffixes = ["" if not i else str(list(i)) for i in inner]
    against_times = times is not None and np.shape(times) == x.shape[:2]
    at = np.asarray(times, float) if against_times else np.broadcast_to(np.arange(x.shape[1], dtype=float), x.shape[:2])
    curves = {name + end: column for end, column in zip(suffixes, columns)}
    found.panels.append(Panel(name, "t" if against_times else INDEX, at, curves))


# Characters of base64 per byte.
BASE64_FACTOR = 4 / 3
# A page of this size opens in a browser without delay, and can be sent by mail.
MOST_MEGABYTES = 25.0
# `positions` is called in Python for every frame of every point.
MOST_FRAMES = 100_000
EVENT = int(RESULTS.event_occurred._value)


def page_of(
    axes: Axes,
    values: PyTree,
    codes: np.ndarray,
    positions: Callable | None,
    megabytes: float,
    film_settings: dict[str, Any],
) -> Page:
    """The page of a sweep; `values` (N, ...) and `codes` (N,), the results, have the lanes as first axis."""
    found = drawn(values)
    _check_size(axes, found, megabytes)
    film_spec, body = None, ""
    if positions is not None:
        body, film_spec = _film(axes, values, codes, positions, megabytes, **film_settings)
    if not found.numbers and not found.panels and film_spec is None:
        contents = "; ".join(found.left_out) or "nothing"
        raise ValueError(
            f"there is nothing to draw: each point has {contents}.\n"
            "Fix: return numbers, a Trajectory, or arrays over time with few columns from run."
        )
    spec = {
        "axes": _axes(axes),
        "start": [n // 2 for n in axes.shape],
        "status": encoded(codes, "i1"),
        "words": {str(code): words_of(code) for code in np.unique(codes).tolist()},
        "trusted": list(TRUSTED),
        "numbers": [{"name": name, "values": encoded(x, "f8")} for name, x in found.numbers.items()],
        "panels": [_panel(panel, codes) for panel in found.panels],
        "colours": list(COLOURS),
        "film": film_spec,
    }
    left_out = html.escape("; ".join(found.left_out))
    note = f'<p class="note">Not drawn: {left_out}.</p>' if left_out else ""
    notice = "The sliders need scripts: allow them, or trust this notebook."
    body = (
        f'<div data-controls=""></div><p data-status="" role="status">{notice}</p>\n{body}'
        f'<div data-views=""></div>{note}'
    )
    page = fragment(body, spec, (*film_scripts(film_spec or {}), "chart.js", "sliders.js"))
    dims = " x ".join(f"{name} ({n})" for name, n in axes.dims.items())
    return Page(f"Sweep over {', '.join(axes.names)}", page, f"Page of {axes.size:,} points, {dims}")


def _axes(axes: Axes):
    """One slider per axis: its name, the labels of its positions, and their coordinates in a picture."""
    if axes.paired:
        labels = [axes.words(i) for i in range(axes.size)]
        return [{"name": POINT, "labels": labels, "at": list(range(axes.size))}]
    sliders = []
    for name, x in axes.values.items():
        is_numeric = x.ndim == 1 and np.all(np.isfinite(x)) and x.dtype != bool and not np.iscomplexobj(x)
        at = x.astype(float).tolist() if is_numeric else list(range(len(x)))
        labels = [f"{value:.6g}" for value in at] if is_numeric else [_label(value, i) for i, value in enumerate(x)]
        sliders.append({"name": name, "labels": labels, "at": at})
    return sliders


def _label(value: Any, i: int):
    return str(value) if np.ndim(value) == 0 else f"no. {i} of shape {np.shape(value)}"


def _panel(panel: Panel, codes: np.ndarray):
    ran = panel.x[codes != NOT_RUN]
    shared = len(ran) > 0 and np.array_equal(ran, np.broadcast_to(ran[0], ran.shape), equal_nan=True)
    x = ran[0] if shared else panel.x
    curves = [{"name": name, "y": encoded_once(y[..., None], _precision(y))} for name, y in panel.curves.items()]
    spec = {"label": panel.label, "across": panel.across, "length": panel.x.shape[1]}
    return spec | {"x": encoded(x, _precision(x)), "curves": curves}


def _precision(x: np.ndarray):
    """Single precision, if it resolves the variation of the data."""
    finite = x[np.isfinite(x)]
    if finite.size == 0:
        return "f4"
    largest, distance = np.max(np.abs(finite)), np.max(finite) - np.min(finite)
    return "f4" if (largest == 0 or 1e-30 < largest < 1e30) and not 0 < distance < 1e-3 * largest else "f8"


def _check_size(axes: Axes, found: Drawn, megabytes: float):
    curves = [y for panel in found.panels for y in panel.curves.values()]
    numbers = len(found.numbers) + sum(y.size for y in curves) // axes.size
    size = BASE64_FACTOR * (8 * axes.size * len(found.numbers) + sum(int(_precision(y)[1]) * y.size for y in curves))
    if size > 1e6 * megabytes:
        raise ValueError(
            f"the page would be larger than {in_bytes(size)}, but may have {megabytes:g} MB: {axes.size:,} points of "
            f"{numbers:,} numbers each.\n"
            "Fix: fewer points, or fewer times ts in run; or a larger megabytes=..."
        )


def _film(
    axes: Axes,
    values: PyTree,
    codes: np.ndarray,
    positions: Callable,
    megabytes: float,
    seconds: float | None,
    rate: float,
    trail: float,
):
    check_arguments(Call("positions", positions, ("t", "q", "params")), "an argument left out that is not needed")
    motions = motions_in(values)
    if len(motions) != 1:
        raise ValueError(
            f"positions(t, q, params) draws a motion, and run returned {len(motions)} trajectories.\n"
            "Fix: run = lambda point: lj.integrate(system, q0, v0, params | point, ts=ts)."
        )
    lanes = jax.tree.map(np.asarray, motions[0])
    trajs = [jax.tree.map(lambda x, i=i: x[i], lanes) if code != NOT_RUN else None for i, code in enumerate(codes)]
    frames = axes.size * rate * (seconds or 2.0)
    if frames > MOST_FRAMES:
        raise ValueError(
            f"{axes.size:,} points are more than {MOST_FRAMES:,} frames, and positions is called for each frame.\n"
            "Fix: fewer points, a lower rate such as rate=10.0, or fewer seconds."
        )
    at, points, kept = film_of_lanes(trajs, positions, seconds, rate, trail, [code == EVENT for code in codes])
    body, spec = film(at, points, rate, kept)
    size = sum(len(part.get("xy", part.get("xyz"))[1]) for part in spec["parts"])
    if size > 1e6 * megabytes:
        raise ValueError(
            f"the film would take {in_bytes(size)}, but the page may have {megabytes:g} MB.\n"
            "Fix: fewer points, a lower rate such as rate=10.0, or fewer seconds; or a larger megabytes=..."
        )
    return body, spec


RESTORED = "Fix: lj.sweep(run, axes, store=path), which restores it."
COMPUTED_AGAIN = (
    "These points are marked as lost in status, and are NaN or 0 in values.\n"
    "Fix: lj.sweep(run, axes, store=path), which computes them again."
)


class Sweep:
    """The result of a sweep, by axis. It prints how its points ended, plots itself and exports to xarray.

    - `axes`: the names and values of the parameters that varied; `dims`: the dimensions and their lengths.
    - `values`: what `run` returned, each leaf with the axes in front (NumPy), NaN where a point failed. With a store
      they are read from it on access; blocks that cannot be read cause a warning and are lost in `status`.
    - `status`: a `Status` of arrays in the shape of the axes; `ok` is True where the values can be trusted.
    - `how`: a description of what ran it; `ran`: how many points this call computed, in how many `seconds`, after
      `compiling` seconds of compilation: 0 if an earlier sweep had compiled the program.
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

    def __copy__(self):
        same = object.__new__(Sweep)
        same.__dict__.update(self.__dict__)
        return same

    def __deepcopy__(self, memo: dict):
        # Only arrays are copied: structures, systems and the engine never change.
        same, values = copy(self), self._values
        same.axes, same.status = (jax.tree.map(np.copy, x) for x in (self.axes, self.status))
        same._values = values if isinstance(values, Stored) else jax.tree.map(np.copy, values)
        return same

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
        """Which points were computed to their end, with no more drift than the tolerance allows, or fitted well."""
        return np.isin(self.status.result, TRUSTED)

    def counts(self) -> dict[str, int]:
        """How many points ended with each result, in words, the most frequent first."""
        codes, counts = np.unique(self.status.result, return_counts=True)
        return {words_of(codes[i]): int(counts[i]) for i in np.argsort(-counts)}

    def resweep(self, run: Callable | None = None, where: ArrayLike | None = None) -> "Sweep":
        """Run the points that are not `ok` again, with another `run` (other settings), and keep the rest.

        **Arguments:** `run` as in `lj.sweep`, returning the same structure; by default the same one, which finishes a
        sweep that was interrupted. `where`: booleans in the shape of the axes, of the points to run.

        **Returns:** a new `Sweep`, in memory.
        """
        where = ~self.ok if where is None else np.broadcast_to(np.asarray(where, bool), self.axes.shape)
        which = np.flatnonzero(where.reshape(-1))
        return self._again(self, run, which) if len(which) else self

    def to_xarray(self):
        """Values, statuses and axes as an `xarray.Dataset`, with dimensions and coordinates by name.

        The outputs of a `Trajectory` have the dimension `t` if all points share their times. The attributes of `result`
        say what its numbers mean (`flag_values`, `flag_meanings`). A value that is named like an axis gets the prefix
        `value_`. A store has the same names: `xarray.open_zarr(path)`.

        **Raises:** `ImportError` without xarray; `ValueError` if two values have the same name.
        """
        return labels.dataset(self)

    def to_pandas(self, values: Callable | None = None):
        """A `pandas.DataFrame` with one row per point: the axes, what `run` returned, how the point ended.

        >>> import numpy as np
        >>> import lagjax as lj
        >>> run = lambda point: {"sum": point["a"] + point["b"], "both": point["a"] * np.array([1.0, 10.0])}
        >>> swept = lj.sweep(run, {"a": np.array([1.0, 2.0]), "b": np.array([0.5])}, progress=False)
        >>> print(swept.to_pandas().drop(columns=["steps", "scaled_error", "residual"]))
             a    b  both[0]  both[1]  sum      result
        0  1.0  0.5      1.0     10.0  1.5  successful
        1  2.0  0.5      2.0     20.0  2.5  successful

        Rows are in the order of the points, the last axis fastest. An array of a point has one column per number, up
        to 100; `result` is categorical, in words.

        **Arguments:** `values`: a function of `swept.values` that returns the values to show instead, each with the
        axes in front: `lambda values: {"end": values.q[..., -1]}`. Trajectories require it.

        **Raises:** `ImportError` without pandas; `ValueError` if a point has more numbers than fit into a row.
        """
        return labels.frame(self, values)

    def plot(self, value: str | Callable | None = None):
        """Draw values over the axes: lines over one, a map over two, a map for each value of the first over three.

        Of two axes, one with up to seven values is drawn as a curve for each of them.

        **Arguments:** `value`: the name of a leaf, or a function of `values` that returns an array in the shape of the
        axes; by default every leaf with one number per point. Line plots mark points that are not `ok`; NaN is grey in
        maps. A `Trajectory` over one axis is drawn against time, one curve per point.

        **Returns:** a matplotlib `Figure`.

        **Raises:** `ValueError` if there is no such value, or there are more than three axes.
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
                f"a figure can show three axes, and this sweep has {len(axes)}: {', '.join(axes)}.\n"
                "Fix: choose a part with swept.to_xarray().isel(...) and plot that."
            )
        if len(axes) == 2 and min(map(len, axes.values())) <= len(plot.COLOURS):
            (few, values), (name, x) = sorted(axes.items(), key=lambda axis: len(axis[1]))
            turned = {key: y if few == next(iter(axes)) else y.T for key, y in (panels | {"": self.ok}).items()}
            return plot.lines(name, x, {key: turned[key] for key in panels}, ~turned[""], (few, values))
        return plot.maps(axes, panels)

    def to_html(
        self,
        path: str | os.PathLike | None = None,
        *,
        positions: Callable | None = None,
        seconds: float | None = None,
        rate: float = 25.0,
        trail: float = 2.0,
        megabytes: float = MOST_MEGABYTES,
    ) -> Page:
        """Make a page with a slider for each axis, which works without Python and without a network.

        >>> import jax.numpy as jnp
        >>> import lagjax as lj
        >>> swept = lj.sweep(lambda point: {"height": point["v"] ** 2 / 20}, {"v": jnp.arange(3.0)}, progress=False)
        >>> swept.to_html()  # doctest: +ELLIPSIS
        Page of 3 points, v (3), ... kB: works in a notebook, and with .save("page.html") in a browser

        It shows how the chosen point ended, in words. A value with one number per point is shown as a number, and as a
        curve over the axis that was moved last; a `Trajectory` as curves against time; an array as curves, one per
        column, against the array `t` in the same dictionary, or else against the index. What happens between two
        outputs is not seen.

        **Arguments:**

        - `path`: where to write the page; it can also be written later: `page.save(path)`.
        - `positions`, `seconds`, `rate`, `trail`: for a sweep of trajectories, a film as made by `Trajectory.animate`.
        - `megabytes`: the largest allowed size of the page.

        **Returns:** a `Page`, which shows itself in a notebook.

        **Raises:** `ValueError` if there is nothing to draw, or the page would be too large.
        """
        lead = len(self.axes.shape)
        flat = jax.tree.map(lambda x: np.asarray(x).reshape(self.axes.size, *np.shape(x)[lead:]), self.values)
        codes, film_settings = self.status.result.reshape(-1), {"seconds": seconds, "rate": rate, "trail": trail}
        page = page_of(self.axes, flat, codes, positions, megabytes, film_settings)
        if path is not None:
            page.save(path)
        return page

    def _plot_motions(self, motions: Trajectory):
        (name, x), *others = self.axes.values.items()
        if others or x.ndim > 1:
            name, x = POINT if others else name, np.arange(len(x))
        columns = [q.reshape(*motions.t.shape, -1) for q in jax.tree.leaves(motions.q)]
        curves = np.moveaxis(np.concatenate(columns, axis=-1), -1, 0)
        one = jax.tree.map(lambda q: q[0, 0], motions.q)
        return plot.families(name, x, motions.t, dict(zip(coordinates.names(one), curves)))

    def _panels(self, values: PyTree, value: str | Callable | None):
        if callable(value):
            chosen = {"value": np.asarray(value(values))}
        else:
            without_motions = jax.tree.map(lambda x: None if is_motion(x) else x, values, is_leaf=is_motion)
            candidates = named_leaves(without_motions if value is None else values)
            chosen = {name: x for name, x in candidates if value is None or name == value}
        numbers = {name: x for name, x in chosen.items() if x.shape == self.axes.shape}
        if not numbers:
            contents = ", ".join(f"'{name}' {x.shape[len(self.axes.shape) :]}" for name, x in named_leaves(values))
            named = f" named {value!r}" if isinstance(value, str) else ""
            raise ValueError(
                f"there is no value{named} with one number per point; each point has {contents}.\n"
                "Fix: choose one, such as swept.plot(lambda values: values.q[..., -1])."
            )
        return numbers

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
            rows.append(("worst constraint residual", f"{residual.max():.1e} (relative, at the outputs)"))
        rows.append(("values", ", ".join(self._shapes())))
        rows.append(("run", self.how))
        if self.ran:
            compiled = f"compiled in {self.compiling:.3g} s" if self.compiling else "nothing had to be compiled"
            rows.append(("", f"{compiled}; computed in {self.seconds:.3g} s, {self.ran / self.seconds:,.0f} points/s"))
        return labelled("Sweep", rows)

    def _shapes(self):
        shown = []
        leaves = self._values.like if isinstance(self._values, Stored) else jax.tree.map(lambda x: x[0], self._values)
        for path, part in with_path(leaves):
            name = key_of(path)
            if is_motion(part):
                shown.append(f"{name or 'value'} Trajectory at {part.t.shape[-1]} times")
            else:
                shown.append(f"{name or 'value'} {part.dtype}{list(part.shape) if part.shape else ''}")
        return shown


def open_sweep(
    path: str | os.PathLike, *, run: Callable | None = None, system: Any = None, classes: Iterable[type] = ()
) -> Sweep:
    """Open the sweep in a store: its values have the structure of what `run` returned, trajectories included.

    A store is data: opening it imports nothing, runs nothing of it and writes nothing, whoever has written it; nothing
    outside of it is read. Other versions of lagjax, jax and diffrax may have written it.

    Statuses are read now, values on first access. A file that is missing, cut off or of another block is detected now,
    without reading the values; a file whose contents have changed is detected when the values are read. Either causes a
    warning that names the file; its points are then "lost from the store" in `status` and not `ok`.
    `lj.sweep(run, axes, store=path)` computes them again.

    >>> import tempfile
    >>> import lagjax as lj
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     done = lj.sweep(lambda point: point["x"] ** 2, {"x": [1.0, 2.0]}, store=folder + "/squares", progress=False)
    ...     print(open_sweep(folder + "/squares").counts())
    {'successful': 2}

    **Arguments:** `path`: the folder or URL that was passed to `lj.sweep` as `store`. Functions are not stored, so a
    trajectory does not know its system. It can be plotted and animated all the same. For methods that need the system
    (`print`, `drift()`), pass `system`, the one that was integrated, or `run`, the function that was swept; `run` is
    only traced, not run. `classes`: your own classes among the values, named tuples and dataclasses: `classes=[Pair]`.

    **Returns:** a `Sweep`.

    **Raises:** `ValueError` if there is no store, it is not as lagjax writes it, its description is damaged or of an
    earlier format, or `run` returns another structure. `values` is a dictionary by name for values that contain
    functions, or objects of classes that were not passed (which a warning names).
    """
    files, table = Files(path), Table(classes)
    store, path = Store(files), files.place
    if wrong := damaged(files, files.sizes(), metadata_of(store.about)):
        warn_of_damage(path, wrong.values(), "It is read all the same. " + RESTORED, stacklevel=2)
    axes, (status, missing, lost) = store.axes(), store.status()
    if lost:
        warn_of_damage(path, lost.values(), COMPUTED_AGAIN, stacklevel=2)
    how = f"from {path}" + (f", of which {len(missing)} blocks are missing" if missing else "")
    if (by := store.about["fingerprint"]["versions"]) != versions():
        how += f", written by {versions_in_words(by)}"
    if run is None:
        like = structure.as_stored(store, system, table)
    else:
        like = structure.as_run_returns(run, axes, store)
    return Sweep(axes, Stored(store, like), status, how, 0, 0.0, 0.0, opened)


def opened(swept: Sweep, run: Callable | None, indices: np.ndarray):
    """Refuse to run points of an opened sweep again."""
    raise ValueError(
        "a sweep that was opened from its store does not know the function that ran it.\n"
        "Fix: lj.sweep(run, axes, store=path), which computes what is missing; without a store lj.sweep(run, axes)."
    )


def of_store(swept: Sweep, run: Callable | None, indices: np.ndarray):
    """Refuse to run points of a sweep in a store with another function."""
    raise ValueError(
        "the values in a store belong to the run that it was begun with.\n"
        "Fix: lj.sweep(other, axes of the failed points, paired=True), or a sweep without a store."
    )


class Stored:
    """The values of a store, read on access; `like` has the shapes of one point. A pickle holds only the path."""

    def __init__(self, store: Store | Path | str, like: PyTree = None):
        self._store, self._like = store, like

    def __reduce__(self):
        place = self.store.place
        return Stored, (place if isinstance(place, str) else Path(os.path.abspath(place)),)

    @property
    def store(self) -> Store:
        """The store, opened on first access."""
        if not isinstance(self._store, Store):
            self._store = Store(Files(self._store))
        return self._store

    @property
    def like(self) -> Any:
        """One point's values, as shapes."""
        if self._like is None:
            # Unpickled.
            self._like = structure.as_stored(self.store, None, Table())
        return self._like

    def read(self, known: np.ndarray) -> tuple[PyTree, np.ndarray]:
        """(the values, which points are lost); warns of lost points that are not yet `known`."""
        values, lost = self.store.values(self.like)
        where, new = known.copy(), []
        for number, wrong in lost.items():
            here = self.store.blocks.points(number)
            new += [] if known[here].all() else [wrong]
            where[here] = True
        if new:
            warn_of_damage(self.store.place, new, COMPUTED_AGAIN, stacklevel=3)
        for x in jax.tree.leaves(values):
            x[where] = nothing(x.dtype)
        return values, where
