"""The front door: a trajectory from a system and an initial state.

    check the arguments  ->  one compiled solve by diffrax  ->  say what went wrong, if anything did

All looking at values happens outside the compiled program (`motion/solve.py`), so that it can be cached,
batched and differentiated.
"""

from collections.abc import Sequence

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.mechanics import coordinates
from lagjax.mechanics.closures import lift
from lagjax.mechanics.diagnosis import explain_failure
from lagjax.mechanics.first_call import check_functions
from lagjax.mechanics.system import System
from lagjax.motion import problem
from lagjax.motion.reported import patient, report
from lagjax.motion.solve import START_TOLERANCES, Settings, trajectory_of
from lagjax.motion.trajectory import RESULTS, Trajectory, ended_well, message


def integrate(
    system: System,
    q0: PyTree[ArrayLike],
    v0: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    ts: Array | np.ndarray | Sequence[float],
    rtol: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    atol: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
    method: diffrax.AbstractSolver | None = None,
    stepsize_controller: diffrax.AbstractStepSizeController | None = None,
    dt0: ArrayLike | None = None,
    event: diffrax.Event | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    max_steps: int | None = 2**20,
    throw: bool = True,
    progress: bool = False,
    drift: str | None = None,
) -> Trajectory:
    """Integrate Lagrange's equations from (q0, v0) at `ts[0]`, with outputs at `ts`.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> traj = integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=jnp.array([0.0, 0.2, 0.5]))
    >>> print(traj.q.round(9))
    [0.   0.4  0.25]

    **Main arguments:**

    - `system`: the `System`.
    - `q0`, `v0`: initial coordinates and velocities, any pytree of float arrays, alike; `[q]`, `[q]/[t]`. A start
      that is off the constraints by no more than about the tolerance is moved onto them.
    - `params`: what the Lagrangian takes; gradients flow to its floating arrays.
    - `ts` (T,): increasing output times, `[t]`. Each is the end of a step of the method, not an interpolation.
    - `rtol`, `atol`: tolerances of the local error of each coordinate and velocity; by default 1e-9 in float64, 1e-5
      in float32. A pair is one for coordinates, `[q]`, and one for velocities, `[q]/[t]`. Of an angle (a coordinate
      that is seen through sines and cosines alone) at most one turn counts as its size.

    **Other arguments:**

    - `method`: any diffrax solver. By default `lj.Nystrom12()` where there are no constraints and accelerations do not
      depend on velocities (`lj.explain` says so), else `lj.Dopri8()`: the fastest way to an error between 1e-4 and
      1e-10 on nearly all scenes (`benchmarks/results/work_precision.json`). With these, with `lj.Nystrom8()` and
      `lj.Tsit5()`, small systems run on equations that are written out number by number; diffrax's own methods take 2
      to 10 times longer.
    - `stepsize_controller`: any diffrax controller, in place of `diffrax.PIDController(rtol, atol)`.
    - `dt0`: the first step, `[t]`; needed with `diffrax.ConstantStepSize()`.
    - `event`: a `diffrax.Event` whose condition takes `(t, (q, v), params, **kwargs)`. Without a root finder of
      its own, a real-valued condition is located to round-off.
    - `adjoint`: any diffrax adjoint. Without one, forward and reverse mode both work.
    - `max_steps`: the largest number of steps, accepted and rejected.
    - `throw`: raise where the integration fails. With `throw=False` the trajectory carries the reason in
      `result` and NaN from there on.
    - `progress`: show a progress meter.
    - `drift`: `"project"` (return to the constraints after every step; the default where there are any),
      `"baumgarte"` (feedback at 50 decays a time span), or `"none"`.

    **Returns:** a `Trajectory`.

    **Raises:**

    - `TypeError`, `ValueError` for arguments of the wrong kind, shape or dtype; `ts` that does not increase; a
      tolerance below the dtype's reach.
    - `ValueError` for a start off the constraints, or one where L or its equations are singular or not finite.
    - `RuntimeError` where the integration stops early: `max_steps` reached, or a step size that collapsed.
    - Warns (`lj.AccuracyWarning`) where the Jacobi integral must be constant and changed by 1000 tolerances, or by less
      over thousands of steps, or by 1e-5 with fixed steps: where `departure` is above 1. In lanes look at that.

    Order and accuracy: those of `method`; `tests/motion/test_orders.py` measures them.

    Source: Hairer & Wanner, *Solving ODEs II*, §VII.2 (projection); Kidger, arXiv:2202.02435 (diffrax).
    """
    problem.check_system(system)
    problem.check_method(method)
    t0 = ts[0] if len(np.shape(ts)) == 1 and np.shape(ts)[0] else 0.0
    start = coordinates.state(t0, q0, v0, params)
    dtype = start.t.dtype
    check_functions(system, *start)
    system = lift(system, start)
    drift = problem.check_drift(drift, system)
    problem.check_adjoint(adjoint, drift)
    settings = Settings(
        method=method,
        controller=stepsize_controller,
        event=event,
        adjoint=adjoint,
        rtol=problem.tolerance(rtol, "rtol", dtype),
        atol=problem.tolerance(atol, "atol", dtype),
        dt0=problem.first_step(dt0, dtype),
        apart=any(isinstance(tol, (tuple, list)) or jnp.ndim(tol) > 0 for tol in (rtol, atol) if tol is not None),
        max_steps=patient(max_steps),
        drift=drift,
        progress=progress,
    )
    ts = problem.times(ts, dtype)
    trajectory = trajectory_of(system, start.q, start.v, start.params, ts, settings)
    trajectory = report(trajectory)
    if throw:
        trajectory = _raise_failure(trajectory, start._replace(t=ts[0]), settings)
    return trajectory


def _raise_failure(trajectory, start, settings):
    """Raise or warn in the user's words; while tracing, at run time with the result's own message."""
    well = ended_well(trajectory.result)
    if coordinates.is_traced(trajectory):
        return trajectory.result.error_if(trajectory, ~well)
    system = trajectory.system
    if not well:
        if bool(trajectory.result == RESULTS.start_off_constraints):
            tolerances = (START_TOLERANCES * np.asarray(tol) for tol in trajectory.tolerance)
            raise ValueError(problem.off_constraints(system, start, *tolerances))
        if any(bool(trajectory.result == result) for result in problem.REFUSED):
            problem.check_finite(start)
            raise ValueError(explain_failure(system, start) or message(trajectory.result))
        raise RuntimeError(problem.stopped_early(trajectory, settings))
    problem.warn_of_drift(trajectory)
    return trajectory
