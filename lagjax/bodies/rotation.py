"""Rotations as unit quaternions e = (w, x, y, z), which turn a body's axes into those of space.

    r_space = R(e) r_body,      Ω_space = 2 vec(ė e*),      Ω_body = 2 vec(e* ė),      ė = ½ Ω_space e = ½ e Ω_body

R is written without dividing by |e|²: it is a rotation where |e| = 1, which a constraint of the body sees to, and a
Lagrangian need be right there alone. Three numbers would need no constraint, and have poses where they stop: charts
that move would have to be known to all that reads q (outputs, events, fits), where a constraint is known already.

Source: Goldstein, *Classical Mechanics*, §4.5; Diebel, *Representing Attitude* (2006), Eqs. 125, 146 and 160.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from lagjax.jaxtools import is_traced, judging, numpy_of, to_jax

# Not a jump of a force that reads a quaternion: e and -e are one rotation.
_is_larger = judging(jnp.greater)


def unit_vector(x: np.ndarray) -> np.ndarray:
    """A vector of length one, zero for zero; its numbers may be the largest or the least there are."""
    size = np.abs(x).max()
    return x if size == 0 else x / size / np.linalg.norm(x / size)


def product(a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "4"]:
    """The quaternion that turns as `b` and then as `a`."""
    if not is_traced((a, b)):
        return to_jax(_product_of_numbers(np.asarray(a), np.asarray(b)))
    real = a[0] * b[0] - jnp.dot(a[1:], b[1:])
    return jnp.concatenate([real[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def conjugate(e: Float[Array, "4"]) -> Float[Array, "4"]:
    """The rotation back."""
    return jnp.concatenate([e[:1], -e[1:]])


def rotation_matrix(e: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """R(e), whose columns are the body's axes in space."""
    w, x, y, z = e
    return jnp.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


def _product_of_numbers(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.append(a[0] * b[0] - a[1:] @ b[1:], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))


# Coefficients of the bilinear forms below: what is many operations on single numbers is a product of arrays, for which
# XLA compiles far less, in derivatives above all.
# (a b)_k = PRODUCT_abk a_a b_b
PRODUCT = np.array([[_product_of_numbers(a, b) for b in np.eye(4)] for a in np.eye(4)])
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
# R_ij = TURNED_jiab e_a e_b, from e r e*
TURNED = np.einsum("ajm,mbi,b->jiab", PRODUCT, PRODUCT, CONJUGATE)[1:, 1:]
SPIN_IN_BODY = 2 * np.einsum("abk,a->kab", PRODUCT, CONJUGATE)[1:]
SPIN_IN_SPACE = 2 * np.einsum("bak,a->kab", PRODUCT, CONJUGATE)[1:]


def turned(e: Float[Array, "4"], r: ArrayLike) -> Float[Array, "... 3"]:
    """R(e) r in space, for vectors r (..., 3) that are given along the body's axes."""
    of = numpy_of(r)
    return _bilinear(of.tensordot(of.asarray(r), TURNED, 1), e, e)


def spin_in_body(e: Float[Array, "4"], rate: Float[Array, "4"]) -> Float[Array, "3"]:
    """The angular velocity along the body's axes."""
    return _bilinear(SPIN_IN_BODY, e, rate)


def spin_in_space(e: Float[Array, "4"], rate: Float[Array, "4"]) -> Float[Array, "3"]:
    """The angular velocity along the axes of space."""
    return _bilinear(SPIN_IN_SPACE, e, rate)


def _bilinear(form: ArrayLike, a: Float[Array, "4"], b: Float[Array, "4"]) -> Float[Array, "... 3"]:
    """`Σ form_ab a_a b_b` over the last two axes of a form, with all digits on an accelerator too."""
    # One product, of the form and all a_a b_b: its derivatives compile in two thirds of the time of two products.
    form = numpy_of(form).asarray(form, a.dtype)
    return jnp.dot(form.reshape(*form.shape[:-2], 16), (a[:, None] * b[None, :]).reshape(16), precision="highest")


def about(axis: ArrayLike, angle: ArrayLike) -> Float[Array, "4"]:
    """The rotation by an angle about an axis of any length."""
    xp, dtype = numpy_of((axis, angle)), jax.dtypes.canonicalize_dtype(float)
    axis, half = xp.asarray(axis, dtype), xp.asarray(angle, dtype) / 2
    with np.errstate(all="ignore"):
        found = xp.concatenate([xp.cos(half)[None], xp.sin(half) * axis / xp.sqrt(xp.sum(axis**2))])
    return to_jax(found)


def quaternion_of(turned: Float[Array, "3 3"]) -> Float[Array, "4"]:
    """The unit quaternion of a rotation matrix, of the two the one whose largest part is positive."""
    (a, b, c), (d, f, g), (h, i, j) = turned
    # The rows of 4 e eᵀ, of which that with the largest diagonal entry is divided by the root of that.
    rows = [
        jnp.stack([1 + a + f + j, i - g, c - h, d - b]),
        jnp.stack([i - g, 1 + a - f - j, b + d, c + h]),
        jnp.stack([c - h, b + d, 1 - a + f - j, g + i]),
        jnp.stack([d - b, c + h, g + i, 1 - a - f + j]),
    ]
    best, largest = rows[0], rows[0][0]
    for k in (1, 2, 3):
        is_larger = _is_larger(rows[k][k], largest)
        best, largest = (jnp.where(is_larger, x, y) for x, y in ((rows[k], best), (rows[k][k], largest)))
    return best / (2 * jnp.sqrt(largest))
