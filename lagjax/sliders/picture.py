"""A picture that follows, as one SVG: axes that seldom change, and in them the lines and words of each value.

Drawing axes, ticks and labels takes matplotlib 30 ms and more; for another value only the lines are written again, in
less than 1 ms. The limits of the axes stay, so that two values can be compared by eye, until the lines leave them or
fill less than an eighth of them. A browser shows such an SVG in 10 ms. A PNG of 64 colours, over pixels of kept axes,
took the browser 19 ms and the kernel 6 ms more (on two busy cores); so a PNG is only drawn when it is asked for.
"""

import html
import io
import re
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from lagjax.display import plots
from lagjax.sweep import MOST_CURVES, Drawn

DPI = 100
# Inches: the width, the height of one panel, and of the words above.
WIDTH, PANEL, WORDS = 6.4, 2.3, 0.45
# What stands around the lines, as a share of their size, and the share of the limits that they must fill.
ROOM, LEAST = 0.08, 1 / 8
MOST_PANELS = 4
# Units of the SVG in a pixel: whole numbers are short to write.
FINE = 10
# Curves of more points than this are drawn within half a pixel, others within a ninth, so that messages stay short.
MOST_POINTS = 4000
# All of the figure, whatever the user's settings are; and what matplotlib would write about an SVG.
SAVED = {"savefig.bbox": None}
METADATA = ("Creator", "Date", "Format", "Type")


class Picture:
    """The canvas, what it shows, and `drawn_whole`: how often it had to be drawn as a whole."""

    def __init__(self):
        plots.import_matplotlib()
        self.kind, self.drawn_whole = None, 0

    @plots.names_as_they_are()
    def of_curves(self, found: Drawn, words: str) -> str:
        """Numbers and curves, those of the first lane."""
        panels = found.panels[:MOST_PANELS]
        kind = [(panel.label, panel.across, *panel.curves) for panel in panels]
        if kind != self.kind:
            self._new(max(1, len(panels)))
            self.kind = kind
            for axis, panel in zip(self.axes, panels):
                empty = enumerate(panel.curves)
                self._lines.append(
                    [axis.plot([], [], label=name, linewidth=1.5, **plots.style(i))[0] for i, name in empty]
                )
                axis.set(xlabel=panel.across, ylabel=panel.label)
                if len(panel.curves) > 1:
                    beside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
                    axis.legend(handles=self._lines[-1][:MOST_CURVES], fontsize=8, frameon=False, **beside)
            if not panels:
                self.axes[0].set_axis_off()
        stays, anew = self._frame is not None, self._fresh
        self._fresh = False
        for axis, panel, lines in zip(self.axes, panels, self._lines):
            x = panel.x[0]
            for line, curve in zip(lines, panel.curves.values()):
                line.set_data(x, curve[0])
            values = np.stack([curve[0] for curve in panel.curves.values()])
            there = np.isfinite(values) & np.isfinite(x)
            stays &= _fits(axis.get_xlim, axis.set_xlim, x[there.any(axis=0)], 0.0, anew)
            stays &= _fits(axis.get_ylim, axis.set_ylim, values[there], ROOM, anew)
        numbers = [f"{name} = {x[0]:.6g}" for name, x in found.numbers.items()]
        left_out = [*found.left_out, *(panel.label for panel in found.panels[MOST_PANELS:])]
        if not (found.numbers or found.panels or left_out):
            numbers = ["run returned nothing to draw"]
        self._words(words, ",  ".join([*numbers, *(["not drawn: " + ", ".join(left_out)] if left_out else [])]))
        if not stays:
            self._draw_frame()
        return self._svg()

    def png(self) -> bytes:
        """The last picture as a PNG."""
        written = io.BytesIO()
        with plots.import_matplotlib().rc_context(SAVED):
            self.figure.savefig(written, format="png", dpi=DPI)
        return written.getvalue()

    def of_user(self, draw: Callable, result: Any, words: str) -> str:
        """What the user's `draw(result, axes)` draws: the whole figure is drawn again."""
        if self.kind != "user":
            self._new(1)
            self.kind = "user"
        axis = self.axes[0]
        axis.clear()
        axis.grid(True, linewidth=0.4, alpha=0.5)
        draw(result, axis)
        return self._without_lines(words)

    def of_words(self, words: str) -> str:
        """What went wrong, above the axes that were drawn before, without their lines."""
        if self.kind is None or self.kind == "user":
            self._new(1)
            self.axes[0].set_axis_off()
            self.kind = "words"
        return self._without_lines(words)

    def _without_lines(self, words):
        self._words(words, "")
        for line in sum(self._lines, []):
            line.set_data([], [])
        self._draw_frame()
        picture, self._frame = self._svg(), None
        return picture

    def _new(self, panels):
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        height = (PANEL + 0.8 if panels == 1 else PANEL * panels) + WORDS
        self.figure, axes = plots.figure(panels, 1, (WIDTH, height / panels))
        self.figure.set_dpi(DPI)
        self.axes, self._layout = axes[:, 0], ConstrainedLayoutEngine(rect=(0, 0, 1, 1 - WORDS / height))
        self._above = self.figure.text(0.02, 1 - 0.08 / height, "", va="top", fontsize=9)
        self._lines, self._frame, self._fresh = [], None, True

    def _words(self, words, numbers):
        lines = textwrap.wrap(words or numbers, 100)
        shown = "\n".join(lines[:2]) + (" ..." if len(lines) > 2 else "")
        # A dollar of the user's is no formula.
        self._above.set(text=shown.replace("$", r"\$"), color="#A30000" if words else "black")

    def _draw_frame(self):
        """Draw all but lines and words, and lay the axes out, which then stay where they are."""
        matplotlib = plots.import_matplotlib()
        ours = [*sum(self._lines, []), self._above]
        for artist in ours:
            artist.set_visible(False)
        self.figure.set_layout_engine(self._layout)
        written = io.StringIO()
        with matplotlib.rc_context(SAVED | {"svg.fonttype": "none", "font.sans-serif": ["DejaVu Sans"]}):
            self.figure.savefig(written, format="svg", metadata=dict.fromkeys(METADATA))
        self.figure.set_layout_engine("none")
        for artist in ours:
            artist.set_visible(True)
        # Its style would hold for all of the notebook.
        frame = re.sub("<style.*?</style>", "", written.getvalue(), flags=re.DOTALL)
        self._frame = re.sub(r'width="[\d.]+pt" height="[\d.]+pt"', "", frame[frame.index("<svg") :], count=1)
        self.drawn_whole += 1

    def _svg(self):
        """The frame, the lines, each panel cut off at its axes, and the words above them."""
        width, height = (round(x) for x in self.figure.bbox.size)
        panels = [_panel(axis, lines, height) for axis, lines in zip(self.axes, self._lines) if lines]
        size = float(self._above.get_fontsize()) * DPI / 72
        x, y = self._above.get_position()
        rows = "".join(
            f'<tspan x="{x * width:g}" dy="{1.2 * size if i else size:g}">{html.escape(row)}</tspan>'
            for i, row in enumerate(self._above.get_text().replace(r"\$", "$").split("\n"))
        )
        words = f'<text y="{(1 - y) * height:g}" font-size="{size:g}" fill="{self._above.get_color()}">{rows}</text>'
        name = "; ".join(f"{axis.get_ylabel()} against {axis.get_xlabel()}" for axis in self.axes if axis.lines)
        return (
            f'<svg role="img" aria-label="{html.escape(name or "numbers")}" viewBox="0 0 {width} {height}" '
            'style="display:block;width:100%;font-family:DejaVu Sans,Verdana,sans-serif" '
            f'xmlns="http://www.w3.org/2000/svg">{self._frame}{"".join(panels)}{words}</svg>'
        )


def _panel(axis, lines, height):
    """The lines of one panel, in an SVG that ends where its axes do."""
    box = axis.get_window_extent()
    paths = []
    for i, line in enumerate(lines):
        x, y = axis.transData.transform(np.column_stack(line.get_data())).T
        path = _path(FINE * (x - box.x0), FINE * (box.y1 - y), FINE * box.width, FINE * box.height)
        thick = FINE * line.get_linewidth() * DPI / 72
        dashes = " ".join(f"{x * thick:.3g}" for x in _dashes(plots.style(i)["linestyle"])) or "none"
        paths.append(
            f'<path d="{path}" stroke="{line.get_color()}" stroke-width="{thick:.3g}" stroke-dasharray="{dashes}"/>'
        )
    where = f'x="{box.x0:g}" y="{height - box.y1:g}" width="{box.width:g}" height="{box.height:g}"'
    units = f'viewBox="0 0 {FINE * box.width:g} {FINE * box.height:g}" preserveAspectRatio="none"'
    return f'<svg {where} {units} fill="none" stroke-linejoin="round">{"".join(paths)}</svg>'


def _dashes(style):
    """The lengths of dashes and gaps, in widths of the line, as matplotlib draws a line style."""
    names = {"--": "lines.dashed_pattern", "-.": "lines.dashdot_pattern", ":": "lines.dotted_pattern"}
    if isinstance(style, tuple):
        return style[1]
    return plots.import_matplotlib().rcParams[names[style]] if style in names else ()


def _path(x, y, width, height):
    """The `d` of an SVG path through points (n,), interrupted where one is not finite, without what no one sees."""
    from matplotlib.path import Path

    path = Path(np.column_stack([x, y]))
    path.simplify_threshold = FINE / 9 if len(x) <= MOST_POINTS else FINE / 2
    # A line ends well outside of its panel, where it is cut off.
    path = path.cleaned(remove_nans=True, simplify=True, clip=(-width, -height, 2 * width, 2 * height))
    points = zip(np.asarray(path.codes).tolist(), np.rint(path.vertices).astype(int).tolist())
    return "".join(f"{'M' if code == Path.MOVETO else ' '}{x} {y}" for code, (x, y) in points if code != Path.STOP)


def _fits(get, set_, values, room, anew):
    """Whether limits stay as they are; where they do not, they are set to hold what there is."""
    if len(values) == 0:
        return True
    low, high = float(np.min(values)), float(np.max(values))
    before = get()
    holds = before[0] <= low and high <= before[1] and high - low >= LEAST * (before[1] - before[0])
    flat = high - low <= 1e-9 * max(abs(low), abs(high))
    if not anew and (holds or (flat and before[0] <= low <= before[1])):
        return True
    size = high - low if not flat else 2 * (abs(high) or 1.0)
    room = room if not flat else 0.5
    if anew or high - low < LEAST * (before[1] - before[0]):
        set_(low - room * size, high + room * size)
    else:
        # Only the sides that were left, and well beyond: the next value goes farther.
        set_(
            before[0] if before[0] <= low else low - 2 * room * size,
            before[1] if high <= before[1] else high + 2 * room * size,
        )
    return False
