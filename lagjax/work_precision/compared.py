"""What is compared of a motion, and in which units: states at the outputs or at the final event, and event times.

Each leaf of the coordinates and of the velocities counts relative to its largest value during the motion, each event
time relative to the time span; the error is the largest of all.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate.events.event import Crossing
from lagjax.integrate.solve.backward_time import runs_backward
from lagjax.integrate.trajectory.results import ended_well
from lagjax.integrate.trajectory.trajectory import Trajectory
from lagjax.work_precision.programs import ComparedMotion, TimedProgram

# The number of times at which the largest values are sought, and the tolerance of that motion.
SAMPLES, ROUGH_TOLERANCE = 200, 1e-5


class ComparedStates(NamedTuple):
    """The coordinates and velocities of a motion at its outputs, each leaf with a leading axis."""

    t: np.ndarray
    q: PyTree
    v: PyTree
    params: PyTree


class Compared(NamedTuple):
    """States, each leaf with a leading axis, and times of events by name."""

    q: PyTree
    v: PyTree
    times: dict[str, np.ndarray]


def compared_of(motion: ComparedStates | Trajectory, events: Mapping[str, Crossing] | None) -> Compared:
    """The compared states and event times of a motion."""
    q, v, times = motion.q, motion.v, {}
    if events and isinstance(motion, Trajectory):
        times = {name: np.asarray(found.found().t) for name, found in motion.events.items()}
        if any(crossing.terminal for crossing in events.values()):
            q, v = (jax.tree.map(lambda x: np.asarray(x)[None], tree) for tree in (motion.end.q, motion.end.v))
            times[""] = np.atleast_1d(np.asarray(motion.end.t))
    return Compared(*(jax.tree.map(np.asarray, tree) for tree in (q, v)), times)


def in_words(events: Mapping[str, Crossing] | None, outputs: int) -> str:
    """A description of what is compared."""
    at = f"at {outputs} times"
    if events:
        ends = any(crossing.terminal for crossing in events.values())
        at = f"{'at the end' if ends else at}, and times of {', '.join(map(repr, events))}"
    return f"coordinates and velocities {at}, each relative to its largest value on the way"


class ComparedScales(NamedTuple):
    """The units of an error: for each leaf of q and v, and for times."""

    q: PyTree
    v: PyTree
    time: float

    def error(self, found: Compared, right: Compared) -> float:
        """The largest relative error; infinite if the numbers of events differ."""
        errors = []
        for tree, exact, scale in ((found.q, right.q, self.q), (found.v, right.v, self.v)):
            leaves = zip(jax.tree.leaves(tree), jax.tree.leaves(exact), jax.tree.leaves(scale), strict=True)
            errors += [np.max(np.abs(a - b), initial=0.0) / unit for a, b, unit in leaves]
        for name, times in right.times.items():
            if times.shape != found.times[name].shape:
                return float("inf")
            errors.append(np.max(np.abs(found.times[name] - times), initial=0.0) / self.time)
        # Unlike Python's max, this keeps NaN.
        return float(np.max(errors))


def other_events(found: Compared, right: Compared) -> str:
    """A message naming an event whose number differs from the reference; empty if there is none."""
    for name, times in right.times.items():
        if times.shape != found.times[name].shape:
            return f"{len(found.times[name])} crossings of '{name}' where the reference has {len(times)}"
    return ""


def scales_of(samples: Any, ts) -> ComparedScales:
    """The units from states (q, v) during the motion, each leaf with a leading axis."""
    largest = lambda x: float(np.nanmax(np.abs(np.asarray(x)), initial=0.0)) or 1.0
    return ComparedScales(*jax.tree.map(largest, tuple(samples)), time=abs(float(ts[-1] - ts[0])))


def states_during(motion: ComparedMotion, program: TimedProgram):
    """States (q, v) at many times; the compiled program runs from one short interval to the next, at its own outputs.

    Backward in time the program's times are fixed, so another program is compiled.
    """
    ts, start, tolerance = motion.ts, motion.start, ROUGH_TOLERANCE
    if runs_backward(ts):
        found = TimedProgram(motion._replace(ts=np.linspace(ts[0], ts[-1], SAMPLES, dtype=ts.dtype)), None)(tolerance)
        return found.q, found.v
    q, v, rows = start.q, start.v, []
    for a, b in pairwise(np.linspace(ts[0], ts[-1], 1 + max(1, SAMPLES // (len(ts) - 1)))):
        found = program(tolerance, np.linspace(a, b, len(ts), dtype=ts.dtype), q, v)
        rows.append((found.q, found.v))
        # Stop at an event or a failure.
        if not bool(ended_well(found.result)) or float(found.end.t) < b:
            break
        q, v = found.end.q, found.end.v
    return jax.tree.map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves]), *rows)
