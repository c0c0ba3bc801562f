"""The main entry: a trajectory from a system and an initial state.

    refuse what cannot be, prepare the problem  ->  run it, in one compiled solve by diffrax  ->  say what went wrong

Values are examined only outside the compiled program (`integrate/solve/programs.py`), so that it can be cached,
batched and differentiated.
"""

from collections.abc import Mapping, Sequence

import diffrax
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.contexts import SILENT, WATCHED
from lagjax.integrate import arguments
from lagjax.integrate.events.event import Crossing
from lagjax.integrate.failure import raise_at_run_time, raise_failure, warn_of_events, warn_of_missed_end
from lagjax.integrate.prepare import MANY_STEPS, prepare
from lagjax.integrate.problem import Problem
from lagjax.integrate.replay import Replay
from lagjax.integrate.results import ENDED_WELL, is_among
from lagjax.integrate.solve.legs import warn_of_lost
from lagjax.integrate.solve.phases import run
from lagjax.integrate.solve.reports import report
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import is_traced
from lagjax.numerics import EqualSteps
from lagjax.system import Hybrid, System, by_name


@by_name("lj.integrate(system, q0, v0, params, ts=ts)", "ts")
def integrate(
    system: System | Hybrid,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    ts: Array | np.ndarray | Sequence[float],
    rtol: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    atol: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    method: diffrax.AbstractSolver | EqualSteps | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: ArrayLike | None = None,
    max_step: ArrayLike | None = None,
    jump_ts: ArrayLike | Sequence[float] | None = None,
    jumps: str = "found",
    events: Mapping[str, Crossing] | None = None,
    event: diffrax.Event | None = None,
    adjoint: diffrax.AbstractAdjoint | Replay | None = None,
    max_steps: int | None = MANY_STEPS,
    throw: bool = True,
    progress: bool | None = None,
    drift: str | None = None,
    estimate_error: bool | None = None,
    start: str | ArrayLike | None = None,
    outputs: str | None = None,
) -> Trajectory:
    """Integrate Lagrange's equations from (q0, v0) at `ts[0]`, with outputs at `ts`.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> traj = integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=jnp.array([0.0, 0.2, 0.5]))
    >>> print(traj.q.round(9))
    [0.   0.4  0.25]

    **Main arguments:**

    - `system`: the `System`; or a `Hybrid`, a motion in phases.
    - `q0`, `v0`: initial coordinates and velocities, any pytree of numbers and arrays, alike; `[q]`, `[q]/[t]`. Whole
      numbers become floats. A list is a pytree, not a vector; angles are in radians. A start that is off the
      constraints by no more than about the tolerance is moved onto them. The velocities of states, which `v0` may leave
      out, and of massless coordinates on dampers are what they are determined to be.
    - `params`: what the Lagrangian takes; gradients flow to its floating arrays.
    - `ts` (T,): output times, `[t]`, increasing or, to run backward, decreasing. Each is the end of a step of the
      method, except as `outputs` says. (Decreasing times have to be known while JAX is tracing: a NumPy array.)
    - `rtol`, `atol`: tolerances of the local error of each coordinate and velocity, `atol + rtol |y|`. `rtol` is 1e-9
      by default in float64, 1e-5 in float32. Without `atol` each number is judged by its own size, whatever the units
      (`lagjax/integrate/stepping.py`): at a zero crossing by its size at the end of the step, at rest by
      its change in a step, and a decaying one over three decades. Give `atol` if small numbers do not matter, such as
      the stretching of a stiff spring. A pair is one for coordinates, `[q]`, and one for velocities, `[q]/[t]`. The
      size of an angle (a coordinate that enters only through sines and cosines) counts at most as one turn.

    **Other arguments:**

    - `method`: any diffrax solver. By default `lj.Nystrom12()` if there are no constraints and accelerations do not
      depend on velocities (`lj.explain` says so), else `lj.Dopri8()`: the fastest way to an error between 1e-4 and
      1e-10 on nearly all scenes (`benchmarks/results/work_precision.json`). With a network (an array of 64 numbers or
      more, and of two axes or more, among the parameters) it is `lj.Tsit5()` for rtol of 1e-6 and above, constraints or
      not, and below that, or with a `stepsize_controller`, `lj.Nystrom8()` in place of `lj.Nystrom12()`. A traced
      `rtol` counts as the default one. With these and with `lj.Tsit5()` small systems run on equations that are written
      out number by number, as they also do with `diffrax.Dopri8()` and `diffrax.Tsit5()`, which are treated as ours;
      diffrax's other methods take 2 to 10 times longer. For stiff systems use `lj.Radau5()` if something decays fast,
      and `lj.Radau5(step_powers=(0, 1))` if springs are stiff and their oscillation does not matter. `lj.Gauss` and
      `lj.Splitting` are symplectic, for long motions; their steps have the length `dt0`, or `dt0` times a `pace`,
      whatever the tolerances are.
    - `stepsize_controller`: any diffrax controller, in place of `diffrax.PIDController(rtol, atol)`.
    - `dt0`: the length of the first step, `[t]`; of all steps with `diffrax.ConstantStepSize()`, `lj.Gauss` and
      `lj.Splitting`, which need it.
    - `max_step`: the longest step, `[t]`. Adaptive steps may miss what is narrower than they are, such as a short push
      or a thin barrier, without a warning. No step is longer than this, nor than the time between two
      exact outputs.
    - `jumps`: "found" reads jumps and kinks off the programs of L, the force and the dissipation (`jnp.where(q > 0,
      ...)`, `jnp.sign(v)`, `jnp.maximum`, `jnp.interp`): each becomes an end of a step, derivatives are those of the
      motion across it, and a motion that is pushed back from both sides stays on it, as under dry friction. "ignored"
      takes forces as they come. See `docs/forces-that-jump.md`.
    - `jump_ts` (J,): times at which a force jumps or has a kink, in any order, `[t]`, that cannot be read off its
      program. They become ends of steps, and each step stays on one side of them; derivatives with respect to these
      times are right.
    - `events`: by name, a `lj.Crossing` each: where a function of the state crosses zero, recorded in `traj.events` or
      ending the motion. Crossings are also found inside steps, several in one, and located to round-off: such a step
      is taken in parts that end there, but its controller sees it as one; steps of equal length stay whole. A value
      that jumps over zero at a switch of a `Hybrid`, as a velocity does in an impact, does not cross it.
    - `event`: a `diffrax.Event` that ends the motion; its condition takes `(t, (q, v), params, **kwargs)`. It is found
      like `events`, under the name "event".
    - `adjoint`: any diffrax adjoint. Without one, forward and reverse mode both work; so they do with `lj.Replay`,
      which says how much memory reverse mode may use.
    - `max_steps`: the largest number of steps, accepted and rejected, including those that search for events; of
      steps of equal length by default as many as there are. A motion ends before (`lj.RESULTS.no_progress`) after 4096
      attempts in a row, each so short that a hundred times `max_steps` of them would not be enough.
    - `throw`: raise if the integration fails. With `throw=False` the trajectory carries the reason in
      `result` and NaN from there on.
    - `progress`: True shows a progress meter. By default only the wait for the compiler is shown, if someone may look.
    - `estimate_error`: whether to integrate a second time, more precisely, to say in `traj.error` how wrong the motion
      may be. The default is to do so if nothing is traced, steps are chosen by lagjax or fixed, and there are at most
      20,000. It then compiles nothing and costs 1.2 to 2 times the solve; inside `jit`, `vmap`, a sweep and derivatives
      it is one more solve in the program, which is not differentiated. It cannot see what a method damps in both runs
      alike, as `lj.Radau5(step_powers=(0, 1))` damps fast oscillations.
    - `start`: the phase of a `Hybrid` in which the motion starts, its name or its number in the order of the phases; by
      default the first one. A number may be traced, so that each lane of a `vmap`, or each point of a sweep over
      numbers, starts in its own phase.
    - `outputs`: "exact" makes each output the end of a step, which costs little up to about as many outputs as there
      would be steps. Beyond that, "interpolated" steps over them by `lj.Tsit5()`, and takes them from the polynomial of
      order 5 through q, v and a at both ends of a step, returned to the constraints. No tolerance controls its error,
      but that is about as large as the errors of steps for rtol of 1e-3 to 1e-6
      (`tests/behaviour/test_interpolated_outputs.py`). In reverse mode with `events` outputs are exact. By default they
      are interpolated where `method` is left out and `lj.Tsit5()` chosen for a network, and exact otherwise.
    - `drift`: `"project"` (return to the constraints after every step; the default if there are any),
      `"baumgarte"` (feedback at 50 decays a time span), or `"none"`.

    **Returns:** a `Trajectory`; of a `Hybrid` a `HybridTrajectory`, with the phases and switches.

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind, shape or dtype; `ts` that is not monotonic; a
      tolerance below the dtype's resolution.
    - `ValueError` for a start off the constraints, or one where L or its equations are singular or not finite.
    - `RuntimeError` if the integration stops early: `max_steps` reached, or steps that collapsed.
    - Warns (`lj.AccuracyWarning`) if `scaled_error` is above 1: if the estimated error is more than 10,000 tolerances
      or leaves fewer than three digits; without an estimate, if the Jacobi integral must be constant and changed by
      1000 tolerances, or by less over thousands of steps, or by 1e-5 with fixed steps. For batches look at
      `scaled_error` yourself.
    - Warns of what is hardly ever intended: a mass matrix that is not positive definite at the start, in directions
      that constraints leave free, once for each kind of motion (not inside `jit` and `vmap`, nor where no mass matrix
      is formed, as for trees and bands, nor with elements, phases or jumps that are followed; where it is meant:
      `warnings.filterwarnings("ignore", "the mass matrix is")`); a `dissipation` that is odd in v, as a force is; once
      in a process (`lj.PrecisionWarning`), float32 that is used only because nothing else was requested.

    Order and accuracy: those of `method`; `tests/behaviour/test_orders.py` measures them.

    Source: Hairer & Wanner, *Solving ODEs II*, §VII.2 (projection); Kidger, arXiv:2202.02435 (diffrax).
    """
    problem = prepare(
        system, q0, v0, params, ts=ts, rtol=rtol, atol=atol, method=method, stepsize_controller=stepsize_controller,
        dt0=dt0, max_step=max_step, jump_ts=jump_ts, jumps=jumps, events=events, event=event, adjoint=adjoint,
        max_steps=max_steps, progress=progress, drift=drift, estimate_error=estimate_error, start=start,
        outputs=outputs,
    )  # fmt: skip
    trajectory = report(run(problem))
    return _raise_or_warn(trajectory, problem) if throw else trajectory


def _raise_or_warn(trajectory: Trajectory, problem: Problem):
    """Raise or warn in the user's words; while tracing, at run time with the result's own message."""
    if is_traced(trajectory):
        # A caller that watches learns the result from the report.
        return trajectory if WATCHED.value or SILENT.value else raise_at_run_time(trajectory)
    result = trajectory.result
    if not is_among(result, ENDED_WELL):
        raise_failure(trajectory, problem.start, problem.settings, problem.guards)
    if not warn_of_missed_end(trajectory, problem.guards):
        arguments.warn_of_inaccuracy(trajectory)
    warn_of_events(trajectory, problem.guards)
    warn_of_lost(trajectory)
    return trajectory
