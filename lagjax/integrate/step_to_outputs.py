"""Steps that end where outputs are wanted.

An output inside a step costs a step of its own, or a polynomial of lower order than the method. Here the step before an
output is shortened to end there, or the last two are made equal; the size proposed before is kept for the step after
it. Outputs then cost nothing apart from the steps that they shorten.

Times at which a force jumps are ends of steps, too, and each step stays on its own side of them: it begins and ends a
few units of round-off away from a jump, so that the force is never evaluated at the jump itself.

A motion whose steps have collapsed is not stepped until `max_steps`: it ends after `TRIES` attempts in a row, accepted
or rejected, after each of which the proposed step was so short that a hundred times `max_steps` of such steps would not
reach the last time. Attempts that end at an output do not count, so that outputs which crowd together end nothing.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, PyTree

from lagjax.integrate.tolerances import PerCoordinateTolerance
from lagjax.mechanics import Equations

# `shares` with the first step as proposed, and no longest one; an infinite share of an empty interval would be NaN.
WHOLE_STEPS = 1.0, 1e30
# The distance kept from a jump, in round-offs of the time: a user may compute the same time in two ways.
MARGIN = 4
# So many attempts take a few seconds in large systems; a collision that passes takes a few hundred.
TRIES, TIMES = 4096, 100


class StepToOutputs(diffrax.AbstractStepSizeController):
    """Wrap `controller`: each of the increasing times `ts` is the end of a step.

    `shares`: the part of the proposed first step that is taken; and the longest step, as a part of the interval between
    two of `ts`. `max_steps`: None if a motion may take as many as it wants.
    """

    controller: diffrax.PIDController | PerCoordinateTolerance
    ts: Float[Array, " T"]
    shares: Float[Array, " 2"]
    max_steps: int | None = eqx.field(static=True, default=None)

    def wrap(self, direction):
        """Wrap the inner controller likewise; `ts` stay, since time always runs forward here."""
        return StepToOutputs(self.controller.wrap(direction), self.ts, self.shares, self.max_steps)

    def init(
        self, terms: diffrax.AbstractTerm, t0: Array, t1: Array, y0: PyTree, dt0: Any, args: PyTree, func: Callable,
        error_order: Any,
    ):  # fmt: skip
        """Choose the first step."""
        proposed, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        index, step = jnp.minimum(1, self.ts.size - 1), self.shares[0] * (proposed - t0)
        return self._toward(index, t0, step), (state, index, step, jnp.asarray(0))

    def adapt_step_size(
        self, t0: Array, t1: Array, y0: PyTree, y1_candidate: PyTree, args: PyTree, y_error: PyTree, error_order: Any,
        controller_state: PyTree,
    ):  # fmt: skip
        """Decide whether to keep a step, and choose the next one."""
        state, index, before, short = controller_state
        # Output times may be closer together than the least step; that must not end the solve.
        least = self.controller.dtmin
        judged = t1 if least is None else jnp.maximum(t1, t0 + 2 * least)
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, judged, y0, y1_candidate, args, y_error, error_order, state
        )
        proposed = next_t1 - next_t0
        if least is not None:
            # The step itself was rejected, not the longer one that was judged, or it would be tried again for ever.
            proposed = jnp.where(keep, proposed, proposed * ((t1 - t0) / (judged - t0)))
            result = diffrax.RESULTS.where(~keep & (proposed < least), diffrax.RESULTS.dt_min_reached, result)
        next_t0 = next_t0 if least is None else jnp.where(keep, t1, t0)
        # That a step was shortened is no reason to reduce the size proposed before it.
        proposed = jnp.where(keep, jnp.maximum(proposed, jnp.where(t1 - t0 < before, before, 0.0)), proposed)
        if self.max_steps is not None:
            longer = TIMES * self.max_steps * proposed > self.ts[-1] - next_t0
            short = jnp.where(longer, 0, jnp.where(t1 < self.ts[index], short + 1, short))
            result = diffrax.RESULTS.where(short >= TRIES, diffrax.RESULTS.max_steps_rejected, result)
        index = jnp.where(keep & (t1 >= self.ts[index]), jnp.minimum(index + 1, self.ts.size - 1), index)
        return keep, next_t0, self._toward(index, next_t0, proposed), jumped, (state, index, proposed, short), result

    def _toward(self, index, t: Array, step):
        left = self.ts[index] - t
        step = jnp.minimum(step, self.shares[1] * (self.ts[index] - self.ts[index - 1]))
        halfway = t + jnp.where(step < 0.5 * left, step, 0.5 * left)
        # At the last time there is nothing left, and diffrax ends the solve. Times a round-off apart cannot be parted.
        partly = (step < left) & (halfway > t)
        return jnp.where(partly | (left <= 0), jnp.where(left > 0, halfway, t + step), self.ts[index])


def together(ts: Float[Array, " T"], jump_ts: Float[Array, " J"]) -> Float[Array, " T+J"]:
    """Merge the increasing times `ts` and the jumps between the first and last, each once; pad with the last time."""
    # If a jump and one of `ts` are equal, the jump is kept, for the derivative with respect to it.
    # Not `clip`, whose derivative is one half for a jump at the first or the last time.
    within = jnp.where(jump_ts < ts[0], ts[0], jnp.where(jump_ts > ts[-1], ts[-1], jump_ts))
    times = jnp.sort(jnp.concatenate([within, ts]), stable=True)
    repeated = jnp.concatenate([jnp.zeros_like(times[:1], bool), times[1:] == times[:-1]])
    return jnp.sort(jnp.where(repeated, ts[-1], times), stable=True)


def between_jumps(t0: Array, t1: Array, jump_ts, made_jump: Any):
    """Return the ends of the step from t0 to t1, moved off any jump, and whether it starts at one."""
    margin = _round_off(jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
    starts, ends, room = jnp.any(t0 == jump_ts), jnp.any(t1 == jump_ts), t1 - t0 > 4 * margin
    t1 = jnp.where(ends & room, t1 - margin, t1)
    return jnp.where(starts & room, t0 + margin, t0), t1, starts | made_jump


def apart_from_jumps(equations: Equations, ts: Array, jump_ts, q: PyTree, v: PyTree):
    """Return the outputs; one at the time of a jump must not move with the jump, although the end of its step does.

    `late` is zero, but its derivative is that of the difference of the two times.
    """
    # The first and the last time are those of the motion itself, and never move with a jump.
    same = (ts[:, None] == jump_ts[None, :]) & ((ts > ts[0]) & (ts < ts[-1]))[:, None]
    late = jnp.where(jnp.any(same, axis=1), ts - jump_ts[jnp.argmax(same, axis=1)], 0.0)
    before = ts - _round_off(jnp.abs(ts))
    a = jax.vmap(lambda t, q, v: equations.accelerations(t, q, v)[0])(before, q, v)

    def along(x, rate):
        return x + late.reshape(-1, *[1] * (x.ndim - 1)) * lax.stop_gradient(rate)

    return jax.tree.map(along, q, v), jax.tree.map(along, v, a)


def _round_off(t: Array):
    return MARGIN * np.finfo(t.dtype).eps * t
