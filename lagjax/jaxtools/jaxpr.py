"""JAX programs (jaxprs) as data: evaluate and rewrite equations, find what depends on what, split, compare by meaning.

JAX's primitives are listed by name, classified for the code that walks over programs; a test checks each name. A
primitive that is not listed is treated as unknown, which is slower and never wrong.

The meaning of a program is its equations in a form to compare, whatever objects they consist of. Two programs with the
same meaning compute the same from the same inputs and constants. Values are compared with their types (0.0 is not -0.0,
nor 1 True), arrays by content, and Python functions that a program calls at run time by their code and the very objects
that they hold. A function with its own rule of differentiation counts by what it computes alone: `rules_of` adds what
its rule computes.
"""

import dataclasses
import hashlib
import types
import weakref
from collections import Counter
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from functools import wraps
from typing import Any, TypeVar, cast

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var, jaxpr_as_fun

# They work entry by entry, on numbers alone.
ELEMENTWISE = {
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
    "clamp", "cos", "cosh", "convert_element_type", "digamma", "div", "eq", "erf", "erf_inv", "erfc", "exp", "exp2",
    "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign",
    "sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
}  # fmt: skip
# Those of these that NumPy computes the same way: it computes constants.
IN_NUMPY = {
    "abs": np.abs, "add": np.add, "and": np.bitwise_and, "eq": np.equal, "ge": np.greater_equal, "gt": np.greater,
    "le": np.less_equal, "lt": np.less, "max": np.maximum, "min": np.minimum, "mul": np.multiply, "ne": np.not_equal,
    "neg": np.negative, "not": np.bitwise_not, "or": np.bitwise_or, "square": np.square, "sub": np.subtract,
    "select_n": lambda which, *cases: np.choose(which.astype(int), cases),
}  # fmt: skip
REDUCING = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "reduce_and", "reduce_or"}
ACCUMULATING = {"cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp"}
# They move entries and compute none.
MOVING = {
    "broadcast_in_dim", "concatenate", "copy", "dynamic_slice", "gather", "iota", "pad", "reshape", "rev", "slice",
    "split", "squeeze", "stack", "transpose", "unstack",
}  # fmt: skip
# Linear in all operands together; in the first operand, where the others choose or scale; in each of two operands.
ADDITIVE = {
    "add", "add_any", "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "cumsum", "neg", "pad",
    "reduce_sum", "reshape", "rev", "slice", "split", "squeeze", "stack", "stop_gradient", "sub", "transpose",
}  # fmt: skip
LINEAR_IN_FIRST = {"div", "dynamic_slice", "gather"}
BILINEAR = {"dot_general", "mul"}
PERIODIC = {"cos", "sin"}
# Primitives that stand for the program that they carry; the second kind has rules of its own for derivatives.
CALLS = {"jit", "closed_call"}
CALLS_WITH_RULES = {"custom_jvp_call", "custom_vjp_call", "remat2"}
# Programs of these alone compute the same by `vmap` as one by one, and cost no more.
ARITHMETIC = ELEMENTWISE | REDUCING | MOVING | CALLS | {"dot_general"}
CONTROL_FLOW = {"cond", "scan", "while"}
# Equinox's primitives: for use under `vmap`, and marks for derivatives.
EQUINOX_PRIMITIVES = {
    "maybe_set", "nonbatchable", "nondifferentiable_backward", "select_if_vmap", "unvmap_all", "unvmap_any",
    "unvmap_max", "vprim",
}  # fmt: skip
# LAPACK on a CPU, with the number of axes of the first operand for one matrix; others may hold solvers that call it.
LAPACK = {
    "cholesky": 2, "eig": 2, "eigh": 2, "geqp3": 2, "geqrf": 2, "hessenberg": 2, "householder_product": 2, "lu": 2,
    "ormqr": 2, "qr": 2, "schur": 2, "svd": 2, "triangular_solve": 2, "tridiagonal": 2, "tridiagonal_solve": 1,
}  # fmt: skip
HOLDS_A_SOLVER = {"linear_solve"}


T = TypeVar("T")

# Chains of at least so many calls are worth a loop.
LONG_CHAIN = 16


def bodies(equation: JaxprEqn) -> list[Jaxpr]:
    """The programs inside a primitive: branches, loop bodies, called functions."""
    found = []
    for value in equation.params.values():
        for item in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(item, (ClosedJaxpr, Jaxpr)):
                found.append(getattr(item, "jaxpr", item))
    return found


def once_per_program(find: Callable[[Jaxpr], T]) -> Callable[[Jaxpr], T]:
    """Keep what `find` says of a program as long as this lives: it never changes, and JAX traces a function once."""
    known: weakref.WeakKeyDictionary = weakref.WeakKeyDictionary()

    @wraps(find)
    def found(jaxpr: Jaxpr):
        # Two tests of one dictionary: an entry may go between them only if the program does.
        if jaxpr not in known:
            known[jaxpr] = find(jaxpr)
        return known[jaxpr]

    return found


def anywhere(test: Callable) -> Callable[[Jaxpr], bool]:
    """Return the function that says whether `test` holds for an equation of a program, or of one inside it."""

    @once_per_program
    def holds(jaxpr: Jaxpr):
        return any(test(equation) or any(map(holds, bodies(equation))) for equation in jaxpr.eqns)

    return holds


def rewritten(closed: ClosedJaxpr, change: Callable) -> ClosedJaxpr:
    """The program with each of its equations changed, those inside loops, branches and functions too."""
    return _rewritten(closed, lambda jaxpr: jaxpr.replace(eqns=list(map(change, jaxpr.eqns))))


def callbacks_in_turn(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program with callbacks that JAX would refuse in lanes called for one lane after the other."""

    def change(equation: JaxprEqn):
        if equation.primitive.name != "pure_callback" or equation.params.get("vmap_method", "") is not None:
            return equation
        return equation.replace(params=equation.params | {"vmap_method": "sequential"})

    return rewritten(closed, change)


def _rewritten(closed: ClosedJaxpr, change: Callable[[Jaxpr], Jaxpr]) -> ClosedJaxpr:
    """The program with its list of equations changed, and the lists inside loops, branches and functions.

    An object used in several places stays one object, and one that does not change stays the same object: JAX
    recognises functions that it has compiled by their identity.
    """
    # New objects by the id of the old one, which is kept alive lest another object get its id.
    made = {}

    def once(value, make: Callable):
        if id(value) not in made:
            made[id(value)] = value, make()
        return made[id(value)][1]

    def inside(value):
        # From jax 0.12 on both names are one class, and a program is closed by itself.
        if isinstance(value, ClosedJaxpr) and value.jaxpr is not value:
            jaxpr = inside(value.jaxpr)
            return value if jaxpr is value.jaxpr else once(value, lambda: value.replace(jaxpr=jaxpr))
        if isinstance(value, Jaxpr):
            return once(value, lambda: of_program(value))
        if isinstance(value, tuple):
            new = [inside(item) for item in value]
            # A named tuple keeps its type.
            make = type(value) if not hasattr(value, "_fields") else lambda items: type(value)(*items)
            return value if _same(new, value) else make(new)
        return value

    def of_equation(equation: JaxprEqn):
        params = equation.params
        new = [inside(value) for value in params.values()]
        return equation if _same(new, params.values()) else equation.replace(params=dict(zip(params, new)))

    def of_program(jaxpr: Jaxpr):
        new = [of_equation(equation) for equation in change(jaxpr).eqns]
        return jaxpr if _same(new, jaxpr.eqns) else jaxpr.replace(eqns=new)

    return cast(ClosedJaxpr, inside(closed))


def _same(new: Sequence, old: Sequence):
    return len(new) == len(old) and all(one is other for one, other in zip(new, old))


def without_chains(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program with long chains f(f(f(... x))) of the same call turned into loops.

    (diffrax goes back a hundred floating-point numbers from the last time, one after the other.)
    """
    return _rewritten(closed, _chains_as_loops)


def _chains_as_loops(jaxpr: Jaxpr) -> Jaxpr:
    uses = Counter(x for e in jaxpr.eqns for x in variables(e))
    uses.update(x for x in jaxpr.outvars if not isinstance(x, Literal))
    kept, chain = [], []
    for equation in jaxpr.eqns:
        if chain and not (_is_again(chain[-1], equation) and uses[chain[-1].outvars[0]] == 1):
            kept, chain = [*kept, *_as_loop(jaxpr, chain)], []
        chain.append(equation)
    return jaxpr.replace(eqns=[*kept, *_as_loop(jaxpr, chain)])


def _is_again(call: JaxprEqn, equation: JaxprEqn) -> bool:
    """Whether an equation is the same call of its own result."""
    if len(call.outvars) != 1 or variables(equation) != call.outvars or equation.primitive is not call.primitive:
        return False
    alike = [x.aval for x in equation.outvars] == [x.aval for x in call.outvars] == [x.aval for x in variables(call)]
    if not alike or equation.effects or len(bodies(equation)) != len(bodies(call)):
        return False
    return all(x is y or _meaning_inside(x) == _meaning_inside(y) for x, y in zip(bodies(equation), bodies(call)))


def _as_loop(jaxpr: Jaxpr, chain: Sequence[JaxprEqn]) -> list[JaxprEqn]:
    if len(chain) < LONG_CHAIN or not bodies(chain[0]):
        return list(chain)
    (x,) = variables(chain[0])
    looped = jax.jit(
        lambda value: lax.fori_loop(0, len(chain), lambda _, value: evaluate(jaxpr, chain[0], {x: value})[0], value)
    )
    (call,) = jax.make_jaxpr(looped)(x.aval).eqns
    return [call.replace(invars=[x], outvars=chain[-1].outvars)]


def equations(jaxpr: Jaxpr) -> Iterator:
    """All equations of a program, those inside its loops, branches and functions included."""
    for equation in jaxpr.eqns:
        yield equation
        for body in bodies(equation):
            yield from equations(body)


def length(jaxpr: Jaxpr) -> int:
    """How many operations a program consists of, those inside its loops and functions included."""
    return sum(1 for _ in equations(jaxpr))


def variables(equation: JaxprEqn) -> list:
    """The distinct operands of an equation that are not literals."""
    return list(dict.fromkeys(x for x in equation.invars if not isinstance(x, Literal)))


def written(literal: Literal) -> np.ndarray:
    """The value of a literal, in the dtype that it has in the program."""
    # JAX also has operands that are not arrays; those are never literals.
    assert isinstance(literal.aval, ShapedArray)
    return np.asarray(literal.val, literal.aval.dtype)


def evaluate(jaxpr: Jaxpr, equation: JaxprEqn, values) -> list:
    """The results of one equation of a program, whatever its primitive; `values` by variable."""
    if not bodies(equation):
        operands = [x.val if isinstance(x, Literal) else values[x] for x in equation.invars]
        results = equation.primitive.bind(*operands, **equation.params)
        return results if equation.primitive.multiple_results else [results]
    operands = variables(equation)
    alone = jaxpr.replace(constvars=[], invars=operands, outvars=equation.outvars, eqns=[equation])
    return jaxpr_as_fun(ClosedJaxpr(alone, ()))(*(values[x] for x in operands))


def applied(jaxpr: Jaxpr, equation: JaxprEqn, operands: Sequence) -> list:
    """The same as `evaluate`, given the operands in order."""
    return evaluate(
        jaxpr, equation, {x: value for x, value in zip(equation.invars, operands) if not isinstance(x, Literal)}
    )


def interpreted(
    closed: ClosedJaxpr, inputs: Sequence, rule: Callable, of_constant: Callable, enters: Callable | None = None
) -> list:
    """The results of a program with values of any kind in place of its arrays.

    `rule(equation, operands)` returns the results of a primitive for such values; the program that a call stands for is
    interpreted too, unless `enters(equation)` is false. `of_constant(x, aval)` turns a constant into a value.
    """
    jaxpr = closed.jaxpr
    values = {x: of_constant(constant, x.aval) for x, constant in zip(jaxpr.constvars, closed.consts)}
    values.update(zip(jaxpr.invars, inputs))

    def read(x: Var | Literal) -> Any:
        return of_constant(x.val, x.aval) if isinstance(x, Literal) else values[x]

    for equation in jaxpr.eqns:
        operands, inner = [read(x) for x in equation.invars], stands_for(equation)
        if inner is None or not (enters is None or enters(equation)):
            results = rule(equation, operands)
        else:
            results = interpreted(inner, operands, rule, of_constant, enters)
        values.update(zip(equation.outvars, results))
    return [read(x) for x in jaxpr.outvars]


def stands_for(equation: JaxprEqn) -> ClosedJaxpr | None:
    """The program that a call stands for; None for others: a reduction, too, holds one, for pairs of entries."""
    inner = [p for p in equation.params.values() if isinstance(p, (ClosedJaxpr, Jaxpr))]
    if equation.primitive.name not in CALLS | CALLS_WITH_RULES or len(inner) != 1:
        return None
    closed = inner[0] if isinstance(inner[0], ClosedJaxpr) else ClosedJaxpr(inner[0], ())
    return closed if len(closed.jaxpr.invars) == len(equation.invars) else None


def reached(jaxpr: Jaxpr, inputs: Iterable) -> set:
    """The variables that depend on some of a program's variables; each primitive is one node."""
    found = set(inputs)
    for equation in jaxpr.eqns:
        if any(x in found for x in variables(equation)):
            found.update(equation.outvars)
    return found


def depends(jaxpr: Jaxpr, inputs: Iterable) -> bool:
    """Whether any result of a program depends on some of its inputs; a call is looked into, and others are one node."""
    chosen, closed = set(inputs), ClosedJaxpr(jaxpr, [None] * len(jaxpr.constvars))
    found = interpreted(
        closed, [x in chosen for x in jaxpr.invars], lambda e, read: [any(read)] * len(e.outvars), lambda *_: False
    )  # fmt: skip
    return any(found)


def needed(jaxpr: Jaxpr) -> list:
    """The equations that a program's results depend on."""
    wanted, kept = {x for x in jaxpr.outvars if not isinstance(x, Literal)}, []
    for equation in reversed(jaxpr.eqns):
        if equation.effects or any(x in wanted for x in equation.outvars):
            wanted.update(variables(equation))
            kept.append(equation)
    return kept[::-1]


def outputs_of(closed: ClosedJaxpr, which: Iterable[int]) -> ClosedJaxpr:
    """The program that gives some of the results of another one, and computes nothing else."""
    jaxpr = closed.jaxpr.replace(outvars=[closed.jaxpr.outvars[i] for i in which])
    return closed.replace(jaxpr=jaxpr.replace(eqns=needed(jaxpr)))


def run(closed: ClosedJaxpr, operands: Sequence) -> list:
    """The results of a program."""
    return jaxpr_as_fun(closed)(*operands)


def staged(program: ClosedJaxpr, first: Sequence[int], then: Sequence[int]):
    """Split a program into two functions: of the inputs `first`, and of the first one's results and the inputs `then`.

    A division of floating-point numbers by a value of the first function becomes a multiplication by its inverse.
    """
    jaxpr = program.jaxpr
    late = reached(jaxpr, (jaxpr.invars[i] for i in then))

    def is_known(x: Any) -> bool:
        return not isinstance(x, Literal) and x not in late

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

    def afterwards(prepared: Sequence, *given):
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
    results = [x.aval for x in equation.outvars if equation.primitive.name == "div"]
    return any(not result.shape and jnp.issubdtype(result.dtype, jnp.floating) for result in results)


# The rules of functions with rules of their own, and what only belongs to these.
RULES = {
    "custom_jvp_call": {"jvp_jaxpr_fun"},
    "custom_vjp_call": {"fwd_jaxpr_thunk", "bwd", "out_trees"},
    "custom_vjp_call_jaxpr": {"fwd_jaxpr_thunk", "bwd", "out_trees"},
}
# Derivatives of a function with its own rule up to this order are compared.
ORDERS = 2
# The name of a jitted function in one with a rule that follows from what the program computes: it is not compared.
RULE_FOLLOWS = "its rule follows from the program"
# Arrays of up to so many bytes are compared whole, larger ones by a hash.
WHOLE = 1024


class Meaning:
    """A key: nested tuples, hashed once. `digest`: that of another process too, once `digest.py` has found it."""

    __slots__ = "parts", "_hash", "digest"

    def __init__(self, parts: Hashable):
        self.parts, self._hash = parts, hash(parts)
        self.digest: bytes | None = None

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or isinstance(other, Meaning) and self._hash == other._hash and self.parts == other.parts


def meaning_of(jaxpr: Jaxpr) -> tuple:
    """The equations of a program by the numbers of their variables, with those inside its loops and functions."""
    numbers = {x: i for i, x in enumerate((*jaxpr.constvars, *jaxpr.invars))}

    def operand(x):
        return ("literal", x.aval, content_of(x.val)) if isinstance(x, Literal) else numbers[x]

    found = [tuple(x.aval for x in (*jaxpr.constvars, *jaxpr.invars))]
    for equation in jaxpr.eqns:
        leave_out = RULES.get(equation.primitive.name, ())
        params = tuple((name, _key(x)) for name, x in equation.params.items() if name not in leave_out)
        operands = tuple(operand(x) for x in equation.invars)
        for x in equation.outvars:
            numbers[x] = len(numbers)
        found.append((equation.primitive, params, operands, tuple(x.aval for x in equation.outvars)))
    found.append(tuple(operand(x) for x in jaxpr.outvars))
    return tuple(found)


@once_per_program
def _meaning_inside(jaxpr: Jaxpr) -> Meaning:
    """The meaning of a program inside another one, which is often one that JAX has traced before."""
    return Meaning(meaning_of(jaxpr))


@once_per_program
def without_repeats(jaxpr: Jaxpr) -> Jaxpr:
    """The program with an operation on the same operands written once, as where a loop in Python builds a partial sum
    anew for each body. Operations of several results stay, and functions with their own rule of differentiation."""
    first, same, kept = {}, {}, []
    for equation in jaxpr.eqns:
        operands = [x if isinstance(x, Literal) else same.get(x, x) for x in equation.invars]
        equation = equation if operands == equation.invars else equation.replace(invars=operands)
        has_rules = _has_a_rule(equation) or any(map(_holds_rules, bodies(equation)))
        is_alone = len(equation.outvars) != 1 or equation.effects or has_rules
        earlier = equation if is_alone else first.setdefault(_operation(equation), equation)
        if earlier is equation:
            kept.append(equation)
        else:
            same[equation.outvars[0]] = earlier.outvars[0]
    return jaxpr.replace(eqns=kept, outvars=[x if isinstance(x, Literal) else same.get(x, x) for x in jaxpr.outvars])


def _operation(equation: JaxprEqn) -> tuple:
    operands = ((x.aval, content_of(x.val)) if isinstance(x, Literal) else x for x in equation.invars)
    return equation.primitive, *operands, *map(_key, equation.params.values())


def rules_of(function: Callable, program: ClosedJaxpr, *args, user: Callable | None = None) -> tuple:
    """What the derivatives of a function compute, where parts of it have rules of their own; () where none has.

    Backward where that can be traced, else forward, as through a loop. Where there is no derivative of an order, as of
    a callback in a rule, the function is known by the `user`'s that it calls.
    """
    found = []
    for _ in range(ORDERS):
        if not any(map(_has_a_rule, equations(program.jaxpr))):
            break
        derivatives = (_pulled_back(function), args), (_pushed_forward(function), (args, *_floats_and_rest(args)[:1]))
        for function, args in derivatives:
            try:
                program = jax.make_jaxpr(function)(*args)
                break
            except (TypeError, ValueError, NotImplementedError):
                continue
        else:
            return *found, Itself(function if user is None else user)
        found.append((meaning_of(program.jaxpr), tuple(map(_key, program.consts))))
    return tuple(found)


def _has_a_rule(equation: JaxprEqn) -> bool:
    inside = [e.params.get("name") for body in bodies(equation) for e in body.eqns]
    return equation.primitive.name in RULES and inside != [RULE_FOLLOWS]


_holds_rules = anywhere(_has_a_rule)


def rule_follows(function: Callable) -> jax.custom_jvp:
    """`jax.custom_jvp`, where what the rule computes follows from the program that contains the function.

    So it is for derivatives of what a search finds, of which the program contains the search: to compare two of them,
    their rules need not be traced.
    """

    def named(*args):
        return function(*args)

    named.__name__ = RULE_FOLLOWS
    return jax.custom_jvp(jax.jit(named))


def _pulled_back(function: Callable):
    def slopes(*args):
        floats, rest = _floats_and_rest(args)
        values, back = jax.vjp(lambda *floats: [x for x in jtu.tree_leaves(function(*rest(floats))) if _is_float(x)],
                               *floats)  # fmt: skip
        return back([jnp.ones_like(x) for x in values])

    return slopes


def _pushed_forward(function: Callable):
    def slopes(args, along):
        floats, rest = _floats_and_rest(args)
        values = lambda *floats: [x for x in jtu.tree_leaves(function(*rest(floats))) if _is_float(x)]
        return jax.jvp(values, tuple(floats), tuple(along))[1]

    return slopes


def _floats_and_rest(args: tuple):
    leaves, structure = jtu.tree_flatten(args)
    places = [i for i, x in enumerate(leaves) if _is_float(x)]

    def together(floats):
        found = list(leaves)
        for i, x in zip(places, floats):
            found[i] = x
        return jtu.tree_unflatten(structure, found)

    return [leaves[i] for i in places], together


def _is_float(x):
    return jnp.issubdtype(jnp.result_type(x), jnp.inexact)


def with_own_constants(closed: ClosedJaxpr) -> ClosedJaxpr:
    """The program with the arrays that the functions inside it hold among its own constants."""
    if not any(_holds_constants(equation) for equation in equations(closed.jaxpr)):
        return closed
    return jax.make_jaxpr(lambda *args: _in_line(closed.jaxpr, closed.consts, args))(*closed.in_avals)


def _holds_constants(equation: JaxprEqn):
    return any(getattr(x, "consts", ()) for x in equation.params.values() if isinstance(x, ClosedJaxpr))


def _in_line(jaxpr, constants: Sequence, args: tuple):
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *args)))

    def read(x: Any) -> Any:
        return x.val if isinstance(x, Literal) else values[x]

    for equation in jaxpr.eqns:
        inner = equation.params.get("jaxpr")
        is_call = equation.primitive.name in ("jit", "pjit")
        if is_call and (inner.consts or any(map(_holds_constants, equations(inner.jaxpr)))):
            results = _in_line(inner.jaxpr, inner.consts, [read(x) for x in equation.invars])
        else:
            results = evaluate(jaxpr, equation, values)
        values.update(zip(equation.outvars, results))
    return [read(x) for x in jaxpr.outvars]


def _key(x):
    """Something among the parameters of an equation, in a form to compare."""
    if isinstance(x, (bool, int, float, complex)):
        return type(x), repr(x)
    if x is None or isinstance(x, (str, bytes, np.dtype)):
        return x
    if isinstance(x, ClosedJaxpr) and x.jaxpr is not x:
        return _meaning_inside(x.jaxpr), tuple(map(_key, x.consts))
    if isinstance(x, Jaxpr):
        return _meaning_inside(x), tuple(map(_key, getattr(x, "consts", ())))
    if isinstance(x, (tuple, list)):
        return type(x), *map(_key, x)
    if isinstance(x, dict):
        return dict, *((name, _key(value)) for name, value in x.items())
    if hasattr(x, "dtype") and hasattr(x, "shape") and not isinstance(x, jax.ShapeDtypeStruct):
        return content_of(x)
    if isinstance(x, types.FunctionType):
        return _CalledLater(x)
    if dataclasses.is_dataclass(x) and not isinstance(x, type):
        return type(x), *(_key(getattr(x, field.name)) for field in dataclasses.fields(x))
    try:
        hash(x)
    except TypeError:
        return object()  # Equal to nothing else.
    return x


def content_of(x):
    """The content of an array or a number; of an array that JAX is tracing, itself."""
    if isinstance(x, Tracer):
        return Itself(x)
    if jnp.issubdtype(getattr(x, "dtype", float), jax.dtypes.extended):
        x = jax.random.key_data(x)
    x = np.asarray(x)
    return x.shape, x.dtype, x.tobytes() if x.nbytes <= WHOLE else hashlib.sha256(x.tobytes()).digest()


class Itself:
    """Equal to nothing but what holds the very same object."""

    def __init__(self, x):
        self.x = x

    def __hash__(self):
        return id(self.x)

    def __eq__(self, other):
        return isinstance(other, Itself) and self.x is other.x


class _CalledLater:
    """A Python function that a program calls at run time: equal to one of the same code that holds the same objects.

    What these objects contain is read when the function is called, and need not be compared.
    """

    def __init__(self, function: Callable):
        self.function = function

    def __hash__(self):
        return hash(self.function.__code__)

    def __eq__(self, other):
        return isinstance(other, _CalledLater) and _alike(self.function, other.function)


def _alike(f, g):
    if f is g:
        return True
    if not (isinstance(f, types.FunctionType) and isinstance(g, types.FunctionType)):
        return False
    same = f.__code__ is g.__code__ and f.__globals__ is g.__globals__ and not (f.__kwdefaults__ or g.__kwdefaults__)
    held = [(*(cell.cell_contents for cell in h.__closure__ or ()), *(h.__defaults__ or ())) for h in (f, g)]
    return same and len(held[0]) == len(held[1]) and all(map(_alike, *held))
