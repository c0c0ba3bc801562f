"""The parts of a motion's answer: its instants, its result in words, its error and its cost.

After many steps an error of up to ten thousand tolerances is expected, as long as three digits are left.
`scaled_error` is the worst error in units of that limit.
"""

from collections.abc import Callable
from types import ModuleType
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.stepping import TURN
from lagjax.jaxtools import HashablePart, hashable_partition, to_jax
from lagjax.mechanics import are_angles
from lagjax.numerics import EqualSteps
from lagjax.system import UnknownSystem, coordinates


# Type checkers take equinox's enumerations for Python's, which cannot have more items than their parent.
class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """How an integration or a fit ended: diffrax's results, and those that diffrax does not have.

    >>> import lagjax as lj
    >>> print(lj.RESULTS[lj.RESULTS.event_occurred])
    Terminating differential equation solve because an event occurred.
    """

    start_off_constraints = "The initial state does not satisfy the constraints."
    contradictory = "Constraints that depend on each other ask for different accelerations at the initial state."
    start_not_finite = "L, the accelerations or the multipliers are not finite at the initial state."
    start_singular = "The accelerations are not determined at the initial state: the equations are singular there."
    not_finite = "The state became NaN or infinite."
    unsolved_step = (
        "A step could not be solved, could not be returned to the constraints, or has an error comparable to the state."
    )
    tolerance_too_small = "The tolerance is below the round-off of the state's dtype."
    unordered = (
        "The times do not increase throughout, or dt0 or max_step is not positive. (Decreasing times are "
        "accepted if they are known while JAX is tracing: a NumPy array.)"
    )
    drifted = (
        "The motion was computed, but its error, or the change of what must stay constant, is above what is allowed."
    )
    not_converged = "The search of a fit, or of a periodic orbit, did not converge."
    not_estimated = (
        "The error was not estimated: it was not asked for, and the motion takes more than 20,000 steps; or "
        "lagjax does not know how to shorten the steps of its controller."
    )
    misfit = "The residuals of a fit are not measurement errors: they contradict sigma, or follow a curve."
    too_many_switches = "There were more switches than most_switches."
    guard_not_seen = "A guard is below zero, and was not seen to cross it: the phase began on it, and hardly left it."
    guard_below_zero = "A guard of the first phase is below zero at the start."
    reset_not_finite = "The state after a switch is NaN or infinite."
    no_contact_forces = "No forces, or impulses, obey the laws of contact and friction together (Painlevé's paradox)."
    element_refused = (
        "A number of an element is NaN, or not what its law allows: friction, stiffness and damping below zero, a "
        "restitution that is not 0 to 1, a time between instants that is not above zero."
    )
    normal_below_zero = (
        "A normal force of friction, which presses from one side, fell below zero: nothing says what friction is then."
    )
    no_such_phase = "start= is not the number of a phase."
    raised = "A function that is called in Python, by a callback, raised an exception."
    no_progress = (
        "The steps became so short, for thousands of them in a row, that a hundred times max_steps would not be enough."
    )


# diffrax has no message for a success, and equinox has no public way to set one.
RESULTS._index_to_message[int(RESULTS.successful._value)] = "successful"
# Its own advice, a larger max_steps, helps only if the motion is long; from inside a program nothing else can be said.
RESULTS._index_to_message[int(RESULTS.max_steps_reached._value)] = (
    "The maximum number of solver steps was reached: a long motion, a stiff one, or one that cannot go on. "
    "lj.integrate outside of jit, vmap and grad tells which."
)
RESULTS._index_to_message[int(RESULTS.dt_min_reached._value)] = (
    "The steps became as short as round-off: a singularity, a velocity without bound, or forces that jump at each. "
    "lj.integrate outside of jit, vmap and grad tells which."
)
ENDED_WELL = RESULTS.successful, RESULTS.event_occurred


def ended_well(result: Any) -> Bool[Array, "..."]:
    """Whether a motion was computed to its end or its event."""
    return (result == RESULTS.successful) | (result == RESULTS.event_occurred)


def is_among(result: Any, others: Any) -> bool:
    """Whether a result with a known value is one of `others`; without JAX, which takes ten times as long."""
    return int(result._value) in [int(other._value) for other in others]


def message(result: Any) -> str:
    """The message of a result."""
    if is_among(result, [RESULTS.event_occurred]):
        return "ended by its event"
    # `RESULTS[result]` cannot look up a NumPy number, which a lane of a sweep has.
    return RESULTS._index_to_message[int(result._value)]


def in_words(code: Any) -> str:
    """The message of a result, from its number."""
    return message(item(RESULTS.successful, code))


def item(result: Any, value: Any):
    """The result with the number `value`; `result`: any known one."""
    return eqx.tree_at(lambda r: r._value, result, to_jax(value))


# The phase of an output that was not reached, and the number in unused places for switches.
NO_PHASE = -1
# The mode of a sliding velocity that rests since others hold it (`complementarity.py`).
HELD_BY_OTHERS = 3


# Those of sliding velocities along a line, and in a plane, in words.
SLIDING = {-1: "slides", 0: "free", 1: "slides", 2: "sticks", HELD_BY_OTHERS: "is held by others"}
# What modes are called, by the kind of what they are modes of.
MODES = {
    "gap": {0: "open", 1: "closed"},
    "sliding velocity": SLIDING,
    "sliding velocity in a plane": SLIDING,
    "side": {1: "presses", -1: "presses from the other side"},
    "spring": {0: "apart", 1: "pressed"},
}


def mode_in_words(kind: str, mode: int) -> str:
    """A mode in a word; nothing of a mode that its phase does not have."""
    if mode == NO_PHASE and kind not in ("sliding velocity", "side"):
        return ""
    return "holds its output" if kind == "control" else MODES[kind][mode]


class Snapshot(NamedTuple):
    """One instant of a motion."""

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    multipliers: dict[str, Array]


class SolveInfo(NamedTuple):
    """How a motion was stepped through.

    `order`: of the error that chooses steps; `evaluations`: of the equations per step, None for an implicit method;
    `steps`: chosen by the "tolerance", by it over several "legs", "fixed", or by the user's "controller"; `backward`:
    whether time decreases; `interpolated`: whether outputs lie inside steps.
    """

    method: str
    order: int
    evaluations: int | None
    steps: str
    backward: bool = False
    interpolated: bool = False


class SolveOptions(NamedTuple):
    """The other arguments of `integrate`, apart from the motion and its tolerances, as it takes them."""

    method: diffrax.AbstractSolver | EqualSteps | None
    stepsize_controller: diffrax.AbstractStepSizeController | None
    dt0: Array | None
    max_step: Array | None
    jump_ts: Array | None
    drift: str
    jumps: str = "found"


class StaticPart(NamedTuple):
    """The parts of a trajectory that are not arrays; they must be hashable, so that JAX can carry them along.

    `integrate`: what continues the motion, `Problem` -> trajectory.
    """

    rest: HashablePart
    how: SolveInfo
    integrate: Callable

    @property
    def method(self) -> str:
        return self.how.method + (", outputs interpolated" if self.how.interpolated else "")


def pack(problem: tuple, how: SolveInfo, integrate: Callable) -> tuple[PyTree, StaticPart]:
    """Split `problem` = (system, params, what was asked for) into arrays and a hashable rest."""
    arrays, rest = hashable_partition(problem)
    return rest.in_place(arrays), StaticPart(rest, how, integrate)


# An error of up to this many tolerances is expected, if it is also below this share of the number.
EXPECTED, DIGITS_LEFT = 1e4, 5e-4
# A coordinate within this many tolerances of zero, and below this share of the others, has no digits to lose.
NOTHING, SMALL = 100.0, 1e-6
# Above this many steps per output, outputs are sparse; an oscillation takes about so many steps.
SPARSE, STEPS_PER_OSCILLATION = 1.5, 10.0
# A velocity below this share of the oscillation's is small at outputs only because these lie at turning points.
TURNING = 1e-3
# A motion has amplified its errors if they exceed the sum of the steps' errors this many times.
AMPLIFIED = 100.0


class Errors(NamedTuple):
    """Estimates of the errors of a motion: how far each number may be from the true one, in its own unit.

    Those of `q`, `v` and `multipliers` are at the outputs: a larger error between two of them is not seen.

    - `q`, `v`, `multipliers`: like those of the trajectory; NaN where the trajectory is NaN.
    - `events`: by name, the errors of the crossings' times, (K,); infinite if the second run did not find the crossing.
    - `result`: `lj.RESULTS.successful`, or why there is no estimate; the errors are then NaN.
    - `steps`: the number of steps that the second run accepted.
    """

    q: PyTree[Float[Array, "T ..."]]
    v: PyTree[Float[Array, "T ..."]]
    multipliers: dict[str, Array]
    events: dict[str, Array]
    result: Any
    steps: Int[Array, ""]


def columns(xp: ModuleType, tree: PyTree, rows) -> Any:
    """Return the leaves of a tree as the columns of one array."""
    return xp.concatenate([xp.asarray(x).reshape(rows, -1) for x in jax.tree.leaves(tree)], axis=1)


def sizes_of(xp: ModuleType, largest, is_angle, span, steps, outputs):
    """Return the sizes of coordinates and velocities, (2, n), from their largest values at outputs, `largest` (2, n).

    Sparse outputs may all lie where a velocity, or a coordinate, is zero. A coordinate then counts as at least the
    distance that its velocity covers in one step. A velocity counts as the coordinate divided by ten steps, but only
    if it is tiny compared with that at all outputs: steps of a stiff motion are much shorter than its oscillations.
    `is_angle`: (n,), or one truth value for all.
    """
    q, v = xp.where(is_angle, xp.minimum(largest[0], TURN), largest[0]), largest[1]
    step = xp.where(steps > SPARSE * outputs, span / (1.0 + steps), 0.0)
    between = xp.where(step > 0, q / xp.where(step > 0, STEPS_PER_OSCILLATION * step, 1.0), 0.0)
    return xp.stack([xp.maximum(q, v * step), xp.where(v > TURNING * between, v, between)])


def of_a_step(size: int, tolerance):
    """Return a step's tolerances for coordinates and velocities of these sizes, (2, n); `atol` is (2,) or (2, n)."""
    rtol, atol = tolerance
    return (atol[:, None] if atol.ndim == 1 else atol) + rtol[:, None] * size


def allowed(xp: ModuleType, size: int, span, tolerance):
    """Return the allowed errors of coordinates and velocities of these sizes, (2, n); `tolerance` is (rtol, atol)."""
    tolerances = of_a_step(size, tolerance)
    largest = xp.max(size, axis=1, keepdims=True)
    others = xp.maximum(largest, largest[::-1] * xp.asarray([[span], [1 / span]]))
    nothing = (size <= NOTHING * tolerances) & (size <= SMALL * others)
    # Those by the motion's own size are its round-off: what is no larger has no digits at all.
    nothing = nothing | (size <= tolerance[1]) if tolerance[1].ndim == 2 else nothing
    return xp.minimum(EXPECTED * tolerances, xp.where(nothing, np.inf, DIGITS_LEFT * size))


def in_units_of(xp: ModuleType, error, limit):
    """Return errors in units of the allowed ones; where a number is zero throughout, its size is the error itself."""
    known = limit > 0
    return xp.where(known, error / xp.where(known, limit, 1.0), xp.where(error > 0, 1 / DIGITS_LEFT, 0.0 * error))


def scaled_error(xp: ModuleType, worst, largest, trajectory, ts, tolerance):
    """Return the largest of the errors `worst` (2, n) in units of the allowed ones; the former value if all are NaN."""
    span, steps = abs(ts[-1] - ts[0]), xp.asarray(trajectory.stats["num_accepted_steps"])

    def by(is_angle):
        limit = allowed(xp, sizes_of(xp, largest, is_angle, span, steps, len(ts)), span, tolerance)
        share = in_units_of(xp, worst, limit)
        unknown = xp.isnan(share)
        return xp.where(unknown.all(), trajectory.scaled_error, xp.where(unknown, 0.0, share).max()).astype(ts.dtype)

    # Finding out which coordinates are angles takes long, and matters only if much is lost.
    at_most = by(True) if xp is np else np.inf
    return at_most if at_most <= 1 else by(angle_mask(trajectory))


def angle_mask(trajectory) -> np.ndarray:
    """Return which coordinates are angles, (n,) booleans."""
    if isinstance(trajectory.any_system, UnknownSystem):
        return np.array(trajectory.any_system.angles, bool)
    return are_angles(trajectory.model)


# A motion whose velocity grows to this many times its median has passed near a singularity.
PEAK = 30.0
# Steps per output: up to BY_OUTPUTS the outputs have chosen the steps, above NOT_BY_OUTPUTS they have not.
BY_OUTPUTS, NOT_BY_OUTPUTS = 1.2, 4.0
# Growth of the number of steps at a tighter tolerance, relative to what the order predicts: below BY_STABILITY if
# stability limits the steps, above BY_LONGEST if the second run had its longest step halved.
BY_STABILITY, BY_LONGEST = 0.35, 1.6
# Among more steps than this the first ones, which search for their length, are few.
ENOUGH = 40
# A tolerance below this many round-offs is close to round-off.
NEAR_ROUND_OFF = 1e3
# An error that grows by this share of its digits between two outputs does not grow steadily.
AT_ONCE = 0.8


class Account(NamedTuple):
    """The errors of all coordinates, then of all velocities, and what they are compared with; rows are outputs.

    - `names`: as the user would write them; `t` (T,): the outputs that were reached.
    - `value`, `error` (T, 2n); `size` (2n,): the largest values; `limit` (2n,): the allowed errors.
    - `amplified` (T, 2n): the errors in units of the sum of the tolerances of all steps so far; 0 without a tolerance.
    """

    names: list[str]
    t: np.ndarray
    value: np.ndarray
    error: np.ndarray
    size: np.ndarray
    limit: np.ndarray
    amplified: np.ndarray

    @property
    def excess(self) -> np.ndarray:
        """The errors in units of the allowed ones."""
        return in_units_of(np, self.error, self.limit)


def account_of(trajectory) -> Account | None:
    """Return the account of one motion that is not traced; None if there is no estimate."""
    if trajectory.error is None or np.isnan(float(trajectory.error.steps)) or not int(trajectory.error.steps):
        return None
    t = np.asarray(trajectory.t)
    value, error = (columns(np, (x.q, x.v), rows=len(t)) for x in (trajectory, trajectory.error))
    reached = np.isfinite(value).all(axis=1)
    if reached.sum() < 2 or np.isnan(error[reached]).any():
        return None
    t, value, error = t[reached], value[reached], error[reached]
    names = coordinates.names(jax.tree.map(lambda x: np.asarray(x)[0], trajectory.q))
    tolerance = tuple(np.asarray(x) for x in trajectory.tolerance)
    largest, span, steps = (
        abs(value).max(axis=0).reshape(2, -1),
        abs(t[-1] - t[0]),
        int(trajectory.stats["num_accepted_steps"]),
    )
    size = sizes_of(np, largest, angle_mask(trajectory), span, steps, len(trajectory.t))
    limit, step, size = allowed(np, size, span, tolerance).ravel(), of_a_step(size, tolerance).ravel(), size.ravel()
    steps_so_far = np.maximum(1.0, steps * abs(t - t[0]) / span)[:, None]
    amplified = error / np.where(step > 0, step * steps_so_far, np.inf)
    return Account([*names, *(f"v of {name}" for name in names)], t, value, error, size, limit, amplified)


def of_error(trajectory) -> list[tuple[str, str]]:
    """Return the lines of a printed trajectory about its error."""
    if trajectory.error is None:
        return []
    times = {name: np.asarray(x)[~np.isnan(np.asarray(x))] for name, x in trajectory.error.events.items()}
    of_times = [(f"error of '{name}'", _of_times(x)) for name, x in times.items() if len(x)]
    account, result = account_of(trajectory), trajectory.error.result
    if account is not None:
        return [("error", _at_the_end(account) + _lost(trajectory, account)), *of_times]
    if is_among(result, [*ENDED_WELL, RESULTS.not_estimated, trajectory.result]):
        return of_times
    return [("error", f"not known: of a second, more precise motion, {message(result)}"), *of_times]


def _of_times(errors):
    lost = "a crossing that a more precise run does not find: does it only touch zero?"
    return lost if np.isinf(errors).any() else f"up to {errors.max():.0e} in its times"


def _at_the_end(account):
    """Name the coordinate and the velocity with the largest relative errors."""
    n, last = len(account.names) // 2, account.error[-1]
    parts = []
    for which, group in (("q", slice(0, n)), ("v", slice(n, None))):
        known = account.size[group] > 0
        relative = np.where(known, last[group] / np.where(known, account.size[group], 1.0), last[group] > 0)
        i = int(np.argmax(relative))
        parts.append(f"{last[group][i]:.0e} in {which}" + (f" ({account.names[i]})" if n > 1 else ""))
    return f"about {' and '.join(parts)} at the end"


def _lost(trajectory, account):
    """Say how many digits were lost because the motion itself amplifies errors."""
    if trajectory.static.how.steps != "tolerance":
        return ""
    column = int(np.argmax(account.amplified[-1]))
    times = account.amplified[-1, column]
    if not times > AMPLIFIED:
        return ""
    since = account.t[np.argmax(account.amplified[:, column] > np.sqrt(AMPLIFIED))]
    return f"; the motion's own sensitivity has cost {np.log10(times):.0f} digits since t = {since:.4g}"


def of_cost(trajectory) -> list[tuple[str, str]]:
    """Return the lines of a printed trajectory about its cost, and about what determined its steps."""
    accepted, rejected = (int(trajectory.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
    evaluations = trajectory.static.how.evaluations
    each = "" if evaluations is None else f"; {evaluations * (accepted + rejected):,} evaluations of the equations"
    rows, by = [("steps", f"{accepted} accepted, {rejected} rejected{each}")], _chosen_by(trajectory, accepted)
    return rows + ([("steps chosen by", by)] if by else [])


def _chosen_by(trajectory, accepted):
    how, account = trajectory.static.how, account_of(trajectory)
    if how.steps != "tolerance" or account is None:
        return ""
    per_output = accepted / (len(account.t) - 1)
    if per_output <= BY_OUTPUTS and not how.interpolated:
        return "the outputs: fewer of them cost less"
    growth = how.order * np.log10(int(trajectory.error.steps) / accepted)
    tells = accepted > ENOUGH and (per_output > NOT_BY_OUTPUTS or how.interpolated)
    if tells and growth > BY_LONGEST:
        return "max_step"
    if tells and growth < BY_STABILITY and how.evaluations is not None:
        return "stability, not the tolerance: the system is stiff; method=lj.Radau5() takes longer steps"
    if len(account.names) == 2:
        return "the tolerance"
    return f"the tolerance, most likely of {account.names[int(np.argmax(np.median(account.amplified, axis=0)))]}"


def warning_of(trajectory) -> str:
    """Return the warning: the coordinate that lost digits, how many, from when on, the cause, and the fix."""
    account = account_of(trajectory)
    assert account is not None
    row, column = np.unravel_index(np.argmax(account.excess), account.excess.shape)
    since = account.t[np.argmax(account.excess[:, column] > 1)]
    size, error, turn = account.size[column], account.error[row, column], account.size[column] == TURN
    rtol = float(np.asarray(trajectory.tolerance[0])[0])
    span, steps = abs(float(account.t[-1] - account.t[0])), int(trajectory.stats["num_accepted_steps"])
    cause, fix = _cause(trajectory, account, row, column, rtol)
    return (
        f"over a time of {span:.6g} ({steps} steps) the error of '{account.names[column]}' grows to about {error:.1g} "
        f"at the outputs, while {'a turn' if turn else 'the largest value'} is {size:.3g}: {_left(error, size)}. "
        f"From t = {since:.6g} on it is larger than {_expected(size, account.limit[column])} at rtol = {rtol:.1g}.\n"
        f"Cause: {cause}.\nFix: {fix}."
    )


def _left(error, size: int):
    digits = int(np.floor(-np.log10(error / size))) if 0 < error < size else 0
    return f"{digits or 'no'} digit{'' if digits == 1 else 's'} left"


def _expected(size: int, limit):
    return "three correct digits allow" if limit >= 0.999 * DIGITS_LEFT * size else f"{EXPECTED:,.0f} tolerances"


def _cause(trajectory, account, row, column, rtol):
    """The cause, with the number that shows it, and the fix."""
    how, dtype = trajectory.static.how, np.asarray(trajectory.t).dtype
    single = dtype == np.dtype("float32")
    tighter = f"rtol={max(rtol / 1e3, 1e2 * float(np.finfo(dtype).eps)):.0e}, and atol smaller by as much"
    if account.size[column] == 0:
        return (
            "a force that is narrower than the steps: the motion is zero throughout in this run, and not in a second "
            "one with shorter steps",
            "jump_ts= with the times at which the force sets in and ends, or max_step= shorter than it lasts",
        )
    if how.steps == "fixed":
        return (
            f"fixed steps that are too long: half as long they change the result by {account.error[row, column]:.1g}",
            "a shorter dt0, or leave stepsize_controller out",
        )
    round_off = rtol < NEAR_ROUND_OFF * np.finfo(dtype).eps
    speeds = abs(account.value[:, len(account.names) // 2 :])
    typical = np.median(speeds, axis=0)
    peaks = speeds.max(axis=0) / np.where(typical > 0, typical, np.inf)
    i, times = int(np.argmax(peaks)), account.amplified[row, column]
    # The digits lost in each interval, beyond the errors of the steps.
    lost = np.diff(np.log10(np.maximum(account.amplified[: row + 1, column], 1.0)))
    near = speeds[: row + 1, i] > PEAK * typical[i]
    there = np.sum(lost[near[1:] | near[:-1]])
    if peaks.max() > PEAK and there > 0.5 * np.sum(lost) and not round_off:
        return (
            f"the motion passes near a singularity: {account.names[len(account.names) // 2 + i]} grows to "
            f"{peaks[i]:.2g} times its median, and there {there:.2g} of {np.sum(lost):.2g} digits were lost",
            f"{tighter}, or coordinates that are regular there",
        )
    limit = f"rtol = {rtol:.1g} is {rtol / np.finfo(dtype).eps:.3g} round-offs of {dtype}"
    beyond = "study what does not depend on a single motion: averages, sections, energies"
    if times > AMPLIFIED and not round_off and not np.max(lost) < AT_ONCE * np.sum(lost):
        a, b = account.t[np.argmax(lost) :][:2]
        return (
            f"between t = {a:.6g} and {b:.6g} the error grows {10 ** np.max(lost):.0e} times beyond what the steps may "
            "have; possible causes: the motion amplifies errors, or a force there is narrower than the steps",
            f"ts with outputs in between, which show where; {tighter}; for a narrow force max_step= or jump_ts=",
        )
    if times > AMPLIFIED:
        kept = "float64" if single and round_off else None if round_off else tighter
        return (
            f"the motion itself amplifies errors, here {times:.0e} times"
            + (f", and {limit}: a tighter one keeps hardly more digits" if round_off and not single else ""),
            f"a shorter span; beyond that, {beyond}"
            if kept is None
            else f"{kept}, which keeps more digits for some time; beyond that, {beyond}",
        )
    if round_off:
        return f"round-off: {limit}", f"a shorter span{', or float64' if single else ''}"
    steps = int(trajectory.stats["num_accepted_steps"])
    return (
        f"the errors of {steps} steps add up, at a loose tolerance: to {times:.2g} times the sum of what each may have",
        f"{tighter}, or a method of higher order",
    )
