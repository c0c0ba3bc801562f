"""Tolerances below which computed numbers count as zero, for each dtype."""

from typing import NamedTuple

import numpy as np


class Precision(NamedTuple):
    """Values up to these, relative to the size that they could have, are round-off.

    `null`: of a rate of change; `zero`: of an entry of a combination; `exact`: of a rate that needs no gauge function;
    `agrees`: of the difference of two numbers that are taken to be equal.
    """

    null: float
    zero: float
    exact: float
    agrees: float


PRECISIONS = {
    np.dtype("float64"): Precision(null=1e-9, zero=1e-8, exact=1e-13, agrees=1e-9),
    np.dtype("float32"): Precision(null=2e-4, zero=1e-3, exact=3e-5, agrees=1e-4),
}


def precision_of(dtype) -> Precision:
    """The tolerances of a dtype."""
    return PRECISIONS[np.dtype(dtype)]
