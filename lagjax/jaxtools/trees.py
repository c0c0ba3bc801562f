"""Operations on all arrays of a tree at once; everything else in it stays as it is."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, PyTree


def stop_gradient(tree: PyTree):
    """The tree without derivatives.

    >>> print(jax.grad(lambda x: x * stop_gradient({"x": x})["x"])(3.0))
    3.0
    """
    return jax.tree.map(lambda leaf: lax.stop_gradient(leaf) if eqx.is_array(leaf) else leaf, tree)


def without_init(cls: type, fields: Mapping[str, Any]):
    """An instance with these fields, whose own `__init__` is not called: it would check, or take long.

    >>> print(without_init(type("Pair", (), {}), {"re": 1.0}).re)
    1.0
    """
    made = object.__new__(cls)
    for name, x in fields.items():
        object.__setattr__(made, name, x)
    return made


def where(condition, a, b):
    """The arrays of `a` where the condition holds, else those of `b`, in the dtypes of these."""
    return jax.tree.map(
        lambda x, y: jnp.where(condition, x, y).astype(jnp.result_type(y)) if eqx.is_array(y) else y, a, b
    )


def like(mask, x):
    """A mask of rows or lanes with as many axes as x has."""
    return mask.reshape(mask.shape + (1,) * (jnp.ndim(x) - jnp.ndim(mask)))


def decided(truth: Bool[Array, "..."]) -> Bool[Array, "..."]:
    """The same truth value, behind a quotient.

    On a CPU, XLA copies what a selection depends on into each selection of single numbers, but computes a quotient
    once. A test of all results that decides about each of them would be compiled as often as there are results.
    """
    return 1.0 / jnp.where(truth, 1.0, -1.0) > 0
