"""Gauss-Kronrod quadrature of many smooth functions at once, with an error estimate.

Source: Piessens, de Doncker-Kapenga, Überhuber & Kahaner, *QUADPACK* (1983), §2.2 (rules) and QK15 (the estimate).
"""

from typing import NamedTuple

import numpy as np

# The nodes from 1 down to 0 and their weights, and the weights of Gauss's rule at every other node.
_HALF = (
    0.991455371120812639206854697526329, 0.949107912342758524526189684047851, 0.864864423359769072789712788640926,
    0.741531185599394439863864773280788, 0.586087235467691130294144691258385, 0.405845151377397166906606412076961,
    0.207784955007898467600689403773245, 0.0,
)  # fmt: skip
_KRONROD = (
    0.022935322010529224963732008058970, 0.063092092629978553290700663189204, 0.104790010322250183839876322541518,
    0.140653259715525918745189590510238, 0.169004726639267902826583426598550, 0.190350578064785409913256402421014,
    0.204432940075298892414161999234649, 0.209482141084727828012999174891714,
)  # fmt: skip
_GAUSS = (
    0.129484966168869693270611432679082, 0.279705391489276667901467771423780, 0.381830050505118944950369775488975,
    0.417959183673469387755102040816327,
)  # fmt: skip


def _both_sides(half, sign=1):
    return np.array([*(sign * x for x in half), *reversed(half[:-1])])


NODES = _both_sides(_HALF, -1)
KRONROD = _both_sides(_KRONROD)
GAUSS = np.zeros(15)
GAUSS[1::2] = _both_sides(_GAUSS)


class Integrals(NamedTuple):
    """The integrals (m, k) of k functions over m intervals, error estimates (m,) summed over the functions, and the
    errors (m,) due to round-off."""

    values: np.ndarray
    errors: np.ndarray
    round_off: np.ndarray


def nodes(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The nodes (m, 15) of the intervals from a to b, (m,)."""
    return 0.5 * (a + b)[:, None] + 0.5 * (b - a)[:, None] * NODES.astype(a.dtype)[None]


def integrals(values: np.ndarray, a: np.ndarray, b: np.ndarray) -> Integrals:
    """The integrals of functions (m, 15, k) over the intervals from a to b."""
    half = 0.5 * (b - a)[:, None]

    def rule(weights: np.ndarray, f: np.ndarray) -> np.ndarray:
        return half * np.einsum("j,mjk->mk", weights, f)

    found, coarse = rule(KRONROD, values), rule(GAUSS, values)
    mean = 0.5 * np.einsum("j,mjk->mk", KRONROD, values)
    varies = np.abs(rule(KRONROD, np.abs(values - mean[:, None, :])))
    apart = np.abs(found - coarse)
    ratio = 200 * apart / np.where(varies > 0, varies, 1.0)
    errors = np.where(varies > 0, varies * np.minimum(1.0, ratio**1.5), apart)
    round_off = 50 * np.finfo(values.dtype).eps * np.abs(rule(KRONROD, np.abs(values)))
    return Integrals(found, errors.sum(axis=1), round_off.sum(axis=1))
