"""Sampled controls as laws: at the instants offset + k every a held output becomes what its controller says.

The mode is the number k of the next instant, and its guard the time until then.

Source: Åström & Wittenmark, *Computer-Controlled Systems*, §2.3.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax.integrate.coefficients import coefficient
from lagjax.jaxtools import stop_gradient

# Instants within this many round-offs of a time are at that time.
AT_ONCE = 8


class Sampled(eqx.Module):
    """A controller with its instants; `place`: that of its mode."""

    name: str = eqx.field(static=True)
    controller: Callable
    every: Any
    offset: Any
    place: int = eqx.field(static=True)

    def instant(self, k: Int[Array, ""], t: Array, params: PyTree) -> Float[Array, ""]:
        """The time of the k-th instant."""
        every, offset = (coefficient(x, t, params) for x in (self.every, self.offset))
        return offset + k * every

    def first(self, t: Array, params: PyTree) -> Int[Array, ""]:
        """The number of the first instant that is not before t."""
        t, params = stop_gradient((t, params))
        every, offset = (coefficient(x, t, params) for x in (self.every, self.offset))
        return jnp.maximum(jnp.ceil((t - offset - self.slack(t, params)) / every), 0.0).astype(int)

    def acts(self, k: Int[Array, ""], t: Array, params: PyTree) -> Bool[Array, ""]:
        """Whether the k-th instant is at t, or before."""
        t, params = stop_gradient((t, params))
        return self.instant(k, t, params) - t <= self.slack(t, params)

    def slack(self, t: Array, params: PyTree) -> Float[Array, ""]:
        """How far apart round-off may take two times that are one."""
        t, params = stop_gradient((t, params))
        sizes = jnp.abs(t) + jnp.abs(coefficient(self.offset, t, params))
        return AT_ONCE * jnp.finfo(t.dtype).eps * (sizes + coefficient(self.every, t, params))
