"""Strict numerics for all tests: float64, no silent rank promotion, warnings are errors."""

import os

# The workers share the cores: threads of OpenBLAS beside them can stall a small factorisation for seconds.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax  # noqa: E402

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
