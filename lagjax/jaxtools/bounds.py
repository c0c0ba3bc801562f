"""Bounds of the values in a program, as far as its operations say: a cosine is between -1 and 1, a square not negative.

They tell which comparisons are decided once and for all, as those that only guard a root or a quotient against
round-off: `jnp.where(r > 0, r, 1.0)` of a distance r, `jnp.arccos(jnp.clip(jnp.cos(q), -1, 1))`.
"""

import math
from collections.abc import Sequence

import numpy as np

Bounds = tuple[float, float]
ALL = (-math.inf, math.inf)
OF_RESULT = {"cos": (-1.0, 1.0), "sin": (-1.0, 1.0), "tanh": (-1.0, 1.0), "erf": (-1.0, 1.0), "logistic": (0.0, 1.0),
             "exp": (0.0, math.inf), "exp2": (0.0, math.inf), "sqrt": (0.0, math.inf), "rsqrt": (0.0, math.inf),
             "square": (0.0, math.inf), "cosh": (1.0, math.inf)}  # fmt: skip
MOVING = {"broadcast_in_dim", "convert_element_type", "copy", "reshape", "rev", "slice", "squeeze", "stop_gradient",
          "transpose", "gather", "dynamic_slice", "reduce_max", "reduce_min", "expand_dims"}  # fmt: skip
JOINING = {"concatenate", "stack", "select_n"}


def of_number(x) -> Bounds:
    """The bounds of a known array."""
    x = np.asarray(x)
    if x.dtype.kind not in "fiu" or not x.size or np.isnan(x).any():
        return ALL
    return float(x.min()), float(x.max())


def of_result(equation, operands: Sequence[Bounds]) -> Bounds:
    """The bounds of the first result of a primitive, from those of its operands."""
    name = equation.primitive.name
    if name in OF_RESULT:
        return OF_RESULT[name]
    if name in MOVING:
        return operands[0]
    if name in JOINING:
        chosen = operands[1:] if name == "select_n" else operands
        return min(low for low, _ in chosen), max(high for _, high in chosen)
    if name == "integer_pow" and equation.params["y"] % 2 == 0:
        return 0.0, math.inf
    if name == "abs":
        low, high = operands[0]
        return (max(low, -high, 0.0), max(-low, high))
    if name == "neg":
        return -operands[0][1], -operands[0][0]
    if name in ("add", "add_any", "sub"):
        (a, b), (c, d) = operands[0], operands[1] if name != "sub" else (-operands[1][1], -operands[1][0])
        return a + c, b + d
    if name in ("mul", "div", "dot_general", "reduce_sum") and all(low >= 0 for low, _ in operands):
        return 0.0, math.inf
    if name == "mul" and equation.invars[0] is equation.invars[1]:
        return 0.0, math.inf
    if name in ("max", "min"):
        of = max if name == "max" else min
        return of(operands[0][0], operands[1][0]), of(operands[0][1], operands[1][1])
    return ALL
