"""How often does a fit end in the global minimum, and does it say so if it does not?

Twelve systems: scenes, driven ones, chaotic ones with windows, constrained ones, measurements with outliers. For each
seed the truth is drawn so that every guess is up to 30 % off, and measured with errors. A result counts as the global
minimum if its cost is no larger than that of the truth, which exceeds the minimum by a few units at most; for some
seeds the best of 64 further starts is computed too, and must not be lower. Every other result must be flagged: not
`converged`, with a warning, and not successful in a sweep. Right results that are flagged are false alarms.

    python -m benchmarks.campaigns.fits_found [--seeds N] [--alone N] [--restarts N] [--only TEXT] [--json FILE]
"""

import argparse
import json
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

import lagjax as lj
from benchmarks.measure import machine, row, versions, written
from lagjax.fit.residuals import dampened
from lagjax.integrate.results import in_words
from lagjax.scenes import bead_on_hoop, cross_rails, mass_distributions

jax.config.update("jax_enable_x64", True)

OFF = 0.3
FOUND, FLAGGED = 0.99, 1.0
# A search ends within this relative distance of its minimal cost.
ROUND_OFF = 1e-6
OUTLIER, SHARE = 30.0, 0.08


class Case(NamedTuple):
    """A system to fit: `guess` of all its parameters, of which `free` are fitted; `start(params)` of its motion.

    `hint` is a guess of the initial state, by default derived from the measurements; `sigma` is given by kind of
    measurement, for what `measured(traj)` returns.
    """

    system: Any
    guess: dict
    free: tuple[str, ...]
    start: Callable
    ts: np.ndarray
    sigma: dict
    measured: Callable = lambda traj: {"q": traj.q}
    hint: Any = None
    options: dict = {}
    outliers: bool = False

    def record(self, measured):
        """A `Record` of some measurements."""
        q0, v0 = (None, None) if self.hint is None else self.hint
        return lj.Record(self.ts, **measured, q0=q0, v0=v0, sigma=self.sigma)

    def fit(self, measured, **options):
        """A `Fit`."""
        return lj.fit(self.system, self.record(measured), self.guess, free=self.free, **self.options, **options)


def swing(t, q, v, p):
    """L of a pendulum in its angle."""
    return 0.5 * v**2 + p["w2"] * jnp.cos(q)


def rubbed(t, q, v, p):
    """Viscous friction."""
    return 0.5 * p["c"] * jnp.sum(v**2)


def pushed(t, q, v, p):
    """L of a pendulum with a time-dependent force."""
    return swing(t, q, v, p) + p["A"] * jnp.cos(p["W"] * t) * q


def shaken(t, q, v, p):
    """L of a pendulum whose support is shaken vertically."""
    return 0.5 * v**2 + (p["w2"] + p["A"] * jnp.cos(p["W"] * t)) * jnp.cos(q)


def duffing(t, q, v, p):
    """L of a hardening spring with a time-dependent force."""
    return 0.5 * v**2 - 0.5 * p["k"] * q**2 - 0.25 * p["k3"] * q**4 + p["A"] * jnp.cos(p["W"] * t) * q


def double(t, q, v, p):
    """L of a double pendulum of unit masses."""
    a, b = p["a"], p["b"]
    kinetic = a**2 * v[0] ** 2 + 0.5 * b**2 * v[1] ** 2 + a * b * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic + p["g"] * (2 * a * jnp.cos(q[0]) + b * jnp.cos(q[1]))


def coupled(t, q, v, p):
    """L of two masses between springs."""
    springs = p["k"] * q["a"] ** 2 + p["kb"] * q["b"] ** 2 + p["kc"] * (q["a"] - q["b"]) ** 2
    return 0.5 * (v["a"] ** 2 + v["b"] ** 2) - 0.5 * springs


def hanging(t, q, v, p):
    """L of a pendulum in Cartesian coordinates."""
    return 0.5 * p["m"] * (v["x"] ** 2 + v["y"] ** 2) - p["m"] * p["g"] * q["y"]


rod = lj.Holonomic(lambda t, q, p: q["x"] ** 2 + q["y"] ** 2 - p["l"] ** 2)
wire = lj.Holonomic(lambda t, q, p: q["y"] - p["k"] * q["x"] ** 2)
of = lambda *start: lambda params: start
CASES = {
    "scene: bead on a turning hoop": Case(
        bead_on_hoop.system, {"m": 0.5, "a": 0.75, "g": 9.8125, "omega": 3.0}, ("g", "omega"), of(2.0, 0.0),
        np.linspace(0.0, 10.0, 200), {"q": 0.03},
    ),
    "scene: cross-rails": Case(
        cross_rails.rotating_system, cross_rails.PARAMS, ("K", "k", "omega"),
        of({"R": 1.5, "r": 0.2}, {"R": 0.0, "r": 0.5}), np.linspace(0.0, 8.0, 120), {"q": 0.03},
    ),
    "scene: orbit around a dumbbell": Case(
        mass_distributions.SYSTEMS["dumbbell"], mass_distributions.PARAMS["dumbbell"], ("M1", "M2"),
        of(*mass_distributions.ORBITS["dumbbell"][:2]), np.linspace(0.0, 12.0, 120), {"q": 0.03},
    ),
    "driven: pendulum": Case(
        lj.System(pushed, dissipation=rubbed), {"w2": 9.0, "c": 0.3, "A": 1.2, "W": 2.0}, ("A", "W", "c", "w2"),
        of(0.8, 0.0), np.linspace(0.0, 15.0, 200), {"q": 0.02},
    ),
    "driven: pendulum with a shaken support": Case(
        lj.System(shaken, dissipation=rubbed), {"w2": 9.0, "c": 0.2, "A": 3.0, "W": 2.5}, ("A", "W", "c", "w2"),
        of(1.5, 0.0), np.linspace(0.0, 15.0, 300), {"q": 0.03},
    ),
    "driven: hardening spring": Case(
        lj.System(duffing, dissipation=rubbed), {"k": 4.0, "k3": 2.0, "c": 0.1, "A": 1.5, "W": 1.5},
        ("A", "W", "c", "k", "k3"), of(1.0, 0.0), np.linspace(0.0, 20.0, 300), {"q": 0.02},
    ),
    "chaotic, by windows: double pendulum": Case(
        lj.System(double), {"a": 1.0, "b": 0.8, "g": 9.81}, ("a", "b"), of(np.array([2.0, 2.5]), np.zeros(2)),
        np.linspace(0.0, 12.0, 240), {"q": 0.02}, options={"window": 2.0},
    ),
    "chaotic, by windows: driven pendulum": Case(
        lj.System(pushed, dissipation=rubbed), {"w2": 1.0, "c": 0.5, "A": 1.15, "W": 0.667}, ("A", "W", "c", "w2"),
        of(0.2, 0.0), np.linspace(0.0, 100.0, 500), {"q": 0.05}, options={"window": 12.0},
    ),
    "constrained: pendulum on a rod": Case(
        lj.System(hanging, {"rod": rod}), {"m": 1.5, "g": 9.81, "l": 2.0}, ("g", "l", "m"),
        lambda p: ({"x": p["l"], "y": 0.0 * p["l"]}, {"x": 0.0, "y": 0.0}), np.linspace(0.0, 8.0, 120),
        {"q": 0.03, "multipliers": 0.1}, lambda traj: {"q": traj.q, "multipliers": traj.multipliers},
        ({"x": 1.9, "y": 0.1}, {"x": 0.0, "y": 0.0}),
    ),
    "constrained: bead on a wire, pushed": Case(
        lj.System(lambda t, q, v, p: hanging(t, q, v, p) + p["A"] * jnp.cos(p["W"] * t) * q["x"], {"wire": wire}),
        {"m": 1.0, "g": 4.0, "k": 0.5, "A": 1.0, "W": 2.5}, ("A", "W", "g", "k"),
        lambda p: ({"x": 1.0 + 0.0 * p["k"], "y": p["k"]}, {"x": 0.0, "y": 0.0}), np.linspace(0.0, 15.0, 200),
        {"q": 0.02}, hint=({"x": 0.9, "y": 0.4}, {"x": 0.0, "y": 0.0}),
    ),
    "outliers: long record of a pendulum": Case(
        lj.System(swing, dissipation=rubbed), {"w2": 8.0, "c": 0.05}, ("c", "w2"), of(1.0, 0.0),
        np.linspace(0.0, 30.0, 600), {"q": 0.01}, options={"loss": "cauchy"}, outliers=True,
    ),
    "outliers: coupled masses, one unseen": Case(
        lj.System(coupled, dissipation=lambda t, q, v, p: 0.5 * p["c"] * (v["a"] ** 2 + v["b"] ** 2)),
        {"k": 4.0, "kb": 9.0, "kc": 2.0, "c": 0.1}, ("c", "k", "kb", "kc"),
        of({"a": 1.0, "b": -0.5}, {"a": 0.0, "b": 0.0}), np.linspace(0.0, 15.0, 200), {"q": 0.01},
        lambda traj: {"q": {"a": traj.q["a"]}}, ({"a": 0.9, "b": -0.4}, {"a": 0.1, "b": 0.1}), {"loss": "huber"}, True,
    ),
}  # fmt: skip


def drawn(case, seeds):
    """Truths by name (n, free), measurements (n, m) as vectors, their costs, and the function to unravel a vector."""
    draw = lambda seed: np.random.default_rng(seed)
    offs = np.stack([1 + OFF * draw(seed).uniform(-1, 1, len(case.free)) for seed in range(seeds)])
    truths = np.array([case.guess[name] for name in case.free]) / offs

    def clean(truth):
        params = case.guess | dict(zip(case.free, truth))
        return case.measured(lj.integrate(case.system, *case.start(params), params, ts=case.ts, throw=False))

    measured = jax.jit(jax.vmap(clean))(jnp.asarray(truths))
    _, tree = ravel_pytree(jax.tree.map(lambda x: x[0], measured))
    clean = np.asarray(jax.vmap(lambda x: ravel_pytree(x)[0])(measured))
    like = {kind: jax.tree.map(lambda x, kind=kind: jnp.full(x.shape[1:], case.sigma[kind]), part)
            for kind, part in measured.items()}  # fmt: skip
    sigma = np.asarray(ravel_pytree(like)[0])
    errors = []
    for seed in range(seeds):
        random = np.random.default_rng(seed + seeds)
        error = random.normal(size=clean.shape[1])
        if case.outliers:
            error = np.where(random.uniform(size=error.size) < SHARE, OUTLIER * random.normal(size=error.size), error)
        errors.append(error)
    errors = np.stack(errors)
    loss = case.options.get("loss", "squares")
    costs = 0.5 * np.sum(np.asarray(dampened(errors, loss)) ** 2, axis=1)
    return truths, clean + sigma * errors, costs, tree


def rows(name, case, seeds, alone_too, restarts):
    """Yield the rows of one system."""
    truths, data, costs, tree = drawn(case, seeds)
    if not np.all(np.isfinite(data)):
        raise ValueError(f"{name}: a true motion fails to integrate")

    def run(point):
        found = case.fit(tree(point["data"]))
        return found.values, found.cost, found.converged, jnp.sum(jnp.isfinite(found.costs)), found.steps

    started = time.perf_counter()
    swept = lj.sweep(run, {"data": data}, paired=True, progress=False)
    seconds = time.perf_counter() - started
    values, cost, converged, tries, steps = swept.values
    right = cost <= costs * (1 + ROUND_OFF)
    yield from shares(f"{name}, in a sweep", right, swept.ok, seconds=seconds, starts=float(np.mean(tries)),
                    steps=float(np.mean(steps)))  # fmt: skip
    if not np.array_equal(converged, swept.ok):
        yield row(f"{name}: converged and status differ", np.sum(converged != swept.ok), 0)
    for s in np.flatnonzero(~right | ~swept.ok)[:10]:
        how = in_words(swept.status.result[s])
        print(f"      seed {s}: chi2 {2 * cost[s]:.6g}, of the truth {2 * costs[s]:.6g}; {how}")
    started, alone, warned_of, lowest = time.perf_counter(), [], [], []
    for seed in range(alone_too):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", lj.FitWarning)
            found = case.fit(tree(data[seed]))
        alone.append((float(found.cost), bool(found.converged)))
        warned_of.append(any(issubclass(w.category, lj.FitWarning) for w in caught) or bool(found.converged))
    seconds = time.perf_counter() - started
    if alone:
        below, well = np.array(alone).T
        yield from shares(f"{name}, alone", below <= costs[:alone_too] * (1 + ROUND_OFF), well > 0, seconds=seconds)
    if not all(warned_of):
        yield row(f"{name}: flagged without a warning", alone_too - sum(warned_of), 0)
    for seed in range(restarts):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", lj.FitWarning)
            lowest.append(float(case.fit(tree(data[seed]), restarts=64).cost))
    if restarts:
        lower = np.sum(np.array(lowest) < cost[:restarts] * (1 - ROUND_OFF) - ROUND_OFF)
        lower -= np.sum(~right[:restarts])
        yield row(f"{name}: ends called right, {restarts} of them, above the best of 64", max(lower, 0), 0)


def shares(what, right, ok, **more):
    """The share of right results, the share of the others that is flagged, and false alarms."""
    count = len(right)
    yield row(f"{what}: global minimum", np.mean(right), FOUND, "more", missed=int(np.sum(~right)), of=count, **more)
    if np.any(~right):
        flagged = int(np.sum(~ok[~right]))
        yield row(f"{what}: flagged of the others", flagged / np.sum(~right), FLAGGED, "more", flagged=flagged)
    yield row(f"{what}: false alarms", np.sum(right & ~ok))


def main():
    """Print a table, and the shares over all systems."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=200)
    parser.add_argument("--alone", type=int, help="seeds that are also fitted outside a sweep; by default all")
    parser.add_argument("--restarts", type=int, default=4, help="seeds for which the best of 64 starts is computed")
    parser.add_argument("--only", metavar="TEXT", default="", help="only systems whose name contains it")
    parser.add_argument("--json", metavar="FILE", help="also write the rows there")
    options = parser.parse_args()
    print(f"{machine()}; " + ", ".join(f"{name} {version}" for name, version in versions().items()))
    alone = options.seeds if options.alone is None else options.alone
    lines = []
    for name, case in CASES.items():
        if options.only.lower() in name:
            for line in rows(name, case, options.seeds, alone, options.restarts):
                lines.append(line)
                print(written(line), flush=True)
            _write(options.json, lines)
    for way in ("in a sweep", "alone"):
        among = lambda what, way=way: [line for line in lines if line["what"].endswith(f"{way}: {what}")]
        found, others = among("global minimum"), among("flagged of the others")
        if found:
            missed, count = (sum(line[key] for line in found) for key in ("missed", "of"))
            flagged = sum(line["flagged"] for line in others)
            false = sum(line["value"] for line in among("false alarms"))
            lines += [
                row(f"all, {way}: global minimum", 1 - missed / count, FOUND, "more", missed=missed, of=count),
                row(f"all, {way}: flagged of the others", flagged / missed if missed else 1.0, FLAGGED, "more"),
                row(f"all, {way}: false alarms", false),
            ]
            print(*map(written, lines[-3:]), sep="\n")
    _write(options.json, lines)


def _write(path, lines):
    if path:
        result = {"machine": machine(), "versions": versions(), "rows": lines}
        Path(path).write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
