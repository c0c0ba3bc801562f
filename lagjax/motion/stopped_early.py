"""Find out why an integration stopped before its last output, and say so in the user's terms.

If steps collapse or `max_steps` is used up, some more steps are taken from where the motion ended, one by one, and
examined:

- The rate of progress at the end, not the average rate, tells how many steps are missing.
- A rejected step is bisected, always into the half in which the acceleration changes more: in the end a smooth function
  no longer changes, one that jumps still changes by its jump. The derivative of the acceleration finds a kink in the
  same way. Moving only time, position or velocity to the other side tells which of them the break depends on.
- Steps that shrink while accelerations grow approach a singularity.
- Eigenvalues of d(v, a)/d(q, v) that are large compared with one over a step limit it: real negative ones by the
  stability of an explicit method (a stiff system), imaginary ones as frequencies to be resolved.

This takes a compilation and some seconds, and is done only after a failure.

Source: Hairer & Wanner, *Solving ODEs II*, §IV.2 (stiffness and its detection).
"""

from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from lagjax.jax_internals.one_by_one import jitted
from lagjax.mechanics import coordinates
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.diagnosis import describe, explain_failure
from lagjax.mechanics.equations import equations_of
from lagjax.motion.accuracy import of_a_step
from lagjax.motion.consistent_state import consistent_state
from lagjax.motion.loop import method_alone
from lagjax.motion.results import RESULTS
from lagjax.motion.solve import method_of
from lagjax.motion.stepping import Field
from lagjax.motion.tolerances import tolerances_at

# The number of steps that are examined, and the first of these, which only find their length.
LOOKED_AT, SETTLED = 160, 40
# diffrax's constants for the choice of the next step.
SAFETY, SHORTEST, LONGEST = 0.9, 0.2, 10.0
# The number of rejected steps that are bisected, and how often each is.
BISECTED, BISECTIONS = 12, 44
# A change over 2^-44 of a rejected step is a jump (or kink) above this share of the largest acceleration in it.
JUMP, KINK = 1e-4, 1e-2
POLE = 1e3  # times as large inside a step as at its ends.
# The velocities at the breaks of a sticking motion agree to this share.
HELD = 1e-6
# A step times an eigenvalue that limits it; and the ratio of eigenvalues from which the larger one is fast.
LIMITED, FAST = 0.3, 30.0
# The same product for the stability of an explicit method, which ends at two to six.
UNSTABLE = 1.5
# Accelerations grew and steps shrank by these factors.
GREW, SHRANK = 3.0, 0.3
BLOWN_UP = 1e6  # times those at the start: a singularity in any case.
# Above so many missing steps max_steps is not advised; above so many times those taken, only as the second advice.
TOO_MANY, MANY_TIMES = 1e8, 10
# The cause and the fix if no other cause is found.
SPAN = "a span that takes more steps: of very many periods, or at a tight tolerance", "a looser rtol and atol"


class Steps(NamedTuple):
    """The steps from where a motion ended: for each its start, its length, and whether it was accepted."""

    t: np.ndarray
    y: list
    h: np.ndarray
    accepted: np.ndarray
    left: float

    @property
    def rate(self) -> float:
        """The progress per step, counting rejected ones, after the first steps have found their length."""
        settled = slice(SETTLED if len(self.h) > 2 * SETTLED else 0, None)
        return abs(float(np.sum((self.h * self.accepted)[settled]))) / len(self.h[settled])

    @property
    def missing(self) -> float:
        """How many steps are missing to the end."""
        return len(self.h) + (self.left / self.rate if self.rate > 0 else np.inf)

    @property
    def kept(self) -> np.ndarray:
        """The indices of the accepted steps, except the first, whose length was guessed."""
        return np.flatnonzero(self.accepted)[1:]


def stopped_early(trajectory, settings) -> str:
    """Say where and why an integration stopped before its last output."""
    end, t0, t1 = trajectory.end, float(trajectory.t[0]), float(trajectory.t[-1])
    share = 100 * (float(end.t) - t0) / (t1 - t0)
    accepted, rejected = (int(trajectory.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
    what = (
        f"the integration stopped at t = {float(end.t):.9g}, {share:.3g} % of the way to {t1:.6g}, after "
        f"{accepted} accepted and {rejected} rejected steps"
    )
    reason = explain_failure(trajectory.system, State(end.t, end.q, end.v, trajectory.params)) or _beyond(trajectory)
    if reason:
        return f"{what}: {reason}"
    if bool(trajectory.result == RESULTS.max_steps_reached):
        return f"{what}: max_steps = {settings.max_steps} is used up. {_used_up(trajectory, settings)}"
    if bool(trajectory.result == RESULTS.unsolved_step) and settings.controller is not None:
        return (
            f"{what}: {RESULTS[trajectory.result]} The last state is {describe(end.q)}.\n"
            "Usual cause: a fixed step that is too long for the method's stability, for an implicit method's root "
            "finder, or for the return to the constraints.\n"
            "Fix: a smaller dt0, or leave stepsize_controller out: failed steps are then repeated, shorter."
        )
    cause, fix = (
        "a singularity of the motion (a collision, a singular configuration), a jump in a force, or NaN from L beyond "
        "that state",
        'stop before it with events={"near": lj.Crossing(...)}, or look at lj.accelerations at trajectory.end with '
        "throw=False",
    )
    if settings.controller is None:
        steps, path = last_steps(trajectory, settings), _Path(trajectory)
        cause, fix = _jump(path, steps) or _singularity(path, steps) or (cause, fix)
    return (
        f"{what}: {RESULTS[trajectory.result]} The last state is {describe(end.q)}{_fastest(trajectory)}.\n"
        f"Usual cause: {cause}.\nFix: {fix}."
    )


def _used_up(trajectory, settings):
    """The rate of progress, what keeps the steps short, and what to do."""
    end, taken = trajectory.end, int(trajectory.stats["num_steps"])
    last = f"The last state is {describe(end.q)}, v = {describe(end.v)}."
    if settings.controller is not None or not taken:
        rate = abs(float(end.t - trajectory.t[0])) / max(1, taken)
        missing = abs(float(trajectory.t[-1] - end.t)) / rate if rate > 0 else np.inf
        cause, fix = "steps that are short for the span", "longer steps"
    else:
        steps, path = last_steps(trajectory, settings), _Path(trajectory)
        rate, missing = steps.rate, steps.missing
        cause, fix = _jump(path, steps) or _singularity(path, steps) or _fast(path, steps) or SPAN
    if not missing < TOO_MANY:
        progress = f"At the rate of its last steps ({rate:.2g} each) it does not arrive"
        return f"{last} {progress}.\nUsual cause: {cause}.\nFix: {fix}."
    # Half as many again, since the rate is that of one place.
    more = f"max_steps={_rounded_up(taken + 1.5 * missing)}"
    fix = f"{fix}; else {more}" if missing > MANY_TIMES * taken and fix is not SPAN[1] else f"{more}, or {fix}"
    progress = f"At the rate of its last steps ({rate:.2g} each) it needs {missing:.2g} more"
    return f"{last} {progress}.\nUsual cause: {cause}.\nFix: {fix}."


def _rounded_up(count):
    """A count rounded up to two digits."""
    unit = 10 ** max(0, int(np.log10(count)) - 1)
    return int(-(-count // unit) * unit)


def last_steps(trajectory, settings) -> Steps:
    """Continue the motion from where it ended, and return each step."""
    system, params, end = trajectory.system, trajectory.params, trajectory.end
    state = (end.t, end.q, end.v, params)
    method = method_alone(settings, method_of(settings, system, *state))
    terms = diffrax.ODETerm(Field(equations_of(system, *state)))
    order = float(method.error_order(terms))
    # Tolerances from the start: near a singularity sizes differ from those at the start.
    first = State(*jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v)), params)
    tolerance = tolerances_at(first, trajectory.t, settings)
    direction, last = np.sign(float(trajectory.t[-1] - end.t)), float(trajectory.t[-1])
    t, y = float(end.t), (end.q, end.v)
    size = abs(t - float(trajectory.t[0])) / max(1, int(trajectory.stats["num_accepted_steps"]))
    size = size or 1e-3 * abs(last - t)
    taken_steps = []
    while len(taken_steps) < LOOKED_AT and abs(last - t) > 0:
        # The last step ends exactly at the last time.
        size = min(size, abs(last - t), float(settings.max_step))
        times = jnp.asarray(t), jnp.asarray(t + direction * size)
        after, error = _attempt(method, terms, *times, y, params, tolerance)
        error = float(error)
        taken_steps.append((t, y, direction * size, error < 1))
        if error < 1:
            t, y = (last if size == abs(last - t) else t + direction * size), after
        factor = SAFETY * error ** (-1 / order) if error > 0 else LONGEST
        size *= np.clip(factor if np.isfinite(error) else 0.0, *((1.0, LONGEST) if error < 1 else (SHORTEST, SAFETY)))
        if size < 4 * np.finfo(float).eps * max(abs(t), 1e-300):
            break
    ts, ys, h, accepted = zip(*taken_steps)
    return Steps(np.array(ts), list(ys), np.array(h), np.array(accepted), abs(last - t))


@jitted
def _attempt(method, terms, t0, t1, y, params, tolerance):
    """One step, and its error in units of the tolerance."""
    after, error, _, _, result = method.step(terms, t0, t1, y, params, method.init(terms, t0, t1, y, params), True)
    rows = lambda tree: jnp.abs(coordinates.flatten(tree)[0]).reshape(2, -1)
    allowed = of_a_step(jnp.maximum(rows(y), rows(after)), tolerance)
    largest = jnp.max(rows(error) / jnp.where(allowed > 0, allowed, 1.0))
    return after, jnp.where((result == diffrax.RESULTS.successful) & jnp.isfinite(largest), largest, jnp.inf)


class _Path:
    """Accelerations along the parabola through a state: q + s v + s² a/2, v + s a."""

    def __init__(self, trajectory):
        self.system, self.params = trajectory.system, trajectory.params
        self.names = coordinates.names(trajectory.end.q)
        t, *y = jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v))
        x, u = (np.max(np.abs(coordinates.flatten(part)[0])) for part in y)
        self.usual = max(np.max(np.abs(self.at(t, y, 0.0))), u**2 / max(x, 1e-300))

    def at(self, t, y, s, order=0):
        """The acceleration (order 0) or its derivative by s (1); t, q, v are taken at s, or at s[0], s[1], s[2]."""
        s = jnp.broadcast_to(jnp.asarray(s, dtype=float), 3)
        return np.asarray(_on_path(self.system, self.params, jnp.asarray(t), y, s, order))

    def rates(self, t, y):
        """The eigenvalues of d(v, a)/d(q, v)."""
        return np.linalg.eigvals(np.asarray(_jacobian(self.system, self.params, jnp.asarray(t), y)))


def _acceleration(system, params, t, q, v):
    return equations_of(system, t, q, v, params).accelerations(t, q, v)[0]


@jitted
def _on_path(system, params, t, y, s, order):
    q, v = y
    a = _acceleration(system, params, t, q, v)
    by = lambda scale, x, dx: jax.tree.map(lambda x, dx: x + scale * dx, x, dx)

    def at(s):
        place, velocity = by(0.5 * s[1] ** 2, by(s[1], q, v), a), by(s[2], v, a)
        return coordinates.flatten(_acceleration(system, params, t + s[0], place, velocity))[0]

    return at(s) if order == 0 else jax.jvp(at, (s,), (jnp.ones_like(s),))[1]


@jitted
def _jacobian(system, params, t, y):
    x, unflatten = coordinates.flatten(y)

    def rates(x):
        q, v = unflatten(x)
        return coordinates.flatten((v, _acceleration(system, params, t, q, v)))[0]

    return jax.jacfwd(rates)(x)


class _Break(NamedTuple):
    """A jump of an acceleration or of its derivative: time, coordinate, the values, and what it depends on (`by`)."""

    t: float
    name: str
    before: float
    after: float
    velocity: float
    by: str


def _jump(path, steps):
    """A jump of the acceleration, or of its derivative, inside steps that were rejected."""
    rejected = np.flatnonzero(~steps.accepted)
    # The shortest ones, since least else happens in them.
    shortest = rejected[np.argsort(np.abs(steps.h[rejected]))][:BISECTED]
    for order in (0, 1):
        breaks = [found for i in shortest if (found := _bisected(path, steps, i, order)) is not None]
        if len(breaks) > len(shortest) // 2:
            return _of_breaks(breaks, order, f"{len(rejected)} of {len(steps.h)} steps were rejected")
    return None


def _of_breaks(breaks, order, rejected):
    first, velocities = breaks[0], np.array([found.velocity for found in breaks])
    what = "has a kink" if order else f"jumps from {first.before:.3g} to {first.after:.3g}"
    where = f"the acceleration of '{first.name}' {what} with the {first.by} at t = {first.t:.9g}"
    if first.by == "velocity":
        held = np.ptp(velocities) <= HELD * np.max(np.abs(velocities)) + 1e-9
        sticks = ", and the motion stays there, pushed from both sides: it sticks" if held and not order else ""
        return (
            f"{where}, where its velocity is {first.velocity:.6g}{sticks} (dry friction, a sign of a velocity); "
            f"{rejected}",
            "a steep slope in place of the jump, jnp.tanh(v / 1e-3) for jnp.sign(v), with method=lj.Radau5()",
        )
    if first.by == "time":
        return (
            f"{where} (a force that is switched); {rejected}",
            "name the times at which it does, jump_ts=jnp.array([...])",
        )
    return (
        f"{where} (a contact, an end stop, a table that is interpolated); {rejected}",
        "a smooth function in its place, or an event there and a new start from where it ended",
    )


def _bisected(path, steps, i, order):
    """Bisect a rejected step: where the acceleration (order 0) or its derivative (1) breaks, or None."""
    t, y, low, high = steps.t[i], steps.y[i], 0.0, float(steps.h[i])
    below, above = path.at(t, y, low, order), path.at(t, y, high, order)
    size = at_ends = max(np.max(np.abs(below)), np.max(np.abs(above)))
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        between = path.at(t, y, middle, order)
        if not np.all(np.isfinite([below, between, above])):
            return None
        size = max(size, np.max(np.abs(between)))
        if np.max(np.abs(between - below)) > np.max(np.abs(above - between)):
            high, above = middle, between
        else:
            low, below = middle, between
    which = int(np.argmax(np.abs(above - below)))
    change = abs(above - below)[which]
    # A pole is not a jump: its values grow as the interval shrinks.
    if size > POLE * at_ends:
        return None
    if not change > (KINK if order else JUMP) * size:
        return None
    # With only t, q or v on the other side of the break.
    alone = [path.at(t, y, np.where(np.arange(3) == k, high, low), order)[which] for k in range(3)]
    by = ("time", "position", "velocity")[int(np.argmax(np.abs(alone - below[which])))]
    velocity = float(coordinates.flatten(y[1])[0][which])
    return _Break(t + low, path.names[which], below[which], above[which], velocity, by)


def _singularity(path, steps):
    """Find a singularity: steps shrink while accelerations grow."""
    kept = steps.kept
    if not kept.size:
        return None
    lengths, at = np.abs(steps.h[kept]), lambda i: np.abs(path.at(steps.t[i], steps.y[i], 0.0))
    last, limit = at(kept[-1]), steps.t[kept[-1]]
    shrinks = lengths[-1] < SHRANK * lengths[0] and np.mean(np.diff(lengths) < 0) > 0.8
    if len(kept) >= 6 and np.max(last) > GREW * np.max(at(kept[0])) and shrinks:
        # Steps in a geometric series converge to its limit.
        ratio = min(np.median(lengths[1:] / lengths[:-1]), 1 - 1e-9)
        limit += np.sign(steps.h[kept[-1]]) * lengths[-1] / (1 - ratio)
    elif not np.max(last) > BLOWN_UP * path.usual:
        return None
    return (
        f"a singularity of the motion near t = {limit:.6g}: steps shrink and the acceleration of "
        f"'{path.names[int(np.argmax(last))]}' grows (a collision, a motion that runs away)",
        f"ts that end before {limit:.6g}, an event on the way there, or a softer potential",
    )


def _fast(path, steps):
    """Find eigenvalues that are large compared with one over a step."""
    kept = steps.kept
    if not kept.size:
        return None
    t, y, step = steps.t[kept[-1]], steps.y[kept[-1]], float(np.median(np.abs(steps.h[kept])))
    # Backward in time, decay turns into growth.
    rates = np.sign(steps.h[kept[-1]]) * path.rates(t, y)
    if not np.all(np.isfinite(rates)) or np.max(np.abs(rates)) * step < LIMITED:
        return None
    fastest = rates[np.argmax(np.abs(rates))]
    if -fastest.real > abs(fastest.imag):
        if -fastest.real * step < UNSTABLE:
            return None
        return (
            f"a stiff system: something decays at a rate of {-fastest.real:.2g} per unit of time, and an explicit "
            "method needs steps as short as that even after the decay is over",
            "method=lj.Radau5(), whose steps follow the motion alone",
        )
    if fastest.real > abs(fastest.imag):
        return (
            f"a motion that grows at a rate of {fastest.real:.2g} per unit of time",
            "a shorter span, or a looser rtol",
        )
    period = 2 * np.pi / abs(fastest.imag)
    cause = f"an oscillation of period {period:.3g}, of which {steps.left / period:.2g} are left"
    if not np.any(np.abs(rates) < abs(fastest) / FAST):
        return cause, SPAN[1]
    return (
        f"{cause}: a stiff spring, or another high frequency on top of the motion",
        "a constraint in place of the stiff spring, or, where that oscillation does not matter, "
        "method=lj.Radau5(step_powers=(0, 1)), which does not follow it",
    )


def _beyond(trajectory):
    """Explain that the constraints cannot be met a little after the end; None if they can."""
    system, end = trajectory.system, trajectory.end
    if not system.constraints:
        return None
    ahead = 1e-3 * (trajectory.t[-1] - trajectory.t[0])
    q = jax.tree.map(lambda q, v: q + ahead * v, end.q, end.v)
    try:
        consistent_state(system, end.t + ahead, q, end.v, trajectory.params)
    except ValueError as error:
        return (
            f"the constraints cannot be met a little later. {error}\n"
            "(Usual there: a loop that can close only so far, or one motion prescribed twice.)"
        )
    return None


def _fastest(trajectory):
    """The coordinate whose acceleration is largest at the end: that of a collision or a coordinate singularity."""
    end = trajectory.end
    a = _acceleration(trajectory.system, trajectory.params, *end[:3])
    values = np.abs(coordinates.flatten(a)[0])
    names = coordinates.names(end.q)
    if len(names) == 0 or not np.all(np.isfinite(values)):
        return ""
    i = int(np.argmax(values))
    return f", and the largest acceleration that of '{names[i]}', {values[i]:.2g}"
