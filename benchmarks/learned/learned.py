"""How well is a motion learned, compared with published results, a neural ODE and a Hamiltonian network?

(1) The double pendulum of Cranmer, Greydanus, Hoyer, Battaglia, Spergel and Ho, "Lagrangian neural networks" (2020,
arXiv:2003.04630). The setting follows the authors' own code (github.com/MilesCranmer/lagrangian_nns, commit
2fc26cb, notebooks DoublePendulum and DoublePendulum-Baseline): unit masses and lengths, g = 9.8; random states, angles
in one turn and rates of ±10, with their exact accelerations; L one network of three layers of 600 softplus units, and a
network for the accelerations of the same size; 300 epochs of a million fresh states in batches of 512. The results that
these notebooks print are used here (only the beginning of the paper itself was accessible):

    loss      the mean of |Δa1| + |Δa2| over 100,000 other states: 0.0689 for L, 0.0739 for the other
    energy    the mean of |E - E_true| / 29.4 after 100 s over 40 motions (angles in one turn, rates up to 0.1), E by
              the true formula: 0.0043 for L, 0.080 for the other (for the first 40 motions)

States are drawn in the same way; networks are smaller, and take sines and cosines of the angles.

(2) Chaotic and dissipative: Shinde et al., "Deepmechanics" (2026, arXiv:2602.18060) find that Hamiltonian and
Lagrangian networks "struggle to maintain stability for chaotic or nonconservative systems". Only the beginning of that
paper was accessible too, without tables: the systems are our own choice, that of Hénon and Heiles in its chaotic range
and a damped double pendulum (`systems.py`). All models get the same noisy positions: first smoothed states one
by one, then motions in windows, whose initial states are trained too.

(3) A measured double pendulum (`pendulum.py`): its rigid-body L is known, friction is learned.

Errors are those of motions from initial states that no model has seen, after 1, 10 and 100 natural times: the largest
error until then, of coordinates and of velocities divided by the natural rate, as the median over the initial states;
energies by the true formula, relative to their typical size. 10 stands for larger errors and for motions that end
early. A chaotic motion cannot be predicted beyond about ten natural times by any method, but its energy can. For
several seeds the median and the range are given.

`--seconds` are processor seconds of training for each model and seed, after compiling; `--published-seconds` are those
for the first setting.

    python -m benchmarks.learned.learned [--seconds 12] [--published-seconds 30] [--seeds 2] [--record FILE]
                                 [--json FILE] [--only TEXT]
"""

import argparse
import os
import sys
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

jax.config.update("jax_enable_x64", True)

from benchmarks.learned import pendulum, systems  # noqa: E402
from benchmarks.learned.models import as_wide, count, free, hamiltonian, neural_ode, ours  # noqa: E402
from benchmarks.learned.scores import HORIZONS, OUTPUTS_A_TIME, errors_of, starts_of  # noqa: E402
from benchmarks.learned.systems import DAMPED, NATURAL, PUBLISHED, STARS  # noqa: E402
from benchmarks.learned.training import Trainer, by_motions, by_states  # noqa: E402
from benchmarks.measure import main, row  # noqa: E402

# Values printed by the authors' notebooks, for L and for their network of accelerations.
LOSS, OTHER_LOSS, ENERGY, OTHER_ENERGY, LARGEST = 0.06890, 0.07387, 0.004258, 0.08007, 29.4
HIDDEN, SMALLER, PEAK, BATCH = (32, 32, 32), (24, 24), 0.005, 128
OPTIONS: dict[str, Any] = {
    "seconds": 12.0,
    "published_seconds": 30.0,
    "seeds": 2,
    "record": os.environ.get("LAGJAX_DOUBLE_PENDULUM"),
}


class Several(NamedTuple):
    """The results of several seeds, one row each, and their training."""

    found: np.ndarray
    shown: dict

    def row(self, what, column, target=None, **more):
        """The median of one column."""
        some = self.found[:, column]
        return row(what, np.median(some), target, low=float(some.min()), high=float(some.max()), **more, **self.shown)


def seeds_of(train_one, score):
    """Train and score all seeds: `train_one(seed)` gives a `Trained`, `score(weights)` numbers."""
    trained = [train_one(seed) for seed in range(OPTIONS["seeds"])]
    weights = trained[0].weights
    network = weights["network"] if isinstance(weights, dict) and "network" in weights else weights
    shown = {"seconds": float(np.median([one.seconds for one in trained])), "compiling_s": trained[0].compiling}
    shown |= {"steps": int(np.median([one.steps for one in trained])), "numbers": count(network)}
    return Several(np.array([score(one.weights) for one in trained], float), shown)


def published(wanted):
    """The double pendulum, state by state."""
    setting = PUBLISHED.setting
    mine = ours(setting, HIDDEN)
    numbers = count(mine.first(np.random.default_rng(0)))
    models = [mine, free(setting, as_wide(20_000, 6, 3, 1)), neural_ode(setting, numbers, 3),
              hamiltonian(setting, numbers, 3)]  # fmt: skip
    for model in models:
        name = f"published setting, {model.name}"
        if not wanted(name):
            continue
        trainer = Trainer(by_states(model), lambda key: systems.published_states(key, BATCH), 100)
        # Single precision, as in the authors' code, allows twice as many steps.
        first = lambda seed: jax.tree.map(np.float32, model.first(np.random.default_rng(seed)))
        several = seeds_of(
            lambda seed: trainer.train(first(seed), OPTIONS["published_seconds"], PEAK, seed), scored(model)
        )
        target = (LOSS, ENERGY) if model is mine else (None, None)
        yield several.row(f"{name}: |Δa1| + |Δa2|", 0, target[0], published=LOSS, published_other=OTHER_LOSS)
        yield several.row(f"{name}: energy after 100 s / 29.4", 1, target[1], published=ENERGY,
                          published_other=OTHER_ENERGY)  # fmt: skip


def scored(model):
    """`score(weights)` -> the loss on 100,000 other states, and the mean energy error of 40 motions."""
    states = systems.published_states(jax.random.key(2**20), 100_000, jnp.float64)
    starts = PUBLISHED.starts(np.random.default_rng(0), 40)
    right = systems.energy(PUBLISHED, *starts)

    @jax.jit
    def of_states(weights, q, v, a):
        off = jnp.abs(jax.vmap(model.accelerations, (None, 0, 0))(weights, q, v) - a)
        return jnp.mean(jnp.sum(off, axis=1))

    ts = np.array([0.0, 100.0])
    run = jax.jit(jax.vmap(lambda weights, q0, v0: model.motion(weights, q0, v0, ts, 1e-7), (None, 0, 0)))

    def score(weights):
        weights = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), weights)
        ends = [np.asarray(x)[:, -1] for x in run(weights, *starts)]
        off = np.abs(systems.energy(PUBLISHED, *ends) - right) / LARGEST
        return of_states(weights, *states), np.mean(np.where(np.isfinite(off), np.minimum(off, 10.0), 10.0))

    return score


def from_positions(truth, wanted):
    """The rows of a system whose noisy positions are known."""
    setting = truth.setting
    mine = ours(setting, SMALLER)
    numbers = count(mine.first(np.random.default_rng(0)))
    asked = [model for model in (mine, neural_ode(setting, numbers, 2), hamiltonian(setting, numbers, 2))
             if wanted(f"{setting.name}, {model.name}")]  # fmt: skip
    if not asked:
        return
    windows, starts = systems.measured(truth, 0), starts_of(truth)
    apart = np.median(systems.growth(truth, starts[1][:, 0], starts[2][:, 0], starts[0]), axis=0)
    at = {horizon: float(apart[horizon * OUTPUTS_A_TIME]) for horizon in HORIZONS}
    more = {f"after_{horizon}": size for horizon, size in at.items()}
    yield row(f"{setting.name}: a nudge of 1e-8 after 10 natural times", at[10], **more)
    energies = {}
    for model in asked:
        several = taught_by(model, windows, systems.SIGMA, errors_of(model, truth, starts, NATURAL))
        for i, horizon in enumerate(HORIZONS):
            yield several.row(f"{setting.name}, {model.name}: {horizon} natural times", i)
            yield several.row(f"{setting.name}, {model.name}: energy, {horizon} natural times", len(HORIZONS) + i)
        energies[model.name] = np.median(several.found[:, -1])
    if len(asked) == 3:
        others = min(energies[model.name] for model in asked[1:])
        yield row(f"{setting.name}: energy, ours / the better other", energies[mine.name] / others, 1.0)


def taught_by(model, windows, sigma, score):
    """Train a model with smoothed states for a quarter of the time, then with motions in windows."""
    states = Trainer(by_states(model), drawn_from(windows.states, BATCH), 50)
    moving = Trainer(by_motions(model, windows, sigma), drawn_from((np.arange(len(windows.q)),), 32), 5)

    def one(seed):
        weights = model.first(np.random.default_rng(seed))
        early = states.train(weights, 0.25 * OPTIONS["seconds"], PEAK, seed)
        both = {"network": early.weights, "starts": np.zeros(windows.start.shape)}
        late = moving.train(both, 0.75 * OPTIONS["seconds"], PEAK, seed)
        return late._replace(compiling=early.compiling + late.compiling, seconds=early.seconds + late.seconds)

    return seeds_of(one, lambda weights: score(weights["network"]))


def drawn_from(arrays, size):
    """`batches(key)` with replacement."""
    arrays = tuple(map(jnp.asarray, arrays))

    def batches(key):
        chosen = jax.random.randint(key, (size,), 0, len(arrays[0]))
        return tuple(x[chosen] for x in arrays)

    return batches


def rows(wanted):
    """The published setting, noisy positions, a measured pendulum."""
    yield from published(wanted)
    yield from from_positions(STARS, wanted)
    yield from from_positions(DAMPED, wanted)
    yield from pendulum.rows(wanted, OPTIONS["record"], taught_by)


if __name__ == "__main__":
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--seconds", type=float, default=OPTIONS["seconds"])
    own.add_argument("--published-seconds", type=float, default=OPTIONS["published_seconds"])
    own.add_argument("--seeds", type=int, default=OPTIONS["seeds"])
    own.add_argument("--record", default=OPTIONS["record"])
    asked, sys.argv[1:] = own.parse_known_args()
    OPTIONS.update(vars(asked))
    main(rows, __doc__)
