"""Steps that end where outputs are wanted.

An output inside a step costs a step of its own, or a polynomial of lower order than the method. Here the step before an
output is shortened to end there, or the last two are made equal; the size that was proposed before is kept for the step
after it. Outputs then cost nothing but the steps they shorten.
"""

import diffrax
import jax.numpy as jnp
from jaxtyping import Array, Float


class Arriving(diffrax.AbstractStepSizeController):
    """Wrap `controller`: each of the increasing times `ts` is the end of a step."""

    controller: diffrax.AbstractStepSizeController
    ts: Float[Array, " T"]

    def wrap(self, direction):
        """The same for time in this direction, which is always forward."""
        return Arriving(self.controller.wrap(direction), self.ts)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        """The first step."""
        proposed, state = self.controller.init(terms, t0, t1, y0, dt0, args, func, error_order)
        index = jnp.minimum(1, self.ts.size - 1)
        return self._toward(index, t0, proposed - t0), (state, index, proposed - t0)

    def adapt_step_size(self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state):
        """Whether to keep a step, and the next one."""
        state, index, before = controller_state
        keep, next_t0, next_t1, jumped, state, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, state
        )
        proposed = next_t1 - next_t0
        # A step that was shortened says nothing against the size that had been proposed.
        proposed = jnp.where(keep, jnp.maximum(proposed, jnp.where(t1 - t0 < before, before, 0.0)), proposed)
        index = jnp.where(keep & (t1 >= self.ts[index]), jnp.minimum(index + 1, self.ts.size - 1), index)
        return keep, next_t0, self._toward(index, next_t0, proposed), jumped, (state, index, proposed), result

    def _toward(self, index, t, step):
        left = self.ts[index] - t
        halfway = t + jnp.where(step < 0.5 * left, step, 0.5 * left)
        # At the last time there is nothing left, and diffrax ends the solve.
        return jnp.where((step < left) | (left <= 0), jnp.where(left > 0, halfway, t + step), self.ts[index])
