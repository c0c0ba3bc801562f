"""How fast is a sweep, and what does it lose when it is killed?

    trajectories/s   the bead on a rotating hoop at 1,000 speeds of the hoop, 100 of its own periods each: our rate over
                     that of another tool, both as loose as the required error allows on every lane (`loosest`)
    spread lanes     speeds from 0.5 to 20 for one span of time, compared with the sum of the times of each alone
    short lanes      a sweep with statuses, labels and progress, compared with a loop over a bare `jax.vmap`
    layout           `integrate` under `vmap`, compared with one lane after the other
    killed           a sweep with a store, killed by SIGKILL and started again: points computed twice, in blocks
    store            the full check of a store of a million numbers, compared with writing it; seconds to open it
    memory           the peak memory of a process with a sweep of 10 million numbers

The error is the largest over lanes and outputs of angle and rate, in radians, against elliptic functions. Sweeps have
one worker, except for the row with two cores; pin the process to one core for all other rows. The timing is of a
compiled sweep that runs all its points again. A tool that is not installed is skipped and named (`peers.py`).

    python -m benchmarks.speed.sweep [--json FILE] [--only TEXT]
"""

import contextlib
import io
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.measure import ROOT, in_turn, main, row, skipped
from benchmarks.speed import peers
from benchmarks.speed.against_peers import LADDER, Once, loosest
from lagjax.scenes import bead_on_hoop
from lagjax.sweep.store import Store

jax.config.update("jax_enable_x64", True)

LANES, CHUNK, PERIODS, OUTPUTS, START = 1000, 250, 100, 100, 1.0
PARAMS = bead_on_hoop.PARAMS
BELOW = PARAMS["g"] / PARAMS["a"]
# Relative to the natural rate. The homoclinic orbit through START is at 1 / cos(START / 2) = 1.14, with infinite
# period.
SPEEDS = np.concatenate([np.linspace(0.5, 1.0, LANES // 4), np.linspace(1.3, 3.0, LANES - LANES // 4)])
OMEGA = math.sqrt(BELOW) * SPEEDS
ENDS = PERIODS * np.asarray(bead_on_hoop.exact_period(PARAMS | {"omega": OMEGA}, START))
ERROR, SMALL_ERROR = 1e-6, 1e-10
SPREAD, SPAN = np.linspace(0.5, 20.0, LANES), 20.0
SHORT, SHORT_CHUNK = 100_000, 1000
# Enough points for several blocks, and the share after which it is killed, inside a block.
STORED, STORED_SPAN, KILLED_AT = 10_000, 100.0, 0.4
MANY = 10**7


def released(omega, ts, **settings):
    """ψ and ψ' at all times except the first, by our default method from the Lagrangian."""
    trajectory = lj.integrate(
        bead_on_hoop.system, START, 0.0, PARAMS | {"omega": omega}, ts=ts, throw=False, **settings
    )  # fmt: skip
    return trajectory.q[1:], trajectory.v[1:]


def error(state, omega=OMEGA, ends=ENDS):
    """The error of (ψ, ψ'), each (lanes,) or (lanes, outputs), at equidistant outputs."""
    q, v = (np.reshape(x, (len(omega), -1)) for x in state)
    params = PARAMS | {"omega": omega[:, None]}
    ts = np.reshape(ends, (-1, 1)) * np.linspace(0.0, 1.0, q.shape[1] + 1)[1:]
    psi, rate = bead_on_hoop.exact_motion(params, START, ts)
    per_radian = bead_on_hoop.exact_period(params, START) / (2 * np.pi)
    return float(np.max([np.abs(q - psi), np.abs(v - rate) * per_radian]))


def by_sweep(outputs=1, tolerances=LADDER, **settings):
    """`prepare(tolerance)` for a sweep compiled once, with the tolerances as an axis; it runs one of them again."""
    tolerances, lanes = np.asarray(tolerances), np.stack([OMEGA, ENDS], axis=1)

    def run(point):
        omega, end = point["lane"]
        ts = end * np.linspace(0.0, 1.0, outputs + 1)
        return released(omega, ts, rtol=point["tolerance"], atol=point["tolerance"])

    axes = {"tolerance": tolerances, "lane": lanes}
    swept = lj.sweep(run, axes, progress=False, **({"workers": 1, "chunk": CHUNK} | settings))

    def prepare(tolerance):
        at = tolerances == tolerance
        return lambda: [x[at] for x in swept.resweep(where=at[:, None]).values]

    return prepare


def per_second(what, ours, theirs, target, repeats=15):
    """The row of trajectories per second by one solve over those by another, each (solve, tolerance, error)."""
    times = in_turn(theirs[0], ours[0], repeats=repeats)
    ratio, of_minima = times.ratio()
    other_us, us = (1e6 * seconds / LANES for seconds in times.medians)
    return row(
        what, ratio, target, "more", minima=of_minima, us=us, other_us=other_us, error=ours[2], other_error=theirs[2],
        tolerance=ours[1], other_tolerance=theirs[1],
    )  # fmt: skip


def rate_rows(wanted):
    """The bead on the hoop in 1,000 lanes."""
    of_ladder, squares = Once(by_sweep), OMEGA**2
    tolerances = {e: Once(lambda e=e: loosest(of_ladder.it, error, e)[1]) for e in (ERROR, SMALL_ERROR)}

    def ours(allowed=ERROR, **settings):
        # Time a sweep of exactly these lanes, since their number may affect how it runs.
        tolerance = tolerances[allowed].it
        solve = by_sweep(tolerances=[tolerance], **settings)(tolerance)
        return solve, tolerance, error(solve())

    def by_numba():
        acceleration = lambda q, v, square: math.sin(q) * (square * math.cos(q) - BELOW)
        return peers.numba_dopri8_lanes(acceleration, START, 0.0, ENDS, squares)

    def by_heyoka():
        acceleration = lambda q, v, hy, square: hy.sin(q) * (square * hy.cos(q) - BELOW)
        return peers.heyoka_lanes(acceleration, START, 0.0, ENDS, squares)

    def by_diffrax():
        field = lambda t, y, square: (y[1], jnp.sin(y[0]) * (square * jnp.cos(y[0]) - BELOW))
        return peers.diffrax_lanes(field, (START, 0.0), ENDS, squares, CHUNK)

    tools = [
        ("numba Dopri8", by_numba, ERROR, 1.2, 15),
        ("heyoka in batches", by_heyoka, ERROR, 0.45, 15),
        ("heyoka in batches", by_heyoka, SMALL_ERROR, 0.2, 15),
        ("diffrax under vmap", by_diffrax, ERROR, 4.5, 5),
    ]
    for name, build, allowed, target, repeats in tools:
        what = f"trajectories/s, error {allowed:.0e}: lagjax / {name}"
        if wanted(what):
            try:
                theirs = loosest(build(), error, allowed)
            except (ImportError, ArithmeticError) as reason:
                yield skipped(what, str(reason))
                continue
            yield per_second(what, ours(allowed), theirs, target, repeats)

    what = f"trajectories/s: {OUTPUTS} outputs / without"
    if wanted(what):
        yield per_second(what, ours(outputs=OUTPUTS), ours(), 0.8)
    what = "trajectories/s: two cores / one"
    if wanted(what):
        if not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2:
            yield skipped(what, "only one core may be used")
        else:
            yield per_second(what, ours(workers=2, chunk=CHUNK // 2), ours(), 1.8)
    what = "layout: lanes under vmap / under map"
    if wanted(what):
        yield per_second(what, ours(), ours(layout="map"), None)


def spread_rows(wanted):
    """Lanes of very different cost."""
    what = "spread lanes: sweep / sum of each alone"
    if not wanted(what):
        return
    run = lambda point: released(point["omega"], np.array([0.0, SPAN]), rtol=1e-8, atol=1e-8)
    swept = lj.sweep(run, {"omega": SPREAD}, workers=1, progress=False)
    alone = jax.jit(run)
    points = [{"omega": jnp.asarray(omega)} for omega in SPREAD]
    one_by_one = lambda: [jax.block_until_ready(alone(point)) for point in points]
    together = lambda: swept.resweep(where=True).values
    times = in_turn(together, one_by_one)
    ratio, of_minima = times.ratio()
    us, other_us = (1e6 * seconds / LANES for seconds in times.medians)
    errors = [error(state, SPREAD, SPAN) for state in (together(), np.moveaxis(one_by_one(), 0, 1))]
    yield row(
        what, ratio, 1.1, minima=of_minima, us=us, other_us=other_us, error=errors[0], other_error=errors[1],
        least_steps=int(swept.status.steps.min()), most_steps=int(swept.status.steps.max()),
    )  # fmt: skip


def short_rows(wanted):
    """Lanes so short that all overhead shows."""
    what = f"{SHORT:,} short lanes: sweep / bare vmap"
    if not wanted(what):
        return
    end = 1 / math.sqrt(BELOW)
    omegas = math.sqrt(BELOW) * np.linspace(0.5, 3.0, SHORT)
    run = lambda point: released(point["omega"], np.array([0.0, end]))
    with contextlib.redirect_stderr(io.StringIO()):
        swept = lj.sweep(run, {"omega": omegas}, workers=1, chunk=SHORT_CHUNK, progress=True)
    program = jax.jit(jax.vmap(run))

    def again():
        with contextlib.redirect_stderr(io.StringIO()):
            return swept.resweep(where=True).values

    def by_vmap():
        found = np.empty((2, SHORT, 1))
        for start in range(0, SHORT, SHORT_CHUNK):
            here = slice(start, start + SHORT_CHUNK)
            found[:, here] = program({"omega": omegas[here]})
        return found

    times = in_turn(again, by_vmap)
    ratio, of_minima = times.ratio()
    us, other_us = (1e6 * seconds / SHORT for seconds in times.medians)
    errors = [error(state(), omegas, end) for state in (again, by_vmap)]
    yield row(what, ratio, 1.05, minima=of_minima, us=us, other_us=other_us, error=errors[0], other_error=errors[1])


def stored(path, log):
    """A sweep with a store that writes the number of every point it computes to a file."""
    omegas = np.resize(OMEGA, STORED)
    with open(log, "ab", buffering=0) as file:

        def logged(number):
            file.write(np.asarray(number).tobytes())
            return number

        def run(point):
            shape = jax.ShapeDtypeStruct((), point["number"].dtype)
            number = jax.pure_callback(logged, shape, point["number"], vmap_method="expand_dims")
            ts = np.array([0.0, STORED_SPAN])
            # XLA would drop a host call whose result is unused.
            return released(point["omega"] + 0.0 * number, ts, rtol=1e-10, atol=1e-10)

        axes = {"omega": omegas, "number": np.arange(STORED)}
        return lj.sweep(run, axes, paired=True, store=path, chunk=CHUNK, workers=1, progress=False)


def elsewhere(code):
    """A separate process that runs some code with this module as `sweep`."""
    # Python's resource tracker outlives a killed process and would warn about what it left behind.
    command = [sys.executable, "-W", "ignore:resource_tracker", "-c", f"from benchmarks.speed import sweep; {code}"]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def killed_rows(wanted):
    """A sweep that is killed and started again."""
    what = "killed: points computed twice / a block"
    if not wanted(what):
        return
    with tempfile.TemporaryDirectory() as folder:
        path, log = Path(folder, "store"), Path(folder, "log")
        computed = lambda: log.stat().st_size // 8 if log.exists() else 0
        with elsewhere(f"sweep.stored({str(path)!r}, {str(log)!r})") as process:
            while process.poll() is None and computed() < KILLED_AT * STORED:
                time.sleep(0.002)
            process.kill()
        before, store = computed(), Store(path)
        missing, block = len(store.missing()), store.blocks.block[0]
        swept = stored(path, log)
        twice = computed() - STORED
        off = error(swept.values, np.resize(OMEGA, STORED), STORED_SPAN)
        yield row(
            what, twice / block, 1, block=block, before=before, missing_blocks=missing, twice=twice,
            after=int(swept.ran), seconds=swept.seconds, error=off,
        )  # fmt: skip


def store_rows(wanted):
    """A million numbers: the full check and a quick opening, compared with writing."""
    what = "store of 1e6 points: full check / writing"
    if not wanted(what):
        return
    with tempfile.TemporaryDirectory() as folder:
        path, axes = Path(folder, "store"), {"x": np.linspace(0.0, 1.0, 10**6)}
        lj.sweep(lambda point: jnp.sin(point["x"]), axes, store=path, chunk=10_000, workers=1, progress=False)
        store = Store(path)
        values, (status, _, _) = store.values()[0], store.status()
        blocks = [store.blocks.points(number) for number in range(len(store.blocks))]
        parts = [jax.tree.map(lambda x: x[here], (values, status)) for here in blocks]
        write = lambda: [store.write(number, *part) for number, part in enumerate(parts)]
        check = lambda: store.damage(range(len(store.blocks)), read=True)
        times, opened = in_turn(check, write, repeats=7), in_turn(lambda: lj.open_sweep(path), check, repeats=7)
        ratio, of_minima = times.ratio()
        seconds, writing = times.medians
        off = float(np.max(np.abs(values["value"] - np.sin(axes["x"]))))
        yield row(
            what, ratio, 0.15, minima=of_minima, blocks=len(store.blocks), check_seconds=seconds, write_seconds=writing,
            open_seconds=opened.medians[0], error=off,
        )  # fmt: skip


def many():
    """A sweep of many numbers: the most memory that its process had, in GB; its seconds; its largest relative error."""
    omegas = np.linspace(0.0, 0.9 * math.sqrt(BELOW), MANY)
    run = lambda point: 2 * np.pi / bead_on_hoop.frequency(bead_on_hoop.small_motion(PARAMS | point).bottom)
    swept = lj.sweep(run, {"omega": omegas}, workers=1, progress=False)
    off = max(
        float(np.max(np.abs(period * np.sqrt(BELOW - omega**2) / (2 * np.pi) - 1)))
        for period, omega in zip(np.split(swept.values, 100), np.split(omegas, 100))
    )
    status = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) * 1024 / 1e9, swept.seconds, off


def memory_rows(wanted):
    """A sweep of ten million numbers."""
    what = f"memory: {MANY:.0e} points, GB"
    if not wanted(what):
        return
    if not Path("/proc/self/status").exists():
        yield skipped(what, "the system does not tell the most memory that a process had")
        return
    with elsewhere("print(*sweep.many())") as process:
        peak, seconds, off = map(float, process.communicate()[0].split())
    yield row(what, peak, 2, seconds=seconds, points_per_s=MANY / seconds, error=off)


def rows(wanted):
    """Rates, spread lanes, short lanes, a kill, a store, memory."""
    for of_question in (rate_rows, spread_rows, short_rows, killed_rows, store_rows, memory_rows):
        yield from of_question(wanted)


if __name__ == "__main__":
    main(rows, __doc__)
