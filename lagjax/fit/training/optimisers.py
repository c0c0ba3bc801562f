"""Optimisers of optax: pairs of functions, `init(params)` and `update(gradients, state, params)`.

They get the fitted numbers in the structure of `params`, with None in place of all others, so that transformations that
go by names (`optax.multi_transform`, `optax.masked`) work. Numbers with bounds are passed as unbounded ones. If only
some entries of an array are fitted, these are passed as a vector.
"""

import inspect
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from lagjax.fit.problem.parameters import FreeNumbers
from lagjax.jaxtools.jaxpr_identity import Meaning, content_of, meaning_of


def is_of_optax(optimiser: Any) -> bool:
    """Whether something looks like a gradient transformation of optax."""
    return isinstance(optimiser, tuple) and all(callable(getattr(optimiser, x, None)) for x in ("init", "update"))


class Optimiser:
    """A gradient transformation, equal to all that do the same: `optax.adam(1e-2)` is a new object in each call."""

    def __init__(self, given: Any, found: FreeNumbers):
        self.given = given
        # Some take the value, too, such as `optax.contrib.reduce_on_plateau`.
        kinds = [p.kind for p in inspect.signature(given.update).parameters.values()]
        self.takes_value = inspect.Parameter.VAR_KEYWORD in kinds
        programs = jax.make_jaxpr(partial(self._first_step, found))(found.free(found.start))
        self.meaning = Meaning((meaning_of(programs.jaxpr), tuple(map(content_of, programs.consts))))

    def _first_step(self, found, y):
        value = jnp.sum(y)
        return self.step(found, y, y, self.init(found, y), value, lambda y: value)

    def __hash__(self):
        return hash(self.meaning)

    def __eq__(self, other):
        return isinstance(other, Optimiser) and self.meaning == other.meaning

    def init(self, found: FreeNumbers, y):
        """The state of the optimiser at free numbers `y` (p,)."""
        return self.given.init(as_params(found, y))

    def step(self, found: FreeNumbers, y, slopes, state, value, value_of):
        """Free numbers after a step, and the state; `value` is that of the function `value_of(y)` with these slopes."""
        more = {}
        if self.takes_value:
            value_of_tree = lambda tree: value_of(as_vector(tree, y))
            more = {"value": value, "grad": as_params(found, slopes), "value_fn": value_of_tree}
        changes, state = self.given.update(as_params(found, slopes), state, as_params(found, y), **more)
        return y + as_vector(changes, y), state


def as_params(found: FreeNumbers, y):
    """Numbers (p,) in the structure of `params`, with None in place of numbers that are not fitted."""
    leaves, structure = jtu.tree_flatten(found.params)
    chosen: list[Any] = [None] * len(leaves)
    at = 0
    for number, places in found.leaves:
        shape = leaves[number].shape if places is None else (len(places),)
        size = leaves[number].size if places is None else len(places)
        chosen[number] = y[at : at + size].reshape(shape)
        at += size
    return jtu.tree_unflatten(structure, chosen)


def as_vector(tree, like):
    """All numbers of a tree as a vector, with the dtype of `like`."""
    leaves = [jnp.ravel(x).astype(like.dtype) for x in jax.tree.leaves(tree)]
    return jnp.concatenate(leaves) if leaves else jnp.zeros_like(like)
