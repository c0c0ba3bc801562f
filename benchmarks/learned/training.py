"""The training of the models of `learned.py`: one loop for all, for a given processor time after compiling.

Matrices use the step of Muon (Jordan et al. 2024: an orthogonalised momentum) and everything else Adam's, with a rate
that rises for a twentieth of the time and then falls as a cosine. In trials on the published double pendulum, Muon
got two to three times as far as Adam in the same time, and batches of 128 as far as those of 512.

A `Trainer` knows nothing about motions: it minimises `loss(weights, batch)` on batches drawn by `batches(key)`.
"""

import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

# The gradient is clipped to this norm: one lane near a singular mass matrix would spoil the rest.
LONGEST, RISE, LAST = 50.0, 0.05, 1e-4


class Trained(NamedTuple):
    """The result of a training, and the processor seconds of compiling and of the steps."""

    weights: Any
    losses: list
    steps: int
    compiling: float
    seconds: float


def rate_at(share):
    """The learning rate over its peak after this share of the time."""
    if share < RISE:
        return max(share / RISE, 0.1)
    return LAST + (1 - LAST) * 0.5 * (1 + np.cos(np.pi * min(1.0, (share - RISE) / (1 - RISE))))


class Trainer:
    """Steps for `loss(weights, batch)` on batches from `batches(key)`, `together` of them in one compiled call."""

    def __init__(self, loss, batches, together):
        self.optimiser = optax.chain(optax.clip_by_global_norm(LONGEST), optax.contrib.muon(1.0))
        self.loss, self.batches, self.together = loss, batches, together
        self.program = None

    def step(self, carry, key):
        """One step; nothing changes if the loss or its gradient is not finite."""
        weights, state, rate = carry
        value, slope = jax.value_and_grad(self.loss)(weights, self.batches(key))
        usable = jnp.isfinite(optax.global_norm(slope)) & jnp.isfinite(value)
        change, new = self.optimiser.update(jax.tree.map(lambda x: jnp.where(usable, x, 0), slope), state, weights)
        state = jax.tree.map(lambda a, b: jnp.where(usable, a, b), new, state)
        weights = jax.tree.map(lambda w, c: w + jnp.where(usable, rate.astype(w.dtype) * c, 0), weights, change)
        return (weights, state, rate), value

    def steps(self, weights, state, rate, key):
        """Do some steps; return the weights, the optimiser's state, and the mean loss."""
        (weights, state, _), values = jax.lax.scan(
            self.step, (weights, state, rate), jax.random.split(key, self.together)
        )
        return weights, state, jnp.mean(values)

    def train(self, weights, budget, peak, seed=0):
        """Train for `budget` processor seconds, not counting compilation, which is done once for all seeds."""
        weights = jax.tree.map(lambda x: jnp.asarray(x, x.dtype), weights)
        state, key = self.optimiser.init(weights), jax.random.key(seed)
        rate = lambda share: jnp.asarray(peak * rate_at(share), jnp.float32)
        started = time.process_time()
        # Compiled ahead of time: it refuses arguments of other types, where `jit` would silently compile again.
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
    """The loss of the windows with the indices (B,), from `weights["network"]` and `weights["starts"]`, (W, 2, n).

    An initial state is that of the smoother, moved by three of its standard deviations per unit of its weight. The
    penalty is quadratic up to an error of three standard deviations of a measurement and linear beyond, so that large
    errors of an early model do not dominate.
    """
    measured, first = jnp.asarray(windows.q), jnp.asarray(windows.start)
    spread = jnp.asarray(3 * windows.spread)[None]

    def loss(weights, batch):
        (chosen,) = batch
        start = first[chosen] + spread * weights["starts"][chosen]
        run = lambda start: model.motion(weights["network"], start[0], start[1], windows.ts, tolerance)[0]
        off = (jax.vmap(run)(start) - measured[chosen]) / (3 * sigma)
        # A failed motion, which diffrax fills with infinity, contributes nothing.
        off = jnp.where(jnp.isfinite(off), off, 0.0)
        return jnp.mean(jnp.sqrt(1 + off**2) - 1)

    return loss
