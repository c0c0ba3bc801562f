"""Sliders in a notebook: a motion that follows its parameters, in a picture that follows.

One compiled program, one picture, and a slider for each parameter. A change of a slider costs a call of the program
(about a millisecond for a small system), another to write the lines, and the time the notebook takes to bring them to
the screen. While a picture is made others wait, and only the last position of a slider is drawn next: dragging leaves
no queue. Needs ipywidgets.

**The picture** is one SVG: axes that seldom change, and in them the lines and words of each value. Drawing axes, ticks
and labels takes matplotlib 30 ms and more; for another value only the lines are written again, in less than 1 ms. The
limits of the axes stay, so that two values can be compared by eye, until the lines leave them or fill less than an
eighth of them. A browser shows such an SVG in 10 ms. A PNG of 64 colours, over pixels of kept axes, took the browser 19
ms and the kernel 6 ms more (on two busy cores); so a PNG is only drawn when it is asked for.
"""

import html
import io
import math
import re
import textwrap
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from lagjax.display import plots
from lagjax.integrate import in_words
from lagjax.refusals import installed, must_be_function, must_name
from lagjax.sweep import LAYOUTS, MOST_CURVES, TRUSTED, Drawn, axes_of, drawn, program_for

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


# The number of steps of a slider for which none is given.
STEPS = 200
MOST_VALUES = 5000
EXAMPLE = 'Fix: {"omega": (0.0, 10.0), "start": (0.1, 3.0, 0.1), "count": [1, 2, 5], "method": ["a", "b"]}.'


class Range(NamedTuple):
    """Numbers from `low` to `high`, `step` apart."""

    low: float
    high: float
    step: float


class Values(NamedTuple):
    """Numbers (n, ...), one of which is passed to `run` as an array."""

    values: np.ndarray


class Choices(NamedTuple):
    """Values that are not numbers (names, methods, functions, None): each needs its own compiled program."""

    values: tuple


Control = Range | Values | Choices


def controls_of(knobs: Any) -> dict[str, Control]:
    """The controls that a user described, validated."""
    if not isinstance(knobs, Mapping) or not knobs:
        raise TypeError(f"knobs must be a dictionary by name, not {knobs!r:.60}.\n{EXAMPLE}")
    return {str(name): _control(str(name), given) for name, given in knobs.items()}


def _control(name, given) -> Control:
    if isinstance(given, bool | np.bool_):
        # A knob starts at the first of its values.
        return Values(np.array([given, not given]))
    if isinstance(given, tuple) and len(given) in (2, 3) and all(map(_is_number, given)):
        return _range(name, *map(float, given))
    if isinstance(given, np.ndarray | jax.Array):
        x = np.asarray(given)
        if x.ndim == 0 or len(x) == 0 or not (np.issubdtype(x.dtype, np.number) or x.dtype == bool):
            raise ValueError(f"knob '{name}' must be an array of at least one number, and is {given!r:.60}.\n{EXAMPLE}")
        return _few(name, x)
    if isinstance(given, Sequence) and not isinstance(given, str | tuple) and len(given) > 0:
        if all(_is_number(x) or isinstance(x, bool) for x in given):
            return _few(name, np.asarray(given))
        return Choices(tuple(given))
    raise ValueError(
        f"knob '{name}' is {given!r:.60}, not a range (low, high), (low, high, step), or a list of values.\n"
        f"{EXAMPLE} Quantities that do not vary belong in run."
    )


def _range(name, low, high, step=None):
    given = (low, high) if step is None else (low, high, step)
    if not all(map(math.isfinite, given)) or low >= high or (step is not None and not 0 < step <= high - low):
        raise ValueError(
            f"knob '{name}' is {given}: low must be below high, and the step between 0 and their distance.\n{EXAMPLE}"
        )
    return Range(low, high, (high - low) / STEPS if step is None else step)


def _few(name, x):
    if len(x) > MOST_VALUES:
        raise ValueError(
            f"knob '{name}' has {len(x):,} values, but a slider has at most {MOST_VALUES:,}.\n"
            f"Fix: a range, ({x.min():.6g}, {x.max():.6g})."
        )
    return Values(x)


def _is_number(x):
    return isinstance(x, int | float | np.number | jax.Array) and not isinstance(x, bool) and np.ndim(x) == 0


def start_of(name: str, control: Control, start: Mapping[str, Any]) -> Any:
    """The initial value of a control: from `start`, else the middle of a range or the first value."""
    if name not in start:
        if not isinstance(control, Range):
            return control.values[0]
        return control.low + control.step * round((control.high - control.low) / 2 / control.step)
    return checked(name, control, start[name])


def checked(name: str, control: Control, value: Any) -> Any:
    """A value of a control, validated."""
    if isinstance(control, Range):
        x = float(value)
        if not control.low <= x <= control.high:
            raise ValueError(f"knob '{name}' goes from {control.low:.6g} to {control.high:.6g}, and not to {x:.6g}.")
        return x
    return control.values[place(name, control, value)]


def place(name: str, control: Values | Choices, value: Any) -> int:
    """The index of a value among those of a control."""
    for i, known in enumerate(control.values):
        if known is value or (np.shape(known) == np.shape(value) and np.all(known == value)):
            return i
    raise ValueError(f"knob '{name}' has no value {value!r:.60}.\nFix: one of {words(control)}.")


def words(control: Control) -> str:
    """The values of a control as text."""
    if isinstance(control, Range):
        return f"{control.low:.6g} to {control.high:.6g}"
    labels = _labels(control)
    return ", ".join(labels) if len(labels) <= 6 else f"{labels[0]} to {labels[-1]} ({len(labels)})"


def _labels(control):
    if isinstance(control, Choices):
        names = [x if isinstance(x, str) else getattr(x, "__name__", None) or f"{x!r:.40}" for x in control.values]
        return [name if names.count(name) == 1 else f"{name} ({i})" for i, name in enumerate(names)]
    if control.values.ndim > 1:
        return [f"no. {i}" for i in range(len(control.values))]
    if control.values.dtype == bool:
        return [str(x) for x in control.values.tolist()]
    labels = [f"{x:.6g}" for x in control.values]
    return labels if len(set(labels)) == len(labels) else [f"{x!r}" for x in control.values.tolist()]


def import_widgets():
    """Import ipywidgets, or say how to get it."""
    return installed("ipywidgets", "a slider in a notebook", "interact")


def widget(name: str, control: Control, value: Any):
    """The widget of a control; `read` gives its value."""
    widgets = import_widgets()
    layout_options = {
        "description": name,
        "layout": widgets.Layout(width="560px", max_width="100%"),
        "style": {"description_width": "120px"},
    }
    if isinstance(control, Range):
        digits = max(0, math.ceil(-math.log10(control.step) - 1e-9))
        readout = f".{min(digits + 1 if digits else 0, 12)}f" if 1e-6 < control.step else ".6g"
        return widgets.FloatSlider(
            value=value, min=control.low, max=control.high, step=control.step, readout_format=readout, **layout_options
        )
    options, index = [(label, i) for i, label in enumerate(_labels(control))], place(name, control, value)
    if isinstance(control, Values) and len(options) > 2:
        return widgets.SelectionSlider(options=options, value=index, **layout_options)
    return widgets.Dropdown(options=options, value=index, **layout_options)


def read(control: Control, shown: Any) -> Any:
    """The value of a control from the value of its widget."""
    return shown if isinstance(control, Range) else control.values[shown]


# Bytes a second: Jupyter drops what is more than a million, and a picture that is dropped never comes.
MOST_A_SECOND = 7e5
# The name of the one axis where no number is turned.
NONE = "no knob"


def interact(
    run: Callable[[dict[str, Any]], Any],
    knobs: Mapping[str, Any],
    *,
    draw: Callable[[Any, Any], Any] | None = None,
    start: Mapping[str, Any] | None = None,
    progress: bool | None = None,
) -> "Knobs":
    """Show what `run` returns in a notebook, with a slider for each knob; the picture follows.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def run(point):
    ...     t = jnp.linspace(0.0, 1.0, 50)
    ...     return {"t": t, "x": jnp.sin(point["omega"] * t), "period": 2 * jnp.pi / point["omega"]}
    >>> knobs = lj.interact(run, {"omega": (1.0, 9.0)}, progress=False)
    >>> knobs
    Knobs: omega = 5 (1 to 9)
      in a notebook these are sliders; here: knobs.set(omega=...), knobs.result, knobs.save("picture.png")
    >>> print(knobs.set(omega=4.0).result["period"].round(4))
    1.5708

    **Arguments:**

    - `run(point)`: any JAX function, as in `lj.sweep`: `point` is a dictionary with the value of each knob as an array,
      so that nothing is compiled anew when it changes; what `run` reads from outside stays as it was. A `Trajectory` is
      drawn as its coordinates at the outputs, linked by straight lines; a dictionary or an array as curves, against its
      entry `t` or else their index; numbers stand above the picture.
    - `knobs`: what may be turned, by name. `(low, high)` or `(low, high, step)`: a slider, whose values are floats. A
      list or an array of numbers: these, in their dtype. `True` or `False`: a switch. A list of anything else (names,
      methods, functions): a choice that `run` gets as it is; each has a program of its own, compiled when it is first
      chosen.
    - `draw(result, axes)`: draws the result, with its numbers as NumPy arrays, into an empty matplotlib `Axes`. Then
      all of the picture is drawn again each time, which takes 40 ms and more.
    - `start`: where the knobs stand at first, by name; else in the middle, or at the first of their values.
    - `progress`: say that it compiles; by default where somebody may look.

    **Returns:** `Knobs`. What failed at a point says why in the picture; the next point is as good as ever.

    **Raises:** `ImportError` without ipywidgets or matplotlib; `TypeError`, `ValueError` for knobs that are none; what
    `run` or `draw` raises at the first point.
    """
    must_be_function(run, "run", "a point", "lambda point: lj.integrate(system, q0, v0, params | point, ts=ts)")
    import_widgets()
    controls, start = controls_of(knobs), dict(start or {})
    must_name(start, controls, "start names", "knob")
    point = {name: start_of(name, control, start) for name, control in controls.items()}
    return Knobs(run, controls, point, draw, progress)


class Knobs:
    """Sliders and the picture that follows them. In a notebook it shows itself.

    - `point`: the values of the knobs, by name; `set(omega=2.0)` changes them.
    - `result`: what `run` returned there, in NumPy; `status`: how it went, in words; `ok`: whether it is to be trusted.
    - `picture`: what is shown, as PNG; `save(path)` writes it.
    - `seconds`: how long the last one took.
    - `widget`: the ipywidgets of it, to be put beside others.
    """

    def __init__(self, run, controls: dict[str, Control], point: dict[str, Any], draw, progress):
        widgets = import_widgets()
        self._run, self._controls, self._draw, self._progress = run, controls, draw, progress
        self._programs, self._picture, self._lock = {}, Picture(), threading.RLock()
        self._free_at, self._shown, self._held = 0.0, None, False
        self.result: Any = None
        self.status, self.ok, self.seconds = "", False, 0.0
        self._sliders = {name: widget(name, control, point[name]) for name, control in controls.items()}
        size = {"width": f"{round(WIDTH * DPI)}px", "max_width": "100%", "margin": "0"}
        self._shows = widgets.HTML(layout=widgets.Layout(**size))
        # What failed stands in the picture, and here for those who have it read to them.
        self._message = widgets.HTML()
        self.widget = widgets.VBox([*self._sliders.values(), self._shows, self._message])
        # What `run` or `draw` raises at the first point is the user's to see.
        self._picture_at(point)
        self._follow()
        for slider in self._sliders.values():
            slider.observe(self._follow, "value")

    @property
    def point(self) -> dict[str, Any]:
        """The values of the knobs."""
        return {name: read(self._controls[name], slider.value) for name, slider in self._sliders.items()}

    @property
    def picture(self) -> bytes:
        """The picture that is shown, as PNG."""
        with self._lock:
            return self._picture.png()

    def set(self, **values) -> "Knobs":
        """Turn knobs to other values, all at once; returns itself.

        **Raises:** `ValueError` for what is no knob or beyond its range.
        """
        must_name(values, self._controls, "set names", "knob")
        values = {name: checked(name, self._controls[name], x) for name, x in values.items()}
        self._held = True
        try:
            for name, x in values.items():
                control = self._controls[name]
                self._sliders[name].value = x if isinstance(control, Range) else place(name, control, x)
        finally:
            self._held = False
        self._follow()
        return self

    def save(self, path) -> None:
        """Write the picture, as PNG."""
        Path(path).write_bytes(self.picture)

    def _follow(self, change=None):
        """Show the point where the sliders are now, which may be beyond the one that asked for it."""
        if self._held:
            return
        with self._lock:
            at = tuple(slider.value for slider in self._sliders.values())
            if at == self._shown:
                return
            if change is not None:
                time.sleep(max(0.0, self._free_at - time.monotonic()))
                at = tuple(slider.value for slider in self._sliders.values())
            self._show(self.point)
            self._shown = at
            self._free_at = time.monotonic() + len(self._shows.value) / MOST_A_SECOND

    def _show(self, point):
        began = time.perf_counter()
        try:
            picture = self._picture_at(point)
        except Exception as error:
            # In a callback of a widget nobody would see it, and the sliders would be dead.
            self.ok, self.status = False, f"{type(error).__name__}: {error}"
            picture = self._picture.of_words(self.status)
        self._shows.value = picture
        said = "" if self.ok else f'<span role="status">{html.escape(self.status)}</span>'
        if self._message.value != said:
            self._message.value = said
        self.seconds = time.perf_counter() - began

    def _picture_at(self, point):
        self.result, code = self._values(point)
        self.ok, self.status = code in TRUSTED, in_words(code)
        return self._drawn()

    def _drawn(self):
        wrong = "" if self.ok else self.status
        if self._draw is not None:
            return self._picture.of_user(self._draw, self.result, wrong)
        lanes = jax.tree.map(lambda x: x[None], self.result)
        return self._picture.of_curves(drawn(lanes, of_motion=("q",)), wrong)

    def _values(self, point):
        """What `run` returns at a point, and the code of how it went."""
        program, numbers = self._program(point), self._numbers(point)
        values, status, _ = program.call({name: np.asarray(x)[None] for name, x in numbers.items()}, 1)
        return jax.tree.map(lambda x: x[0], values), int(status.result[0])

    def _numbers(self, point):
        """What is passed as arrays."""
        found = {name: x for name, x in point.items() if not isinstance(self._controls[name], Choices)}
        kinds = {name: self._dtype(name) for name in found}
        found = {name: np.asarray(x, kinds[name]) for name, x in found.items()}
        return found or {NONE: np.zeros((), bool)}

    def _dtype(self, name):
        control = self._controls[name]
        return jax.dtypes.canonicalize_dtype(control.values.dtype if isinstance(control, Values) else float)

    def _program(self, point):
        """The program for the choices of a point, compiled where there is none yet."""
        chosen = {name: x for name, x in point.items() if isinstance(self._controls[name], Choices)}
        key = tuple(place(name, self._controls[name], x) for name, x in chosen.items())
        if key not in self._programs:
            run, numbers = self._run, self._numbers(point)

            def with_choices(point):
                return run({name: x for name, x in point.items() if name != NONE} | chosen)

            axes, device = axes_of({name: x[None] for name, x in numbers.items()}, False), jax.local_devices()[:1]
            one = with_choices if chosen or NONE in numbers else run
            self._programs[key], _ = program_for(one, axes, 1, device, LAYOUTS[1], progress=self._progress)
        return self._programs[key]

    def _repr_mimebundle_(self, **options):
        shown = dict(self.widget._repr_mimebundle_(**options) or {})
        # Where no widgets are shown (a hosted copy, a preview) the picture stands there.
        return shown | {"text/plain": repr(self), "image/png": b64encode(self.picture).decode()}

    def __repr__(self):
        at = [f"{_in_words(item)} ({words(self._controls[item[0]])})" for item in self.point.items()]
        lines = [f"Knobs: {', '.join(at)}"] + ([] if self.ok else [f"  not ok: {self.status}"])
        how = ", ".join(f"{name}=..." for name in self._controls)
        here = f'here: knobs.set({how}), knobs.result, knobs.save("picture.png")'
        return "\n".join([*lines, f"  in a notebook these are sliders; {here}"])


def _in_words(item):
    name, x = item
    if isinstance(x, str | bool | np.bool_) or x is None:
        return f"{name} = {x}"
    if np.ndim(x) == 0 and isinstance(x, int | float | np.number):
        return f"{name} = {x:.6g}"
    return f"{name} = {getattr(x, '__name__', None) or f'{x!r:.40}'}"
