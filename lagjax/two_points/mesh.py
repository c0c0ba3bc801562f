"""A mesh: elements on a stretch of time, the polynomials on them, and the same polynomials on other elements.

Elements meet at `parts` (K + 1,), most often parts of the whole time from 0 to 1. What they carry is given by its
values at *nodes*, parts (r,) of an element. Nodes from 0 to 1 have a row (K r - K + 1 in all) that two elements share
where they meet; all others have K r rows. Functions of arrays alone work in NumPy where all is known, else in JAX.

**How good elements are.** The size of the highest Legendre coefficient of a path on an element, c_s, says how well the
polynomial follows it: it falls as h^s. Elements are laid anew so that it is the same on all, by the density
(|c_s|)^(1/s) / h.

Source: Ascher, Mattheij & Russell, *Numerical Solution of Boundary Value Problems for ODEs* (1995), §9.2.

**How elements are made finer**, where a control jumps. All elements are halved until the answer no longer changes. And
where a control goes from one of its bounds to the other within an element, this is cut in two at a time that the
program then finds, and the control stays at the one bound before the cut and at the other after it.

Without the second half of that rule the cut would not be where the control jumps: a polynomial is held to its bounds at
Gauss's points alone, and one that is beyond them in between costs less.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree
from numpy.polynomial import legendre

from lagjax.jaxtools import numpy_of, once
from lagjax.two_points.elements import basis, rule_of_degree

# An element is at most so many times longer than the mean would have it.
EVEN = 0.2
# A control this near to a bound, in parts of the distance between both, is at it.
AT_BOUND = 0.02
# How near to a neighbour a bound of elements may move, in parts of their distance.
APART = 0.02


def even(count: int) -> np.ndarray:
    """Where elements of one length meet.

    >>> print(even(2))
    [0.  0.5 1. ]
    """
    return np.linspace(0.0, 1.0, count + 1)


def places(parts: Float[Array, " K+1"], nodes: np.ndarray) -> Float[Array, " R"]:
    """Where the rows of given nodes stand, in their order.

    >>> print(places(np.array([0.0, 1.0, 3.0]), np.array([0.0, 0.5, 1.0])), places(even(2), np.array([0.5])))
    [0.  0.5 1.  2.  3. ] [0.25 0.75]
    """
    xp: Any = numpy_of(parts)
    inside = nodes[:-1] if _are_shared(nodes) else nodes
    found = (parts[:-1, None] + xp.diff(parts)[:, None] * inside[None].astype(parts.dtype)).ravel()
    return xp.concatenate([found, parts[-1:]]) if _are_shared(nodes) else found


def after_first(parts: Float[Array, " K+1"], s: int) -> Float[Array, "K s"]:
    """Where all of Lobatto's nodes of degree s stand but the first one."""
    return places(parts, rule_of_degree(s).nodes)[1:].reshape(-1, s)


def rows_of(count: int, nodes: np.ndarray) -> np.ndarray:
    """The numbers of the rows that each element has, (K, r).

    >>> print(rows_of(2, np.array([0.0, 0.5, 1.0])).tolist(), rows_of(2, np.array([0.5])).tolist())
    [[0, 1, 2], [2, 3, 4]] [[0], [1]]
    """
    return (len(nodes) - _are_shared(nodes)) * np.arange(count)[:, None] + np.arange(len(nodes))


def _are_shared(nodes: np.ndarray) -> bool:
    return bool(nodes[0] == 0.0 and nodes[-1] == 1.0)


def cut(parts: Float[Array, " K+1"], pieces: int = 2) -> Float[Array, " K2+1"]:
    """Each element cut into pieces of one length.

    >>> print(cut(np.array([0.0, 1.0, 3.0])))
    [0.  0.5 1.  2.  3. ]
    """
    return places(parts, np.arange(pieces + 1) / pieces)


def located(parts: Float[Array, " K+1"], at: Float[Array, " T"]) -> tuple[Array, Array, Array]:
    """By place: the element, its length, and which part of it that is; the first and last go on beyond the mesh."""
    xp: Any = numpy_of((parts, at))
    i = xp.clip(xp.searchsorted(parts, at, side="right") - 1, 0, len(parts) - 2)
    length = xp.diff(parts)[i]
    return i, length, (at - parts[i]) / length


def between(
    parts: Float[Array, " K+1"], nodes: np.ndarray, values: Float[Array, "K r n"], at: Float[Array, " T"]
) -> Float[Array, "T n"]:
    """The polynomials through `values` at the nodes of each element, at any places.

    >>> values = np.array([[[0.0], [1.0]], [[1.0], [5.0]]])
    >>> print(between(even(2), np.array([0.0, 1.0]), values, np.array([0.25, 0.75])).ravel())
    [0.5 3. ]
    """
    xp, (i, _, inside) = numpy_of((parts, values, at)), located(parts, at)
    return xp.einsum("tr,trn->tn", basis(nodes, inside), values[i])


def stacked(tree: PyTree[Float[Array, "T ..."]]) -> Float[Array, "T n"]:
    """All numbers of a tree at each time, in rows."""
    xp: Any = numpy_of(tree)
    return xp.concatenate([xp.reshape(x, (len(x), -1)) for x in jax.tree.leaves(tree)], axis=1)


def in_groups(function: Callable, size: int, *arrays: np.ndarray) -> PyTree[np.ndarray]:
    """A function of many elements or places, so many at a time: one program serves any number of them."""
    count, found = len(arrays[0]), []
    for start in range(0, count, size):
        pieces = (x[start : start + size] for x in arrays)
        filled = (np.concatenate([x, np.repeat(x[-1:], size - len(x), axis=0)]) for x in pieces)
        found.append(jax.tree.map(np.asarray, function(*filled)))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *found)


def highest(values: Float[Array, "K s+1 n"]) -> Float[Array, "K n"]:
    """The highest Legendre coefficient on each element, of values at Lobatto's nodes."""
    return jnp.einsum("j,kjn->kn", jnp.asarray(_to_highest(values.shape[1] - 1), values.dtype), values)


@once
def _to_highest(s: int) -> np.ndarray:
    return np.linalg.inv(legendre.legvander(2 * rule_of_degree(s).nodes - 1, s))[-1]


def laid_anew(parts: Float[Array, " K+1"], errors: Float[Array, " K"], s: int) -> Float[Array, " K+1"]:
    """Where as many elements meet that are equally good, from the errors of degree s on these."""
    dtype, width = parts.dtype, jnp.diff(parts)
    density = jnp.maximum(errors, jnp.finfo(dtype).eps) ** (1 / s) / width
    density = jnp.maximum(density, EVEN * jnp.sum(density * width))
    whole = jnp.concatenate([jnp.zeros(1, dtype), jnp.cumsum(density * width)])
    parts = jnp.interp(jnp.linspace(0.0, 1.0, len(whole), dtype=dtype) * whole[-1], whole, parts)
    return parts.at[0].set(0.0).at[-1].set(1.0)


class Jump(NamedTuple):
    """Where a control jumps, as a part of the whole time; which one, and whether it is at its upper bound before."""

    at: float
    control: int
    falls: bool


class Mesh(NamedTuple):
    """Where K elements meet, and the jumps at which they may move, by the number of the place."""

    parts: np.ndarray
    jumps: dict[int, list[Jump]]

    @property
    def count(self) -> int:
        """The number of elements."""
        return len(self.parts) - 1

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Between which values each place may move."""
        low, high = self.parts.copy(), self.parts.copy()
        for i in self.jumps:
            before, after = self.parts[i] - self.parts[i - 1], self.parts[i + 1] - self.parts[i]
            # Two neighbours that both move each have half of what lies between them.
            low[i] -= before * ((0.5 if i - 1 in self.jumps else 1.0) - APART)
            high[i] += after * ((0.5 if i + 1 in self.jumps else 1.0) - APART)
        return low, high

    def halved(self) -> "Mesh":
        """Each element cut in two."""
        return Mesh(cut(self.parts), {2 * i: jumps for i, jumps in self.jumps.items()})

    def cut_at(self, jumps: list[Jump]) -> "Mesh":
        """With elements that meet at each jump; a place nearby where some meet is moved there."""
        parts = list(self.parts)
        for jump in jumps:
            i = int(np.clip(np.searchsorted(parts, jump.at), 1, len(parts) - 1))
            share = (jump.at - parts[i - 1]) / (parts[i] - parts[i - 1])
            near = i - 1 if share < 0.1 else i if share > 0.9 else None
            if near is not None and 0 < near < len(parts) - 1:
                parts[near] = jump.at
            elif near is None:
                parts.insert(i, jump.at)
        found = {}
        for jump in jumps:
            found.setdefault(int(np.argmin(np.abs(np.array(parts) - jump.at))), []).append(jump)
        return Mesh(np.array(parts), {i: found[i] for i in sorted(found) if 0 < i < len(parts) - 1})


def jumps_of(
    parts: np.ndarray, weights: np.ndarray, controls: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[Jump]:
    """Where a control goes from one bound to the other within an element, in their order.

    `controls` (K r, n): r rows for each element, which count for the parts `weights` (r,) of its time.
    """
    width = np.diff(parts)[:, None]
    # To each value the time that it counts for.
    ends = (parts[:-1, None] + width * np.cumsum(weights)).ravel()
    widths, found = (width * weights).ravel(), []
    for control, (u, a, b) in enumerate(zip(controls.T, low, high)):
        if not np.isfinite(b - a):
            continue
        share = (u - a) / (b - a)
        side = np.where(share < AT_BOUND, -1, np.where(share > 1 - AT_BOUND, 1, 0))
        (at_bounds,) = np.nonzero(side)
        for i, j in zip(at_bounds, at_bounds[1:]):
            if side[i] != side[j] and j - i <= len(weights) + 1:
                # The time of a jump that has the same integral as what lies between.
                as_before = share[i + 1 : j] if side[i] > 0 else 1 - share[i + 1 : j]
                place = float(ends[i] + np.sum(as_before * widths[i + 1 : j]))
                found.append(Jump(place, control, bool(side[i] > 0)))
    return sorted(found)
