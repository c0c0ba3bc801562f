"""The error of a motion, estimated by integrating it a second time, ten times more precisely.

A tolerance bounds the error of a step; no method knows how large the motion lets these errors grow. The same compiled
program with tolerances ten times tighter has a tenth of the error, so that the difference of the two runs is the error
of the first, to within a tenth of it. This holds even if the motion amplifies errors until no digits are left, since it
amplifies the difference alike, and for round-off, which differs between the runs as their steps do.

If something else than the tolerance determined the steps, both runs would take the same ones. So fixed steps are
halved, and so is `max_step` if it limits them; outputs are reached in one step more than before; the first step is
shorter.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.4 (global error by a second tolerance).
"""

from collections.abc import Callable
from dataclasses import replace
from types import ModuleType
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from lagjax.integrate.results import ENDED_WELL, RESULTS, Errors, columns, ended_well, is_among, scaled_error
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import is_eager, stop_gradient

# The tightest tolerance that is not below round-off.
ROUND_OFFS = 8
TIGHTER = 10.0
# A motion of more steps is integrated again only if the user requests it.
STEPS_AT_MOST = 20_000
# Up to FEW steps per output, outputs may have determined the steps. Since the first steps are short, this share of a
# step per output is not counted.
FEW, UNCOUNTED = 4, 0.2
# The least number of steps per output if there were more than FEW, and the share of the first step that is taken.
MANY, FIRST = 3.0, 0.7
# `max_step` limits the steps if their mean is above this share of it.
LIMITED = 0.7
# Round-off adds at least this many round-offs of a number, times the square root of the number of steps.
ROUND_OFF = 3.0


def steps_to_repeat(estimate: bool | None, controller, progress: bool) -> np.ndarray:
    """Return the most steps of a motion to be integrated again; raise if `estimate` is not None, True or False."""
    if not (estimate is None or isinstance(estimate, (bool, np.bool_))):
        raise TypeError(
            f"estimate_error must be True, False or None, not {estimate!r}.\nFix: estimate_error=True, or leave it out."
        )
    ours = controller is None or _fixed(controller)
    by_default = STEPS_AT_MOST if is_eager() and ours and not progress else 0
    limits = {None: by_default, True: np.iinfo(np.int32).max, False: 0}
    return np.asarray(limits[None if estimate is None else bool(estimate)], np.int32)


def with_errors(run: Callable, first: Trajectory, settings, ts: Array) -> Trajectory:
    """Return the trajectory with its errors by `run(settings)`, if it is short enough; not while JAX is tracing."""
    if not is_among(first.result, ENDED_WELL):
        return _unknown(first, first.result)
    steps = int(first.stats["num_accepted_steps"])
    if steps > settings.repeated_up_to or not _can_be_closer(settings):
        return _unknown(first)
    return _compared(np, first, run(_closer(np, settings, steps, np.asarray(first.end.t), ts)), ts)


def with_errors_inside(run: Callable, first: Trajectory, settings, ts: Array) -> Trajectory:
    """Do the same in a traced program, without derivatives of the errors."""
    if not _can_be_closer(settings):
        return _unknown(first)
    known, settings, ts = stop_gradient((first, settings, ts))
    second = stop_gradient(run(_closer(jnp, settings, known.stats["num_accepted_steps"], known.end.t, ts)))
    found = _compared(jnp, known, second, ts)
    excess = jnp.where(ended_well(known.result), found.scaled_error, first.scaled_error)
    return replace(first, error=found.error, scaled_error=excess)


def _fixed(controller):
    return isinstance(controller, diffrax.ConstantStepSize)


def _can_be_closer(settings):
    return settings.controller is None or _fixed(settings.controller) and settings.dt0 is not None


def _closer(xp: ModuleType, settings, steps: Any, end: Any, ts: Array):
    """Return the settings of the second run, after a first one of `steps` steps to the time `end`."""
    if settings.controller is not None:
        return replace(settings, dt0=settings.dt0 / 2)
    # Looser if tighter would be below round-off: the difference is then the error of the second run, the larger one.
    scale = xp.where(settings.rtol / TIGHTER >= ROUND_OFFS * np.finfo(ts.dtype).eps, 1 / TIGHTER, TIGHTER)
    per_output = steps / xp.maximum(1, xp.sum(ts < end))
    limited = steps * settings.max_step * LIMITED <= end - ts[0]
    longest = xp.where(limited, settings.max_step / 2, settings.max_step)
    pieces = xp.where(per_output <= FEW, xp.maximum(1, xp.ceil(per_output - UNCOUNTED)) + 1, MANY)
    values = settings.rtol * scale, settings.atol * scale, longest, xp.stack([xp.asarray(FIRST), 1 / pieces])
    rtol, atol, longest, shares = (x.astype(ts.dtype) for x in values)
    return replace(settings, rtol=rtol, atol=atol, max_step=longest, shares=shares)


def _compared(xp: ModuleType, first, second, ts: Array) -> Trajectory:
    """Return the first trajectory with its errors: the difference of the two, plus the least effect of round-off."""
    steps = xp.asarray(second.stats["num_accepted_steps"])
    share = ROUND_OFF * np.finfo(ts.dtype).eps * xp.sqrt(1.0 + steps)
    x, y, well = _columns(xp, first), _columns(xp, second), True
    if xp is jnp or np.isnan(y).any():
        # The second run, which an event may have ended a little sooner, keeps its last state after its end.
        well = ended_well(second.result) if xp is jnp else is_among(second.result, ENDED_WELL)
        y = xp.where(xp.isnan(y) & well, _columns(xp, second.end), y)
    # Outputs that were not reached are NaN, and come last.
    sizes = np.fmax.accumulate(abs(x)) if xp is np else lax.cummax(jnp.nan_to_num(abs(x)))
    errors = (abs(x - y) + share * sizes).astype(ts.dtype)
    both = {name: (xp.asarray(found.t), xp.asarray(second.events[name].t)) for name, found in first.events.items()}
    times = {name: _of_times(xp, *pair, share) for name, pair in both.items()}
    found = Errors(*_like_trajectory(errors, first), times, second.result, steps)

    def of_motion(row):
        return row[: 2 * sum(np.size(x) for x in jax.tree.leaves(first.end.q))].reshape(2, -1)

    worst = of_motion(np.fmax.reduce(errors) if xp is np else jnp.nanmax(errors, axis=0))
    excess = scaled_error(xp, worst, of_motion(sizes[-1]), first, ts, tuple(map(xp.asarray, first.tolerance)))
    if well is not True:
        # Where the second run failed, no error is known from there on.
        excess = xp.where(well, excess, xp.maximum(excess, xp.asarray(first.scaled_error))).astype(ts.dtype)
    return replace(first, error=found, scaled_error=excess)


def _unknown(first, result=RESULTS.not_estimated) -> Trajectory:
    nothing = jax.tree.map(lambda x: np.full(x.shape, np.nan, x.dtype), (first.q, first.v, first.multipliers))
    times = {name: np.full(found.t.shape, np.nan, found.t.dtype) for name, found in first.events.items()}
    return replace(first, error=Errors(*nothing, times, result, np.zeros((), int)))


def _columns(xp: ModuleType, of):
    """Return coordinates, velocities and multipliers as columns, one row for each instant."""
    return columns(xp, (of.q, of.v, of.multipliers), rows=np.size(of.t))


def _like_trajectory(errors, first):
    leaves, structure = jax.tree.flatten((first.q, first.v, first.multipliers))
    ends = np.cumsum([x.size // len(errors) for x in leaves])
    parts = (errors[:, end - x.size // len(errors) : end].reshape(x.shape) for x, end in zip(leaves, ends))
    return jax.tree.unflatten(structure, parts)


def _of_times(xp: ModuleType, first, second, share: Any):
    found = xp.where(xp.isnan(second), np.inf, abs(first - second) + share * abs(first))
    return xp.where(xp.isnan(first), np.nan, found).astype(first.dtype)
