"""Alternating timing, rows and their report, shared by the benchmarks.

A speed is the ratio of two things measured alternately in one process, so that other load on the machine affects both.
Everything is called once before it is timed, so that compilation is not included. Medians are reported, together with
minima, since the machine is never entirely idle. On a shared machine, `--processor-time` counts the processor time of
the process, summed over its threads.
"""

import argparse
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

PACKAGES = ("lagjax", "jax", "diffrax", "numpy", "scipy", "numba", "heyoka", "casadi", "scikit-sundae", "mujoco", "rebound")

ROOT = Path(__file__).parent.parent
# The clock of `in_turn`; `main` changes it for `--processor-time`.
CLOCK = {"seconds": time.perf_counter}


class Times(NamedTuple):
    """Median and least seconds of each function, in the given order, and all times (repeats, functions)."""

    medians: list
    minima: list
    turns: np.ndarray

    def ratio(self, of=0, to=1):
        """The median of the ratios in each turn, insensitive to a temporarily slow machine; the ratio of minima."""
        return float(np.median(self.turns[:, of] / self.turns[:, to])), self.minima[of] / self.minima[to]


def in_turn(*functions, repeats=15, shortest=0.0) -> Times:
    """Time functions without arguments alternately, `repeats` times after a first call.

    The timing waits for their results. Functions that take less than `shortest` seconds are called several times in a
    row for one measurement, because the clock and the call themselves cost time.
    """
    calls = []
    for function in functions:
        jax.block_until_ready(function())
        calls.append(max(1, int(np.ceil(shortest / _seconds(function, 1)))))
    turns = np.array([[_seconds(*one) for one in zip(functions, calls)] for _ in range(repeats)])
    return Times(np.median(turns, axis=0).tolist(), np.min(turns, axis=0).tolist(), turns)


def _seconds(function, calls):
    started = CLOCK["seconds"]()
    for _ in range(calls):
        jax.block_until_ready(function())
    return (CLOCK["seconds"]() - started) / calls


def in_new_process(source):
    """Run the source in a new Python process, in the repository, and parse the last line that it prints as JSON."""
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def compiled(function, *arguments):
    """`jax.jit(function)`, compiled for these arguments, and the seconds of tracing and compiling."""
    started = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - started


def row(what, value, target=None, better="less", **more):
    """One line of a result; without a target it is informative only.

    Args:
      what: what was measured, a ratio as "one / another".
      value, target: numbers; the target is met if value <= target, or >= with `better="more"`.
      more: further columns, numbers or text.
    """
    if better not in ("less", "more"):
        raise ValueError(f'better is {better!r}: it is "less" or "more".')
    met = None if target is None else bool(value <= target if better == "less" else value >= target)
    return {"what": what, "value": float(value), "target": target, "met": met, "better": better, **more}


def skipped(what, why):
    """The line of a measurement that was not possible; it counts as neither met nor missed."""
    return {"what": what, "value": None, "target": None, "met": None, "skipped": why}


def small():
    """Whether `--small` is asked for, few lanes for a machine without a GPU; takes it from the command line."""
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--small", action="store_true")
    asked, sys.argv[1:] = own.parse_known_args()
    return asked.small


def main(rows, doc, draw=None):
    """Run a benchmark from the command line: print its rows as they come, and write them to the file of `--json`.

    Args:
      rows: called with `wanted(what)`, which says whether `--only` asks for a row; returns or yields rows.
      doc: the module's docstring, for `--help`.
      draw: called with the file that `--plot` names, after all rows.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="also write the rows there")
    parser.add_argument("--only", metavar="TEXT", default="", help="only the rows whose name contains it; they replace those of FILE")
    if draw:
        parser.add_argument("--plot", metavar="FILE", help="draw the results")
    parser.add_argument("--processor-time", action="store_true", help="instead of wall time; for a shared machine")
    options = parser.parse_args()
    if options.processor_time:
        CLOCK["seconds"] = time.process_time
    clock = "processor time" if options.processor_time else "wall time"
    print(f"{machine()}, {clock}; " + ", ".join(f"{name} {version}" for name, version in versions().items()))
    found, before = [], None
    if options.json and options.only and Path(options.json).exists():
        before = json.loads(Path(options.json).read_text())
    for line in rows(lambda what: options.only.lower() in what.lower()):
        found.append(line)
        print(written(line), flush=True)
        if options.json:
            # After each row: an interrupted run keeps what it has.
            result = {"machine": machine(), "clock": clock, "versions": versions(), "rows": found}
            result = result if before is None else merged(before, result)
            Path(options.json).write_text(json.dumps(result, indent=1) + "\n")
    if not found:
        parser.error(f"no row's name contains {options.only!r}")
    if draw and options.plot:
        draw(options.plot)


def merged(before, now):
    """Results of an earlier run with some rows of this one in their places, new ones last; `later` names them."""
    if any(before.get(key) != now[key] for key in ("machine", "clock")):
        raise SystemExit("the file was measured on another machine or clock: measure all rows, or write another file")
    fresh = {line["what"]: line for line in now["rows"]}
    later = {*before.get("later", []), *fresh}
    rows = [fresh.pop(line["what"], line) for line in before["rows"]] + list(fresh.values())
    return before | {"later": [line["what"] for line in rows if line["what"] in later], "rows": rows}


def written(line):
    """A row as one line of a table."""
    if "skipped" in line:
        return f"{line['what']:68s}  skipped: {line['skipped']}"
    met = {None: "", True: "ok", False: "MISSED"}[line["met"]]
    target = "" if line["target"] is None else f"{'<=' if line['better'] == 'less' else '>='} {line['target']:.3g}"
    more = [f"{name} {value:.3g}" if isinstance(value, float) else f"{name} {value}" for name, value in line.items()
            if name not in ("what", "value", "target", "met", "better")]  # fmt: skip
    return f"{line['what']:68s} {line['value']:10.4g}  {target:9s} {met:6s}  {', '.join(more)}"


def machine():
    """The processor, and how many of its cores this process may use."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return f"{platform.processor() or platform.machine()}, {cores} cores, {jax.default_backend()}"


def versions():
    """The versions of Python, lagjax and the tools it is compared with, if installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            pass
    return found
