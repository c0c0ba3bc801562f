"""Steps that end where outputs are wanted.

An output inside a step costs a step of its own, or a polynomial of lower order than the method. Here the step before an
output is shortened to end there, or the last two are made equal; the size that was proposed before is kept for the step
after it. Outputs then cost nothing but the steps they shorten.

Times at which a force jumps are ends of steps, too, and each step stays on its own side of them: it begins and ends a
few units of round-off beside a jump, so that the function is not asked at the jump itself.
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from lagjax.mechanics.equations import Equations
from lagjax.motion.tolerances import Weighing

# The first step as it is proposed, and no longest one. Infinite, the share of an empty pause would be no number.
WHOLE_STEPS = 1.0, 1e30
# The distance kept from a jump, in round-offs of the time: a user computes the same time in two ways.
BESIDE = 4


class Arriving(diffrax.AbstractStepSizeController):
    """Wrap `controller`: each of the increasing times `ts` is the end of a step.

    `shares`: of the first step that is proposed, that which is taken; and of the time from one of `ts` to the next, the
    longest step.
    """

    controller: diffrax.PIDController | Weighing
    ts: Float[Array, " T"]
    shares: Float[Array, " 2"]

    def wrap(self, direction):
        """The same for time in this direction, which is always forward."""
        return Arriving(self.controller.wrap(direction), self.ts, self.shares)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first step."""
        proposed, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        index, step = jnp.minimum(1, self.ts.size - 1), self.shares[0] * (proposed - t0)
        return self._toward(index, t0, step), (state, index, step)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Whether to keep a step, and the next one."""
        state, index, before = controller_state
        # Times asked for may be closer than the least step, which is no reason to give up.
        least = self.controller.dtmin
        judged = t1 if least is None else jnp.maximum(t1, t0 + 2 * least)
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, judged, y0, y1_candidate, args, y_error, error_order, state
        )
        proposed = next_t1 - next_t0
        next_t0 = next_t0 if least is None else jnp.where(keep, t1, t0)
        # A step that was shortened says nothing against the size that had been proposed.
        proposed = jnp.where(keep, jnp.maximum(proposed, jnp.where(t1 - t0 < before, before, 0.0)), proposed)
        index = jnp.where(keep & (t1 >= self.ts[index]), jnp.minimum(index + 1, self.ts.size - 1), index)
        return keep, next_t0, self._toward(index, next_t0, proposed), jumped, (state, index, proposed), result

    def _toward(self, index, t, step):
        left = self.ts[index] - t
        step = jnp.minimum(step, self.shares[1] * (self.ts[index] - self.ts[index - 1]))
        halfway = t + jnp.where(step < 0.5 * left, step, 0.5 * left)
        # At the last time there is nothing left, and diffrax ends the solve.
        return jnp.where((step < left) | (left <= 0), jnp.where(left > 0, halfway, t + step), self.ts[index])


def together(ts: Float[Array, " T"], jump_ts: Float[Array, " J"]) -> Float[Array, " T+J"]:
    """The increasing times `ts` and the jumps between the first and the last, each once; filled with the last."""
    # Of equal times the jump is kept, for the derivative by it.
    times = jnp.sort(jnp.concatenate([jnp.clip(jump_ts, ts[0], ts[-1]), ts]), stable=True)
    again = jnp.concatenate([jnp.zeros_like(times[:1], bool), times[1:] == times[:-1]])
    return jnp.sort(jnp.where(again, ts[-1], times), stable=True)


def between_jumps(t0, t1, jump_ts, made_jump):
    """A step from t0 to t1 that touches no jump at its ends, and whether it starts at one."""
    beside = _round_off(jnp.maximum(jnp.abs(t0), jnp.abs(t1)))
    at = lambda t: jnp.any(t == jump_ts)
    starts, ends, room = at(t0), at(t1), t1 - t0 > 4 * beside
    t1 = jnp.where(ends & room, t1 - beside, t1)
    return jnp.where(starts & room, t0 + beside, t0), t1, starts | made_jump


def apart_from_jumps(equations: Equations, ts, jump_ts, q, v):
    """The outputs; one at the time of a jump does not move with the jump, as the end of its step does.

    `late` is zero, and its derivative that of the difference.
    """
    same = ts[:, None] == jump_ts[None, :]
    late = jnp.where(jnp.any(same, axis=1), ts - jump_ts[jnp.argmax(same, axis=1)], 0.0)
    before = ts - _round_off(jnp.abs(ts))
    a = jax.vmap(lambda t, q, v: equations.accelerations(t, q, v)[0])(before, q, v)
    along = lambda x, rate: x + late.reshape(-1, *[1] * (x.ndim - 1)) * lax.stop_gradient(rate)
    return jax.tree.map(along, q, v), jax.tree.map(along, v, a)


def _round_off(t):
    return BESIDE * np.finfo(t.dtype).eps * t
