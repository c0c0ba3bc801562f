"""Programs on small arrays rewritten as operations on single numbers, without known zeros; sine and cosine for them.

The mechanics is written with vectors and matrices. For a few coordinates these are mostly zeros and ones: the rows of a
unit matrix along which a momentum is differentiated, a diagonal mass matrix. `written_out` splits a program into
operations on single numbers: products with a known zero are dropped, products with a known one are not computed, and
neither are unused numbers. What is the same operation on the same numbers is written once, as are numbers that differ
by their sign: of a rattleback's 4,100 operations that leaves 2,800. XLA keeps the rest in registers.

A product with a known zero is zero, even if the other factor turns out to be infinity or NaN: so it is where a known
zero is the derivative of what does not matter. Two exceptions keep the meaning of what the user writes: a factor that
is known to be infinity or NaN gives NaN; and in a program that asks whether a number is one (`isnan`, `isfinite`,
`nan_to_num`), all products with zeros are computed. Primitives that are not known here, control flow, and arrays of
more than `LARGE` entries are left unchanged.

XLA callsthe C library once for every sine of a float64 array. Here sine and cosine use only arithmetic, in three steps
without a branch, so that XLA fuses them into loops over vector registers:

    n = round(2 x/π),    x - n π/2 = r + d,    ±sin(r + d) or ±cos(r + d) by n modulo 4

π/2 is split into parts (Cody & Waite). The product of n and each part but the last is exact, and so is the first
subtraction. The rounding errors of later subtractions are collected in d (Fast2Sum). It is needed if x is close to a
multiple of π/2, so that the small difference has all its digits. Since the products are exact, it does not matter
whether XLA fuses them with sums. This holds for |n| < 2^16 in float64 and 2^10 in float32; beyond `limit` the C library
is used, behind a `lax.cond` that stays a branch under `vmap`. The polynomials in r are fdlibm's; first-order terms in d
keep the error below 0.85 units in the last place (C library: 0.55).

Source: Cody & Waite, *Software Manual for the Elementary Functions* (1980), ch. 8; fdlibm `k_sin.c`, `k_cos.c` (Sun
Microsystems, 1993) and FreeBSD msun `k_sinf.c`, `k_cosf.c` for the coefficients; Dekker, Numer. Math. 18 (1971) 224.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.extend.core import Jaxpr, JaxprEqn
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from lagjax.jaxtools.jaxpr import CALLS, ELEMENTWISE, IN_NUMPY, ClosedJaxpr, Literal, applied, equations, interpreted
from lagjax.jaxtools.primitives import primitive


class Arithmetic(NamedTuple):
    """The constants of sine and cosine in one floating-point format.

    - `limit`: the largest argument that `parts` can reduce.
    - `parts`: π/2 as a sum, largest part first.
    - `sine`, `cosine`: coefficients of r³, r⁵, ... and of r⁴, r⁶, ...
    - `tiny`: below it the sine equals its argument. Most processors treat subnormal numbers as zero here.
    - `integers`: adding this to a small integer puts the integer into the lowest bits.
    - `word`: the integer type of the same width.
    """

    limit: float
    parts: tuple[float, ...]
    sine: tuple[float, ...]
    cosine: tuple[float, ...]
    tiny: float
    integers: float
    word: type


ARITHMETIC = {
    np.dtype("float64"): Arithmetic(
        limit=1e5,
        parts=tuple(map(float.fromhex, ("0x1.921fb54440000p+0", "0x1.68c234c4c0000p-39", "0x1.98a2e03707345p-77"))),
        sine=(
            -1.66666666666666324348e-01,
            8.33333333332248946124e-03,
            -1.98412698298579493134e-04,
            2.75573137070700676789e-06,
            -2.50507602534068634195e-08,
            1.58969099521155010221e-10,
        ),
        cosine=(
            4.16666666666666019037e-02,
            -1.38888888888741095749e-03,
            2.48015872894767294178e-05,
            -2.75573143513906633035e-07,
            2.08757232129817482790e-09,
            -1.13596475577881948265e-11,
        ),
        tiny=2.0**-27,
        integers=1.5 * 2.0**52,
        word=np.int64,
    ),
    np.dtype("float32"): Arithmetic(
        limit=1600.0,
        parts=tuple(map(float.fromhex, ("0x1.9218p+0", "0x1.ed5p-14", "0x1.10bp-30", "0x1.184698p-44"))),
        sine=(-0.166666666416265235595, 0.0083333293858894631756, -0.000198393348360966317347, 2.718311493989822e-6),
        cosine=(0.0416666233237390631894, -0.00138867637746099294692, 0.0000243904487962774090654),
        tiny=2.0**-13,
        integers=1.5 * 2.0**23,
        word=np.int32,
    ),
}


def _with_derivatives(pair: Callable):
    """Give a function (sine, cosine) derivatives in terms of itself."""
    pair = jax.custom_jvp(pair)

    @pair.defjvp
    def rule(primals: Sequence, tangents: Sequence):
        sine, cosine = pair(*primals)
        return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])

    return pair


@_with_derivatives
def sincos(x: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Take sine and cosine, to 0.85 units in the last place, by arithmetic that XLA vectorises.

    >>> import jax.numpy as jnp
    >>> sine, cosine = sincos(jnp.array([0.0, jnp.pi / 6, 1e300]))
    >>> print(sine.round(8), (cosine**2).round(8))
    [ 0.          0.5        -0.81788191] [1.         0.75       0.33106918]

    **Arguments:** `x`, any shape. If any element, in any lane, is beyond `ARITHMETIC[dtype].limit` (1e5 in float64,
    1600 in float32), all elements use `jnp.sin` and `jnp.cos`; formats other than these two always do.

    **Returns:** sine and cosine, like `x`; NaN where `x` is not finite. Differentiable in both modes, to any order.
    """
    x = jnp.asarray(x)
    if np.dtype(x.dtype) not in ARITHMETIC:
        return _by_library(x)
    return lax.cond(eqxi.unvmap_any(_is_outside(x)), _by_library, _by_arithmetic, x)


def sincos_in_lanes(x):
    """Sine and cosine: by the C library, or in a batch on a CPU by arithmetic, which is several times faster there.

    For a single number both cost the same, 23 ns per pair.
    """
    return tuple(_sincos_p.bind(x))


def _sincos_jvp(primals: Sequence, tangents: Sequence):
    sine, cosine = _sincos_p.bind(*primals)
    (dx,) = tangents
    return (sine, cosine), (cosine * dx, -sine * dx)


def _sincos_batched(operands: Sequence, axes):
    batched_version = sincos if jax.default_backend() == "cpu" else _by_library
    return batched_version(*operands), axes * 2


def _is_outside(x):
    return jnp.abs(x) > ARITHMETIC[np.dtype(x.dtype)].limit


def _by_library(x):
    return jnp.sin(x), jnp.cos(x)


@_with_derivatives
def _by_arithmetic(x):
    """Sine and cosine of arguments within the limit; wrong for others."""
    a = ARITHMETIC[np.dtype(x.dtype)]
    n = lax.round(x * (2 / np.pi), lax.RoundingMethod.TO_NEAREST_EVEN)
    r, d = x - n * a.parts[0], 0.0
    for part in a.parts[1:-1]:
        r, before = r - n * part, r
        d = d + ((before - r) - n * part)
    d = d - n * a.parts[-1]
    z = r * r
    cube = z * r
    sine = r + ((d - z * (0.5 * d - cube * _polynomial(z, a.sine[1:]))) + cube * a.sine[0])
    # 1 - z/2 is rounded; the rounding error is added back.
    leading = 1 - 0.5 * z
    cosine = leading + (((1 - leading) - 0.5 * z) + (z * z * _polynomial(z, a.cosine) - r * d))
    # Cheaper than a conversion to integers, for which many processors have no vector instruction.
    quadrant = lax.bitcast_convert_type(n + a.integers, a.word)
    odd = (quadrant & 1) != 0
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    sine = jnp.where((quadrant & 2) != 0, -sine, sine)
    return jnp.where(jnp.abs(x) < a.tiny, x, sine), jnp.where(((quadrant + 1) & 2) != 0, -cosine, cosine)


def _polynomial(z: Array, coefficients):
    """Evaluate in pairs (Estrin's scheme): half the dependency chain of Horner's."""
    pairs = [c + z * after for c, after in zip(coefficients[::2], coefficients[1::2])]
    pairs += coefficients[len(pairs) * 2 :]
    return functools.reduce(lambda rest, pair: pair + z * z * rest, reversed(pairs))


_sincos_p = primitive(
    "sincos", lambda x: list(_by_library(x)), lambda x: [x, x],
    several=True, jvp=_sincos_jvp, batched=_sincos_batched,
)  # fmt: skip


LARGE = 512


class TooLong(Exception):
    """A program becomes longer than the allowed number of operations."""


def written_out(closed: ClosedJaxpr, *args, most: float = math.inf) -> list:
    """Evaluate a program on its (flat) arguments, number by number; raise `TooLong` beyond about `most` operations.

    >>> import jax, jax.numpy as jnp
    >>> program = jax.make_jaxpr(lambda x: jnp.diag(jnp.array([2.0, 0.0])) @ x)(jnp.ones(2))
    >>> numbers = jax.make_jaxpr(lambda x: written_out(program, x))(jnp.ones(2))
    >>> print([str(equation.primitive) for equation in numbers.jaxpr.eqns].count("mul"))
    1
    """
    # Known numbers follow the same rules as in the compiled program: 1/0 is infinite, without a warning.
    with np.errstate(all="ignore"):
        inputs = [_split(x) if _small(x.aval) else x for x in map(_Value, args)]
        ledger = _Ledger(most, not asks_for_nan(closed))
        rule = functools.partial(_apply, closed.jaxpr, ledger)
        results = interpreted(closed, inputs, rule, _constant, _is_plain_call)
    return [_joined(x, aval) for x, aval in zip(results, closed.out_avals)]


def asks_for_nan(closed: ClosedJaxpr) -> bool:
    """Whether a program asks of a number whether it is NaN or infinite."""

    def asks(equation: JaxprEqn):
        name, operands = equation.primitive.name, equation.invars
        if name not in ("eq", "ne"):
            return name == "is_finite"
        known = [x.val for x in operands if isinstance(x, Literal)]
        return operands[0] is operands[1] or any(np.ndim(x) == 0 and not np.isfinite(x) for x in known)

    return any(asks(equation) for equation in equations(closed.jaxpr))


# Of these the order of the operands does not matter.
COMMUTE = {"add", "add_any", "and", "eq", "max", "min", "mul", "ne", "or", "xor"}


class _Ledger:
    """What has been written so far: an operation on the same numbers is written once, and a sign is moved outwards.

    `most`: how many operations are allowed. `drops_zeros`: whether products with known zeros are dropped.
    """

    def __init__(self, most, drops_zeros: bool = True):
        self.left, self.drops_zeros = most, drops_zeros
        self.results: dict[tuple, tuple] = {}
        self.negated: dict[int, Any] = {}

    def count(self, entries: Sequence):
        """Count the entries that are not known numbers."""
        self.left -= sum(not isinstance(x, np.generic) for x in entries)
        if self.left < 0:
            raise TooLong

    def once(self, name: str, operation: Callable, *x, **params):
        """The result of an operation: the earlier one if it has been applied to the same numbers."""
        of = [(y.dtype, y.tobytes()) if isinstance(y, np.generic) else id(y) for y in x]
        key = name, frozenset(of) if name in COMMUTE else tuple(of), tuple(params.items())
        if key not in self.results:
            # With the operands, so that none is deleted and another number takes its `id`.
            self.results[key] = operation(*x, **params), x
        return self.results[key][0]

    def negative(self, x):
        """-x."""
        if isinstance(x, np.generic):
            return np.negative(x)
        if id(x) in self.negated:
            return self.negated[id(x)]
        result = self.once("neg", jax.lax.neg, x)
        self.negated[id(result)] = x
        return result

    def is_negative(self, x) -> bool:
        """Whether x was written as the negative of another number."""
        return id(x) in self.negated

    def add(self, x, y):
        """x + y."""
        if _is_known(x, 0):
            return y
        if _is_known(y, 0):
            return x
        if isinstance(x, np.generic) and isinstance(y, np.generic):
            return np.add(x, y)
        if self.is_negative(y):
            return self.subtract(x, self.negative(y))
        if self.is_negative(x):
            return self.subtract(y, self.negative(x))
        return self.once("add", jax.lax.add, *_arrays(x, y))

    def subtract(self, x, y):
        """x - y."""
        if _is_known(y, 0):
            return x
        if _is_known(x, 0):
            return self.negative(y)
        if isinstance(x, np.generic) and isinstance(y, np.generic):
            return np.subtract(x, y)
        if self.is_negative(y):
            return self.add(x, self.negative(y))
        return self.once("sub", jax.lax.sub, *_arrays(x, y))

    def multiply(self, x, y):
        """x y."""
        for a, b in ((x, y), (y, x)):
            # A known factor may be infinite: the product is computed below.
            if _is_known(a, 0) and self.drops_zeros and not isinstance(b, np.generic):
                return a
            if _is_known(a, 1):
                return b
            if _is_known(a, -1):
                return self.negative(b)
        if isinstance(x, np.generic) and isinstance(y, np.generic):
            return np.multiply(x, y)
        for a, b in ((x, y), (y, x)):
            if self.is_negative(a):
                return self.negative(self.multiply(self.negative(a), b))
        return self.once("mul", jax.lax.mul, *_arrays(x, y))

    def total(self, entries: Sequence, zero):
        """The sum of the entries."""
        return functools.reduce(self.add, entries, zero)


class _Value:
    """A whole array with the interface of a program's variable."""

    def __init__(self, array):
        self.array, self.aval = array, jax.typeof(array)


def _small(aval: ShapedArray):
    return hasattr(aval, "shape") and aval.size <= LARGE and not jnp.issubdtype(aval.dtype, jax.dtypes.extended)


def _split(value):
    """The numbers of a whole array, as an array of objects."""
    array = value.array
    if isinstance(array, (np.ndarray, np.generic)) or not isinstance(array, Tracer):
        return _known(np.asarray(array))
    if array.shape == ():
        return _filled((), [array])
    flat = array.reshape(-1)
    return _filled(array.shape, [jax.lax.squeeze(jax.lax.slice(flat, (i,), (i + 1,)), (0,)) for i in range(array.size)])


def _known(array):
    return _filled(array.shape, list(array.reshape(-1)))


def _filled(shape: tuple[int, ...], entries: Sequence):
    result = np.empty(len(entries), object)
    for i, entry in enumerate(entries):
        result[i] = entry
    return result.reshape(shape)


def _joined(value, aval: ShapedArray):
    """A whole array, from a `_Value` or an array of numbers."""
    if not isinstance(value, np.ndarray):
        return value.array
    if value.shape == ():
        return value[()]
    entries = [jnp.asarray(x, aval.dtype) for x in value.reshape(-1)]
    return jnp.stack(entries).reshape(aval.shape) if entries else jnp.zeros(aval.shape, aval.dtype)


def _constant(x, aval: ShapedArray):
    if not _small(aval):
        return _Value(x)
    return _split(_Value(x)) if isinstance(x, Tracer) else _known(np.asarray(x, aval.dtype))


def _is_plain_call(equation: JaxprEqn):
    return equation.primitive.name in CALLS


def _apply(jaxpr: Jaxpr, ledger, equation: JaxprEqn, operands: Sequence):
    name, params = equation.primitive.name, equation.params
    splittable = all(isinstance(x, np.ndarray) for x in operands) and all(_small(x.aval) for x in equation.outvars)
    if splittable and name in ELEMENTWISE:
        return [_elementwise(equation, operands, ledger)]
    write = functools.partial(SUMS[name], ledger) if name in SUMS else MOVES.get(name)
    if splittable and write is not None:
        found = write(params, equation.outvars, *operands)
        if found is not None:
            return found
    results = applied(jaxpr, equation, [_joined(x, v.aval) for x, v in zip(operands, equation.invars)])
    return [_split(x) if _small(v.aval) else x for x, v in zip(map(_Value, results), equation.outvars)]


def _elementwise(equation, operands: Sequence, ledger):
    (variable,) = equation.outvars
    shape, dtype = variable.aval.shape, variable.aval.dtype
    rows = [np.broadcast_to(x, shape).reshape(-1) for x in operands]
    entries = [_simplified(equation, dtype, ledger, *x) for x in zip(*rows)]
    ledger.count(entries)
    return _filled(shape, entries)


def _is_known(x, number):
    return isinstance(x, np.generic) and x == number


def _simplified(equation: JaxprEqn, dtype: DTypeLike, ledger, *x):
    """The result of a primitive for one number, simplified if operands are known."""
    name = equation.primitive.name
    if name in ("add", "add_any"):
        return ledger.add(*x)
    if name == "sub":
        return ledger.subtract(*x)
    if name == "mul":
        return ledger.multiply(*x)
    if name == "neg":
        return ledger.negative(x[0])
    if name == "div" and _is_known(x[1], 1):
        return x[0]
    if name == "div" and ledger.drops_zeros and _is_known(x[0], 0) and not isinstance(x[1], np.generic):
        return x[0]
    if name == "select_n" and isinstance(x[0], np.generic):
        return x[1 + int(x[0])]
    if name == "select_n" and all(y is x[1] for y in x[2:]):
        return x[1]
    if name == "convert_element_type":
        if isinstance(x[0], np.generic):
            return np.asarray(x[0]).astype(dtype)[()]
        if x[0].dtype == dtype and not getattr(x[0], "weak_type", False):
            return x[0]
    if name in ("sin", "cos") and not isinstance(x[0], np.generic):
        return ledger.once("sincos", sincos_in_lanes, x[0])[name == "cos"]
    if name == "div" and jnp.issubdtype(dtype, jnp.floating) and all(isinstance(y, np.generic) for y in x):
        return np.divide(*x)
    if name in IN_NUMPY and all(isinstance(y, np.generic) for y in x):
        return np.asarray(IN_NUMPY[name](*x), dtype)[()]
    return ledger.once(name, equation.primitive.bind, *x, **equation.params)


def _arrays(x, y):
    dtype = (y if isinstance(x, np.generic) else x).dtype
    return tuple(np.asarray(z, dtype) if isinstance(z, np.generic) else z for z in (x, y))


def _converted(entries, dtype: DTypeLike):
    def one(x: Any) -> Any:
        return x.astype(dtype) if isinstance(x, np.generic) else jax.lax.convert_element_type(x, dtype)

    return _filled(entries.shape, [x if x.dtype == dtype else one(x) for x in entries.reshape(-1)])


def _zero(variables: Sequence):
    return np.zeros((), variables[0].aval.dtype)[()]


def _broadcast(params: dict, variables: Sequence, x):
    shape, places = params["shape"], params["broadcast_dimensions"]
    widened = [1] * len(shape)
    for place, size in zip(places, x.shape):
        widened[place] = size
    return [np.broadcast_to(x.reshape(widened), shape)]


def _sliced(params: dict, variables: Sequence, x):
    strides = params["strides"] or [1] * x.ndim
    return [x[tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]]


def _dynamic_slice(params: dict, variables: Sequence, x, *starts):
    if not all(isinstance(s[()], np.generic) for s in starts):
        return None
    sizes = params["slice_sizes"]
    starts = [min(max(int(s[()]), 0), n - size) for s, n, size in zip(starts, x.shape, sizes)]
    return [x[tuple(slice(s, s + size) for s, size in zip(starts, sizes))]]


def _padded(params: dict, variables: Sequence, x, filling):
    if any(inner or low < 0 or high < 0 for low, high, inner in params["padding_config"]):
        return None
    result = _filled(variables[0].aval.shape, [filling[()]] * variables[0].aval.size)
    place = tuple(slice(low, low + n) for n, (low, _, _) in zip(x.shape, params["padding_config"]))
    result[place] = x
    return [result]


def _sum(ledger, params: dict, variables: Sequence, x):
    axes = params["axes"]
    kept = [i for i in range(x.ndim) if i not in axes]
    rows = x.transpose([*kept, *axes]).reshape([x.shape[i] for i in kept] + [-1])
    shape = rows.shape[:-1]
    rows = rows.reshape(-1, rows.shape[-1]) if rows.size else np.empty((int(np.prod(shape)), 0), object)
    return [_filled(shape, [ledger.total(row, _zero(variables)) for row in rows])]


def _cumulative_sum(ledger, params: dict, variables: Sequence, x):
    axis, result = params["axis"], x.copy()
    if params["reverse"]:
        return None
    result = np.moveaxis(result, axis, 0)
    for i in range(1, len(result)):
        flat = [ledger.add(a, b) for a, b in zip(result[i - 1].reshape(-1), result[i].reshape(-1))]
        result[i] = _filled(result[i].shape, flat) if result[i : i + 1].ndim > 1 else flat[0]
    return [np.moveaxis(result, 0, axis)]


def _product(ledger, params: dict, variables: Sequence, x, y):
    (contract_x, contract_y), (batch_x, batch_y) = params["dimension_numbers"]
    free_x = [i for i in range(x.ndim) if i not in (*contract_x, *batch_x)]
    free_y = [i for i in range(y.ndim) if i not in (*contract_y, *batch_y)]

    def sizes(z: Any, axes: Sequence[int]) -> int:
        return int(np.prod([z.shape[i] for i in axes]))

    # The operands may have other dtypes than the result: integers, or lower precision.
    x, y = (_converted(z, variables[0].aval.dtype) for z in (x, y))
    inner, batch = sizes(x, contract_x), sizes(x, batch_x)
    x = x.transpose([*batch_x, *free_x, *contract_x]).reshape(batch, -1, inner)
    y = y.transpose([*batch_y, *free_y, *contract_y]).reshape(batch, -1, inner)
    zero = _zero(variables)
    entries = [
        ledger.total(map(ledger.multiply, row, column), zero)
        for rows, columns in zip(x, y)
        for row in rows
        for column in columns
    ]
    return [_filled(variables[0].aval.shape, entries)]


def _unstacked(params: dict, variables: Sequence, x):
    return [
        _filled(v.aval.shape, list(part.reshape(-1))) for v, part in zip(variables, np.moveaxis(x, params["axis"], 0))
    ]


def _split_up(params: dict, variables: Sequence, x):
    return np.split(x, np.cumsum(params["sizes"])[:-1], params["axis"])


def _counted(params: dict, variables: Sequence):
    aval, axis = variables[0].aval, params["dimension"]
    shape = [-1 if i == axis else 1 for i in range(len(aval.shape))]
    return [_known(np.broadcast_to(np.arange(aval.shape[axis], dtype=aval.dtype).reshape(shape), aval.shape))]


SUMS: dict[str, Callable] = {"cumsum": _cumulative_sum, "dot_general": _product, "reduce_sum": _sum}
MOVES: dict[str, Callable] = {
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, variables, *x: [np.concatenate(x, params["dimension"])],
    "copy": lambda params, variables, x: [x],
    "dynamic_slice": _dynamic_slice,
    "iota": _counted,
    "pad": _padded,
    "reshape": lambda params, variables, x: [x.reshape(variables[0].aval.shape)],
    "rev": lambda params, variables, x: [np.flip(x, params["dimensions"])],
    "slice": _sliced,
    "split": _split_up,
    "squeeze": lambda params, variables, x: [x.reshape(variables[0].aval.shape)],
    "stack": lambda params, variables, *x: [
        np.stack([y.reshape(1, -1) for y in x], 0).reshape(-1, *x[0].shape)
        if params["axis"] == 0
        else np.moveaxis(np.stack([np.atleast_1d(y) for y in x], 0), 0, params["axis"])
    ],
    "unstack": _unstacked,
    "transpose": lambda params, variables, x: [x.transpose(params["permutation"])],
}
