"""Warnings of input that the library can integrate but that is hardly ever meant; given where values are not traced.

A force given in place of Rayleigh's function R is odd in the velocities, R(-v) = -R(v), as -c v is. The power that it
takes, v·∂R/∂v, then changes its sign with v, so that it gives to one motion what it takes from the reversed one, which
no dissipation does. An R that is merely not even may be right: in a medium that moves with w it is ½ c (v - w)², which
has an even and an odd part.
"""

import weakref
from collections.abc import Callable
from types import FunctionType

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.jaxtools import at_once, compiled, is_traced
from lagjax.system import State, coordinates, warn

# Round-off of an R with several terms, in units of the last place.
ROUND_OFFS = 100
# Functions already checked and found correct: this saves 1 ms a call.
_in_order = weakref.WeakSet()


def warn_of_odd_dissipation(dissipation: Callable | None, state: State) -> None:
    """Warn if R changes its sign with the velocities. Nothing is checked if the values are traced."""
    known = isinstance(dissipation, FunctionType) and dissipation in _in_order
    if dissipation is None or known or is_traced(state):
        return
    t, q, v, params = coordinates.as_arrays(state, state.t.dtype)
    # While JAX traces something else, values that it does not trace can still be checked.
    with at_once():
        both = _both_ways(dissipation, t, q, _without_zeros(v), params)
    if is_traced(both):
        return
    plus, minus = map(float, both)
    if plus != 0 and abs(plus + minus) <= ROUND_OFFS * float(jnp.finfo(t.dtype).eps) * abs(plus):
        name = getattr(dissipation, "__name__", "f")
        name = "f" if name == "<lambda>" else name
        warn(
            "dissipation R(t, q, v, params) changes its sign with v, R(-v) = -R(v): it gives as much energy to one "
            "motion as it takes from the reversed one.\n"
            "Usual cause: a force given in place of Rayleigh's function R, whose force is -∂R/∂v.\n"
            f"Fix: force={name}, if -c v is meant as a force; or R = 0.5 c v², whose force is -c v. Friction of "
            "constant size has R = c |v|.",
            UserWarning,
        )
    elif isinstance(dissipation, FunctionType):
        _in_order.add(dissipation)


@compiled
def _both_ways(dissipation: Callable, t: Array, q: PyTree, v: PyTree, params: PyTree):
    return [dissipation(t, q, jax.tree.map(lambda x: sign * x, v), params) for sign in (1, -1)]


def _without_zeros(v: PyTree):
    """The velocities, each zero replaced by an irregular number."""
    flat = coordinates.vector(v)
    usual = np.max(np.abs(flat)) or 1.0
    irregular = usual * (0.5 + np.modf(0.6180339887 * np.arange(1, len(flat) + 1))[0])
    return coordinates.like(v, np.where(flat == 0, irregular, flat).astype(flat.dtype))
