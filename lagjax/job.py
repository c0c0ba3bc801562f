"""`python -m lagjax`: every scene, checked, timed and drawn; then the stability report.

For each scene: error against run time by method and tolerance, the time of the first answer, then the results of stiff
and extreme cases; work-precision diagrams and a picture as PNG, all numbers as JSON. `python -m lagjax stability`
prints the whole stability report, the main job only a part of it. The exit status is 1 if a scene misses its accuracy,
or a row of the stability report is silently wrong or has another outcome than expected. Scenes run in parallel, one per
core: most of their time is compilation, which uses one thread.
"""

import argparse
import json
import platform
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict
from multiprocessing import get_context, parent_process
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax

from lagjax import report, stability
from lagjax.display import plots
from lagjax.numerics import Dopri8
from lagjax.scenes import SCENES
from lagjax.sweep import usable_cores

STABILITY = "stability"
# The parts that take longest start first, so that no core waits for one of them.
LONGEST = "mass_distributions", STABILITY, "cross_rails"

FULL = {
    "methods": None,
    "tolerances": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
    "repeats": 15,
}
QUICK = {"methods": {"Dopri8": Dopri8()}, "tolerances": (1e-6, 1e-10), "repeats": 3}


class JobPart(NamedTuple):
    """A scene, or the stability report: its printed text, its numbers, and the requirements it missed."""

    printed: str
    numbers: Any
    missed: list[str]


def main(arguments=None) -> int:
    """Run the job; returns the exit status."""
    options = _parse(arguments)
    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    note = f"; {_at_a_time(options)} scenes at a time, which slow each other down" if _at_a_time(options) > 1 else ""
    print(f"{_machine()}{note}\n", flush=True)
    numbers, missed, rows = {}, [], None
    for name, part in zip(options.scenes, _parts(options, folder)):
        print(part.printed, end="\n\n", flush=True)
        missed += part.missed
        if name == STABILITY:
            rows = part.numbers
        else:
            numbers[name] = part.numbers
    if numbers:
        (folder / "report.json").write_text(json.dumps({"machine": _machine(), "scenes": numbers}, indent=1))
    if rows is not None:
        (folder / "stability.json").write_text(json.dumps({"machine": _machine(), "rows": rows}, indent=1))
    print(f"{time.perf_counter() - started:.0f} s; pictures and numbers are in {folder}/")
    for line in missed:
        print(f"MISSED  {line}")
    return 1 if missed else 0


def _parts(options, folder) -> Iterator[JobPart]:
    """All requested parts, in order; several at a time, each in its own process."""
    tasks = [(name, options.quick, options.tier, folder) for name in options.scenes]
    at_a_time = _at_a_time(options)
    if at_a_time == 1:
        yield from (_part(*task) for task in tasks)
        return
    pool = ProcessPoolExecutor(at_a_time, get_context("spawn"))
    try:
        order = sorted(tasks, key=lambda task: LONGEST.index(task[0]) if task[0] in LONGEST else len(LONGEST))
        running = {task: pool.submit(_part, *task) for task in order}
        for task in tasks:
            _progress(f"{task[0]}: {sum(f.done() for f in running.values())} of {len(tasks)} done")
            part = running[task].result()
            _progress("")
            yield part
    finally:
        # After an interruption no further parts are started.
        pool.shutdown(cancel_futures=True)


def _at_a_time(options):
    return max(1, min(options.jobs, len(options.scenes)))


def _part(name, quick, tier, folder) -> JobPart:
    # The job is an application: the library itself never sets JAX's options.
    jax.config.update("jax_enable_x64", True)
    return _stability(tier) if name == STABILITY else _scene(SCENES[name], quick, folder)


def _parse(arguments):
    parser = argparse.ArgumentParser(
        prog="python -m lagjax", description="Check, time and draw the scenes: error against run time."
    )
    parser.add_argument(
        "scenes",
        nargs="*",
        metavar="SCENE",
        help=f"which scenes, or {STABILITY} for the whole stability report; by default all scenes and a part of it: "
        f"{', '.join(SCENES)}",
    )
    parser.add_argument("-o", "--output", default="lagjax-report", help="folder for pictures and numbers")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="one run per scene, one method, two tolerances, no scene pictures, few stability rows; under a minute",
    )
    parser.add_argument(
        "-j", "--jobs", type=int, default=usable_cores(), metavar="N",
        help="scenes at a time, each in its own process; by default one per core. With -j 1 times vary less",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    unknown = [name for name in options.scenes if name not in (*SCENES, STABILITY)]
    if unknown:
        parser.error(f"no scene named {', '.join(unknown)}; there are: {', '.join(SCENES)}, and {STABILITY}")
    tier = stability.FULL if options.scenes else stability.REDUCED
    options.tier = stability.QUICK if options.quick else tier
    short = [name for name, scene in SCENES.items() if not (options.quick and scene.long)]
    options.scenes = options.scenes or [*short, STABILITY]
    return options


def _stability(tier) -> JobPart:
    """The stability report, with the rows that do not have the expected outcome."""
    _progress("stability")
    rows, outcomes = stability.trials(tier), []
    for i, row in enumerate(rows):
        _progress(f"stability, row {i + 1} of {len(rows)}")
        outcomes.append(row.attempt())
    _progress("")
    title = "Stability: accurate, degraded with a warning, or refused with a reason"
    printed = f"{title}\n{'=' * len(title)}\n\n{stability.stability_table(outcomes)}"
    numbers = [asdict(outcome) | {"verdict": outcome.verdict} for outcome in outcomes]
    missed = [
        f"stability: {o.family}, {o.name}, {o.method}: {o.verdict}, error {o.error:.1e}"
        for o in outcomes
        if not o.passed
    ]
    return JobPart(printed, numbers, missed)


def _scene(scene, quick, folder) -> JobPart:
    """Check, time and draw a scene."""
    found, cases = _run_scene(scene, quick)
    _draw(scene, found, folder, with_picture=not quick)
    rows = [row for run, of_run in found for row in report.rows_of(run, of_run)]
    _progress("")
    missed = [f"{scene.name}: {row.run}, error {row.error:.1e} > {row.required:.0e}" for row in rows if not row.passed]
    missed += [
        f"{scene.name}: {case.name}, error {case.error:.1e} > {case.allowed:.0e}" for case in cases if not case.passed
    ]
    numbers = {"runs": [asdict(row) for row in rows], "cases": [asdict(case) for case in cases]}
    return JobPart(_described(scene, rows, cases), numbers, missed)


def _run_scene(scene, quick):
    settings = QUICK if quick else FULL
    runs, found, with_others = scene.runs(), [], not quick
    for run in runs[:1] if quick else runs:
        _progress(f"{scene.name}: {run.name}")
        # Other tools are compared once per scene: they take as long as all other runs together.
        found.append((run, report.work_precision(run, others=with_others, **settings)))
        with_others = with_others and run.by_hand is None
    _progress(f"{scene.name}: stiff and extreme cases")
    return found, scene.cases()


def _draw(scene, found, folder, with_picture):
    _progress(f"{scene.name}: pictures")
    try:
        plots.import_matplotlib()
    except ImportError as error:
        print(f"no pictures: {error}", file=sys.stderr)
        return
    panels = [of_run.against_time(run.name) for run, of_run in found if run.drawn]
    # Run times of motions shorter than a call, or without an error, are not drawn.
    if panels:
        plots.work_precision(panels).savefig(folder / f"{scene.name}_work_precision.png")
    if with_picture:
        scene.picture().savefig(folder / f"{scene.name}.png")


def _described(scene, rows, cases):
    of_errors = [
        f"error of '{run}': {measured}" for run, measured in dict.fromkeys((row.run, row.measured) for row in rows)
    ]
    return "\n".join([
        f"{scene.title}\n{'=' * len(scene.title)}\n{scene.source}\n",
        *((report.work_precision_table(rows), report.first_answer(rows), *of_errors, "") if rows else ()),
        report.case_table(cases), "",
        "Where the source is wrong:", *(f"- {line}" for line in scene.misprints),
    ])  # fmt: skip


def _progress(text):
    """Overwrite one line of text, only in a terminal."""
    if sys.stderr.isatty() and parent_process() is None:
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _machine():
    return (
        f"lagjax on {jax.devices()[0].platform}, {platform.machine()}, Python {platform.python_version()}, "
        f"JAX {jax.__version__}, diffrax {diffrax.__version__}, float64; times are medians of compiled solves"
    )
