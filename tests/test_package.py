"""Statements about the package agree: its version, its pages, the extras named in messages."""

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest

import lagjax
import lagjax as lj

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_one_version():
    """The package, its metadata and the citation have the same version, and the change log has a section for it."""
    number = lagjax.__version__
    cited = re.search(r"^version: (.+)$", (ROOT / "docs" / "CITATION.cff").read_text(), re.M)
    assert cited is not None and cited[1] == number == version("lagjax")
    sections = re.findall(r"^## (\S+)", (ROOT / "docs" / "CHANGELOG.md").read_text(), re.M)
    assert sections[0] == number and len(set(sections)) == len(sections)


def test_extras_that_messages_name_exist():
    """`pip install "lagjax[...]"` in a message or docstring names an existing extra."""
    extras = PROJECT["optional-dependencies"]
    named = {
        (path.name, extra)
        for path in (ROOT / "lagjax").rglob("*.py")
        for group in re.findall(r"lagjax\[([\w,]+)\]", path.read_text())
        for extra in group.split(",")
    }
    assert len(named) > 3
    assert not {(name, extra) for name, extra in named if extra not in extras}


def test_every_dependency_has_a_lowest_version():
    """Each dependency of a plain installation has a tested lower bound."""
    assert all(">=" in requirement for requirement in PROJECT["dependencies"])


ROW = re.compile(
    r"^\| (`lj\.\w+`(?:, `lj\.\w+`)*) \| (?:in `(lj\.\w+)`|`from ([\w.]+) import \.\.\.`) \|", re.MULTILINE
)


def moved_by_table(text: str) -> dict[str, str]:
    """By the change log's table *Renamed*, where each name is that has left `lj.`."""
    table = text.split("### Renamed")[1].split("###")[0]
    rows = ROW.findall(table)
    return {name: place or room for names, place, room in rows for name in re.findall(r"lj\.(\w+)", names)}


def test_names_that_have_moved():
    """The change log's table and the one in the package agree; twin: with a row less they do not."""
    moved = {name: place for place, names in lagjax.MOVED.items() for name in names.split()}
    log = (ROOT / "docs" / "CHANGELOG.md").read_text()
    assert moved_by_table(log) == moved and len(moved) == sum(len(names.split()) for names in lagjax.MOVED.values())
    assert set(moved) - set(moved_by_table(re.sub(r".*`lj\.rod`.*\n", "", log))) >= {"rod", "box"}


def test_a_name_that_has_moved_says_where_it_is():
    """Its error ends in code that gives the thing itself, and `hasattr` says that it is gone; twin: an unknown name."""
    for name in " ".join(lagjax.MOVED.values()).split():
        with pytest.raises(AttributeError, match=rf"^lj\.{name} has moved: .*\nFix: ") as raised:
            getattr(lj, name)
        code = str(raised.value).split("Fix: ")[1]
        found = {"lj": lj}
        exec(code if code.startswith("from") else f"{name} = {code}", found)
        assert getattr(found[name], "__name__", name) == name, code
        assert name not in lj.__all__ and not hasattr(lj, name)
    with pytest.raises(AttributeError, match="^No lagjax attribute rods$"):
        getattr(lj, "rods")


def test_how_many_names_there_are():
    """`lj.` has the words of mechanics and the doors, at most 105; the rest is one step further, each name once."""
    assert len(lj.__all__) <= 105
    parts = [lj.bodies, lj.guards, lj.shapes]
    names = [name for part in parts for name in part.__all__]
    assert len(set(names)) == len(names) and not set(names) & set(lj.__all__)
    assert all(hasattr(part, name) for part in parts for name in part.__all__)


def uses(text: str) -> set[str]:
    """The names in a text that have moved, as they were before."""
    return set(re.findall(rf"\b(?:lj|lagjax)\.(?:{'|'.join(' '.join(lagjax.MOVED.values()).split())})\b", text))


def test_nobody_uses_a_name_that_has_moved():
    """No code, message, page, notebook or test has one, but those that are about this; twin: one is found."""
    about = {"CHANGELOG.md", "test_docs.py", "test_package.py", "test_readme.py"}
    folders = (ROOT / name for name in ("lagjax", "tests", "benchmarks", "docs", "notebooks"))
    found = (path for folder in folders for kind in ("*.py", "*.md", "*.ipynb") for path in folder.rglob(kind))
    texts = {path: path.read_text() for path in (ROOT / "README.md", *found) if path.name not in about}
    assert {str(path): old for path, text in texts.items() if (old := uses(text))} == {} and len(texts) > 500
    assert uses("a `lj.Body` of lj.bodies.Body, lj.rods") == {"lj.Body"}
