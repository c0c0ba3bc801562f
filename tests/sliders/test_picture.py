"""Live pictures: lines written into kept axes are where matplotlib draws them, and limits are stable."""

import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lagjax.sliders import FINE, MOST_PANELS, MOST_POINTS, Picture
from lagjax.sweep.result import drawn
from tests.tiers import exhaustive_but

T = np.linspace(0.0, 1.0, 200)


def of(amplitude, words="", picture=None, **more):
    """The picture of a wave and of twice the wave, and the pixels."""
    picture = picture or Picture()
    amplitude = np.full((1, 1, 1), amplitude)
    with np.errstate(invalid="ignore"):
        waves = amplitude * np.stack([np.sin(9 * T), np.cos(9 * T)], axis=1)[None]
    values = {"t": T[None], "x": waves, **more}
    picture.of_curves(drawn(values), words)
    return picture, pixels_of(picture.png())


def pixels_of(png):
    """The colours of a PNG (rows, columns, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), int)


def points_of(picture):
    """The points (n, 2) of each curve of an SVG, in pixels from its left upper corner, and the paths' attributes."""
    tag = "{http://www.w3.org/2000/svg}"
    for panel in ElementTree.fromstring(picture).iter(f"{tag}svg"):
        for path in panel.findall(f"{tag}path"):
            parts = re.findall(r"M([^M]*)", path.get("d"))
            points = [np.array(re.findall(r"-?\d+", part), int).reshape(-1, 2) for part in parts]
            corner = float(panel.get("x")), float(panel.get("y"))
            yield [corner + x / FINE for x in points], path.attrib


def test_lines_over_the_axes():
    """The points of the SVG are where matplotlib draws them, in their colours and dashes, with gaps where NaN is."""
    picture, x = Picture(), np.stack([np.sin(9 * T), np.where(abs(T - 0.5) < 0.1, np.nan, T)], axis=1)
    written = picture.of_curves(drawn({"t": T[None], "x": x[None]}), "")
    # A PNG in between leaves the axes where they are.
    assert picture.png() == picture.png()
    axis, height = picture.axes[0], picture.figure.bbox.height
    (first, look), (second, other_look) = points_of(written)
    expected = axis.transData.transform(np.column_stack([T, x[:, 0]])) * [1, -1] + [0, height]
    across, down = expected.T
    off = np.interp(across, *first[0].T) - down
    # A ninth of a pixel and the rounding, across lines that rise by up to 1.7 pixels in one.
    assert np.abs(off).max() < 0.35 and len(first[0]) > 20
    # Twin: upside down.
    assert np.abs(np.interp(across, *first[0].T) - (height - down)).max() > 100
    ends = [part[[0, -1], 0] for part in second]
    np.testing.assert_allclose(ends, [across[[0, 79]], across[[120, 199]]], atol=0.51 / FINE)
    assert (
        look["stroke"] != other_look["stroke"] and look["stroke-dasharray"] == "none" != other_look["stroke-dasharray"]
    )
    # Another value changes the lines, but not the axes.
    assert picture.of_curves(drawn({"t": T[None], "x": 0.9 * x[None]}), "") != written and picture.drawn_whole == 1


@pytest.mark.parametrize("bbox", [None, "tight"])
def test_axes_of_the_svg(bbox, monkeypatch):
    """The axes of the SVG stand around its lines, where those of the PNG are, with their ticks and names as text.

    So they do when the user's figures are saved without margins.
    """
    from matplotlib import rcParams

    monkeypatch.setitem(rcParams, "savefig.bbox", bbox)
    picture = Picture()
    written = picture.of_curves(drawn({"t": T[None], "<b>x": T[None]}), "a < b & 5 $")
    root, tag = ElementTree.fromstring(written), "{http://www.w3.org/2000/svg}"
    frame, panel, words = root
    spine = next(g for g in frame.iter(f"{tag}g") if g.get("id") == "patch_2").find(f"{tag}path")
    corners = np.array(re.findall(r"[\d.]+", spine.get("d")), float).reshape(-1, 2)
    pixels = corners / [float(x) for x in frame.get("viewBox").split()[2:]] * picture.figure.bbox.size
    box = [float(panel.get(name)) for name in ("x", "y", "width", "height")]
    np.testing.assert_allclose([*pixels.min(axis=0), *np.ptp(pixels, axis=0)], box, atol=0.01)
    # Twin: with axes that were laid out anew for other labels they are not.
    picture.axes[0].set_ylabel("a\nhigher\nlabel")
    picture.figure.set_layout_engine(picture._layout)
    picture.png()
    moved = ElementTree.fromstring(picture._svg())[1]
    assert abs(float(moved.get("x")) - box[0]) > 5
    texts = [x.text for x in frame.iter(f"{tag}text")]
    assert "t" in texts and "<b>x" in texts and "0.0" in texts and "<style" not in written
    assert words[0].text == "a < b & 5 $"


def test_many_points_are_thinned():
    """Of 2e5 points those remain that a pixel shows: each column keeps its height, and the message stays small."""
    t = np.linspace(0.0, 1.0, 200_001)
    picture = Picture()
    written = picture.of_curves(drawn({"t": t[None], "x": np.sin(30_000 * t)[None]}), "")
    (((points,), _),) = points_of(written)
    assert MOST_POINTS / 8 < len(points) < MOST_POINTS and len(written) < 60_000
    sizes = [np.ptp(points[points[:, 0] // 1 == column, 1]) for column in range(100, 600, 50)]
    whole = picture.axes[0].transData.transform([(0, -1), (0, 1)])[:, 1]
    assert min(sizes) > 0.9 * np.ptp(whole)


def test_limits_stay_until_they_are_left():
    """Limits grow with some room when a curve leaves them, and shrink when it fills less than an eighth."""
    picture = Picture()
    limits = lambda: picture.axes[0].get_ylim()
    draw = lambda amplitude: picture.of_curves(drawn({"t": T[None], "x": amplitude * np.sin(9 * T)[None]}), "")
    draw(1.0)
    first = limits()
    assert first[0] < -1.0 < 1.0 < first[1]
    draw(0.2)
    assert limits() == first and picture.drawn_whole == 1
    draw(1.3)
    assert limits()[0] < -1.3 < 1.3 < limits()[1] and picture.drawn_whole == 2
    draw(1.4)
    assert picture.drawn_whole == 2
    draw(0.01)
    assert limits()[1] < 0.02 and picture.drawn_whole == 3


@pytest.mark.parametrize("amplitude", exhaustive_but((0.0, 1e300, -np.inf), (0.0, 1e-300, 1e300, np.nan, -np.inf)))
def test_any_number(amplitude):
    """Curves that are flat, tiny, huge or missing can be drawn."""
    _, pixels = of(amplitude)
    assert pixels.std() > 1


def test_words_above():
    """A reason is red, without interpreting dollar signs; numbers are black; values not drawn are named."""
    red = lambda pixels: np.sum((pixels[..., 0] > 120) & (pixels[..., 1] < 60) & (pixels[:, :, 2] < 60))
    picture, failed = of(1.0, "it cost 5 $ and 3 $, and the state became NaN, " + "again and " * 40)
    assert red(failed[:45]) > 100
    _, well = of(1.0, picture=picture, period=np.array([2.5]), matrix=np.ones((1, 3, 40)))
    assert red(well[:45]) == 0 and np.sum(well[:45].sum(axis=-1) < 200) > 100
    assert picture._above.get_text() == "period = 2.5,  not drawn: matrix of shape (3, 40)"
    failed = picture.of_words("wrong")
    assert red(pixels_of(picture.png())[:45]) > 20 and not any(
        len(x) > 1 for part, _ in points_of(failed) for x in part
    )


def test_panels():
    """One panel per value; beyond a few they are only named; other values get another figure."""
    many = {f"value {i}": T[None] for i in range(MOST_PANELS + 1)}
    picture = Picture()
    picture.of_curves(drawn(many), "")
    assert len(picture.axes) == MOST_PANELS and f"not drawn: value {MOST_PANELS}" in picture._above.get_text()
    of(1.0, picture=picture)
    assert len(picture.axes) == 1 and picture.axes[0].get_xlabel() == "t"
    picture.of_curves(drawn({"number": np.array([1.0])}), "")
    assert picture._above.get_text() == "number = 1"


def test_what_the_user_draws():
    """A user's drawing function is called with the result and empty axes each time."""
    picture, lines = Picture(), []

    def draw(result, axes):
        axes.plot(T, result * T, "k--")
        lines.append(len(axes.lines))

    first, second = (picture.of_user(draw, x, "") for x in (1.0, -1.0))
    assert lines == [1, 1] and first != second and "stroke-dasharray" in second
    png = picture.png()
    picture.of_user(draw, 1.0, "")
    assert picture.png() != png
