"""The second variation along a path: its index, and the conjugate points.

The matrix of Newton's method is the second variation of the discrete action, bordered by the constraints. Eliminated
from the start, its pivots Δ have together as many negative eigenvalues as the matrix (Haynsworth), one for each
constraint equation, and one for each direction in which the action has a maximum. With the end fixed at a node, this is
the Morse index of the path up to there: the number of conjugate points before, with their multiplicities.

Between two nodes where the index grows, the path is cut at a time inside the element, and the time bisected.

Source: Milnor, *Morse Theory*, §15; Haynsworth, *Linear Algebra Appl.* 1 (1968) 73.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lagjax.jaxtools import compiled
from lagjax.numerics import lapack
from lagjax.system import Model
from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.path import Ends, FoundPath, Path, momentum_matrix, states

BISECTIONS = 52
# Scalings of rows and columns; each brings their largest entries nearer to one, by a square root (Ruiz).
SCALINGS = 4


def index_at_nodes(model: Model, found: FoundPath, free_end: bool) -> Int[Array, " K"]:
    """The index of the path up to the end of each element, that end fixed; the last one free altogether if so."""
    count, s, size = found.path.y.shape
    m, inner = size - model.n, (s - 1) * size
    # The last node is an end: a maximum in its directions would be one of others, so they have none.
    fixed = np.arange(s * size) >= inner
    cut = jnp.where((fixed[:, None] | fixed)[None], np.eye(s * size, dtype=found.deltas.dtype)[None], found.deltas)
    whole, cut = jax.vmap(_negative)(jnp.concatenate([found.deltas, cut])).reshape(2, count)
    whole, cut = whole - s * m, cut - (s - 1) * m
    cut = cut.at[-1].set(whole[-1]) if free_end else cut
    return jnp.concatenate([jnp.zeros(1, whole.dtype), jnp.cumsum(whole)[:-1]]) + cut


def _negative(matrix: Array) -> Array:
    return jnp.sum(_eigenvalues(_evened(matrix, jnp)) < 0)


def _evened(matrix, xp=np):
    """The symmetric part, with rows and columns scaled alike until their largest entries are one: the signs of its
    eigenvalues are the same (Sylvester), and those of constraints, in other units, are no longer round-off."""
    matrix = (matrix + matrix.T) / 2
    for _ in range(SCALINGS):
        scale = xp.sqrt(xp.max(xp.abs(matrix), axis=0))
        scale = xp.where(scale > 0, scale, 1.0)
        matrix = matrix / scale[:, None] / scale[None]
    return matrix


@lapack.one_by_one
def _eigenvalues(matrix: Array):
    # LAPACK may not return if the matrix is not finite.
    return jnp.linalg.eigvalsh(jnp.where(jnp.all(jnp.isfinite(matrix)), matrix, 0.0))


def conjugate_times(model: Model, ends: Ends, found: FoundPath, index: np.ndarray) -> Float[np.ndarray, " c"]:
    """The times of the points conjugate to the start, each as often as its multiplicity; the end itself left out."""
    times, before = [], 0
    for element, after in enumerate(index):
        times += [_bisected(model, ends, found, element, wanted) for wanted in range(before + 1, int(after) + 1)]
        before = max(before, int(after))
    return np.array(times, np.asarray(ends.t_a).dtype)


def _bisected(model: Model, ends: Ends, found: FoundPath, element: int, wanted: int) -> float:
    """The time inside an element at which the index reaches a number."""
    s, size = found.path.y.shape[1:]
    deltas, m = np.asarray(found.deltas), size - model.n
    earlier = sum(int(np.sum(np.linalg.eigvalsh(_evened(d)) < 0)) - s * m for d in deltas[: max(element - 1, 0)])
    t, h = (float(x[element]) for x in found.path.times(ends))

    def index(part: float) -> int:
        # As arrays: a program is compiled for each Python number.
        at = np.asarray(element), np.asarray(part, deltas.dtype)
        whole, cut = (np.asarray(x) for x in _matrices(model, ends, found.path, *at))
        if element:
            matrix = np.zeros((2 * s * size - size,) * 2, cut.dtype)
            matrix[: s * size, : s * size] = deltas[element - 1]
            first = (s - 1) * size
            matrix[first : s * size, first : s * size] -= whole[:size, :size]
            matrix[first:, first:] += cut[:-size, :-size]
            rows = (2 * s - 1) * m
        else:
            matrix, rows = cut[size:-size, size:-size], (s - 1) * m
        return earlier + int(np.sum(np.linalg.eigvalsh(_evened(matrix)) < 0)) - rows

    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if index(middle) >= wanted else (middle, high)
    return t + h * high


@compiled
def _matrices(model: Model, ends: Ends, path: Path, element: Array, part: Array):
    """The second variation of an element and of a part of it, ((s + 1) N, (s + 1) N) each."""
    rule, (t, h) = rule_of_degree(path.y.shape[1]), path.times(ends)
    t, h, size = t[element], h[element], path.y.shape[2] * (path.y.shape[1] + 1)

    def of_part(part: Array) -> Array:
        nodes, _ = states(ends, path, t + part * h * rule.nodes)
        return momentum_matrix(model, rule, t, part * h, nodes)[1].reshape(size, size)

    return jax.vmap(of_part)(jnp.stack([jnp.ones_like(part), part]))
