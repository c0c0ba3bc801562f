"""Error against run time of several methods on a user's system: check, compile, solve, time, compare.

**Over longer and longer horizons**: the least time for an error, and from when on equal steps win.

A method that adapts its steps changes the energy a little in each, so that its phase runs away as the square of time N;
where a symplectic method keeps the energy, as N. So for one error at the end the time of a method of order p grows as

    N^(1 + 2/p) with steps that adapt        N^(1 + 1/p) with equal, symplectic steps

in the long run. The first has the lower cost of a step and longer steps where the motion is slow. Which takes less time
at some horizon is measured: at each, a method goes from rough to fine until its error is small enough.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §X.3 (growth of errors).
"""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.display import plots as plot
from lagjax.display import table
from lagjax.integrate import Crossing, Trajectory, arguments, ended_well, integrate, is_suited, message
from lagjax.numerics import EqualSteps, Gauss, Radau5, Splitting, evaluations_a_step
from lagjax.refusals import must, must_be, must_be_function, must_have_values, must_name, must_not_meet
from lagjax.system import State, System, by_name, check_system, coordinates, model_of
from lagjax.work_precision import references
from lagjax.work_precision.methods import (
    ComparedMotion,
    TimedProgram,
    Times,
    as_code,
    chosen,
    interleaved_times,
    ladder,
    seconds_of,
    usual_methods,
    without_overhead,
)
from lagjax.work_precision.references import (
    Compared,
    ComparedStates,
    KnownAnswer,
    Reference,
    compared_of,
    computed_reference,
    given_reference,
)
from lagjax.work_precision.result import Curve, Point, WorkPrecision, in_ms

# The options of `integrate` that mean the same for every method.
OPTIONS = ("max_step", "jump_ts", "drift", "max_steps")
# An error is trusted if it is this many times the possible error of the reference.
TRUSTED_FROM = 2
UNTIMED = Times(float("nan"), float("nan"))


@by_name("lj.work_precision(system, q0, v0, params, ts=ts)", "ts")
def work_precision(
    system: System,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    ts: Array | np.ndarray | Sequence[float],
    methods: Sequence[diffrax.AbstractSolver] | Mapping[str, diffrax.AbstractSolver] | None = None,
    tolerances: Sequence[float] | None = None,
    events: Mapping[str, Crossing] | None = None,
    reference: Trajectory | tuple[PyTree, PyTree] | Callable | None = None,
    error: Callable[[Any], float] | None = None,
    others: Mapping[str, Callable] | None = None,
    repeats: int = 15,
    patience: float = 30.0,
    patience_with_others: float = 30.0,
    **options: Any,
) -> WorkPrecision:
    """Compare methods on one motion: the error of each at each tolerance, and its cost.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2)
    >>> exact = lambda ts: (jnp.cos(2 * ts), -2 * jnp.sin(2 * ts))
    >>> found = work_precision(spring, 1.0, 0.0, {"k": 4.0}, ts=[0.0, 20.0], methods=[lj.Tsit5()], reference=exact)
    >>> print(found.best(error=1e-6)[0].name, found.best(error=1e-6)[0].error < 1e-6, found.reference.agrees)
    Tsit5 True True

    `print(found)` shows a table, `found.plot()` draws it, `found.best(error=1e-6)` recommends methods and tolerances.

    **Main arguments:**

    - `system`, `q0`, `v0`, `params`, `ts`: as `integrate` takes them. A motion that takes less than ten times the
      overhead of a call says little about methods: make `ts` long.
    - `methods`: solvers with an error estimate, of lagjax or diffrax, in a sequence or by name in a dict. By default
      the explicit ones that suit the system, starting with the default of `integrate`; for a stiff system add
      `lj.Radau5()`.
    - `tolerances`: each is used as rtol, by other tools also as atol; by default decades from 1e-3 to 1e-12 in float64.
    - `events`: as `integrate` takes them. If one ends the motion, errors are those of its time and of the state there;
      else those of the states at `ts`, and of the times of crossings. An error between two times of `ts` is not seen.
    - `reference`: the right answer: a `Trajectory` at `ts`, states `(q, v)` with a row for each time, or a function
      of times that returns these. By default two methods of different kinds at 1e-13; if they do not agree, the result
      says how many digits can be trusted.

    **Other arguments:**

    - `error`: a function of a `Trajectory` (for `others`, of an object with `t`, `q`, `v`, `params`) that returns the
      error as one number, instead of the comparison with a reference.
    - `others`: by name, functions of a tolerance that solve the same problem with another tool, for comparison: each
      returns `(q, v, evaluations)`, the states at `ts` and the number of evaluations of the accelerations, or None.
    - `repeats`: how often each solve is timed; the median is kept. A long solve is repeated less.
    - `patience`, `patience_with_others`: if a solve takes more seconds than this, tighter tolerances are not tried.
    - `options`: `max_step`, `jump_ts`, `drift` and `max_steps` of `integrate`.

    **Returns:** a `WorkPrecision`.

    **Raises:**

    - `TypeError`, `ValueError` for methods without an error estimate or that do not suit the system, tolerances below
      round-off, a reference that does not fit; for everything that `integrate` refuses.
    - `RuntimeError` if no method reaches the end of the motion.

    Times are those of the compiled solve; the overhead of a call and the time of compiling are given separately. A
    failed point stays in the table with its reason.

    Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.10 (work-precision diagrams); `tests/comparison` checks
    the orders and the marks.
    """
    motion = _motion(system, q0, v0, params, ts, events, options)
    solvers = chosen(methods, system, motion.start)
    tolerances = ladder(tolerances, motion.ts.dtype)
    _check(reference, error, others, events)
    programs = {name: TimedProgram(motion, solver) for name, solver in solvers.items()}
    solved = []
    for name, program in programs.items():
        solved += _solves_of_program(name, program, tolerances, patience)
    if not any(solve.ended_well for solve in solved):
        raise _all_failed(motion, solved, tolerances)
    known = None
    if error is None and reference is None:
        known = references.computed_reference(motion, programs, solvers)
    elif error is None:
        known = references.given_reference(reference, motion, next(iter(programs.values())))
    for name, solve in (others or {}).items():
        solved += _solves_of_other(motion, name, solve, tolerances, patience_with_others)
    judged = None if known is None else known.judged(_tightest(motion, solved))
    call_seconds = next(iter(programs.values())).call_seconds()
    points = _points(motion, solvers, solved, known, judged, error, call_seconds, repeats)
    return WorkPrecision(
        curves={
            name: Curve(
                name,
                solvers.get(name),
                programs[name].compile_seconds if name in programs else float("nan"),
                tuple(point for point in points if point.method == name),
            )
            for name in (*solvers, *(others or {}))
        },
        reference=judged,
        measured=references.in_words(events, len(motion.ts)) if error is None else "as given by error=",
        call_seconds=call_seconds,
    )


class Solve(NamedTuple):
    """One solve: its result (None if it was not tried), the number of evaluations, and the call to be timed."""

    method: str
    tolerance: float
    found: Any
    evaluations: int | None
    reason: str
    call: Callable
    seconds: float

    @property
    def ended_well(self) -> bool:
        if isinstance(self.found, Trajectory):
            return bool(ended_well(self.found.result))
        return self.found is not None and all(np.isfinite(x).all() for x in jax.tree.leaves(self.found[1:3]))


def _motion(
    system: System,
    q0: PyTree,
    v0: PyTree,
    params: PyTree,
    ts: np.ndarray,
    events: Mapping[str, Crossing] | None,
    options: dict[str, Any],
):
    """The motion, with its start as arrays; raise if the arguments do not define one."""
    check_system(system, q0, v0, params)
    fix = "leave it out; rtol is its tolerances="
    must_name(options, OPTIONS, "work_precision() was given", "argument of it", fix, error=TypeError)
    must_have_values((q0, v0, params, ts), "work_precision measures times", "call it outside jit", eager=True)
    ts = np.asarray(arguments.vector_of_times(ts))
    start = coordinates.state(ts[0], q0, v0, params)
    return ComparedMotion(system, start, arguments.times(ts, start.t.dtype), {**options, "events": events})


def _check(reference: Any, error: Any, others: Any, events: Mapping[str, Crossing] | None):
    must_not_meet({"reference": reference, "error": error}, "they are two ways to define the error")
    if not callable(reference):
        claim = "reference must be something to compare with"
        must_be(Trajectory | tuple | list | None, reference, claim, references.FIX_OF_FORM)
    must_not_meet({"others": others or None, "events": events or None}, "others have no events to compare")


def _solves_of_program(name: str, program: TimedProgram, tolerances: Sequence[float], patience: float):
    """The solves of a method, from loose to tight."""
    solves, slow = [], ""
    for tolerance in tolerances:
        if slow:
            solves.append(Solve(name, tolerance, None, None, slow, program.call(tolerance), 0.0))
            continue
        started = time.perf_counter()
        found = program(tolerance)
        seconds = time.perf_counter() - started
        solves.append(Solve(name, tolerance, found, None, message(found.result), program.call(tolerance), seconds))
        slow = _too_slow(seconds, patience)
    return solves


def _solves_of_other(motion: ComparedMotion, name: str, solve: Callable, tolerances: Sequence[float], patience: float):
    """The solves of another tool, after one call that lets it compile."""
    solves, slow = [], ""
    solve(tolerances[0])
    for tolerance in tolerances:
        call = partial(solve, tolerance)
        if slow:
            solves.append(Solve(name, tolerance, None, None, slow, call, 0.0))
            continue
        started = time.perf_counter()
        q, v, evaluations = jax.tree.map(np.asarray, call())
        seconds = time.perf_counter() - started
        found = ComparedStates(motion.ts, q, v, motion.start.params)
        evaluations = None if evaluations is None else int(evaluations)
        done = Solve(name, tolerance, found, evaluations, "successful", call, seconds)
        solves.append(done if done.ended_well else done._replace(reason="failed"))
        slow = _too_slow(seconds, patience)
    return solves


def _too_slow(seconds: float, patience: float):
    return "" if seconds <= patience else f"not tried: the last took {seconds:.1f} s"


def _all_failed(motion: ComparedMotion, solved: Any, tolerances: Sequence[float]):
    """The error to raise if every solve failed, with the message of `integrate` if that fails, too."""
    reasons = "; ".join(dict.fromkeys(f"{solve.method}: {solve.reason}" for solve in solved))
    cause = ""
    try:
        integrate(motion.system, *motion.start[1:], ts=motion.ts, rtol=tolerances[0], **motion.options)
    except (ValueError, RuntimeError) as error:
        cause = f"\nThe default method at {tolerances[0]:.0e}: {error}"
    return RuntimeError(f"no method reached the end of this motion at any tolerance. {reasons}{cause}")


def _tightest(motion: ComparedMotion, solved: Any) -> list[Compared]:
    """The tightest successful solves of two methods; the tightest two if there is only one method."""
    good = [solve for solve in solved if solve.ended_well and isinstance(solve.found, Trajectory)]
    good.sort(key=lambda solve: solve.tolerance)
    by_method = list({solve.method: solve for solve in reversed(good)}.values())
    by_method.sort(key=lambda solve: solve.tolerance)
    chosen = by_method if len(by_method) > 1 else good
    return [references.compared_of(solve.found, motion.options["events"]) for solve in chosen[:2]]


def _points(
    motion: ComparedMotion,
    solvers: Mapping[str, Any],
    solved: Any,
    known: KnownAnswer | None,
    judged: Reference | None,
    error: Any,
    call_seconds: float,
    repeats: int,
):
    """The point of each solve; the successful ones are timed, in turn."""
    good = [solve for solve in solved if solve.ended_well]
    measured = interleaved_times([solve.call for solve in good], [solve.seconds for solve in good], repeats)
    times = {(solve.method, solve.tolerance): seconds for solve, seconds in zip(good, measured)}
    return [
        _point(motion, solve, times, solvers, known, judged, error, call_seconds) for solve in solved
    ]  # fmt: skip


def _point(
    motion: ComparedMotion,
    solve: Solve,
    times: Any,
    solvers: Mapping[str, Any],
    known: KnownAnswer,
    judged: Reference,
    error: Any,
    call_seconds: float,
):
    events, found, reason = motion.options["events"], solve.found, solve.reason
    ours, distance = isinstance(found, Trajectory), float("inf")
    if solve.ended_well and known is None:
        distance = float(error(found))
    elif solve.ended_well:
        of_motion = references.compared_of(found, events)
        distance, reason = known.distance(of_motion), references.other_events(of_motion, known.right) or reason
    steps, evaluations = None, solve.evaluations
    if ours:
        steps, stages = int(found.stats["num_steps"]), evaluations_a_step(solvers[solve.method])
        evaluations = None if stages is None else stages * steps
    seconds = times.get((solve.method, solve.tolerance), UNTIMED)
    # The overhead of another tool's call counts as its own cost.
    overhead = call_seconds if solve.method in solvers else 0.0
    median, least = (without_overhead(x, overhead) for x in seconds)
    return Point(
        method=solve.method,
        tolerance=solve.tolerance,
        error=distance,
        trusted=judged is None or distance > TRUSTED_FROM * judged.error,
        seconds=median,
        least=least,
        steps=steps,
        evaluations=evaluations,
        result=reason,
        trajectory=found if ours else None,
    )


# Outputs in the last period: an error shows at one of them, whatever the phase is.
OUTPUTS = 8
# From rough to fine: tolerances, and the number of steps in a period.
TOLERANCES = tuple(10.0 ** (-k / 2) for k in range(4, 27))
STEPS = tuple(2.0 ** (k / 4) for k in range(6, 45))
# Nobody follows a motion for so many periods.
FAR = 1e8

# Compared by default, where they suit the system.
EQUAL = Splitting(6), Splitting(8), Gauss(4), Gauss(6)


class Needed(NamedTuple):
    """What a method needs for an error at a horizon: rtol or dt0, seconds, steps; infinite seconds if it cannot."""

    setting: float
    error: float
    seconds: float
    steps: int


class Win(NamedTuple):
    """From how many periods on a method of equal steps is the fastest, and its name.

    `measured`: whether that was seen; else it follows from the last horizon and from how times grow, N^(1 + 2/p) and
    N^(1 + 1/p).
    """

    periods: float
    name: str
    measured: bool


@dataclass(frozen=True, repr=False)
class Horizons:
    """What each method needs for an `error`, over longer and longer horizons; it prints and plots itself.

    - `solvers`: the methods by name. `rows`: by the number of periods and by the method's name, what it needs there:
      `setting` (its rtol or dt0), `error`, `seconds` (infinite if it did not get there) and `steps`.
    """

    solvers: dict[str, Any]
    rows: dict[float, dict[str, Needed]]
    error: float

    def best(self, periods: float) -> str:
        """The name of the fastest method over this horizon, one of `rows`."""
        row = self.rows[periods]
        return min(row, key=lambda name: row[name].seconds)

    @property
    def win(self) -> Win | None:
        """From when on equal steps win; None if never, or if no method of one of the two kinds reached the error."""
        if not self._has_both_kinds:
            return None
        equal = {end: self._fastest(end, True) for end in self.rows}
        adapting = {end: self._fastest(end, False) for end in self.rows}
        won = [end for end in self.rows if self.rows[end][equal[end]].seconds < self.rows[end][adapting[end]].seconds]
        last = list(self.rows)[-1]
        if last in won:
            lost = [end for end in self.rows if end not in won]
            first = min(end for end in self.rows if end > max(lost, default=0))
            return Win(first, equal[first], True)
        one, other = equal[last], adapting[last]
        slower = self.rows[last][one].seconds / self.rows[last][other].seconds
        gained = self._growth(other) - self._growth(one)
        if not np.isfinite(slower) or gained <= 0:
            return None
        return Win(float(last * slower ** (1 / gained)), one, False)

    @property
    def _has_both_kinds(self) -> bool:
        return {isinstance(solver, EqualSteps) for solver in self.solvers.values()} == {True, False}

    def _fastest(self, periods: float, equal: bool) -> str:
        row = self.rows[periods]
        kind = [name for name, solver in self.solvers.items() if isinstance(solver, EqualSteps) == equal]
        return min(kind, key=lambda name: row[name].seconds)

    def _growth(self, name: str) -> float:
        """The power of the number of periods with which the time grows."""
        solver = self.solvers[name]
        order = float(solver.error_order(diffrax.ODETerm(lambda t, y, args: y)))
        return 1 + (1 if isinstance(solver, EqualSteps) else 2) / order

    def plot(self, title: str = ""):
        """Draw the time that each method takes over the number of periods; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib.
        """
        ends = np.array([*self.rows], float)
        seconds = {name: np.array([row[name].seconds for row in self.rows.values()]) for name in self.solvers}
        return plot.growth(title, ("periods", f"seconds for an error of {self.error:g}"), ends, seconds)

    def __repr__(self):
        header = ("method", *(f"{end:g} periods" for end in self.rows))
        cells = [(name, *(_cell(row[name]) for row in self.rows.values())) for name in self.solvers]
        last = list(self.rows)[-1]
        needed, name = self.rows[last][self.best(last)], self.best(last)
        lines = [f"Milliseconds for an error of {self.error:g} (rtol, or dt0 of equal steps)", table(header, cells)]
        if self._has_both_kinds:
            lines.append(_in_words(self.win, last))
        if np.isfinite(needed.seconds):
            by = "dt0" if isinstance(self.solvers[name], EqualSteps) else "rtol"
            method = f"method={as_code(self.solvers[name])}, {by}={needed.setting:.2g}"
            lines.append(f"lj.integrate(system, q0, v0, params, ts=ts, {method}, max_steps=None)")
        return "\n".join(lines)


def _cell(needed: Needed) -> str:
    return f"{in_ms(needed.seconds)} ({needed.setting:.1e})" if np.isfinite(needed.seconds) else "-"


def _in_words(win: Win | None, last: float) -> str:
    if win is None:
        return "Equal steps do not win, however long the motion is."
    if win.measured:
        return f"From {win.periods:g} periods on {win.name} is the fastest."
    law = "N^(1 + 2/order) and N^(1 + 1/order)"
    adaptive = f"Up to {last:g} periods steps that adapt are faster, and by how times grow, {law},"
    if win.periods > FAR:
        return f"{adaptive}\nfar beyond a hundred million too (not measured)."
    return f"{adaptive}\nup to about {win.periods:.0e}; from there on {win.name} is (not measured)."


@by_name("lj.horizons(system, q0, v0, params, period=period)", "period")
def horizons(
    system: System,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    period: float,
    periods: Sequence[float] = (10, 100, 1000),
    error: float = 1e-3,
    methods: Sequence[Any] | None = None,
    reference: Callable | None = None,
    patience: float = 30.0,
) -> Horizons:
    """Find the method that reaches an error in the least time, over more and more periods.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * q**2)
    >>> exact = lambda ts: (jnp.cos(ts), -jnp.sin(ts))
    >>> both = [lj.Nystrom12(), lj.Splitting(8)]
    >>> found = horizons(spring, 1.0, 0.0, period=2 * jnp.pi, periods=(10, 100), methods=both, reference=exact)
    >>> print(all(needed.error < 1e-3 for row in found.rows.values() for needed in row.values()))
    True

    `print(found)` shows a table and says from which horizon on equal steps win; `found.plot()` draws it.

    **Arguments:**

    - `system`, `q0`, `v0`, `params`: as `integrate` takes them; the motion begins at t = 0.
    - `period`: about the time in which the motion comes back, `[t]`. Errors are those at 8 times in the last one.
    - `periods`: horizons, increasing. Where a motion amplifies errors, as chaotic ones do, no method reaches long ones.
    - `error`: that of states, relative to the largest values on the way: about the error of the phase in radians.
    - `methods`: solvers with an error estimate, and methods of equal steps. By default those that suit the system:
      the explicit ones, `lj.Gauss(4)`, `lj.Gauss(6)`, and `lj.Splitting(6)`, `lj.Splitting(8)` where it can be split.
    - `reference`: the right motion, a function of times that returns the states (q, v). By default two methods at
      1e-13, which agree to less than `error` over some ten thousand periods.
    - `patience`: if a solve takes more seconds than this, finer ones are not tried.

    **Returns:** `Horizons`.

    **Raises:** `TypeError`, `ValueError` for a period or horizons that are not positive and increasing, an error below
    what the reference is known to, and for everything that `integrate` refuses.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §X.3.
    """
    check_system(system, q0, v0, params)
    must_have_values((q0, v0, params), "horizons measures times", "call it outside jit", eager=True)
    ends = _checked(period, periods, error, methods, reference)
    start = coordinates.state(0.0, q0, v0, params)
    solvers = {_label(method): method for method in (_usual(system, start) if methods is None else methods)}
    options = {"events": None, "max_steps": None, "estimate_error": False}
    last = period * np.linspace(1 / OUTPUTS, 1.0, OUTPUTS)
    motion = ComparedMotion(system, start, np.append(0.0, period * (ends[0] - 1) + last).astype(start.t.dtype), options)
    programs = {name: TimedProgram(motion, solver) for name, solver in solvers.items()}
    kinds = usual_methods(system, start) | {"Radau5": Radau5()}
    rows, next_of = {}, dict.fromkeys(solvers, 0)
    for end in ends:
        motion = motion._replace(ts=np.append(0.0, period * (end - 1) + last).astype(start.t.dtype))
        here = {name: program.at(motion.ts) for name, program in programs.items()}
        if reference is None:
            adapting = {name: s for name, s in solvers.items() if not isinstance(s, EqualSteps)}
            known = computed_reference(motion, here, adapting or kinds)
        else:
            # Of a function neither the largest values nor the states need a program.
            known = given_reference(reference, motion, next(iter(here.values())))
        if known.error > error:
            raise ValueError(
                f"over {end:g} periods the reference is known to {known.error:.0e} only, and an error of {error:g} "
                "cannot be seen.\nUsual cause: a motion that amplifies errors, or a very long one.\n"
                "Fix: a shorter horizon, a larger error=, or an exact reference=."
            )
        row = {}
        for name, program in here.items():
            ladder = _ladder(solvers[name], period)
            next_of[name], row[name] = _needed(program, ladder, next_of[name], known, error, patience)
        rows[end] = row
    return Horizons(solvers, rows, error)


def _needed(program: TimedProgram, ladder: Sequence[float], first: int, known: Any, error: float, patience: float):
    """The place in the ladder from which on a method is within the error, and what it needs there."""
    for i in range(first, len(ladder)):
        found: list[Trajectory] = []
        taken = seconds_of(lambda: found.append(program(ladder[i])) or found[0].q)
        distance = known.distance(compared_of(found[0], None)) if bool(ended_well(found[0].result)) else np.inf
        if distance <= error:
            taken = min([taken] + [seconds_of(program.call(ladder[i])) for _ in range(2) if taken < patience / 10])
            return i, Needed(ladder[i], distance, taken, int(found[0].stats["num_steps"]))
        if taken > patience:
            break
    return len(ladder), Needed(np.nan, np.inf, np.inf, 0)


def _ladder(method: Any, period: float) -> Sequence[float]:
    """The settings of a method from rough to fine."""
    return [period / n for n in STEPS] if isinstance(method, EqualSteps) else TOLERANCES


def _label(method: Any) -> str:
    return method.label if isinstance(method, EqualSteps) else type(method).__name__


def _usual(system: System, start: State) -> list[Any]:
    """The methods that suit a system: the explicit ones, and those of equal steps."""
    model = model_of(system, *start)
    equal = [method for method in EQUAL if is_suited(method, model)]
    return [*usual_methods(system, start).values(), *equal]


def _checked(period: Any, periods: Any, error: Any, methods: Any, reference: Any) -> list[float]:
    """The horizons; raise if they, or the rest, do not say what to compare."""
    ends = [float(end) for end in np.atleast_1d(np.asarray(periods, float))]
    rising = all(a < b for a, b in pairwise(ends))
    if not (np.ndim(period) == 0 and 0 < period < np.inf and rising and ends and 1 <= ends[0] and ends[-1] < np.inf):
        raise ValueError(
            f"horizons are numbers of periods of a positive length, increasing, not {periods!r} of {period!r}.\n"
            "Fix: period=6.28, periods=(10, 100, 1000)."
        )
    must(0 < error < 1, "error is relative, and must be between 0 and 1", error, "error=1e-3")
    well = methods is None or isinstance(methods, Iterable) and not isinstance(methods, (str, dict))
    fix = "methods=[lj.Nystrom12(), lj.Gauss(4)], or leave it out"
    must(well, "methods must be a sequence of solvers and methods of equal steps", methods, fix, error=TypeError)
    must(methods is None or list(methods), "methods must hold something to compare", methods, "leave it out")
    for method in methods or ():
        arguments.check_method(method)
        if not isinstance(method, (EqualSteps, diffrax.AbstractAdaptiveSolver)):
            raise TypeError(
                f"{type(method).__name__} does not estimate its error, so no tolerance sets its steps.\n"
                "Fix: leave it out, or leave methods out."
            )
    fix = "reference=lambda ts: (q, v), or leave it out"
    must_be_function(reference, "reference", "times, since horizons differ", fix, optional=True)
    return ends
