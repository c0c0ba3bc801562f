"""Warn once what single precision costs: JAX computes in float32 unless told otherwise.

The warning comes where a state is first made of numbers that the user gave, in whichever function that is. A user who
means float32, on a GPU or for networks, starts from NumPy float32 arrays, or filters the warning by its class. JAX's
own arrays do not show what was meant: they are float32 in either case.
"""

import jax
import numpy as np

from lagjax.system.warn import warn

SINGLE = np.dtype("float32")
# Not empty once this process has warned, or float32 is known to be meant.
_settled = []


class PrecisionWarning(UserWarning):
    """JAX computes in single precision, as it does unless told otherwise; issued once per process.

    Where that is intended: `warnings.filterwarnings("ignore", category=lj.PrecisionWarning)`, or initial states of
    `np.float32` arrays.
    """


def warn_of_float32(dtype, given) -> None:
    """Warn once per process if JAX is left in single precision and no array in `given` is NumPy float32."""
    if _settled or dtype != SINGLE or jax.dtypes.canonicalize_dtype(np.float64) != SINGLE:
        return
    if not any(isinstance(x, np.ndarray | np.generic) and x.dtype == SINGLE for x in given):
        warn(
            "JAX computes in float32, as it does unless told otherwise: seven digits at most (1e-7), tolerances of "
            "1e-5 in place of 1e-9 (none below 1e-6), and still fewer digits in derivatives and fits.\n"
            'Fix: jax.config.update("jax_enable_x64", True) before the first array. Where float32 is meant, on a GPU '
            "for example, start from np.float32 arrays, or ignore lj.PrecisionWarning. This warning comes once.",
            PrecisionWarning,
        )
    _settled.append(True)
