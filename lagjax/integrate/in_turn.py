"""Lanes of a `vmap` one after the other, for a search by motions whose lanes take differently many steps."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from lagjax.integrate.settings import PATIENCE
from lagjax.jaxtools import WATCHED


def in_turn(function: Callable, *args) -> PyTree:
    """`function(*args)`; on a CPU lanes of a `vmap` run one after the other, which compiles once and wastes no steps.

    Motions that a search tries do not report to a surrounding sweep.

    >>> print(jax.vmap(lambda x: in_turn(jnp.sqrt, x))(jnp.array([1.0, 4.0])))
    [1. 2.]
    """
    live, static = eqx.partition(args, eqx.is_array)
    rest = []

    def run(live: PyTree):
        with WATCHED(False), PATIENCE(None):
            found, others = eqx.partition(function(*eqx.combine(live, static)), eqx.is_array)
        rest.append(others)
        return found

    if jax.default_backend() == "cpu":
        run = jax.custom_batching.sequential_vmap(run)
    return eqx.combine(run(jax.tree.map(jnp.asarray, live)), rest[-1])
