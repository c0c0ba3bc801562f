"""What counts as zero among numbers that were computed in a dtype."""

from typing import NamedTuple

import numpy as np


class Precision(NamedTuple):
    """Up to which size, relative to what it could be, something is round-off.

    `null`: a rate of change; `zero`: an entry of a combination; `exact`: a rate that needs no gauge function; `agrees`:
    what two numbers may differ by to be taken for the same.
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
    """That of a dtype."""
    return PRECISIONS[np.dtype(dtype)]
