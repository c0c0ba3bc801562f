"""The time of an event inside a step: a bracketing search that is satisfied with a change of sign.

`optimistix.Bisection` raises where its interval holds no root and asks for a small function value besides a small
interval. Neither suits events: a batch mixes lanes with and without one, and the unit of the function is the user's.
"""

from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int


class _Bracket(NamedTuple):
    """The sign changes between `a`, where the function was asked last, and `b`; `c` was one of them before."""

    a: Float[Array, ""]
    b: Float[Array, ""]
    c: Float[Array, ""]
    fa: Float[Array, ""]
    fb: Float[Array, ""]
    fc: Float[Array, ""]
    asked: Int[Array, ""]


class SignChange(optx.AbstractRootFinder):
    """Narrow `[lower, upper]` around the change of sign until it is `atol + rtol |y|` wide.

    By inverse quadratic interpolation where that can be trusted, else by halves: about ten evaluations of a smooth
    function, each a step of the solver. Without a change of sign it ends at `upper`: the end of the step, which is
    where diffrax puts a lane without an event and a condition that is true or false.

    Source: Chandrupatla, *Advances in Engineering Software* 28 (1997) 145.
    """

    rtol: float
    atol: Float[Array, ""] | float
    norm: ClassVar = staticmethod(jnp.abs)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        """Nothing is known yet."""
        lower, upper = options["lower"], options["upper"]
        zero = jnp.zeros_like(lower)
        return _Bracket(lower, upper, lower, zero, zero, zero, jnp.asarray(0))

    def step(self, fn, y, args, options, state, tags):
        """Ask once more, at the lower end first and then at the upper one, and keep where the sign changes."""
        at = jnp.where(state.asked == 0, options["lower"], y)
        value, aux = fn(at, args)
        # Of several conditions diffrax leaves the one that was met and sets the others to zero.
        f = sum(jax.tree.leaves(value))
        a, b, c, fa, fb, fc, asked = state
        same = (asked == 0) | ((f < 0) == (fa < 0))
        c, fc = jnp.where(same, a, b), jnp.where(same, fa, fb)
        b, fb = jnp.where(same, b, a), jnp.where(same, fb, fa)
        state = _Bracket(at, b, c, f, fb, fc, asked + 1)
        y = jnp.where(asked == 0, options["upper"], self._next(state))
        ended, _ = self.terminate(fn, y, args, options, state, tags)
        return jnp.where(ended, jnp.where(jnp.abs(f) < jnp.abs(fb), at, b), y), state, aux

    def terminate(self, fn, y, args, options, state, tags):
        """Whether the interval is small."""
        return (state.asked > 1) & (jnp.abs(state.b - state.a) <= self._width(state)), optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """The end of the last interval at which the function is smaller."""
        return y, aux, {}

    def _width(self, state):
        return self.atol + self.rtol * jnp.abs(state.a)

    def _next(self, state):
        a, b, c, fa, fb, fc, _ = state
        safe = lambda x: jnp.where(x == 0, 1.0, x)
        xi, phi = (a - b) / safe(c - b), (fa - fb) / safe(fc - fb)
        trusted = (phi**2 < xi) & ((1 - phi) ** 2 < 1 - xi)
        from_b = fa / safe(fb - fa) * fc / safe(fb - fc)
        from_c = (c - a) / safe(b - a) * fa / safe(fc - fa) * fb / safe(fc - fb)
        least = jnp.minimum(0.5 * self._width(state) / safe(jnp.abs(b - a)), 0.5)
        share = jnp.clip(jnp.where(trusted, from_b + from_c, 0.5), least, 1 - least)
        return a + share * (b - a)
