"""A whole program as one machine function, differentiable in both modes.

On a CPU, XLA runs a compiled program as a list of kernels and library calls, and going from one to the next costs 0.05
to 0.1 microseconds. A step of a mechanical system is hundreds of operations on single numbers: nearly all of its time
would go there. XLA has a remedy for loops that touch very little memory: it compiles them into one function and calls
that. `one_function` asks for the same for a program of ours; measured on the bead and the Cartesian pendulum it is 7 to
13 times faster, and compiles in less time.

Such a program may contain no library call (LAPACK, the host), no large reduction or product, no general scatter. `fits`
reads off the jaxpr whether a program qualifies; one that does not runs as usual. In a batch the operations are long
enough to be kernels, and the request is dropped; on a CPU a large batch is taken in blocks.

The request is made by two attributes of a call. `inlineable="false"` keeps the call a call, and
`xla_cpu_small_call="true"` is XLA's own mark for loops that its pass `small-while-loop-hoisting` has chosen. An XLA
that does not know them ignores them. What they buy, measured on a pendulum on a rod: with jax 0.10.2 a solve takes 0.3
ms, 4 without the second mark, and 5 without both, when it takes six times as long to compile. The XLA of jax 0.12
chooses such loops by itself: 0.4 ms, the same without the second mark, and 1.1 without both; code outside loops still
is one kernel only with both. `tests/jaxtools/test_fuse_cpu.py` counts kernels.

JAX has no public call for such attributes, up to 0.12; the experimental one puts them on the operation that makes
a result.

`one_function` is differentiated forward along its operations, and can no longer be transposed.
`one_function_in_both_modes` can, as often as wanted: its derivative is a linear map of its own, dx -> dy at x:
evaluated forward as one function, and transposed by another one, which computes

    x, dy*  ->  (dy/dx)ᵀ dy*

from the start. So what reverse mode keeps are the arguments, and no more. In a batch both are the usual programs.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jax.core import ShapedArray
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir
from jaxtyping import Array, PyTree

from lagjax.jaxtools.jaxpr import (
    ACCUMULATING,
    CALLS,
    CALLS_WITH_RULES,
    CONTROL_FLOW,
    ELEMENTWISE,
    EQUINOX_PRIMITIVES,
    MOVING,
    REDUCING,
    anywhere,
    bodies,
    equations,
    rewritten,
    without_chains,
)
from lagjax.jaxtools.primitives import front, is_float, linear_map_primitive, no_tangent, one_by_one, primitive, split
from lagjax.jaxtools.tracing import as_usual, is_plain

STAYS_A_CALL = {"inlineable": "false"}
ONE_KERNEL = {"inlineable": "false", "xla_cpu_small_call": "true"}
# Reductions and products above this become library calls.
LARGE = 1024
# Lanes of a batch that a CPU takes together: a sweep of pendulums takes 143 microseconds a lane one by one, 94 in
# blocks of 64, 42 in blocks of 256, and 55 in blocks of 2048, which do not fit into its caches.
TOGETHER = 256
# A matrix product of more multiplications is left to the library: that gains more than one function.
PRODUCT = 4096
# But not a vector of so few numbers times a matrix, as the sum of the stages of a step, which reads each number once.
FEW_TERMS = 16
AT_ANY_SIZE = ELEMENTWISE | MOVING | EQUINOX_PRIMITIVES | {
    "bessel_i0e", "bessel_i1e", "bitcast_convert_type", "dynamic_update_slice", "empty2", "reduce_precision", "sincos",
    "tile", "xla_metadata_value", "added",
}  # fmt: skip
SMALL = REDUCING | ACCUMULATING - {"cumlogsumexp"} | {"argmax", "argmin"}
WITH_BODIES = CALLS | CALLS_WITH_RULES | CONTROL_FLOW | {"one_function"}


def one_function(function: Callable, *args, checked: bool = False, in_blocks: bool = False, in_parts: bool = False):
    """`function(*args)`, compiled as one machine function where that is possible.

    >>> import jax.numpy as jnp
    >>> print(one_function(lambda x: {"twice": 2 * x}, jnp.asarray(3.0))["twice"])
    6.0

    **Arguments:** pytrees, of which the arrays are passed and all else is compiled in; what `function` returns may
    contain anything too. It must not close over traced values. `checked` says that all of equinox's checks in it
    (`error_if`, a call of the host) are known to pass: they are left out. With `in_blocks`, a batch on a CPU is
    processed a few hundred lanes at a time. With `in_parts`, only those parts become functions that ask for it
    themselves: LLVM's time for one function grows faster than its length.

    Its forward derivative is one function too, also along many directions. Reverse mode must use `function` itself.
    """
    if is_plain():
        return function(*args)
    arrays, static = eqx.partition(args, eqx.is_array)
    given, structure = jtu.tree_flatten(arrays)
    # An array that is passed twice, as by a solver and its controller, is one operand.
    leaves = list({id(x): x for x in given}.values())
    places = {id(x): i for i, x in enumerate(leaves)}
    rest = []

    def of_leaves(*leaves):
        repeated = [leaves[places[id(x)]] for x in given]
        result = function(*eqx.combine(jtu.tree_unflatten(structure, repeated), static))
        arrays, others = eqx.partition(result, eqx.is_array)
        rest.append(others)
        return arrays

    jaxpr, shapes = jax.make_jaxpr(of_leaves, return_shape=True)(*leaves)
    jaxpr = without_chains(without_checks(jaxpr) if checked else jaxpr)
    found = _one_function_p.bind(
        *leaves, jaxpr=jaxpr, in_blocks=in_blocks, in_parts=in_parts, points=len(leaves), values=0, checked=checked
    )
    return eqx.combine(jtu.tree_unflatten(jtu.tree_structure(shapes), found), rest[0])


def marked(result: jax.Array, marks: dict[str, str]) -> jax.Array:
    """Put marks on the call of a jitted function, given its first result; return that."""
    return cast(jax.Array, set_xla_metadata(result, **marks))


def kept_as_call(results: PyTree):
    """Keep the jitted function of these `results` a call; else XLA computes it again for each use of a result."""
    if jax.default_backend() != "cpu" or is_plain():
        return results
    first, *others = jtu.tree_leaves(results)
    return jtu.tree_unflatten(jtu.tree_structure(results), [marked(first, STAYS_A_CALL), *others])


def apart(function: Callable, *args):
    """`function(*args)` as a call of its own: what XLA fuses, it computes again for each use.

    >>> import jax.numpy as jnp
    >>> print(apart(jnp.sin, jnp.asarray(0.0)))
    0.0
    """
    return kept_as_call(_jitted(function, args))


@as_usual
@eqx.filter_jit
def _jitted(function: Callable, args: tuple):
    return function(*args)


def fits(jaxpr: Jaxpr) -> bool:
    """Whether XLA can compile a program as one function; to be asked after `without_library`."""
    return all(_equation_fits(equation) for equation in jaxpr.eqns)


def _equation_fits(equation):
    name, sizes = equation.primitive.name, [x.aval.size for x in equation.invars]
    if name == "vprim":  # One of equinox's primitives, batched.
        name = equation.params["prim"].name
    if name in AT_ANY_SIZE:
        return True
    if name == "inverse":
        return equation.params["eliminate"]
    if name == "product":
        (contracted, _), _ = equation.params["dimension_numbers"]
        summed = math.prod(equation.invars[0].aval.shape[i] for i in contracted)
        adds_up = summed <= FEW_TERMS and min(x.aval.ndim for x in equation.invars) == 1
        return adds_up or equation.outvars[0].aval.size * summed <= PRODUCT
    if name in SMALL:
        return max(sizes) <= LARGE
    if name.startswith("scatter"):
        # A scatter to one place becomes an update of a slice.
        indices = equation.invars[1].aval
        return indices.size == (indices.shape[-1] if indices.ndim else 1)
    return name in WITH_BODIES and all(fits(body) for body in bodies(equation))


def without_checks(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program without equinox's checks (`error_if`); other calls of the host stay."""
    return rewritten(closed, _without_check) if calls_host(closed.jaxpr) else closed


def poisoned(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program in which a failing equinox check gives NaN, in its lane only, instead of raising."""
    return without_checks(rewritten(closed, _poisoned)) if calls_host(closed.jaxpr) else closed


def _poisoned(equation: JaxprEqn):
    """A call of equinox's `branched_error_if_impl(x, condition, ...)`, with NaN for x where the condition is true."""
    if equation.params.get("name") != "branched_error_if_impl" or "jaxpr" not in equation.params:
        return equation
    inner = equation.params["jaxpr"]
    inside = inner.jaxpr
    # It asks once for all lanes (`unvmap_any`) whether any fails: the operand says so for each lane.
    conditions = [e.invars[0] for e in inside.eqns if e.primitive.name == "unvmap_any"]
    places = [i for i, x in enumerate(inside.invars) if any(x is y for y in conditions)]
    unchecked = jaxpr_as_fun(without_checks(inner))

    def with_nan(*operands):
        fails = jnp.any(jnp.stack([jnp.any(operands[i]) for i in places]))

        def nan(x: Array) -> Array:
            return jnp.where(fails, jnp.nan, x) if jnp.issubdtype(x.dtype, jnp.inexact) else x

        return [nan(x) for x in unchecked(*operands)]

    if not places:
        return equation
    program = jax.make_jaxpr(with_nan)(*(jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in inside.invars))
    return equation.replace(params={**equation.params, "jaxpr": program})


def _without_check(equation: JaxprEqn):
    """Replace a branch that calls the host only to raise an error by the other branch, which does not."""
    branches = equation.params.get("branches", ())
    silent = [branch for branch in branches if not calls_host(branch.jaxpr)]
    raising = [branch for branch in branches if calls_host(branch.jaxpr) and _only_raises(branch.jaxpr)]
    if len(silent) != 1 or len(raising) + 1 != len(branches):
        return equation
    return equation.replace(params={**equation.params, "branches": tuple(silent * len(branches))})


# Whether a program calls functions of Python while it runs.
calls_host = anywhere(lambda equation: "callback" in equation.primitive.name)


def _only_raises(jaxpr: ClosedJaxpr):
    calls = [equation for equation in equations(jaxpr) if "callback" in equation.primitive.name]
    host_functions = [getattr(equation.params.get("callback"), "callback_func", None) for equation in calls]
    return all(getattr(function, "__module__", None) == "equinox._errors" for function in host_functions)


def without_library(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program with matrix products and eliminations as loops of lagjax's own."""
    return rewritten(closed, _equation_without_library)


def _equation_without_library(equation: JaxprEqn):
    name = equation.primitive.name
    if name == "inverse":
        return equation.replace(params={**equation.params, "eliminate": True})
    if name == "dot_general":
        numbers = equation.params["dimension_numbers"]
        return equation.replace(
            primitive=_product_p, params={"dimension_numbers": numbers, "like": equation.outvars[0].aval}
        )
    if name == "scatter-add" and _adds_to_entries(equation):
        numbers = equation.params["dimension_numbers"]
        (axis,), windows = numbers.scatter_dims_to_operand_dims, numbers.update_window_dims
        (of_added,) = set(range(cast(Any, equation.invars[2].aval).ndim)) - set(windows)
        clips = equation.params["mode"] == lax.GatherScatterMode.CLIP
        return equation.replace(primitive=_added_p, params={"axes": (axis, of_added), "clips": clips})
    return equation


def _adds_to_entries(equation: JaxprEqn) -> bool:
    """Whether it adds a few entries along one axis of a small array, as does the derivative of `q[i]` for many i."""
    array, places, added = (cast(Any, x.aval) for x in equation.invars)
    numbers = equation.params["dimension_numbers"]
    along = numbers.scatter_dims_to_operand_dims
    return (
        len(along) == 1 and numbers.inserted_window_dims == along and not numbers.operand_batching_dims
        and places.ndim == 2 and added.ndim == array.ndim and added.size * array.shape[along[0]] <= LARGE
    )  # fmt: skip


def _added(array: Array, places: Array, added: Array, axes: tuple[int, int], clips: bool):
    """The array with entries added along an axis, without a scatter; those outside are left out, or moved (`clips`)."""
    rows, added = jnp.moveaxis(array, axes[0], 0), jnp.moveaxis(added, axes[1], 0)
    place = jnp.clip(places[:, 0], 0, rows.shape[0] - 1) if clips else places[:, 0]
    here = place[:, None] == jnp.arange(rows.shape[0])[None]
    here = here.reshape(here.shape + (1,) * (rows.ndim - 1))
    return jnp.moveaxis(rows + jnp.sum(jnp.where(here, added[:, None], 0), axis=0, dtype=rows.dtype), 0, axes[0])


def _product(left: Array, right: Array, dimension_numbers, like):
    """A matrix product that XLA does not pass on to a library, as it does with sums of many multiplications.

    Such sums are added up in a loop over their terms.
    """
    (of_left, of_right), (left_lanes, right_lanes) = dimension_numbers

    def arranged(x, contracted: Sequence[int], lanes):
        free = [i for i in range(x.ndim) if i not in contracted and i not in lanes]
        groups = (lanes, free, contracted)
        return x.transpose(*lanes, *free, *contracted).reshape(
            [math.prod(x.shape[i] for i in group) for group in groups]
        )

    left = arranged(left.astype(like.dtype), of_left, left_lanes)
    right = arranged(right.astype(like.dtype), of_right, right_lanes)
    lanes, rows, columns, summed = *left.shape[:2], *right.shape[1:]
    if lanes * rows * columns * summed <= LARGE:
        return jnp.sum(left[:, :, None] * right[:, None], axis=-1, dtype=like.dtype).reshape(like.shape)

    def added(i: Array, total: Array):
        entries = [lax.dynamic_index_in_dim(x, i, axis=2, keepdims=False) for x in (left, right)]
        return total + entries[0][:, :, None] * entries[1][:, None]

    zero = jnp.zeros((lanes, rows, columns), like.dtype)
    # Four terms at a time are twice as fast as one, and sixteen no faster.
    return lax.fori_loop(0, summed, added, zero, unroll=4).reshape(like.shape)


def _unmarked(*operands, jaxpr: ClosedJaxpr, **params):
    return jaxpr_as_fun(jaxpr)(*operands)


def _marked(*operands, jaxpr: ClosedJaxpr, in_parts: bool = False, **params):
    original, jaxpr = jaxpr, without_library(jaxpr)
    if in_parts or not fits(jaxpr.jaxpr):
        return _unmarked(*operands, jaxpr=original)

    # XLA ends the process if an operand of such a call is not used in it: one that is never used, one that it finds to
    # be unnecessary, or one above 10 kB that it knows and writes into the function. So each operand is a result too,
    # and the barrier hides its value.
    def function(*operands):
        return *jaxpr_as_fun(jaxpr)(*operands), *map(jnp.copy, operands)

    # The mark of a result is put on the operation that makes it: the call.
    first, *others = jax.jit(function)(*lax.optimization_barrier(operands))
    return [marked(first, ONE_KERNEL), *others][: len(jaxpr.out_avals)]


def _jvp_program(jaxpr: ClosedJaxpr, has_tangent: Sequence[bool], checked: bool):
    """The program of values and derivatives; it takes the operands, and the tangents of those with `has_tangent`."""

    def values_and_derivatives(*operands):
        primals, moving = operands[: len(has_tangent)], operands[len(has_tangent) :]

        def of_moved(*moved):
            moved = iter(moved)
            return jaxpr_as_fun(jaxpr)(*(next(moved) if k else x for x, k in zip(primals, has_tangent)))

        y, dy = jax.jvp(of_moved, [x for x, k in zip(primals, has_tangent) if k], list(moving))
        # Results that are not floating-point numbers have no derivative.
        return *y, *(d for d in dy if d.dtype != jax.dtypes.float0)

    moving = [aval for aval, k in zip(jaxpr.in_avals, has_tangent) if k]
    like = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in (*jaxpr.in_avals, *moving)]
    program = jax.make_jaxpr(values_and_derivatives)(*like)
    # The derivative of a check is a check.
    return without_checks(program) if checked else program


def _jvp(primitive: Primitive, primals: Sequence, tangents: Sequence, *, jaxpr: ClosedJaxpr, checked: bool, **params):
    has_tangent = [not isinstance(t, ad.Zero) for t in tangents]
    moving = [t for t, k in zip(tangents, has_tangent) if k]
    program, count = _jvp_program(jaxpr, has_tangent, checked), len(jaxpr.out_avals)
    if "batched" in params:
        params["batched"] += tuple(b for b, k in zip(params["batched"], has_tangent) if k)
    else:
        params |= {"points": len(primals), "values": count}
    found = primitive.bind(*primals, *moving, jaxpr=program, checked=checked, **params)
    derivatives = iter(found[count:])
    shapes = [primal.aval.to_tangent_aval() for primal in jaxpr.jaxpr.outvars]
    if "lanes" in params:
        shapes = [aval.update(shape=(params["lanes"], *aval.shape)) for aval in shapes]

    def moves(aval: Any) -> bool:
        return aval.dtype != jax.dtypes.float0

    return found[:count], [next(derivatives) if moves(aval) else ad.Zero(aval) for aval in shapes]


def _batched(
    operands: Sequence, axes: Sequence, *, jaxpr: ClosedJaxpr, in_blocks: bool, in_parts: bool, points: int,
    values: int, checked: bool,
):  # fmt: skip
    front = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    batched = tuple(axis is not None for axis in axes)
    lanes = next(x.shape[0] for x, b in zip(front, batched) if b)
    params = dict(jaxpr=jaxpr, batched=batched, lanes=lanes, checked=checked)
    if not any(batched[:points]):
        # Many directions at one point, whose values are computed once.
        out_axes = [None] * values + [0] * (len(jaxpr.out_avals) - values)
        together = jax.make_jaxpr(jax.vmap(jaxpr_as_fun(jaxpr), [0 if b else None for b in batched], out_axes))(*front)
        params = dict(in_blocks=in_blocks, in_parts=in_parts, points=points, values=values, checked=checked)
        results = _one_function_p.bind(*front, jaxpr=together, **params)
        return results, [axis if axis is None else 0 for axis in out_axes]
    results = _in_blocks_p.bind(*front, **params) if in_blocks else _lanes_together(*front, **params)
    return results, [0] * len(results)


def _lanes_together(*operands, jaxpr: ClosedJaxpr, batched: Sequence[bool], lanes=None, **params):
    if isinstance(lanes, int) and lanes == 0:
        # A loop that runs until the slowest lane is done has none to ask here.
        return [jnp.zeros((0, *aval.shape), aval.dtype) for aval in jaxpr.out_avals]
    return jax.vmap(jaxpr_as_fun(jaxpr), [0 if b else None for b in batched])(*operands)


def _lanes_in_blocks(*operands, jaxpr: ClosedJaxpr, batched: Sequence[bool], lanes, **params):
    """A loop over as few blocks of lanes as fit, all of one length: copies of the last lane fill the last block."""
    together = partial(_lanes_together, jaxpr=jaxpr, batched=batched)
    if not isinstance(lanes, int):
        # An exported program of any number of lanes does not know how many blocks there are.
        return together(*operands, lanes=lanes)
    blocks = -(-lanes // TOGETHER)
    if blocks <= 1:
        return together(*operands, lanes=lanes)
    length = -(-lanes // blocks)

    def in_blocks(x):
        filled = jnp.concatenate([x, jnp.broadcast_to(x[-1:], (blocks * length - lanes, *x.shape[1:]))])
        return filled.reshape(blocks, length, *x.shape[1:])

    def of_block(batched_operands: Sequence):
        remaining = iter(batched_operands)
        return tuple(together(*(next(remaining) if b else x for x, b in zip(operands, batched))))

    found = lax.map(of_block, [in_blocks(x) for x, b in zip(operands, batched) if b])
    return [x.reshape(blocks * length, *x.shape[2:])[:lanes] for x in found]


def _batched_again(
    operands: Sequence, axes: Sequence, *, jaxpr: ClosedJaxpr, batched: Sequence[bool], lanes, checked: bool
):
    more = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    flat = []
    for x, axis, b in zip(operands, axes, batched):
        if axis is None and not b:
            flat.append(x)
            continue
        x = jnp.broadcast_to(x, (more, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
        x = x if b else jnp.broadcast_to(x[:, None], (more, lanes, *x.shape[1:]))
        flat.append(x.reshape(more * lanes, *x.shape[2:]))
    varied = tuple(b or axis is not None for b, axis in zip(batched, axes))
    results = _in_blocks_p.bind(*flat, jaxpr=jaxpr, batched=varied, lanes=more * lanes, checked=checked)
    return [x.reshape(more, lanes, *x.shape[1:]) for x in results], [0] * len(results)


def _lane_shapes(*operands, jaxpr: ClosedJaxpr, lanes, **params):
    return [aval.update(shape=(lanes, *aval.shape)) for aval in jaxpr.out_avals]


def _define(name: str, evaluate: Callable, on_cpu: Callable, shapes, batch: Callable):
    primitive = Primitive(name)
    primitive.multiple_results = True
    primitive.def_impl(as_usual(lambda *x, **params: jax.jit(lambda *x: primitive.bind(*x, **params))(*x)))
    primitive.def_abstract_eval(shapes)
    ad.primitive_jvps[primitive] = partial(_jvp, primitive)
    batching.primitive_batchers[primitive] = batch
    mlir.register_lowering(primitive, mlir.lower_fun(evaluate, multiple_results=True))
    mlir.register_lowering(primitive, mlir.lower_fun(one_by_one(on_cpu), multiple_results=True), platform="cpu")
    return primitive


# Stands for `dot_general` in a program that is compiled as one function.
_product_p = Primitive("product")
_product_p.def_abstract_eval(lambda left, right, like, **params: like)
mlir.register_lowering(_product_p, mlir.lower_fun(_product, multiple_results=False))

# Stands for `scatter-add` there.
_added_p = Primitive("added")
_added_p.def_abstract_eval(lambda array, places, added, **params: array)
mlir.register_lowering(_added_p, mlir.lower_fun(_added, multiple_results=False))

_one_function_p = _define("one_function", _unmarked, _marked, lambda *x, jaxpr, **params: jaxpr.out_avals, _batched)
_in_blocks_p = _define("in_blocks", _lanes_together, _lanes_in_blocks, _lane_shapes, _batched_again)


def one_function_in_both_modes(function: Callable, *args) -> PyTree:
    """`function(*args)`, compiled as one machine function where that is possible, and so are its derivatives.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> print(jax.grad(lambda x: one_function_in_both_modes(jnp.sin, x))(jnp.asarray(0.0)))
    1.0

    The arguments are those of `one_function`; the results are arrays.
    """
    if is_plain():
        return function(*args)
    arrays, static = eqx.partition(args, eqx.is_array)
    leaves, structure = jtu.tree_flatten(arrays)
    structures = []

    def of_leaves(*leaves):
        found, of_results = jtu.tree_flatten(function(*eqx.combine(jtu.tree_unflatten(structure, leaves), static)))
        structures.append(of_results)
        return found

    program = jax.make_jaxpr(of_leaves)(*leaves)
    # Jitted, so that it is traced once.
    call = jax.jit(jaxpr_as_fun(program))
    return jtu.tree_unflatten(structures[0], _function_p.bind(*leaves, of=_Function(call, False)))


@dataclass(frozen=True, eq=False)
class _Function:
    """A function of arrays that returns a list of arrays; `lanes`: whether it is one of a batch."""

    call: Callable
    lanes: bool

    def compiled(self, function: Callable, *args):
        """A function that is made from this one, at some arguments."""
        return function(*args) if self.lanes else one_function(function, *args)

    def in_lanes(self, batched: Sequence[bool], lanes: bool = True) -> "_Function":
        """The same for a batch."""
        return _Function(jax.vmap(self.call, [0 if b else None for b in batched]), lanes)


def _evaluated(*leaves, of: _Function):
    return list(of.compiled(of.call, *leaves))


def _shapes(*leaves, of: _Function):
    found = jax.eval_shape(of.call, *(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in leaves))
    return [ShapedArray(x.shape, x.dtype) for x in found]


def _function_jvp(primals: Sequence, tangents: Sequence, *, of: _Function):
    values = _function_p.bind(*primals, of=of)
    moved = tuple(i for i, t in enumerate(tangents) if not isinstance(t, ad.Zero))
    if not moved:
        return values, [no_tangent(y) for y in values]
    dy = iter(_tangent_p.bind(*primals, *(tangents[i] for i in moved), of=of, moved=moved))
    return values, [next(dy) if is_float(y) else no_tangent(y) for y in values]


def _function_batched(operands: Sequence, axes: Sequence, *, of: _Function):
    operands, batched, _ = front(operands, axes)
    found = _function_p.bind(*operands, of=of.in_lanes(batched))
    return found, [0] * len(found)


# The operands of the derivative are the arguments, and the directions of those with indices `moved`; its results are
# the derivatives of the floating-point results.


def _of_moved(points: Sequence, *chosen, of: _Function, moved: Sequence[int]):
    every = list(points)
    for i, x in zip(moved, chosen):
        every[i] = x
    return [y for y in of.call(*every) if is_float(y)]


def _along(points: Sequence, directions: Sequence, *, of: _Function, moved: Sequence[int]):
    start = tuple(points[i] for i in moved)
    return jax.jvp(partial(_of_moved, points, of=of, moved=moved), start, tuple(directions))[1]


def _pushed(points: Sequence, directions: Sequence, *, of: _Function, moved: Sequence[int]):
    return of.compiled(partial(_along, of=of, moved=moved), points, directions)


def _pushed_shapes(*operands, of: _Function, moved: Sequence[int]):
    return [x for x in _shapes(*split(operands, len(moved))[0], of=of) if is_float(x)]


def _pulled(
    points: Sequence, directions: Sequence, wanted: Sequence[bool], cotangents: Sequence, *, of: _Function,
    moved: Sequence[int],
):  # fmt: skip
    moved = tuple(i for i, w in zip(moved, wanted) if w)
    count = len(points)

    def pull(*operands):
        points, cotangents = operands[:count], operands[count:]
        _, back = jax.vjp(partial(_of_moved, points, of=of, moved=moved), *(points[i] for i in moved))
        return list(back(list(cotangents)))

    # Itself such a function, to be differentiated again.
    return _function_p.bind(*points, *map(ad.instantiate_zeros, cotangents), of=_Function(pull, of.lanes))


def _pushed_as_function(of: _Function, moved: Sequence[int]) -> _Function:
    def push(*operands):
        return _along(*split(operands, len(moved)), of=of, moved=moved)

    return _Function(push, of.lanes)


def _pushed_jvp(primals: Sequence, tangents: Sequence, *, of: _Function, moved: Sequence[int]):
    values = _tangent_p.bind(*primals, of=of, moved=moved)
    return values, _function_jvp(primals, tangents, of=_pushed_as_function(of, moved))[1]


def _pushed_batched(operands: Sequence, axes: Sequence, *, of: _Function, moved: Sequence[int]):
    operands, batched, _ = front(operands, axes)
    # Many directions at one point still are one function.
    lanes = of.lanes or any(split(batched, len(moved))[0])
    found = _function_p.bind(*operands, of=_pushed_as_function(of, moved).in_lanes(batched, lanes))
    return found, [0] * len(found)


def function_of(function: Callable, lanes: bool, *operands) -> list:
    """A function of arrays, which returns a list of them, in both modes; `lanes`: whether it is one of a batch."""
    return _function_p.bind(*operands, of=_Function(function, lanes))


def function_in_lanes(function: Callable, lanes: bool, operands: Sequence, axes: Sequence) -> tuple[list, list]:
    """The same in a batch, with the axes of its results."""
    operands, batched, _ = front(operands, axes)
    found = _function_p.bind(*operands, of=_Function(function, lanes).in_lanes(batched, lanes))
    return found, [0] * len(found)


def pushed_again(function: Callable, lanes: bool, primals: Sequence, tangents: Sequence) -> list:
    """The derivatives of its results."""
    return _function_jvp(primals, tangents, of=_Function(function, lanes))[1]


_function_p = primitive(
    "lagjax_function", _evaluated, _shapes, several=True, jvp=_function_jvp, batched=_function_batched
)
_tangent_p = linear_map_primitive(
    "lagjax_function_tangent", _pushed, _pulled, _pushed_shapes, lambda params: len(params["moved"]),
    jvp=_pushed_jvp, batched=_pushed_batched,
)  # fmt: skip
