"""The README's code runs and prints what it claims; it has exactly two commands."""

import ast
import importlib.util
import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.tiers import exhaustive_but

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text()
BLOCKS = re.compile(r"```python\n(.*?)```", re.DOTALL)
WITHOUT_CODE = set("CHANGELOG CONTRIBUTING architecture derivatives gallery how-to index known-gaps look-up".split())
# Their code trains, fits, or compiles for 8 to 30 s.
LONG = """
    bodies choose-a-method coming-from connect-two-points contacts debug fitting forces-that-jump learned long-runs
    states steer switch-phases taking-a-solve-elsewhere what-a-system-is-like
""".split()
CODE = {
    page.stem: "\n".join(BLOCKS.findall(page.read_text()))
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
}
SHORT = [name for name, code in CODE.items() if code and name not in LONG]


def claimed_and_printed(block, capsys):
    """The claimed and actual output of a block."""
    exec(compile(block, "README.md", "exec"), {})
    printed = capsys.readouterr().out.split()
    claimed = " ".join(re.findall(r"print\(.*\)\s*# (.*)", block)).split()
    return claimed, printed


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(SHORT, [name for name, code in CODE.items() if code]))
def test_python_blocks(name, capsys, tmp_path, monkeypatch):
    """All blocks of a page print the numbers in their comments."""
    assert jnp.asarray(0.0).dtype == np.float64
    monkeypatch.chdir(tmp_path)
    if "import sympy" in CODE[name] or "lj.latex" in CODE[name]:
        pytest.importorskip("sympy")
    claimed, printed = claimed_and_printed(CODE[name], capsys)
    assert claimed == printed


# What has names of its own in `lj.`.
PARTS = "bodies|guards|scenes|shapes"


def unknown(code):
    """The names that code reads from lagjax and that are not there."""
    dotted = {ast.unparse(node) for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Attribute)}
    return sorted(name for name in dotted if re.match(rf"lj\.(({PARTS})\.)?\w+$", name) and not known(name))


def known(name):
    """Whether `lj.a`, or `lj.scenes.a` and the like, is there."""
    *part, last = name.split(".")[1:]
    return hasattr(getattr(lj, part[0]) if part else lj, last)


def test_code_of_pages_names_what_is_there():
    """The pages with code are as expected, and it names nothing that was renamed; twin: a renamed function is seen."""
    assert {name for name, code in CODE.items() if not code} == WITHOUT_CODE
    assert {name: found for name, code in CODE.items() if (found := unknown(code))} == {}
    assert unknown("lj.integrat(lj.System(L), lj.scenes.hoop)") == ["lj.integrat", "lj.scenes.hoop"]
    assert unknown("lj.rod(lj.shapes.rod, lj.shapes.weight)") == ["lj.rod", "lj.shapes.weight"]


@pytest.mark.slow
def test_mujoco_block(capsys):
    """The same problem in MuJoCo, if it is installed."""
    pytest.importorskip("mujoco", reason="needs the extra bench")
    page = (ROOT / "docs" / "coming-from.md").read_text()
    block = next(found for found in re.findall(r"```py\n(.*?)```", page, re.DOTALL) if "mujoco" in found)
    claimed, printed = claimed_and_printed(block, capsys)
    assert claimed == printed == ["True"]


@pytest.mark.exhaustive
def test_the_figure_is_drawn(tmp_path):
    """The script of the README's figure still works, and the README shows the figure."""
    assert "(docs/overview.png)" in README and (ROOT / "docs" / "overview.png").exists()
    spec = importlib.util.spec_from_file_location("overview", ROOT / "docs" / "overview.py")
    overview = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(overview)
    overview.main(tmp_path / "overview.png")
    assert (tmp_path / "overview.png").stat().st_size > 20_000


def test_the_block_check_can_fail(capsys):
    """Twin: a wrong number in a comment is found."""
    claimed, printed = claimed_and_printed("print(1 + 1)  # 3\n", capsys)
    assert claimed != printed


def test_size_and_commands():
    """At most 150 lines, and exactly two commands between the markers that CI reads."""
    assert len(README.splitlines()) <= 150
    commands = [
        line for line in README.split("<!-- commands -->")[1].split("<!-- end -->")[0].splitlines() if "venv" in line
    ]
    assert len(commands) == 2
    assert all(command.startswith("python3 -m venv .venv && ") for command in commands)


def test_tables_are_those_of_the_results():
    """The tables of errors and speeds equal those that `benchmarks/quote.py` makes from `benchmarks/results/`."""
    spec = importlib.util.spec_from_file_location("quote", Path(__file__).parent.parent / "benchmarks" / "quote.py")
    quote = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(quote)
    assert quote.quoted(README) == README
    # Twin: different numbers are detected.
    for name in ("| ratio |", "| ms to an error of |"):
        changed = README.replace(name, "| other |")
        assert quote.quoted(changed) == README != changed
