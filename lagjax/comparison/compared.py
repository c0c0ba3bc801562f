"""What of a motion is compared, and in which units: states at the outputs, or at the event that ended it, and times.

Every leaf of the coordinates and of the velocities counts relative to its largest value on the way, every time of an
event relative to the time span; the error is the largest of all.
"""

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.comparison.programs import Motion, Program
from lagjax.motion.backward import runs_backward
from lagjax.motion.crossings import Crossing
from lagjax.motion.results import ended_well
from lagjax.motion.trajectory import Trajectory

# Where a motion is looked at to find its largest values, at this tolerance.
PLACES, ROUGHLY = 200, 1e-5


class States(NamedTuple):
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


def of(motion: States | Trajectory, events: Mapping[str, Crossing] | None) -> Compared:
    """What is compared of a motion."""
    q, v, times = motion.q, motion.v, {}
    if events and isinstance(motion, Trajectory):
        times = {name: np.asarray(found.found().t) for name, found in motion.events.items()}
        if any(crossing.terminal for crossing in events.values()):
            q, v = (jax.tree.map(lambda x: np.asarray(x)[None], tree) for tree in (motion.end.q, motion.end.v))
            times[""] = np.atleast_1d(np.asarray(motion.end.t))
    return Compared(*(jax.tree.map(np.asarray, tree) for tree in (q, v)), times)


def in_words(events: Mapping[str, Crossing] | None, outputs: int) -> str:
    """What is compared, in words."""
    at = f"at {outputs} times"
    if events:
        ends = any(crossing.terminal for crossing in events.values())
        at = f"{'at the end' if ends else at}, and times of {', '.join(map(repr, events))}"
    return f"coordinates and velocities {at}, each relative to its largest value on the way"


class Scales(NamedTuple):
    """The units of an error: for each leaf of q and v, and for times."""

    q: PyTree
    v: PyTree
    time: float

    def error(self, found: Compared, right: Compared) -> float:
        """The largest relative error; infinite where there are other events."""
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
    """In words, which event came more or less often than it does; empty where none."""
    for name, times in right.times.items():
        if times.shape != found.times[name].shape:
            return f"{len(found.times[name])} crossings of '{name}' where the reference has {len(times)}"
    return ""


def scales_of(samples: Any, ts) -> Scales:
    """The units from states (q, v) on the way, each leaf with a leading axis."""
    largest = lambda x: float(np.nanmax(np.abs(np.asarray(x)), initial=0.0)) or 1.0
    return Scales(*jax.tree.map(largest, tuple(samples)), time=abs(float(ts[-1] - ts[0])))


def on_the_way(motion: Motion, program: Program):
    """States (q, v) at many times: the compiled program goes from place to place, whatever the number of its outputs.

    Backward in time its times are fixed, and another program is compiled.
    """
    ts, start, tolerance = motion.ts, motion.start, ROUGHLY
    if runs_backward(ts):
        found = Program(motion._replace(ts=np.linspace(ts[0], ts[-1], PLACES, dtype=ts.dtype)), None)(tolerance)
        return found.q, found.v
    q, v, rows = start.q, start.v, []
    for a, b in pairwise(np.linspace(ts[0], ts[-1], 1 + max(1, PLACES // (len(ts) - 1)))):
        found = program(tolerance, np.linspace(a, b, len(ts), dtype=ts.dtype), q, v)
        rows.append((found.q, found.v))
        # An event, or a failure.
        if not bool(ended_well(found.result)) or float(found.end.t) < b:
            break
        q, v = found.end.q, found.end.v
    return jax.tree.map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves]), *rows)
