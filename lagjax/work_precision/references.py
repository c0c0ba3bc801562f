"""The reference that errors are measured against, given or computed, and how far it can be trusted.

Compared are states at the outputs or at the final event, and event times. Each leaf of the coordinates and of the
velocities counts relative to its largest value during the motion, each event time relative to the time span; the error
is the largest of all.

A computed reference consists of two solves at the tightest tolerance by methods of different kinds. Their errors are
unrelated, so the distance between them is the possible error of either. A given reference is checked, too: if solves at
the tightest tolerances agree with each other, but all are far from it, the reference has that error.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import Crossing, Trajectory, ended_well, message, runs_backward
from lagjax.numerics import Radau5
from lagjax.refusals import must, must_be_single, must_name
from lagjax.system import coordinates
from lagjax.work_precision.methods import TIGHTEST, ComparedMotion, TimedProgram, usual_methods

# A given reference is wrong if it is this many times farther from solves than these are from each other.
FARTHER = 10.0
FIX_OF_FORM = "reference=traj, reference=(q, v) with each leaf at all ts, or reference=lambda ts: (q, v)"
# The number of times at which the largest values are sought, and the tolerance of that motion.
SAMPLES, ROUGH_TOLERANCE = 200, 1e-5
# The power with which samples are spread.
UNEVEN = 1.2


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


def scales_of(samples: Any, ts: np.ndarray) -> ComparedScales:
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
    for a, b in pairwise(_uneven(ts[0], ts[-1], 1 + max(1, SAMPLES // (len(ts) - 1)))):
        found = program(tolerance, _uneven(a, b, len(ts)).astype(ts.dtype), q, v)
        rows.append((found.q, found.v))
        # Stop at an event or a failure.
        if not bool(ended_well(found.result)) or float(found.end.t) < b:
            break
        q, v = found.end.q, found.end.v
    return jax.tree.map(lambda *leaves: np.concatenate([np.asarray(x) for x in leaves]), *rows)


def _uneven(a: float, b: float, count: int) -> np.ndarray:
    """Increasing numbers from a to b. With equal distances, samples of a periodic motion may all have one phase."""
    return np.append(a + (b - a) * np.linspace(0.0, 1.0, count)[:-1] ** UNEVEN, b)


@dataclass(frozen=True)
class Reference:
    """The reference that errors are measured against.

    - `how`: its origin, in words; `error`: its own possible relative error; 0 for a given one without contradiction.
    - `agrees`: whether that error is small: below the square root of round-off.
    """

    how: str
    error: float
    agrees: bool

    @property
    def digits(self) -> int:
        """The number of digits that can be trusted."""
        return max(0, int(np.floor(-np.log10(self.error)))) if self.error > 0 else 16

    def in_words(self) -> str:
        """A description in one line."""
        if self.error == 0:
            return self.how
        if not np.isfinite(self.error):
            return f"{self.how}: NO digit can be trusted"
        return f"{self.how} to {self.error:.1e}: {self.digits} digits can be trusted"


class KnownAnswer:
    """A reference answer: its states, their units, its origin, and its own error."""

    def __init__(self, right: Compared, scales: ComparedScales, how: str, error: float, dtype: Any):
        self.right, self.scales, self.how, self.error, self._dtype = right, scales, how, error, dtype

    def distance(self, found: Compared) -> float:
        """The error of a computed motion."""
        return self.scales.error(found, self.right)

    def judged(self, tightest: list[Compared]) -> Reference:
        """The reference, with its error estimated from solves at the tightest tolerances."""
        error, how = self.error, self.how
        if error == 0 and len(tightest) > 1:
            one, other = tightest[:2]
            apart = max(self.scales.error(one, other), float(np.finfo(self._dtype).eps))
            off = min(self.distance(one), self.distance(other))
            if not off <= FARTHER * apart:
                how, error = f"{how}; solves that agree with each other to {apart:.0e} agree with it", off
        return Reference(how, error, bool(error <= np.sqrt(np.finfo(self._dtype).eps)))


def computed_reference(
    motion: ComparedMotion, programs: Mapping[str, TimedProgram], solvers: Mapping[str, Any]
) -> KnownAnswer:
    """The reference that two methods of different kinds compute."""
    dtype = motion.ts.dtype
    kinds: dict[str, diffrax.AbstractSolver] = usual_methods(motion.system, motion.start) | {"Radau5": Radau5()}
    tolerance = TIGHTEST.get(dtype, 1e-2)
    found, reasons, first = {}, [], None
    for name, solver in kinds.items():
        if len(found) == 2:
            break
        same = next((key for key, given in solvers.items() if type(given) is type(solver)), None)
        program = TimedProgram(motion, solver) if same is None else programs[same]
        first = program if first is None else first
        trajectory = program(tolerance)
        if bool(ended_well(trajectory.result)):
            found[name] = compared_of(trajectory, motion.options["events"])
        else:
            reasons.append(f"{name}: {message(trajectory.result)}")
    if len(found) < 2 or first is None:
        raise RuntimeError(
            f"no two methods reached the end of this motion at {tolerance:.0e}, so there is no reference to compare "
            f"with: {'; '.join(reasons)}\n"
            "Usual cause: a start or parameters that cannot be integrated, a motion that ends in a singularity, or "
            "stiffness.\n"
            "Fix: look at lj.integrate(system, q0, v0, params, ts=ts), shorten ts, or give reference=."
        )
    (one, best), (two, other) = found.items()
    scales = scales_of(states_during(motion, first), motion.ts)
    apart = scales.error(best, other)
    apart = apart if np.isfinite(apart) else float("inf")
    how = f"{one} and {two} at {tolerance:.0e}, which agree"
    # Even two solves that agree to the last digit have an error of one round-off.
    return KnownAnswer(best, scales, how, max(apart, float(np.finfo(dtype).eps)), dtype)


def given_reference(reference: Any, motion: ComparedMotion, program: TimedProgram) -> KnownAnswer:
    """A given reference; raise if it does not fit the motion."""
    ts, dtype, events = motion.ts, motion.ts.dtype, motion.options["events"]
    if isinstance(reference, Trajectory):
        _check_trajectory(reference, motion)
        right, how = compared_of(reference, events), "the trajectory that was given"
    else:
        if events:
            raise TypeError(
                "with events the reference must be a Trajectory, which has the times of events.\n"
                "Fix: reference=lj.integrate(..., events=events, rtol=1e-13), or leave it out."
            )
        how = "the function that was given" if callable(reference) else "the states that were given"
        states = reference(jnp.asarray(ts)) if callable(reference) else reference
        right = compared_of(ComparedStates(ts, *_as_states(states, motion), None), None)
    if callable(reference) and not isinstance(reference, Trajectory):
        samples = reference(jnp.linspace(ts[0], ts[-1], SAMPLES, dtype=dtype))
    else:
        samples = states_during(motion, program)
    return KnownAnswer(right, scales_of(samples, ts), how, 0.0, dtype)


def _as_states(states: Any, motion: ComparedMotion):
    """(q, v) in the structure and shapes of the start, each leaf with an axis of times in front."""
    well = isinstance(states, (tuple, list)) and len(states) == 2
    must(well, "the reference must give coordinates and velocities", states, FIX_OF_FORM, error=TypeError)
    count = len(motion.ts)
    for which, tree, like in zip(("coordinates", "velocities"), states, motion.start[1:3]):
        if jax.tree.structure(tree) != jax.tree.structure(like):
            raise ValueError(
                f"the reference's {which} are not in the structure of {'q0' if which == 'coordinates' else 'v0'}: "
                f"{jax.tree.structure(tree)}, but {jax.tree.structure(like)} is needed.\n"
                f"Usual cause: a vector instead of a dict, or another name.\nFix: {FIX_OF_FORM}."
            )
        for x, y, name in zip(jax.tree.leaves(tree), jax.tree.leaves(like), coordinates.names(like)):
            if np.shape(x) != (count, *np.shape(y)):
                raise ValueError(
                    f"the reference's {which} have the shape {np.shape(x)} at '{name}', but {(count, *np.shape(y))} is "
                    f"needed: a row for each of the {count} times.\n"
                    f"Usual cause: the last state alone, or states at other times.\nFix: {FIX_OF_FORM}."
                )
    return states


def _check_trajectory(reference: Trajectory, motion: ComparedMotion):
    must_be_single(reference.t.shape[:-1], "the reference", "reference={traj}")
    t, ts = np.asarray(reference.t), motion.ts
    if t.shape != ts.shape or not np.allclose(t, ts, rtol=0, atol=8 * np.finfo(ts.dtype).eps * np.max(np.abs(ts))):
        raise ValueError(
            f"the reference has {len(t)} times from {t[0]:.6g} to {t[-1]:.6g}, but ts has {len(ts)} from {ts[0]:.6g} "
            f"to {ts[-1]:.6g}.\nUsual cause: a trajectory with other outputs.\nFix: ts=traj.t."
        )
    if not bool(ended_well(reference.result)):
        raise ValueError(
            f"the reference did not reach its end: {message(reference.result)}\nFix: leave reference out, or repair it."
        )
    _as_states((reference.q, reference.v), motion)
    events = motion.options["events"] or {}
    must_name(
        events, reference.events, "the events ask for", "event of the reference", "integrate it with events=events, too"
    )
