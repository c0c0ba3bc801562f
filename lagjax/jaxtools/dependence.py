"""What a function depends on, read off its jaxpr: the sparsity of its derivatives, and whether it is linear.

Sparsity says which outputs depend on which entries of a vector. Every intermediate value carries, entry by entry, the
set of inputs that it depends on; a set is a Python integer, one bit per input. Primitives that work entry by entry
unite the sets of their operands; those that move entries move the sets; sums and products of matrices unite what they
sum. Where an operation is unknown here, such as a loop or an index that is not constant, every entry of its results
depends on everything that its operands depend on. The pattern holds at every state: it may be too full, never too
empty, since no values but those of constants are used.

The package asdex finds the same patterns, just as fast; it needs numba, and stops at a primitive that it does not know.

Linearity is asked of a force of the multipliers: f is linear in λ if f(λ) = f(0) + B λ with B = ∂f/∂λ at 0. Most
programs show it: λ is added, moved, and multiplied by what does not depend on it, also inside calls, branches and loops
of known length. What does not show is decided by that equation itself, with multipliers of both signs and of many sizes
at states that are made up, of which only the shapes are taken: a force that bends where a multiplier changes its sign
or with its size differs at one of them.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import JaxprEqn
from jax.typing import DTypeLike
from jaxtyping import Array, Bool

from lagjax.jaxtools.jaxpr import (
    ACCUMULATING,
    ADDITIVE,
    BILINEAR,
    ELEMENTWISE,
    IN_NUMPY,
    LINEAR_IN_FIRST,
    REDUCING,
    ClosedJaxpr,
    Literal,
    interpreted,
    stands_for,
)
from lagjax.jaxtools.tracing import at_once


class SparseValue(NamedTuple):
    """An intermediate value: the inputs that each entry depends on, and the entries if they are constants."""

    sets: np.ndarray
    known: np.ndarray | None = None


ENTRYWISE = ELEMENTWISE | {"copy", "reduce_precision"}
# Products of matrices larger than this are not searched for zeros.
TERMS = 2_000_000


def pattern(function: Callable, vector, *rest) -> Bool[np.ndarray, "m n"]:
    """Return which outputs of `function(vector, *rest)` depend on which entries of the vector.

    >>> import jax.numpy as jnp
    >>> print(pattern(lambda x: x[1:] * x[:-1], jnp.zeros(3)).astype(int))
    [[1 1 0]
     [0 1 1]]

    **Arguments:** a function that returns one array, a vector, and pytrees of arrays, of which only shapes and
    dtypes count. What the function closes over is a constant, unless JAX is tracing it.

    **Returns:** (m, n) booleans: false where the output never depends on the entry.
    """
    shaped = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), (vector, *rest))
    closed = jax.make_jaxpr(lambda *args: jnp.ravel(function(*args)))(*shaped)
    n = shaped[0].size
    inputs = [SparseValue(_empty(x.aval.shape)) for x in closed.jaxpr.invars]
    inputs[0] = SparseValue(np.array([1 << i for i in range(n)], object))
    (found,) = interpreted(closed, inputs, _apply, _constant)
    return _as_booleans(found.sets, n)


def _as_booleans(sets: np.ndarray, count):
    """One row per set."""
    width = count // 8 + 1
    rows = np.frombuffer(b"".join(int(s).to_bytes(width, "little") for s in sets), np.uint8).reshape(-1, width)
    return np.unpackbits(rows, axis=1, bitorder="little")[:, :count].astype(bool)


def _constant(x, aval: ShapedArray):
    known = None if isinstance(x, Tracer) else np.asarray(x)
    return SparseValue(_empty(np.shape(x)), known)


def _empty(shape: tuple[int, ...]):
    return np.full(shape, 0, object)


def _apply(equation, operands: Sequence):
    name, params = equation.primitive.name, equation.params
    shapes = [x.aval.shape for x in equation.outvars]
    results = None
    if name in ENTRYWISE:
        results = [SparseValue(_united(name, operands, shapes[0]), _evaluated(name, equation, operands))]
    elif name in RULES and None not in (results := RULES[name](operands, params, equation)):
        pass
    else:
        # Anything else: each result depends on everything that the operands depend on.
        everything = np.bitwise_or.reduce([_union(x.sets) for x in operands] + [0])
        results = [SparseValue(np.full(shape, everything, object)) for shape in shapes]
    return results


def _union(sets: np.ndarray, axis: int | None = None):
    """The union over some axes, or over all."""
    if axis is None:
        return np.bitwise_or.reduce(np.ravel(sets), initial=0)
    for i in sorted(axis, reverse=True):
        sets = np.bitwise_or.reduce(sets, axis=i, initial=0)
    return np.asarray(sets, object)


def _united(name: str, operands: Sequence, shape: tuple[int, ...]):
    sets = _empty(shape)
    for i, operand in enumerate(operands):
        part = operand.sets
        if name == "mul":
            # A product with a constant zero is zero, as with a mask.
            other = operands[1 - i].known
            part = part if other is None else np.where(other == 0, 0, part)
        elif name == "select_n" and operands[0].known is not None:
            part = np.where(operands[0].known.astype(int) == i - 1, part, 0)
        sets = sets | part
    return np.asarray(sets, object).reshape(shape)


def _evaluated(name: str, equation, operands: Sequence):
    """The entries of a result made of constants alone, as indices are."""
    known = [x.known for x in operands]
    if any(x is None for x in known):
        return None
    if name == "convert_element_type":
        return known[0].astype(equation.outvars[0].aval.dtype)
    return IN_NUMPY[name](*known) if name in IN_NUMPY else None


def _moving(move):
    """The rule of a primitive that moves entries, given the same move of NumPy arrays."""

    def rule(operands: Sequence, params: dict, equation: JaxprEqn):
        # The second operand of a padding is a number.
        known = [x.known for x in operands]
        moved = None if any(x is None for x in known) else move(known, params)
        sets = move([x.sets for x in operands], params)
        single = not isinstance(sets, list)
        sets, moved = ([sets], [moved]) if single else (sets, moved or [None] * len(sets))
        return [SparseValue(s, k) for s, k in zip(sets, moved)]

    return rule


def _broadcast(arrays: Sequence, params: dict):
    shape = [1] * len(params["shape"])
    for size, axis in zip(np.shape(arrays[0]), params["broadcast_dimensions"]):
        shape[axis] = size
    return np.broadcast_to(np.reshape(arrays[0], shape), params["shape"])


def _reshape(arrays: Sequence, params: dict):
    return np.reshape(arrays[0], params["new_sizes"])


def _slice(arrays: Sequence, params: dict):
    strides = params["strides"] or [1] * np.ndim(arrays[0])
    return arrays[0][tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]


def _split(arrays: Sequence, params: dict):
    return list(np.split(arrays[0], np.cumsum(params["sizes"])[:-1], params["axis"]))


def _pad(arrays: Sequence, params: dict):
    x, fill = arrays
    for axis, (low, high, interior) in enumerate(params["padding_config"]):
        size = x.shape[axis] + max(x.shape[axis] - 1, 0) * interior
        shape = list(x.shape)
        shape[axis] = max(low, 0) + size + max(high, 0)
        wide = np.full(shape, np.asarray(fill).item(), x.dtype)

        def along(s: slice, axis: int = axis) -> tuple:
            return (slice(None),) * axis + (s,)

        wide[along(slice(max(low, 0), max(low, 0) + size, interior + 1))] = x
        x = wide[along(slice(max(-low, 0), shape[axis] - max(-high, 0)))]
    return x


def _concatenate(arrays: Sequence, params: dict):
    return np.concatenate(arrays, params["dimension"])


def _gather(operands: Sequence, params: dict, equation: JaxprEqn):
    return _by_positions(partial(equation.primitive.bind, **params), operands[0], operands[1:], equation)


def _by_positions(move, source, indices, equation: JaxprEqn):
    """Find where constant indices take entries from: apply the primitive itself to the entries' positions."""
    if any(x.known is None for x in indices):
        return [None]
    # Positions count from one, as zero means that nothing is taken: a gather fills float32 with NaN, made zero here.
    with at_once():
        taken = np.nan_to_num(np.asarray(move(_positions(source), *(x.known for x in indices)))).astype(int)
    taken = np.where((taken >= 0) & (taken <= source.sets.size), taken, 0)
    return [SparseValue(np.append(np.array([0], object), np.ravel(source.sets))[taken])]


def _positions(x) -> np.ndarray:
    """The positions of the entries of a value, from one."""
    return np.arange(1, x.sets.size + 1, dtype=np.float32).reshape(x.sets.shape)


def _scatter(operands: Sequence, params: dict, equation: JaxprEqn):
    """The operand's entries united with those written there, also where the latter replace the former."""
    onto, indices, updates = operands
    if indices.known is None:
        return [None]
    with at_once():
        zeros, places = np.zeros(onto.sets.shape, np.float32), indices.known

        def add(updates: Array) -> Array:
            return lax.scatter_add(zeros, places, updates, params["dimension_numbers"], mode=params["mode"])

        like = jax.ShapeDtypeStruct(updates.sets.shape, jnp.float32)
        (target,) = jax.linear_transpose(add, like)(_positions(onto))
    sets = np.append(np.array([0], object), np.ravel(onto.sets))
    np.bitwise_or.at(sets, np.ravel(np.asarray(target)).astype(int), np.ravel(updates.sets))
    return [SparseValue(sets[1:].reshape(onto.sets.shape))]


def _dynamic_slice(operands: Sequence, params: dict, equation: JaxprEqn):
    starts = [x.known for x in operands[1:]]
    if any(x is None for x in starts):
        return [None]
    source, sizes = operands[0].sets, params["slice_sizes"]
    # XLA shifts a slice back that would reach beyond the end.
    first = [int(np.clip(s, 0, n - k)) for s, n, k in zip(starts, source.shape, sizes)]
    return [SparseValue(source[tuple(slice(i, i + k) for i, k in zip(first, sizes))])]


def _dot_general(operands: Sequence, params: dict, equation):
    (contract, batch), shape = params["dimension_numbers"], equation.outvars[0].aval.shape
    sides = []
    for x, c, b in zip(operands, contract, batch):
        free = [i for i in range(x.sets.ndim) if i not in (*c, *b)]
        sizes = [int(np.prod([x.sets.shape[i] for i in axes])) for axes in (b, c, free)]
        counts = np.ones(x.sets.shape, bool) if x.known is None else x.known != 0
        sides.append([np.transpose(a, (*b, *c, *free)).reshape(sizes) for a in (x.sets, counts)])
    (a, a_counts), (b, b_counts) = sides
    if a.size * b.shape[2] > TERMS:
        rows, columns = _union(a, (1,)), _union(b, (1,))
        return [SparseValue((rows[:, :, None] | columns[:, None, :]).reshape(shape))]
    found = _empty((a.shape[0], a.shape[2], b.shape[2]))
    for k in range(a.shape[1]):
        found |= np.where(b_counts[:, k, None, :], a[:, k, :, None], 0)
        found |= np.where(a_counts[:, k, :, None], b[:, k, None, :], 0)
    return [SparseValue(found.reshape(shape))]


def _reduce(operands: Sequence, params: dict, equation: JaxprEqn):
    return [SparseValue(_union(operands[0].sets, params["axes"]))]


def _accumulate(operands: Sequence, params: dict, equation: JaxprEqn):
    def flip(x: np.ndarray) -> np.ndarray:
        return np.flip(x, params["axis"]) if params["reverse"] else x

    return [SparseValue(flip(np.bitwise_or.accumulate(flip(operands[0].sets), axis=params["axis"])))]


def _iota(operands: Sequence, params: dict, equation):
    aval = equation.outvars[0].aval
    along = np.arange(aval.shape[params["dimension"]], dtype=aval.dtype)
    along = along.reshape([-1 if i == params["dimension"] else 1 for i in range(len(aval.shape))])
    return [SparseValue(_empty(aval.shape), np.broadcast_to(along, aval.shape))]


RULES = {
    "broadcast_in_dim": _moving(_broadcast),
    "reshape": _moving(_reshape),
    "squeeze": _moving(lambda arrays, params: np.squeeze(arrays[0], tuple(params["dimensions"]))),
    "transpose": _moving(lambda arrays, params: np.transpose(arrays[0], params["permutation"])),
    "rev": _moving(lambda arrays, params: np.flip(arrays[0], params["dimensions"])),
    "slice": _moving(_slice),
    "split": _moving(_split),
    "pad": _moving(_pad),
    "concatenate": _moving(_concatenate),
    "stack": _moving(lambda arrays, params: np.stack(arrays, params["axis"])),
    "gather": _gather,
    "dynamic_slice": _dynamic_slice,
    "scatter": _scatter,
    "scatter-add": _scatter,
    "dot_general": _dot_general,
    "iota": _iota,
    **dict.fromkeys(REDUCING, _reduce),
    **dict.fromkeys(ACCUMULATING, _accumulate),
}


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
