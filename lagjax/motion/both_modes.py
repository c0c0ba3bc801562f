"""A solve that can be differentiated forward and in reverse without being told which.

diffrax offers one derivative a solve: `ForwardMode` or `RecursiveCheckpointAdjoint`. Which one is wanted is
known only when JAX pushes tangents through (`jacfwd`, Levenberg-Marquardt) or transposes them (`grad`).
The derivative of y = solve(x) is therefore bound as a linear map dx -> dy of its own: a primitive that is
evaluated by forward mode and transposed by the checkpointed reverse mode; where few derivatives are asked for,
by forward mode too, along each of them. Undifferentiated, there is no trace of it in the compiled program.
Differentiated, the plain solve runs beside the derivative's own; naming an `adjoint` saves that one solve.

Second derivatives work forward over forward (`jacfwd` of `jacfwd`).
"""

from collections.abc import Callable
from functools import partial, reduce

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import ShapedArray
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

# Up to this many derivatives of one number, pushing all of them forward is cheaper than one pull back through the
# checkpoints, to run and to compile.
PUSH_UP_TO = 24


def solve_in_both_modes(solve: Callable, x: PyTree, fixed: PyTree) -> PyTree:
    """`solve(x, fixed, adjoint)` for a diffrax adjoint, differentiable in both modes in `x`.

    All leaves of `x` are floating arrays, all leaves of `fixed` and of the result are arrays, and `solve`
    closes over no traced value.
    """
    return _solve((x, fixed), solve=solve)


@eqx.filter_custom_jvp
def _solve(inputs, *, solve):
    return solve(*inputs, diffrax.ForwardMode())


@_solve.def_jvp
def _solve_jvp(primals, tangents, *, solve):
    ((x, fixed),), ((dx, _),) = primals, tangents
    y = solve(x, fixed, diffrax.ForwardMode())
    leaves, structure = jtu.tree_flatten((x, fixed))
    along = jtu.tree_structure(x).flatten_up_to(dx)
    # What is not moved is a constant: a tangent of zeros would go through every step.
    moved = [i for i, d in enumerate(along) if d is not None] or [0]
    dx = [eqxi.materialise_zeros(leaves[i], along[i]) for i in moved]
    order = moved + [i for i in range(len(leaves)) if i not in moved]

    def float_outputs(adjoint, *operands):
        x, fixed = jtu.tree_unflatten(structure, [operands[order.index(i)] for i in range(len(order))])
        return jtu.tree_leaves(eqx.filter(solve(x, fixed, adjoint), eqx.is_inexact_array))

    floats, rest = eqx.partition(y, eqx.is_inexact_array)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jtu.tree_leaves(floats))
    params = dict(outputs=float_outputs, shapes=shapes, size=len(moved), many=False)
    dy = _tangent_p.bind(*(leaves[i] for i in order), *dx, **params)
    dy = jtu.tree_unflatten(jtu.tree_structure(floats), dy)
    return y, eqx.combine(dy, jtu.tree_map(lambda _: None, rest))


# The operands of the primitive are the leaves of x, of `fixed`, and of dx; `size` is the count of the
# first and the last. `outputs(adjoint, *x, *fixed)` gives the floating leaves of the result; their `shapes`
# are those of their tangents, and known without tracing. With `many`, each dx has a leading axis of directions,
# and so has each result.


def _split(operands, size):
    return tuple(operands[:size]), tuple(operands[size:-size]), tuple(operands[-size:])


def _tangent(*operands, outputs, shapes, size, many):
    x, fixed, dx = _split(operands, size)
    along = lambda dx: jax.jvp(lambda *x: outputs(diffrax.ForwardMode(), *x, *fixed), x, dx)[1]
    return jax.vmap(along)(dx) if many else along(dx)


def _tangent_shapes(*operands, shapes, size, many, **params):
    lead = operands[-1].shape[:1] if many else ()
    return [ShapedArray((*lead, *shape), dtype) for shape, dtype in shapes]


def _tangent_jvp(primals, tangents, **params):
    tangents = tuple(None if isinstance(t, ad.Zero) else t for t in tangents)
    dy, ddy = eqx.filter_jvp(partial(_tangent, **params), tuple(primals), tangents)
    return dy, [eqxi.materialise_zeros(a, b) for a, b in zip(dy, ddy)]


def _tangent_transpose(cotangents, *operands, size, many, **params):
    x, fixed, dx = _split(operands, size)
    cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
    wanted = [ad.is_undefined_primal(tangent) for tangent in dx]
    pull = _pull_by_pushing if sum(a.size for a, w in zip(x, wanted) if w) <= PUSH_UP_TO else _pull
    along = lambda cotangents: pull(x, fixed, wanted, cotangents, size=size, **params)
    found = iter(jax.vmap(along)(cotangents) if many else along(cotangents))
    return [None] * (len(operands) - size) + [next(found) if w else None for w in wanted]


def _pull(x, fixed, wanted, cotangents, *, outputs, **params):
    def of_wanted(*chosen):
        chosen = iter(chosen)
        every = [next(chosen) if w else a for a, w in zip(x, wanted)]
        return outputs(diffrax.RecursiveCheckpointAdjoint(), *every, *fixed)

    return jax.vjp(of_wanted, *[a for a, w in zip(x, wanted) if w])[1](cotangents)


def _pull_by_pushing(x, fixed, wanted, cotangents, **params):
    """The derivatives along the axes of all that is wanted, and their products with the cotangents."""
    sizes = [a.size if w else 0 for a, w in zip(x, wanted)]
    starts, total = np.cumsum([0, *sizes]), sum(sizes)
    axes = [
        jnp.eye(total, a.size, -start, dtype=a.dtype).reshape(total, *a.shape)
        if w
        else jnp.zeros((total, *a.shape), a.dtype)
        for a, w, start in zip(x, wanted, starts)
    ]
    dy = _tangent_p.bind(*x, *fixed, *axes, many=True, **params)
    of_outputs = [jnp.sum((d * ct[None]).reshape(total, -1), axis=1) for d, ct in zip(dy, cotangents)]
    slopes = reduce(jnp.add, of_outputs)
    return [slopes[i : i + n].reshape(a.shape).astype(a.dtype) for i, n, a, w in zip(starts, sizes, x, wanted) if w]


def _tangent_batched(operands, axes, *, outputs, shapes, size, many):
    lanes = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    front = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    x, fixed, dx = _split(front, size)
    batched_x, batched_fixed, batched_dx = _split([axis is not None for axis in axes], size)
    widen = lambda leaves, have: [
        leaf if here else jnp.broadcast_to(leaf, (lanes, *leaf.shape)) for leaf, here in zip(leaves, have)
    ]
    params = dict(outputs=outputs, shapes=shapes, size=size, many=many)
    if not any(batched_x + batched_fixed):
        # Many directions at one point: the solve itself is not repeated.
        dx = widen(dx, batched_dx)
        if many:
            dx = [d.reshape(-1, *d.shape[2:]) for d in dx]
        dy = _tangent_p.bind(*x, *fixed, *dx, **{**params, "many": True})
        dy = [d.reshape(lanes, -1, *d.shape[1:]) for d in dy] if many else dy
        return dy, [0] * len(dy)
    # Lanes: the same solve at many points, one direction each; a tangent has the shape of its primal.
    dx = widen(dx, batched_dx)
    if many:
        # One direction after the other of each lane.
        along = lambda dx: _lanes(x, fixed, dx, batched_x, batched_fixed, lanes, params)
        dy = lax.map(along, [jnp.moveaxis(d, 1, 0) for d in dx])
        dy = [jnp.moveaxis(d, 0, 1) for d in dy]
    else:
        dy = _lanes(x, fixed, dx, batched_x, batched_fixed, lanes, params)
    return dy, [0] * len(dy)


def _lanes(x, fixed, dx, batched_x, batched_fixed, lanes, params):
    x = [a if here else jnp.broadcast_to(a, (lanes, *a.shape)) for a, here in zip(x, batched_x)]
    in_axes = [0] * len(x) + [0 if here else None for here in batched_fixed]
    outputs, shapes = params["outputs"], params["shapes"]

    def lane_outputs(adjoint, *operands):
        return jax.vmap(partial(outputs, adjoint), in_axes, axis_size=lanes)(*operands)

    shapes = tuple(((lanes, *shape), dtype) for shape, dtype in shapes)
    return _tangent_p.bind(*x, *fixed, *dx, **{**params, "outputs": lane_outputs, "shapes": shapes, "many": False})


_tangent_p = Primitive("lagjax_trajectory_tangent")
_tangent_p.multiple_results = True
_tangent_p.def_impl(_tangent)
_tangent_p.def_abstract_eval(_tangent_shapes)
mlir.register_lowering(_tangent_p, mlir.lower_fun(_tangent, multiple_results=True))
ad.primitive_jvps[_tangent_p] = _tangent_jvp
ad.primitive_transposes[_tangent_p] = _tangent_transpose
batching.primitive_batchers[_tangent_p] = _tangent_batched
