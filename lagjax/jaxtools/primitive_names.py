"""JAX's primitives by name, classified for the code that walks over programs; a test checks each name.

A primitive that is not listed is treated as unknown, which is slower and never wrong.
"""

import numpy as np

# They work entry by entry, on numbers alone.
ELEMENTWISE = {
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
    "clamp", "cos", "cosh", "convert_element_type", "digamma", "div", "eq", "erf", "erf_inv", "erfc", "exp", "exp2",
    "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign",
    "sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
}  # fmt: skip
# Those of these that NumPy computes the same way: it computes constants.
IN_NUMPY = {
    "abs": np.abs, "add": np.add, "and": np.bitwise_and, "eq": np.equal, "ge": np.greater_equal, "gt": np.greater,
    "le": np.less_equal, "lt": np.less, "max": np.maximum, "min": np.minimum, "mul": np.multiply, "ne": np.not_equal,
    "neg": np.negative, "not": np.bitwise_not, "or": np.bitwise_or, "square": np.square, "sub": np.subtract,
    "select_n": lambda which, *cases: np.choose(which.astype(int), cases),
}  # fmt: skip
REDUCING = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "reduce_and", "reduce_or"}
ACCUMULATING = {"cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp"}
# They move entries and compute none.
MOVING = {
    "broadcast_in_dim", "concatenate", "copy", "dynamic_slice", "gather", "iota", "pad", "reshape", "rev", "slice",
    "split", "squeeze", "stack", "transpose", "unstack",
}  # fmt: skip
# Linear in all operands together; in the first operand, where the others choose or scale; in each of two operands.
ADDITIVE = {
    "add", "add_any", "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "cumsum", "neg", "pad",
    "reduce_sum", "reshape", "rev", "slice", "split", "squeeze", "stack", "stop_gradient", "sub", "transpose",
}  # fmt: skip
LINEAR_IN_FIRST = {"div", "dynamic_slice", "gather"}
BILINEAR = {"dot_general", "mul"}
PERIODIC = {"cos", "sin"}
# Primitives that stand for the program that they carry; the second kind has rules of its own for derivatives.
CALLS = {"jit", "closed_call"}
CALLS_WITH_RULES = {"custom_jvp_call", "custom_vjp_call", "remat2"}
CONTROL_FLOW = {"cond", "scan", "while"}
# Equinox's primitives: for use under `vmap`, and marks for derivatives.
EQUINOX_PRIMITIVES = {
    "maybe_set", "nonbatchable", "nondifferentiable_backward", "select_if_vmap", "unvmap_all", "unvmap_any",
    "unvmap_max", "vprim",
}  # fmt: skip
# LAPACK on a CPU, with the number of axes of the first operand for one matrix; others may hold solvers that call it.
LAPACK = {
    "cholesky": 2, "eig": 2, "eigh": 2, "geqp3": 2, "geqrf": 2, "hessenberg": 2, "householder_product": 2, "lu": 2,
    "ormqr": 2, "qr": 2, "schur": 2, "svd": 2, "triangular_solve": 2, "tridiagonal": 2, "tridiagonal_solve": 1,
}  # fmt: skip
HOLDS_A_SOLVER = {"linear_solve"}
