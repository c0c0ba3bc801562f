"""The controls of a user: ranges, values and choices, and the widget for each. Needs ipywidgets."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

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
