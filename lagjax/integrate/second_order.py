"""Reverse mode of a solve with respect to many numbers, and the derivatives of that.

With y = solve(x) and J = ∂y/∂x, the pull is (x, c) -> J(x)ᵀ c, one replay of the steps. Its derivative along (dx, dc)
is forward mode over the replay,

    d(Jᵀ c) = H[c, dx] + Jᵀ dc,    H[c, ·] = ∂²(c·y)/∂x∂x,

a linear map. Its transpose needs no reverse mode over the replay, which is a loop of unknown length: H is symmetric, so
the transpose takes w to H[c, w], by forward mode along w, and to J w, a push. The derivative of a push (x, dx) -> J dx
is transposed in the same way, to H[c, dx], the pull's derivative along dx, and Jᵀ c.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import ShapedArray

from lagjax.integrate.backward_sweep import filled
from lagjax.integrate.replay import Replay
from lagjax.jaxtools import ad, front, linear_map_primitive, split


@eqx.filter_custom_jvp
def pull(x, fixed: Sequence, cotangents: Sequence, *, which: tuple, outputs: Callable):
    """The cotangents of some of x, from the cotangents of some of `outputs(adjoint, *x, *fixed)`.

    `which`: for each of x whether its cotangent is wanted, and for each output whether it has one in `cotangents`.
    """
    return _pulled(x, fixed, cotangents, which, outputs)


@pull.def_jvp
def _pull_jvp(primals: Sequence, tangents: Sequence, *, which: tuple, outputs: Callable):
    values = pull(*primals, which=which, outputs=outputs)
    points = [a for part in primals for a in part]
    along = [None if part is None else d for part in tangents for d in part]
    along = [ad.Zero(jax.typeof(a).to_tangent_aval()) if d is None else d for a, d in zip(points, along)]
    shapes = tuple((a.shape, a.dtype) for a in values)
    derivative = turned(Pull(len(primals[0]), len(primals[1]), which, outputs), points, along, shapes)
    return values, type(values)(ad.instantiate_zeros(d) for d in derivative)


def _pulled(x, fixed: Sequence, cotangents: Sequence, which: tuple, outputs: Callable, bent=False):
    wanted, asked = which

    def of_wanted(*chosen):
        chosen = iter(chosen)
        every = [next(chosen) if w else a for a, w in zip(x, wanted)]
        return tuple(y for y, a in zip(outputs(Replay(bent=bent), *every, *fixed), asked) if a)

    return jax.vjp(of_wanted, *[a for a, w in zip(x, wanted) if w])[1](tuple(cotangents))


def _pull_tangent(
    x, fixed: Sequence, cotangents: Sequence, which: tuple, outputs: Callable, at: Sequence, direction: Sequence
):
    """The derivative of a pull with respect to the x at the indices `at`, along a direction."""

    def of_moved(*chosen):
        return _pulled(filled(x, at, chosen), fixed, cotangents, which, outputs, bent=True)

    return jax.jvp(of_moved, tuple(x[i] for i in at), tuple(direction))[1]


def _pushed(x, fixed: Sequence, outputs: Callable, at: Sequence, direction: Sequence):
    """The derivative of the outputs with respect to the x at the indices `at`, along a direction."""
    return jax.jvp(
        lambda *chosen: outputs(diffrax.ForwardMode(), *filled(x, at, chosen), *fixed),
        tuple(x[i] for i in at),
        tuple(direction),
    )[1]


@dataclass(frozen=True)
class Pull:
    """The derivative of a pull; its points are x, the fixed operands, and the cotangents."""

    size: int
    fixed: int
    which: tuple
    outputs: Callable

    def _split(self, points: Sequence):
        return points[: self.size], points[self.size : self.size + self.fixed], points[self.size + self.fixed :]

    def forward(self, points: Sequence, moved: Sequence, moving: Sequence):
        """The derivative along directions `moving` of the points with indices `moved`."""

        def of_moved(*chosen):
            return _pulled(*self._split(filled(points, moved, chosen)), self.which, self.outputs, bent=True)

        return jax.jvp(of_moved, tuple(points[i] for i in moved), tuple(moving))[1]

    def backward(self, points: Sequence, moved: Sequence, w):
        """The transpose: the cotangents of the directions of the `moved` points."""
        x, fixed, cotangents = self._split(points)
        wanted, asked = self.which
        at = [i for i, here in enumerate(wanted) if here]
        mine = tuple(i in moved for i in range(self.size))
        of_x, of_cotangents = iter(()), [None] * len(cotangents)
        if any(mine):
            of_x = iter(_pull_tangent(x, fixed, cotangents, (mine, asked), self.outputs, at, w))
        if max(moved) >= self.size + self.fixed:
            found = _pushed(x, fixed, self.outputs, at, w)
            of_cotangents = [d for d, a in zip(found, asked) if a]
        return [next(of_x) if i < self.size else of_cotangents[i - self.size - self.fixed] for i in moved]


@dataclass(frozen=True)
class Push:
    """The derivative of a push; its points are x, the fixed operands, and a direction for each of x."""

    size: int
    outputs: Callable

    def _split(self, points: Sequence):
        return points[: self.size], points[self.size : -self.size], points[-self.size :]

    def forward(self, points: Sequence, moved: Sequence, moving: Sequence):
        """The derivative along directions `moving` of the points with indices `moved`."""

        def of_moved(*chosen):
            x, fixed, dx = self._split(filled(points, moved, chosen))
            return _pushed(x, fixed, self.outputs, range(self.size), dx)

        return jax.jvp(of_moved, tuple(points[i] for i in moved), tuple(moving))[1]

    def backward(self, points: Sequence, moved: Sequence, w):
        """The transpose: the cotangents of the directions of the `moved` points."""
        x, fixed, dx = self._split(points)
        offset = len(points) - self.size
        asked = (True,) * len(w)
        mine, theirs = (tuple(i + start in moved for i in range(self.size)) for start in (0, offset))
        of_x = iter(_pull_tangent(x, fixed, w, (mine, asked), self.outputs, range(self.size), dx) if any(mine) else ())
        of_dx = iter(_pulled(x, fixed, w, (theirs, asked), self.outputs) if any(theirs) else ())
        return [next(of_x if i < self.size else of_dx) for i in moved]


@dataclass(frozen=True)
class _OverLanes:
    """The derivative `one` in a batch; `points`, `moving`: the batch axes of points and directions."""

    one: Any
    points: tuple
    moving: tuple
    count: int

    def forward(self, points: Sequence, moved: Sequence, moving: Sequence):
        return jax.vmap(
            lambda points, moving: self.one.forward(points, moved, moving),
            (list(self.points), list(self.moving)),
            axis_size=self.count,
        )(points, moving)

    def backward(self, points: Sequence, moved: Sequence, w):
        found = jax.vmap(
            lambda points, w: self.one.backward(points, moved, w), (list(self.points), 0), axis_size=self.count
        )(points, w)
        return [x if axis == 0 else jnp.sum(x, axis=0) for x, axis in zip(found, self.moving)]


def turned(map, points: Sequence, tangents: Sequence, shapes: tuple):
    """The derivative `map` at these points along these tangents, as a linear map that JAX can transpose."""
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero))
    if not moved:
        return [ad.Zero(ShapedArray(*shape)) for shape in shapes]
    return _turned_p.bind(*points, *(tangents[i] for i in moved), map=map, moved=moved, shapes=shapes)


def _turned(points: Sequence, moving: Sequence, *, map, moved: Sequence, shapes: tuple):
    return map.forward(list(points), moved, list(moving))


def _turned_jvp(primals: Sequence, tangents: Sequence, **params):
    raise NotImplementedError(
        "a third derivative of a motion by many numbers, two of them in reverse mode, is not available.\n"
        "Fix: jax.jvp of jax.jvp of jax.jvp, along each direction that is wanted, or differences of second derivatives."
    )


def _turned_transpose(
    points: Sequence, moving: Sequence, wanted: Sequence, cotangents: Sequence, *, map, moved: Sequence, shapes: tuple
):
    found = map.backward(list(points), moved, [ad.instantiate_zeros(ct) for ct in cotangents])
    return [x for x, w in zip(found, wanted) if w]


def _turned_batched(operands: Sequence, axes: Sequence, *, map, moved: Sequence, shapes: tuple):
    operands, batched, count = front(operands, axes)
    lanes = _OverLanes(map, *split([0 if b else None for b in batched], len(moved)), count)
    shapes = tuple(((count, *shape), dtype) for shape, dtype in shapes)
    found = _turned_p.bind(*operands, map=lanes, moved=moved, shapes=shapes)
    return found, [0] * len(found)


_turned_p = linear_map_primitive(
    "lagjax_second_derivative", _turned, _turned_transpose,
    lambda *operands, shapes, **params: [ShapedArray(*shape) for shape in shapes],
    lambda params: len(params["moved"]), jvp=_turned_jvp, batched=_turned_batched,
)  # fmt: skip
