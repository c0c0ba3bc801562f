"""How wrong a motion is: the same motion once more, ten times more precisely.

A tolerance bounds the error of a step; what a motion makes of these errors, no method knows. The same compiled program
run with tolerances ten times tighter has a tenth of the error, so that the difference of the two is the error of the
first, but for a tenth of it. Also where the motion amplifies errors until nothing is left, since it amplifies the
difference alike, and round-off, which differs in the two as the steps do.

Where something else chooses the steps, both runs would take the same ones. Fixed steps are halved, and so are those
that `max_step` shortens; outputs are reached in one step more than there were; the first step is a shorter one.

Source: Hairer, Nørsett & Wanner, *Solving ODEs I*, §II.4 (global error by a second tolerance).
"""

from collections.abc import Callable
from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from lagjax.jax_internals.tracing import is_eager
from lagjax.motion.accuracy import Errors, columns, scaled_error
from lagjax.motion.consistency import stopped
from lagjax.motion.results import ENDED_WELL, RESULTS, ended_well, is_among
from lagjax.motion.trajectory import Trajectory

# The tightest tolerance that is not below round-off.
ROUND_OFFS = 8
TIGHTER = 10.0
# A motion of more steps is not integrated again unless that is asked for.
STEPS_AT_MOST = 20_000
# Steps from one output to the next up to which outputs may have chosen them. The first steps are short: so much of a
# step to an output does not count.
FEW, BUT_FOR = 4, 0.2
# The least steps to an output where most take more, and the share of the first step that is taken.
MANY, FIRST = 3.0, 0.7
# Steps that are nearly as long as `max_step` all the way.
LIMITED = 0.7
# Of the size of a number and the square root of the steps: what round-off adds at least.
ROUND_OFF = 3.0


def steps_to_repeat(asked: bool | None, controller, progress: bool) -> np.ndarray:
    """The most steps of a motion that is integrated again; raise where `asked` is neither None, True nor False."""
    if not (asked is None or isinstance(asked, (bool, np.bool_))):
        raise TypeError(
            f"estimate_error must be True, False or None, not {asked!r}.\nFix: estimate_error=True, or leave it out."
        )
    ours = controller is None or _fixed(controller)
    by_default = STEPS_AT_MOST if is_eager() and ours and not progress else 0
    limits = {None: by_default, True: np.iinfo(np.int32).max, False: 0}
    return np.asarray(limits[None if asked is None else bool(asked)], np.int32)


def with_errors(run: Callable, first: Trajectory, settings, ts) -> Trajectory:
    """A trajectory with its errors by `run(settings)`, where it is short enough; not while JAX is tracing."""
    if not is_among(first.result, ENDED_WELL):
        return _unknown(first, first.result)
    steps = int(first.stats["num_accepted_steps"])
    if steps > settings.repeated_up_to or not _can_be_closer(settings):
        return _unknown(first)
    return _compared(np, first, run(_closer(np, settings, steps, np.asarray(first.end.t), ts)), ts)


def with_errors_inside(run: Callable, first: Trajectory, settings, ts) -> Trajectory:
    """The same in a program, through which no derivatives go."""
    if not _can_be_closer(settings):
        return _unknown(first)
    known, settings, ts = stopped((first, settings, ts))
    second = stopped(run(_closer(jnp, settings, known.stats["num_accepted_steps"], known.end.t, ts)))
    found = _compared(jnp, known, second, ts)
    return replace(first, error=found.error, scaled_error=found.scaled_error)


def _fixed(controller):
    return isinstance(controller, diffrax.ConstantStepSize)


def _can_be_closer(settings):
    return settings.controller is None or _fixed(settings.controller) and settings.dt0 is not None


def _closer(xp, settings, steps, end, ts):
    """The settings of a second run, after a first one of so many steps to the time `end`."""
    if settings.controller is not None:
        return replace(settings, dt0=settings.dt0 / 2)
    # Below round-off the other way: the difference is then what the looser run is off, and more than this one.
    scale = xp.where(settings.rtol / TIGHTER >= ROUND_OFFS * np.finfo(ts.dtype).eps, 1 / TIGHTER, TIGHTER)
    an_output = steps / xp.maximum(1, xp.sum(ts < end))
    limited = steps * settings.max_step * LIMITED <= end - ts[0]
    longest = xp.where(limited, settings.max_step / 2, settings.max_step)
    pieces = xp.where(an_output <= FEW, xp.maximum(1, xp.ceil(an_output - BUT_FOR)) + 1, MANY)
    values = settings.rtol * scale, settings.atol * scale, longest, xp.stack([xp.asarray(FIRST), 1 / pieces])
    rtol, atol, longest, shares = (x.astype(ts.dtype) for x in values)
    return replace(settings, rtol=rtol, atol=atol, max_step=longest, shares=shares)


def _compared(xp, first, second, ts) -> Trajectory:
    """The first trajectory with what the two differ by, and with what round-off adds at least."""
    steps = xp.asarray(second.stats["num_accepted_steps"])
    share = ROUND_OFF * np.finfo(ts.dtype).eps * xp.sqrt(1.0 + steps)
    x, y = _columns(xp, first), _columns(xp, second)
    if xp is jnp or np.isnan(y).any():
        # After its end the second run, which an event may have ended a little sooner, stays there.
        well = ended_well(second.result) if xp is jnp else is_among(second.result, ENDED_WELL)
        y = xp.where(xp.isnan(y) & well, _columns(xp, second.end), y)
    # NaN where nothing was reached, which comes last.
    sizes = np.fmax.accumulate(abs(x)) if xp is np else lax.cummax(jnp.nan_to_num(abs(x)))
    errors = (abs(x - y) + share * sizes).astype(ts.dtype)
    of_times = lambda name, found: _of_times(xp, xp.asarray(found.t), xp.asarray(second.events[name].t), share)
    times = {name: of_times(name, found) for name, found in first.events.items()}
    found = Errors(*_in_their_places(errors, first), times, second.result, steps)
    of_motion = lambda row: row[: 2 * sum(np.size(x) for x in jax.tree.leaves(first.end.q))].reshape(2, -1)
    worst = of_motion(np.fmax.reduce(errors) if xp is np else jnp.nanmax(errors, axis=0))
    excess = scaled_error(xp, worst, of_motion(sizes[-1]), first, ts, tuple(map(xp.asarray, first.tolerance)))
    return replace(first, error=found, scaled_error=excess)


def _unknown(first, result=RESULTS.not_estimated) -> Trajectory:
    nothing = jax.tree.map(lambda x: np.full(x.shape, np.nan, x.dtype), (first.q, first.v, first.multipliers))
    times = {name: np.full(found.t.shape, np.nan, found.t.dtype) for name, found in first.events.items()}
    return replace(first, error=Errors(*nothing, times, result, np.zeros((), int)))


def _columns(xp, of):
    """Coordinates, velocities and multipliers in columns, a row an instant."""
    return columns(xp, (of.q, of.v, of.multipliers), rows=np.size(of.t))


def _in_their_places(errors, first):
    leaves, structure = jax.tree.flatten((first.q, first.v, first.multipliers))
    ends = np.cumsum([x.size // len(errors) for x in leaves])
    parts = (errors[:, end - x.size // len(errors) : end].reshape(x.shape) for x, end in zip(leaves, ends))
    return jax.tree.unflatten(structure, parts)


def _of_times(xp, first, second, share):
    found = xp.where(xp.isnan(second), np.inf, abs(first - second) + share * abs(first))
    return xp.where(xp.isnan(first), np.nan, found).astype(first.dtype)
