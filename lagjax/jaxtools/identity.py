"""The meaning of a JAX program: its equations in a form to compare, whatever objects they consist of.

Two programs with the same meaning compute the same from the same inputs and constants. Values are compared with their
types (0.0 is not -0.0, nor 1 True), arrays by content, and Python functions that a program calls at run time by their
code and the very objects that they hold. A function with its own rule of differentiation counts by what it computes
alone: `rules_of` adds what its rule computes.
"""

import dataclasses
import hashlib
import types
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal

from lagjax.jaxtools.jaxpr import anywhere, bodies, equations, evaluate, once_per_program

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
