"""JAX programs (jaxprs) as data: one equation of them, what depends on what, one program as two."""

from collections.abc import Callable, Iterable, Sequence

import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, jaxpr_as_fun


def bodies(equation) -> list[Jaxpr]:
    """The programs inside a primitive: branches, loop bodies, called functions."""
    found = []
    for value in equation.params.values():
        for item in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(item, (ClosedJaxpr, Jaxpr)):
                found.append(getattr(item, "jaxpr", item))
    return found


def rewritten(closed: ClosedJaxpr, change: Callable) -> ClosedJaxpr:
    """The program with each of its equations changed, those inside loops, branches and functions too."""

    def inside(value):
        if isinstance(value, tuple) and any(isinstance(item, ClosedJaxpr) for item in value):
            # A named one keeps its names.
            return type(value)(*map(inside, value)) if hasattr(value, "_fields") else tuple(map(inside, value))
        return rewritten(value, change) if isinstance(value, ClosedJaxpr) else value

    def of_equation(equation):
        equation = change(equation)
        return equation.replace(params={name: inside(value) for name, value in equation.params.items()})

    return closed.replace(jaxpr=closed.jaxpr.replace(eqns=list(map(of_equation, closed.jaxpr.eqns))))


def length(jaxpr: Jaxpr) -> int:
    """How many operations a program consists of, those inside its loops and functions included."""
    return sum(1 + sum(map(length, bodies(equation))) for equation in jaxpr.eqns)


def variables(equation) -> list:
    """The distinct operands of an equation that are not written in it."""
    return list(dict.fromkeys(x for x in equation.invars if not isinstance(x, Literal)))


def written(literal: Literal) -> np.ndarray:
    """The number that stands in a program in place of a variable, in the dtype that it has there."""
    # To JAX an operand may be no array at all; such a one is never written down.
    assert isinstance(literal.aval, ShapedArray)
    return np.asarray(literal.val, literal.aval.dtype)


def evaluate(jaxpr: Jaxpr, equation, values) -> list:
    """The results of one equation of a program, whatever its primitive; `values` by variable."""
    if not bodies(equation):
        operands = [x.val if isinstance(x, Literal) else values[x] for x in equation.invars]
        results = equation.primitive.bind(*operands, **equation.params)
        return results if equation.primitive.multiple_results else [results]
    operands = variables(equation)
    alone = jaxpr.replace(constvars=[], invars=operands, outvars=equation.outvars, eqns=[equation])
    return jaxpr_as_fun(ClosedJaxpr(alone, ()))(*(values[x] for x in operands))


def reached(jaxpr: Jaxpr, inputs: Iterable) -> set:
    """The variables that depend on some of a program's variables; each primitive is one node."""
    found = set(inputs)
    for equation in jaxpr.eqns:
        if any(x in found for x in variables(equation)):
            found.update(equation.outvars)
    return found


def needed(jaxpr: Jaxpr) -> list:
    """The equations that a program's results depend on."""
    wanted, kept = {x for x in jaxpr.outvars if not isinstance(x, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or any(x in wanted for x in equation.outvars):
            wanted.update(variables(equation))
            kept.append(equation)
    return kept[::-1]


def staged(program: ClosedJaxpr, first: Sequence[int], then: Sequence[int]):
    """A program as two functions: of the inputs `first`, and of what that returns and the inputs `then`.

    A division of numbers by what the first one knows becomes a multiplication by its inverse.
    """
    jaxpr = program.jaxpr
    late = reached(jaxpr, (jaxpr.invars[i] for i in then))
    is_known = lambda x: not isinstance(x, Literal) and x not in late
    before = [e for e in jaxpr.eqns if not any(x in late for x in variables(e))]
    after = [e for e in jaxpr.eqns if any(x in late for x in variables(e))]
    crossing = dict.fromkeys(x for e in after for x in variables(e) if x not in late)
    crossing.update(dict.fromkeys(x for x in jaxpr.outvars if is_known(x)))
    divisors = dict.fromkeys(e.invars[1] for e in after if _divides_numbers(e) and is_known(e.invars[1]))
    constants = dict(zip(jaxpr.constvars, program.consts))

    def at_first(*given):
        values = constants | {jaxpr.invars[i]: x for i, x in zip(first, given)}
        for equation in before:
            values.update(zip(equation.outvars, evaluate(jaxpr, equation, values)))
        return [values[x] for x in crossing] + [1 / values[x] for x in divisors]

    def afterwards(prepared, *given):
        values = dict(zip(crossing, prepared)) | {jaxpr.invars[i]: x for i, x in zip(then, given)}
        inverse = dict(zip(divisors, prepared[len(crossing) :]))
        for equation in after:
            if _divides_numbers(equation) and is_known(equation.invars[1]):
                dividend, divisor = equation.invars
                results = [values[dividend] * inverse[divisor]]
            else:
                results = evaluate(jaxpr, equation, values)
            values.update(zip(equation.outvars, results))
        return [jnp.asarray(written(x)) if isinstance(x, Literal) else values[x] for x in jaxpr.outvars]

    return at_first, afterwards


def _divides_numbers(equation):
    return equation.primitive.name == "div" and not equation.outvars[0].aval.shape
