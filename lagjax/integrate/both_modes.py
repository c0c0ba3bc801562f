"""A solve that can be differentiated forward and in reverse, without choosing one in advance.

diffrax offers one kind of derivative for each solve: `ForwardMode` or `RecursiveCheckpointAdjoint`. Which one is needed
is known only when JAX pushes tangents through (`jacfwd`, Levenberg-Marquardt) or transposes them (`grad`).
The derivative of y = solve(x) is therefore bound as a linear map dx -> dy of its own: a primitive that is
evaluated by forward mode and transposed by a replay of the steps (`pull`), or, for few derivatives, by forward mode
along each of them. If nothing is differentiated, it leaves no trace in the compiled program. With many
numbers to differentiate by, the solve that computes the values records its steps, and these are replayed. With few, and
as many directions as numbers or directions that JAX does not know yet (`grad`, `jacfwd`), the solve that computes the
values pushes all of them along, and J is a table; its own derivatives are those of values and J apart.

Second derivatives by few numbers are those of this map, which is bilinear in dx and in the direction dz in which x
moves:

    d(J dx) = H[dx, dz] + J d(dx)

It is evaluated forward over forward, and itself bound as a linear map of (dz, d(dx)), which is transposed by pushing
along each of their axes. So `jacfwd(jacfwd)`, `jvp(grad)`,
`grad(grad)`, `jacrev(jacrev)` and the other orders all work; third derivatives by many numbers are refused.

By many numbers, with y = solve(x) and J = ∂y/∂x, the pull is (x, c) -> J(x)ᵀ c, one replay of the steps. Its
derivative along (dx, dc) is forward mode over the replay,

    d(Jᵀ c) = H[c, dx] + Jᵀ dc,    H[c, ·] = ∂²(c·y)/∂x∂x,

a linear map. Its transpose needs no reverse mode over the replay, which is a loop of unknown length: H is symmetric, so
the transpose takes w to H[c, w], by forward mode along w, and to J w, a push. The derivative of a push (x, dx) -> J dx
is transposed in the same way, to H[c, dx], the pull's derivative along dx, and Jᵀ c.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import Any

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jaxtyping import PyTree

from lagjax.contexts import COLUMNS
from lagjax.integrate.replay import Replay
from lagjax.jaxtools import (
    FEW,
    Columns,
    Lanes,
    ad,
    axes_of,
    changes_from,
    filled,
    front,
    have_columns,
    is_float,
    jaxpr_as_fun,
    linear_map_primitive,
    no_tangent,
    primitive,
    split,
    stop_gradient,
)


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


def _push(x, fixed: Sequence, outputs: Callable, at: Sequence, direction: Sequence):
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
            found = _push(x, fixed, self.outputs, at, w)
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
            return _push(x, fixed, self.outputs, range(self.size), dx)

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


def solve_in_both_modes(solve: Callable, x: PyTree, fixed: PyTree, recorded: bool) -> PyTree:
    """Return the result of `solve(x, fixed, adjoint, differentiated)`, differentiable in both modes in `x`.

    `solve` returns its result and a record of the motion, to be used by a later `Replay`, or None if the adjoint is not
    a `Replay`. All leaves of `x` are floating arrays, all leaves of `fixed` and of the result are arrays, and `solve`
    closes over no traced value. `differentiated`: whether this solve is for a derivative; `recorded`: whether there is
    a record.
    """
    if COLUMNS.value:
        return solve(x, fixed, diffrax.ForwardMode(), True)[0]
    leaves, structure = jtu.tree_flatten((x, fixed))
    shapes = {}

    def solve_flat(adjoint: Any, differentiated, *leaves):
        found = solve(*jtu.tree_unflatten(structure, leaves), adjoint, differentiated)
        shapes["y"], shapes[type(adjoint)] = map(jtu.tree_structure, found)
        return tuple(jtu.tree_leaves(part) for part in found)

    def results(adjoint: Any, *operands):
        leaves, record = operands[: structure.num_leaves], operands[structure.num_leaves :]
        if isinstance(adjoint, Replay):
            adjoint = replace(adjoint, record=jtu.tree_unflatten(shapes[Replay], record) if record else None)
        return solve_flat(adjoint, True, *leaves)[0]

    # Undifferentiated, the solve is a program that other transformations may look into, as into a call.
    program = jax.make_jaxpr(lambda *leaves: solve_flat(diffrax.ForwardMode(), False, *leaves)[0])(*leaves)
    with_record = jax.jit(partial(solve_flat, Replay(), True))
    rules = _Solve(
        with_record if recorded else None,
        results,
        lambda *record: jtu.tree_unflatten(shapes[Replay], record).record.count == 0,
        len(jtu.tree_leaves(x)),
    )
    found = _solve_p.bind(*leaves, program=program, rules=rules)
    return jtu.tree_unflatten(shapes["y"], found)


@dataclass(frozen=True, eq=False)
class _Solve:
    """How to differentiate a solve, a function of arrays, with respect to the first `size` of them.

    `recorded(*leaves)` gives the arrays of the result and of the record; None without a record. `results(adjoint,
    *leaves, *record)` gives those of the result, for a derivative; `no_steps(*record)` whether the motion was refused.
    `axes`: the lane axis of each array; None without lanes.
    """

    recorded: Callable | None
    results: Callable
    no_steps: Callable
    size: int
    axes: tuple | None = None

    def without_refused(self, leaves: Sequence, record):
        """Return the arrays, without derivatives if the motion was refused, as these may be infinite."""
        if not record:
            return leaves
        none = self.no_steps(*record)
        none = none if self.axes is None else jnp.all(none.reshape(none.shape[0], -1), axis=1)

        def still(x):
            return jnp.where(none.reshape(none.shape + (1,) * (x.ndim - none.ndim)), lax.stop_gradient(x), x)

        # Arrays that all lanes share must not get a lane axis.
        own = [i < self.size and (self.axes is None or self.axes[i] == 0) for i in range(len(leaves))]
        return [still(x) if m else x for x, m in zip(leaves, own)]

    def in_lanes(self, axes, count: int):
        """Return the same for lanes, whose axis comes first in the results."""

        def results(adjoint: Any, *operands):
            more = [0] * (len(operands) - len(axes))
            return jax.vmap(partial(self.results, adjoint), [*axes, *more], axis_size=count)(*operands)

        recorded = self.recorded and jax.vmap(self.recorded, axes, axis_size=count)
        return _Solve(recorded, results, self.no_steps, self.size, tuple(axes))


def _solved(*leaves, program: Any, rules: _Solve):
    return jaxpr_as_fun(program)(*leaves)


def _solved_shapes(*leaves, program: Any, rules: _Solve):
    return program.out_avals


def _solved_jvp(primals: Sequence, tangents: Sequence, *, program: Any, rules: _Solve):
    # Arrays without a tangent are constants: a tangent of zeros would be carried through every step.
    moved = [i for i in range(rules.size) if not isinstance(tangents[i], ad.Zero)]

    directions = [tangents[i] for i in moved]
    if have_columns([primals[i] for i in moved], directions):
        return _by_columns(primals, moved, directions, program, rules)
    if rules.recorded is None or not moved or _are_few(primals[i] for i in moved):
        # Bind the primitive, so that a second derivative finds this rule again.
        values, record = _solve_p.bind(*primals, program=program, rules=rules), []
    else:
        values, record = rules.recorded(*primals)
    if not moved:
        return values, [no_tangent(y) for y in values]
    # The record only says around which motion to replay; it is not differentiated.
    dy = iter(_changes(primals, stop_gradient(record), moved, directions, values, rules, many=False))
    return values, [next(dy) if is_float(y) else no_tangent(y) for y in values]


def _changes(
    leaves: Sequence, record: Sequence, moved: Sequence[int], directions: Sequence, values: Sequence, rules: _Solve,
    many: bool,
):  # fmt: skip
    """The changes of the results along directions of the arrays that are `moved`."""
    operands, count = [*leaves, *record], len(leaves)
    order = [*moved, *(i for i in range(len(operands)) if i not in moved)]
    place = [order.index(i) for i in range(len(operands))]

    def outputs(adjoint: Any, *operands):
        operands = [operands[i] for i in place]
        leaves, record = operands[:count], operands[count:]
        found = rules.results(adjoint, *rules.without_refused(leaves, record), *record)
        return [y for y in found if is_float(y)]

    shapes = tuple((y.shape, y.dtype) for y in values if is_float(y))
    params = dict(outputs=outputs, shapes=shapes, size=len(moved), many=many)
    return _tangent_p.bind(*(operands[i] for i in order), *directions, **params)


def _by_columns(primals: Sequence, moved: Sequence[int], directions: Sequence, program: Any, rules: _Solve):
    """The results and their changes, from one solve with the derivatives by all numbers that are `moved`."""

    def apart(*leaves):
        values = _solve_p.bind(*leaves, program=program, rules=rules)
        axes = axes_of([leaves[i] for i in moved])
        return [*values, *_changes(leaves, [], moved, axes, values, rules, many=True)]

    results = program.out_avals
    numbers = sum(primals[i].size for i in moved)
    columns = [ShapedArray((numbers, *y.shape), y.dtype) for y in results if is_float(y)]
    at_once = Columns(tuple(moved)).of(lambda leaves: list(rules.results(diffrax.ForwardMode(), *leaves)))
    found = _columns_p.bind(*primals, at_once=at_once, apart=apart, shapes=(*results, *columns))
    return changes_from(found, len(results), directions)


def _columns(*leaves, at_once: Callable, apart: Callable, shapes: tuple):
    return at_once(list(leaves))


def _columns_shapes(*leaves, at_once: Callable, apart: Callable, shapes: tuple):
    return list(shapes)


def _columns_jvp(primals: Sequence, tangents: Sequence, **params):
    moved = [i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero)]
    chosen = tuple(primals[i] for i in moved)
    _, found = jax.jvp(
        lambda *chosen: params["apart"](*filled(primals, moved, chosen)), chosen, tuple(tangents[i] for i in moved)
    )
    values = _columns_p.bind(*primals, **params)
    return values, [d if is_float(y) else no_tangent(y) for y, d in zip(values, found)]


def _columns_batched(operands: Sequence, axes, *, at_once: Callable, apart: Callable, shapes: tuple):
    operands, batched, count = front(operands, axes)
    lanes = Lanes(batched)
    shapes = tuple(ShapedArray((count, *y.shape), y.dtype) for y in shapes)
    lanes_apart = lambda *leaves: lanes.of(lambda one: apart(*one))(leaves)
    return _columns_p.bind(*operands, at_once=lanes.of(at_once), apart=lanes_apart, shapes=shapes), [0] * len(shapes)


def _solved_batched(operands: Sequence, axes, *, program: Any, rules: _Solve):
    operands, batched, count = front(operands, axes)
    axes = [0 if b else None for b in batched]
    lanes = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(program), axes, axis_size=count))(*operands)
    found = _solve_p.bind(*operands, program=lanes, rules=rules.in_lanes(axes, count))
    return found, [0] * len(found)


def _are_few(leaves: Sequence):
    return sum(a.size for a in leaves) <= FEW


# The operands of the derivative are the leaves of x, of what is fixed, and of dx; `size` is the number of leaves of x
# and of dx. `outputs(adjoint, *x, *fixed)` gives the floating leaves of the result; `shapes`, which are also those of
# their tangents, are known without tracing. With `many`, each dx has a leading axis of directions, and so has each
# result.


def _split(operands: Sequence, size: int):
    return tuple(operands[:size]), tuple(operands[size:-size]), tuple(operands[-size:])


def _tangent(points: Sequence, dx: Sequence, *, outputs: Callable, shapes: tuple, size: int, many: bool):
    x, fixed = points[:size], points[size:]

    def along(dx: Sequence):
        return jax.jvp(lambda *x: outputs(diffrax.ForwardMode(), *x, *fixed), x, dx)[1]

    return jax.vmap(along)(dx) if many else along(dx)


def _tangent_shapes(*operands, shapes: tuple, size: int, many: bool, **params):
    lead = operands[-1].shape[:1] if many else ()
    return [ShapedArray((*lead, *shape), dtype) for shape, dtype in shapes]


def _tangent_jvp(primals: Sequence, tangents: Sequence, **params):
    x, fixed, dx = _split(primals, params["size"])
    values = _tangent_p.bind(*primals, **params)
    if _are_few(x):
        return _linear(lambda *x: _tangent(*split(x, params["size"]), **params), primals, tangents, values)
    push = partial(turned, Push(len(x), params["outputs"]), shapes=params["shapes"])
    if not params["many"]:
        return values, push(primals, tangents)
    # Directions are treated as lanes.
    count, moves = len(primals) - len(dx), lambda t: not isinstance(t, ad.Zero)
    axes = [None] * count + [0] * len(dx)
    moving = [t for t in tangents if moves(t)]

    def along(primals: Sequence, moving):
        moving = iter(moving)
        each = [next(moving) if moves(t) else no_tangent(x) for x, t in zip(primals, tangents)]
        return [ad.instantiate_zeros(d) for d in push(primals, each)]

    return values, jax.vmap(along, (axes, [axis for axis, t in zip(axes, tangents) if moves(t)]))(list(primals), moving)


def _linear(function: Callable, points: Sequence, tangents: Sequence, values):
    """Return `values`, and the derivative of `function` along `tangents`, as a linear map that can be transposed."""
    moved = [i for i, tangent in enumerate(tangents) if not isinstance(tangent, ad.Zero)]
    if not moved:
        return values, [ad.Zero(value.aval.to_tangent_aval()) for value in map(jnp.asarray, values)]

    def along(*operands):
        points, directions = operands[: -len(moved)], operands[-len(moved) :]
        given = [None] * len(points)
        for i, direction in zip(moved, directions):
            given[i] = direction
        found, derivative = eqx.filter_jvp(lambda *points: function(*points), tuple(points), tuple(given))
        return [eqxi.materialise_zeros(a, b) for a, b in zip(found, derivative)]

    derivative = _pushed_p.bind(*points, *(tangents[i] for i in moved), along=along, size=len(moved))
    return values, derivative


def _pushed(points: Sequence, directions, *, along: Callable, size: int):
    return along(*points, *directions)


def _pushed_shapes(*operands, along: Callable, size: int):
    like = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands]
    return [ShapedArray(x.shape, x.dtype) for x in jax.eval_shape(along, *like)]


def _pushed_jvp(primals: Sequence, tangents: Sequence, *, along: Callable, size: int):
    return _linear(along, primals, tangents, _pushed_p.bind(*primals, along=along, size=size))


def _pushed_transpose(points: Sequence, like, wanted: Sequence, cotangents: Sequence, *, along: Callable, size: int):
    push = jax.vmap(partial(along, *points))
    return _along_axes(like, wanted, push, [ad.instantiate_zeros(ct) for ct in cotangents])


def _pushed_batched(operands: Sequence, axes, *, along: Callable, size: int):
    operands, batched, lanes = front(operands, axes)
    operands = [x if b else jnp.broadcast_to(x, (lanes, *x.shape)) for x, b in zip(operands, batched)]
    found = _pushed_p.bind(*operands, along=jax.vmap(along), size=size)
    return found, [0] * len(found)


def _along_axes(like, wanted: Sequence, push, cotangents: Sequence):
    """Push along the axes of all wanted arrays, and return the products of these derivatives with the cotangents."""
    sizes = [a.size if w else 0 for a, w in zip(like, wanted)]
    starts, total = np.cumsum([0, *sizes]), sum(sizes)
    if not total:
        return [jnp.zeros(a.shape, a.dtype) for a, w in zip(like, wanted) if w]
    chosen = iter(axes_of([a for a, w in zip(like, wanted) if w]))
    axes = [next(chosen) if w else jnp.zeros((total, *a.shape), a.dtype) for a, w in zip(like, wanted)]
    dy = push(*axes)
    of_outputs = [jnp.sum((d * ct[None]).reshape(total, -1), axis=1) for d, ct in zip(dy, cotangents)]
    slopes = reduce(jnp.add, of_outputs)
    return [slopes[i : i + n].reshape(a.shape).astype(a.dtype) for i, n, a, w in zip(starts, sizes, like, wanted) if w]


def _tangent_transpose(
    points: Sequence, dx: Sequence, wanted: Sequence, cotangents: Sequence, *, outputs: Callable, shapes: tuple,
    size: int, many: bool,
):  # fmt: skip
    x, fixed = points[:size], points[size:]
    if _are_few(a for a, w in zip(x, wanted) if w):
        params = dict(outputs=outputs, shapes=shapes, size=size)
        cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
        along = partial(_pull_by_pushing, x, fixed, wanted, **params)
    else:
        nonzero = tuple(not isinstance(ct, ad.Zero) for ct in cotangents)
        cotangents = tuple(ct for ct, n in zip(cotangents, nonzero) if n)
        along = partial(pull, x, fixed, which=(wanted, nonzero), outputs=outputs)
    return jax.vmap(along)(cotangents) if many else along(cotangents)


def _pull_by_pushing(x, fixed: Sequence, wanted: Sequence, cotangents: Sequence, **params):
    """Push along the axes of all wanted arrays, and return the products of these derivatives with the cotangents."""
    push = partial(_tangent_p.bind, *x, *fixed, many=True, **params)
    return _along_axes(x, wanted, push, cotangents)


def _tangent_batched(operands: Sequence, axes, *, outputs: Callable, shapes: tuple, size: int, many: bool):
    operands, batched, lanes = front(operands, axes)
    x, fixed, dx = _split(operands, size)
    batched_x, batched_fixed, batched_dx = _split(batched, size)

    def widen(leaves: Sequence, have):
        return [leaf if here else jnp.broadcast_to(leaf, (lanes, *leaf.shape)) for leaf, here in zip(leaves, have)]

    params = dict(outputs=outputs, shapes=shapes, size=size, many=many)
    if not any(batched_x + batched_fixed):
        # Many directions at one point: do not repeat the solve itself.
        dx = widen(dx, batched_dx)
        if many:
            dx = [d.reshape(-1, *d.shape[2:]) for d in dx]
        dy = _tangent_p.bind(*x, *fixed, *dx, **{**params, "many": True})
        dy = [d.reshape(lanes, -1, *d.shape[1:]) for d in dy] if many else dy
        return dy, [0] * len(dy)
    # Lanes: the same solve at many points, one direction each; a tangent has the shape of its primal. Arrays shared by
    # all lanes, such as a network's, are not repeated: products with them, and for their gradient, are matrix products.
    per_lane = [many or a or b for a, b in zip(batched_x, batched_dx)]
    x, dx = (widen(y, [b or not a for b, a in zip(have, per_lane)]) for y, have in ((x, batched_x), (dx, batched_dx)))

    def along(dx: Sequence):
        return _lanes(x, fixed, dx, per_lane, batched_fixed, lanes, params)

    if many:
        # The directions of each lane one after the other.
        dy = lax.map(along, [jnp.moveaxis(d, 1, 0) for d in dx])
        dy = [jnp.moveaxis(d, 0, 1) for d in dy]
    else:
        dy = along(dx)
    return dy, [0] * len(dy)


def _lanes(x, fixed: Sequence, dx: Sequence, per_lane, batched_fixed, lanes, params: PyTree):
    in_axes = [0 if here else None for here in (*per_lane, *batched_fixed)]
    outputs, shapes = params["outputs"], params["shapes"]

    def lane_outputs(adjoint: Any, *operands):
        return jax.vmap(partial(outputs, adjoint), in_axes, axis_size=lanes)(*operands)

    shapes = tuple(((lanes, *shape), dtype) for shape, dtype in shapes)
    return _tangent_p.bind(*x, *fixed, *dx, **{**params, "outputs": lane_outputs, "shapes": shapes, "many": False})


_solve_p = primitive(
    "lagjax_trajectory", _solved, _solved_shapes, several=True, jvp=_solved_jvp, batched=_solved_batched
)
_columns_p = primitive(
    "lagjax_trajectory_columns", _columns, _columns_shapes, several=True, jvp=_columns_jvp, batched=_columns_batched
)
_tangent_p = linear_map_primitive(
    "lagjax_trajectory_tangent", _tangent, _tangent_transpose, _tangent_shapes, lambda params: params["size"],
    jvp=_tangent_jvp, batched=_tangent_batched,
)  # fmt: skip
_pushed_p = linear_map_primitive(
    "lagjax_trajectory_tangent_pushed", _pushed, _pushed_transpose, _pushed_shapes, lambda params: params["size"],
    jvp=_pushed_jvp, batched=_pushed_batched,
)  # fmt: skip
