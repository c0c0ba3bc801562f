"""The least time for an error, over longer and longer horizons: from when on equal steps win.

A method that adapts its steps changes the energy a little in each, so that its phase runs away as the square of time N;
where a symplectic method keeps the energy, as N. So for one error at the end the time of a method of order p grows as

    N^(1 + 2/p) with steps that adapt        N^(1 + 1/p) with equal, symplectic steps

in the long run. The first has the lower cost of a step and longer steps where the motion is slow. Which takes less time
at some horizon is measured: at each, a method goes from rough to fine until its error is small enough.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, §X.3 (growth of errors).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import diffrax
import numpy as np
from jaxtyping import ArrayLike, PyTree

from lagjax.display import plots as plot
from lagjax.integrate import Trajectory, arguments, ended_well, is_suited
from lagjax.jaxtools import is_eager, is_traced
from lagjax.numerics import EqualSteps, Gauss, Radau5, Splitting
from lagjax.system import State, System, by_name, check_system, coordinates, model_of
from lagjax.work_precision.methods import as_code, usual_methods
from lagjax.work_precision.programs import ComparedMotion, TimedProgram, seconds_of
from lagjax.work_precision.references import compared_of, computed_reference, given_reference
from lagjax.work_precision.result import in_ms, table

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
    if not is_eager() or is_traced((q0, v0, params)):
        raise TypeError("horizons measures times, but it is being traced.\nFix: call it outside jit.")
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
    if not 0 < error < 1:
        raise ValueError(f"error is relative, between 0 and 1, not {error!r}.\nFix: error=1e-3.")
    if methods is not None and (isinstance(methods, (str, dict)) or not isinstance(methods, Iterable)):
        raise TypeError(
            "methods must be a sequence of solvers and methods of equal steps.\n"
            "Fix: methods=[lj.Nystrom12(), lj.Gauss(4)], or leave it out."
        )
    if methods is not None and not list(methods):
        raise ValueError("methods is empty: there is nothing to compare.\nFix: leave it out.")
    for method in methods or ():
        arguments.check_method(method)
        if not isinstance(method, (EqualSteps, diffrax.AbstractAdaptiveSolver)):
            raise TypeError(
                f"{type(method).__name__} does not estimate its error, so no tolerance sets its steps.\n"
                "Fix: leave it out, or leave methods out."
            )
    if reference is not None and not callable(reference):
        raise TypeError(
            "reference must be a function of times, since horizons differ.\n"
            "Fix: reference=lambda ts: (q, v), or leave it out."
        )
    return ends
