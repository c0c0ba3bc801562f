"""How the models of `learned.py` are trained: one loop for all of them, for so many processor seconds after compiling.

The step is Muon's for matrices (Jordan et al. 2024: a momentum made orthogonal) and Adam's for all else, with a rate
that rises for a twentieth of the time and falls as a cosine. Of what was tried on the published double pendulum, Muon
came two to three times as far as Adam in the same time, and batches of 128 as far as those of 512.

`train` knows nothing of motions: what is minimised is `loss(weights, batch)`, and `batches(key)` draws.
"""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

# The gradient is cut to this length: one lane near a singular mass matrix would throw the rest.
LONGEST, RISE, LAST = 50.0, 0.05, 1e-4


class Trained(NamedTuple):
    """What came of it, and the processor seconds of compiling and of the steps."""

    weights: Any
    losses: list
    steps: int
    compiling: float
    seconds: float


def rate_at(share):
    """The rate over its peak when this share of the time is over."""
    if share < RISE:
        return max(share / RISE, 0.1)
    return LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * min(1.0, (share - RISE) / (1 - RISE))))


def trainer(loss, batches, together):
    """A compiled function that takes `together` steps: (weights, state, rate, key) -> (weights, state, mean loss)."""
    optimiser = optax.chain(optax.clip_by_global_norm(LONGEST), optax.contrib.muon(1.0))

    def step(carry, key):
        weights, state, rate = carry
        value, slope = jax.value_and_grad(loss)(weights, batches(key))
        usable = jnp.isfinite(optax.global_norm(slope)) & jnp.isfinite(value)
        change, new = optimiser.update(jax.tree.map(lambda x: jnp.where(usable, x, 0), slope), state, weights)
        state = jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, state)
        weights = jax.tree.map(lambda w, c: w + jnp.where(usable, rate.astype(w.dtype) * c, 0), weights, change)
        return (weights, state, rate), value

    @jax.jit
    def steps(weights, state, rate, key):
        (weights, state, _), values = jax.lax.scan(step, (weights, state, rate), jax.random.split(key, together))
        return weights, state, jnp.mean(values)

    return optimiser.init, steps


def train(taught, weights, budget, peak, seed=0):
    """Steps of a `trainer` until `budget` processor seconds are over; compiling (once a trainer) is not counted."""
    init, steps = taught
    started = time.process_time()
    weights = jax.tree.map(jnp.asarray, weights)
    state, key = init(weights), jax.random.key(seed)
    # Called, not only compiled: `jit` keeps what it has called.
    jax.block_until_ready(steps(weights, state, jnp.asarray(0.0), key))
    compiling, losses = time.process_time() - started, []
    started = time.process_time()
    while (spent := time.process_time() - started) < budget:
        key, now = jax.random.split(key)
        weights, state, value = steps(weights, state, jnp.asarray(peak * rate_at(spent / budget)), now)
        losses.append(float(value))
    return Trained(weights, losses, len(losses), compiling, time.process_time() - started)
