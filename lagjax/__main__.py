"""`python -m lagjax`: every scene, checked, timed and drawn; then the stability report.

For each scene: error against run time by method and tolerance, how long its first answer took, then what happened in
stiff and extreme cases; work-precision diagrams and a picture as PNG, all numbers as JSON. `python -m lagjax stability`
prints the whole stability report, the main job a part of it. The exit status is 1 where a scene misses its accuracy, or
a row of the stability report is silently wrong or not as it should be.
"""

import argparse
import json
import platform
import sys
import time
from dataclasses import asdict
from pathlib import Path

import diffrax
import jax

from lagjax import plot, report, stability
from lagjax.numerics.runge_kutta import Dopri8
from lagjax.scenes import SCENES

STABILITY = "stability"

FULL = {
    "methods": None,
    "tolerances": (1e-4, 1e-6, 1e-8, 1e-10, 1e-12),
    "repeats": 5,
}
QUICK = {"methods": {"Dopri8": Dopri8()}, "tolerances": (1e-6, 1e-10), "repeats": 3}


def main(arguments=None) -> int:
    """Run the job; returns the exit status."""
    options = _parse(arguments)
    # The job is the application here: the library itself never sets JAX's options.
    jax.config.update("jax_enable_x64", True)
    folder = Path(options.output)
    folder.mkdir(parents=True, exist_ok=True)
    started = time.perf_counter()
    print(f"{_machine()}\n", flush=True)
    numbers, missed = {}, []
    for i, name in enumerate(options.scenes):
        if name == STABILITY:
            missed += _stability(options.tier, folder)
            continue
        _progress(f"scene {i + 1} of {len(options.scenes)}: {name}")
        scene = SCENES[name]
        rows, cases = _run_scene(scene, options.quick)
        _draw(scene, rows, folder, with_picture=not options.quick)
        _progress("")
        _print_scene(scene, rows, cases)
        missed += [f"{name}: {row.run}, error {row.error:.1e} > {row.required:.0e}" for row in rows if not row.passed]
        missed += [
            f"{name}: {case.name}, error {case.error:.1e} > {case.allowed:.0e}" for case in cases if not case.passed
        ]
        numbers[name] = {"runs": [asdict(row) for row in rows], "cases": [asdict(case) for case in cases]}
    if numbers:
        (folder / "report.json").write_text(json.dumps({"machine": _machine(), "scenes": numbers}, indent=1))
    print(f"{time.perf_counter() - started:.0f} s; pictures and numbers are in {folder}/")
    for line in missed:
        print(f"MISSED  {line}")
    return 1 if missed else 0


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
        help="one run a scene, one method, two tolerances, no scene pictures, few stability rows; under a minute",
    )
    options = parser.parse_args(arguments)
    unknown = [name for name in options.scenes if name not in (*SCENES, STABILITY)]
    if unknown:
        parser.error(f"no scene named {', '.join(unknown)}; there are: {', '.join(SCENES)}, and {STABILITY}")
    asked = stability.FULL if options.scenes else stability.REDUCED
    options.tier = stability.QUICK if options.quick else asked
    options.scenes = options.scenes or [*SCENES, STABILITY]
    return options


def _stability(tier, folder):
    """The stability report; returns what is not as it should be."""
    _progress("stability")
    rows, outcomes = stability.trials(tier), []
    for i, row in enumerate(rows):
        _progress(f"stability, row {i + 1} of {len(rows)}")
        outcomes.append(row.attempt())
    _progress("")
    title = "Stability: accurate, degraded with a warning, or refused with a reason"
    print(f"{title}\n{'=' * len(title)}\n\n{stability.stability_table(outcomes)}\n", flush=True)
    numbers = [asdict(outcome) | {"verdict": outcome.verdict} for outcome in outcomes]
    (folder / "stability.json").write_text(json.dumps({"machine": _machine(), "rows": numbers}, indent=1))
    return [
        f"stability: {o.family}, {o.name}, {o.method}: {o.verdict}, error {o.error:.1e}"
        for o in outcomes
        if not o.passed
    ]


def _run_scene(scene, quick):
    settings = QUICK if quick else FULL
    runs, rows = scene.runs(), []
    for run in runs[:1] if quick else runs:
        _progress(f"{scene.name}: {run.name}")
        rows += report.work_precision(run, **settings)
    _progress(f"{scene.name}: stiff and extreme cases")
    return rows, scene.cases()


def _draw(scene, rows, folder, with_picture):
    _progress(f"{scene.name}: pictures")
    try:
        plot.import_matplotlib()
    except ImportError as error:
        print(f"no pictures: {error}", file=sys.stderr)
        return
    curves = {}
    for row in rows:
        seconds, errors = curves.setdefault(f"{row.run}, {row.method}", ([], []))
        seconds.append(row.seconds)
        errors.append(row.error)
    plot.work_precision(scene.title, curves).savefig(folder / f"{scene.name}_work_precision.png")
    if with_picture:
        scene.picture().savefig(folder / f"{scene.name}.png")


def _print_scene(scene, rows, cases):
    print(f"{scene.title}\n{'=' * len(scene.title)}\n{scene.source}\n")
    print(report.work_precision_table(rows))
    print(report.first_answer(rows))
    for run, measured in dict.fromkeys((row.run, row.measured) for row in rows):
        print(f"error of '{run}': {measured}")
    print()
    print(report.case_table(cases), end="\n\n")
    print("Where the source is wrong:")
    print("\n".join(f"- {line}" for line in scene.misprints), end="\n\n", flush=True)


def _progress(text):
    """One line that is overwritten, on a terminal only."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _machine():
    return (
        f"lagjax on {jax.devices()[0].platform}, {platform.machine()}, Python {platform.python_version()}, "
        f"JAX {jax.__version__}, diffrax {diffrax.__version__}, float64; times are medians, first answers apart"
    )


if __name__ == "__main__":
    sys.exit(main())
