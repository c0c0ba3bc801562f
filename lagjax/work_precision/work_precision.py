"""Error against run time of several methods on a user's system: check, compile, solve, time, compare."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import diffrax
import jax
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.integrate import Crossing, Trajectory, arguments, ended_well, integrate, message
from lagjax.jaxtools import is_eager, is_traced
from lagjax.numerics import evaluations_a_step
from lagjax.system import System, by_name, check_system, coordinates
from lagjax.work_precision import references
from lagjax.work_precision.methods import chosen, ladder
from lagjax.work_precision.programs import ComparedMotion, TimedProgram, Times, interleaved_times, without_overhead
from lagjax.work_precision.references import Compared, ComparedStates, KnownAnswer, Reference
from lagjax.work_precision.result import Curve, Point, WorkPrecision

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
    unknown = [name for name in options if name not in OPTIONS]
    if unknown:
        raise TypeError(
            f"work_precision() has no argument {unknown[0]!r}.\n"
            f"Fix: of integrate's arguments it takes {', '.join(OPTIONS)}; rtol is its tolerances=."
        )
    if not is_eager() or is_traced((q0, v0, params, ts)):
        raise TypeError("work_precision measures times, but it is being traced.\nFix: call it outside jit.")
    ts = np.asarray(arguments.vector_of_times(ts))
    start = coordinates.state(ts[0], q0, v0, params)
    return ComparedMotion(system, start, arguments.times(ts, start.t.dtype), {**options, "events": events})


def _check(reference: Any, error: Any, others: Any, events: Mapping[str, Crossing] | None):
    if reference is not None and error is not None:
        raise ValueError("reference and error are two ways to define the error.\nFix: leave one of them out.")
    if reference is not None and not isinstance(reference, (Trajectory, tuple, list)) and not callable(reference):
        raise TypeError(
            f"reference is of type {type(reference).__name__}, which cannot be compared with.\n"
            f"Fix: {references.FIX_OF_FORM}."
        )
    if others and events:
        raise ValueError("others have no events to compare.\nFix: leave out events, or others.")


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
