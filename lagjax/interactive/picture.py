"""A picture that follows: lines in a matplotlib figure without a window, of which only the lines are drawn again.

A whole figure takes matplotlib 30 ms and more, most of it for axes, ticks and words that stay. So these are drawn once
and kept as pixels; for another value the pixels are put back and the lines drawn over them, in 2 ms. Limits stay, so
that two values can be compared by eye, until the lines leave them, or fill less than an eighth of them; then the whole
is drawn again. 64 colours make the PNG small (15 kB) and quick (4 ms): a notebook's server lets through 1 MB/s.
"""

import io
import textwrap
from collections.abc import Callable
from typing import Any

import numpy as np

from lagjax import plot
from lagjax.sweeps.drawn import MOST_CURVES, Drawn

DPI = 100
# Inches: the width, the height of one panel, and of the words above.
WIDTH, PANEL, WORDS = 6.4, 2.3, 0.45
COLOURS = 64
# What stands around the lines, as a share of their size, and the share of the limits that they must fill.
ROOM, LEAST = 0.08, 1 / 8
MOST_PANELS = 4


class Picture:
    """The canvas, what it shows, and `drawn_whole`: how often it had to be drawn as a whole."""

    def __init__(self):
        plot.import_matplotlib()
        self.kind, self.drawn_whole = None, 0

    def of_curves(self, found: Drawn, words: str) -> bytes:
        """The PNG of numbers and curves, those of the first lane."""
        panels = found.panels[:MOST_PANELS]
        kind = [(panel.label, panel.across, *panel.curves) for panel in panels]
        if kind != self.kind:
            self._new(max(1, len(panels)))
            self.kind = kind
            for axis, panel in zip(self.axes, panels):
                self._lines.append(
                    [
                        axis.plot([], [], label=name, linewidth=1.5, animated=True, **plot.style(i))[0]
                        for i, name in enumerate(panel.curves)
                    ]
                )
                axis.set(xlabel=panel.across, ylabel=panel.label)
                if len(panel.curves) > 1:
                    beside = {"loc": "center left", "bbox_to_anchor": (1.0, 0.5)}
                    axis.legend(handles=self._lines[-1][:MOST_CURVES], fontsize=8, frameon=False, **beside)
            if not panels:
                self.axes[0].set_axis_off()
        stays, anew = self._background is not None, self._fresh
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
            self._whole()
            self._background = self._canvas.copy_from_bbox(self.figure.bbox)
        self._canvas.restore_region(self._background)
        for axis, lines in zip(self.axes, self._lines):
            for line in lines:
                axis.draw_artist(line)
        self.figure.draw_artist(self._above)
        return self._png()

    def of_user(self, draw: Callable, result: Any, words: str) -> bytes:
        """The PNG of what the user's `draw(result, axes)` draws: the whole is drawn again."""
        if self.kind != "user":
            self._new(1)
            self.kind = "user"
        axis = self.axes[0]
        axis.clear()
        axis.grid(True, linewidth=0.4, alpha=0.5)
        draw(result, axis)
        self._words(words, "")
        self._whole()
        self.figure.draw_artist(self._above)
        return self._png()

    def of_words(self, words: str) -> bytes:
        """The PNG of what went wrong: what was drawn before, without its lines."""
        if self.kind is None or self.kind == "user":
            self._new(1)
            self.axes[0].set_axis_off()
            self.kind = "words"
        self._words(words, "")
        self._whole()
        self._background = None
        self.figure.draw_artist(self._above)
        return self._png()

    def _new(self, panels):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine

        height = (PANEL + 0.8 if panels == 1 else PANEL * panels) + WORDS
        layout = ConstrainedLayoutEngine(rect=(0, 0, 1, 1 - WORDS / height))
        self.figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout=layout)
        self._canvas = FigureCanvasAgg(self.figure)
        self.axes = self.figure.subplots(panels, 1, squeeze=False)[:, 0]
        for axis in self.axes:
            axis.grid(True, linewidth=0.4, alpha=0.5)
            axis.spines[["top", "right"]].set_visible(False)
        self._above = self.figure.text(0.02, 1 - 0.08 / height, "", va="top", fontsize=9, animated=True)
        self._lines, self._background, self._fresh = [], None, True

    def _words(self, words, numbers):
        lines = textwrap.wrap(words or numbers, 100)
        shown = "\n".join(lines[:2]) + (" ..." if len(lines) > 2 else "")
        # A dollar of the user's is no formula.
        self._above.set(text=shown.replace("$", r"\$"), color="#A30000" if words else "black")

    def _whole(self):
        self._canvas.draw()
        self.drawn_whole += 1

    def _png(self):
        from PIL import Image

        pixels = Image.fromarray(np.asarray(self._canvas.buffer_rgba())).convert("RGB")
        few = pixels.quantize(COLOURS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        written = io.BytesIO()
        few.save(written, "png", compress_level=1)
        return written.getvalue()


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
