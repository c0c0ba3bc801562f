"""Timing in turn, rows and their report: what the benchmarks share.

A speed is a ratio of two things measured in turn in one process, so that whatever else the machine does falls on both.
Everything is called once before it is timed: compiling is not running. Medians are what is reported; minima stand
beside them, for a machine that is never quite at rest. On one that others use too, `--processor-time` counts the time
in which the process ran, over all its threads.
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

PACKAGES = ("lagjax", "jax", "diffrax", "numpy", "scipy", "numba", "heyoka", "casadi", "scikit-sundae", "mujoco")

# What `in_turn` reads; `main` changes it where `--processor-time` asks.
CLOCK = {"seconds": time.perf_counter}


class Times(NamedTuple):
    """Median and least seconds of each function, in the order given, and all of them, (repeats, functions)."""

    medians: list
    minima: list
    turns: np.ndarray

    def ratio(self, of=0, to=1):
        """The median of the turns' ratios, which a machine slow for a while leaves alone, and the ratio of minima."""
        return float(np.median(self.turns[:, of] / self.turns[:, to])), self.minima[of] / self.minima[to]


def in_turn(*functions, repeats=15, shortest=0.0) -> Times:
    """Time functions without arguments, each in turn, `repeats` times after a first call.

    What they return is waited for. With `shortest` seconds, those that take less are called several times in a row for
    one measurement, for clocks and calls that cost as much as what they measure.
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
    """What a new Python process that runs the source prints on its last line, as JSON."""
    done = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def compiled(function, *arguments):
    """`jax.jit(function)` compiled for these arguments, and the seconds of tracing and compiling."""
    started = time.perf_counter()
    program = jax.jit(function).lower(*arguments).compile()
    return program, time.perf_counter() - started


def row(what, value, target=None, better="less", **more):
    """One line of a result; without a target it only informs.

    Args:
      what: what was measured, a ratio as "one / another".
      value, target: numbers; the target is met where value <= target, or >= with `better="more"`.
      more: further columns, numbers or text.
    """
    if better not in ("less", "more"):
        raise ValueError(f'better is {better!r}: it is "less" or "more".')
    met = None if target is None else bool(value <= target if better == "less" else value >= target)
    return {"what": what, "value": float(value), "target": target, "met": met, "better": better, **more}


def skipped(what, why):
    """The line of a measurement that could not be made; it counts as neither met nor missed."""
    return {"what": what, "value": None, "target": None, "met": None, "skipped": why}


def main(rows, doc, draw=None):
    """Run a benchmark from the command line: print its rows as they come, and write them where `--json` says.

    Args:
      rows: called with `wanted(what)`, which says whether `--only` asks for a row; returns or yields rows.
      doc: the module's docstring, for `--help`.
      draw: called with the file that `--plot` names, after all rows.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", metavar="FILE", help="also write the rows there")
    parser.add_argument("--only", metavar="TEXT", default="", help="measure only the rows whose name contains it")
    if draw:
        parser.add_argument("--plot", metavar="FILE", help="draw what was measured")
    parser.add_argument("--processor-time", action="store_true", help="not wall time; for a machine others use too")
    options = parser.parse_args()
    if options.processor_time:
        CLOCK["seconds"] = time.process_time
    clock = "processor time" if options.processor_time else "wall time"
    print(f"{machine()}, {clock}; " + ", ".join(f"{name} {version}" for name, version in versions().items()))
    found = []
    for line in rows(lambda what: options.only.lower() in what.lower()):
        found.append(line)
        print(written(line), flush=True)
    if not found:
        parser.error(f"no row's name contains {options.only!r}")
    if options.json:
        result = {"machine": machine(), "clock": clock, "versions": versions(), "rows": found}
        Path(options.json).write_text(json.dumps(result, indent=1) + "\n")
    if draw and options.plot:
        draw(options.plot)


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
    """The versions of Python, lagjax and what it is compared with, as far as they are installed."""
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            pass
    return found
