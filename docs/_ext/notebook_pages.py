"""The notebooks as pages with their stored outputs; nothing is executed here.

The alternative text of a figure is the metadata `alt` of its cell, or else the titles and labels in its code.
"""

import ast
import json
import re
from pathlib import Path

from written import clear, write

FOLDER = Path(__file__).parent.parent / "notebooks"
SOURCE = Path(__file__).parents[2] / "notebooks"
INDEX = """# Notebooks

Each notebook answers one question and starts with its Lagrangian. The pages show the stored outputs; the tests run
the notebooks.

```{toctree}
:maxdepth: 1

"""


def words(code: str) -> str:
    """The titles and labels that a cell's code gives to its figure."""
    found = []
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.keyword) and node.arg in ("title", "xlabel", "ylabel", "label"):
            parts = node.value.values if isinstance(node.value, ast.JoinedStr) else [node.value]
            found.append("".join(str(p.value) for p in parts if isinstance(p, ast.Constant)).strip())
    return "; ".join(dict.fromkeys(filter(None, found)))


def with_alt_texts(notebook: dict, name: str) -> dict:
    """Give each cell that shows a picture an alternative text."""
    heading = name
    for cell in notebook["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            headings = re.findall(r"^#+ (.*)", text, re.MULTILINE)
            heading = headings[-1] if headings else heading
        elif any("image/png" in output.get("data", {}) for output in cell["outputs"]):
            description = words(text) or "drawn by " + text.strip().splitlines()[-1]
            alt = cell["metadata"].get("alt") or f"Figure, {heading}: {description}"
            cell["metadata"]["mystnb"] = {"image": {"alt": alt.replace("$", "")}}
    return notebook


def without_widgets(notebook: dict) -> dict:
    """Remove sliders, which need a running Python and scripts from the network; keep their text, except for meters."""
    notebook["metadata"].pop("widgets", None)
    for cell in notebook["cells"]:
        kept = []
        for output in cell.get("outputs", ()):
            widget = output.get("data", {}).pop("application/vnd.jupyter.widget-view+json", None)
            if widget is None or not "".join(output["data"].get("text/plain", "")).startswith("compiling"):
                kept.append(output)
        if "outputs" in cell:
            cell["outputs"] = kept
    return notebook


def generate(app):
    """Write the notebooks and the list of them."""
    names = sorted(path.stem for path in SOURCE.glob("*.ipynb"))
    for name in names:
        text = (SOURCE / f"{name}.ipynb").read_text().replace("](../docs/", "](../")
        shown = without_widgets(with_alt_texts(json.loads(text), name))
        write(FOLDER / f"{name}.ipynb", json.dumps(shown, ensure_ascii=False))
    write(FOLDER / "index.md", INDEX + "\n".join(names) + "\n```\n")
    clear(FOLDER, {"index.md"} | {f"{name}.ipynb" for name in names})


def point_to_pages(app, docname, source):
    """Point links to a notebook of the repository to its page."""
    source[0] = source[0].replace("](../notebooks/", "](notebooks/")


def setup(app):
    """Generate before the sources are read."""
    app.connect("source-read", point_to_pages)
    app.connect("builder-inited", generate)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
