"""Periodic orbits: a motion that comes back to its start, from a guess.

analyse the system  ->  one compiled search (`shooting.py`)  ->  raise or warn about what went wrong
"""

import warnings
from collections.abc import Iterable, Mapping
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.analysis import shooting
from lagjax.analysis.monodromy import any_problem_of, refuse_unfollowed, tolerance_of, user_system
from lagjax.analysis.shooting import OrbitRequest
from lagjax.display import labelled
from lagjax.integrate import RESULTS, Report, Switches, Trajectory, integrate, reported
from lagjax.jaxtools import HashablePart, hashable_partition, is_eager, is_traced, numpy_of, stop_gradient
from lagjax.mechanics import describe
from lagjax.refusals import must, must_be_single, must_name
from lagjax.system import Held, Hybrid, State, System, coordinates

POINTS = 401


class PeriodicOrbit(eqx.Module):
    """A motion that comes back to its start. It prints and plots itself.

    - `t`, `q`, `v`: a state on the orbit; `period`, `[t]`.
    - `turns`: the number of whole turns of each angle in a period, in the structure of `q`.
    - `shift`: how far the coordinates named in `relative` move in a period, in the structure of `q`; 0 elsewhere.
    - `residual`: how far the end is from the start, and held quantities from their values, in units of the motion's
      size.
    - `converged`: whether the residual is within the tolerance times what the motion amplifies, and below its square
      root; if not, this is the best orbit that was found.
    - `iterations`: the number of steps of Newton's method.
    - `nodes` (K, 2n): the states q and v, in the order of their names, at K equal parts of the period.
    - `switches`: the `Switches` in one period, where the system has phases or elements; else None.

    Under `vmap` every array has the batch's axes in front.
    """

    t: Float[Array, ""]
    q: PyTree[Float[Array, "..."]]
    v: PyTree[Float[Array, "..."]]
    period: Float[Array, ""]
    turns: PyTree[Float[Array, "..."]]
    shift: PyTree[Float[Array, "..."]]
    residual: Float[Array, ""]
    converged: Bool[Array, ""]
    iterations: Int[Array, ""]
    nodes: Float[Array, "K 2n"]
    arrays: PyTree
    static: HashablePart = eqx.field(static=True)
    asked: OrbitRequest = eqx.field(static=True)
    switches: Switches | None = None

    @property
    def system(self) -> System | Hybrid:
        return self._problem()[0]

    @property
    def params(self) -> PyTree:
        return self._problem()[1]

    def _problem(self):
        return self.static.combine(self.arrays)

    @property
    def trajectory(self) -> Trajectory:
        """The motion over one period, 401 states, by `lj.integrate`; not available for a batch.

        It starts at `q`, `v`, and leaves an unstable orbit by as much as that amplifies its tolerance: what lies on the
        orbit throughout are its `nodes`.
        """
        self._check_alone("trajectory")
        ts = float(self.t) + float(self.period) * np.linspace(0.0, 1.0, POINTS)
        return integrate(self.system, self.q, self.v, self.params, ts=ts.astype(self.t.dtype))

    def plot(self):
        """Plot velocities against coordinates, one panel each, with a dot at the start; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib; `ValueError` for a batch.
        """
        return self.trajectory.phase_portrait()

    def _check_alone(self, what):
        must_be_single(np.shape(self.period), "this orbit", f"{{orbit}}.{what}")

    def __repr__(self):
        if is_traced(self):
            return "PeriodicOrbit(being traced)"
        if np.ndim(self.period):
            shape, good = " x ".join(map(str, np.shape(self.period))), int(np.sum(np.asarray(self.converged)))
            low, high = np.min(self.period), np.max(self.period)
            return f"Periodic orbits, {shape} lanes, {good} converged, periods {low:.9g} to {high:.9g}"
        rows = [("period", f"{float(self.period):.12g}")]
        rows.append(("start", f"t = {float(self.t):.6g}, q = {describe(self.q)}, v = {describe(self.v)}"))
        rows += [
            (label, moved) for label, tree in (("turns", self.turns), ("shift", self.shift)) if (moved := _moved(tree))
        ]
        rows.append(("residual", f"{float(self.residual):.1e} (relative), after {int(self.iterations)} iterations"))
        if self.switches is not None:
            rows.append(("switches", self.switches.in_words()))
            rows += [("", row) for row in self.switches.in_rows()]
        if not bool(self.converged):
            rows.append(("WARNING", "not converged: this is the best that was found"))
        return labelled("Periodic orbit", rows)


def _moved(tree):
    values, names = np.asarray(coordinates.flatten(tree)[0]), coordinates.names(tree)
    return ", ".join(f"{name} {value:+.9g}" for name, value in zip(names, values) if value)


# A driven system may change from one period to the next by this fraction of what it does in one.
SAME = 1e-5


class OrbitWarning(UserWarning):
    """A search for a periodic orbit did not converge; its best candidate is returned."""


def periodic_orbit(
    system: System | Hybrid,
    start: tuple[PyTree[ArrayLike], PyTree[ArrayLike]],
    period: ArrayLike,
    params: PyTree = None,
    *,
    t: ArrayLike = 0.0,
    hold: str | Iterable[str] | None = None,
    turns: Mapping[str, int] | None = None,
    relative: str | Iterable[str] = (),
    parts: int = 1,
    rtol: ArrayLike | None = None,
    most: int = shooting.MOST,
    phase: str | int | None = None,
) -> PeriodicOrbit:
    """Find a motion that comes back to its start, near a guess: Newton's method on the flow.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> pendulum = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["g"] * jnp.cos(q))
    >>> orbit = periodic_orbit(pendulum, (2.0, 0.0), 6.0, {"g": 1.0})
    >>> print(orbit.period.round(9), orbit.q.round(6))
    8.349752927 2.0

    **Main arguments:**

    - `system`, `params`: a `System`, with or without constraints, first-order states and elements, or a `Hybrid`, and
      its parameters.
    - `start`: (q, v), a state near the orbit; `[q]`, `[q]/[t]`. With constraints it is replaced by the nearest state
      that satisfies them; v may leave out states, whose rates are determined. Where the motion has switches (impacts,
      sticking), a state between two of them.
    - `period`: the approximate period, `[t]`. If the system depends on time, the period is kept, and must be a multiple
      of that of the drive; otherwise it is found with the orbit. Where there are switches it is not searched for among
      several returns.
    - `t`: the time of the start, `[t]`, for a system that depends on it.
    - `hold`: what the orbit keeps of the guess, where orbits form a family: `"energy"` (the Jacobi integral; the
      default where it is conserved), `"period"`, or coordinates and velocities of the start by name: `"theta"`,
      `"r[0]"`, `"v.theta"`; `"q"` and `"v"` for a single coordinate. Give several as a tuple. `()` holds nothing and
      finds the orbit nearest to the guess.

    **Other arguments:**

    - `turns`: the whole turns that angles make in a period, by name. By default those of the guess, rounded. (A
      coordinate is an angle if it appears only in sines and cosines.) Where there are switches, by default none.
    - `relative`: coordinates that need not come back, for relative periodic orbits; the system must not depend on them.
      So do states that only sum up what the motion does, such as a running cost.
    - `parts`: into how many parts the period is divided, with unknown states at all their ends (multiple shooting); for
      orbits so unstable that a guess does not come near its start again.
    - `rtol`: the tolerance of the steps; 1e-12 by default in float64, 1e-5 in float32. `most`: the largest number of
      flows to try.
    - `phase`: the phase of a `Hybrid` in which the orbit starts and ends, by name or number; by default the first one.

    **Returns:** a `PeriodicOrbit`; the best candidate where the search did not converge. Both modes differentiate `q`,
    `v`, `period` and `nodes` by `params` and by what is held.

    **Raises:**

    - `TypeError`, `ValueError` for a state of the wrong shape or dtype, for unknown names, for quantities that cannot
      be held, and where a driven system is not the same after `period`.
    - `ValueError` for a state that has no periodic value, since nothing depends on it, and is not in `relative`.
    - `ValueError`, `RuntimeError` where the motion of the guess ends early, as `lj.integrate` raises them.
    - Warns (`lj.OrbitWarning`) where the search did not converge; under `jit` and `vmap` check `converged`.

    Source: Seydel, *Practical Bifurcation and Stability Analysis*, §7.4 (shooting, phase condition); Meyer & Offin, §9.
    """
    q, v = _pair(start)
    problem = any_problem_of(system, State(t, q, v, params), phase)
    s = problem.state
    dtype, names = s.t.dtype, coordinates.names(s.q)
    asked = _asked(problem, names, hold, relative)
    if problem.system.in_phases:
        if parts != 1:
            raise ValueError(
                f"parts={parts}: a motion with switches is not divided, since the parts may begin in other phases.\n"
                "Fix: leave parts out."
            )
        asked = asked._replace(angles=tuple(name in (turns or {}) for name in names))
    rtol, period = tolerance_of(rtol, dtype), numpy_of(period).asarray(period, dtype)
    well = is_traced(period) or np.ndim(period) == 0 and float(period) > 0
    must(well, "period must be one positive number", period, "about the time of one swing")
    given_turns = None if turns is None else _turns(turns, names, dtype)
    eager = is_eager() and not is_traced((s, period))
    if eager:
        found = shooting.closed(problem.system, s, period, rtol, asked, problem.rows, parts, given_turns, most)
        _raise_or_warn(found, float(period), problem)
    else:
        state = coordinates.state(*s)
        given = stop_gradient((problem.system, state, jnp.asarray(period)))
        found = shooting.closed(*given, rtol, asked, problem.rows, parts, given_turns, most)
        found = shooting.implicit(problem.system, state, rtol, asked, problem.rows, found)
    orbit = _orbit(problem, found, asked)
    return reported(orbit, _report)


def _report(orbit: PeriodicOrbit) -> Report:
    result = jnp.where(orbit.converged, RESULTS.successful._value, RESULTS.not_converged._value)
    return Report(result, orbit.iterations, jnp.zeros_like(orbit.residual), orbit.residual)


def _pair(start):
    fix = "lj.periodic_orbit(system, (q, v), period, params)"
    well = isinstance(start, (tuple, list)) and len(start) == 2
    must(well, "start must be a pair (q, v)", start, fix, error=TypeError)
    return start


def _asked(problem, names, hold, relative) -> OrbitRequest:
    driven = not problem.reasons.autonomous
    all_names = [*names, *(_velocity(name) for name in names)]
    wanted = {relative} if isinstance(relative, str) else set(relative)
    must_name(sorted(wanted), names, "relative names", "coordinate", "relative='{}'")
    depended_on = [name for name, free in zip(names, problem.reasons.ignorable) if name in wanted and not free]
    if depended_on:
        raise ValueError(
            f"'{depended_on[0]}' is named in relative, but the system depends on it: its value changes the motion.\n"
            "Fix: leave it out; whole turns of an angle are counted anyway."
        )
    _refuse_quadratures(problem, wanted)
    mask = tuple(name in wanted for name in names)
    if driven:
        if hold is not None and hold != "period" and tuple(hold) not in ((), ("period",)):
            raise ValueError(
                f"the system depends on time, so the orbit has the period of the drive and cannot also hold={hold!r}.\n"
                "Fix: leave hold out."
            )
        return OrbitRequest(False, False, False, (), mask, problem.is_angle)
    if hold is None:
        hold = ("energy",) if problem.reasons.energy else ()
    hold = (hold,) if isinstance(hold, str) else tuple(hold)
    entries = [name for name in hold if name not in ("energy", "period")]
    if len(all_names) == 2:
        all_names = ["q" if names[0] == "q" else names[0], all_names[1]]
    must_name(entries, ["energy", "period", *all_names], "hold names", "coordinate or velocity", "hold='{}'")
    if "energy" in hold and not problem.reasons.energy:
        raise ValueError(
            "the Jacobi integral is not conserved here, so the orbit cannot hold that of the guess.\n"
            "Usual cause: a force or dissipation; cycles are then isolated.\n"
            "Fix: hold=(), or leave hold out."
        )
    held = tuple(all_names.index(name) for name in entries)
    return OrbitRequest("period" not in hold, True, "energy" in hold, held, mask, problem.is_angle)


def _refuse_quadratures(problem, relative: set[str]):
    """Raise where a state only sums up what the motion does, and is not said to be relative."""
    q, system = problem.state.q, user_system(problem)
    names, free = (coordinates.like(q, np.array(x)) for x in (coordinates.names(q), problem.reasons.ignorable))
    states = {name for phase in system.phases for name, rate in phase.states.items() if not isinstance(rate, Held)}
    for state in sorted(states):
        sums = [str(name) for name in np.ravel(names[state])[np.ravel(free[state])] if name not in relative]
        if sums:
            raise ValueError(
                f"state '{sums[0]}' has no periodic value: nothing depends on it, so it only sums up its rate.\n"
                "Usual cause: a running cost, or another quadrature, beside a motion that comes back without it.\n"
                f"Fix: relative=\"{sums[0]}\"; then orbit.shift['{state}'] is how much a period adds."
            )


def _velocity(name: str):
    return f"v{name[1:]}" if name == "q" or name.startswith("q[") else f"v.{name}"


def _turns(turns, names, dtype):
    must_name(turns, names, "turns names", "coordinate", "turns={'{}': 1}")
    return np.array([turns.get(name, 0) for name in names], dtype)


def _raise_or_warn(found, period, problem):
    if float(found.apart) > SAME:
        raise ValueError(
            f"the system is not the same after period = {period:.9g}: its accelerations change.\n"
            "Usual cause: a rounded period, or one that is not a period of the drive.\n"
            'Fix: period=2 * jnp.pi / params["omega"] for a drive cos(ωt), or a multiple of it.'
        )
    if not np.isfinite(float(found.evaluation.size)):
        refuse_unfollowed(problem, period)
    if not bool(found.converged) and problem.system.in_phases:
        warnings.warn(_switching_words(found), OrbitWarning, stacklevel=3)
    elif not bool(found.converged):
        warnings.warn(
            f"no periodic orbit was found near this start: after {int(found.iterations)} flows the motion comes back "
            f"to {float(found.evaluation.size):.2g} of its size, with the period {float(found.candidate.period):.9g}. "
            "The best candidate is returned.\n"
            "Usual cause: a guess too far away, a family that does not reach the held energy or coordinate, a state of "
            "rest, or an orbit so unstable that the guess leaves it.\n"
            "Fix: another start or period; hold=...; parts=8 for an unstable one.",
            OrbitWarning,
            stacklevel=3,
        )


def _switching_words(found) -> str:
    """Why no orbit of a motion with switches was found."""
    evaluation, period = found.evaluation, float(found.candidate.period)
    words = (
        f"no periodic orbit was found near this start: after {int(found.iterations)} flows the motion comes back to "
        f"{float(evaluation.size):.2g} of its size, with the period {period:.9g} and {int(evaluation.switches.count)} "
        "switches in it. The best candidate is returned.\n"
    )
    if not bool(evaluation.returns) and float(evaluation.size) < SAME:
        last = evaluation.switches.names[int(evaluation.switches.to[int(evaluation.switches.count) - 1])]
        return words + (
            f"Usual cause: it comes back in the phase '{last}', in which it did not start.\nFix: phase=\"{last}\"."
        )
    return words + (
        "Usual cause: a start at a switch, such as just after an impact: whether that one is in the period, round-off "
        "decides; a guess too far away, or with other switches than an orbit near it; a state of rest.\n"
        "Fix: a start between two switches; traj = lj.integrate(...) from the guess shows them, and where it settles."
    )


def _orbit(problem, found, asked) -> PeriodicOrbit:
    s, xp = problem.state, numpy_of(found)
    if xp is np:
        found = jax.tree.map(np.asarray, found)

    like = partial(coordinates.like, s.q)
    z, n = found.candidate.nodes[0], found.guess.turns.shape[0]
    shift = xp.where(np.array(asked.relative), found.evaluation.displacement[:n], xp.zeros_like(z[:n]))
    arrays, static = hashable_partition((user_system(problem), coordinates.state(*s).params))
    return PeriodicOrbit(
        xp.asarray(s.t), like(z[:n]), like(z[n:]), found.candidate.period, like(found.guess.turns),
        like(shift), found.evaluation.size, found.converged, found.iterations, found.candidate.nodes, arrays, static,
        asked, found.evaluation.switches,
    )  # fmt: skip
