"""Strict numerics for all tests: float64, no silent rank promotion, warnings are errors."""

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
