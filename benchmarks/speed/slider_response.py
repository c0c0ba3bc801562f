"""How soon does a picture follow its slider? `lj.interact` in JupyterLab, and the page of a sweep, in a real browser.

The motion is that of a bead on a rotating hoop, 30 units of time, 601 outputs, drawn as a curve. In a headless browser
the slider has the focus, and a key is pressed as a user would. The measured wall time inside the browser starts with
the key and ends when the browser has painted the new picture: it includes the notebook's messages to the kernel and
back, the solve and the drawing. "whole" is the share of presses after which axes and ticks had to be drawn again too.
Then 100 presses come at once, like a dragging hand: no queue may form, and the last value must be the one shown at the
end.

In this process, the processor time of one value and of its parts is measured. Beside the times of the browser runs
stands the processor time of the processes per press; the browser continues after the picture is shown.

Presses come three tenths of a second apart, as from a hand that looks, and in quick succession. In quick succession a
message of JupyterLab's server waits up to 40 ms until the browser's machine acknowledges the one before it (Nagle's
algorithm and TCP's delayed acknowledgement).

    python -m benchmarks.speed.slider_response [--json FILE] [--only TEXT]

Needs Chromium or Chrome, and the extra `notebook`. On a shared machine, wall times depend on its load, which is
therefore recorded.
"""

import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import numpy as np

import lagjax as lj
from benchmarks.measure import main, row, skipped
from benchmarks.speed.browser import Browser, installed

jax.config.update("jax_enable_x64", True)

CELL = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
import lagjax as lj
bead = lj.System(lambda t, q, v, params: 0.5 * v**2 + 0.5 * (params["omega"] * jnp.sin(q)) ** 2 + jnp.cos(q))
ts = jnp.linspace(0.0, 30.0, 601)
run = lambda point: lj.integrate(bead, point["start"], 0.0, {"omega": point["omega"]}, ts=ts)
knobs = lj.interact(run, {"omega": (0.0, 4.0, 0.02), "start": (0.1, 3.0)}, start={"omega": 0.6}, progress=False)
"""
PRESSES, DRAGGED = 60, 100
# The element in which JupyterLab shows the picture: the first HTML below the sliders.
PICTURE = ".widget-vbox .widget-html-content"
# Seconds between a picture and the next press, and the key; back again, so that a slider's range suffices.
PACES = {"": (0.3, "ArrowRight"), ", in quick succession": (0.05, "ArrowLeft")}
# Variables that keep the run from reading or writing the user's own settings.
OF_JUPYTER = ("JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR", "JUPYTERLAB_SETTINGS_DIR")
# Times from the key to the end of the frame that shows the new picture, after scripts, layout and painting.
WATCH = """
(() => {
  window.times = []; window.pressed = 0; window.told = () => {};
  document.addEventListener("keydown", () => { window.pressed = performance.now(); }, true);
  const painted = new MessageChannel();
  painted.port1.onmessage = () => { window.times.push([window.pressed, performance.now()]); window.told(true); };
  const changed = () => requestAnimationFrame(() => painted.port2.postMessage(null));
  new MutationObserver(changed).observe(document.querySelector("PICTURE"),
                                        {childList: true, subtree: true, attributes: true});
})()
"""


def rows(wanted):
    """The rows of the kernel, of the whole path in the browser, and of the page."""
    space = {}
    exec(CELL, space)
    if wanted("kernel"):
        yield from in_this_process(space["knobs"])
    for what, measured in (
        ("notebook", in_the_notebook),
        ("page", lambda: in_the_page(space["run"])),
    ):
        if wanted(what):
            if installed() is None:
                yield skipped(what, "no Chromium or Chrome is installed")
            else:
                yield from measured()


def in_this_process(knobs):
    """Processor time per value."""
    values = np.linspace(0.6, 1.8, 61)
    wholes, times = [], []
    for omega in values:
        before, began = knobs._picture.drawn_whole, time.process_time()
        knobs.set(omega=omega)
        times.append(1e3 * (time.process_time() - began))
        wholes.append(knobs._picture.drawn_whole > before)
    solve, lines = (milliseconds(f) for f in (lambda: knobs._values(knobs.point), knobs._picture._svg))
    whole = statistics.median([x for x, is_whole in zip(times, wholes) if is_whole] or [0.0])
    more = {
        "solve": solve,
        "lines": lines,
        "with axes": whole,
        "whole": np.mean(wholes),
        "bytes": len(knobs._shows.value),
    }
    yield row("kernel: ms of processor time a value, median", statistics.median(times), 20, **more)


def milliseconds(function, repeats=30):
    """Processor time of one call, in milliseconds."""
    began = time.process_time()
    for _ in range(repeats):
        function()
    return 1e3 * (time.process_time() - began) / repeats


def in_the_notebook():
    """JupyterLab with one notebook of one cell."""
    with tempfile.TemporaryDirectory() as folder:
        cell = {"cell_type": "code", "source": CELL + "knobs", "metadata": {}, "outputs": [], "execution_count": None}
        kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
        notebook = {"cells": [cell], "metadata": kernel, "nbformat": 4, "nbformat_minor": 4}
        Path(folder, "knobs.ipynb").write_text(json.dumps(notebook))
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        settings = ("--no-browser", f"--port={port}", "--IdentityProvider.token=", "--allow-root", "--ip=127.0.0.1",
                    "--LabApp.expose_app_in_browser=True", f"--notebook-dir={folder}")  # fmt: skip
        own = dict.fromkeys(OF_JUPYTER, folder)
        lab = subprocess.Popen(
            [sys.executable, "-m", "jupyterlab", *settings],
            env=os.environ | own, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            wait_for(port)
            with Browser(patience=120.0) as browser:
                page = browser.open(f"http://127.0.0.1:{port}/lab/tree/knobs.ipynb", width=1100, height=900)
                page.wait("window.jupyterapp && document.querySelector('.jp-Notebook .jp-CodeCell')", 120)
                page.wait("document.querySelector('.jp-NotebookPanel-toolbar')", 60)
                time.sleep(2.0)
                page.run("jupyterapp.commands.execute('notebook:run-all-cells').then(() => null)")
                page.wait(f"document.querySelector('{PICTURE} svg')", 240)
                roots = browser.process.pid, lab.pid
                yield from measured(page, "notebook", PICTURE, ".widget-slider .noUi-handle", 50, roots)
                if os.environ.get("LAGJAX_PICTURE"):
                    page.picture(os.environ["LAGJAX_PICTURE"])
        finally:
            lab.terminate()
            lab.wait()


def wait_for(port, seconds=120.0):
    """Wait until a server listens on a port."""
    until = time.monotonic() + seconds
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
            return
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.2)


def in_the_page(run):
    """The page of a sweep over the same number of values."""
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        file = Path(folder, "sweep.html")
        axes = {"start": np.array([1.5]), "omega": np.arange(0.0, 4.21, 0.02)}
        lj.sweep(run, axes, progress=False).to_html(file)
        page = browser.open(file)
        yield from measured(
            page, "page", "[data-views] svg", ".lagjax .row:nth-child(2) input", 50, [browser.process.pid]
        )


def processor_time(*roots):
    """Milliseconds of processor time of some processes and all that they started, as reported by Linux."""
    parents, spent = {}, {}
    for file in Path("/proc").glob("[0-9]*/stat"):
        try:
            after_name = file.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        number = int(file.parent.name)
        parents[number], spent[number] = int(after_name[1]), sum(map(int, after_name[11:13]))
    family = lambda number: number in roots or (number in parents and family(parents[number]))
    return 1e3 * sum(spent[number] for number in spent if family(number)) / os.sysconf("SC_CLK_TCK")


def measured(page, what, picture, slider, target, roots):
    """Rows for single presses one after another, and for many at once."""
    page.run(WATCH.replace("PICTURE", picture))
    page.run(f"document.querySelector({json.dumps(slider)}).focus()")
    page.press("ArrowRight")
    page.wait("times.length >= 1")
    for how, (gap, key) in PACES.items():
        page.run("times.length = 0")
        spent = [processor_time(root) for root in roots]
        for _ in range(PRESSES):
            page.press(key)
            # No polling in the meantime, which would use the browser's time.
            page.run("times.some(([key]) => key === pressed) || new Promise(done => { window.told = done; })")
            time.sleep(gap)
        spent = [(processor_time(root) - before) / PRESSES for root, before in zip(roots, spent)]
        # A page may draw several times for one key: the last drawing counts.
        last = {pressed: shown - pressed for pressed, shown in page.run("times")}
        times = sorted(last.values())
        load = {"load": os.getloadavg()[0]}
        more = {"least": times[0], "of 95 %": times[int(0.95 * len(times))], "presses": len(times)} | load
        more |= dict(zip(("browser's processor time", "server's and kernel's"), spent))
        yield row(f"{what}: ms from the key to the picture{how}, median", statistics.median(times), target, **more)
    page.run("times.length = 0")
    for _ in range(DRAGGED):
        page.press("ArrowRight")
    page.wait("times.length && performance.now() - times[times.length - 1][1] > 500")
    pressed, shown = page.run("[window.pressed, times[times.length - 1][1]]")
    more = {"pictures": len({shown for _, shown in page.run("times")}), "presses": DRAGGED} | load
    yield row(f"{what}: ms from the last key of a drag to the last picture", max(0.0, shown - pressed), 150, **more)


if __name__ == "__main__":
    main(rows, __doc__)
