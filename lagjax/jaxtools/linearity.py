"""Whether a function is linear in some numbers, as the equations need it of a force of the multipliers.

f is linear in λ if f(λ) = f(0) + B λ with B = ∂f/∂λ at 0. Most programs show it: λ is added, moved, and multiplied by
what does not depend on it, also inside calls, branches and loops of known length. What does not show is decided by that
equation itself, with multipliers of both signs and of many sizes at states that are made up, of which only the shapes
are taken: a force that bends where a multiplier changes its sign or with its size differs at one of them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import JaxprEqn
from jax.typing import DTypeLike

from lagjax.jaxtools.jaxpr import ADDITIVE, BILINEAR, LINEAR_IN_FIRST, ClosedJaxpr, Literal, stands_for
from lagjax.jaxtools.tracing import at_once

CONSTANT, LINEAR, OTHER = range(3)
# Sizes of the multipliers that are tried, with random signs, and the states at which they are.
SIZES, STATES = (1e-9, 1e-6, 1e-3, 0.1, 1.0, 10.0, 1e3, 1e6), 3
# Forces that agree to this part of their terms are equal.
SAME = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-4}


def is_linear(function: Callable, count: int, dtype: DTypeLike, rest) -> bool:
    """Whether `function(numbers, rest)` -> (n,) is linear in `numbers` (count,); `rest`: arrays, known or traced."""
    zero = np.zeros(count, dtype)
    closed = jax.make_jaxpr(function)(zero, rest)
    given = [LINEAR] + [CONSTANT] * (len(closed.jaxpr.invars) - 1)
    if max(_kinds(closed, given), default=CONSTANT) < OTHER:
        return True
    # The numbers below are computed at once, also while JAX traces the caller.
    with at_once():
        return _holds(jax.jit(partial(_with_slope, function)), zero, rest)


def _kinds(closed: ClosedJaxpr, given: list[int]) -> list[int]:
    """How each result of a program depends on its inputs: not, linearly, or in a way that does not show."""
    jaxpr = closed.jaxpr
    kinds = dict.fromkeys(jaxpr.constvars, CONSTANT) | dict(zip(jaxpr.invars, given))

    def read(x: Any) -> Any:
        return CONSTANT if isinstance(x, Literal) else kinds[x]

    for equation in jaxpr.eqns:
        kinds.update(zip(equation.outvars, _of_equation(equation, [read(x) for x in equation.invars])))
    return [read(x) for x in jaxpr.outvars]


def _of_equation(equation: JaxprEqn, given: list[int]) -> list[int]:
    name, largest = equation.primitive.name, max(given, default=CONSTANT)
    if largest == CONSTANT:
        found = CONSTANT
    elif (inner := stands_for(equation)) is not None:
        return _kinds(inner, given)
    elif name == "scan":
        return _of_scan(equation, given)
    elif name == "cond":
        if given[0] != CONSTANT:
            return [OTHER] * len(equation.outvars)
        branches = [_kinds(branch, given[1:]) for branch in equation.params["branches"]]
        return [max(kinds) for kinds in zip(*branches)]
    elif name == "select_n":
        found = max(given[1:]) if given[0] == CONSTANT else OTHER
    elif name in BILINEAR:
        found = max(given) if min(given) == CONSTANT else OTHER
    elif name in LINEAR_IN_FIRST:
        found = given[0] if max(given[1:]) == CONSTANT else OTHER
    # A whole number or a stop of derivatives hides how it depends.
    elif name in ADDITIVE and name != "stop_gradient" and _all_floating(equation):
        found = largest
    else:
        found = OTHER
    return [found] * len(equation.outvars)


def _of_scan(equation: JaxprEqn, given):
    """A loop of known length: what it carries is of the last kind that its body makes of it."""
    body = equation.params["jaxpr"]
    # What a loop takes or gives in rows has one axis less in its body; the parameters' names depend on JAX's version.
    carried = _without_rows(equation.outvars, body.out_avals)
    consts = _without_rows(equation.invars, body.in_avals) - carried
    kinds = list(given)
    while True:
        made = _kinds(body, kinds)
        new = [max(x, y) for x, y in zip(kinds[consts : consts + carried], made)]
        if new == kinds[consts : consts + carried]:
            return made
        kinds[consts : consts + carried] = new


def _without_rows(outside, inside):
    return sum(x.aval.ndim == y.ndim for x, y in zip(outside, inside))


def _all_floating(equation):
    return all(jnp.issubdtype(x.aval.dtype, jnp.floating) for x in equation.outvars)


def _with_slope(function: Callable, numbers, state):
    """f and B; along the rows of a NumPy array, as `jax.jacfwd` would compute its own at once, in six kernels."""
    along = jax.vmap(lambda way: jax.jvp(lambda x: function(x, state), (numbers,), (way,))[1], out_axes=-1)
    return function(numbers, state), along(np.eye(len(numbers), dtype=numbers.dtype))


def _holds(with_slope: Callable, zero, rest) -> bool:
    """Whether f(λ) = f(0) + B λ wherever it is finite, and there is such a place; `with_slope` gives f and its B."""
    random, same, seen = np.random.default_rng(0), SAME[np.dtype(zero.dtype)], False
    for _ in range(STATES):
        state = jax.tree.map(lambda x: _made_up(x, random), rest)

        def at(numbers: np.ndarray, state: Any = state) -> list[np.ndarray]:
            return [np.asarray(x, float) for x in with_slope(numbers, state)]

        start, slope = at(zero)
        for size in SIZES:
            numbers = size * random.uniform(0.5, 2.0, zero.shape) * random.choice([-1.0, 1.0], zero.shape)
            numbers = numbers.astype(zero.dtype)
            there, terms = at(numbers)[0], np.abs(slope) @ np.abs(numbers)
            off = np.abs(there - start - slope @ numbers)
            finite = np.isfinite(off)
            seen = seen or bool(finite.all())
            if np.any(off[finite] > same * (np.abs(there) + np.abs(start) + terms)[finite]):
                return False
    return seen


def _made_up(x, random: np.random.Generator):
    """Numbers for an array of which only the shape is used; whole numbers that are known stay."""
    if not jnp.issubdtype(jnp.result_type(x), jnp.floating):
        return np.ones(np.shape(x), jnp.result_type(x)) if isinstance(x, Tracer) else x
    return random.uniform(0.5, 1.5, np.shape(x)).astype(jnp.result_type(x))
