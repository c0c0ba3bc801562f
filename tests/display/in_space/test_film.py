"""A film in space is one piece of HTML: its numbers are the poses, its first frame stands without a script."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from lagjax.display import CUBE, SPHERE, Anchor, Animation, InSpace, Shape, film, film_scripts, stills_in_space
from lagjax.display.painting import marks, trails, view_of
from tests.display.web_page.test_page import NASTY, decoded, told

T = np.linspace(0.0, 2.0, 51)
TURN = np.stack([np.cos(T), 0 * T, 0 * T, np.sin(T)], axis=1)
POSES = {
    # Nearly unit quaternions, as interpolation leaves them.
    NASTY: np.concatenate([np.stack([T, 0 * T, 1 + T], axis=1), 0.999 * TURN], axis=1),
    "b": np.tile([0.0, 1, 1, 1, 0, 0, 0], (51, 1)),
}
SHAPES = (
    Shape("solid", (Anchor(NASTY, np.zeros(3)),), CUBE, np.array([1.0, 0.5, 0.2])),
    Shape("solid", (Anchor("b", np.zeros(3)),), SPHERE, 0.5 * np.ones(3), "#123456"),
    Shape("line", (Anchor(None, np.zeros(3)), Anchor("b", np.zeros(3)))),
    Shape("trail", (Anchor(NASTY, np.array([0.0, 0.0, 0.1])),)),
)
POINTS = {"tip": np.stack([T, T**2, 0 * T], axis=1)[:, None]}
MOTION = InSpace(SHAPES, POSES, POINTS)


@pytest.fixture(scope="module")
def page():
    """The HTML of a box, a ball, a line, and a point."""
    return Animation(T, MOTION, 25.0, 10)._repr_html_()


def test_needs_nothing_from_outside(page):
    """No URL except the SVG namespace, no name that ends the script; each shape and surface is there once."""
    assert re.findall(r"(?:src|href|url|import|fetch)\b", page) == []
    assert set(re.findall(r"https?://[^\"]*", page)) == {"http://www.w3.org/2000/svg"}
    assert page.count("</script>") == 2 and "<script>alert" not in page
    data = told(page)
    assert len(data["surfaces"]) == 2 and [s["kind"] for s in data["shapes"]] == ["solid", "solid", "line", "trail"]
    assert data["shapes"][1]["color"] == [0x12, 0x34, 0x56] and len(page) < 60_000


def test_numbers_are_the_motion(page):
    """Poses and points to single precision; the anchors by the numbers of their bodies."""
    data = told(page)
    found = decoded(data["poses"], 51, 2, 7)
    known = np.stack(list(POSES.values()), axis=1)
    np.testing.assert_allclose(found[..., :3], known[..., :3], rtol=1e-7)
    np.testing.assert_allclose(found[:, 0, 3:], TURN, rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(decoded(data["parts"][0]["xyz"], 51, 1, 3), POINTS["tip"], rtol=1e-7)
    assert [a["body"] for a in data["shapes"][2]["anchors"]] == [None, 1]


def test_first_frame_stands_without_a_script(page):
    """The SVG has the faces in sight and the labels of its axes; its words name the bodies."""
    picture = ET.fromstring(re.search(r"<svg.*</svg>", page, re.DOTALL)[0])
    words = [e.text for e in picture.iter() if e.tag.endswith("text")]
    assert {"x", "y", "z"} <= set(words) and any(re.fullmatch(r"-?\d+(\.\d)?", word) for word in words)
    filled = [e for e in picture.iter() if e.tag.endswith("path") and e.attrib["d"].endswith("z")]
    assert 27 + 60 < len(filled) < 27 + 100 and NASTY[:9] in picture.attrib["aria-label"]


def test_several_lanes():
    """Points by lane, NaN in one without a motion, which has no say in the size; the plane keeps its script."""
    lanes = {"": np.stack([POINTS["tip"], np.full_like(POINTS["tip"], np.nan)])}
    _, data = film(T, lanes, 25.0, 10)
    found = decoded(data["parts"][0]["xyz"], 2, 51, 1, 3)
    assert np.isnan(found[1]).all() and np.isfinite(data["view"]["scale"]) and "space.js" in film_scripts(data)
    _, plane = film(T, {"": lanes[""][..., :2]}, 25.0, 10)
    assert "film.js" in film_scripts(plane) and "space.js" not in film_scripts(plane)


def test_a_figure_of_some_instants():
    """One instant has the colours of the film's marks, the nearest last; the first of several is paler."""
    view, _ = view_of(*MOTION.extent(), -60.0, 22.0)
    painted = sorted(trails(MOTION, view) + marks(MOTION.at(50), view), key=lambda mark: mark.nearness)
    colours = lambda fig: fig.axes[0].collections[0].get_edgecolor()[:, :3]
    one = stills_in_space(MOTION, MOTION.at(slice(50, None)), -60.0, 22.0)
    np.testing.assert_allclose(colours(one)[-len(painted) :], [mark.color for mark in painted], atol=1e-12)
    both = stills_in_space(MOTION, MOTION.at(slice(0, None, 50)), -60.0, 22.0)
    assert colours(both).mean() > colours(one).mean() + 0.05 and one.axes[0].get_aspect() == 1.0
