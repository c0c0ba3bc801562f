"""A solve by one method as a compiled program, and the time that calls take.

The program takes tolerance, times and start as arguments, so one compilation serves a method at all tolerances. It is
the program that a plain call of `integrate` runs, without the checks around it.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.integrate import Trajectory, integrate, reporting, runs_backward
from lagjax.jaxtools import REGULAR_FIRST, compiler_options, hashable_partition, kinds, program_of, to_jax
from lagjax.numerics import EqualSteps
from lagjax.system import State, System

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
