"""Which numbers among the parameters are fitted, with their bounds and priors.

A fitted number x is searched as an unbounded one, z:

    x = z                         without bounds
    x = low + exp z               above `low`      (positive numbers: z is the logarithm)
    x = high - exp(-z)            below `high`
    x = low + (high - low) / (1 + exp(-z))         between

Weights of a network that the data hardly determine run away beside physical numbers, which then mean nothing. An entry
of `params` that is more than one array, a matrix among them, counts as a network; if other numbers are free too, each
of its weights gets a weak prior, normal about its guess.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import compress
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from lagjax.jaxtools import at_once, is_traced, numpy_of
from lagjax.mechanics import listed
from lagjax.system import coordinates

# The standard deviation of a weak prior, relative to the root mean square of the guesses of a network's weights. With
# ten times a search takes three times as many steps (a spring and a friction network, from three keys).
WEAK = 3.0


class Leaf(NamedTuple):
    """A leaf of `params` by its index, and the indices of its fitted entries; None stands for all."""

    number: int
    places: tuple[int, ...] | None


@jtu.register_dataclass
@dataclass(frozen=True, eq=False)
class FreeNumbers:
    """The numbers among `params` that a fit finds.

    - `start` (p,): where the search starts. `low`, `high` (p,): bounds, infinite where there are none.
    - `mean`, `sd` (p,): the priors; `sd` is infinite where there is none.
    - `names`: the name of each number, as the user writes it. `weak`: the entries whose weights have weak priors.
    """

    params: PyTree
    start: Float[Array, " p"]
    low: Float[Array, " p"]
    high: Float[Array, " p"]
    mean: Float[Array, " p"]
    sd: Float[Array, " p"]
    names: tuple[str, ...] = eqx.field(static=True)
    leaves: tuple[Leaf, ...] = eqx.field(static=True)
    weak: tuple[str, ...] = eqx.field(static=True, default=())

    def into(self, x: Float[Array, " p"]) -> PyTree:
        """`params` with the numbers `x` inserted."""
        leaves, structure = jtu.tree_flatten(self.params)
        at = 0
        for number, places in self.leaves:
            old = leaves[number]
            size = old.size if places is None else len(places)
            new = x[at : at + size].astype(old.dtype)
            if places is not None:
                new = _replace_entries(old, np.array(places), new)
            leaves[number] = new.reshape(old.shape)
            at += size
        return jtu.tree_unflatten(structure, leaves)

    def tree(self, y: Float[Array, " p"]) -> PyTree:
        """Numbers in the structure of `params`, with None in place of what is not fitted."""
        leaves, structure = jtu.tree_flatten(self.params)
        chosen: list[Any] = [None] * len(leaves)
        at = 0
        for number, places in self.leaves:
            shape = leaves[number].shape if places is None else (len(places),)
            size = math.prod(shape)
            chosen[number] = y[at : at + size].reshape(shape)
            at += size
        return jtu.tree_unflatten(structure, chosen)

    def vector(self, tree: PyTree) -> Float[Array, " p"]:
        """The inverse of `tree`."""
        parts = [jnp.ravel(x).astype(self.start.dtype) for x in jax.tree.leaves(tree)]
        return jnp.concatenate(parts or [jnp.zeros(0, self.start.dtype)])

    def natural(self, z: Array):
        """Numbers within their bounds from unbounded ones."""
        low, high = jnp.isfinite(self.low), jnp.isfinite(self.high)
        below, above = jnp.where(low, self.low, 0.0), jnp.where(high, self.high, 0.0)

        def z_if(taken: Bool[Array, " p"]):
            # Zeros in branches that are not taken: an overflow there would make derivatives NaN.
            return jnp.where(taken, z, 0.0)

        x = jnp.where(low & ~high, below + jnp.exp(z_if(low & ~high)), z)
        x = jnp.where(high & ~low, above - jnp.exp(-z_if(high & ~low)), x)
        return jnp.where(high & low, below + (above - below) * jax.nn.sigmoid(z_if(high & low)), x)

    def free(self, x: Array):
        """The inverse of `natural`."""
        low, high = jnp.isfinite(self.low), jnp.isfinite(self.high)
        share = (x - self.low) / jnp.where(low & high, self.high - self.low, 1.0)
        z = jnp.where(low & ~high, jnp.log(jnp.where(low & ~high, x - self.low, 1.0)), x)
        z = jnp.where(high & ~low, -jnp.log(jnp.where(high & ~low, self.high - x, 1.0)), z)
        return jnp.where(high & low, jax.scipy.special.logit(jnp.where(high & low, share, 0.5)), z)


def _replace_entries(old: Array, places: np.ndarray, new: Array):
    """All entries of `old` as a vector, some of them replaced."""
    if is_traced((old, new)):
        return jnp.ravel(old).at[places].set(new)
    row = np.array(old).ravel()
    row[places] = new
    return row


def find(
    params: PyTree,
    free: str | Iterable[str] | None,
    bounds: Mapping[str, tuple[float | None, float | None]],
    priors: Mapping[str, tuple[float, float] | None],
    dtype: Any,
    error: float = 0.0,
) -> FreeNumbers:
    """Determine the numbers to be fitted from `params`, names, bounds and priors.

    `error`: that of a measurement as residuals have it, against which weak priors are set; 0: there are none.
    """
    if not is_traced(params):
        with at_once():
            params = coordinates.given_params(params, dtype)
    named = [(leaf_name(path), x) for path, x in jtu.tree_leaves_with_path(params)]
    floating = {name: x for name, x in named if eqx.is_inexact_array(x)}
    chosen = {name: np.full(x.size, free is None) for name, x in floating.items()}
    for wanted in [free] if isinstance(free, str) else free or ():
        for name, places in _matching(wanted, floating, "free").items():
            chosen[name][places] = True
    chosen = {name: places for name, places in chosen.items() if places.any()}
    entries = [entry for name, places in chosen.items() for entry in compress(_entries(name, floating[name]), places)]
    xp = numpy_of(params)
    values = [xp.ravel(floating[name])[places].astype(dtype) for name, places in chosen.items()]
    start = xp.concatenate(values or [xp.zeros(0, dtype)])

    def spread(given: Mapping[str, tuple], default: tuple[float, float], what: str):
        by_leaf = [{name: np.full(len(places), value) for name, places in chosen.items()} for value in default]
        among = {name: floating[name] for name in chosen}
        for wanted, pair in given.items():
            _check_pair(wanted, pair, what)
            for name, places in _matching(wanted, among, what, chosen).items():
                shape = floating[name].shape if isinstance(places, slice) else (1,)
                for numbers, new in zip(by_leaf, pair):
                    if new is not None:
                        numbers[name][places] = np.broadcast_to(np.asarray(new, float), shape).ravel()
        return [np.concatenate([numbers[name][places] for name, places in chosen.items()] or [np.zeros(0)])
                for numbers in by_leaf]  # fmt: skip

    low, high = spread(bounds, (-np.inf, np.inf), "bounds")
    mean, sd = spread({name: pair for name, pair in priors.items() if pair is not None}, (0.0, np.inf), "priors")
    if np.any(sd <= 0):
        raise ValueError('the standard deviation of a prior must be positive.\nFix: priors={"g": (9.81, 0.01)}.')
    # Which network each number belongs to, counted from 1; 0 for one with a prior of its own, or with None for it.
    networks = _networks(params, chosen) if error else []
    of = spread({name: (i + 1, None) for i, name in enumerate(networks)}, (0, 0), "priors")[0]
    physical = np.any(of == 0)
    of = np.where(spread(dict.fromkeys(priors, (1, None)), (0, 0), "priors")[0], 0, of)
    weak = tuple(name for i, name in enumerate(networks) if physical and np.any(of == i + 1))
    for i, name in enumerate(networks):
        if name in weak:
            size = xp.sqrt(xp.mean(start[of == i + 1] ** 2))
            width = WEAK * xp.where(size > 0, size, 1.0) / error
            mean, sd = xp.where(of == i + 1, start, mean), xp.where(of == i + 1, width, sd)
    numbers = {name: i for i, (name, _) in enumerate(named)}
    leaves = tuple(
        Leaf(numbers[name], None if places.all() else tuple(map(int, np.flatnonzero(places))))
        for name, places in chosen.items()
    )
    found = FreeNumbers(params, start, *(x.astype(dtype) for x in (low, high, mean, sd)), tuple(entries), leaves, weak)
    _check_start(found, low, high)
    return found


def leaf_name(path: tuple[Any, ...]) -> str:
    """The name of a leaf of `params` as a user writes it."""
    return jtu.keystr(path, simple=True, separator=".") or "params"


def _networks(params: PyTree, chosen: Mapping[str, np.ndarray]) -> list[str]:
    """The entries of `params` that are more than one array, a matrix among them, and have free numbers."""
    found = []
    for path, entry in jtu.tree_leaves_with_path(params, is_leaf=lambda x: x is not params):
        name, arrays = leaf_name(path), [x for x in jax.tree.leaves(entry) if eqx.is_inexact_array(x)]
        if len(arrays) > 1 and any(x.ndim > 1 for x in arrays) and any(leaf.startswith(f"{name}.") for leaf in chosen):
            found.append(name)
    return found


def _entries(name: str, x: Array):
    return [name + ("[" + ", ".join(map(str, i)) + "]" if i else "") for i in np.ndindex(x.shape)]


def _matching(
    name: Any, among: Mapping[str, Array], argument: str, chosen: Mapping[str, np.ndarray] | None = None
) -> dict[str, Any]:
    """The leaves that a name stands for, each with the places of its entries: all, or that of one element, 'm[1]'."""
    found: dict[str, Any] = {leaf: slice(None) for leaf in among if leaf == name or leaf.startswith(f"{name}.")}
    leaf = str(name).partition("[")[0]
    if not found and leaf in among:
        places = [i for i, entry in enumerate(_entries(leaf, among[leaf])) if entry == name]
        found = {leaf: [i] for i in places if chosen is None or chosen[leaf][i]}
    if not found:
        raise ValueError(
            f"{argument} names {name!r}, which is not a floating-point number of params that can be fitted: "
            f"{listed(list(among))}.\n"
            'Usual cause: a misspelled name, or a whole number written without a decimal point ("m": 1).\n'
            "Fix: use the names in params; leaves of a dict in a dict as 'arm.length', elements as 'm[1]'."
        )
    return found


def _check_pair(name: str, pair: Any, what: str):
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        example = '{"m": (0.0, None)}' if what == "bounds" else '{"g": (9.81, 0.01)}, mean and standard deviation'
        raise ValueError(f"{what} of '{name}' must be a pair, not {pair!r}.\nFix: {what}={example}.")


def _check_start(found: FreeNumbers, low: np.ndarray, high: np.ndarray):
    if np.any(low >= high):
        i = int(np.argmax(low >= high))
        raise ValueError(f"the bounds of '{found.names[i]}' are ({low[i]}, {high[i]}): low must be below high.")
    if is_traced(found.start):
        return
    x = np.asarray(found.start)
    if not np.all(np.isfinite(x)):
        raise ValueError(f"'{found.names[int(np.argmin(np.isfinite(x)))]}' starts at {x[~np.isfinite(x)][0]}.")
    outside = (x <= low) | (x >= high)
    if outside.any():
        i = int(np.argmax(outside))
        raise ValueError(
            f"'{found.names[i]}' starts at {x[i]:.6g}, but must start inside its bounds, from {low[i]:.6g} to "
            f"{high[i]:.6g}.\nFix: start a positive number at its order of magnitude, such as 1e-3, not at 0."
        )
