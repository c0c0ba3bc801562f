"""Training with optimisers of optax."""
