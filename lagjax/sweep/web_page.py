"""A sweep as a page with a slider for each axis: values, curves and motions of every point, and how each ended.

What can be drawn of the values of several lanes: numbers, and curves against time or against their index.
"""

import html
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.display import COLOURS, Page, encoded, film, film_scripts, fragment, in_bytes
from lagjax.integrate import RESULTS, Trajectory, film_of_lanes
from lagjax.sweep.axes import POINT, Axes
from lagjax.sweep.batch_program import NOT_RUN, TRUSTED
from lagjax.sweep.labels import key_of, motions_in, with_path, words_of
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
    curves = [{"name": name, "y": encoded(y, _precision(y))} for name, y in panel.curves.items()]
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
    size = BASE64_FACTOR * sum((2 if x.shape[-1] == 2 else 4) * x.size for x in points.values())
    if size > 1e6 * megabytes:
        raise ValueError(
            f"the film would take {in_bytes(size)}, but the page may have {megabytes:g} MB.\n"
            "Fix: fewer points, a lower rate such as rate=10.0, or fewer seconds; or a larger megabytes=..."
        )
    return film(at, points, rate, kept)
