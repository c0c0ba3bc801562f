"""Sine and cosine that vectorise on a CPU.

XLA calls the C library once for every sine of a float64 array. Here sine and cosine use only arithmetic, in three steps
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
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

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
