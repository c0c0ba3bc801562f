"""Statements about the package agree: its version, its pages, the extras named in messages."""

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import lagjax

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
