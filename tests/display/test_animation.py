"""A film is one piece of HTML that contains its numbers and needs nothing else."""

import re
import sys
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from PIL import Image

from lagjax.display import films
from lagjax.display.animation import FIELD, MARKED_UP_TO, Animation
from tests.display.web_page.test_page import decoded, told

T = np.linspace(0.0, 2.0, 51)
CIRCLE = np.stack([3 * np.cos(T), 3 * np.sin(T)], axis=1)[:, None]
POINTS = {"rod & bob": np.concatenate([np.zeros_like(CIRCLE), CIRCLE], axis=1), "tip": CIRCLE + 0.5}


@pytest.fixture(scope="module")
def page():
    """The HTML of a rod that turns, and a point beside it."""
    return Animation(T, POINTS, 25.0, 10)._repr_html_()


def numbers(page):
    """The data of the script, one array (F, k, 2) per part."""
    film = told(page)
    return [decoded(part["xy"], film["frames"], part["points"], 2) for part in film["parts"]]


def picture(page):
    """The SVG shown before any script runs."""
    return ET.fromstring(re.search(r"<svg.*</svg>", page)[0])


def test_numbers_are_the_points(page):
    """Undoing the scale recovers the points to a twentieth of a pixel, with one scale for x and y, and y upwards."""
    drawn = [part.astype(float) for part in numbers(page)]
    pixels, points = (np.concatenate([x.reshape(-1, 2) for x in all_]) for all_ in (drawn, POINTS.values()))
    scale = np.ptp(pixels[:, 0]) / np.ptp(points[:, 0])
    np.testing.assert_allclose(pixels[:, 0] - pixels[0, 0], scale * (points[:, 0] - points[0, 0]), atol=2)
    np.testing.assert_allclose(pixels[:, 1] - pixels[0, 1], -scale * (points[:, 1] - points[0, 1]), atol=2)
    assert np.ptp(pixels[:, 0]) <= FIELD[0] and np.ptp(pixels[:, 1]) <= FIELD[1] and np.min(pixels) >= 0
    # Twin: another scale is detected.
    assert np.max(np.abs(pixels[:, 0] - pixels[0, 0] - 1.02 * scale * (points[:, 0] - points[0, 0]))) > 2


def test_first_frame_stands_without_a_script(page):
    """The SVG shows the first frame, with ticks and axis labels; a name is escaped."""
    groups = [g for g in picture(page).iter() if "data-part" in g.attrib]
    for group, frames in zip(groups, numbers(page), strict=True):
        trail, line, dots = group
        assert trail.attrib["points"] == ""
        assert [int(x) for x in line.attrib["points"].split()] == frames[0].reshape(-1).tolist()
        assert [int(x) for x in re.findall(r"-?\d+(?= |h0)", dots.attrib["d"])] == frames[0].reshape(-1).tolist()
    words = [e.text for e in picture(page).iter() if e.tag.endswith("text")]
    assert {"x", "y", "-1", "0", "3"} <= set(words)
    assert "rod &amp; bob" in page


def test_outlines_have_no_marks():
    """Up to eight points are marked, a longer line is an outline."""
    line = np.stack([np.arange(MARKED_UP_TO + 1.0), np.zeros(MARKED_UP_TO + 1)], axis=1)
    for n, marked in ((MARKED_UP_TO, True), (MARKED_UP_TO + 1, False)):
        (group,) = (g for g in picture(Animation(T, {"": np.stack([line[:n]] * 51)}, 25.0, 0)._repr_html_()).iter()
                    if "data-part" in g.attrib)  # fmt: skip
        assert (len(group) == 3) is marked


def test_saves_a_page(tmp_path, page):
    """The saved page contains the same film, which needs nothing from outside."""
    Animation(T, POINTS, 25.0, 10).save(tmp_path / "motion.html")
    with pytest.raises(ValueError, match=r'(?s)would be no .avi file.*Fix: .save."motion.html"'):
        Animation(T, POINTS, 25.0, 10).save(tmp_path / "motion.avi")
    text = (tmp_path / "motion.html").read_text(encoding="utf-8")
    assert text.startswith("<!DOCTYPE html>") and page in text and len(page) < 15_000
    assert re.findall(r"(?:src|href|url|import|fetch)\b", page) == []
    assert set(re.findall(r"https?://[^\"]*", page)) == {"http://www.w3.org/2000/svg"}


@pytest.mark.parametrize("size", [0.0, 1e-9, 1e12])
def test_any_size(size):
    """A point at rest, a tiny and a huge motion are drawn with distinct ticks, in the plane and in space; one frame."""
    page = Animation(T, {"": size * CIRCLE}, 25.0, 10)._repr_html_()
    labels = [e.text for e in picture(page).iter() if e.tag.endswith("text")]
    assert 6 <= len(labels) <= 16 and len(set(labels[: labels.index("x")])) >= 3
    in_space = {"": size * np.concatenate([CIRCLE, CIRCLE[..., :1]], axis=-1)}
    data = told(Animation(T, in_space, 25.0, 10)._repr_html_())
    assert np.isfinite(data["view"]["scale"]) and len({label for _, label in data["grid"]["x"]}) >= 3
    assert told(Animation(T[:1], {"": in_space[""][:1]}, 25.0, 10)._repr_html_())["frames"] == 1


def test_a_film_of_pixels(tmp_path, monkeypatch):
    """A GIF has all frames at its rate; a dot is where its point is, in its colour; MP4 says what it needs."""
    few = slice(0, 51, 25)
    Animation(T[few], {"": POINTS["tip"][few]}, 25.0, 10).save(tmp_path / "motion.gif")
    with Image.open(tmp_path / "motion.gif") as film:
        assert (film.format, getattr(film, "n_frames"), film.info["duration"]) == ("GIF", 3, 40)
        places = []
        for i in range(3):
            film.seek(i)
            off = np.asarray(film.convert("RGB"), float) - [0x00, 0x72, 0xB2]
            rows, columns = np.nonzero(np.abs(off).max(axis=2) < 20)
            places.append((columns.mean(), -rows.mean()))
    way, of_dot = np.diff(places, axis=0), np.diff(POINTS["tip"][few, 0], axis=0)
    np.testing.assert_allclose(way / way[0, 1], of_dot / of_dot[0, 1], atol=0.05)
    in_space = {"": np.concatenate([CIRCLE, CIRCLE[..., :1]], axis=-1)[few]}
    Animation(T[few], in_space, 25.0, 10).save(tmp_path / "space.gif")
    with Image.open(tmp_path / "space.gif") as film:
        assert getattr(film, "n_frames") == 3
    monkeypatch.setattr(films, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ValueError, match=r'Fix: pip install imageio-ffmpeg, .* or .save."motion.gif"'):
        Animation(T, POINTS, 25.0, 10).save(tmp_path / "motion.mp4")
