"""What a motion has to say about its own error and its own cost, in words: for `print` and for the warning."""

from typing import NamedTuple

import jax
import numpy as np

from lagjax.mechanics import coordinates
from lagjax.motion.accuracy import AMPLIFIED, DIGITS_LEFT, EXPECTED, allowed, angle_mask, columns, of_a_step, sizes_of
from lagjax.motion.tolerances import TURN

# A velocity that grows to so many times its median has passed near a singularity.
PEAK = 30.0
# Steps from one output to the next up to which the outputs have chosen them, and from which on they have not.
BY_OUTPUTS, NOT_BY_OUTPUTS = 1.2, 4.0
# The number of steps grows with the tolerance as the order says; by a share of that where stability limits them, and by
# more where a second run had its longest step halved.
BY_STABILITY, BY_LONGEST = 0.35, 1.6
# Steps of which the first, which find their length, are few.
ENOUGH = 40
# A tolerance from which round-off is not far.
NEAR_ROUND_OFF = 1e3


class Account(NamedTuple):
    """Errors of all coordinates, then of all velocities, beside what they are measured by; rows are outputs.

    - `names`: as the user would write them; `t` (T,): the outputs that were reached.
    - `error`, `size`, `limit`: (T, 2n), and (2n,) for the largest values and for what is allowed.
    - `amplified` (T, 2n): the errors in units of what the tolerances of all steps until then add up to.
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
        """Errors in units of what is allowed."""
        return self.error / np.where(self.limit > 0, self.limit, 1.0)


def account_of(trajectory) -> Account | None:
    """The account of one motion that is known; None where there is no estimate."""
    if trajectory.error is None or np.isnan(float(trajectory.error.steps)) or not int(trajectory.error.steps):
        return None
    t = np.asarray(trajectory.t)
    value, error = (columns(np, (of.q, of.v), rows=len(t)) for of in (trajectory, trajectory.error))
    reached = np.isfinite(value).all(axis=1) & ~np.isnan(error).any(axis=1)
    if reached.sum() < 2:
        return None
    t, value, error = t[reached], value[reached], error[reached]
    names = coordinates.names(jax.tree.map(lambda x: np.asarray(x)[0], trajectory.q))
    tolerance = tuple(np.asarray(x) for x in trajectory.tolerance)
    seen, span, steps = (
        abs(value).max(axis=0).reshape(2, -1),
        abs(t[-1] - t[0]),
        int(trajectory.stats["num_accepted_steps"]),
    )
    size = sizes_of(np, seen, angle_mask(trajectory), span, steps, len(trajectory.t))
    limit, step, size = allowed(np, size, span, tolerance).ravel(), of_a_step(size, tolerance).ravel(), size.ravel()
    amplified = error / (step * np.maximum(1.0, steps * abs(t - t[0]) / span)[:, None])
    return Account([*names, *(f"v of {name}" for name in names)], t, value, error, size, limit, amplified)


def of_error(trajectory) -> list[tuple[str, str]]:
    """The lines of a printed trajectory about its error."""
    if trajectory.error is None:
        return []
    times = {name: np.asarray(x)[~np.isnan(np.asarray(x))] for name, x in trajectory.error.events.items()}
    of_times = [(f"error of '{name}'", _of_times(x)) for name, x in times.items() if len(x)]
    found = account_of(trajectory)
    return of_times if found is None else [("error", _at_the_end(found) + _lost(trajectory, found)), *of_times]


def _of_times(errors):
    lost = "a crossing that a more precise run does not find: does it only touch zero?"
    return lost if np.isinf(errors).any() else f"up to {errors.max():.0e} in its times"


def _at_the_end(found):
    """The coordinate and the velocity that have lost most."""
    n, last = len(found.names) // 2, found.error[-1]
    parts = []
    for which, group in (("q", slice(0, n)), ("v", slice(n, None))):
        relative = last[group] / np.where(found.size[group] > 0, found.size[group], 1.0)
        i = int(np.argmax(relative))
        parts.append(f"{last[group][i]:.0e} in {which}" + (f" ({found.names[i]})" if n > 1 else ""))
    return f"about {' and '.join(parts)} at the end"


def _lost(trajectory, found):
    """How many digits the motion itself has cost."""
    if trajectory.static.how.steps != "tolerance":
        return ""
    column = int(np.argmax(found.amplified[-1]))
    times = found.amplified[-1, column]
    if not times > AMPLIFIED:
        return ""
    since = found.t[np.argmax(found.amplified[:, column] > np.sqrt(AMPLIFIED))]
    return f"; the motion's own sensitivity has cost {np.log10(times):.0f} digits since t = {since:.4g}"


def of_cost(trajectory) -> list[tuple[str, str]]:
    """The lines of a printed trajectory about what it cost, and what chose its steps."""
    accepted, rejected = (int(trajectory.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
    evaluations = trajectory.static.how.evaluations
    each = "" if evaluations is None else f"; {evaluations * (accepted + rejected):,} evaluations of the equations"
    rows, by = [("steps", f"{accepted} accepted, {rejected} rejected{each}")], _chosen_by(trajectory, accepted)
    return rows + ([("steps chosen by", by)] if by else [])


def _chosen_by(trajectory, accepted):
    how, found = trajectory.static.how, account_of(trajectory)
    if how.steps != "tolerance" or found is None:
        return ""
    an_output = accepted / (len(found.t) - 1)
    if an_output <= BY_OUTPUTS:
        return "the outputs: fewer of them cost less"
    growth = how.order * np.log10(int(trajectory.error.steps) / accepted)
    tells = accepted > ENOUGH and an_output > NOT_BY_OUTPUTS
    if tells and growth > BY_LONGEST:
        return "max_step"
    if tells and growth < BY_STABILITY and how.evaluations is not None:
        return "stability, not the tolerance: the system is stiff; method=lj.Radau5() takes longer steps"
    if len(found.names) == 2:
        return "the tolerance"
    return f"the tolerance, most likely of {found.names[int(np.argmax(np.median(found.amplified, axis=0)))]}"


def warning_of(trajectory) -> str:
    """What is lost, in which coordinate, from when on; the cause, and what helps."""
    found = account_of(trajectory)
    assert found is not None
    row, column = np.unravel_index(np.argmax(found.excess), found.excess.shape)
    since = found.t[np.argmax(found.excess[:, column] > 1)]
    size, error, turn = found.size[column], found.error[row, column], found.size[column] == TURN
    rtol = float(np.asarray(trajectory.tolerance[0])[0])
    span, steps = abs(float(found.t[-1] - found.t[0])), int(trajectory.stats["num_accepted_steps"])
    cause, fix = _cause(trajectory, found, row, column, rtol)
    return (
        f"over a time of {span:.6g} ({steps} steps) the error of '{found.names[column]}' grows to about {error:.1g}, "
        f"where {'a turn' if turn else 'the largest value'} is {size:.3g}: {_left(error, size)}. From t = {since:.6g} "
        f"on it is more than {_expected(size, found.limit[column])} at rtol = {rtol:.1g}.\n"
        f"Usual cause: {cause}.\nFix: {fix}."
    )


def _left(error, size):
    digits = int(np.floor(-np.log10(error / size))) if 0 < error < size else 0
    return f"{digits or 'no'} digit{'' if digits == 1 else 's'} left"


def _expected(size, limit):
    return "three digits allow" if limit >= 0.999 * DIGITS_LEFT * size else f"{EXPECTED:,.0f} tolerances"


def _cause(trajectory, found, row, column, rtol):
    how, dtype = trajectory.static.how, np.asarray(trajectory.t).dtype
    tighter = f"rtol={max(rtol / 1e3, 1e2 * float(np.finfo(dtype).eps)):.0e}, and atol as much"
    if how.steps == "fixed":
        return "fixed steps that are too long", "a shorter dt0, or leave stepsize_controller out"
    round_off = rtol < NEAR_ROUND_OFF * np.finfo(dtype).eps
    speeds = abs(found.value[:, len(found.names) // 2 :])
    typical = np.median(speeds, axis=0)
    peaks = speeds.max(axis=0) / np.where(typical > 0, typical, np.inf)
    if peaks.max() > PEAK:
        i = int(np.argmax(peaks))
        return (
            f"the motion passes near a singularity: {found.names[len(found.names) // 2 + i]} grows to {peaks[i]:.2g} "
            "times its median, and what is lost there is not found again",
            f"{tighter}, or coordinates that are regular there",
        )
    times = found.amplified[row, column]
    if times > AMPLIFIED:
        return (
            f"the motion itself amplifies errors, here {times:.0e} times (a chaotic or an unstable motion, or a phase "
            "that runs away over many periods)",
            f"{'float64 where this is float32' if round_off else tighter}, which gains some digits for some time; "
            "beyond that look at what does not depend on one motion: averages, sections, energies",
        )
    if round_off:
        return "round-off: the tolerance is near its limit", "a shorter span, or float64 where this is float32"
    return "the errors of many steps add up, at a loose tolerance", f"{tighter}, or a method of higher order"
