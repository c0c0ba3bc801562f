"""Is the estimate of a motion's error right? How often is it ten or a hundred times too small or too large?

The motions (`closed_forms.py` and `amplifying.py`) are those of the six scenes and of mechanisms; chaotic, nearly
singular and stiff ones; with events, backward, in single precision and with fixed steps; at up to three tolerances
each. Their references are

    closed forms, elliptic functions   of the scenes and the tests, which check them; in double precision
    Kepler's equation, eigenvectors    to 50 digits by mpmath, from exactly the numbers that the solve starts from
    long double                        extrapolation of orders 16 and 20, on equations by hand (`long_double.py`)

"known" in a line is the largest relative difference of these two extrapolations along the motion; closed forms are
assumed to have a floor of 1e-13. True errors and estimates below the floor, or below "known", count as that value.

At every output after the start, for coordinates and for velocities (a *pair*): the largest error of a number over its
largest value on the way is compared with the largest estimate, in the same units. Events: likewise, the error of each
crossing's time over the span. Ratios are estimate / true error. "No digit left" means a true error above 0.1; it counts
as reported if the estimate is above 1e-3 and the call warned. A false alarm is a warning for a motion that is right to
1e-4 and to 10,000 tolerances.

Cost: the time of a call with the estimate over that without, minus one; medians of alternating calls, at the tightest
tolerance. Programs: the number compiled by calls with the estimate after one without, if none of them warns.

By default only `rtol` is given; with `--atol` also an equal atol. The twin, `--twin`, divides every estimate by 1,000,
including the one that decides on a warning: it must miss the targets. The exit status is 1 if a target is missed.

    python -m benchmarks.accuracy.error_estimates [--json FILE] [--only TEXT] [--atol] [--twin]
"""

import sys
import warnings
from contextlib import contextmanager
from typing import NamedTuple

import jax
import numpy as np

import lagjax as lj
from benchmarks.accuracy import amplifying, closed_forms
from benchmarks.accuracy.long_double import largest, worst
from benchmarks.measure import in_turn, main, row

jax.config.update("jax_enable_x64", True)

TWIN, ABSOLUTE = "--twin", "--atol"
SCALE, GIVEN = {"of estimates": 1.0}, {"atol": False}
NO_DIGIT, SAID, MUST_WARN = 0.1, 1e-3, 1e-3
RIGHT, RIGHT_IN_TOLERANCES = 1e-4, 1e4
REPEATS = 7
ON_THE_WAY = 101
_COMPILED = []


class Verdict(NamedTuple):
    """One motion at one tolerance: `ratios` (pairs,) for estimates and `events` for crossing times, NaN if unknown.

    `true` and `estimate` (pairs,) are in the same order, coordinates first; `warned` says whether the call warned.
    """

    motion: object
    tolerance: float
    true: np.ndarray
    estimate: np.ndarray
    ratios: np.ndarray
    events: np.ndarray
    known: float
    warned: bool


def solve(motion, tolerance, estimate=True):
    """The motion by `lj.integrate`."""
    more = {"events": motion.events} if motion.events else {}
    more |= {"atol": tolerance} if GIVEN["atol"] else {}
    return lj.integrate(
        motion.system, motion.q0, motion.v0, motion.params, ts=motion.ts, rtol=tolerance, method=motion.method,
        estimate_error=estimate, **more, **motion.options,
    )  # fmt: skip


def judged(motion, tolerance):
    """The verdict on one call."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        traj = solve(motion, tolerance)
    did_warn = any(issubclass(one.category, lj.AccuracyWarning) for one in caught)
    there = np.isfinite(np.asarray(jax.tree.leaves(traj.q)[0]).reshape(len(motion.ts), -1)[:, 0])
    there[0] = False
    known, right = motion.known(motion.ts), motion.exact(motion.ts)
    # Outputs may coincide with zeros of a number, such as the velocity after each half period.
    on_the_way = motion.exact(on_its_way(motion.ts))
    true, estimate = [], []
    for found, error, exact, between in zip((traj.q, traj.v), (traj.error.q, traj.error.v), right, on_the_way):
        found, error, exact, between = (as_arrays(tree) for tree in (found, error, exact, between))
        scales = [largest(leaf) for leaf in between]
        zero = [0 * leaf for leaf in exact]
        true.append(worst(found, exact, scales)[there])
        estimate.append(worst(error, zero, scales)[there] * SCALE["of estimates"])
    true, estimate, floor = np.concatenate(true), np.concatenate(estimate), np.maximum(motion.floor, known)[there]
    return Verdict(
        motion, tolerance, true, estimate, ratio(estimate, true, np.tile(floor, 2)), of_events(motion, traj),
        float(np.max(known)), did_warn and float(traj.scaled_error) * SCALE["of estimates"] > 1,
    )  # fmt: skip


def on_its_way(ts):
    """Times that are not multiples of any period, starting with the first of `ts`."""
    golden = (np.sqrt(5.0) - 1) / 2
    return ts[0] + (ts[-1] - ts[0]) * np.sort(np.arange(ON_THE_WAY) * golden % 1)


def as_arrays(tree):
    """The leaves in double precision."""
    return [np.asarray(leaf, float) for leaf in jax.tree.leaves(tree)]


def of_events(motion, traj):
    """Estimated over true errors of the times of all crossings found."""
    ratios, span = [], abs(motion.ts[-1] - motion.ts[0])
    for name, exact in motion.when.items():
        times = np.asarray(traj.events[name].t, float)
        found = np.isfinite(times)
        true = np.abs(times[found] - exact(times[found]))
        estimate = np.asarray(traj.error.events[name], float)[found] * SCALE["of estimates"]
        ratios.append(ratio(estimate / span, true / span, motion.floor))
    return np.concatenate([np.zeros(0), *ratios])


def ratio(estimate, true, floor):
    """Estimate over true error, both at least the floor; NaN if there is no estimate."""
    return np.maximum(estimate, floor) / np.maximum(true, floor)


def within(ratios, factor):
    """Which of the ratios are within a factor; unknown ones count as outside."""
    return (ratios >= 1 / factor) & (ratios <= factor)


def share(yes):
    """Of none, all."""
    return float(np.mean(yes)) if np.size(yes) else 1.0


@contextmanager
def compiles():
    """A list with one item for each program compiled inside the context."""
    before, found = len(_COMPILED), []
    yield found
    found.extend(_COMPILED[before:])


def on_compile_event(event, seconds, **_):
    """A listener for `jax.monitoring`."""
    if event == "/jax/core/compile/backend_compile_duration":
        _COMPILED.append(seconds)


def cost_of(motion):
    """The time of the estimate over that of the solve, the time of the solve in ms, and the programs it compiled."""
    tightest = motion.tolerances[-1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        jax.block_until_ready(solve(motion, tightest, estimate=False))
        programs = 0
        for tolerance in motion.tolerances[::-1]:
            with compiles() as found:
                traj = jax.block_until_ready(solve(motion, tolerance))
            # A warning runs extra programs to describe the motion, which do not count.
            programs += 0 if traj.scaled_error > 1 else len(found)
        times = in_turn(lambda: solve(motion, tightest), lambda: solve(motion, tightest, False), repeats=REPEATS)
    return times.ratio()[0] - 1, 1e3 * times.medians[1], programs


def line(verdict, of_cost):
    """A verdict as a row of the table."""
    true, estimate = verdict.true, verdict.estimate
    at_end = lambda errors: float(max(errors[len(errors) // 2 - 1], errors[-1])) if errors.size else 0.0
    kind = verdict.motion.method or verdict.motion.options.get("stepsize_controller")
    more = {"cost": of_cost[0], "ms": of_cost[1], "programs": of_cost[2]} if of_cost else {}
    if verdict.events.size:
        more = {"event_times": len(verdict.events), "worst_event": farthest(verdict.events)} | more
    hundred = share(within(verdict.ratios, 100))
    return row(
        f"{verdict.motion.name}, {verdict.tolerance:.0e}", share(within(verdict.ratios, 10)),
        method=type(kind).__name__ if kind else "default", pairs=len(true), within_100=hundred,
        farthest=farthest(verdict.ratios), error=at_end(true), estimate=at_end(estimate),
        warned=verdict.warned, reference=verdict.motion.source,
        known=verdict.known, **more,
    )  # fmt: skip


def farthest(ratios):
    """The ratio farthest from one."""
    return float(ratios[np.argmax(np.abs(np.log(np.nan_to_num(ratios, nan=np.inf))))]) if ratios.size else 1.0


def totals(verdicts, costs):
    """The summary rows, with targets."""
    ratios = np.concatenate([v.ratios for v in verdicts])
    true, estimate = (np.concatenate([getattr(v, kind) for v in verdicts]) for kind in ("true", "estimate"))
    warned = np.concatenate([np.full(len(v.true), v.warned) for v in verdicts])
    events = np.concatenate([v.events for v in verdicts])
    lost = true > NO_DIGIT
    off = [v for v in verdicts if np.max(v.true, initial=0) > MUST_WARN]
    good = [v for v in verdicts if np.max(v.true, initial=0) < min(RIGHT, RIGHT_IN_TOLERANCES * v.tolerance)]
    each = len(verdicts)
    yield row("pairs with an estimate within 1/10 and 10 of the error", share(within(ratios, 10)), 0.95, "more",
              pairs=len(ratios))  # fmt: skip
    yield row("pairs with an estimate within 1/100 and 100", share(within(ratios, 100)), 1.0, "more",
              beyond=int(np.sum(~within(ratios, 100))))  # fmt: skip
    yield row("of those where no digit is left: said", share((estimate > SAID)[lost] & warned[lost]), 1.0, "more",
              pairs=int(np.sum(lost)))  # fmt: skip
    yield row("motions off by more than 1e-3: warned of", share([v.warned for v in off]), 1.0, "more", motions=len(off))
    yield row("false alarms, of all motions", sum(v.warned for v in good) / each, 0.02, right=len(good), motions=each)
    yield row("crossings with an estimate within 1/10 and 10", share(within(events, 10)), 0.95, "more",
              crossings=len(events))  # fmt: skip
    yield row("crossings with an estimate within 1/100 and 100", share(within(events, 100)), 1.0, "more")
    high = [cost for motion, (cost, *_) in costs if motion.order >= 8]
    low = [cost for motion, (cost, *_) in costs if motion.order < 8]
    if high:
        yield row("cost, order 8 and above, median / solve", np.median(high), 1.6, largest=max(high), motions=len(high))
    if low:
        yield row("cost, order below 8, median / solve", np.median(low), largest=max(low), motions=len(low))
    yield row("programs compiled for the estimates", sum(found[2] for _, found in costs), 0)


def rows(wanted, missed):
    """Yield the lines of the requested motions, and the totals; `missed` collects the missed targets."""
    jax.monitoring.register_event_duration_secs_listener(on_compile_event)
    verdicts, costs = [], []
    for motion in [*closed_forms.motions(), *amplifying.motions()]:
        if not wanted(motion.name):
            continue
        costs.append((motion, cost_of(motion)))
        for tolerance in motion.tolerances:
            verdicts.append(judged(motion, tolerance))
            yield line(verdicts[-1], costs[-1][1] if tolerance == motion.tolerances[-1] else None)
    for found in totals(verdicts, costs) if verdicts else ():
        missed.extend([found["what"]] * (found["met"] is False))
        yield found


if __name__ == "__main__":
    if TWIN in sys.argv:
        sys.argv.remove(TWIN)
        SCALE["of estimates"] = 1e-3
    if ABSOLUTE in sys.argv:
        sys.argv.remove(ABSOLUTE)
        GIVEN["atol"] = True
    missing = []
    main(lambda wanted: rows(wanted, missing), __doc__)
    sys.exit(bool(missing))
