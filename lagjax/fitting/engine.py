"""The front door of fits: check, look, search, say what was found and how well."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import PyTree

from lagjax.fitting.doubts import doubts
from lagjax.fitting.equations import WHOLE, Problem, Stage, one_by_one
from lagjax.fitting.identifiability import Identifiability
from lagjax.fitting.problem import problem_of
from lagjax.fitting.records import Record
from lagjax.fitting.result import Fit, FitWarning
from lagjax.fitting.search import listening, look, search
from lagjax.mechanics import coordinates
from lagjax.mechanics.system import System
from lagjax.meter import meter
from lagjax.motion.integrate import integrate
from lagjax.numerics.chained import Unknowns

# The first part of a record has so many measurements an unknown, and each next stage twice as many.
A_STAGE_HAS, STAGES = 4, 7
# What a jump between joined windows costs, stage by stage, in units of what missing the data by as much costs.
JOINED = (0.1, 1.0, 10.0, 100.0, 1e4)
# With a loss that forgives outliers so many stages more, in which to learn the size of an ordinary error.
SETTLING = 2
# Uncertainties of more numbers than this are not computed.
COVARIANCE_UP_TO = 1000
# In units of the data's spread: when a stage is done, and when the last one is; not below what the motion is good for.
STAGE_DONE, DONE, OF_RTOL, ROUND_OFFS = 1e-4, 1e-9, 10.0, 100.0


def fit(
    system: System,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    bounds: Mapping[str, tuple[float | None, float | None]] | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    loss: str = "squares",
    units: Mapping[str, str] | None = None,
    window: float | None = None,
    joined: bool = True,
    grow: bool = True,
    restarts: int = 0,
    spread: float = 0.3,
    seed: int = 0,
    optimiser: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | None = None,
    iterations: int = 100,
    progress: bool | None = None,
    **options,
) -> Fit:
    """Find the parameters and initial states with which the motion is nearest to what was measured.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swing = lj.System(lambda t, q, v, params: 0.5 * v**2 + params["w2"] * jnp.cos(q))
    >>> t = jnp.linspace(0.0, 10.0, 60)
    >>> measured = lj.integrate(swing, 1.0, 0.0, {"w2": 4.0}, ts=t).q
    >>> found = fit(swing, lj.Record(t, q=measured), {"w2": 3.0})
    >>> print(f"{found.params['w2']:.6f}", f"{found.q0[0]:.6f}", found.converged)
    4.000000 1.000000 True

    **Main arguments:**

    - `records`: one `Record` or several, each with its own initial state. Angles as they run on, not wrapped to a turn.
    - `params`: what the Lagrangian takes, with guesses of what is to be found; all records share it.
    - `free`: the names of what is found, `"g"`, `["m[1]", "arm.length"]`, or of a part, such as a network,
      `"potential"`. By default every floating number in `params`.
    - `observe(t, q, v, params)`: what `observed` in the records are measurements of: positions, for example.
    - `bounds`: by name, `{"m": (0.0, None)}`. A number that is positive is searched by its logarithm.
    - `priors`: by name (mean, standard deviation) of what is known already; needs `sigma` in the records.
    - `loss`: `"squares"`; or `"huber"`, `"soft_l1"`, `"cauchy"`, against outliers, which need `sigma`. Until the last
      stage an ordinary error is the median of what the motion is off, since far from the truth all are large.
    - `units`: by name, for the table.

    **The search:**

    - `window`: cut records into windows of this length, `[t]`, each from a state of its own: for chaotic motion and
      long records. With `joined` (multiple shooting) the windows are drawn together in a few stages until each goes on
      where the last one ended; else they stay on their own, which forgives what the system leaves out.
    - `grow`: begin with the first part of each record or window and double it, stage by stage: a long record has many
      wrong minima, whole periods off.
    - `restarts`: further starts of the search, with parameters `spread` (relative) away from their guess, or anywhere
      between two bounds; `seed` says which. The best end counts.
    - `optimiser`: by default `optimistix.LevenbergMarquardt`, with derivatives taken forward. Any other of optimistix's
      least-squares solvers; or a minimiser of it, with derivatives in reverse, for thousands of parameters, such as
      `optimistix.BFGS(rtol, atol)` or `optimistix.OptaxMinimiser(optax.adam(1e-3), rtol, atol)`.
    - `iterations`: the largest number in each stage.
    - `progress`: show stage, steps and cost (tqdm); by default where somebody may look.
    - `options` go to `lj.integrate`: `rtol`, `atol`, `method`, `event`, `max_steps`, ...

    **Returns:** a `Fit`: estimates with their uncertainties, residuals, what the data do not determine. It is the best
    point found also where the search did not converge (`converged`, and a `FitWarning`). Inside `jax.vmap`, `jit` or
    `lj.sweep` measurements and guesses may be traced, times not.

    **Raises:**

    - `ValueError` for names, shapes and kinds that do not match; for a guess from which the motion fails at once.
    - Warns (`lj.FitWarning`) where the search did not converge, a motion stops early, residuals are far larger than
      `sigma` says, an estimate is at its bound, or the data cannot see a parameter.

    Source: Nocedal & Wright, *Numerical Optimization*, §10.3; Bock, in *Modelling of Chemical Reaction Systems* (1981)
    (multiple shooting); Huber, *Robust Statistics*, §7.8 (scale by the median); Bierman, *Factorization Methods for
    Discrete Sequential Estimation* (covariance).
    """
    if optimiser is not None and not isinstance(optimiser, optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser):
        raise TypeError(
            f"optimiser must be one of optimistix's least-squares solvers or minimisers, not {optimiser!r:.60}.\n"
            "Fix: leave it out; or optimistix.OptaxMinimiser(optax.adam(1e-3), rtol=1e-6, atol=1e-6)."
        )
    problem = problem_of(system, records, params, free, observe, bounds, priors, loss, window, options)
    stages, tolerances = _stages(problem, grow, joined and window is not None)
    last = jax.tree.map(lambda x: x[-1], stages)
    with _shown(problem, len(tolerances), progress) as tell:
        run = lambda u: search(problem, u, stages, tolerances, optimiser, iterations, tell)
        searched, seen, costs = _best(run, problem, restarts, spread, seed)
    if seen is None and problem.found.start.size <= COVARIANCE_UP_TO:
        seen = look(problem, searched.unknowns, last)
    if seen is not None and not coordinates.is_traced(seen) and not np.any(np.asarray(seen.well)):
        _check_motion(problem, seen, problem.start)
    found = Fit(problem, *searched, costs, seen, tuple(sorted((units or {}).items())))
    if coordinates.is_traced(found.cost):
        return found
    if seen is not None and found.at_bounds():
        # There the search's own slopes vanish.
        found = eqx.tree_at(lambda f: f.seen, found, look(problem, searched.unknowns, last))
    for words in doubts(found):
        warnings.warn(words, FitWarning, stacklevel=2)
    return found


def identifiability(
    system: System,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    window: float | None = None,
    **options,
) -> Identifiability:
    """Say which combinations of parameters measurements like these can see, before anything is fitted.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2)
    >>> t = jnp.linspace(0.0, 10.0, 60)
    >>> print(identifiability(spring, lj.Record(t, q=jnp.cos(t)), {"m": 1.0, "k": 1.0}))
    Identifiability: of 'k' and 'm' the data see only
      k/m

    **Arguments:** as for `lj.fit`. Only the times, what was measured, and `sigma` count, not the measured values;
    `params` and the starts are where it is asked.

    **Returns:** an `Identifiability`.

    **Raises:** as `lj.fit`.
    """
    problem = problem_of(system, records, params, free, observe, None, priors, "squares", window, options)
    seen = look(problem, problem.start, WHOLE)
    _check_motion(problem, seen, problem.start)
    noise = np.asarray(1.0) if problem.absolute else None
    return Identifiability(problem.found.names, problem.found.start, seen.singular_values, seen.combinations, noise)


def _stages(problem: Problem, grow: bool, joined: bool) -> tuple[Stage, Any]:
    unknowns = sum(x.shape[-1] for x in jax.tree.leaves(problem.start))
    measured = sum(int(np.prod(x.shape[1:])) for x in jax.tree.leaves(problem.measured))
    doublings = int(np.clip(np.log2(max(measured / max(A_STAGE_HAS * unknowns, 1), 1)), 0, STAGES - 1))
    doublings = doublings if grow else 0
    settling, joining = (0 if problem.loss == "squares" else SETTLING), (JOINED if joined else ())
    parts = [2.0**-i for i in range(doublings, -1, -1)] + [1.0] * (settling + len(joining))
    weights = [0.0] * (doublings + 1 + settling) + list(joining)
    ratio = problem.spread_in_sigmas
    rtol = problem.options.get("rtol")
    done = max(DONE, ROUND_OFFS * np.finfo(problem.windows.ts.dtype).eps)
    done = done if rtol is None else jnp.maximum(done, OF_RTOL * jnp.max(jnp.asarray(rtol)))
    last = np.arange(len(parts)) == len(parts) - 1
    xp = coordinates.numpy_of((ratio, done))
    stages = Stage(np.asarray(parts), xp.asarray(weights) * ratio, np.ones(len(parts)))
    return stages, xp.where(last, done, STAGE_DONE) * ratio


@contextmanager
def _shown(problem, stages, progress):
    """A meter of the search's steps; whether there is one."""
    if coordinates.is_traced(problem):
        yield False
        return
    with meter(progress, unit=" steps", desc="fit") as shown:
        if shown.disable:
            yield False
            return

        def step(stage, cost):
            shown.set_postfix_str(f"stage {stage + 1} of {stages}, cost {cost:.4g}", refresh=False)
            shown.update(1)

        with listening(step):
            yield True


def _best(run, problem, restarts, spread, seed):
    """The best search, what the data say at its end if it knows, and the costs of all restarts."""
    start = problem.start
    if not restarts:
        return *run(start), None
    x = _scattered(problem.found, restarts, spread, seed)
    starts = Unknowns(jnp.concatenate([start.shared[None], x]), jnp.stack([start.own] * (restarts + 1)))
    every = one_by_one(run, starts)
    costs = every[0].cost
    best = jnp.argmin(jnp.where(jnp.isfinite(costs), costs, jnp.inf))
    return *jax.tree.map(lambda x: x[best], every), costs


def _scattered(found, count, spread, seed):
    """Starts (count, p) around the guess, or between two bounds."""
    size = jnp.where(found.start != 0, found.start, 1.0)
    bounded = jnp.isfinite(found.low) & jnp.isfinite(found.high)
    width = jnp.where(bounded, found.high - found.low, 0.0)

    def one(key):
        here, anywhere = jax.random.split(key)
        x = found.start + size * jnp.expm1(spread * jax.random.normal(here, size.shape))
        share = jax.random.uniform(anywhere, size.shape, minval=0.01, maxval=0.99)
        inside = (x > found.low) & (x < found.high)
        return jnp.where(bounded, found.low + share * width, jnp.where(inside, x, found.start))

    return jax.vmap(one)(jax.random.split(jax.random.key(seed), count))


def _check_motion(problem, seen, u):
    """Raise, in the words of the integration, where a motion fails."""
    failed = np.flatnonzero(~np.asarray(seen.well))
    if not failed.size:
        return
    w = int(failed[0])
    ts, params, (q, v), options = problem.setting(u.shared, u.own[w], w, WHOLE)
    reason = "it stops early"
    try:
        integrate(problem.system, q, v, params, ts=ts, **(options | {"throw": True}))
    except (ValueError, RuntimeError) as error:
        reason = str(error)
    raise ValueError(
        f"from the guess the motion of record {int(problem.windows.record[w])} fails: {reason}\n"
        "Fix: guess params, q0 and v0 nearer to the truth; try them with lj.integrate first."
    )
