"""Warnings about a fit, in words: each says what happened, the usual cause, and what to do."""

import jax
import numpy as np

from lagjax.fit.problem.records import channel_name
from lagjax.fit.result.result import Fit
from lagjax.fit.search.search import Evaluation
from lagjax.fit.uncertainty.identifiable import rank_of
from lagjax.mechanics import listed

# A search has gone astray if a number ends this many times as large as its guess.
ASTRAY = 1e6


def caveats(fit: Fit) -> list[str]:
    """What a user has to know about a fit, the most serious first."""
    words = [_search_caveat(fit), _astray_caveat(fit), _sigma_caveat(fit) or _curve_caveat(fit)]
    if fit.evaluation is not None:
        words += [_parameters_caveat(fit, fit.evaluation), _motion_caveat(fit, fit.evaluation)]
        words += [] if fit.problem.absolute else [_freedom_caveat(fit)]
    if at := fit.at_bounds():
        words.append(f"{listed(at)} ended at a bound, where uncertainties mean nothing.")
    return [caveat for caveat in words if caveat]


def _search_caveat(fit: Fit):
    if bool(fit.rested):
        return ""
    return (
        f"the search stopped after {int(fit.steps)} steps without converging; this is its best point.\n"
        "Usual cause: a guess too far off, parameters that the data hardly determine, noise in the motion itself.\n"
        "Fix: look at found.plot(); try restarts=8, a shorter window=, or iterations=1000."
    )


def _astray_caveat(fit: Fit):
    guesses = zip(fit.names, np.asarray(fit.problem.found.start), np.asarray(fit.values))
    for name, guess, x in guesses:
        if guess and abs(x) > ASTRAY * abs(guess):
            return (
                f"the search went astray: '{name}' was guessed to be {guess:.4g}, and ended at {x:.4g}.\n"
                "Usual cause: a guess too far off, outliers, angles wrapped to one turn.\n"
                f'Fix: bounds={{"{name}": (low, high)}}, a better guess, a shorter window=, or loss="cauchy".'
            )
    return ""


def _parameters_caveat(fit: Fit, at: Evaluation):
    if rank_of(np.asarray(at.singular_values)) == len(fit.names):
        return ""
    return (
        f"the data do not determine all parameters.\n{fit.identifiability}\n"
        "An undetermined parameter has no uncertainty. One that leaves no trace keeps its guess; of others only the "
        "combinations above mean something.\n"
        "Fix: leave some out of free=, give priors=, or measure more."
    )


def _motion_caveat(fit: Fit, at: Evaluation):
    failed = np.flatnonzero(~np.asarray(at.well))
    if not failed.size:
        return ""
    record, windows = int(fit.problem.windows.record[failed[0]]), fit.problem.windows.count
    which = f"the motion of record {record} stops"
    if failed.size > 1:
        share = f"{failed.size} of {windows} motions ({100 * failed.size / windows:.0f} %)"
        which = f"{share}, the first of them of record {record}, stop"
    return (
        f"at the estimates {which} early; samples after that count as large residuals.\n"
        f"Fix: found.motion({record}).result says why; give a better guess, or bounds=."
    )


def _sigma_caveat(fit: Fit):
    large = [name for name, large in zip(_channels(fit), np.asarray(fit.misfit.large)) if large]
    if not large:
        return ""
    times = float(np.nanmax(fit.misfit.times))
    return (
        f"the residuals of {listed(large)} are {times:.2g} times as large as sigma says, so the ± mean nothing.\n"
        "Usual cause: a wrong minimum, something that the system leaves out, outliers, or too small a sigma.\n"
        'Fix: look at found.plot(); try a shorter window=, restarts=30, loss="cauchy".'
    )


def _freedom_caveat(fit: Fit):
    if float(fit.freedom) > 0:
        return ""
    return (
        "there are as many unknowns as measurements, so their uncertainties cannot be estimated.\n"
        "Fix: measure more, free fewer, or say how large the errors are: lj.Record(..., sigma=0.01)."
    )


def _curve_caveat(fit: Fit):
    missed = [name for name, curved in zip(_channels(fit), np.asarray(fit.misfit.curved)) if curved]
    if not missed:
        return ""
    return (
        f"the residuals of {listed(missed)} are not measurement errors: they are large and follow a curve.\n"
        "Usual cause: a wrong minimum, or something that the system leaves out.\n"
        "Fix: look at found.plot(); try a better guess, restarts=30, a shorter window=."
    )


def _channels(fit: Fit):
    """The names of what was measured, in the order of a `Misfit`."""
    paths = {kind: jax.tree_util.tree_leaves_with_path(tree) for kind, tree in fit.problem.measured.items()}
    return [channel_name(kind, path) for kind, leaves in paths.items() for path, _ in leaves]
