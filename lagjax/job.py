"""`python -m lagjax`: every scene, checked, timed and drawn; then the stability report.

For each scene: error against run time by method and tolerance beside a peer written by hand, the time of the first
answer, the results of stiff and extreme cases, what its source gets wrong; work-precision diagrams and a picture as
PNG, all numbers as JSON. `--full` adds what repeats this: second variations of a motion by all methods, slow peers,
further cases, the whole stability report (`python -m lagjax stability` prints it alone), and all of it compiled as
users get it, where else XLA optimises little what is not timed. The exit status is 1 if a scene misses its accuracy,
or a row of the stability report is silently wrong or has another outcome than expected. Parts run side by side, one per
core: most of their time is compilation, which uses one thread. Each is printed as it ends.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict
from multiprocessing import get_all_start_methods, get_context, parent_process
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax

from lagjax import report, stability
from lagjax.display import plots, table
from lagjax.numerics import Dopri8
from lagjax.report import FULL, MAIN, QUICK
from lagjax.scenes import SCENES
from lagjax.sweep import usable_cores

STABILITY = "stability"
SETTINGS = {
    QUICK: {"methods": {"Dopri8": Dopri8()}, "tolerances": (1e-6, 1e-10), "repeats": 3},
    MAIN: {"methods": None, "tolerances": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12), "repeats": 15},
}
SETTINGS[FULL] = SETTINGS[MAIN]
# Processor seconds of each part, `QUICK` and `MAIN`, as its summary prints them: what takes longest starts first, so
# that no core waits for it, and a line says how long all will take. Of `FULL` nothing is said.
SECONDS = {
    "sphere_geodesic": (7, 16), "rolling_hoop": (11, 26), "slipping_hoop": (1, 28), "bead_on_hoop": (7, 27),
    "mass_distributions": (14, 39), "sliding_wedge": (12, 15), "cross_rails": (11, 29), STABILITY: (5, 31),
}  # fmt: skip


class JobPart(NamedTuple):
    """A scene, or the stability report: its printed text, its numbers, its line of the summary, what it missed."""

    printed: str
    numbers: Any
    summary: tuple[str, ...]
    missed: list[str]


def main(arguments=None) -> int:
    """Run the job; returns the exit status."""
    options = _parse(arguments)
    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    print(f"{_machine()}\n{_plan(options)}\n", flush=True)
    parts = {}
    for name, part in _parts(options, folder):
        print(part.printed, end="\n\n", flush=True)
        parts[name] = part
    parts = {name: parts[name] for name in options.scenes}
    _write(folder, parts)
    print(_summary(parts, folder))
    print(f"{time.perf_counter() - started:.0f} s; pictures and numbers are in {folder}/")
    missed = [line for part in parts.values() for line in part.missed]
    for line in missed:
        print(f"MISSED  {line}")
    return 1 if missed else 0


def _parts(options, folder) -> Iterator[tuple[str, JobPart]]:
    """All requested parts by name, as they end; several at a time, each in its own process."""
    tasks = {name: (name, options.tier, options.stability, folder) for name in options.scenes}
    order = sorted(tasks, key=lambda name: -_seconds(name, options.tier))
    at_a_time = _at_a_time(options)
    if at_a_time == 1:
        for name in options.scenes:
            _progress(f"{name}: tracing and compiling")
            part = _part(*tasks[name])
            _progress("")
            yield name, part
        return
    # A server that has imported everything once is copied for each process.
    context = get_context("forkserver" if "forkserver" in get_all_start_methods() else "spawn")
    if context.get_start_method() == "forkserver":
        context.set_forkserver_preload([__name__])
    pool = ProcessPoolExecutor(at_a_time, context)
    try:
        running = {pool.submit(_part, *tasks[name]): name for name in order}
        while running:
            at_work = [name for future, name in running.items() if future.running()][:at_a_time]
            left = sum(_seconds(name, options.tier) for name in running.values()) / at_a_time
            done = f"{len(tasks) - len(running)} of {len(tasks)} done" + (f", about {left:.0f} s left" if left else "")
            _progress(f"{', '.join(at_work)}: tracing and compiling; {done}")
            ended, _ = wait(running, timeout=1.0, return_when=FIRST_COMPLETED)
            _progress("")
            for future in ended:
                yield running.pop(future), future.result()
    finally:
        # After an interruption no further parts are started.
        pool.shutdown(cancel_futures=True)


def _at_a_time(options):
    return max(1, min(options.jobs, len(options.scenes)))


def _seconds(name, tier):
    """Processor seconds that a part takes; 0 if nobody measured it."""
    return dict(zip((QUICK, MAIN), SECONDS.get(name, ()))).get(tier, 0)


def _part(name, tier, of_stability, folder) -> JobPart:
    # The job is an application: the library itself never sets JAX's options.
    jax.config.update("jax_enable_x64", True)
    # First answers are those of a system that was never seen.
    os.environ["LAGJAX_CACHE"] = "off"
    started = time.process_time()
    part = _stability(of_stability) if name == STABILITY else _scene(SCENES[name], tier, folder)
    seconds = f"{time.process_time() - started:.0f}"
    return part._replace(summary=(*part.summary[:-1], seconds, part.summary[-1]))


@contextmanager
def _quickly_compiled(tier):
    """XLA optimises little, for what runs once and is not timed; its numbers change by round-off. `FULL` has everything
    as users get it.
    """
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", before or tier < FULL)
    try:
        yield
    finally:
        jax.config.update("jax_disable_most_optimizations", before)


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
    how_much = parser.add_mutually_exclusive_group()
    how_much.add_argument(
        "--quick",
        action="store_const", const=QUICK, default=MAIN, dest="tier",
        help="one run per scene, one method, two tolerances, one picture, few cases and stability rows",
    )  # fmt: skip
    how_much.add_argument(
        "--full",
        action="store_const", const=FULL, dest="tier",
        help="also variations of each motion by all methods, slow peers, further cases, the whole stability report",
    )  # fmt: skip
    parser.add_argument(
        "-j", "--jobs", type=int, default=usable_cores(), metavar="N",
        help="scenes at a time, each in its own process; by default one per core. With -j 1 times vary less",
    )  # fmt: skip
    options = parser.parse_args(arguments)
    unknown = [name for name in options.scenes if name not in (*SCENES, STABILITY)]
    if unknown:
        parser.error(f"no scene named {', '.join(unknown)}; there are: {', '.join(SCENES)}, and {STABILITY}")
    # Asked for by name, the stability report is whole.
    options.stability = FULL if options.scenes and options.tier == MAIN else options.tier
    options.scenes = options.scenes or [*SCENES, STABILITY]
    return options


def _stability(tier) -> JobPart:
    """The stability report, with the rows that do not have the expected outcome."""
    with _quickly_compiled(tier):
        outcomes = [row.attempt() for row in stability.trials(tier)]
    title = "Stability: accurate, degraded with a warning, or refused with a reason"
    printed = f"{title}\n{'=' * len(title)}\n\n{stability.stability_table(outcomes)}"
    numbers = [asdict(outcome) | {"verdict": outcome.verdict} for outcome in outcomes]
    missed = [
        f"stability: {o.family}, {o.name}, {o.method}: {o.verdict}, error {o.error:.1e}"
        for o in outcomes
        if not o.passed
    ]
    return JobPart(printed, numbers, ("-", "-", "-", _share([o.passed for o in outcomes]), "-"), missed)


def _scene(scene, tier, folder) -> JobPart:
    """Check, time and draw a scene."""
    runs = [run for run in scene.runs() if run.tier <= max(tier, MAIN)]
    runs = runs[:1] if tier == QUICK else runs
    found = [(run, report.work_precision(run, tier, **SETTINGS[tier])) for run in runs]
    with _quickly_compiled(tier):
        cases = scene.cases(tier)
        picture = _draw(scene, found, folder, tier)
    rows = [row for run, of_run in found for row in report.rows_of(run, of_run)]
    missed = [f"{scene.name}: {row.run}, error {row.error:.1e} > {row.required:.0e}" for row in rows if not row.passed]
    missed += [
        f"{scene.name}: {case.name}, error {case.error:.1e} > {case.allowed:.0e}" for case in cases if not case.passed
    ]
    numbers = {"runs": [asdict(row) for row in rows], "cases": [asdict(case) for case in cases]}
    summary = *report.judged(rows), _share([case.passed for case in cases]), picture
    return JobPart(_described(scene, rows, cases), numbers, summary, missed)


def _share(passed):
    return f"{sum(passed)} of {len(passed)}"


def _draw(scene, found, folder, tier) -> str:
    """Save the pictures; returns the name of the one to look at first."""
    try:
        plots.import_matplotlib()
    except ImportError as error:
        print(f"no pictures: {error}", file=sys.stderr)
        return "-"
    # Run times of motions shorter than a call, or without an error, are not drawn.
    panels = [of_run.against_time(run.name) for run, of_run in found if run.drawn]
    work, motion = f"{scene.name}_work_precision.png", f"{scene.name}.png"
    if panels:
        plots.work_precision(panels).savefig(folder / work)
    if tier == QUICK and panels:
        return work
    scene.picture(tier).savefig(folder / motion)
    return motion


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


def _write(folder, parts):
    numbers = {name: part.numbers for name, part in parts.items()}
    rows = numbers.pop(STABILITY, None)
    if numbers:
        (folder / "report.json").write_text(json.dumps({"machine": _machine(), "scenes": numbers}, indent=1))
    if rows is not None:
        (folder / "stability.json").write_text(json.dumps({"machine": _machine(), "rows": rows}, indent=1))


def _summary(parts, folder):
    """A line for each part."""
    header = "", "error at 1e-10", "ms", "first answer/s", "cases", "processor s", "picture"
    rows = [
        (name, *part.summary[:-1], part.summary[-1] if part.summary[-1] == "-" else str(folder / part.summary[-1]))
        for name, part in parts.items()
    ]
    return table(header, rows, prose=True)


def _progress(text):
    """Overwrite one line of text, only in a terminal."""
    if sys.stderr.isatty() and parent_process() is None:
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _plan(options):
    """What happens next, and for how long."""
    at_a_time, total = _at_a_time(options), sum(_seconds(name, options.tier) for name in options.scenes)
    side_by_side = f", {at_a_time} at a time, which slow each other down" if at_a_time > 1 else ""
    about = f", about {total / at_a_time:.0f} s in all, most of them of tracing and compiling" if total else ""
    parts = f"{len(options.scenes)} part{'s' * (len(options.scenes) > 1)}"
    return f"{parts}{side_by_side}{about}; each is printed as it ends"


def _machine():
    return (
        f"lagjax on {jax.devices()[0].platform}, {platform.machine()}, Python {platform.python_version()}, "
        f"JAX {jax.__version__}, diffrax {diffrax.__version__}, float64; times are medians of compiled solves"
    )
