"""All plots, in one style. Needs matplotlib (`pip install "lagjax[plot]"`)."""

import io
from collections.abc import Sequence
from contextlib import contextmanager
from fractions import Fraction
from typing import NamedTuple

import numpy as np

from lagjax.refusals import installed

# Okabe & Ito's colours: distinct to colour-blind readers and in grey print, with a marker and dash each.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (8, 2)), (0, (1, 1)))
# The box behind text that overlaps marks.
ON_MARKS = {"facecolor": "white", "alpha": 0.85, "edgecolor": "none", "pad": 1.5}
MARKERS = ("o", "s", "^", "D", "v", "P", "X")


def figure(rows=1, columns=1, size=(4.6, 3.2), **options):
    """Make a figure of `rows` x `columns` axes, each of `size` inches; returns (figure, 2-D array of axes)."""
    import_matplotlib()
    from matplotlib.figure import Figure

    fig = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained", dpi=130)
    # Shown as the value of a notebook cell, without pyplot and the figures that it keeps open.
    setattr(fig, "_repr_png_", lambda: _png(fig))
    axes = fig.subplots(rows, columns, squeeze=False, **options)
    for axis in axes.flat:
        axis.grid(True, linewidth=0.4, alpha=0.5)
        axis.spines[["top", "right"]].set_visible(False)
    return fig, axes


def panel_axes(count, across, size):
    """Make a figure of `count` axes of `size` inches, at most `across` per row; returns (figure, axes)."""
    columns = min(across, count)
    fig, axes = figure(-(-count // columns), columns, size)
    for axis in axes.flat[count:]:
        axis.set_visible(False)
    return fig, list(axes.flat[:count])


def _png(fig):
    buffer = io.BytesIO()
    fig.savefig(buffer, format="png")
    return buffer.getvalue()


def import_matplotlib():
    """Import matplotlib, or say how to get it."""
    return installed("matplotlib", "this plot", "plot")


@contextmanager
def names_as_they_are():
    """A context or decorator in which a dollar in a text is no formula: names are the user's, or those of a file."""
    with import_matplotlib().rc_context({"text.parse_math": False}):
        yield


def style(i: int) -> dict:
    """Colour and dash of the i-th curve."""
    return {"color": COLOURS[i % len(COLOURS)], "linestyle": DASHES[i % len(DASHES)]}


@names_as_they_are()
def time_series(
    t, panels: dict[str, dict[str, np.ndarray]], strips: dict[str, list[tuple[float, float, str]]] | None = None
):
    """Draw curves against time, one panel per key of `panels`, one curve per name in it; strips below them.

    **Arguments:** `t` (T,); `panels` by axis label, curves (T,) by name; `strips`: by name, what holds from when until
    when, in a word that has a colour.

    **Returns:** a matplotlib `Figure`.
    """
    strips = strips or {}
    tall, row = 2.2, 0.24 * len(strips) + 0.35
    ratios = [tall] * len(panels) + ([row] if strips else [])
    fig, axes = figure(len(ratios), 1, (6.4, sum(ratios) / len(ratios)), sharex=True, height_ratios=ratios)
    for axis, (label, curves) in zip(axes[:, 0], panels.items()):
        for i, (name, values) in enumerate(curves.items()):
            axis.plot(t, values, label=name, **style(i))
        first = next(iter(curves))
        axis.set_ylabel(label if len(curves) > 1 or first == "q" else f"{label}: {first}")
        if len(curves) > 1:
            axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    if strips:
        _draw_strips(axes[-1, 0], strips)
    axes[-1, 0].set_xlabel("t")
    return fig


# Of modes; what has no colour here gets the next of the others.
NOTHING = "#E6E6E6"
STRIP_COLOURS = {"open": NOTHING, "free": NOTHING, "apart": NOTHING, "closed": COLOURS[0], "pressed": COLOURS[5]}
STRIP_COLOURS |= {"slides": COLOURS[1], "sticks": COLOURS[2], "holds its output": COLOURS[3]}


def _draw_strips(axis, strips: dict[str, list[tuple[float, float, str]]]):
    """One thin row for each name, the first at the top, and a legend of the words."""
    from matplotlib.patches import Patch

    words = list(dict.fromkeys(word for row in strips.values() for _, _, word in row))
    others = iter(COLOURS * len(words))
    colours = {word: STRIP_COLOURS.get(word) or next(others) for word in words}
    for i, row in enumerate(strips.values()):
        for start, end, word in row:
            axis.broken_barh([(start, end - start)], (i - 0.36, 0.72), color=colours[word], linewidth=0)
    axis.set_yticks(range(len(strips)), list(strips), fontsize=8)
    axis.set_ylim(len(strips) - 0.4, -0.6)
    axis.grid(False)
    shown = {colours[word]: ", ".join(w for w in words if colours[w] == colours[word]) for word in words}
    handles = [Patch(color=colour, label=label) for colour, label in shown.items()]
    axis.legend(handles=handles, fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))


@names_as_they_are()
def stills(motion: dict[str, np.ndarray], chosen: dict[str, np.ndarray]):
    """Draw some instants of points in the plane in one figure, earlier ones paler, and the path of each last point.

    **Arguments:** `motion`, `chosen`: by name, (F, k, 2), all frames and those that are drawn.

    **Returns:** a matplotlib `Figure`.
    """
    fig, axes = figure()
    axis = axes[0, 0]
    for i, (name, frames) in enumerate(chosen.items()):
        color = COLOURS[i % len(COLOURS)]
        axis.plot(*motion[name][:, -1].T, color=color, linewidth=0.8, alpha=0.4)
        for shade, points in zip(np.linspace(0.25 if len(frames) > 1 else 1.0, 1.0, len(frames)), frames):
            label = name if shade == 1.0 and len(chosen) > 1 else None
            marked = "o-" if len(points) <= 8 else "-"
            axis.plot(*points.T, marked, color=color, alpha=shade, markersize=4, linewidth=1.4, label=label)
    axis.set(aspect="equal", xlabel="x", ylabel="y")
    if len(chosen) > 1:
        axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


@names_as_they_are()
def families(label: str, x, ts, panels: dict[str, np.ndarray]):
    """Draw curves against time, one panel per coordinate, one curve per value of `x` (N,), which sets its shade.

    **Arguments:** `ts` (N, T); `panels` by coordinate, curves (N, T).

    **Returns:** a matplotlib `Figure`.
    """
    import_matplotlib()
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize

    low, high = np.min(x), np.max(x)
    # The lightest shades are left out: they are hard to see on white.
    shades = ListedColormap(colormaps["cividis"](np.linspace(0.0, 0.88, 256)))
    shade = ScalarMappable(Normalize(low, high if high > low else low + 1), shades)
    fig, axes = figure(len(panels), 1, size=(6.4, 2.4), sharex=True)
    for axis, (name, curves) in zip(axes[:, 0], panels.items()):
        for value, t, curve in zip(x, ts, curves):
            axis.plot(t, curve, linewidth=1.2, color=shade.to_rgba(value))
        axis.set_ylabel(name)
    axes[-1, 0].set_xlabel("t")
    fig.colorbar(shade, ax=list(axes[:, 0]), label=label)
    return fig


@names_as_they_are()
def phase_portrait(panels: dict[str, tuple[list[tuple[np.ndarray, np.ndarray]], bool]]):
    """Draw velocities against coordinates, one panel per coordinate, one curve per motion, with a dot at its start.

    **Arguments:** `panels` by coordinate: [(q (T,), v (T,)) of each motion], and whether it is an angle. Angles with
    whole turns are drawn between -π and π.

    **Returns:** a matplotlib `Figure`.
    """
    fig, axes = panel_axes(len(panels), 3, (4.2, 3.4))
    for axis, (name, (curves, is_angle)) in zip(axes, panels.items()):
        around = is_angle and any(np.ptp(q) > 2 * np.pi for q, _ in curves)
        for i, (q, v) in enumerate(curves):
            x, y = _cut_at_half_turns(q, v) if around else (q, v)
            axis.plot(x, y, linewidth=1.2, color=COLOURS[i % len(COLOURS)])
            axis.plot(x[:1], y[:1], "o", markersize=5, color=COLOURS[i % len(COLOURS)])
        if is_angle:
            _ticks_in_pi(axis)
        entry = name[1:] if name == "q" or name.startswith("q[") else f": {name}"
        axis.set(xlabel=f"q{entry}", ylabel=f"v{entry}")
    return fig


@names_as_they_are()
def section(panels: dict[tuple[str, str], tuple[list[tuple[np.ndarray, np.ndarray]], bool]], note: str):
    """Draw points, one panel per pair of names, one colour per motion.

    **Arguments:** `panels` by the names of the x and y axes: [(x (C,), y (C,)) of each motion], and whether x is an
    angle. `note`: a title, for instance that some points are missing; may be empty.

    **Returns:** a matplotlib `Figure`.
    """
    fig, axes = panel_axes(len(panels), 3, (4.2, 3.4))
    for axis, ((to_the_right, upward), (motions, is_angle)) in zip(axes, panels.items()):
        # Small enough to distinguish curves of many points from areas.
        size = np.clip(80 / np.sqrt(1 + sum(len(x) for x, _ in motions)), 1.2, 5.0)
        for i, (x, y) in enumerate(motions):
            axis.plot(x, y, "o", markersize=size, markeredgewidth=0, color=COLOURS[i % len(COLOURS)])
        if is_angle:
            _ticks_in_pi(axis)
        axis.set(xlabel=to_the_right, ylabel=upward)
    if note:
        fig.suptitle(note, fontsize=9)
    return fig


def _cut_at_half_turns(q, v):
    """An angle wrapped to -π ... π, with the curve cut (by NaN) where it leaves on one side and enters on the other."""
    turn = np.floor((q + np.pi) / (2 * np.pi))
    i = np.flatnonzero(np.diff(turn))
    edge = 2 * np.pi * np.maximum(turn[i], turn[i + 1]) - np.pi
    at_edge = v[i] + (edge - q[i]) / (q[i + 1] - q[i]) * (v[i + 1] - v[i])
    side, gap = np.pi * np.sign(turn[i + 1] - turn[i]), np.full(len(i), np.nan)

    def insert(x: np.ndarray, *pieces):
        return np.insert(x, np.repeat(i + 1, 3), np.stack(pieces, axis=1).reshape(-1))

    return insert(q - 2 * np.pi * turn, side, gap, -side), insert(v, at_edge, gap, at_edge)


def _ticks_in_pi(axis):
    """Put ticks at fractions of π if the axis spans a quarter turn or more."""
    from matplotlib.ticker import FuncFormatter, MultipleLocator

    low, high = axis.get_xlim()
    if high - low < np.pi / 2:
        return
    step = next(n for n in (4, 2, 1) if (high - low) * n / np.pi <= 6 or n == 1)

    def label(x, _):
        whole = Fraction(round(x * step / np.pi), step)
        top = {0: "0", 1: "π", -1: "-π"}.get(whole.numerator, f"{whole.numerator}π")
        return top if whole.denominator == 1 else f"{top}/{whole.denominator}"

    axis.xaxis.set_major_locator(MultipleLocator(np.pi / step))
    axis.xaxis.set_major_formatter(FuncFormatter(label))


class DrawnAxes(NamedTuple):
    """One panel of a work-precision diagram.

    - `label`: the label of the work axis. `floor`: the error of the reference; 0 if unknown.
    - `curves`: by name: work (N,), relative errors (N,), which of them can be trusted (N,), and the measured order.
    """

    title: str
    label: str
    curves: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray, float]]
    floor: float


def work_precision(panels: Sequence[DrawnAxes]):
    """Draw error against work, one panel each; the number at a curve is its order. Returns a matplotlib `Figure`.

    Errors of zero are drawn at half a unit of round-off; untrusted points are hollow, and errors below that of the
    reference are on grey.
    """
    fig, axes = panel_axes(len(panels), 3, (4.9, 3.9))
    names = list(dict.fromkeys(name for panel in panels for name in panel.curves))
    for axis, panel in zip(axes, panels):
        _draw_work(axis, panel, names)
    found = {label: line for axis in axes for line, label in zip(*axis.get_legend_handles_labels())}
    shown = [name for name in names if name in found]
    handles, ncols = [found[name] for name in shown], min(len(shown), 3 * min(3, len(panels)))
    fig.legend(handles, shown, fontsize=8, frameon=False, ncols=ncols, loc="outside lower center")
    return fig


def _draw_work(axis, panel, names):
    lowest = 0.5 * float(np.finfo(float).eps)
    axis.set(xscale="log", yscale="log", xlabel=panel.label, ylabel="relative error", title=panel.title)
    for name, (work, errors, trusted, order) in panel.curves.items():
        finite = np.isfinite(work) & np.isfinite(errors)
        if not finite.any():
            continue
        i = names.index(name)
        work, errors, trusted = work[finite], np.maximum(errors[finite], lowest), trusted[finite]
        axis.plot(work, errors, marker=MARKERS[i % len(MARKERS)], markersize=4, label=name, **style(i))
        hollow = {"marker": MARKERS[i % len(MARKERS)], "color": COLOURS[i % len(COLOURS)], "markerfacecolor": "white"}
        axis.plot(work[~trusted], errors[~trusted], linestyle="", markersize=4, zorder=3, **hollow)
        if np.isfinite(order):
            # At the point of smallest error, where curves are farthest apart.
            k = np.argmin(errors)
            axis.annotate(
                f"{order:.1f}", (work[k], errors[k]), (4, 1), textcoords="offset points", fontsize=8,
                color=COLOURS[i % len(COLOURS)], va="bottom",
            )  # fmt: skip
    if panel.floor > 0:
        bottom, top = axis.get_ylim()
        bottom = min(bottom, 0.1 * panel.floor)
        axis.axhspan(bottom, panel.floor, color="0.9", zorder=0)
        axis.text(0.02, panel.floor, "the reference cannot tell", transform=axis.get_yaxis_transform(), fontsize=7,
                  color="0.4", va="top")  # fmt: skip
        axis.set_ylim(bottom, top)
    _ticks_of_decades(axis.xaxis)
    _ticks_of_decades(axis.yaxis)


def growth(title: str, labels: tuple[str, str], x: np.ndarray, curves: dict[str, np.ndarray]):
    """Draw curves over x with both axes logarithmic. Returns a matplotlib `Figure`."""
    fig, ((axis,),) = figure(size=(5.6, 3.6))
    axis.set(xscale="log", yscale="log", xlabel=labels[0], ylabel=labels[1], title=title)
    for i, (name, y) in enumerate(curves.items()):
        axis.plot(x, y, marker=MARKERS[i % len(MARKERS)], markersize=4, label=name, **style(i))
    fig.legend(fontsize=8, frameon=False, loc="outside right upper")
    return fig


def _ticks_of_decades(axis):
    """Ticks at powers of ten, fewer if there are many; within two decades also at two and five times them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

    low, high = sorted(axis.get_view_interval())
    decades = np.log10(high / low)
    short = decades < 2.2
    axis.set_major_locator(LogLocator(10, (1.0, 2.0, 5.0) if short else (1.0,), numticks=6))
    axis.set_minor_locator(NullLocator() if short or decades > 4 else LogLocator(10, range(2, 10)))
    axis.set_minor_formatter(NullFormatter())
    if low > 1e-4 and high < 1e8:
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}" if x >= 1000 else f"{x:g}"))


@names_as_they_are()
def fits(
    panels: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray]], curves: dict[str, tuple[np.ndarray, np.ndarray]]
):
    """Draw measurements and the fit on the left, and the residuals on the right, one row per channel.

    **Arguments:** `panels` by name: times (T,), measurements and residuals (T,) or (T, n); `curves` by name: times and
    values of the fit, where it is not to be drawn from sample to sample.

    **Returns:** a matplotlib `Figure`.
    """
    fig, axes = figure(len(panels), 2, size=(5.2, 2.3), sharex=True)
    for (left, right), (name, (t, measured, residuals)) in zip(axes, panels.items()):
        at, fitted = curves.get(name, (t, measured + residuals))
        for i, (x, y) in enumerate(zip(measured.reshape(len(t), -1).T, fitted.reshape(len(at), -1).T)):
            left.plot(t, x, ".", color="#888888", markersize=3, label="measured" if i == 0 else None)
            left.plot(at, y, linewidth=1.2, label="fit" if i == 0 else None, **style(i))
        for i, r in enumerate(residuals.reshape(len(t), -1).T):
            right.plot(t, r, ".", markersize=3, color=COLOURS[i % len(COLOURS)])
        right.axhline(0.0, color="black", linewidth=0.8)
        left.set_ylabel(name)
        right.set_ylabel(f"fit less measured: {name}")
        left.legend(fontsize=8, frameon=False)
    for axis in axes[-1]:
        axis.set_xlabel("t")
    return fig


@names_as_they_are()
def lines(label: str, x, panels: dict[str, np.ndarray], bad, by: tuple[str, np.ndarray] | None = None):
    """Draw values against one axis of a sweep, one panel per value; `bad` points are marked at the bottom.

    `by`: the name and values (k,) of a second axis: values and `bad` are then (k, N), one curve each.
    """
    fig, axes = figure(len(panels), 1, size=(6.0, 2.8), sharex=True)
    bad = np.atleast_2d(bad)
    for axis, (name, values) in zip(axes[:, 0], panels.items()):
        for i, curve in enumerate(np.atleast_2d(values)):
            named = None if by is None else f"{by[0]} = {by[1][i]:.4g}"
            axis.plot(x, curve, marker="." if len(x) < 200 else "", label=named, **style(i))
            if np.any(bad[i]):
                at, mark = np.asarray(x)[bad[i]], {"color": COLOURS[1] if by is None else COLOURS[i % len(COLOURS)]}
                first = not np.any(bad[:i])
                axis.plot(at, np.zeros(len(at)), "x", transform=axis.get_xaxis_transform(), zorder=3,
                          label="not ok" if first else None, **mark)  # fmt: skip
        if by is not None:
            axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
        elif np.any(bad):
            axis.legend(fontsize=8, frameon=False)
        axis.set_ylabel(name)
    axes[-1, 0].set_xlabel(label)
    return fig


@names_as_they_are()
def maps(axes: dict[str, np.ndarray], panels: dict[str, np.ndarray]):
    """Draw values over two axes as maps, one row per value; a third axis in front gets one column per axis value."""
    *first, (down, y), (across, x) = axes.items()
    columns = [("", ...)] if not first else [(f"{first[0][0]} = {value:.4g}", i) for i, value in enumerate(first[0][1])]
    fig, grid = figure(len(panels), len(columns), size=(4.2, 3.2), sharex=True, sharey=True)
    for row, (name, values) in zip(grid, panels.items()):
        low, high = np.nanmin(values), np.nanmax(values)
        shown = [
            axis.pcolormesh(x, y, values[i], cmap="cividis", vmin=low, vmax=high, shading="nearest")
            for axis, (_, i) in zip(row, columns)
        ]
        for axis, (title, _) in zip(row, columns):
            axis.set_facecolor("#bbbbbb")
            axis.set_title(title, fontsize=9)
            axis.grid(False)
        row[0].set_ylabel(down)
        fig.colorbar(shown[0], ax=list(row), label=name)
    for axis in grid[-1]:
        axis.set_xlabel(across)
    return fig


@names_as_they_are()
def stacked(t, parts: dict[str, np.ndarray], total: np.ndarray, label: str):
    """Draw parts against time, stacked upwards if positive and downwards if negative, and their total.

    **Arguments:** `t` (T,); `parts` by name, (T,); `total` (T,), drawn as a line with its `label`.

    **Returns:** a matplotlib `Figure`.
    """
    fig, axes = figure(size=(6.4, 3.2))
    axis, up, down = axes[0, 0], np.zeros(len(t)), np.zeros(len(t))
    for i, (name, values) in enumerate(parts.items()):
        colour = COLOURS[i % (len(COLOURS) - 1)]
        higher, lower = up + np.maximum(values, 0), down + np.minimum(values, 0)
        axis.fill_between(t, up, higher, color=colour, alpha=0.5, linewidth=0, label=name)
        axis.fill_between(t, down, lower, color=colour, alpha=0.5, linewidth=0)
        up, down = higher, lower
    axis.plot(t, total, color=COLOURS[-1], linewidth=1.4, label=label)
    axis.axhline(0.0, color=COLOURS[-1], linewidth=0.6)
    axis.set(xlabel="t", ylabel="work")
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


@names_as_they_are()
def graph(names: Sequence[str], arrows: Sequence[tuple[str, str, str]]):
    """Draw names on a circle, and labelled arrows between them.

    **Arguments:** `names`; `arrows`: (from, to, label) each; an arrow from a name to itself is a loop.

    **Returns:** a matplotlib `Figure`.
    """
    fig, axes = figure(size=(5.2, 3.8))
    axis, n = axes[0, 0], len(names)
    turn = np.pi / 2 - 2 * np.pi * np.arange(n) / n
    places = dict(zip(names, np.stack([np.cos(turn), 0.8 * np.sin(turn)], axis=1) if n > 1 else np.zeros((1, 2))))
    for i, (start, end, label) in enumerate(arrows):
        a, b = places[start], places[end]
        middle, curve, short = (a + b) / 2 + 0.125 * np.array([(b - a)[1], (a - b)[0]]), "arc3,rad=0.25", 22
        if start == end:
            out = a / np.hypot(*a) if np.any(a) else np.array([0.0, 1.0])
            side = 0.22 * np.array([out[1], -out[0]])
            a, b, middle, curve, short = a - side, a + side, a + 0.37 * out, "arc3,rad=-1.4", 10
        arrow = {"arrowstyle": "-|>", "connectionstyle": curve, "shrinkA": short, "shrinkB": short}
        axis.annotate("", b, a, arrowprops=arrow | {"color": COLOURS[i % len(COLOURS)]})
        axis.annotate(label, middle, ha="center", va="center", fontsize=8, bbox=ON_MARKS)
    for name, (x, y) in places.items():
        box = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": COLOURS[-1]}
        axis.text(x, y, name, ha="center", va="center", bbox=box)
    axis.set(xlim=(-1.4, 1.4), ylim=(-1.3, 1.3))
    axis.set_axis_off()
    return fig
