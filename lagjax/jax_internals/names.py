"""JAX's primitives by name, as the walkers over programs sort them: one table, each of whose names is tested.

What is no name here is treated as unknown by all of them, which is slower and never wrong.
"""

# Entry by entry, of numbers alone.
ELEMENTWISE = {
    "abs", "acos", "acosh", "add", "add_any", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil",
    "clamp", "cos", "cosh", "convert_element_type", "digamma", "div", "eq", "erf", "erf_inv", "erfc", "exp", "exp2",
    "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "rem", "round", "rsqrt", "select_n", "sign",
    "sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
}  # fmt: skip
REDUCING = {"reduce_sum", "reduce_max", "reduce_min", "reduce_prod", "reduce_and", "reduce_or"}
ACCUMULATING = {"cumsum", "cumprod", "cummax", "cummin", "cumlogsumexp"}
# What moves entries, and makes none.
MOVING = {
    "broadcast_in_dim", "concatenate", "copy", "dynamic_slice", "gather", "iota", "pad", "reshape", "rev", "slice",
    "split", "squeeze", "stack", "transpose", "unstack",
}  # fmt: skip
# Primitives that stand for the program that they carry; the second kind has rules of its own for derivatives.
CALLS = {"jit", "closed_call"}
CALLS_WITH_RULES = {"custom_jvp_call", "custom_vjp_call", "remat2"}
CONTROL_FLOW = {"cond", "scan", "while"}
# Of equinox: what holds under `vmap`, and marks for derivatives.
OF_EQUINOX = {
    "maybe_set", "nonbatchable", "nondifferentiable_backward", "select_if_vmap", "unvmap_all", "unvmap_any",
    "unvmap_max", "vprim",
}  # fmt: skip
