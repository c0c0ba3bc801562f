"""How the models of `learned.py` are trained: one loop for all of them, for so many processor seconds after compiling.

The step is Muon's for matrices (Jordan et al. 2024: a momentum made orthogonal) and Adam's for all else, with a rate
that rises for a twentieth of the time and falls as a cosine. Of what was tried on the published double pendulum, Muon
came two to three times as far as Adam in the same time, and batches of 128 as far as those of 512.

A `Trainer` knows nothing of motions: what is minimised is `loss(weights, batch)`, and `batches(key)` draws.
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


class Trainer:
    """Steps for `loss(weights, batch)` on what `batches(key)` draws, `together` of them in one compiled call."""

    def __init__(self, loss, batches, together):
        self.optimiser = optax.chain(optax.clip_by_global_norm(LONGEST), optax.contrib.muon(1.0))
        self.loss, self.batches, self.together = loss, batches, together
        self.program = None

    def step(self, carry, key):
        """One step; nothing changes where the loss or its slope is not finite."""
        weights, state, rate = carry
        value, slope = jax.value_and_grad(self.loss)(weights, self.batches(key))
        usable = jnp.isfinite(optax.global_norm(slope)) & jnp.isfinite(value)
        change, new = self.optimiser.update(jax.tree.map(lambda x: jnp.where(usable, x, 0), slope), state, weights)
        state = jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, state)
        weights = jax.tree.map(lambda w, c: w + jnp.where(usable, rate.astype(w.dtype) * c, 0), weights, change)
        return (weights, state, rate), value

    def steps(self, weights, state, rate, key):
        """The weights after some steps, the optimiser's state, and the mean loss."""
        (weights, state, _), values = jax.lax.scan(
            self.step, (weights, state, rate), jax.random.split(key, self.together)
        )
        return weights, state, jnp.mean(values)

    def train(self, weights, budget, peak, seed=0):
        """Go on until `budget` processor seconds are over; compiling, once for all seeds, is not counted."""
        weights = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), weights)
        state, key = self.optimiser.init(weights), jax.random.key(seed)
        rate = lambda share: jnp.asarray(peak * rate_at(share), jnp.float32)
        started = time.process_time()
        # Compiled ahead: a program that meets other types refuses them, where `jit` would compile again unseen.
        self.program = self.program or jax.jit(self.steps).lower(weights, state, rate(0.0), key).compile()
        compiling, losses, started = time.process_time() - started, [], time.process_time()
        while (spent := time.process_time() - started) < budget:
            key, now = jax.random.split(key)
            weights, state, value = self.program(weights, state, rate(spent / budget), now)
            losses.append(float(value))
        return Trained(weights, losses, len(losses) * self.together, compiling, time.process_time() - started)


def by_states(model):
    """The loss of states (q, v, a), (N, n) each: the mean of the model's `mismatch`."""
    return lambda weights, batch: jnp.mean(jax.vmap(model.mismatch, (None, 0, 0, 0))(weights, *batch))


def by_motions(model, windows, sigma, tolerance=1e-5):
    """The loss of windows by their numbers (B,): of `weights["network"]` and `weights["starts"]`, (W, 2, n).

    A start is what the smoother says, moved by three of its standard deviations for each unit of its weight. The
    penalty grows as the square of an error up to three standard deviations of a measurement, and then as itself: a
    model that is still far off would else be all that is seen.
    """
    measured, first = jnp.asarray(windows.q), jnp.asarray(windows.start)
    spread = jnp.asarray(3 * windows.spread)[None]

    def loss(weights, batch):
        (chosen,) = batch
        start = first[chosen] + spread * weights["starts"][chosen]
        run = lambda start: model.motion(weights["network"], start[0], start[1], windows.ts, tolerance)[0]
        off = (jax.vmap(run)(start) - measured[chosen]) / (3 * sigma)
        # A motion that failed says nothing; diffrax leaves infinity there.
        off = jnp.where(jnp.isfinite(off), off, 0.0)
        return jnp.mean(jnp.sqrt(1 + off**2) - 1)

    return loss
