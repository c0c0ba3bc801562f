"""Execute the notebooks and write their hosted copies, with how long each took; needs the extra `notebook`.

    python docs/notebooks.py [NAME ...]

The scripts are the source: edit `notebooks/*.py`, run this, look at the figures, commit both.
"""

import argparse
import base64
import io
import time
from pathlib import Path

import jupytext
from nbclient import NotebookClient
from PIL import Image

FOLDER = Path(__file__).parent.parent / "notebooks"
# The figures have few colours; this many are enough for their antialiased edges.
COLOURS = 128
METER = "application/vnd.jupyter.widget-view+json"


def smaller(png: str) -> str:
    """A PNG in base64, reduced to a palette."""
    image = Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")
    written = io.BytesIO()
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(written, "png", optimize=True)
    return base64.b64encode(written.getvalue()).decode()


def execute(script: Path) -> None:
    """Run one script cell by cell in its own kernel, and write the notebook next to it."""
    notebook = jupytext.read(script)
    began = time.perf_counter()
    settings = {"kernel_name": "python3", "resources": {"metadata": {"path": FOLDER}}, "store_widget_state": False}
    NotebookClient(notebook, timeout=600, **settings).execute()
    took = time.perf_counter() - began
    for cell in notebook.cells:
        # The times at which cells ran differ from run to run.
        cell.metadata.pop("execution", None)
        if "outputs" in cell:
            # A progress meter shows nothing in a stored copy.
            cell.outputs = [output for output in cell.outputs if METER not in output.get("data", {})]
        for output in cell.get("outputs", ()):
            if "image/png" in output.get("data", {}):
                # Sliders need a kernel; keep only their picture.
                output["data"].pop("application/vnd.jupyter.widget-view+json", None)
                output["data"]["image/png"] = smaller(output["data"]["image/png"])
    notebook.metadata.pop("widgets", None)
    hosted = script.with_suffix(".ipynb")
    jupytext.write(notebook, hosted)
    print(f"{script.stem}: {took:.0f} s, {hosted.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="beginnings of the notebooks' names; all if none is given")
    names = tuple(parser.parse_args().names) or ("",)
    for script in sorted(FOLDER.glob("*.py")):
        if script.name.startswith(names):
            execute(script)
