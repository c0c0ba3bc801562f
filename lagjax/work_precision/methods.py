"""The compared methods: chosen and checked, as compiled programs; and alternatives to lagjax.

**Programs.** The program takes tolerance, times and start as arguments, so one compilation serves a method at all
tolerances. It is the program that a plain call of `integrate` runs, without the checks around it.

**Alternatives**: bare diffrax and SciPy, with accelerations derived by hand. Each function takes `acceleration(t, q, v,
params)` and a motion, and returns a function of a tolerance that integrates the motion and returns the states at `ts`
and the number of evaluations: an entry of `others` of `lj.work_precision`. SciPy calls the compiled acceleration from
Python.
"""

import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple, cast

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.contexts import REGULAR_FIRST
from lagjax.integrate import Trajectory, arguments, integrate, nystrom_for, reporting, runs_backward
from lagjax.jaxtools import compiler_options, hashable_partition, kinds, program_of, to_jax
from lagjax.mechanics import is_free_of_velocities
from lagjax.numerics import Dopri8, EqualSteps, Nystrom, Tsit5
from lagjax.refusals import PACKAGES, must
from lagjax.system import State, System, model_of

# From too loose for high orders to show, to where round-off dominates.
LADDERS = {
    np.dtype("float64"): tuple(10.0**-k for k in range(3, 13)),
    np.dtype("float32"): (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5),
}
# The tolerance of a computed reference.
TIGHTEST = {np.dtype("float64"): 1e-13, np.dtype("float32"): 2e-6}
FIX = 'methods={"Dopri8": lj.Dopri8(), "Tsit5": lj.Tsit5()}, or leave it out'


def usual_methods(system: System, start: State) -> dict[str, diffrax.AbstractSolver]:
    """The explicit methods that suit a system, starting with the default of `integrate`."""
    by_stages: dict[str, diffrax.AbstractSolver] = {"Dopri8": Dopri8(), "Tsit5": Tsit5()}
    model = model_of(system, *start)
    if not is_free_of_velocities(model):
        return by_stages
    default = nystrom_for(model)
    return {type(default).__name__: default} | by_stages


def chosen(methods: Any, system: System, start: State) -> dict[str, diffrax.AbstractSolver]:
    """The methods by name; raise if one is not an adaptive solver for this system."""
    if methods is None:
        return usual_methods(system, start)
    if isinstance(methods, (str, diffrax.AbstractSolver, type)) or not isinstance(methods, Iterable):
        fix = f"methods=[{as_code(methods)}]" if isinstance(methods, diffrax.AbstractSolver) else FIX
        must(False, "methods must be a sequence of solvers, or a dict of them by name", methods, fix, error=TypeError)
    named = dict(methods) if isinstance(methods, Mapping) else _named(methods)
    must(named, "methods must hold something to compare", methods, "leave it out")
    for name, method in named.items():
        _check(name, method, system, start)
    return named


def _named(methods: Any):
    named = {}
    for method in methods:
        name = type(method).__name__
        again = sum(key.split(" ")[0] == name for key in named)
        named[f"{name} ({again + 1})" if again else name] = method
    return named


def _check(name: str, method: Any, system: System, start: State):
    if method is None:
        raise TypeError(f"method {name!r} is None.\nFix: leave methods out; the comparison then includes the default.")
    if isinstance(method, EqualSteps):
        raise TypeError(
            f"method {name!r} makes steps of equal length, which no tolerance sets.\n"
            "Fix: lj.horizons(system, q0, v0, params, period=period), which compares it over many periods."
        )
    if isinstance(method, diffrax.AbstractSolver) and not isinstance(method, diffrax.AbstractAdaptiveSolver):
        kind = type(method).__name__
        by_halves = method.term_structure is diffrax.AbstractTerm
        raise TypeError(
            f"method {name!r} is diffrax's {kind}, which does not estimate its error, so no tolerance sets its steps.\n"
            "Usual cause: a method for fixed steps in a comparison at tolerances.\n"
            + (f"Fix: leave it out, or diffrax.HalfSolver(diffrax.{kind}())." if by_halves else "Fix: leave it out.")
        )
    try:
        arguments.check_method(method)
    except TypeError as error:
        raise TypeError(f"method {name!r}: {error}") from None
    if isinstance(method, Nystrom) and not is_free_of_velocities(model_of(system, *start)):
        cause = "there are constraints" if system.constraints else "these do depend on them"
        raise ValueError(
            f"method {name!r} is for accelerations that do not depend on velocities, but {cause}.\n"
            "Usual cause: a list of methods written for another system.\n"
            "Fix: leave it out; methods=None takes those that suit the system."
        )


def ladder(tolerances: Any, dtype: Any) -> tuple[float, ...]:
    """The tolerances from loose to tight; raise if one is below round-off."""
    if tolerances is None:
        return LADDERS.get(np.dtype(dtype), (1e-1, 1e-2))
    try:
        found = np.atleast_1d(np.asarray(tolerances, float))
    except (TypeError, ValueError):
        found = np.zeros(())
    fix, cause = "tolerances=(1e-4, 1e-6, 1e-8)", "exponents instead of powers of ten"
    well = found.ndim == 1 and found.size and np.all(np.isfinite(found) & (found > 0))
    must(well, "tolerances must be a sequence of positive numbers", tolerances, fix, cause)
    for value in found:
        arguments.check_reach(value, "tolerances", np.dtype(dtype))
    return tuple(float(value) for value in sorted(set(found), reverse=True))


def as_code(method: Any) -> str:
    """A method as it is written in code."""
    package = PACKAGES.get(type(method).__module__.split(".")[0], "")
    return f"{package}{method!r}"


MAX_STEPS = 2**20


def usual_others(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray) -> dict[str, Callable]:
    """All alternatives by name."""
    motion = acceleration, q0, v0, params, np.asarray(ts)
    return {
        "diffrax, by hand": bare_diffrax(*motion),
        "DOP853, by hand": dop853(*motion),
        "LSODA, by hand": lsoda(*motion),
    }


def bare_diffrax(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray):
    """diffrax's Dopri8 and its own loop, compiled once."""
    start, params = jax.tree.map(lambda x: jnp.asarray(x, float), ((q0, v0), params))
    method = diffrax.Dopri8()
    stages = method.tableau.num_stages - method.tableau.fsal

    @jax.jit
    def solve(tolerance: float, start: Array, params: PyTree):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, params: (y[1], acceleration(t, *y, params))),
            method,
            ts[0],
            ts[-1],
            None,
            start,
            params,
            saveat=diffrax.SaveAt(ts=ts),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=MAX_STEPS,
            throw=False,
        )
        q, v = cast(tuple, solution.ys)
        return q, v, stages * solution.stats["num_steps"]

    return lambda tolerance: solve(jnp.asarray(tolerance), start, params)


def dop853(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray):
    """`scipy.integrate.solve_ivp` with DOP853."""
    field, y0, as_states = _flat_problem(acceleration, q0, v0, params)

    def solve(tolerance: float):
        solution = scipy.integrate.solve_ivp(
            field, (ts[0], ts[-1]), y0, method="DOP853", t_eval=ts, rtol=tolerance, atol=tolerance
        )
        return *as_states(solution.y.T if solution.success else np.full((len(ts), len(y0)), np.nan)), solution.nfev

    return solve


def lsoda(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree, ts: np.ndarray):
    """`scipy.integrate.odeint`, which is LSODA."""
    field, y0, as_states = _flat_problem(acceleration, q0, v0, params)

    def solve(tolerance: float):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", scipy.integrate.ODEintWarning)
            options = {"tfirst": True, "rtol": tolerance, "atol": tolerance, "mxstep": MAX_STEPS}
            y, info = scipy.integrate.odeint(field, y0, ts, full_output=True, **options)
        well = info["message"] == "Integration successful."
        return *as_states(y if well else np.full_like(y, np.nan)), int(info["nfe"][-1])

    return solve


def _flat_problem(acceleration: Callable, q0: PyTree, v0: PyTree, params: PyTree):
    """The vector field for flat vectors, the start as a vector, and a function from rows of vectors to (q, v)."""
    y0, unravel = ravel_pytree(jax.tree.map(lambda x: jnp.asarray(x, float), (q0, v0)))

    @jax.jit
    def rates(t: ArrayLike, y: Array):
        q, v = unravel(y)
        return ravel_pytree((v, acceleration(t, q, v, params)))[0]

    return lambda t, y: np.asarray(rates(t, y)), np.asarray(y0), jax.jit(jax.vmap(unravel))


# Seconds of measuring after which a call is not repeated; a single call that takes longer is timed twice, unless it is
# very long.
ENOUGH, VERY_LONG = 0.05, 0.2
# A shorter call is made once before it is timed, since caches are cold after another program.
SHORT = 0.02
# Times below this fraction of the call of an empty program cannot be distinguished from zero.
RESOLVED = 0.1


class ComparedMotion(NamedTuple):
    """The motion to integrate: `start` has the first time; `options` are those of `integrate`, including events."""

    system: System
    start: State
    ts: np.ndarray
    options: Mapping[str, Any]


class TimedProgram:
    """The trajectory of a motion by one method, as a function of (tolerance, ts, q, v); the number of times is fixed.
    For a method of equal steps the tolerance is the length of a step.

    `compile_seconds` is the time of tracing and compiling; motions that differ in nothing but numbers share a program,
    and its time. Like `integrate`, the program first assumes that the
    equations are regular; if they turn out singular, the robust program is compiled, too, and used from then on.
    """

    def __init__(self, motion: ComparedMotion, method: Any):
        self._motion, self._method = motion, method
        self.compile_seconds = 0.0
        self._compiled = self._compile(robust=False)

    def __call__(self, tolerance: ArrayLike, ts: Array | None = None, q: PyTree = None, v: PyTree = None) -> Trajectory:
        """Solve; by default from the motion's start, with outputs at its own times."""
        args = self._arguments(tolerance, ts, q, v)
        trajectory, regular = self._compiled(args)
        if regular is not None and not bool(regular):
            self._compiled = self._compile(robust=True)
            trajectory, _ = self._compiled(args)
        return jax.block_until_ready(trajectory)

    def at(self, ts: np.ndarray) -> "TimedProgram":
        """The same compiled program, with outputs at as many other times."""
        other = copy(self)
        other._motion = self._motion._replace(ts=ts)
        return other

    def call(self, tolerance: ArrayLike) -> Callable[[], Any]:
        """The bare call, for timing; the caller has to wait for the result."""
        args = self._arguments(tolerance)
        return lambda: self._compiled(args)

    def call_seconds(self) -> float:
        """The least time of a call of an empty program with the same arguments and results."""
        args = self._arguments(1e-3)

        def zeros(args: Sequence[Array]):
            return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), self._returned)

        idle = jax.jit(zeros).lower(args).compile()
        return min(seconds_of(lambda: idle(args)) for _ in range(50))

    def _arguments(self, tolerance: ArrayLike, ts: Any = None, q: PyTree = None, v: PyTree = None):
        start = self._motion.start
        ts = self._motion.ts if ts is None else ts
        given = (np.asarray(tolerance, ts.dtype), ts, start.q if q is None else q, start.v if v is None else v)
        return [to_jax(x) for x in hashable_partition((*given, start.params))[0]]

    def _compile(self, robust: bool):
        motion, given = self._motion, (np.asarray(0.0, self._motion.ts.dtype), self._motion.ts, *self._motion.start[1:])
        _, static = hashable_partition(given)
        # Decreasing times must be known at compile time.
        backward = motion.ts if runs_backward(motion.ts) else None

        def solve(args: Sequence[Array]):
            tolerance, ts, q, v, params = static.combine(args)
            steps = {"dt0" if isinstance(self._method, EqualSteps) else "rtol": tolerance}
            return integrate(
                motion.system, q, v, params, ts=ts if backward is None else backward, method=self._method,
                throw=False, **steps, **motion.options,
            )  # fmt: skip

        def program(args: Sequence[Array]):
            trajectory, _, regular = reporting(solve)(args)
            return trajectory, regular

        def made():
            started = time.perf_counter()
            with REGULAR_FIRST(not robust):
                lowered = jax.jit(program, compiler_options=compiler_options()).lower(self._arguments(1e-3))
            return lowered.compile(), lowered.out_info, time.perf_counter() - started

        constants, rest = hashable_partition((motion.system, self._method, motion.options, backward))
        key = TimedProgram, rest, static, robust, kinds(self._arguments(1e-3))
        # Numbers that are not arguments are constants of a program, which no other motion may share.
        compiled, self._returned, seconds = made() if constants else program_of(key, made)
        self.compile_seconds += seconds
        return compiled


def seconds_of(call: Callable[[], Any]) -> float:
    """The time of one call, until its result is ready."""
    started = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - started


class Times(NamedTuple):
    """Seconds of a call: the median and the minimum."""

    median: float
    least: float


def interleaved_times(calls: Sequence[Callable[[], Any]], first: Sequence[float], repeats: int) -> list[Times]:
    """Times of calls made in turn, so that other load on the machine affects all of them equally.

    `first` are the seconds of an earlier call of each; long ones are not called again.
    """
    turns: list[list[float]] = [[seconds] if seconds > ENOUGH else [] for seconds in first]
    for _ in range(repeats):
        for call, seconds in zip(calls, turns):
            if sum(seconds) <= ENOUGH or len(seconds) == 1 and seconds[0] <= VERY_LONG:
                if not seconds or seconds[-1] < SHORT:
                    jax.block_until_ready(call())
                seconds.append(seconds_of(call))
    # The lower of two medians: disturbances only make a call longer.
    return [Times(float(np.percentile(seconds, 50, method="lower")), min(seconds)) for seconds in turns]


def without_overhead(seconds: float, call_seconds: float) -> float:
    """The time of the solve itself: a measured time without the overhead of the call."""
    return max(seconds - call_seconds, RESOLVED * call_seconds)
