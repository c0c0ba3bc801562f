"""What `integrate` does before a motion runs: arguments are checked, functions traced, and a `Problem` made."""

from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import arguments
from lagjax.integrate.arguments import warn_of_odd_dissipation
from lagjax.integrate.equal_steps.pace import with_traced_pace
from lagjax.integrate.events.event import crossings_of, guards_of, left_to_diffrax
from lagjax.integrate.problem import Problem
from lagjax.integrate.replay import Replay
from lagjax.integrate.settings import Settings, is_recorded, patient
from lagjax.integrate.solve.phases import phases_in, refuse_beside_switches, traced_phases
from lagjax.integrate.solve.reports import steps_to_repeat
from lagjax.integrate.stepping import WHOLE_STEPS
from lagjax.mechanics import has_networks
from lagjax.numerics import EqualSteps
from lagjax.system import Hybrid, System, check_system, coordinates, with_rates

# The steps that a motion may take unless `max_steps` says otherwise.
MANY_STEPS = 2**20


def prepare(
    system: System | Hybrid, q0: PyTree, v0: PyTree, params: PyTree, *, ts: Any, rtol: Any, atol: Any, method: Any,
    stepsize_controller: Any, dt0: Any, max_step: Any, jump_ts: Any, jumps: str, events: Any, event: Any, adjoint: Any,
    max_steps: int | None, progress: bool | None, drift: str | None, estimate_error: bool | None, start: Any,
    outputs: str | None,
) -> Problem:  # fmt: skip
    """The motion that `integrate` is asked for, with its arguments checked and the user's functions traced."""
    check_system(system, q0, v0, params, phases=True, elements=True)
    arguments.check_method(method)
    if isinstance(method, EqualSteps):
        fixed = isinstance(stepsize_controller, diffrax.ConstantStepSize)
        arguments.check_equal_steps(
            method, dt0, system, stepsize_controller=None if fixed else stepsize_controller, max_step=max_step,
            jump_ts=jump_ts, events=events, event=event, adjoint=adjoint, outputs=outputs, start=start,
            drift=drift if drift == "baumgarte" else None,
        )  # fmt: skip
        stepsize_controller = diffrax.ConstantStepSize()
        # `dt0` says how many there are.
        max_steps = None if method.pace is None and max_steps == MANY_STEPS else max_steps
    arguments.check_controller(stepsize_controller, max_step, jump_ts)
    arguments.check_max_steps(max_steps)
    ts = arguments.vector_of_times(ts)
    state = coordinates.prepared(ts[0], q0, with_rates(system, q0, v0), params)
    dtype = state.t.dtype
    if isinstance(method, EqualSteps):
        method = with_traced_pace(method, state)
    system = traced_phases(system if start is None else system.starting(start), state, ts)
    for i, phase in enumerate(system.phases):
        if phase.dissipation is None:
            continue
        params = system.given(state.params, phase=i) if isinstance(system, Hybrid) else state.params
        given = state._replace(params=params)
        warn_of_odd_dissipation(phase.dissipation, given)
    crossings, left = crossings_of(events, event), left_to_diffrax(event)
    if system.in_phases:
        refuse_beside_switches(system, state, ts, adjoint, event)
        guards = phases_in(system, state, crossings)
    else:
        guards = guards_of(crossings, system, state) if crossings else None
    drift = arguments.check_drift(drift, any(phase.constraints for phase in system.phases))
    arguments.check_adjoint(adjoint, drift, jump_ts, is_recorded(stepsize_controller, left, progress))
    relative = arguments.tolerance(rtol, "rtol", dtype)
    # Only where it chooses the method: a program serves all tolerances.
    loose = stepsize_controller is None and arguments.is_loose(relative, dtype) and has_networks((system, state.params))
    settings = Settings(
        method=method,
        controller=stepsize_controller,
        event=left,
        adjoint=None if isinstance(adjoint, Replay) else adjoint,
        memory=adjoint.memory if isinstance(adjoint, Replay) else None,
        rtol=relative,
        atol=arguments.tolerance(rtol if atol is None else atol, "rtol" if atol is None else "atol", dtype),
        by_size=atol is None,
        dt0=arguments.step_length(dt0, "dt0", dtype),
        max_step=arguments.step_length(np.inf if max_step is None else max_step, "max_step", dtype),
        jump_ts=arguments.jumps(jump_ts, dtype),
        apart=any(isinstance(tol, (tuple, list)) or jnp.ndim(tol) > 0 for tol in (rtol, atol) if tol is not None),
        max_steps=patient(max_steps),
        drift=drift,
        progress=progress,
        jumps=arguments.check_jumps(jumps),
        outputs=arguments.check_outputs(outputs),
        loose=loose,
        shares=np.array(WHOLE_STEPS, dtype),
        repeated_up_to=steps_to_repeat(estimate_error, stepsize_controller, progress),
    )
    return Problem(system, state.q, state.v, state.params, arguments.times(ts, dtype), guards, settings)
