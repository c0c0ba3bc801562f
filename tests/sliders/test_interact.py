"""Sliders without a browser: values arrive, nothing is recompiled, and failures are shown without breaking the widget.

`benchmarks/speed/slider_response.py` measures the same in JupyterLab, in a browser.
"""

import re
import sys
import threading
from base64 import b64decode
from collections.abc import Sized
from importlib.util import find_spec

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.sliders import Values, controls_of, start_of, words
from tests import by_hand
from tests.counting import compiles

pytestmark = pytest.mark.skipif(
    find_spec("ipywidgets") is None, reason='sliders need ipywidgets. Fix: pip install "lagjax[interact]"'
)

TS = np.linspace(0.0, 3.0, 31)
SWING = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))


def swing(point):
    """A pendulum."""
    return lj.integrate(SWING, point["angle"], 0.0, {"g": point["g"]}, ts=TS, method=lj.Tsit5())


def wave(point):
    """A function that compiles fast, and is NaN below omega = 1."""
    return {"t": TS, "x": jnp.sqrt(point["omega"] - 1.0) * jnp.sin(point["omega"] * TS), "double": 2 * point["omega"]}


def knobs_of(run, knobs, **settings):
    """Knobs without progress messages."""
    return lj.interact(run, knobs, progress=False, **settings)


@pytest.fixture(scope="module")
def waves():
    """Knobs of a wave."""
    return knobs_of(wave, {"omega": (0.0, 8.0)})


@pytest.mark.slow
def test_a_slider_moves_the_motion():
    """A trajectory at the slider's values is that in elliptic functions; another value compiles nothing."""
    knobs = knobs_of(swing, {"angle": (0.0, 3.0), "g": (1, 9)}, start={"angle": 1.0})
    before = knobs.picture
    with compiles() as compiled:
        knobs._sliders["g"].value = 4.0
        knobs.set(angle=2)
    assert len(compiled) == 0 and knobs.point == {"angle": 2.0, "g": 4.0} and knobs.ok and knobs.picture != before
    angle = lambda start: by_hand.swing(TS, start, 2.0)[0]
    np.testing.assert_allclose(knobs.result.q, angle(2.0), atol=1e-3)
    # Twin: the motion of the previous value differs.
    assert np.max(np.abs(knobs.result.q - angle(1.0))) > 0.1


def test_values_arrive(waves):
    """`result` is what `run` returns, as NumPy arrays; the same value gives the same picture."""
    pictures = [waves.set(omega=x).picture for x in (3.0, 5.0, 3.0)]
    assert waves.result["double"] == 6.0 and isinstance(waves.result["x"], np.ndarray)
    np.testing.assert_allclose(waves.result["x"], np.sqrt(2.0) * np.sin(3.0 * TS), rtol=1e-12, atol=1e-14)
    assert pictures[0] == pictures[2] != pictures[1] and pictures[0][:8] == b"\x89PNG\r\n\x1a\n"
    assert len(pictures[0]) < 40_000


def test_a_point_that_fails_says_why(waves):
    """The reason is shown in picture, message and print; the next point works as usual."""
    well = waves.set(omega=4.0).picture
    failed = waves.set(omega=0.5)
    assert not failed.ok and "NaN" in failed.status and "NaN" in failed._message.value
    assert "not ok: The state became NaN" in repr(failed) and failed.picture != well
    assert waves.set(omega=4.0).ok and waves.picture == well and waves._message.value == ""


def test_a_draw_that_fails_says_why():
    """An error in the user's later drawings is shown, and the widget keeps working."""

    def draw(result, axes):
        if result["double"] > 10.0:
            raise KeyError("energy")
        axes.plot(result["t"], result["x"])

    knobs = knobs_of(wave, {"omega": (1.0, 8.0)}, draw=draw, start={"omega": 2.0})
    well = knobs.picture
    assert knobs.set(omega=6.0).status == "KeyError: 'energy'" and not knobs.ok
    assert knobs.set(omega=2.0).ok and knobs.picture == well
    with pytest.raises(KeyError, match="energy"):
        knobs_of(wave, {"omega": (1.0, 8.0)}, draw=draw, start={"omega": 6.0})


def test_choices_are_programs_of_their_own():
    """Values that are not numbers reach `run` unchanged; their program is compiled at the first choice, and kept."""

    def run(point):
        return point["shape"](point["omega"] * TS) if point["shape"] is not None else 1 / 0

    knobs = knobs_of(run, {"shape": [jnp.sin, jnp.cos, None], "omega": (0.0, 2.0)})
    with compiles() as first:
        np.testing.assert_allclose(knobs.set(shape=jnp.cos).result, np.cos(TS), atol=1e-12)
    with compiles() as again:
        np.testing.assert_allclose(knobs.set(shape=jnp.sin, omega=0.5).result, np.sin(0.5 * TS), atol=1e-12)
        knobs.set(shape=jnp.cos)
    assert len(first) > 0 and len(again) == 0
    assert "ZeroDivisionError" in knobs.set(shape=None).status and knobs.set(shape=jnp.cos).ok
    alone = knobs_of(lambda point: point["shape"](TS), {"shape": [jnp.sin, jnp.cos]})
    np.testing.assert_allclose(alone.set(shape=jnp.cos).result, np.cos(TS), atol=1e-12)


@pytest.mark.parametrize(
    "given, at, dtype",
    [
        ([1, 2, 5], 5, int),
        (np.linspace(0.0, 1.0, 5), 0.25, float),
        (jnp.array([1, 3], jnp.float32), 3.0, np.float32),
        (True, False, bool),
        ((0, 10), 3, float),
        ((1, 9, 2), 5, float),
        (np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([3.0, 4.0]), float),
    ],
    ids=["list", "array", "float32", "switch", "range of whole numbers", "range with a step", "vectors"],
)
def test_kinds_of_knobs(given, at, dtype):
    """Numbers of a list keep their dtype, ranges are floats, an array of vectors gives one of them."""
    knobs = knobs_of(lambda point: {"a": point["a"]}, {"a": given})
    assert np.all(knobs.set(a=at).result["a"] == at) and knobs.result["a"].dtype == dtype
    assert np.all(knobs.point["a"] == at)


def test_dragging_leaves_no_queue(waves, monkeypatch):
    """Positions that arrive while a picture is made are skipped, except the last, which is drawn next."""
    waves.set(omega=2.0)
    slider, drawn, shown = waves._sliders["omega"], [], waves._show
    busy, go_on = threading.Event(), threading.Event()

    def slowly(point):
        drawn.append(point["omega"])
        busy.set()
        assert go_on.wait(10.0)
        shown(point)

    monkeypatch.setattr(waves, "_show", slowly)
    change = lambda x: threading.Thread(target=setattr, args=(slider, "value", x))
    threads = [change(3.0)]
    threads[0].start()
    assert busy.wait(10.0)
    for x in (3.5, 4.0, 4.5, 5.0):
        threads.append(change(x))
        threads[-1].start()
        while slider.value != x:
            threading.Event().wait(0.001)
    go_on.set()
    for thread in threads:
        thread.join(10.0)
    assert drawn == [3.0, 5.0] and waves.result["double"] == 10.0


def test_several_at_once_are_one_picture(monkeypatch):
    """`set` of two knobs draws once."""
    knobs, drawn = knobs_of(lambda point: point["a"] * TS + point["b"], {"a": (0.0, 2.0), "b": (0.0, 2.0)}), []
    monkeypatch.setattr(knobs, "_show", drawn.append)
    knobs.set(a=0.5, b=0.25)
    assert drawn == [{"a": 0.5, "b": 0.25}]


def test_shows_itself(waves, tmp_path):
    """A notebook shows the sliders, a viewer without widgets the picture, a terminal a hint."""
    shown = waves.set(omega=3.0)._repr_mimebundle_()
    assert "application/vnd.jupyter.widget-view+json" in shown and b64decode(shown["image/png"]) == waves.picture
    assert shown["text/plain"] == repr(waves)
    assert repr(waves).startswith("Knobs: omega = 3 (0 to 8)\n  in a notebook these are sliders; here: knobs.set(")
    waves.save(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").read_bytes() == waves.picture
    assert [type(x).__name__ for x in waves.widget.children] == ["FloatSlider", "HTML", "HTML"]


def test_where_knobs_stand_at_first():
    """Knobs start in the middle of a range, on a step; at the first value; or where `start` says."""
    controls = controls_of({"a": (0.1, 3.0, 0.1), "b": [3, 1, 2], "c": (0, 1, 0.6), "d": False, "e": ["x", "y"]})
    found = {name: start_of(name, control, {"e": "y"}) for name, control in controls.items()}
    assert found == {"a": pytest.approx(1.5), "b": 3, "c": 0.6, "d": False, "e": "y"}
    assert [words(x) for x in controls.values()] == ["0.1 to 3", "3, 1, 2", "0 to 1", "False, True", "x, y"]
    assert isinstance(controls["b"], Values) and isinstance(controls["b"].values, Sized)


@pytest.mark.parametrize(
    "given",
    [(3, 1), (1, 1), (0, 1, 2), (0, 1, 0), (0.0, np.nan), (0, np.inf), (1, 2, 3, 4), (), [], "ab", 3.0, None,
     np.zeros(0), np.array("a"), np.zeros(6000)],
    ids=str,
)  # fmt: skip
def test_what_is_no_knob(given):
    """The error names the knob and gives an example."""
    with pytest.raises((TypeError, ValueError), match=r"(?s)'omega'.*Fix:"):
        controls_of({"omega": given})


def test_what_else_is_refused(waves, monkeypatch):
    """Errors for a wrong run, no knobs, unknown names and values out of range, and without ipywidgets."""
    knobs, ask = {"omega": (0.0, 1.0)}, lambda run, *more, **settings: lambda: knobs_of(run, *more, **settings)
    for act, error, said in (
        (ask(3.0, knobs), TypeError, "(?s)function of a point.*Fix:"),
        (ask(wave, {}), TypeError, "(?s)dictionary by name.*Fix:"),
        (ask(wave, list(knobs.items())), TypeError, "(?s)dictionary by name.*Fix:"),
        (ask(wave, knobs, start={"speed": 1.0}), ValueError, "'speed', which is no knob; .*'omega'.\nFix: 'omega'"),
        (lambda: waves.set(speed=1.0), ValueError, "'speed', which is no knob"),
        (lambda: waves.set(omega=9.0), ValueError, "from 0 to 8, and not to 9"),
        (ask(lambda point: point["speed"], knobs), ValueError, r"run\(point\) asks for 'speed'"),
    ):
        with pytest.raises(error, match=said):
            act()
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=re.escape('pip install "lagjax[interact]"')):
        ask(wave, knobs)()
