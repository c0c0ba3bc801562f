"""What single precision costs, told once: JAX computes in float32 unless told otherwise.

It is told where a state is made of numbers that the user gave, at whichever function comes first. Who means float32, on
a GPU or for networks, starts from arrays of NumPy's float32, or filters the warning by its class; JAX's own arrays do
not tell, as they are of float32 whatever was meant.
"""

import jax
import numpy as np

from lagjax.mechanics.warned import warn

SINGLE = np.dtype("float32")
# Whether it was told, or is known, in this process.
_settled = []


class PrecisionWarning(UserWarning):
    """JAX computes in single precision, as it does unless told otherwise; told once in a process.

    Where that is meant: `warnings.filterwarnings("ignore", category=lj.PrecisionWarning)`, or initial states of
    `np.float32` arrays.
    """


def warn_of_float32(dtype, given) -> None:
    """Warn once in a process where JAX is left in single precision, and none of `given` is of NumPy's float32."""
    if _settled or dtype != SINGLE or jax.dtypes.canonicalize_dtype(np.float64) != SINGLE:
        return
    if not any(isinstance(x, np.ndarray | np.generic) and x.dtype == SINGLE for x in given):
        warn(
            "JAX computes in float32, as it does unless told otherwise: seven digits at most (1e-7), tolerances of "
            "1e-5 in place of 1e-9, below 1e-6 refused, and fewer digits yet in derivatives and fits.\n"
            'Fix: jax.config.update("jax_enable_x64", True) before the first array. Where float32 is meant, on a GPU '
            "for example, start from np.float32 arrays, or ignore lj.PrecisionWarning. This is told once.",
            PrecisionWarning,
        )
    _settled.append(True)
