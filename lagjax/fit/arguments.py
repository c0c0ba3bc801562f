"""Turn the user's arguments into the arrays of a fit, with errors in the user's words."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from lagjax.fit.records import KINDS, Record, Windows, channels, cut, spread
from lagjax.fit.residuals import LOSSES, FitProblem, replace
from lagjax.fit.unknowns import FreeNumbers, find, leaf_name, starts
from lagjax.integrate import Crossing, traced_guard, traced_phases
from lagjax.jaxtools import is_traced, numpy_of
from lagjax.mechanics import listed
from lagjax.refusals import must_be_among, must_name
from lagjax.system import OF_STATE, Call, Hybrid, State, System, check_system, model_of, traced_call, traced_system

# Arguments of `integrate` that a fit sets itself.
SET_BY_FIT = {"ts", "throw", "adjoint"}
# Beside a weak prior an error counts as this fraction of the data's spread, if there is no sigma.
ASSUMED_ERROR = 1e-3


class FitWarning(UserWarning):
    """A fit has a result, but with reservations that the message states."""


def problem_of(
    system: System | Hybrid,
    records: Record | Sequence[Record],
    params: PyTree,
    free: str | Iterable[str] | None,
    observe: Callable | None,
    bounds: Mapping | None,
    priors: Mapping | None,
    loss: str,
    window: float | None,
    options: dict[str, Any],
    weak: bool = True,
) -> FitProblem:
    """Check all arguments and make arrays of them; `weak`: with weak priors for the weights of networks."""
    check_system(system, records, params, phases=True, elements=True)
    # A motion in phases starts in that of `start=`, which is no option of the motions.
    system = system.starting(options.pop("start", None))
    if system.elements is not None and window is not None:
        raise ValueError(
            "window= cuts records into windows with free starts, and a start of a system with elements may be inside a "
            "contact.\nFix: leave window out; or a lj.Record for each part, with its start."
        )
    if system.in_phases and window is not None:
        raise ValueError(
            "window= cuts records into windows, but for a lj.Hybrid the phase in which each window would start is not "
            "known.\nFix: leave window out; or a lj.Record for each part, with start= the phase of all of them."
        )
    first = system.first_phase
    records = [records] if isinstance(records, Record) else list(records)
    if not records or not all(isinstance(record, Record) for record in records):
        raise TypeError("records must be a lj.Record or a list of them.\nFix: lj.Record(t, q=measured).")
    must_be_among(LOSSES, loss, "loss")
    if SET_BY_FIT & set(options):
        raise ValueError(f"{listed(sorted(SET_BY_FIT & set(options)))} cannot be given: a fit sets it itself.")
    _check_kinds(records, observe, options)
    absolute = _absolute(records, loss, priors)
    dtype = jnp.result_type(float)
    options = {name: np.asarray(x, dtype) if isinstance(x, float) else x for name, x in options.items()}
    found = find(params, free, bounds or {}, priors or {}, dtype, (1.0 if absolute else ASSUMED_ERROR) if weak else 0.0)
    windows = cut(records, window, dtype)
    overrides = _overrides(records, windows, found)
    params_of_records = [
        replace(found.params, {name: values[r] for name, values in overrides.items()}) for r in range(len(records))
    ]
    guessed, unflatten, guess = starts(first, records, windows, params_of_records, options)
    if not found.names and not guessed.q.along.shape[-1] + guessed.v.along.shape[-1]:
        raise ValueError(
            "nothing is left to find: no number of params is free, and every start is known.\n"
            "Fix: free=... with the names of the numbers to find, or lj.Record(...) without hold_q and hold_v."
        )
    system = traced_phases(system, guess)
    first, observe, options = system.first_phase, _traced(observe, guess), _with_traced_events(options, first, guess)
    measured = {kind: _gathered(windows, [record.measured[kind] for record in records], kind)
                for kind in records[0].measured}  # fmt: skip
    _check_anything_measured(measured)
    sigma, spreads, ratio = _sigmas(records, windows, measured, absolute)
    per_window = {name: values[windows.record] for name, values in overrides.items()}
    xp = numpy_of((guessed.q.guess, guessed.v.guess))
    unit = xp.std(xp.concatenate([guessed.q.guess, guessed.v.guess], axis=1), axis=0)
    _warn_of_wrapped_angles(records)
    return FitProblem(
        system, first, found, per_window, windows, guessed, measured, sigma, spreads, ratio,
        xp.where(unit > 0, unit, 1.0), unflatten, observe, options, loss, absolute,
    )  # fmt: skip


def _traced(observe: Callable | None, guess: State):
    if observe is None:
        return None
    return traced_call(Call("observe", observe, OF_STATE), guess._asdict(), lambda call, value: None)


def _with_traced_events(options: dict[str, Any], system: System, guess: State):
    events = options.get("events")
    if not isinstance(events, Mapping) or not all(isinstance(event, Crossing) for event in events.values()):
        return options
    given = guess._asdict() | {"multipliers": model_of(traced_system(system, guess), *guess).zero_multipliers()}
    traced = {name: event.with_guard(traced_guard(name, event.guard, given)) for name, event in events.items()}
    return options | {"events": traced}


def _absolute(records: Sequence[Record], loss: str, priors: Mapping | None):
    """Whether the sizes of the errors are known; raise if they are needed and not given."""
    given = [record.sigma is not None for record in records]
    if any(given) and not all(given):
        raise ValueError(
            f"record {given.index(False)} has no sigma, but others have one.\nFix: give it to all, or none."
        )
    if all(given):
        return True
    why = None
    if any(len(record.measured) > 1 for record in records):
        why = f"measurements of several kinds ({listed(list(records[0].measured))}) must be weighed against each other"
    elif any(pair is not None for pair in (priors or {}).values()):
        why = "a prior must be weighed against the data"
    elif loss != "squares":
        why = f"loss={loss!r} must know how large an ordinary error is"
    if why:
        raise ValueError(f"{why}, but the records have no sigma.\nFix: lj.Record(..., sigma=0.01).")
    return False


def _overrides(records: Sequence[Record], windows: Windows, found: FreeNumbers):
    names = sorted({name for record in records for name in record.params})
    known = {leaf_name(path): x for path, x in jtu.tree_leaves_with_path(found.params)}
    fitted = {name.partition("[")[0] for name in found.names}
    values = {}
    must_name(names, known, "a record sets", "entry of params")
    for name in names:
        if name in fitted:
            raise ValueError(
                f"a record sets '{name}', which the fit is to find.\nFix: leave it out of free=, or out of the record."
            )
        given = [record.params.get(name, known[name]) for record in records]
        xp = numpy_of(given)
        values[name] = xp.stack([xp.asarray(x, jnp.result_type(float)) for x in given])
    return values


def _check_kinds(records: Sequence[Record], observe: Callable | None, options: dict[str, Any]):
    kinds = set(records[0].measured)
    for r, record in enumerate(records):
        structures = [jax.tree.structure(x.measured) for x in (records[0], record)]
        if structures[0] != structures[1]:
            raise ValueError(
                f"record {r} holds {listed([n for n, _ in record.channels()])}, but record 0 "
                f"{listed([n for n, _ in records[0].channels()])}: they must hold the same quantities.\n"
                "Fix: write NaN for what was not measured in a run."
            )
    if ("observed" in kinds) != (observe is not None):
        raise ValueError(
            "observe= and the records' observed= belong together, but only one of them is given.\n"
            'Fix: lj.Record(t, observed={"x": x}) and observe=lambda t, q, v, params: {"x": ...}.'
        )
    if "end" in kinds and not (options.get("event") or options.get("events")):
        raise ValueError(
            "records have end=, but the fit has no events= that end the motion.\n"
            'Fix: events={"down": lj.Crossing(lambda t, q, v, params: q["y"])}.'
        )


def _gathered(windows: Windows, trees: Sequence[PyTree], kind: str):
    if kind == "end":
        last = np.append(windows.record[1:] != windows.record[:-1], True)
        xp = numpy_of(trees)

        def place(*x):
            return xp.stack([xp.where(at, x[r], np.nan) for r, at in zip(windows.record, last)])

        return jax.tree.map(place, *trees)
    return jax.tree.map(lambda *x: windows.gather(x), *trees)


def _check_anything_measured(measured: PyTree):
    if not is_traced(measured) and all(np.all(np.isnan(x)) for x in jax.tree.leaves(measured)):
        raise ValueError(
            "all measurements are NaN.\nUsual cause: a column of a file that was not read as numbers.\n"
            "Fix: look at record.measured; NaN stands for a value that is missing."
        )


def _sigmas(records: Sequence[Record], windows: Windows, measured: PyTree, absolute: bool):
    """Sigmas in the shape of the measurements, the spread of each channel, and the largest spread in sigmas."""
    spreads = jax.tree.map(_spread, measured)
    if not absolute:
        # One size for all; the fit estimates the errors as a multiple of it.
        xp = numpy_of(spreads)
        common = xp.sqrt(xp.mean(xp.stack(jax.tree.leaves(spreads)) ** 2))
        return jax.tree.map(lambda x: xp.full(x.shape, common), measured), spreads, np.asarray(1.0)
    each = [{kind: _broadcast(record, kind) for kind in record.measured} for record in records]
    sigma = {kind: _gathered(windows, [tree[kind] for tree in each], kind) for kind in measured}
    xp = numpy_of((spreads, sigma))
    finest = [xp.nanmin(xp.where(xp.isfinite(s), s, np.nan)) for s in jax.tree.leaves(sigma)]
    ratios = [a / s for a, s in zip(jax.tree.leaves(spreads), finest)]
    return sigma, spreads, xp.asarray(xp.max(xp.stack(ratios)))


def _spread(x: Array):
    """The standard deviation of a channel; its largest absolute value if that is 0; 1 if that is 0, too."""
    xp, deviation = numpy_of(x), spread(x)
    size = xp.max(xp.where(xp.isnan(x), 0.0, xp.abs(x)), initial=0.0)
    deviation = xp.where(deviation > 0, deviation, size)
    return xp.where(deviation > 0, deviation, 1.0)


def _broadcast(record: Record, kind: str):
    sigma, tree = record.sigma, record.measured[kind]
    if isinstance(sigma, Mapping):
        if kind not in sigma:
            raise ValueError(
                f"sigma has no entry '{kind}'; it has {listed(list(sigma))}.\n"
                f'Fix: sigma={{"{kind}": ...}}, by kind of measurement ({listed(KINDS)}).'
            )
        sigma = sigma[kind]

    def like(s: ArrayLike, part: PyTree):
        def one(x: Array):
            xp = numpy_of(s)
            given = xp.asarray(s, x.dtype)
            if xp is np and not np.all(given > 0):
                raise ValueError("sigma must be positive.\nFix: sigma=jnp.inf, or NaN in the data, leaves a value out.")
            if 0 < given.ndim < x.ndim and given.shape == x.shape[: given.ndim]:
                given = given.reshape(given.shape + (1,) * (x.ndim - given.ndim))
            return xp.broadcast_to(given, x.shape)

        return jax.tree.map(one, part)

    try:
        return jtu.tree_map(like, sigma, tree)
    except (ValueError, TypeError) as error:
        if "sigma must" in str(error):
            raise
        raise ValueError(f"sigma of '{kind}' does not fit the measurements: {error}") from error


def _warn_of_wrapped_angles(records: Sequence[Record]):
    for r, record in enumerate(records):
        for name, x in channels(record.measured):
            if name.startswith("end") or "q" not in record.measured or is_traced(x):
                continue
            jumps = np.abs(np.diff(np.asarray(x), axis=0))
            turns = (jumps > 1.95 * np.pi) & (jumps < 2.05 * np.pi)
            if turns.any() and np.nanmedian(jumps) < 0.5:
                warnings.warn(
                    f"'{name}' of record {r} jumps by a whole turn: the angle seems to be wrapped.\n"
                    f"Fix: np.unwrap({name}).",
                    FitWarning,
                    stacklevel=4,
                )
