"""`identifiability`: what measurements can determine before a fit, and what to measure next."""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from jaxtyping import PyTree

from lagjax.fit.problem.arguments import problem_of
from lagjax.fit.problem.checks import check_motion
from lagjax.fit.problem.records import Record
from lagjax.fit.problem.residuals import WHOLE
from lagjax.fit.search.search import evaluate
from lagjax.fit.uncertainty.identifiable import Identifiability
from lagjax.fit.uncertainty.next_measurement import next_measurements, survey
from lagjax.jaxtools import is_traced
from lagjax.system import Hybrid, System


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
    """Say which combinations of parameters measurements like these determine, before anything is fitted.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> spring = lj.System(lambda t, q, v, params: 0.5 * params["m"] * v**2 - 0.5 * params["k"] * q**2)
    >>> t = jnp.linspace(0.0, 10.0, 60)
    >>> print(identifiability(spring, lj.Record(t, q=jnp.cos(t)), {"m": 1.0, "k": 1.0}))
    Identifiability: of 'k' and 'm' the data see only
      k/m

    What to measure next to know k better (`next.candidates` lists all candidates, `next.best` the best with its times):

    >>> record = lj.Record(t, q=jnp.cos(t), sigma=0.01)
    >>> asked = identifiability(spring, record, {"m": 1.0, "k": 1.0}, free="k", shrink="k")
    >>> print(asked.next.best.name, asked.next.best.times.round(1), asked.next.best.sd < asked.next.now)
    q [20.2] True

    **Arguments:** as for `lj.fit`. Only the times, the measured quantities and `sigma` count, not the measured values;
    the answer holds at `params` and at the guessed starts.

    - `shrink`: the name of the parameter whose uncertainty should shrink, `"k"`; or a function of `params` that returns
      such a number.
    - `candidates`: by name, a `lj.Record` of each run that could be measured next: its times, what would be measured
      (any numbers, such as `np.zeros(50)`; NaN where nothing is measured), `sigma`, the start `q0` and `v0`, and its
      own `params`. The start is an unknown, as in a fit, unless `hold_q` and `hold_v` say that it is known. By default
      the candidates are one further measurement of each coordinate and velocity in the existing runs, during the run or
      within the same length of time after it. A quantity that the records do not measure is assumed to have the error
      that `sigma` gives, if `sigma` is one number or has an entry for its kind; else it is left out.

    **Returns:** an `Identifiability`; with `shrink` its `next` says how certain the number is now and would be after
    each candidate, to first order in the errors (from the slopes at `params`).

    **Raises:** as `lj.fit`; `ValueError` if `shrink` is not among the fitted parameters, or the motion of a candidate
    fails.

    Source: Pukelsheim, *Optimal Design of Experiments*, ch. 2.
    """

    def problem_for(records: Sequence[Record], observe: Callable | None):
        return problem_of(
            system, records, params, free, observe, None, priors, "squares", window, dict(options), weak=False
        )

    problem = problem_for(records, observe)
    if shrink is None and candidates is not None:
        raise ValueError('candidates= needs shrink=, the number that they are compared by.\nFix: shrink="g".')
    at = None if shrink is None else survey(problem, problem.start)
    evaluation = evaluate(problem, problem.start, WHOLE) if at is None else at.evaluation
    if is_traced(evaluation):
        raise TypeError(
            "identifiability needs the values of its arguments, and they are being traced.\n"
            "Fix: call it in a Python loop, not in jit, vmap or lj.sweep: it is compiled only once."
        )
    check_motion(problem, evaluation.well, problem.start)
    following = None
    if at is not None:
        runs = [records] if isinstance(records, Record) else list(records)

        def of_candidates(runs: Sequence[Record]):
            # Only candidates with `observed` measurements take `observe`.
            return problem_for(runs, observe if "observed" in runs[0].measured else None)

        following = next_measurements(problem, runs, at, shrink, candidates, of_candidates)
    noise = np.asarray(1.0) if problem.absolute else None
    return Identifiability(
        problem.found.names, problem.found.start, evaluation.singular_values, evaluation.combinations, noise, following
    )
