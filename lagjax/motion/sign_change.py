"""The time of an event inside a step: bisection that is satisfied with a change of sign.

`optimistix.Bisection` raises where its interval holds no root and asks for a small function value besides a small
interval. Neither suits events: a batch mixes lanes with and without one, and the unit of the function is the user's.
"""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float


class _Bracket(eqx.Module):
    lower: Float[Array, ""]
    upper: Float[Array, ""]
    starts_negative: Bool[Array, ""]


class SignChange(optx.AbstractRootFinder):
    """Halve `[lower, upper]` around the change of sign until it is `atol + rtol |y|` wide.

    Without a change of sign it ends at `upper`: the end of the step, which is where diffrax puts a lane without an
    event and a condition that is true or false.
    """

    rtol: float
    atol: Float[Array, ""] | float
    norm: ClassVar = staticmethod(jnp.abs)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Look at the sign at the lower end."""
        value, _ = fn(options["lower"], args)
        return _Bracket(options["lower"], options["upper"], _negative(value))

    def step(self, fn, y, args, options, state, tags):
        """Keep the half in which the sign changes."""
        value, aux = fn(y, args)
        unchanged = _negative(value) == state.starts_negative
        lower, upper = jnp.where(unchanged, y, state.lower), jnp.where(unchanged, state.upper, y)
        return lower + 0.5 * (upper - lower), _Bracket(lower, upper, state.starts_negative), aux

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the interval is small."""
        return state.upper - state.lower <= self.atol + self.rtol * jnp.abs(y), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """The middle of the last interval."""
        return y, aux, {}


def _negative(value):
    # Of several conditions diffrax leaves the one that was met and sets the others to zero.
    return sum(jax.tree.leaves(value)) < 0
