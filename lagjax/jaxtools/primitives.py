"""Primitives of our own, with rules for derivatives, batches and compilation; LAPACK's operations one by one.

From jaxlib 0.10.0 to 0.11, XLA on a CPU distributes a batch of LAPACK calls over the threads of its pool, and a thread
of this pool waits for them. If a program has several such calls, or several programs run at the same time, all threads
may wait, for parts that only they could run: the process stops for good. The rule that excludes this: *on a CPU, no
program of ours calls LAPACK for more than one matrix at a time; a batch is a loop over its matrices.* A GPU takes a
batch at once.

`one_by_one` rewrites the program of a function so, whoever called LAPACK in it: we, the user's Lagrangian, a solver of
diffrax's. Each such operation becomes a primitive of our own with the same derivatives, which is a loop if JAX makes it
a batch later, in a `vmap` or a derivative outside.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial, wraps

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from lagjax.jaxtools.jaxpr import HOLDS_A_SOLVER, LAPACK, anywhere, applied, bodies, rewritten
from lagjax.jaxtools.tracing import as_usual, full_products

# The name of a function whose backward pass is rewritten already.
WITH_WAY_BACK = "with_rewritten_way_back"


def one_by_one(function: Callable) -> Callable:
    """Return the same function of pytrees, whose program calls LAPACK for one matrix at a time on a CPU.

    Named arguments are not traced.

    >>> import jax
    >>> import jax.numpy as jnp
    >>> batch = one_by_one(jax.vmap(jnp.linalg.inv))
    >>> print(batch(jnp.array([[[2.0]], [[4.0]]])).ravel())
    [0.5  0.25]
    """

    @wraps(function)
    def called(*args, **params):
        arrays, static = eqx.partition(args, eqx.is_array)
        rest = []

        def of_arrays(arrays: Sequence):
            found, others = eqx.partition(function(*eqx.combine(arrays, static), **params), eqx.is_array)
            rest.append(others)
            return found

        with full_products():
            program, shapes = jax.make_jaxpr(of_arrays, return_shape=True)(arrays)
        found = jaxpr_as_fun(without_batches(program))(*jtu.tree_leaves(arrays))
        return eqx.combine(jtu.tree_unflatten(jtu.tree_structure(shapes), found), rest[0])

    return called


def jitted(function: Callable) -> Callable:
    """Return equinox's `filter_jit` of the same function, with LAPACK called for one matrix at a time on a CPU.

    Products of matrices keep every digit, as in all programs that `one_by_one` makes.
    """
    return as_usual(eqx.filter_jit(one_by_one(function)))


def without_batches(program: ClosedJaxpr) -> ClosedJaxpr:
    """The program whose calls of LAPACK are loops over the matrices of a batch, now and after `vmap`."""
    return rewritten(program, _one_by_one) if _may_call_library(program.jaxpr) else program


def _one_by_one(equation: JaxprEqn):
    name, params = equation.primitive.name, equation.params
    while name == "vprim":  # One of equinox's primitives, batched, perhaps several times.
        name, params = params["prim"].name, dict(params["params"])
    if name in LAPACK or name in HOLDS_A_SOLVER:
        return equation.replace(primitive=_library_p, params={"of": LapackCall(equation.primitive, equation.params)})
    if name == "custom_jvp_call" and any(map(_has_library, bodies(equation))):
        return _with_rewritten_derivative(equation)
    if name == "custom_vjp_call" and not any(map(_is_rewritten, bodies(equation))):
        return _with_rewritten_way_back(equation)
    return equation


_has_library = anywhere(lambda equation: equation.primitive.name in {*LAPACK, *HOLDS_A_SOLVER})
_may_call_library = anywhere(
    lambda equation: equation.primitive.name in {*LAPACK, *HOLDS_A_SOLVER, "vprim", "custom_vjp_call"}
)


def _is_rewritten(jaxpr: Jaxpr):
    return [equation.params.get("name") for equation in jaxpr.eqns] == [WITH_WAY_BACK]


class LapackCall:
    """A primitive with its parameters; equal to another if both are, so that JAX recognises what it has compiled."""

    def __init__(self, primitive: Primitive, params: dict):
        self.primitive, self.params = primitive, params
        self._key = primitive, tuple(sorted(params.items(), key=lambda item: item[0]))

    def __eq__(self, other):
        return isinstance(other, LapackCall) and self._key == other._key

    def __hash__(self):
        return hash(self._key)

    def __repr__(self):
        return self.primitive.name

    def __call__(self, *operands):
        found = self.primitive.bind(*operands, **self.params)
        return list(found) if self.primitive.multiple_results else [found]

    def one_by_one(self, *operands):
        """The results, those for the matrices of a batch one after the other."""
        if self.primitive.name not in LAPACK:
            # A solver that calls LAPACK, in Python.
            return one_by_one(partial(self.primitive.impl, **self.params))(*operands)
        lanes = operands[0].shape[: operands[0].ndim - LAPACK[self.primitive.name]]
        if not lanes:
            return self(*operands)
        count, within = math.prod(lanes), len(lanes)
        flat = [lax.reshape(x, (count, *x.shape[within:])) for x in operands]
        found = lax.map(lambda one: self(*one), flat)
        return [lax.reshape(x, (*lanes, *x.shape[1:])) for x in found]


def _at_once(*operands, of):
    return of(*operands)


def _each(*operands, of):
    return of.one_by_one(*operands)


def _shapes(*operands, of):
    return jax.make_jaxpr(of)(*(jax.ShapeDtypeStruct(x.shape, x.dtype) for x in operands)).out_avals


def _batched(operands: Sequence, axes: Sequence, *, of):
    found = one_by_one(jax.vmap(of, axes))(*operands)
    return found, [0] * len(found)


def _jvp(primals: Sequence, tangents: Sequence, *, of):
    found, derivatives = _pushed(of, primals, [None if isinstance(t, ad.Zero) else t for t in tangents])
    pairs = zip(found, derivatives)
    return found, [ad.Zero(jax.typeof(x).to_tangent_aval()) if d.dtype == jax.dtypes.float0 else d for x, d in pairs]


def _pushed(function: Callable, primals: Sequence, tangents: Sequence):
    """Values and derivatives of a function along some tangents, None for those that are zero."""
    moved = [i for i, t in enumerate(tangents) if t is not None]

    def along(primals: Sequence, moving):
        def of_moved(*chosen):
            return function(*filled(primals, moved, chosen))

        return jax.jvp(of_moved, tuple(primals[i] for i in moved), tuple(moving))

    return one_by_one(along)(list(primals), [tangents[i] for i in moved])


def _transposed(cotangents: Sequence, *operands, of):
    wanted = [ad.is_undefined_primal(x) for x in operands]
    like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x, w in zip(operands, wanted) if w]

    def back(known, cotangents: Sequence):
        def of_wanted(*given):
            given, rest = iter(given), iter(known)
            found = of(*(next(given) if w else next(rest) for w in wanted))
            return [x for x in found if jnp.issubdtype(x.dtype, jnp.inexact)]

        return jax.linear_transpose(of_wanted, *like)(cotangents)

    known = [x for x, w in zip(operands, wanted) if not w]
    cotangents = [ad.instantiate_zeros(ct) for ct in cotangents]
    # A solver also says how it ended, in whole numbers.
    cotangents = [ct for ct in cotangents if ct.dtype != jax.dtypes.float0]
    found = iter(one_by_one(back)(known, cotangents))
    return [next(found) if w else None for w in wanted]


def _with_rewritten_derivative(equation):
    """A function with a derivative of its own, which JAX traces only when it takes it; that is rewritten then."""
    program = equation.params["call_jaxpr"]
    function = jax.custom_jvp(lambda *operands: jaxpr_as_fun(without_batches(program))(*operands))

    @partial(function.defjvp, symbolic_zeros=True)
    def _(primals: Sequence, tangents: Sequence):
        moving = [None if isinstance(t, SymbolicZero) else t for t in tangents]
        return _pushed(lambda *operands: applied(program.jaxpr, equation, operands), primals, moving)

    like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
    (call,) = jax.make_jaxpr(lambda *x: function(*x))(*like).eqns
    return equation.replace(params=call.params)


def _with_rewritten_way_back(equation):
    """A function with a backward pass of its own, which may call LAPACK though the function does not."""
    program = equation.params["call_jaxpr"]

    def primal(*operands):
        return jaxpr_as_fun(without_batches(program))(*operands)

    primal.__name__ = WITH_WAY_BACK
    function = jax.custom_vjp(jax.jit(primal))

    def forward(*primals):
        def of_varying(*operands):
            # What does not vary is kept still inside: the rule of the user's may depend on it.
            operands = [x if p.perturbed else lax.stop_gradient(x) for x, p in zip(operands, primals)]
            return applied(program.jaxpr, equation, operands)

        return one_by_one(partial(jax.vjp, of_varying))(*(primal.value for primal in primals))

    def backward(way_back, slopes):
        zeros = [np if x.dtype == jax.dtypes.float0 else jnp for x in slopes]
        slopes = [xp.zeros(x.shape, x.dtype) if isinstance(x, SymbolicZero) else x for x, xp in zip(slopes, zeros)]
        return one_by_one(lambda way_back, slopes: way_back(slopes))(way_back, slopes)

    function.defvjp(forward, backward, symbolic_zeros=True)
    like = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in equation.invars]
    (call,) = jax.make_jaxpr(lambda *x: function(*x))(*like).eqns
    return equation.replace(params=call.params)


_library_p = Primitive("one_by_one")
_library_p.multiple_results = True
_library_p.def_impl(as_usual(lambda *x, of: jax.jit(partial(_library_p.bind, of=of))(*x)))
_library_p.def_abstract_eval(_shapes)
ad.primitive_jvps[_library_p] = _jvp
ad.primitive_transposes[_library_p] = _transposed
batching.primitive_batchers[_library_p] = _batched
mlir.register_lowering(_library_p, mlir.lower_fun(_at_once, multiple_results=True))
mlir.register_lowering(_library_p, mlir.lower_fun(_each, multiple_results=True), platform="cpu")


__all__ = [
    "Primitive", "ad", "filled", "front", "is_float", "jaxpr_as_fun", "linear_map_primitive", "no_tangent", "primitive",
    "split",
]  # fmt: skip


def primitive(
    name: str,
    evaluate: Callable,
    shapes: Callable,
    *,
    several: bool = False,
    compiled: Callable | None = None,
    jvp: Callable | None = None,
    transpose: Callable | None = None,
    batched: Callable | None = None,
) -> Primitive:
    """Define a primitive that gives one result, or a list of `several`.

    **Arguments:** `evaluate`, the operation on arrays; `compiled`, the operation in compiled programs, if that is
    another function; `shapes`, the abstract values of the results from those of the operands; and the rules, as JAX
    wants them, of derivatives, of transposition and of batches. A transformation without a rule raises.
    """
    new = Primitive(name)
    new.multiple_results = several
    new.def_impl(as_usual(evaluate))
    new.def_abstract_eval(shapes)
    # What such a primitive evaluates in Python becomes part of a program only here.
    lowered = as_usual(one_by_one(compiled or evaluate))
    mlir.register_lowering(new, mlir.lower_fun(lowered, multiple_results=several))
    for rules, rule in (
        (ad.primitive_jvps, jvp),
        (ad.primitive_transposes, transpose),
        (batching.primitive_batchers, batched),
    ):
        if rule is not None:
            rules[new] = as_usual(rule)
    return new


def linear_map_primitive(
    name: str,
    along: Callable,
    transpose: Callable,
    shapes: Callable,
    count: Callable,
    *,
    jvp: Callable,
    batched: Callable,
) -> Primitive:
    """Define a linear map of directions at some points: a derivative that JAX can transpose.

    **Arguments:** operands are the points, then `count(params)` directions. `along(points, directions, **params)` gives
    the results; `transpose(points, directions, wanted, cotangents, **params)` one cotangent for each wanted direction,
    in order, of which the abstract value stands among `directions`. The other rules are those of `primitive`.
    """

    def evaluate(*operands, **params):
        return list(along(*split(operands, count(params)), **params))

    def transposed(cotangents: Sequence, *operands, **params):
        points, directions = split(operands, count(params))
        # A constant comes as a Python number that knows its dtype.
        points = tuple(jnp.asarray(x) for x in points)
        wanted = tuple(ad.is_undefined_primal(x) for x in directions)
        like = [x.aval if w else x for x, w in zip(directions, wanted)]
        found = iter(transpose(points, like, wanted, cotangents, **params))
        return [None] * len(points) + [next(found) if w else None for w in wanted]

    return primitive(name, evaluate, shapes, several=True, jvp=jvp, transpose=transposed, batched=batched)


def split(operands: Sequence, count: int) -> tuple[tuple, tuple]:
    """The points and the last `count` operands, which are directions at them."""
    return tuple(operands[: len(operands) - count]), tuple(operands[len(operands) - count :])


def filled(arrays: Sequence, moved: Sequence[int], chosen: Iterable) -> list:
    """The arrays, with those at the indices `moved` replaced by `chosen`."""
    every = list(arrays)
    for i, x in zip(moved, chosen):
        every[i] = x
    return every


def front(operands: Sequence, axes: Sequence[int | None]) -> tuple[list, tuple[bool, ...], int]:
    """The operands of a batch with its axis in front, which of them have it, and the number of lanes."""
    lanes = next(x.shape[axis] for x, axis in zip(operands, axes) if axis is not None)
    moved = [x if axis is None else jnp.moveaxis(x, axis, 0) for x, axis in zip(operands, axes)]
    return moved, tuple(axis is not None for axis in axes), lanes


def is_float(x) -> bool:
    """Whether an array has derivatives."""
    return jnp.issubdtype(x.dtype, jnp.inexact)


def no_tangent(x) -> ad.Zero:
    """The tangent of an array that does not move."""
    return ad.Zero(jax.typeof(x).to_tangent_aval())
