"""The front door before a fit: what measurements can see, and what is to be measured next."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import PyTree

from lagjax.fitting.design import next_measurements, surveyed
from lagjax.fitting.equations import WHOLE
from lagjax.fitting.identifiability import Identifiability
from lagjax.fitting.predicted import check_motion
from lagjax.fitting.problem import problem_of
from lagjax.fitting.records import Record
from lagjax.fitting.search import evaluate
from lagjax.mechanics import coordinates
from lagjax.mechanics.hybrid import Hybrid
from lagjax.mechanics.system import System


def identifiability(
    system: System | Hybrid,
    records: Record | Sequence[Record],
    params: PyTree,
    *,
    free: str | Iterable[str] | None = None,
    observe: Callable | None = None,
    priors: Mapping[str, tuple[float, float]] | None = None,
    window: float | None = None,
    shrink: str | Callable | None = None,
    candidates: Mapping[str, Record] | None = None,
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

    What next to measure, so as to know k better (all of `next.candidates`, the best of them, when):

    >>> record = lj.Record(t, q=jnp.cos(t), sigma=0.01)
    >>> asked = identifiability(spring, record, {"m": 1.0, "k": 1.0}, free="k", shrink="k")
    >>> print(asked.next.best.name, asked.next.best.times.round(1), asked.next.best.sd < asked.next.now)
    q [20.2] True

    **Arguments:** as for `lj.fit`. Only the times, what was measured, and `sigma` count, not the measured values;
    `params` and the starts are where it is asked.

    - `shrink`: the name of a number that is to be better known, `"k"`; or a function of `params` whose value is.
    - `candidates`: by name, a `lj.Record` of each run that could be measured next: its times, what would be measured
      (any numbers, such as `np.zeros(50)`; NaN where nothing), `sigma`, the start `q0` and `v0`, which is as unknown as
      that of a fit unless `hold_q` and `hold_v` say that it is known, `params` of its own. Left out, it is one further
      measurement of each coordinate and velocity in the runs that there are, at their times or as long again after
      them. What the records do not measure is taken to be measured as well as `sigma` says, where that is one number
      or has one for the kind; else it is left out.

    **Returns:** an `Identifiability`; with `shrink` its `next` says how certain the number is now, and would be after
    each candidate, where errors are small enough for the slopes at `params` to serve.

    **Raises:** as `lj.fit`; `ValueError` where `shrink` is not among what is found, or the motion of a candidate fails.

    Source: Pukelsheim, *Optimal Design of Experiments*, ch. 2.
    """
    settings = lambda observe: (free, observe, None, priors, "squares", window, dict(options))
    problem = problem_of(system, records, params, *settings(observe))
    if shrink is None and candidates is not None:
        raise ValueError('candidates= are judged by what they shrink.\nFix: shrink="g", the number to know better.')
    at = None if shrink is None else surveyed(problem, problem.start)
    evaluation = evaluate(problem, problem.start, WHOLE) if at is None else at.evaluation
    if coordinates.is_traced(evaluation):
        raise TypeError(
            "identifiability looks at numbers, and here it is traced.\n"
            "Fix: call it in a Python loop, not in jit, vmap or lj.sweep: it is compiled once."
        )
    check_motion(problem, evaluation.well, problem.start)
    following = None
    if at is not None:
        # `observe` belongs to those that are measured by it.
        observing = lambda runs: observe if "observed" in runs[0].measured else None
        of = lambda runs: problem_of(system, runs, params, *settings(observing(runs)))
        runs = [records] if isinstance(records, Record) else list(records)
        following = next_measurements(problem, runs, at, shrink, candidates, of)
    noise = np.asarray(1.0) if problem.absolute else None
    return Identifiability(
        problem.found.names, problem.found.start, evaluation.singular_values, evaluation.combinations, noise, following
    )
