"""Pages in a real browser: sliders choose the right lane, films play, without a network and by keyboard alone.

Needs Chromium or Chrome (`LAGJAX_CHROMIUM` says where, if it is not on the path).
"""

import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from benchmarks.speed.browser import Browser, installed
from lagjax.display import CUBE, SPHERE, TUBE, Anchor, InSpace, Shape, Still
from lagjax.display.animation import Animation, film, film_scripts
from lagjax.display.page import fragment, whole

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(installed() is None, reason="no Chromium or Chrome is installed, or LAGJAX_CHROMIUM not set"),
]

AXES = {"a": np.array([0.5, 1.0, 2.0]), "b <i>": np.array([-1.0, 0.0, 4.0, 9.0])}
T = np.linspace(0.0, 1.0, 6)
# The text of a slider; the value shown; the ends of a curve in units of its picture.
SLIDER = ".lagjax .row input[type=range]"
SHOWN = """(() => {
  const root = document.querySelector(".lagjax");
  return {status: root.querySelector("[data-status]").textContent, bad: root.querySelector("[data-status]").className,
    images: [...root.querySelectorAll("figure svg[role=img]")].map(x => x.ariaLabel),
    number: root.querySelector("dd").textContent,
    curve: root.querySelector('[data-curve="wave"]').getAttribute("d")};
})()"""
# Checks for accessibility without good sight or a mouse; an empty list if all requirements are met.
AUDIT = """(() => {
  const found = [], brightness = text => {
    const linear = x => x <= 0.03928 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4;
    const [r, g, b] = text.match(/[0-9.]+/g).map(x => linear(x / 255));
    return 0.2126 * r + 0.7152 * g + 0.0722 * b;
  };
  const headings = document.querySelectorAll("h1").length;
  if (!document.documentElement.lang || !document.title || headings !== 1) found.push("no language, title or heading");
  for (const control of document.querySelectorAll("input, button")) {
    if (!control.labels.length && !control.ariaLabel) found.push(`no label: ${control.outerHTML}`);
    if (control.tabIndex < 0) found.push(`not reached by keyboard: ${control.outerHTML}`);
    if (control.getBoundingClientRect().height < 18) found.push(`too small: ${control.outerHTML}`);
  }
  for (const image of document.querySelectorAll("svg:not([aria-hidden])")) {
    const named = image.getAttribute("role") === "img" && image.ariaLabel;
    if (!named) found.push(`no words: ${image.outerHTML.slice(0, 80)}`);
  }
  for (const element of document.querySelectorAll("body *:not(script):not(style)")) {
    const own = [...element.childNodes].some(node => node.nodeType === 3 && node.textContent.trim());
    const box = element.getBoundingClientRect(), look = getComputedStyle(element);
    if (!own || !box.width || element.ariaHidden) continue;
    const colour = element instanceof SVGElement ? look.fill : look.color;
    if (1.05 / (brightness(colour) + 0.05) < 4.5) found.push(`too pale: ${element.textContent}`);
    if (box.height < 9) found.push(`too small: ${element.textContent}, ${box.height}`);
    if (box.right > innerWidth + 1 || box.left < -1) found.push(`beyond the edge: ${element.textContent}`);
  }
  if (document.documentElement.scrollWidth > innerWidth) found.push("wider than the window");
  return found;
})()"""


def run(point):
    """A number and a curve by lane."""
    a, b = point["a"], point["b <i>"]
    return {"root": a * jnp.sqrt(b), "t": T, "wave": a * T + b}


@pytest.fixture(scope="module")
def browser():
    """One browser for all pages."""
    with Browser() as started:
        yield started


@pytest.fixture(scope="module")
def swept():
    """A grid of closed forms, in which the root of a negative number fails."""
    return lj.sweep(run, AXES, progress=False)


@pytest.fixture
def text(swept, tmp_path):
    """The page of the sweep."""
    swept.to_html(tmp_path / "sweep.html")
    return (tmp_path / "sweep.html").read_text(encoding="utf-8")


def opened(browser, tmp_path, text, **size):
    """A page of some HTML."""
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    return browser.open(tmp_path / "page.html", **size)


def wrong_lanes(page):
    """Walk through all points with the arrow keys; returns those whose values differ from the closed form."""
    found = []
    for i, a in enumerate(AXES["a"]):
        for j, b in enumerate(AXES["b <i>"]):
            for k, places in enumerate((i, j)):
                page.run(f"document.querySelectorAll('{SLIDER}')[{k}].focus()")
                page.press("Home")
                for _ in range(places):
                    page.press("ArrowRight")
            shown = page.run(SHOWN)
            number = f"{a * np.sqrt(b):.6g}" if b >= 0 else "NaN"
            values = a * T + b
            # A point that failed has no values.
            words = f"between {min(values):.6g} and {max(values):.6g}" if b >= 0 else "there is no value"
            well = f"a = {a:.6g}, b <i> = {b:.6g}: successful" == shown["status"]
            right = well == (b >= 0) and number == shown["number"] and words in shown["images"][1]
            right &= len(re.findall("[ML]", shown["curve"])) == (len(T) if b >= 0 else 0)
            found += [] if right else [(i, j, shown)]
    return found


def test_sliders_choose_the_lane(browser, tmp_path, text):
    """At all points number, curve and status match the closed form; no script logs errors or loads anything."""
    page = opened(browser, tmp_path, text)
    assert wrong_lanes(page) == [] and page.complaints() == []
    # Twin: with a wrong stride, wrong lanes are shown.
    stride = "lane * lengths[k] + i"
    assert text.count(stride) == 1
    assert len(wrong_lanes(opened(browser, tmp_path, text.replace(stride, "lane + i * lengths[k]")))) > 4


def test_what_failed_is_said(browser, tmp_path, text):
    """Failures are reported in words, not by colour alone, also to screen readers."""
    page = opened(browser, tmp_path, text)
    page.run(f"document.querySelectorAll('{SLIDER}')[1].focus()")
    page.press("Home")
    shown = page.run(SHOWN)
    assert shown["status"] == "a = 1, b <i> = -1: not ok, The state became NaN or infinite." and shown["bad"] == "bad"
    assert page.run("document.querySelector('[data-status]').getAttribute('role')") == "status"
    assert page.run(f"document.querySelectorAll('{SLIDER}')[1].getAttribute('aria-valuetext')") == "b <i> -1"
    page.press("End")
    assert page.run(SHOWN)["bad"] == ""


def test_scales(browser, tmp_path, text):
    """One scale for all points, or one per point, in which the curve fills its picture."""
    page = opened(browser, tmp_path, text)
    height = "(box => box.height)(document.querySelector('[data-curve=\"wave\"]').getBoundingClientRect())"
    low = page.run(height)
    page.run("document.querySelector('input[type=checkbox]').focus()")
    page.press(" ")
    assert page.run(height) > 150 > 60 > low
    page.press(" ")
    assert page.run(height) == low


def circle(lanes):
    """A point on a circle, with a larger radius in each lane; the last lane has no motion."""
    t = np.linspace(0.0, 2.0, 51)
    turn = np.stack([np.cos(np.pi * t), np.sin(np.pi * t)], axis=-1)[:, None]
    radii = np.arange(1.0, lanes + 1.0)
    radii[1:][-1:] = np.nan
    return t, {"rod": np.stack([r * np.concatenate([0 * turn, turn], axis=1) for r in radii])}


FRAME = """(() => {
  const [trail, line] = document.querySelector("g[data-part]").children;
  const numbers = x => x.getAttribute("points").split(" ").filter(Boolean).map(Number);
  return {clock: document.querySelector("[data-film] output").textContent,
    line: numbers(line), trail: numbers(trail).length / 2,
    words: document.querySelector("svg").ariaLabel, button: document.querySelector("[data-film] button").ariaLabel};
})()"""


def test_a_film_plays(browser, tmp_path):
    """By keyboard: arrow keys change the frame, the space bar plays and stops; points match the clock."""
    t, points = circle(1)
    Animation(t, {name: x[0] for name, x in points.items()}, 25.0, 10).save(tmp_path / "film.html")
    page = browser.open(tmp_path / "film.html")
    first = page.run(FRAME)
    assert first["clock"] == "t = 0.00" and first["trail"] == 1 and first["words"] == "Motion of rod, t = 0.00"
    page.run("document.querySelector('[data-film] input').focus()")
    for _ in range(25):
        page.press("ArrowRight")
    half = page.run(FRAME)
    assert half["clock"] == "t = 1.00" and half["trail"] == 11
    # Half a turn later the point is opposite.
    np.testing.assert_allclose(np.add(first["line"][2:], half["line"][2:]) / 2, first["line"][:2], atol=1)
    page.press(" ")
    page.wait(f"({FRAME}).clock !== 't = 1.00'")
    playing = page.run(FRAME)
    assert playing["button"] == "pause" and playing["line"] != half["line"]
    page.press(" ")
    stopped = page.run(FRAME)
    page.run("new Promise(done => setTimeout(done, 150))")
    assert page.run(FRAME) == stopped and stopped["button"] == "play" and page.complaints() == []
    # Its position on the circle matches the clock to half a frame.
    turned = np.subtract(stopped["line"][2:], stopped["line"][:2]) * [1, -1]
    expected = np.pi * float(stopped["clock"].removeprefix("t = "))
    assert abs(np.angle(complex(*turned) / np.exp(1j * expected))) < 0.02


def test_films_of_several_lanes(browser, tmp_path):
    """Each lane has its own frames; a lane without a motion says so."""
    body, spec = film(*circle(3), 25.0, 10)
    html = fragment(body, {"film": spec}, film_scripts(spec), "window.show = film(root, spec.film);")
    page = opened(browser, tmp_path, whole("Lanes", html))
    reach = []
    for lane in (0, 1, 2, 0):
        page.run(f"show({lane})")
        frame = page.run(FRAME)
        reach.append(frame["line"][2] - frame["line"][0] if frame["line"] else None)
    assert reach[1] == pytest.approx(2 * reach[0], abs=1) and reach[2] is None and reach[3] == reach[0]
    page.run("show(2)")
    assert page.run(FRAME)["words"] == "Motion of rod, no motion to draw"


@pytest.mark.parametrize("width", [360, 1200])
def test_for_everybody(browser, tmp_path, text, width):
    """At two widths: labels, alternative texts, contrast, sizes, and nothing beyond the edge."""
    t, points = circle(1)
    Animation(t, {name: x[0] for name, x in points.items()} | {"tip": points["rod"][0, :, 1:]}, 25.0, 10).save(
        tmp_path / "film.html"
    )
    Animation(*tumbling(), 25.0, 10).save(tmp_path / "space.html")
    for file in ("sweep.html", "film.html", "space.html"):
        assert browser.open(tmp_path / file, width=width).run(AUDIT) == []
    # Twin: a missing label and pale text are found.
    changed = text.replace('element(row, "label", {for: id}, axis.name);', "").replace("color: #222", "color: #aaa")
    audit = opened(browser, tmp_path, changed, width=width).run(AUDIT)
    assert any("no label" in x for x in audit) and any("too pale" in x for x in audit)


def test_twice_in_one_notebook(browser, tmp_path, swept):
    """The same output twice gives two independent sets of sliders with their own labels."""
    page = opened(browser, tmp_path, whole("Twice", 2 * swept.to_html().html))
    page.run(f"document.querySelectorAll('{SLIDER}')[0].focus()")
    page.press("Home")
    places = page.run("[...document.querySelectorAll('[data-status]')].map(x => x.textContent)")
    assert [x.split(",")[0] for x in places] == ["a = 0.5", "a = 1"]
    ids = page.run("[...document.querySelectorAll('input')].map(x => x.id)")
    assert len(set(ids)) == len(ids) == 6 and page.complaints() == []


def test_the_browser_can_complain(browser, tmp_path):
    """Twin: a failing script and a page that loads something are detected."""
    html = '<script>throw Error("twin")</script><img src="http://127.0.0.1:9/picture.png">'
    told = json.dumps(opened(browser, tmp_path, html).complaints())
    assert "twin" in told and "picture.png" in told


def tumbling():
    """A box that moves and turns, a ball on a rod, a line in space, and a trail."""
    t = np.linspace(0.0, 2.0, 51)
    turn = np.stack([np.cos(t), 0.6 * np.sin(t), 0 * t, 0.8 * np.sin(t)], axis=1)
    poses = {
        "box": np.concatenate([np.stack([t, 0 * t, 1 + t], axis=1), turn], axis=1),
        "ball": np.concatenate([np.stack([t, 1 + t, 0 * t + 1], axis=1), turn], axis=1),
    }
    at = lambda name, *point: Anchor(name, np.array(point))
    shapes = (
        Shape("solid", (at("box", 0.0, 0.0, 0.0),), CUBE, np.array([1.0, 0.5, 0.2])),
        Shape("solid", (at("ball", 0.0, 0.0, 0.0),), SPHERE, 0.4 * np.ones(3)),
        Shape("rod", (at("box", 0.0, 0.0, 0.0), at("ball", 0.0, 0.0, 0.0)), TUBE, np.array([0.05, 0.05, 1.0])),
        Shape("dot", (at("box", 0.5, 0.25, 0.1),), color="#000000"),
        Shape("trail", (at("ball", 0.0, 0.0, 0.4),)),
    )
    return t, InSpace(shapes, poses, {"wire": np.stack([np.zeros((51, 3)), poses["box"][:, :3]], axis=1)})


def pixels(page, tmp_path):
    """What is visible, as numbers (rows, columns, 3)."""
    from matplotlib import image

    page.picture(tmp_path / "seen.png")
    return image.imread(tmp_path / "seen.png")[:, :, :3]


def canvas_beside(svg: str, browser, tmp_path, text: str, *keys: str):
    """How far a page's canvas, after these keys, is from an SVG: the mean of the pixels; and the canvas' label."""
    size = {"width": 560, "height": 520}
    by_python = pixels(opened(browser, tmp_path, f"<body style='margin:0'>{svg}", **size), tmp_path)
    page = opened(browser, tmp_path, whole("In space", text), **size)
    label = page.run("document.querySelector('canvas').ariaLabel")
    page.run("document.body.replaceChildren(document.querySelector('canvas')); document.body.style.margin = 0")
    page.run("document.querySelector('canvas').focus({focusVisible: false})")
    for key in keys:
        page.press(key)
    page.run("document.querySelector('canvas').blur()")
    page.run("new Promise(done => setTimeout(done, 50))")
    assert page.complaints() == []
    return np.mean(np.abs(pixels(page, tmp_path)[:250] - by_python[:250])), label


TUMBLING = tumbling()[1].at(slice(40, 41))
ALONE = Still(TUMBLING.finished(frames=True), (-60.0, 22.0))._repr_html_()
FIRST = Animation(tumbling()[0][40:], tumbling()[1].at(slice(40, None)), 25.0, 0)._repr_html_()


@pytest.mark.parametrize(
    ("text", "label", "right", "wrong"),
    [
        (FIRST, "Motion in space of box, ball, wire, t = ", "2 * (x * y + w * z)", "2 * (x * y - w * z)"),
        (ALONE, "Picture in space of box, ball, wire. ", '["mark", "gap"].includes(shape.kind)', "false"),
    ],
    ids=["first frame", "still"],
)
def test_the_canvas_shows_what_python_paints(browser, tmp_path, text, label, right, wrong):
    """Painted by the script, a frame or a state has the pixels of the SVG that Python paints, but for edges.

    Twins: seen from five degrees to the side, with a sign wrong in the rotation, or with marks behind what is before
    them, it has not.
    """
    svg = re.search(r"<svg.*?</svg>", text, re.DOTALL)
    assert svg is not None and ("<button" in text) == (text is FIRST)

    def differ(text: str, *keys: str):
        difference, said = canvas_beside(svg[0], browser, tmp_path, text, *keys)
        assert said.startswith(label)
        return difference

    near = differ(text)
    assert near < 0.002 and text.count(right) == 1
    assert differ(text, "ArrowRight") > 5 * near and differ(text.replace(right, wrong)) > 1.5 * near


def test_a_film_in_space_turns_and_zooms(browser, tmp_path):
    """By mouse, wheel, fingers and keys the picture changes; the first view comes back, pixel by pixel; it plays."""
    Animation(*tumbling(), 25.0, 10).save(tmp_path / "film.html")
    page = browser.open(tmp_path / "film.html", width=700, height=620)
    canvas = "document.querySelector('canvas')"
    words = page.run(f"{canvas}.ariaLabel")
    assert words.startswith("Motion in space of box, ball, wire, t = 0.00") and "Arrow keys" in words
    first, centre = pixels(page, tmp_path), "b => [b.x + b.width / 2, b.y + b.height / 2]"
    x, y = page.run(f"({centre})({canvas}.getBoundingClientRect())")

    def mouse(kind, dx=0.0, dy=0.0, **more):
        page.ask("Input.dispatchMouseEvent", type=kind, x=x + dx, y=y + dy, button="left", clickCount=1, **more)

    def fingers(kind, *places):
        points = [{"x": x + dx, "y": y + dy, "id": i} for i, (dx, dy) in enumerate(places)]
        page.ask("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def changed():
        return np.mean(np.abs(pixels(page, tmp_path) - first))

    def drag(**more):
        mouse("mousePressed", **more)
        mouse("mouseMoved", 80.0, 30.0, buttons=1, **more)
        mouse("mouseReleased", 80.0, 30.0, **more)

    def pinch():
        fingers("touchStart", (-40, 0), (40, 0))
        fingers("touchMove", (-90, 0), (90, 0))
        fingers("touchEnd")

    wheel = lambda: page.ask("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=-300)
    for act in (drag, lambda: drag(modifiers=8), wheel, pinch):
        act()
        page.run("new Promise(done => setTimeout(done, 50))")
        assert changed() > 0.005
        page.run(f"{canvas}.ondblclick()")
        assert changed() == 0.0
    page.run(f"{canvas}.focus({{focusVisible: false}})")
    for key in ("ArrowLeft", "ArrowUp", "+"):
        page.press(key)
    assert changed() > 0.005
    page.press("Home")
    page.run(f"{canvas}.blur()")
    assert changed() < 1e-3
    page.run("document.querySelector('[data-film] input').focus()")
    for _ in range(25):
        page.press("ArrowRight")
    assert page.run(f"{canvas}.ariaLabel").startswith("Motion in space of box, ball, wire, t = 1.00")
    page.press(" ")
    page.wait(f"!{canvas}.ariaLabel.includes('t = 1.00')")
    assert page.complaints() == []
