"""Coefficients of laws: a number, a function of the parameters, or of a speed or depth and the parameters."""

import inspect
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree


def is_fixed(law) -> bool:
    """Whether a law is the same in all of a motion: a number, or a function of the parameters alone."""
    return not callable(law) or takes_of_coefficient(law) == ("params",)


def fixed(law, params: PyTree) -> Array:
    """The value of one that is."""
    return jnp.asarray(law(params) if callable(law) else law)


def coefficient(law, of: Array, params: PyTree) -> Array:
    """The coefficient for each of the speeds, or depths, `of`."""
    found = fixed(law, params) if is_fixed(law) else jax.vmap(lambda x: law(x, params))(of)
    return jnp.broadcast_to(jnp.asarray(found, of.dtype), of.shape)


def takes_of_coefficient(law: Callable, of: str = "speed") -> tuple[str, ...]:
    """What a coefficient takes: the parameters, or `of` before them."""
    known = getattr(law, "takes", None)
    if known is not None:
        return known
    needed = [x for x in inspect.signature(law).parameters.values() if x.default is x.empty]
    return ("params",) if len(needed) == 1 else (of, "params")
