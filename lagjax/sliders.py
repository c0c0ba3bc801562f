"""Turn parameters and see the motion follow: one compiled program, one picture, and a slider for each parameter.

A change of a slider costs a call of the program (about a millisecond for a small system), another to write the lines,
and the time the notebook takes to bring them to the screen. While a picture is made others wait, and only the last
position of a slider is drawn next: dragging leaves no queue. Needs ipywidgets.
"""

import html
import math
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from lagjax.integrate import in_words
from lagjax.sliders.picture import DPI, WIDTH, Picture
from lagjax.sweep import LAYOUTS, TRUSTED, axes_of, drawn, program_for

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
    try:
        import ipywidgets
    except ImportError as error:
        raise ImportError(
            'sliders in a notebook need ipywidgets, which is an optional extra.\nFix: pip install "lagjax[interact]"'
        ) from error
    return ipywidgets


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
    if not callable(run):
        raise TypeError(
            f"run must be a function of a point, not {type(run).__name__}.\n"
            "Fix: lambda point: lj.integrate(system, q0, v0, params | point, ts=ts)."
        )
    import_widgets()
    controls, start = controls_of(knobs), dict(start or {})
    if unknown := [name for name in start if name not in controls]:
        raise ValueError(f"start has '{unknown[0]}', which is no knob.\nFix: one of {', '.join(controls)}.")
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
        if unknown := [name for name in values if name not in self._controls]:
            raise ValueError(f"'{unknown[0]}' is no knob.\nFix: one of {', '.join(self._controls)}.")
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
