"""The errors of the models' motions in `learned.py`, by horizon."""

import jax
import numpy as np

from benchmarks.learned.systems import NATURAL, energy, motions

HORIZONS, LOST, STARTS, OUTPUTS_A_TIME = (1, 10, 100), 10.0, 8, 4


def starts_of(truth):
    """Initial states that no model has seen, with times and true motions."""
    q0, v0 = truth.starts(np.random.default_rng(12345), STARTS)
    ts = np.linspace(0.0, HORIZONS[-1] * NATURAL, HORIZONS[-1] * OUTPUTS_A_TIME + 1)
    return ts, *motions(truth, q0, v0, ts)


def errors_of(model, truth, right, natural):
    """`score(weights)`: at each horizon the median error of states, then of energies; see `learned.py`."""
    ts, q, v = right
    run = jax.jit(jax.vmap(lambda weights, q0, v0: model.motion(weights, q0, v0, ts, 1e-6), (None, 0, 0)))
    true_energy, rate = energy(truth, q, v), 2 * np.pi / natural

    def score(weights):
        found = [np.asarray(x) for x in run(weights, q[:, 0], v[:, 0])]
        states = np.maximum(*(np.abs(a - b).max(axis=2) / size for a, b, size in zip(found, (q, v), (1.0, rate))))
        energies = np.abs(energy(truth, *found) - true_energy) / truth.setting.energy
        return [until(off, ts, horizon * natural) for off in (states, energies) for horizon in HORIZONS]

    return score


def until(off, ts, end):
    """The median over starts of the largest error (starts, T) until `end`; `LOST` if it is larger or NaN."""
    off = np.where(np.isfinite(off), np.minimum(off, LOST), LOST)
    return float(np.median(off[:, ts <= end * (1 + 1e-9)].max(axis=1)))
