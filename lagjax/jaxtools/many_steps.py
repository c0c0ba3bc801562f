"""Many steps in a row as one machine function, with derivatives in both modes that begin where each step began.

    y_{k+1} = step(y_k, row_k, fixed),    k = 0 ... N - 1

All states are results, so they are known when a derivative is taken: forward mode goes along them, and reverse mode
goes back from one to the one before, without any step made again to find where the others began,

    dy_{k+1} = ∂step(y_k) (dy_k, d row_k, d fixed),    (ȳ_k, r̄ow_k) and a share of f̄ixed = ∂step(y_k)ᵀ ȳ_{k+1}

So what reverse mode keeps are the states, and what one step needs is computed again from its state. Both are functions
of the states like any other, and can be differentiated again.

There may be two ways to make a step, a fast one that gives NaN where it fails, and another: if a step of a motion, or
of any lane of a batch, fails the first way, all are made the second way, and so are their derivatives.

Source: Griewank & Walther, *Evaluating Derivatives*, §3.2 (adjoints of a sequence of steps), ch. 12 (states kept).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.interpreters import ad
from jaxtyping import Array, PyTree

from lagjax.jaxtools.fuse import function_in_lanes, function_of, one_function, pushed_again
from lagjax.jaxtools.primitives import filled, front, is_float, linear_map_primitive, no_tangent, primitive, split
from lagjax.jaxtools.tracing import is_plain


def steps_in_both_modes(ways: Sequence[Callable], y: PyTree, rows: PyTree, fixed: PyTree) -> PyTree:
    """The states after each of N steps `y = step(y, row, fixed)`, as one machine function where that is possible.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> step = lambda y, h, rate: y * (1 + rate * h)
    >>> grown = lambda rate: steps_in_both_modes([step], 1.0, jnp.array([0.5, 0.5]), rate)
    >>> print(grown(2.0), jax.grad(lambda rate: grown(rate)[1])(2.0))
    [2. 4.] 2.0

    **Arguments:** `ways`, one function for a step, or two; a state `y` of floats; `rows`, arrays with an axis of N in
    front; `fixed`, the same in all steps. Leaves that are no arrays are compiled in. A way must not close over traced
    values.

    **Returns:** states like `y`, with an axis of N in front.
    """
    y, rows = (jtu.tree_map(jnp.asarray, x) for x in (y, rows))
    leaves, structure = jtu.tree_flatten((y, rows, fixed))
    arrays = [i for i, x in enumerate(leaves) if hasattr(x, "shape")]
    counts = len(jtu.tree_leaves(y)), len(jtu.tree_leaves(rows))

    def of_leaves(way: Callable, *operands):
        return jtu.tree_leaves(way(*jtu.tree_unflatten(structure, filled(leaves, arrays, operands))))

    operands = [leaves[i] for i in arrays]
    leaves = [None if i in arrays else x for i, x in enumerate(leaves)]
    flat = [partial(of_leaves, way) for way in ways]
    if is_plain():
        found = _Steps(tuple(flat), *counts, True).run(*operands)
    else:
        # Jitted, so that each is traced once.
        found = _steps_p.bind(*map(jnp.asarray, operands), of=_Steps(tuple(map(jax.jit, flat)), *counts, False))
    return jtu.tree_unflatten(jtu.tree_structure(y), found[: counts[0]])


@dataclass(frozen=True, eq=False)
class _Steps:
    """Steps of flat lists: each of `ways(*y, *row, *fixed)` -> the next y; how many arrays of y and of rows there are;
    `lanes`: whether they are those of a batch, whose axis follows that of the steps.

    Results are the states, and with two ways whether the first did not fail.
    """

    ways: tuple[Callable, ...]
    states: int
    rows: int
    lanes: bool

    def parts(self, operands: Sequence) -> tuple[list, list, list]:
        """The state, the rows, and what is fixed."""
        a, b = self.states, self.states + self.rows
        return list(operands[:a]), list(operands[a:b]), list(operands[b:])

    def compiled(self, function: Callable, *args):
        """A function of these steps at some arguments."""
        return function(*args) if self.lanes else one_function(function, *args)

    @property
    def results(self) -> int:
        """How many there are."""
        return self.states + len(self.ways) - 1

    def run(self, *operands) -> list[Array]:
        """The states after each step."""
        first, well = self._run(self.ways[0], operands)
        if len(self.ways) == 1:
            return first
        return [*lax.cond(well, lambda: first, lambda: self._run(self.ways[1], operands)[0]), well]

    def _run(self, way: Callable, operands: Sequence) -> tuple[list[Array], Array]:
        """The states, and whether all are finite, if there is another way."""
        y, rows, fixed = self.parts(operands)

        def one(before: tuple, row: list):
            y, well = before
            y = [x.astype(old.dtype) for x, old in zip(way(*y, *row, *fixed), y)]
            if len(self.ways) > 1:
                # Step by step: a program with a large sum is no single function. Zero times NaN or infinity is NaN.
                well &= sum(jnp.sum(0 * x) for x in y) == 0
            return (y, well), y

        (_, well), states = in_pieces(one, (y, jnp.asarray(True)), rows)
        return states, well

    def _by_way(self, derivative: Callable, points: Sequence, *args) -> list[Array]:
        """A derivative of the way that was taken."""
        if len(self.ways) == 1:
            return derivative(self.ways[0], points, *args)
        *points, well = points
        return lax.cond(well, *(partial(derivative, way, points, *args) for way in self.ways))

    def _begins(self, points: Sequence) -> tuple[list, list, list]:
        """Where each step begins, the rows, and what is fixed, from the operands and the states after each step."""
        operands, states = split(points, self.states)
        y, rows, fixed = self.parts(operands)
        return [jnp.concatenate([x[None], after[:-1]]) for x, after in zip(y, states)], rows, fixed

    def along(self, points: Sequence, directions: Sequence, moved: Sequence[int]) -> list[Array]:
        """The change of the states with the operands that are `moved`."""
        return self._by_way(self._along, points, directions, moved)

    def _along(self, way: Callable, points: Sequence, directions: Sequence, moved: Sequence[int]) -> list[Array]:
        begins, rows, fixed = self._begins(points)
        given, places = dict(zip(moved, directions)), self._places(moved)
        start = [given.get(i, jnp.zeros_like(x[0])) for i, x in enumerate(begins)]
        of_rows, of_fixed = ([given[i] for i in part] for part in places[1:])

        def one(dy: list, here: tuple):
            y, row, d_row = here
            _, dy = jax.jvp(*_of(way, [*y, *row, *fixed], places), [*dy, *d_row, *of_fixed])
            return dy, dy

        return in_pieces(one, start, (begins, rows, of_rows))[1]

    def back(self, points: Sequence, cotangents: Sequence, moved: Sequence[int]) -> list[Array]:
        """The transpose of that: the slopes by the operands that are `moved`."""
        return self._by_way(self._back, points, cotangents, moved)

    def _back(self, way: Callable, points: Sequence, cotangents: Sequence, moved: Sequence[int]) -> list[Array]:
        begins, rows, fixed = self._begins(points)
        places = self._places(moved)
        ends = np.cumsum([len(part) for part in places])[:-1]

        def one(after: tuple, here: tuple):
            (of_y, of_fixed), (y, row, added) = after, here
            step, at = _of(way, [*y, *row, *fixed], places)
            found = jax.vjp(step, *at)[1]([a + b for a, b in zip(of_y, added)])
            of_y, of_row, share = found[: ends[0]], found[ends[0] : ends[1]], found[ends[1] :]
            return (list(of_y), [a + b for a, b in zip(of_fixed, share)]), list(of_row)

        zeros = [jnp.zeros_like(x[0]) for x in begins], [jnp.zeros_like(points[i]) for i in places[2]]
        (start, shares), by_row = in_pieces(one, zeros, (begins, rows, list(cotangents)), reverse=True)
        found = dict(zip(chain(*places), [*start, *by_row, *shares]))
        return [found[i] for i in moved]

    def _places(self, moved: Sequence[int]) -> tuple[list[int], list[int], list[int]]:
        """Of the state all, and of the rows and of what is fixed the operands that are `moved`."""
        first, end = self.states, self.states + self.rows
        return list(range(first)), [i for i in moved if first <= i < end], [i for i in moved if i >= end]

    def in_lanes(self, batched: Sequence[bool]) -> "_Steps":
        """The same for a batch."""
        axes = [0 if b else None for b in batched]
        return replace(self, ways=tuple(jax.vmap(way, axes) for way in self.ways), lanes=True)


def in_pieces(one: Callable, carry: Any, rows: PyTree, reverse: bool = False) -> tuple[Any, PyTree]:
    """`lax.scan`, as a loop over loops of about √N steps if N has such a divisor.

    On a CPU, XLA compiles a loop that touches little memory as one function, here the inner one, also of many lanes.
    """
    count = jtu.tree_leaves(rows)[0].shape[0]
    length = piece_length(count)

    def cut(x: Array):
        return x.reshape(count // length, length, *x.shape[1:])

    def piece(carry: Any, rows: PyTree):
        return lax.scan(one, carry, rows, reverse=reverse)

    if length in (1, count):
        return piece(carry, rows)
    carry, found = lax.scan(piece, carry, jtu.tree_map(cut, rows), reverse=reverse)
    return carry, jtu.tree_map(lambda x: x.reshape(count, *x.shape[2:]), found)


def piece_length(count: int) -> int:
    """The divisor of `count` next to its root.

    >>> [piece_length(count) for count in (64, 50, 53)]
    [8, 5, 1]
    """
    return max(n for n in range(1, math.isqrt(count) + 1) if count % n == 0)


def _of(way: Callable, at: list, places: tuple) -> tuple[Callable, list]:
    """A step as a function of some of its arguments, and these."""
    chosen = list(chain(*places))

    def of_chosen(*given):
        return [x.astype(old.dtype) for x, old in zip(way(*filled(at, chosen, given)), at)]

    return of_chosen, [at[i] for i in chosen]


def _evaluated(*operands, of: _Steps):
    return list(of.compiled(of.run, *operands))


def _shapes(*operands, of: _Steps):
    y, rows, _ = of.parts(operands)
    states = [ShapedArray((rows[0].shape[0], *x.shape), x.dtype) for x in y]
    return states + [ShapedArray((), np.dtype(bool))] * (of.results - of.states)


def _jvp(primals: Sequence, tangents: Sequence, *, of: _Steps):
    found = _steps_p.bind(*primals, of=of)
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero) and is_float(primals[i]))
    still = [no_tangent(x) for x in found]
    if not moved:
        return found, still
    directions = [tangents[i] for i in moved]
    return found, [*_tangent_p.bind(*primals, *found, *directions, of=of, moved=moved), *still[of.states :]]


def _batched(operands: Sequence, axes: Sequence, *, of: _Steps):
    operands, batched, lanes = front(operands, axes)
    first_row, end = of.states, of.states + of.rows
    for i, b in enumerate(batched):
        if i < first_row and not b:
            # States move in all lanes.
            operands[i] = jnp.broadcast_to(operands[i], (lanes, *operands[i].shape))
        elif first_row <= i < end and b:
            operands[i] = jnp.moveaxis(operands[i], 0, 1)
    batched = (True,) * first_row + batched[first_row:]
    found = _steps_p.bind(*operands, of=of.in_lanes(batched))
    return found, [1] * of.states + [None] * (of.results - of.states)


def _pushed(points: Sequence, directions: Sequence, *, of: _Steps, moved: Sequence[int]):
    def along(points: Sequence, directions: Sequence):
        return of.along(points, directions, moved)

    return of.compiled(along, points, directions)


def _pulled(
    points: Sequence, directions: Sequence, wanted: Sequence[bool], cotangents: Sequence, *, of: _Steps,
    moved: Sequence[int],
):  # fmt: skip
    moved, count = tuple(i for i, w in zip(moved, wanted) if w), len(points)

    def back(*operands):
        return of.back(operands[:count], operands[count:], moved)

    return function_of(back, of.lanes, *points, *map(ad.instantiate_zeros, cotangents))


def _pushed_shapes(*operands, of: _Steps, moved: Sequence[int]):
    points, _ = split(operands, len(moved))
    return [ShapedArray(x.shape, x.dtype) for x in split(points, of.results)[1][: of.states]]


def _flat(of: _Steps, moved: Sequence[int]) -> Callable:
    def push(*operands):
        return of.along(*split(operands, len(moved)), moved)

    return push


def _pushed_jvp(primals: Sequence, tangents: Sequence, *, of: _Steps, moved: Sequence[int]):
    values = _tangent_p.bind(*primals, of=of, moved=moved)
    return values, pushed_again(_flat(of, moved), of.lanes, primals, tangents)


def _pushed_batched(operands: Sequence, axes: Sequence, *, of: _Steps, moved: Sequence[int]):
    # Many directions at one point still are one function.
    lanes = of.lanes or any(axis is not None for axis in split(axes, len(moved))[0])
    return function_in_lanes(_flat(of, moved), lanes, operands, axes)


_steps_p = primitive("lagjax_steps", _evaluated, _shapes, several=True, jvp=_jvp, batched=_batched)
_tangent_p = linear_map_primitive(
    "lagjax_steps_tangent", _pushed, _pulled, _pushed_shapes, lambda params: len(params["moved"]),
    jvp=_pushed_jvp, batched=_pushed_batched,
)  # fmt: skip
