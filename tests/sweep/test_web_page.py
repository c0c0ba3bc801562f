"""The page of a sweep contains the values of every lane, and says what failed and what is left out."""

import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.display.web_page.test_page import decoded, told
from tests.systems import motion

AXES = {"a": np.array([1.0, 2.0, 3.0]), "b": np.array([-1, 0, 4, 9])}
T = np.linspace(0.0, 1.0, 6)


def run(point):
    """A number, curves over time and over their index, and an array with too many columns."""
    wave = jnp.sin(point["a"] * T + point["b"])
    return {
        "root": point["a"] * jnp.sqrt(point["b"] * 1.0),
        "of": {"t": T * point["a"], "wave": wave, "pair": jnp.stack([wave, -wave], axis=1)},
        "turn": jnp.exp(1j * point["a"] * T),
        "matrix": jnp.ones((4, 40)),
    }


@pytest.fixture(scope="module")
def swept():
    """A grid in which the root of a negative number fails."""
    return lj.sweep(run, AXES, progress=False)


def array(encoded, dtype, *shape):
    """Decode an array of the page, and check its dtype."""
    assert encoded[0] == dtype
    return decoded(encoded, *shape)


def test_the_values_of_every_lane(swept):
    """Numbers to all digits, curves in single precision, in the order of the sweep; each lane with its own times."""
    page = told(swept.to_html().html)
    assert [axis["name"] for axis in page["axes"]] == ["a", "b"] and page["start"] == [1, 2]
    assert page["axes"][1]["labels"] == ["-1", "0", "4", "9"] and page["axes"][0]["at"] == [1.0, 2.0, 3.0]
    (root,) = page["numbers"]
    np.testing.assert_array_equal(array(root["values"], "f8", 3, 4), swept.values["root"])
    panels = {panel["label"]: panel for panel in page["panels"]}
    assert set(panels) == {"of.wave", "of.pair", "turn (real)", "turn (imaginary)"}
    wave, pair, turn = panels["of.wave"], panels["of.pair"], panels["turn (imaginary)"]
    expected = swept.values["of"]
    assert (wave["across"], turn["across"], wave["length"]) == ("t", "index", 6)
    np.testing.assert_array_equal(array(wave["x"], "f4", 3, 4, 6), expected["t"].astype("f4"))
    np.testing.assert_array_equal(array(wave["curves"][0]["y"], "f4", 3, 4, 6), expected["wave"].astype("f4"))
    assert [curve["name"] for curve in pair["curves"]] == ["of.pair[0]", "of.pair[1]"]
    np.testing.assert_array_equal(array(pair["curves"][1]["y"], "f4", 3, 4, 6), expected["pair"][..., 1].astype("f4"))
    # Values shared by all lanes are stored once.
    np.testing.assert_array_equal(array(turn["x"], "f4", 6), np.arange(6))
    np.testing.assert_allclose(array(turn["curves"][0]["y"], "f4", 3, 4, 6)[:, 1:], swept.values["turn"].imag[:, 1:])


def test_what_failed_and_what_is_left_out_in_words(swept):
    """The page has a status for every lane, its meaning, and which are good; matrices left out are named."""
    page = swept.to_html()
    spec = told(page.html)
    codes = array(spec["status"], "i1", 3, 4)
    np.testing.assert_array_equal(codes, swept.status.result)
    assert not np.isin(codes[:, 0], spec["trusted"]).any() and np.isin(codes[:, 1:], spec["trusted"]).all()
    assert spec["words"][str(codes[0, 0])] == "The state became NaN or infinite."
    assert "Not drawn: matrix of shape (4, 40)." in page.html
    assert repr(page).startswith("Page of 12 points, a (3) x b (4), ")


def test_paired_axes_and_slices_have_one_slider():
    """Paired axes share one slider, whose labels name all axes; slices are numbered; booleans are words."""
    axes = {"a": np.array([1.0, 2.5]), "w": np.eye(2)}
    together = lj.sweep(lambda p: p["a"] * p["w"][0], axes, paired=True, progress=False).to_html()
    (slider,) = told(together.html)["axes"]
    assert slider["labels"][1] == "a = 2.5, w of shape (2,)" and slider["name"] == "point"
    axes = {"w": np.eye(2), "c": np.array([False, True])}
    grid = lj.sweep(lambda p: p["c"] * p["w"][0], axes, progress=False).to_html()
    of_slices, of_switch = told(grid.html)["axes"]
    assert of_slices["labels"] == ["no. 0 of shape (2,)", "no. 1 of shape (2,)"]
    assert of_switch["labels"] == ["False", "True"] and of_switch["at"] == [0, 1]


def test_writes_a_file_and_reads_a_store(tmp_path):
    """`path` is written; a sweep opened from its store has the same page."""
    axes = {"a": np.array([1.0, 4.0])}
    swept = lj.sweep(lambda p: {"root": jnp.sqrt(p["a"])}, axes, store=tmp_path / "store", progress=False)
    swept.to_html(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    spec = told(lj.open_sweep(tmp_path / "store").to_html().html)
    assert told(text)["numbers"] == spec["numbers"] != [] and "<title>Sweep over a</title>" in text


def test_what_single_precision_would_hide():
    """Small changes of large numbers, and huge and tiny numbers, keep double precision."""
    t = np.linspace(0.0, 1.0, 11)
    run = lambda p: {
        "near": 1e6 + p["a"] * t, "huge": 1e300 * p["a"] * t, "tiny": 1e-60 * p["a"] * t, "plain": p["a"] * t,
    }  # fmt: skip
    page = told(lj.sweep(run, {"a": np.array([1.0, 2.0])}, progress=False).to_html().html)
    curves = {panel["label"]: panel["curves"][0]["y"] for panel in page["panels"]}
    for name, dtype in (("near", "f8"), ("huge", "f8"), ("tiny", "f8"), ("plain", "f4")):
        expected = np.asarray(run({"a": 2.0})[name], dtype)
        np.testing.assert_allclose(array(curves[name], dtype, 2, 11)[1], expected, rtol=1e-15)


def test_batches_in_a_point_are_named():
    """A batch of trajectories per point is not drawn, and the page says so."""
    traj = motion("pendulum")
    several = jax.vmap(lambda v: eqx.tree_at(lambda x: x.q, traj, v * traj.q))
    swept = lj.sweep(lambda p: {"all": several(p["v"] * np.ones(2)), "v": p["v"]}, {"v": np.ones(1)}, progress=False)
    assert "Not drawn: all, a batch of trajectories." in swept.to_html().html


def refused(*parts):
    """Expect an error that holds all parts and a fix."""
    return pytest.raises(ValueError, match="(?s)" + "".join(f"(?=.*{re.escape(part)})" for part in (*parts, "Fix:")))


def test_what_makes_no_page(swept):
    """Errors for a page too large, nothing to draw, and a film without a trajectory."""
    with refused("larger than", "12 points", "megabytes"):
        swept.to_html(megabytes=0.001)
    with refused("nothing to draw", "value of shape (4, 40)"):
        lj.sweep(lambda p: jnp.ones((4, 40)) * p["a"], {"a": np.ones(2)}, progress=False).to_html()
    with refused("draws a motion", "0 trajectories"):
        swept.to_html(positions=lambda t, q, params: (q, q))
