"""A solve that can be differentiated forward and in reverse without being told which.

diffrax offers one derivative a solve: `ForwardMode` or `RecursiveCheckpointAdjoint`. Which one is wanted is
known only when JAX pushes tangents through (`jacfwd`, Levenberg-Marquardt) or transposes them (`grad`).
The derivative of y = solve(x) is therefore bound as a linear map dx -> dy of its own: a primitive that is
evaluated by forward mode and transposed by the checkpointed reverse mode. Undifferentiated, there is no
trace of it in the compiled program. Differentiated, the plain solve runs beside the derivative's own;
naming an `adjoint` saves that one solve.

Second derivatives work forward over forward (`jacfwd` of `jacfwd`).
"""

from collections.abc import Callable
from functools import partial

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree


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
    dx = jtu.tree_map(eqxi.materialise_zeros, x, dx, is_leaf=lambda leaf: leaf is None)
    leaves, structure = jtu.tree_flatten((x, fixed))
    size = len(jtu.tree_leaves(x))

    def float_outputs(adjoint, *operands):
        x, fixed = jtu.tree_unflatten(structure, operands)
        return jtu.tree_leaves(eqx.filter(solve(x, fixed, adjoint), eqx.is_inexact_array))

    floats, rest = eqx.partition(y, eqx.is_inexact_array)
    shapes = tuple((leaf.shape, leaf.dtype) for leaf in jtu.tree_leaves(floats))
    dy = _tangent_p.bind(*leaves, *jtu.tree_leaves(dx), outputs=float_outputs, shapes=shapes, size=size)
    dy = jtu.tree_unflatten(jtu.tree_structure(floats), dy)
    return y, eqx.combine(dy, jtu.tree_map(lambda _: None, rest))


# The operands of the primitive are the leaves of x, of `fixed`, and of dx; `size` is the count of the
# first and the last. `outputs(adjoint, *x, *fixed)` gives the floating leaves of the result; their `shapes`
# are those of their tangents, and known without tracing.


def _split(operands, size):
    return operands[:size], operands[size:-size], operands[-size:]


def _tangent(*operands, outputs, shapes, size):
    x, fixed, dx = _split(operands, size)
    return jax.jvp(lambda *x: outputs(diffrax.ForwardMode(), *x, *fixed), x, dx)[1]


def _tangent_shapes(*operands, outputs, shapes, size):
    return [jax.core.ShapedArray(shape, dtype) for shape, dtype in shapes]


def _tangent_jvp(primals, tangents, **params):
    tangents = tuple(None if isinstance(t, ad.Zero) else t for t in tangents)
    dy, ddy = eqx.filter_jvp(partial(_tangent, **params), tuple(primals), tangents)
    return dy, [eqxi.materialise_zeros(a, b) for a, b in zip(dy, ddy)]


def _tangent_transpose(cotangents, *operands, outputs, shapes, size):
    x, fixed, _ = _split(operands, size)
    _, pullback = jax.vjp(lambda *x: outputs(diffrax.RecursiveCheckpointAdjoint(), *x, *fixed), *x)
    dx = pullback([ad.instantiate_zeros(ct) for ct in cotangents])
    return [None] * (len(operands) - size) + list(dx)


def _tangent_batched(operands, axes, *, outputs, shapes, size):
    lanes = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    front = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    x, fixed, dx = _split(front, size)
    batched_x, batched_fixed, batched_dx = _split([axis is not None for axis in axes], size)
    # A tangent has the shape of its primal: where one of the two is batched, so is the other.
    batched = [a or b for a, b in zip(batched_x, batched_dx)]
    widen = lambda leaves, have: [
        leaf if here or not needed else jnp.broadcast_to(leaf, (lanes, *leaf.shape))
        for leaf, here, needed in zip(leaves, have, batched)
    ]
    x, dx = widen(x, batched_x), widen(dx, batched_dx)
    in_axes = [0 if b else None for b in (*batched, *batched_fixed)]

    def lane_outputs(adjoint, *operands):
        return jax.vmap(partial(outputs, adjoint), in_axes, axis_size=lanes)(*operands)

    shapes = tuple(((lanes, *shape), dtype) for shape, dtype in shapes)
    dy = _tangent_p.bind(*x, *fixed, *dx, outputs=lane_outputs, shapes=shapes, size=size)
    return dy, [0] * len(dy)


_tangent_p = Primitive("lagjax_trajectory_tangent")
_tangent_p.multiple_results = True
_tangent_p.def_impl(_tangent)
_tangent_p.def_abstract_eval(_tangent_shapes)
mlir.register_lowering(_tangent_p, mlir.lower_fun(_tangent, multiple_results=True))
ad.primitive_jvps[_tangent_p] = _tangent_jvp
ad.primitive_transposes[_tangent_p] = _tangent_transpose
batching.primitive_batchers[_tangent_p] = _tangent_batched
