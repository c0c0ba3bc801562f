"""The causes of a stop before the last output, and of a guard that could not be followed, with numbers that show them.

If steps collapse or `max_steps` is used up, some more steps are taken from where the motion ended, one by one. A cause
is said only where one of these numbers shows it, and with the number; otherwise the facts stand alone:

- The rate of progress at the end, not the average rate, tells how many steps are missing.
- An eigenvalue of the mass matrix is below zero at the end or just beyond it (`lagjax/mechanics/diagnosis.py`).
- Velocities or accelerations that have grown a millionfold, or that grow while steps shrink, approach a singularity.
- Steps are rejected at jumps and kinks of forces, where these are read off their programs and `jumps="ignored"`.
- Eigenvalues of d(v, a)/d(q, v) that are large compared with one over a step limit it: real negative ones by the
  stability of an explicit method (a stiff system), imaginary ones as frequencies to be resolved.

This takes a compilation and some seconds, and is done only after a failure. `benchmarks/campaigns/advice.py` applies
each fix.

Source: Hairer & Wanner, *Solving ODEs II*, §IV.2 (stiffness and its detection).
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate.events.event import Guards
from lagjax.integrate.jumps import found as jumps_found
from lagjax.integrate.problem import Problem
from lagjax.integrate.results import ENDED_WELL, RESULTS, is_among, of_a_step
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.one_motion import method_alone
from lagjax.integrate.solve.programs import method_of
from lagjax.integrate.stepping import Field, tolerances_at
from lagjax.integrate.trajectory import SWITCHES, HybridTrajectory, Trajectory
from lagjax.jaxtools import jitted
from lagjax.mechanics import (
    IndefiniteMass,
    describe,
    equations_of,
    explain_failure,
    indefinite_mass,
    listed,
    unreachable_ahead,
)
from lagjax.numerics import EqualSteps, Gauss, Splitting
from lagjax.system import Model, State, coordinates

# Outputs at which guards are evaluated; a change by the last digit that is no round-off, as a share of the guard, and
# by how much more a linear one would change where all digits from the middle on change; round-offs that are zero.
OUTPUTS, SHARE, MORE, ZERO = 16, 0.1, 100.0, 64
# What is said where no number shows more.
UNKNOWN = "touches zero within round-off, or changes too fast between steps to be followed"
# Guards are why steps are rejected if so many are, and less than this share of these without guards.
MANY_REJECTED, FEWER = 0.5, 0.5
# A guard is too fast if it changes by so many times its size in a step.
TOO_FAST = 10.0


class Instant(NamedTuple):
    """A state of the motion, its multipliers, and its phase."""

    state: State
    multipliers: Mapping
    phase: int


def of_guards(trajectory, guards) -> str:
    """The guards of a motion whose steps they may have shortened, in words, with what is wrong with them; "" if none.

    Those with something wrong are named alone.
    """
    found = [in_doubt(trajectory, guards, name) for name in (trajectory.events if guards is not None else ())]
    known = [f"The guard of {which} {cause}.\nFix: {fix}." for which, cause, fix in found if cause]
    names = " and ".join(which for which, *_ in found)
    return "\n".join(known) or (names and f"The guards looked at are those of {names}.")


def rejected_by_guards(guards: str, stats: Mapping, without: float) -> str:
    """Why all steps were used up, if by guards, of which `guards` tells; `without`: the share rejected without them."""
    taken = int(stats["num_steps"])
    share = int(stats["num_rejected_steps"]) / taken
    if not guards or share <= MANY_REJECTED or without >= FEWER * share:
        return ""
    said = f"{100 * share:.3g} % of the steps were rejected; without its guards the motion goes on with "
    return f"{said}{100 * without:.3g} %. {guards}" + ("" if "Fix:" in guards else f"\nFix: max_steps={10 * taken}.")


def in_doubt(trajectory, guards, name: str) -> tuple[str, str, str]:
    """The guard of an event, or that of a switch, that cannot be followed; why, with a number, or ""; and the fix."""
    shifted = "shift the level of the guard a little; or make the motion take shorter steps, max_step="
    if trajectory.system.elements is not None:
        switches = trajectory.switches
        modes = ("a switch of phases, or " if switches.of_phases else "") + "the modes "
        modes += listed([mode for mode, _ in switches.of_modes])
        return (modes if name == SWITCHES else f"event '{name}'"), "", shifted
    instants, step = _instants(trajectory), _step(trajectory)
    candidates = [
        (i, kind.name.partition(", number ")[0] if name == SWITCHES else name, guard, kind.takes_multipliers)
        for i in sorted({x.phase for x in instants})
        for kind, guard in zip(_of_phase(guards, i).kinds, _of_phase(guards, i).functions)
        if kind.name == name or name == SWITCHES and kind.holds
    ]
    for i, of, guard, takes in candidates:
        # The modes that its guard depends on are not known at outputs.
        if not isinstance(guards, Guards) and guards[i].meeting is not None and name == SWITCHES:
            continue
        found = _cause(guard, takes, [x for x in instants if x.phase == i], step)
        if found:
            return _called(of, name), *found
    names = " or ".join(dict.fromkeys(_called(of, name) for _, of, _, _ in candidates))
    return names, "", shifted


def _called(of, name: str):
    return f"the switch {of}" if name == SWITCHES else f"event '{of}'"


def _of_phase(guards, phase) -> Guards:
    return guards if isinstance(guards, Guards) else guards[phase].guards


def _instants(trajectory) -> list[Instant]:
    """Some outputs that were reached, and the end."""
    t, q = np.asarray(trajectory.t), jax.tree.leaves(trajectory.q)[0]
    reached = np.flatnonzero(np.isfinite(np.asarray(q).reshape(t.size, -1)).all(axis=1))
    hybrid = isinstance(trajectory, HybridTrajectory)
    rows = []
    for i in reached[np.unique(np.linspace(0, reached.size - 1, OUTPUTS).astype(int))] if reached.size else ():
        motion = trajectory.q, trajectory.v, trajectory.multipliers
        q, v, multipliers = jax.tree.map(lambda x: np.asarray(x)[i], motion)
        state = State(t[i], q, v, trajectory.params)
        rows.append(Instant(state, multipliers, int(trajectory.phase[i]) if hybrid else 0))
    end = trajectory.end
    last = trajectory.last_phase() if hybrid else 0
    return [*rows, Instant(State(end.t, end.q, end.v, trajectory.params), end.multipliers, last)]


def _step(trajectory):
    """The mean length of the steps of the motion."""
    taken = max(1, int(trajectory.stats["num_accepted_steps"]))
    return abs(float(trajectory.end.t) - float(trajectory.t[0])) / taken


def _cause(guard: Callable, takes_multipliers: bool, instants, step) -> tuple[str, str] | None:
    """What is wrong with a guard at some instants, with the fix; None if nothing is."""

    def value(instant, change=0.0):
        t, q, v = jax.tree.map(lambda x: np.asarray(x) * (1 + change), instant.state[:3])
        of = (t, q, v, instant.multipliers) if takes_multipliers else (t, q, v)
        return float(guard(*of, instant.state.params))

    values = np.array([value(x) for x in instants])
    for x, g in zip(instants, values):
        if not np.isfinite(g):
            return (
                f"is {g} at t = {float(x.state.t):.9g}, where q = {describe(x.state.q)}",
                "a guard that is finite along the whole motion: jnp.sqrt(jnp.maximum(x, 0)) for a root, or a guard "
                "without the root, the logarithm or the quotient, which is zero at the same place",
            )
    eps, size = np.finfo(np.asarray(instants[0].state.t).dtype).eps, np.max(abs(values))
    last, half = (np.array([value(x, change) for x in instants]) - values for change in (4 * eps, np.sqrt(eps)))
    worst = int(np.argmax(abs(last)))
    if abs(last[worst]) > SHARE * size and abs(half[worst]) < MORE * abs(last[worst]):
        return (
            f"changes from {values[worst]:.3g} to {values[worst] + last[worst]:.3g} at "
            f"t = {float(instants[worst].state.t):.9g} where t, q and v change in their last digit",
            "a guard that changes by no more than its size when the state does so by its own",
        )
    if np.all(abs(values) <= ZERO * abs(last)):
        return (
            f"is zero within round-off all along, at most {size:.2g}",
            "another level of the guard, if it is a quantity that is conserved",
        )
    rates = [_rate(value, x, step) for x in instants]
    fastest = int(np.argmax(rates))
    if step * rates[fastest] > TOO_FAST * size:
        t = float(instants[fastest].state.t)
        return (
            f"changes at a rate of {rates[fastest]:.2g} at t = {t:.9g}, by its size within "
            f"{size / rates[fastest]:.2g}, where a step of the motion is {step:.2g}",
            f"max_step={size / rates[fastest]:.1g}; or a guard that changes as slowly as the motion",
        )
    return None


def _rate(value, instant, step):
    """The size of dg/dt along (q, v), by a difference over a millionth of a step."""
    t, q, v, params = instant.state
    h = 1e-6 * step
    on = State(np.asarray(t) + h, jax.tree.map(lambda x, dx: np.asarray(x) + h * np.asarray(dx), q, v), v, params)
    return abs(value(instant._replace(state=on)) - value(instant)) / h if h > 0 else 0.0


# The number of steps that are examined, and the first of these, which only find their length.
LOOKED_AT, SETTLED = 160, 40
# diffrax's constants for the choice of the next step.
SAFETY, SHORTEST, LONGEST = 0.9, 0.2, 10.0
# A step times an eigenvalue that limits it; and the ratio of eigenvalues from which the larger one is fast.
LIMITED, FAST = 0.3, 30.0
# The same product for the stability of an explicit method, which ends at two to six.
UNSTABLE = 1.5
# The radians of an oscillation in a step of `lj.Splitting` above which it grows.
STABLE, STABLE_OF_ORDER_2 = 3.0, 2.0
# Velocities or accelerations grew and steps shrank by these factors; growth that is a singularity in any case.
GREW, SHRANK, BLOWN_UP = 3.0, 0.3, (1e4, 1e6)
# Above so many missing steps max_steps is not advised; above so many times those taken, only as the second advice.
TOO_MANY, MANY_TIMES = 1e8, 10


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


def stopped_early(trajectory: Trajectory, settings: Settings, guards: str) -> str:
    """Say where and why an integration stopped before its last output; `guards`: these, in words."""
    end, t0, t1 = trajectory.end, float(trajectory.t[0]), float(trajectory.t[-1])
    share = 100 * (float(end.t) - t0) / (t1 - t0)
    accepted, rejected = (int(trajectory.stats[f"num_{kind}_steps"]) for kind in ("accepted", "rejected"))
    what = (
        f"the integration stopped at t = {float(end.t):.9g}, {share:.3g} % of the way to {t1:.6g}, after "
        f"{accepted} accepted and {rejected} rejected steps"
    )
    first = jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v))
    last = State(end.t, end.q, end.v, trajectory.params)
    mass = indefinite_mass(trajectory.model, State(*first, trajectory.params), last)
    if isinstance(settings.method, Splitting) and (found := _grows_by_steps(trajectory, settings)):
        return _with_cause(f"{what}.", found)
    reason = None if mass and mass.crossed else explain_failure(trajectory.model, last) or unreachable_ahead(trajectory)
    if reason:
        return f"{what}: {reason}"
    shown = f"The last state is {describe(end.q)}, v = {describe(end.v)}."
    if is_among(trajectory.result, [RESULTS.max_steps_reached]):
        used_up = f"max_steps = {settings.max_steps} is used up. {shown}"
        return f"{what}: {used_up} {_used_up(trajectory, settings, guards, mass)}"
    said = f"{what}: {RESULTS[trajectory.result]} {shown}"
    if is_among(trajectory.result, [RESULTS.no_progress]):
        return f"{said} {_used_up(trajectory, settings, guards, mass)}"
    if mass and mass.crossed:
        return _with_cause(said, mass[:2])
    if settings.controller is not None:
        return f"{said}\nFix: {_of_controller(trajectory, settings)}."
    steps, path = last_steps(trajectory, settings), _Path(trajectory)
    found = _singularity(path, steps, mass) or _jump(trajectory, settings, steps) or _undefined(path, steps)
    if found:
        return _with_cause(said, found)
    return (
        f"{said} {path.largest(steps)}\nFix: look at lj.accelerations at trajectory.end, with throw=False; or end the "
        'motion before, with events={"near": lj.Crossing(...)}.'
    )


def _with_cause(said: str, found):
    cause, fix = found
    return f"{said}\nCause: {cause}." + (f"\nFix: {fix}." if fix else "")


def _used_up(trajectory: Trajectory, settings: Settings, guards: str, mass: IndefiniteMass | None):
    """The rate of progress, what keeps the steps short, and what to do."""
    end, taken = trajectory.end, int(trajectory.stats["num_steps"])
    if settings.controller is not None or not taken:
        rate = abs(float(end.t - trajectory.t[0])) / max(1, taken)
        missing = abs(float(trajectory.t[-1] - end.t)) / rate if rate > 0 else np.inf
        found, facts, otherwise = None, "", "longer steps"
    else:
        steps, path = last_steps(trajectory, settings), _Path(trajectory)
        rate, missing, rejected = steps.rate, steps.missing, int(np.sum(~steps.accepted))
        if said := rejected_by_guards(guards, trajectory.stats, rejected / len(steps.h)):
            return said
        method = method_of(settings, trajectory.model)
        implicit = isinstance(method, diffrax.AbstractImplicitSolver)
        crossed = mass[:2] if mass and mass.crossed else None
        found = crossed or _singularity(path, steps, mass) or _jump(trajectory, settings, steps)
        found = found or _fast(path, steps, implicit)
        facts = "" if found else f" {rejected} of the next {len(steps.h)} were rejected. {path.largest(steps)}"
        otherwise = "a looser rtol and atol"
    if not missing < TOO_MANY:
        said = f"At the rate of its last steps ({rate:.2g} each) it does not arrive.{facts}"
        return _with_cause(said, found) if found else f"{said}\nFix: {otherwise}, or ts that end before."
    said = f"At the rate of its last steps ({rate:.2g} each) it needs {missing:.2g} more.{facts}"
    # Half as many again, since the rate is that of one place.
    more = f"max_steps={_rounded_up(taken + 1.5 * missing)}"
    if not found or not found[1]:
        return _with_cause(said, (found[0], more)) if found else f"{said}\nFix: {more}, or {otherwise}."
    fix = f"{found[1]}; else {more}" if missing > MANY_TIMES * taken else f"{more}, or {found[1]}"
    return _with_cause(said, (found[0], fix))


def _of_controller(trajectory: Trajectory, settings: Settings):
    """The fix for steps of a user's controller: whether a shorter one can be taken from where it failed."""
    if settings.dt0 is None or not isinstance(settings.controller, diffrax.ConstantStepSize):
        return "leave stepsize_controller out: failed steps are then repeated, shorter"
    if isinstance(settings.method, EqualSteps):
        return _of_equal_steps(trajectory, settings)
    attempt, _, (t, y), direction = _attempts(trajectory, settings)
    for part in (2, 4, 8, 16, 32):
        h = float(settings.dt0) / part
        after, _ = attempt(t, t + direction * h, y)
        if np.all(np.isfinite(coordinates.flatten(after)[0])):
            return f"dt0={h:.3g}, which succeeds there; or leave stepsize_controller out"
    return f"leave stepsize_controller out: there even a step of dt0 / 32 = {float(settings.dt0) / 32:.3g} fails"


def _of_equal_steps(trajectory: Trajectory, settings: Settings):
    """The fix for equal steps, one of which was not solved: a shorter one that is."""
    assert settings.dt0 is not None and isinstance(settings.method, EqualSteps)
    end, longest, pace = trajectory.end, float(settings.dt0), 1.0
    if settings.method.pace is not None:
        pace = float(settings.method.pace(end.t, end.q, trajectory.params))
        if not 0 < pace < np.inf:
            return f"a pace that is positive and finite: there it is {pace:.3g}"
    ahead = np.array([0.0, longest * pace], np.asarray(end.t).dtype)
    ts = end.t + np.sign(float(trajectory.t[-1] - end.t)) * ahead
    others = "; or method=lj.Gauss(2, newton=True)" if isinstance(settings.method, Gauss) else "; or method=lj.Gauss(3)"
    for part in (2, 4, 8, 16, 32):
        shorter = replace(settings, dt0=settings.dt0 / part, repeated_up_to=np.zeros((), np.int32))
        found = trajectory.static.integrate(
            Problem(trajectory.system, end.q, end.v, trajectory.params, ts, None, shorter)
        )
        if is_among(found.result, ENDED_WELL):
            return f"dt0={longest / part:.3g}, with which a step is solved there{others}"
    return f"look at the motion near its end: there even a step of dt0 / 32 = {longest / 32:.3g} is not solved{others}"


def _grows_by_steps(trajectory: Trajectory, settings: Settings) -> tuple[str, str] | None:
    """Why an oscillation grew under equal steps, and shorter ones; None if they were short enough for the start."""
    assert settings.dt0 is not None and isinstance(settings.method, Splitting)
    if trajectory.model.m:
        return None
    t, *y = jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v))
    rates = np.linalg.eigvals(np.asarray(_jacobian(trajectory.model, jnp.asarray(t), y)))
    rate = float(np.max(np.abs(np.imag(rates)), initial=0.0))
    pace = 1.0 if settings.method.pace is None else float(settings.method.pace(t, y[0], trajectory.params))
    most, turned = STABLE if settings.method.order > 2 else STABLE_OF_ORDER_2, float(settings.dt0) * pace * rate
    if not turned > most:
        return None
    return (
        f"steps of {float(settings.dt0) * pace:.3g}, in which the fastest oscillation at the start, of the period "
        f"{2 * np.pi / rate:.3g}, turns by {turned:.2g} radians: above {most:g} it grows",
        f"dt0={most / 2 / rate / pace:.2g}; or method=lj.Gauss(2, newton=True)",
    )


def _rounded_up(count: int):
    """A count rounded up to two digits."""
    unit = 10 ** max(0, int(np.log10(count)) - 1)
    return int(-(-count // unit) * unit)


def _attempts(trajectory: Trajectory, settings: Settings):
    """`attempt(t0, t1, y)` -> (state, error), its order, where the motion ended, and the direction of time."""
    model, params, end = trajectory.model, trajectory.params, trajectory.end
    method = method_alone(settings, method_of(settings, model))
    terms = diffrax.ODETerm(Field(equations_of(model)))
    # Tolerances from the start: near a singularity sizes differ from those at the start.
    first = State(*jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v)), params)
    at_start = _on_path(model, first.t, (first.q, first.v), 0.0)
    of_start = jax.jit(lambda first, ts, a: tolerances_at(first, ts, settings, a=a))
    tolerance = of_start(first._replace(params=None), trajectory.t, at_start)

    def attempt(t0, t1, y: PyTree):
        return _attempt(method, terms, jnp.asarray(t0), jnp.asarray(t1), y, params, tolerance)

    order = float(method.error_order(terms))
    return attempt, order, (float(end.t), (end.q, end.v)), np.sign(float(trajectory.t[-1] - end.t))


def last_steps(trajectory: Trajectory, settings: Settings) -> Steps:
    """Continue the motion from where it ended, and return each step."""
    attempt, order, (t, y), direction = _attempts(trajectory, settings)
    last = float(trajectory.t[-1])
    size = abs(t - float(trajectory.t[0])) / max(1, int(trajectory.stats["num_accepted_steps"]))
    size = size or 1e-3 * abs(last - t)
    taken_steps = []
    while len(taken_steps) < LOOKED_AT and abs(last - t) > 0:
        # The last step ends exactly at the last time.
        size = min(size, abs(last - t), float(settings.max_step))
        after, error = attempt(t, t + direction * size, y)
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
def _attempt(method: diffrax.AbstractSolver, terms: diffrax.AbstractTerm, t0, t1, y: PyTree, params: PyTree, tolerance):
    """One step, and its error in units of the tolerance."""
    after, error, _, _, result = method.step(terms, t0, t1, y, params, method.init(terms, t0, t1, y, params), True)

    def rows(tree: PyTree):
        return jnp.abs(coordinates.flatten(tree)[0]).reshape(2, -1)

    allowed = of_a_step(jnp.maximum(rows(y), rows(after)), tolerance)
    largest = jnp.max(rows(error) / jnp.where(allowed > 0, allowed, 1.0))
    return after, jnp.where((result == diffrax.RESULTS.successful) & jnp.isfinite(largest), largest, jnp.inf)


class _Path:
    """Velocities and accelerations along the motion and along the parabola through a state."""

    def __init__(self, trajectory: Trajectory):
        self.model, self.names = trajectory.model, trajectory.model.names
        self.in_dict = isinstance(trajectory.end.q, dict)
        t, *y = jax.tree.map(lambda x: x[0], (trajectory.t, trajectory.q, trajectory.v))
        span = abs(float(trajectory.end.t - trajectory.t[0]))
        # The largest velocity and acceleration that the start and the way so far account for.
        a, u = np.max(np.abs(self.at(t, y, 0.0))), np.max(np.abs(self.velocity(y)))
        x, x1 = (np.asarray(coordinates.flatten(part)[0]) for part in (y[0], trajectory.end.q))
        moved = np.max(np.abs(x1 - x))
        pace = max(u, np.sqrt(a * moved), moved / span if span > 0 else 0.0)
        self.usual = pace, max(a, pace**2 / max(np.max(np.abs(x)), moved, 1e-300))

    def at(self, t, y: PyTree, s):
        """The acceleration at t + s, q + s v + s² a/2, v + s a."""
        return np.asarray(_on_path(self.model, jnp.asarray(t), y, jnp.asarray(s, dtype=float)))

    def velocity(self, y: PyTree):
        """The velocities of a state, (n,)."""
        return np.asarray(coordinates.flatten(y[1])[0])

    def rates(self, t, y: PyTree):
        """The eigenvalues of d(v, a)/d(q, v)."""
        return np.linalg.eigvals(np.asarray(_jacobian(self.model, jnp.asarray(t), y)))

    def largest(self, steps: Steps):
        """What is large at the last of the steps, in words."""
        a, v = np.abs(self.at(steps.t[-1], steps.y[-1], 0.0)), np.abs(self.velocity(steps.y[-1]))
        if not a.size or not np.all(np.isfinite(a)):
            return ""
        i, k = int(np.argmax(v)), int(np.argmax(a))
        return (
            f"The largest velocity there is that of '{self.names[i]}', {v[i]:.2g}, the largest acceleration that of "
            f"'{self.names[k]}', {a[k]:.2g}."
        )


@jitted
def _on_path(model: Model, t, y: PyTree, s):
    q, v = y
    a, _ = equations_of(model).accelerations(t, q, v)
    place = jax.tree.map(lambda q, v, a: q + s * v + 0.5 * s**2 * a, q, v, a)
    velocity = jax.tree.map(lambda v, a: v + s * a, v, a)
    return model.vector(equations_of(model).accelerations(t + s, place, velocity)[0])


@jitted
def _jacobian(model: Model, t, y: PyTree):
    def rates(z: PyTree):
        u = z[model.n :]
        a, _ = equations_of(model).accelerations(t, model.tree(z[: model.n]), model.tree(u))
        return jnp.concatenate([u, model.vector(a)])

    return jax.jacfwd(rates)(jnp.concatenate(model.vectors(*y)))


def _singularity(path: _Path, steps: Steps, mass: IndefiniteMass | None):
    """Velocities or accelerations that have grown without bound, or that grow while steps shrink."""
    kept = steps.kept if steps.kept.size else np.array([0])

    def sizes(i):
        return (np.abs(path.velocity(steps.y[i])), np.abs(path.at(steps.t[i], steps.y[i], 0.0)))

    first, last, limit = sizes(kept[0]), sizes(kept[-1]), steps.t[kept[-1]]
    if not all(np.all(np.isfinite(x)) and x.size for x in last):
        return None
    lengths = np.abs(steps.h[kept])
    shrinks = len(kept) >= 6 and lengths[-1] < SHRANK * lengths[0] and np.mean(np.diff(lengths) < 0) > 0.8
    grows = [np.max(x) > GREW * np.max(x0) for x, x0 in zip(last, first)]
    blown_up = [np.max(x) > many * usual > 0 for x, many, usual in zip(last, BLOWN_UP, path.usual)]
    if not (any(blown_up) or shrinks and any(grows)):
        return None
    if shrinks:
        # Steps in a geometric series converge to its limit.
        ratio = min(np.median(lengths[1:] / lengths[:-1]), 1 - 1e-9)
        limit += np.sign(steps.h[kept[-1]]) * lengths[-1] / (1 - ratio)
    of_velocity = blown_up[0] or not any(blown_up) and grows[0]
    which = last[0] if of_velocity else last[1]
    i = int(np.argmax(which))
    what = "velocity" if of_velocity else "acceleration"
    usual = path.usual[0 if of_velocity else 1]
    # Where M is negative from the start on, as with a relativistic time, it may be meant.
    also, fix = ("", "") if mass is None else (f". L has {mass.cause}", f". If that is not meant: {mass.fix}")
    return (
        f"a singularity of the motion: the {what} of '{path.names[i]}' grows without bound as t -> {limit:.6g}; it is "
        f"{which[i]:.2g} already, where the start and the way so far have {usual:.2g}{also}",
        f"ts that end before {limit:.6g}" + (_event(path, i, usual) if of_velocity else "") + fix,
    )


def _event(path: _Path, i, usual):
    """An event where a velocity has grown a hundred times, in the user's names."""
    name = path.names[i]
    if not (path.in_dict and name.isidentifier() or name == "q" or name.startswith("q[")):
        return ""
    entry = f'v["{name}"]' if path.in_dict else f"v{name[1:]}"
    guard = f"lambda t, q, v, params: {100 * usual:.2g} - abs({entry})"
    return f', or an event on the way there, events={{"near": lj.Crossing({guard})}}'


def _jump(trajectory: Trajectory, settings: Settings, steps: Steps) -> tuple[str, str] | None:
    """Comparisons in the forces, where steps were rejected and these are taken as they come."""
    rejected, end = int(np.sum(~steps.accepted)), trajectory.end
    if settings.jumps != "ignored" or not rejected:
        return None
    jumps = jumps_found(trajectory.model, State(end.t, end.q, end.v, trajectory.params))
    if jumps is None:
        return None
    return (
        f"forces that jump or have a kink, with {'; '.join([*jumps.in_words(), *jumps.missed])}; {rejected} of "
        f"{len(steps.h)} steps were rejected",
        'jumps="found", the default, by which each is the end of a step',
    )


def _undefined(path: _Path, steps: Steps):
    """Accelerations that are not finite just beyond the last state."""
    t, y, h = steps.t[-1], steps.y[-1], float(steps.h[-1])
    beyond = path.at(t, y, h)
    if np.all(np.isfinite(beyond)) or not np.all(np.isfinite(path.at(t, y, 0.0))):
        return None
    name = path.names[int(np.argmax(~np.isfinite(beyond)))]
    return (
        f"the acceleration of '{name}' is {beyond[~np.isfinite(beyond)][0]} at t = {t + h:.9g}, {abs(h):.1g} beyond",
        "an L that is defined there (a root or a logarithm of what becomes negative); or ts, or an event, that end "
        "before",
    )


def _fast(path: _Path, steps: Steps, implicit: bool):
    """Find eigenvalues that are large compared with one over a step; decay does not limit an implicit method."""
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
        if implicit or -fastest.real * step < UNSTABLE:
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
        return cause, "a looser rtol and atol"
    return (
        f"{cause}: a stiff spring, or another high frequency on top of the motion",
        "a constraint in place of the stiff spring, or, where that oscillation does not matter, "
        "method=lj.Radau5(step_powers=(0, 1)), which does not follow it",
    )
