"""Primitives of our own: operations with rules of their own for derivatives, batches and compilation."""

from collections.abc import Callable

from jax.extend.core import Primitive, jaxpr_as_fun
from jax.interpreters import ad, batching, mlir

from lagjax.jaxtools.without_lapack_batches import one_by_one

__all__ = ["Primitive", "ad", "jaxpr_as_fun", "primitive"]


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
    new.def_impl(evaluate)
    new.def_abstract_eval(shapes)
    # What such a primitive evaluates in Python becomes part of a program only here.
    lowered = one_by_one(compiled or evaluate)
    mlir.register_lowering(new, mlir.lower_fun(lowered, multiple_results=several))
    for rules, rule in (
        (ad.primitive_jvps, jvp),
        (ad.primitive_transposes, transpose),
        (batching.primitive_batchers, batched),
    ):
        if rule is not None:
            rules[new] = rule
    return new
