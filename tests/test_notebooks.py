"""The notebooks run, and their .ipynb copies match the scripts."""

import json
from pathlib import Path

import pytest

from tests.tiers import exhaustive_but

FOLDER = Path(__file__).parent.parent / "notebooks"
SCRIPTS = sorted(FOLDER.glob("*.py"))
# Of the others, which compile for 10 s or more, other tests are about what they show; nothing else joins what 22 does.
SHORT = [script for script in SCRIPTS if script.stem[:2] in ("01", "21", "22")]


def cells(script):
    """The source of each cell of a percent script."""
    blocks = script.read_text().split("\n# %%")[1:]
    return [block.split("\n", 1)[1].strip() for block in blocks]


@pytest.mark.slow
@pytest.mark.parametrize("script", exhaustive_but(SHORT, SCRIPTS), ids=lambda path: path.stem)
def test_runs(script):
    """Every cell runs, the asserts of the last one included."""
    pytest.importorskip("matplotlib").use("agg")
    exec(compile(script.read_text(), script.name, "exec"), {})


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_hosted_copy_is_current_and_small(script):
    """The .ipynb has the script's code, outputs to show, and at most 300 kB."""
    path = script.with_suffix(".ipynb")
    assert path.stat().st_size <= 300_000
    notebook = json.loads(path.read_text())
    code = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert code == [cell for cell in cells(script) if not cell.startswith("# ")]
    assert any(cell.get("outputs") for cell in notebook["cells"])
