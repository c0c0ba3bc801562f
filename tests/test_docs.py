"""The site: every public name has an example and its errors, every message is found, pages are accessible.

The code on its pages is run by `test_readme.py`; `docs/check_pages.mjs` looks at them in a browser.
"""

import doctest
import importlib.util
import inspect
import json
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import api_pages
import error_pages
import notebook_pages
import pytest
import result_pages

import lagjax as lj
from benchmarks import measure
from lagjax import refusals
from lagjax.mechanisms import MECHANISMS
from lagjax.scenes import SCENES

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
GALLERY = (DOCS / "gallery.md").read_text()


def lacks(name, thing, page):
    """The parts missing from the page of a public name."""
    function = inspect.isfunction(inspect.unwrap(thing)) if callable(thing) else False
    parts = {"signature": "{py:" in page, "example": ">>> " in page, "errors": not function or "**Raises:**" in page}
    return [part for part, there in parts.items() if not there]


def test_every_public_name_has_a_page():
    """Every page has a signature, an example and, for functions, errors. Twin: a function without both is found."""
    names = api_pages.public_names()
    found = {name: lacks(name, api_pages.named(name), api_pages.page(name)) for name in names}
    assert {name: missing for name, missing in found.items() if missing} == {}
    pages = [api_pages.page_of(name).lower() for name in names]
    assert len(set(pages)) == len(pages)
    listed = api_pages.index(api_pages.sections())
    assert all(f"({api_pages.page_of(name)}.md)" in listed for name in names)

    def silent(t):
        """Say nothing."""

    assert lacks("silent", silent, api_pages.described(silent, "silent")) == ["example", "errors"]


def test_sections_are_those_of_the_front_door():
    """All names are in sections named by the comments of `lagjax/__init__.pyi`, those of its parts, and results."""
    sections = api_pages.sections()
    names = sum(sections.values(), [])
    assert sorted(name for name in names if name in lj.__all__) == sorted(lj.__all__) and len(set(names)) == len(names)
    assert set(names) >= {"bodies.Body", "shapes.rod", "guards.touches", "Trajectory"} and "Body" not in names
    assert list(sections)[0].startswith("A system") and "momentum" in next(v for k, v in sections.items() if "One" in k)


def test_code_in_texts_is_linked():
    """Code that begins with a public name leads to its page, that of a part to its own. Twins: what has moved."""
    cases = {"lj.fit(system)": "fit", "lj.bodies.Body": "bodies.Body", "lj.shapes.rod(a, b)": "shapes.rod",
             "lj.bodies": "bodies", "Trajectory": "Trajectory", "lj.scenes.rolling_hoop": "scenes",
             "lj.Body": None, "lj.Trajectory": None, "Trajectory.animate": None, "fit": None}  # fmt: skip
    assert {code: api_pages.name_in(code) for code in cases} == cases


def test_added_examples_run():
    """Examples on pages that are not in a docstring."""
    parser, runner = doctest.DocTestParser(), doctest.DocTestRunner(verbose=False)
    for name in api_pages.public_names():
        if text := api_pages.added_example(api_pages.named(name), name):
            runner.run(parser.get_doctest(text, {}, name, None, 0), out=lambda line: None)
    assert runner.tries >= 10 and runner.failures == 0


MESSAGES = '''
def f(x):
    """Not a message.

    Fix: nothing.
    """
    if x:
        raise ValueError(f"{x} is quite wrong, {x}{x}.\\nFix: " + f(x))
    warnings.warn("beware of this", AccuracyWarning)
    fix, y = "x=1", x + 1
    must_be_whole(x, f"{y} of {f}", fix=fix)
    return "the rope is torn.\\nUsual cause: age.\\nFix: a new one."
'''


def test_messages_are_found():
    """Messages that are raised, by rules too, used in warnings, or built for others are found; docstrings are not."""
    assert error_pages.messages(MESSAGES) == [
        ("ValueError", "… is quite wrong, ….\nFix: …"),
        ("AccuracyWarning", "beware of this"),
        ("ValueError", "… of … must be a whole number …, not ….\nFix: x=1."),
        ("", "the rope is torn.\nUsual cause: age.\nFix: a new one."),
    ]


def missing_files(text: str) -> list[str]:
    """The files of the project that a page names and that are not there."""
    named = re.findall(r"(?:lagjax|tests|benchmarks)/[\w/]+\.py\b", text)
    return sorted({path for path in named if not (ROOT / path).exists()})


def test_files_that_pages_name_are_there():
    """Twin: one that was moved is noticed."""
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    assert {str(page): missing for page in pages if (missing := missing_files(page.read_text()))} == {}
    assert missing_files("lagjax/files/table.py, lagjax/mechanics/file_table.py") == ["lagjax/mechanics/file_table.py"]


ALL = pytest.param("**/*.py", 300, marks=pytest.mark.slow)


@pytest.mark.parametrize(("files", "least"), [("system/*.py", 30), ALL])
def test_every_message_has_its_place(files, least):
    """A message that occurs is on the page, and each has its own anchor."""
    page = error_pages.page(files)
    with pytest.raises(TypeError) as raised:
        lj.Holonomic(3)  # pyright: ignore[reportArgumentType]
    said = "g of lj.Holonomic(g) must be a function of (t, q, params), not ….\nFix: lj.Holonomic(g), with def"
    assert re.match(re.escape(said).replace("…", ".+"), str(raised.value)) and said in page
    assert set(error_pages.RULES) == {name for name in vars(refusals) if name.startswith("must") or name == "installed"}
    anchors = re.findall(r"^\((.*)\)=$", page, re.MULTILINE)
    assert len(anchors) == len(set(anchors)) > least


def test_results_keep_what_is_missed():
    """Rows that missed their target are bold; twin: the same row with its target met is not."""
    row = {"what": "a_b", "value": 2.0, "target": 1.0, "met": False, "better": "less"}
    assert result_pages.line(row) == "| a\\_b | 2 | ≤ 1 | **missed** |"
    assert "missed" not in result_pages.line(row | {"met": True})


def test_rows_measured_later_are_said():
    """Rows of a second run replace those of the first, new ones are last, and the page names them, with the note.

    Twin: rows of another clock are refused.
    """
    run = {"machine": "m", "clock": "wall time", "note": "beside other work"}
    first = run | {"rows": [measure.row("a", 1.0), measure.row("b", 2.0)]}
    second = {"machine": "m", "clock": "wall time", "rows": [measure.row("c", 4.0), measure.row("b", 3.0)]}
    found = measure.merged(first, second)
    assert [(x["what"], x["value"]) for x in found["rows"]] == [("a", 1.0), ("b", 3.0), ("c", 4.0)]
    page = result_pages.one_file("none", measure.merged(found, second))
    assert "Note: beside other work. Measured later than the rest: b, c." in page
    with pytest.raises(SystemExit, match="another machine or clock"):
        measure.merged(first, second | {"clock": "processor time"})


@pytest.mark.parametrize("name", [*SCENES, "woodpecker", *MECHANISMS])
def test_gallery_has_a_picture_and_a_formula(name):
    """There is a film of every scene and mechanism, with an alternative text."""
    section = next(part for part in GALLERY.split("\n### ") if f"gallery/{name}.png" in part)
    alt = re.search(r"!\[(.*)\]", section)
    assert alt and len(alt[1]) > 40
    assert "$$" in section and f".{name}`" in section
    assert 4_000 < (DOCS / "gallery" / f"{name}.png").stat().st_size < 100_000


@pytest.mark.exhaustive
def test_a_picture_is_drawn():
    """The figure of one mechanism as drawn by the script; the closed form passes through the computed dots."""
    spec = importlib.util.spec_from_file_location("gallery", DOCS / "gallery.py")
    assert spec and spec.loader
    gallery = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(gallery)
    known, found = gallery.picture("slider_crank").axes[1].lines
    assert max(abs(known.get_ydata()[::6] - found.get_ydata())) < 1e-4


def test_formulas():
    """LaTeX becomes MathML; short fractions have two numbers, which docutils would read as one."""
    mathml = pytest.importorskip("mathml", reason="needs the extra docs")
    assert "<mn>1</mn>\n    <mn>2</mn>" in mathml.converted(r"\tfrac12 x", True)
    assert "mspace" in mathml.converted(r"\cos\theta", True) and "mspace" not in mathml.converted(r"\cosh x", True)
    from docutils.utils.math.latex2mathml import tex2mathml

    assert "<mn>12</mn>" in tex2mathml(r"\frac12 x", as_block=True)


def test_pictures_of_notebooks_have_words():
    """Each figure has an alternative text that describes it."""
    for path in notebook_pages.SOURCE.glob("*.ipynb"):
        notebook = notebook_pages.with_alt_texts(json.loads(path.read_text()), path.stem)
        for cell in notebook["cells"]:
            if any("image/png" in output.get("data", {}) for output in cell.get("outputs", ())):
                assert len(cell["metadata"]["mystnb"]["image"]["alt"]) > 25, path.stem


def test_notebooks_need_nothing_from_the_network():
    """Sliders become text, progress bars are removed, without their scripts; other outputs stay."""
    view = "application/vnd.jupyter.widget-view+json"
    outputs = [{"data": {view: {}, "text/plain": [text]}} for text in ("compiling, 00:00", "Knobs: a = 1")]
    notebook = {"metadata": {"widgets": {}}, "cells": [{"outputs": [*outputs, {"data": {"image/png": "x"}}]}]}
    kept = notebook_pages.without_widgets(notebook)["cells"][0]["outputs"]
    assert kept == [{"data": {"text/plain": ["Knobs: a = 1"]}}, {"data": {"image/png": "x"}}]
    assert notebook["metadata"] == {}


class Page(HTMLParser):
    """The elements of a page that screen readers and links need."""

    def __init__(self, text):
        super().__init__()
        self.links, self.ids, self.wordless, self.outside = [], set(), [], []
        self.headings, self.lang, self.title = 0, "", ""
        self.within = ""
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        found = dict(attrs)
        self.within = tag
        self.ids |= {found[key] for key in ("id", "name") if found.get(key)}
        self.headings += tag == "h1"
        if tag == "html":
            self.lang = found.get("lang") or ""
        if tag == "img" and not found.get("alt"):
            self.wordless.append(found.get("src"))
        if tag == "a" and "href" in found:
            self.links.append(found["href"] or "")
        for key in ("src", "href") if tag in ("link", "script", "img", "iframe", "source") else ():
            if re.match("(https?:)?//", found.get(key) or ""):
                self.outside.append(found[key])

    def handle_data(self, data):
        if self.within == "title":
            self.title += data.strip()


def faults(pages):
    """The faults of pages by path, one line each."""
    found = []
    for path, page in pages.items():
        if page.wordless or page.outside or page.headings != 1 or not page.lang or not page.title:
            found.append(f"{path}: {page.wordless} {page.outside} {page.headings} h1, '{page.lang}', '{page.title}'")
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.exists():
                found.append(f"{path}: no file {link}")
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].ids | {"", "top"}:
                found.append(f"{path}: no place {link}")
    return found


def test_faults_are_seen(tmp_path):
    """Twin: a missing alternative text, a dead link or anchor, a missing heading, an external resource are found."""
    good = '<html lang="en"><title>T</title><h1 id="a">T</h1><a href="#a">a</a><img src="x" alt="words"></html>'
    path = tmp_path / "page.html"
    path.write_text(good)
    assert faults({path: Page(good)}) == []
    for part, bad in (
        ('alt="words"', ""), ('href="#a"', 'href="no.html"'), ('href="#a"', 'href="#b"'), ("h1", "h2"),
        ('lang="en"', ""), ("<title>T", "<title>"), ('src="x"', 'src="https://example.org/x"'),
    ):  # fmt: skip
        assert len(faults({path: Page(good.replace(part, bad))})) == 1, part


@pytest.mark.slow
def test_the_site_builds(tmp_path):
    """No warnings, dead links, missing alternative texts or external resources; headings, titles and a language."""
    for module in ("sphinx", "myst_nb", "pydata_sphinx_theme"):
        pytest.importorskip(module, reason="needs the extra docs")
    built = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", "-d", tmp_path / "doctrees", DOCS, tmp_path / "html"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert built.returncode == 0, built.stderr[-3000:]
    made = [path for path in (tmp_path / "html").rglob("*.html") if "_static" not in path.parts]
    pages = {path.resolve(): Page(path.read_text()) for path in made}
    assert len(pages) > 100
    assert faults(pages) == []
    assert all(
        (tmp_path / "html" / "api" / f"{api_pages.page_of(name)}.html").exists() for name in api_pages.public_names()
    )
